"""The pictures of README and documentation, made anew from the shipped data: ``python docs/pictures.py``.

Side by side, with the camera alone: its raw measurements, the measurements interpolated, a constant-velocity Kalman
filter tuned by maximum likelihood, and pumafuse. All have the camera's latency removed; errors are those on the
reference.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import msgspec
import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.optimize import minimize_scalar

import pumafuse as pf
from pumafuse.filter.response import response
from pumafuse.fusion.score import interpolate
from pumafuse.views import colours, step_figures

HERE = Path(__file__).parent
DATA = Path(pf.__file__).parent / "data"
SCAN = DATA / "scan"
SD, GATE = 0.5e-3, 4.0  # m, sigma: the camera's, the same for both filters
STRETCH = (33.6, 36.2)  # s of the scan, with an outlier and dropouts
BENDS = {  # scenarios of arms that are not linear
    "saturating-servo": "a fastest speed: behind beyond it",
    "tool-with-play": "play: off by half of it, either way",
    "sagging-lever": "a sag: off by where it is",
}
COLOURS = ["#c2c6cc", "#8a8f98", "#e8890c", colours.ESTIMATE, "#0a3d7a"]


def constant_velocity(time, value, density, at):
    """Filtered position at ``at`` and the log-likelihood of a constant-velocity filter with acceleration noise."""
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.x, kf.P = np.array([[value[0]], [0.0]]), np.diag([SD**2, 0.1**2])
    kf.H, kf.R = np.array([[1.0, 0.0]]), np.array([[SD**2]])
    states, likelihood, rejected = [(time[0], kf.x[:, 0])], 0.0, 0
    for step, z in zip(np.diff(time), value[1:], strict=True):
        Q = density**2 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        kf.predict(F=np.array([[1.0, step], [0.0, 1.0]]), Q=Q)
        S = kf.P[0, 0] + SD**2
        nis = (z - kf.x[0, 0]) ** 2 / S
        rejected = rejected + 1 if nis > GATE**2 else 0
        likelihood -= 0.5 * (np.log(2 * np.pi * S) + min(nis, GATE**2))
        if nis <= GATE**2 or rejected > 5:  # a gate that never reacquired would lose the arm for good
            kf.update(np.array([[z]]))
        states.append((states[-1][0] + step, kf.x[:, 0]))
    stamps, mean = np.array([stamp for stamp, _ in states]), np.array([x for _, x in states])
    last = np.maximum(np.searchsorted(stamps, at, side="right") - 1, 0)
    return mean[last, 0] + mean[last, 1] * np.maximum(at - stamps[last], 0.0), likelihood


def rows(est, axis):
    """Positions on the even grid by each method."""
    seen = est.measurements.of("vision", axis)
    good = seen.where(seen.outcome == pf.Outcome.FUSED)

    def misfit(log_density):
        return -constant_velocity(seen.time, seen.value, np.exp(log_density), est.time)[1]

    best = minimize_scalar(misfit, bounds=(-6.0, 3.0), method="bounded")
    held = np.maximum(np.searchsorted(good.time, est.time, side="right") - 1, 0)
    return {
        "last camera measurement held": good.value[held],
        "camera measurements interpolated (afterwards)": np.interp(est.time, good.time, good.value),
        "constant-velocity filter, tuned": constant_velocity(seen.time, seen.value, np.exp(best.x), est.time)[0],
        "pumafuse": est[axis].position,
    }


def errors(axes, methods, reference):
    """RMS error of each method on each axis as bars; prints them, too."""
    for place, (axis, positions) in enumerate(methods.items()):
        for number, (name, position) in enumerate(positions.items()):
            rms = float(np.sqrt(np.nanmean((position - reference[axis]) ** 2))) * 1e3
            print(f"{axis:11} {name:42} {rms:.3f} mm")
            at = place + 0.17 * (number - 2)
            axes.bar(at, rms, 0.16, color=COLOURS[number], label=name if place == 0 else None)
            axes.text(at, rms + 0.02, f"{rms:.2f}", ha="center", fontsize=8)
    axes.set_title("60 s of scanning: error of each method", loc="left")
    axes.set_xticks(range(len(methods)), list(methods))
    axes.set_ylabel("RMS error [mm]")
    axes.legend(frameon=False, fontsize=8)


def stretch(axes, est, methods, reference):
    """A few seconds of the y axis: the camera's measurements, each filter's estimate, and the reference."""
    start, end = STRETCH
    shown = (est.time >= start) & (est.time <= end)
    time, reference = est.time[shown], reference["y"][shown] * 1e3
    middle, span = np.median(reference), 1.9 * np.ptp(reference)
    low, high = middle - 0.5 * span, middle + 0.5 * span
    seen = est.measurements.of("vision", "y")
    seen = seen.where((seen.time >= start) & (seen.time <= end))
    fused, value = seen.outcome == pf.Outcome.FUSED, seen.value * 1e3
    axes.plot(seen.time[fused], value[fused], "o", ms=3.5, color=COLOURS[1], label="camera measurements")
    for when, far in zip(seen.time[~fused], value[~fused], strict=True):
        edge = np.clip(far, low + 0.04 * span, high - 0.04 * span)
        axes.plot(when, edge, "x", ms=8, mew=2, color=colours.REJECTED)
        axes.annotate(
            f"outlier, {far - np.interp(when, time, reference):+.0f} mm: rejected",
            (when, edge),
            (7, -3),
            textcoords="offset points",
            color=colours.REJECTED,
            fontsize=8,
        )
    on_y = methods["y"]
    other = "constant-velocity filter, tuned"
    axes.plot(time, on_y[other][shown] * 1e3, color=COLOURS[2], lw=1.2, label=other)
    position, sd = est["y"].position[shown] * 1e3, est["y"].position_sd[shown] * 1e3
    axes.fill_between(time, position - 1.96 * sd, position + 1.96 * sd, color=colours.ESTIMATE, alpha=0.22, lw=0)
    axes.plot(time, position, color=colours.ESTIMATE, lw=1.8, label="pumafuse, with its 95 % error bars")
    axes.plot(time, reference, "k--", lw=1.1, label="reference, used by no filter")
    axes.set(xlim=STRETCH, ylim=(low, high), xlabel="time [s]", ylabel="y [mm]")
    axes.set_title("a camera with 0.5 mm noise, 45 ms late, and two filters", loc="left")
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")


def lateness() -> None:
    """The four ways of being late, at constant velocity: the glossary's drawing."""
    period, dead, tau, latency = 40.0, 60.0, 55.0, 70.0  # ms
    time, level = np.linspace(0.0, 420.0, 2000), 3.5
    figure, axes = plt.subplots(figsize=(9.0, 4.0), layout="constrained")
    axes.plot(time, time / period, "--", color=COLOURS[0], lw=1.2, label="the path through the commanded points")
    axes.plot(time, np.floor(time / period), color=COLOURS[1], lw=1.5, label="commands, held")
    axes.plot(time, (time - period / 2) / period, color=COLOURS[1], lw=0.7)
    late = period / 2 + dead + tau
    axes.plot(time, (time - late) / period, color=colours.ESTIMATE, lw=2.0, label="the arm")
    begin, edges = level * period, np.cumsum([0.0, period / 2, dead, tau])
    names = ["T/2", "dead time (delay)", "plant"]
    for name, start, end in zip(names, edges[:-1], edges[1:], strict=True):
        between(axes, begin + start, begin + end, level, name, COLOURS[1])
    between(axes, begin + period / 2, begin + late, level - 0.75, "lag", colours.ESTIMATE)
    valid = begin + late + 45.0
    seen = (valid - late) / period
    axes.plot(valid, seen, "o", color=COLOURS[2], label="what a sensor sees, and when it is stamped")
    axes.plot(valid + latency, seen, "s", color=COLOURS[2])
    between(axes, valid, valid + latency, seen, "latency", COLOURS[2])
    axes.set(xlim=(100.0, 420.0), ylim=(1.6, 7.2), xlabel="time", ylabel="position", xticks=[], yticks=[])
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    figure.savefig(HERE / "images" / "lag.svg", metadata={"Date": None})


def bends() -> None:
    """What a fastest speed, play and a sag look like: measurements less the linear arm, over what shows each."""
    figure, shown = plt.subplots(1, 3, figsize=(13.0, 3.8), layout="constrained")
    for axes, (name, title) in zip(shown, BENDS.items(), strict=True):
        made = pf.simulate(pf.Scenario.load(HERE.parent / "scenarios" / f"{name}.toml"))
        ((axis, model),) = made.config.arm.axes.items()
        linear = msgspec.structs.replace(model, max_speed=None, play=None, sag=None)
        given, command = made.run.command.series(axis)
        stamp, seen = made.run.sensors["camera"].series(axis)
        valid = stamp - round(made.config.sensors["camera"].latency * 1e9)
        arm = made.config.arm.update_period, made.config.arm.delay_of(axis), given, command, float(command[0])
        beside, near = (response(linear, *arm, valid + shift) for shift in (0, 1_000_000))
        speed = (near - beside) * 1e3  # rad/s
        off, over = np.degrees(seen - command[0] - beside), np.degrees(speed if name == "saturating-servo" else beside)
        for forth, colour, label in (True, COLOURS[2], "on the way up"), (False, colours.ESTIMATE, "on the way down"):
            some = (speed > 0.0) == forth
            axes.plot(over[some], off[some], "o", ms=3, color=colour, label=label)
        unit = "speed of the linear arm [deg/s]" if name == "saturating-servo" else "position of the linear arm [deg]"
        axes.set(xlabel=unit, ylabel="camera less the linear arm [deg]")
        axes.set_title(title, loc="left")
        axes.axhline(0.0, color="k", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    shown[0].legend(frameon=False, fontsize=8)
    figure.savefig(HERE / "images" / "bends.svg", metadata={"Date": None})


def between(axes, start, end, level, name, colour):
    """An arrow from one instant to another with its name above."""
    arrow = {"arrowstyle": "<->", "color": colour, "shrinkA": 0.0, "shrinkB": 0.0}
    axes.annotate("", (end, level), (start, level), arrowprops=arrow)
    axes.text((start + end) / 2, level + 0.08, name, ha="center", va="bottom", fontsize=9, color=colour)


def main() -> None:
    """Write the pictures and print the numbers of the comparison."""
    warnings.simplefilter("ignore", pf.PumafuseWarning)
    run, config = pf.Run.read(SCAN), pf.FusionConfig.load(SCAN / "fusion.toml")
    est = pf.fuse(run, config, sensors=["vision"], rate=200.0)
    smooth = pf.fuse(run, config, sensors=["vision"], rate=200.0, mode="smoothed")
    methods = {axis: {**rows(est, axis), "pumafuse --smooth (afterwards)": smooth[axis].position} for axis in est.axes}
    reference = {axis: interpolate(est.time, est.segment, est.reference, axis) for axis in est.axes}
    figure, (left, right) = plt.subplots(1, 2, figsize=(13.0, 4.4), layout="constrained", width_ratios=[5, 4])
    stretch(left, est, methods, reference)
    errors(right, methods, reference)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(HERE / "images" / "comparison.png", dpi=110)

    trials = pf.StepTrials.read(DATA / "steps")
    picture = step_figures.responses(pf.identify(trials), trials)
    (HERE / "images" / "steps.svg").write_text(picture, encoding="utf-8")
    lateness()
    bends()


if __name__ == "__main__":
    main()

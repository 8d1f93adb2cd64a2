"""The pictures and the numbers of the README, made anew from the shipped data: ``python docs/pictures.py``.

Sets side by side, with the camera alone: its raw readings, the readings interpolated, a constant-velocity Kalman filter
tuned by maximum likelihood, and pumafuse. All have the camera's latency removed; errors are against the truth.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.optimize import minimize_scalar

import pumafuse as pf
from pumafuse.fusion.score import interpolated
from pumafuse.views import step_figures, style

HERE = Path(__file__).parent
DATA = Path(pf.__file__).parent / "data"
SD, GATE = 0.5e-3, 4.0  # m, sigma: the camera's, the same for both filters


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
        if nis <= GATE**2 or rejected > 5:  # a gate that never reopened would lose the arm for good
            kf.update(np.array([[z]]))
        states.append((states[-1][0] + step, kf.x[:, 0]))
    stamps, mean = np.array([stamp for stamp, _ in states]), np.array([x for _, x in states])
    last = np.maximum(np.searchsorted(stamps, at, side="right") - 1, 0)
    return mean[last, 0] + mean[last, 1] * np.maximum(at - stamps[last], 0.0), likelihood


def rows(est, axis):
    """Positions on the even grid by each method."""
    seen = est.readings.of("vision", axis)
    good = seen.where(seen.outcome == pf.Outcome.FUSED)

    def misfit(log_density):
        return -constant_velocity(seen.time, seen.value, np.exp(log_density), est.time)[1]

    best = minimize_scalar(misfit, bounds=(-6.0, 3.0), method="bounded")
    held = np.maximum(np.searchsorted(good.time, est.time, side="right") - 1, 0)
    return {
        "last camera reading held": good.value[held],
        "camera readings interpolated (afterwards)": np.interp(est.time, good.time, good.value),
        "constant-velocity filter, tuned": constant_velocity(seen.time, seen.value, np.exp(best.x), est.time)[0],
        "pumafuse": est[axis].position,
    }


def main() -> None:
    """Write the comparison picture and print its numbers."""
    warnings.simplefilter("ignore", pf.PumafuseWarning)
    run, config = pf.Run.read(DATA / "scan1"), pf.FusionConfig.load(DATA / "fusion.toml")
    est = pf.fuse(run, config, sensors=["vision"], rate=200.0)
    smooth = pf.fuse(run, config, sensors=["vision"], rate=200.0, smooth=True)
    colours = ["#c2c6cc", "#8a8f98", "#e8890c", style.ESTIMATE, "#0a3d7a"]
    methods = {axis: {**rows(est, axis), "pumafuse --smooth (afterwards)": smooth[axis].position} for axis in est.axes}
    truth = {axis: interpolated(est.time, est.segment, est.reference, axis) for axis in est.axes}
    figure, (bars, trace) = plt.subplots(1, 2, figsize=(13.0, 4.2), layout="constrained", width_ratios=[3, 2])
    start, end = style.busiest(est, 1.2)
    shown = (est.time >= start) & (est.time <= end)
    for number, colour in enumerate(colours):
        for place, axis in enumerate(est.axes):
            name, position = list(methods[axis].items())[number]
            rms = float(np.sqrt(np.nanmean((position - truth[axis]) ** 2))) * 1e3
            print(f"{axis:11} {name:42} {rms:.3f} mm")
            bars.bar(place + 0.17 * (number - 2), rms, 0.16, color=colour, label=name if place == 0 else None)
            bars.text(place + 0.17 * (number - 2), rms + 0.03, f"{rms:.2f}", ha="center", fontsize=8)
            if axis == "radial" and number > 0:
                trace.plot(est.time[shown], position[shown] * 1e3, color=colour, lw=1.4, label=name)
    trace.plot(est.time[shown], truth["radial"][shown] * 1e3, "k--", lw=1.0, label="truth")
    bars.set_xticks(range(3), list(est.axes))
    bars.set_ylabel("RMS error [mm]")
    bars.legend(frameon=False, fontsize=8)
    trace.set_xlabel("time [s]")
    trace.set_ylabel("radial [mm]")
    trace.legend(frameon=False, fontsize=8)
    for axes in (bars, trace):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(HERE / "images" / "comparison.png", dpi=110)

    trials = pf.StepTrials.read(DATA / "steps")
    picture = step_figures.responses(pf.identify(trials), trials)
    (HERE / "images" / "steps.svg").write_text(picture, encoding="utf-8")


if __name__ == "__main__":
    main()

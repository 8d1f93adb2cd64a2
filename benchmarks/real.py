"""Real recordings: errors of pumafuse and of filters without a gate, filtered, as live and smoothed.

    python benchmarks/real.py [--servo DIR [--write]]

Everything is tuned on one recording and scored on another, at the instants of the reference; in brackets the share of
errors within 95 % bars, in %. All but the last table is for docs/comparison.md, which is the README's: ``--write``
puts them there.
"""

from __future__ import annotations

import argparse
import math
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from generic import beginning
from kinematic import ORDERS, Array
from page import COMPARISON, REPOSITORY, put, table
from ungated import Regression, likeliest

import pumafuse as pf

MODES: dict[str, dict[str, Any]] = {"filtered": {}, "as live": {"mode": "as-live"}, "smoothed": {"mode": "smoothed"}}
KINDS = [f"constant {kind}" for kind in ORDERS]
METHODS = ["held", *KINDS, "LSQ+OU", "pumafuse"]
FIT = ["noise", "delay", "plant", "gain"]
LEARNT = 100.0  # s of trunk-servo

Errors = Mapping[
    str, tuple[float, float]
]  # of each method: RMSE [mm or degrees], coverage (NaN where there are no bars)


@dataclass(frozen=True)
class Recording:
    """What is tuned on, and what is scored with that.

    Attributes:
        name: Of the robot.
        learnt: What everything is tuned on.
        config: What is known before; it has one sensor.
        scored: Runs to score.
        skip: What is not scored after the first command [s]: it begins in motion, which nobody knows.
    """

    name: str
    learnt: pf.Run
    config: pf.FusionConfig
    scored: Sequence[pf.Run]
    skip: float = 0.0


@dataclass(frozen=True)
class Log:
    """One axis of a run, in s since the first command and mm or degrees: commands, and measurements when valid."""

    time: Array
    command: Array
    valid: Array
    value: Array

    @property
    def all(self) -> tuple[Array, Array, Array, Array]:
        """For a fit."""
        return self.time, self.command, self.valid, self.value


@dataclass
class Row:
    """One axis of a run in one mode."""

    run: str
    axis: str
    mode: str
    errors: dict[str, tuple[float, float]] = field(default_factory=dict)

    def cells(self, methods: Sequence[str]) -> list[str]:
        """RMSE and coverage of each."""
        return [cell(*self.errors[name]) if name in self.errors else "" for name in methods]


def cell(rmse: float, covered: float) -> str:
    """RMSE, and the coverage in brackets."""
    return f"{rmse:.3f}" + ("" if math.isnan(covered) else f" ({100.0 * covered:.0f})")


def recordings(servo: Path | None) -> Iterator[Recording]:
    """All of them."""
    trunk = REPOSITORY / "examples" / "trunk-servo"
    config = pf.FusionConfig.load(trunk / "fusion.toml")
    light, loaded = (pf.Run.read(trunk / name) for name in ("0g", "100g"))
    for learnt, scored in ((light, loaded), (loaded, light)):
        yield Recording("trunk", beginning(learnt, config, LEARNT), config, [scored], skip=3.0)
    if servo is not None:
        runs = [pf.Run.read(servo / name) for name in ("sin_time_square", "sin_sin")]
        tip = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.030))
        arm = pf.ArmModel(name="servo", update_period=0.020, delay=0.020, axes={"tip": tip})
        yield Recording("servo", runs[0], pf.FusionConfig(arm=arm, sensors={"encoder": pf.Sensor(sd=1e-4)}), runs)


def log(run: pf.Run, config: pf.FusionConfig, axis: str) -> Log:
    """What everybody is given of an axis."""
    (name, sensor), origin = next(iter(config.sensors.items())), int(run.command.stamp.min())
    source = run.sensors[name]
    time, stamp = ((stamps - origin) / 1e9 for stamps in (run.command.stamp, source.stamp))
    scale = config.arm.screen_of(axis).scale
    return Log(time, scale * run.command.values[axis], stamp - sensor.latency, scale * source.values[axis])


def held(seen: Log, at: Array, late: float) -> list[Array]:
    """The last measurement; it has no error bars."""
    last = np.searchsorted(seen.valid, at - late, side="right") - 1
    return [np.where(last < 0, np.nan, seen.value[last]), np.full(len(at), np.nan)]


def rivals(seen: Log) -> Mapping[str, Callable[..., list[Array]]]:
    """Each as a function of a log, instants, what is late, and whether it is smoothed."""
    kinds = {f"constant {kind}": likeliest(order, seen.valid, seen.value) for kind, order in ORDERS.items()}
    regression = Regression.fit(*seen.all)

    def answer(seen: Log, at: Array, late: float, smooth: bool) -> list[Array]:
        expected = regression.response.at(seen.time, seen.command, seen.valid)
        mean, sd = regression.rest.estimate(seen.valid, seen.value - expected, at, late, smooth)
        return [regression.response.at(seen.time, seen.command, at) + mean, sd]

    def generic(kind: str) -> Callable[..., list[Array]]:
        return lambda seen, at, late, smooth: kinds[kind].estimate(seen.valid, seen.value, at, late, smooth)

    return {kind: generic(kind) for kind in kinds} | {"LSQ+OU": answer}


def score(mean: Array, sd: Array, true: Array) -> tuple[float, float]:
    """RMSE and coverage."""
    given = np.isfinite(mean)
    error, sd = (mean - true)[given], sd[given]
    covered = math.nan if np.isnan(sd).all() else float(np.mean(np.abs(error) <= 1.96 * sd))
    return float(np.sqrt(np.mean(error**2))), covered


def measure(recording: Recording) -> Iterator[Row]:
    """A row for each axis and mode of what is scored."""
    (sensor,) = recording.config.sensors.values()
    tuned = pf.tune([recording.learnt], recording.config, fit=FIT, validate=recording.scored[-1]).config
    fitted = {axis: rivals(log(recording.learnt, recording.config, axis)) for axis in recording.config.arm.axes}
    modes = {mode: options for mode, options in MODES.items() if mode != "as live" or sensor.latency}  # else filtered
    for run in recording.scored:
        for mode, options in modes.items():
            est = pf.fuse(run, tuned, **options)
            for axis, found in fitted.items():
                yield row(recording, run, axis, mode, est, found)


def row(
    recording: Recording,
    run: pf.Run,
    axis: str,
    mode: str,
    est: pf.Estimates,
    found: Mapping[str, Callable[..., list[Array]]],
) -> Row:
    """All methods at the instants of the reference at which there is a command, and so an estimate of pumafuse."""
    seen = log(run, recording.config, axis)
    assert est.reference is not None
    scale = recording.config.arm.screen_of(axis).scale
    true, at = scale * est.reference.position[axis], est.reference.time
    scored = (at > recording.skip) & (at < seen.valid[-1]) & np.isin(at, est.time) & np.isfinite(true)
    true, at = true[scored], at[scored]
    here, at = np.searchsorted(est.time, at), at + 1e-9  # rounding makes no measurement of that instant a later one
    (sensor,) = recording.config.sensors.values()
    late = sensor.latency if mode == "as live" else 0.0
    made = Row(f"{recording.name}, {run.name.split(', ')[-1]}", axis, mode)
    if mode != "smoothed":
        made.errors["held"] = score(*held(seen, at, late), true)
    for name, method in found.items():
        made.errors[name] = score(*method(seen, at, late, mode == "smoothed"), true)
    made.errors["pumafuse"] = score(scale * est[axis].position[here], scale * est[axis].position_sd[here], true)
    return made


def verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """Geometric means of pumafuse's error over that of others, and where it loses."""
    name, others = METHODS[-1], METHODS[1:-1]
    for mode in MODES:
        mine = [row for row in rows if row.mode == mode]
        ratios = {
            other: math.exp(np.mean([math.log(row.errors[name][0] / row.errors[other][0]) for row in mine]))
            for other in others
        }
        yield f"{name}, {mode}: " + ", ".join(f"{ratio:.2f} of {other}" for other, ratio in ratios.items())
    lost = [
        f"{row.run}, {row.axis}, {row.mode} ({row.errors[name][0]:.3f}, {other} {row.errors[other][0]:.3f})"
        for row in rows
        for other in others
        if row.errors[other][0] < row.errors[name][0]
    ]
    yield f"it loses {len(lost)} of {len(rows) * len(others)} times: {'; '.join(lost) or 'nowhere'}"
    for other in (*others, name):
        holding = sum(0.90 <= row.errors[other][1] <= 0.98 for row in rows)
        yield f"coverage of {other} within 90 to 98 %: {holding} of {len(rows)} rows"


def readme(rows: Sequence[Row]) -> str:
    """The README's table: trunk-servo in few columns."""
    trunk = {(row.axis, row.mode): row.errors for row in rows if row.run == "trunk, 100 g"}
    lines = [
        [axis, *(cell(*trunk[axis, mode][name]) for name, mode in SHOWN.values())]
        for axis in dict.fromkeys(axis for axis, _ in trunk)
    ]
    return table(["axis", *SHOWN], lines, 1)


SHOWN = {
    "camera, held": ("held", "filtered"),
    "constant velocity": ("constant velocity", "filtered"),
    "and smoothed": ("constant velocity", "smoothed"),
    "pumafuse": ("pumafuse", "filtered"),
    "`--smooth`": ("pumafuse", "smoothed"),
}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--servo", type=Path, metavar="DIR", help="recordings of a real servo, not in this repository")
    parser.add_argument("--write", action="store_true", help="put it into README.md and docs/comparison.md")
    given = parser.parse_args()
    if given.write and given.servo is None:
        parser.error("the pages have the servo, too: --servo DIR")
    warnings.simplefilter("ignore", pf.PumafuseWarning)  # what is odd in the runs, and what fits cannot tell
    rows = [row for recording in recordings(given.servo) for row in measure(recording)]
    lines = [[row.run, row.axis, row.mode, *row.cells(METHODS)] for row in rows]
    listed = "\n".join(
        textwrap.fill(f"- {verdict}", 120, subsequent_indent="  ", break_on_hyphens=False) for verdict in verdicts(rows)
    )
    compared = f"{table(['recording', 'axis', 'mode', *METHODS], lines, 3)}\n\n{listed}"
    print(compared, readme(rows), sep="\n\n")
    if given.write:
        put(COMPARISON, "real.py", compared)
        put(REPOSITORY / "README.md", "real.py", readme(rows))


if __name__ == "__main__":
    main()

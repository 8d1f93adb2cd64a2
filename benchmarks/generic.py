"""What the commands are worth: position errors of pumafuse and of filters that know nothing of them, in mm.

    python benchmarks/generic.py [--only TEXT] [--servo DIR] [--json FILE]

All filters see the same measurements, are tuned by maximum likelihood on the same run and are scored by one function at
the same instants, those of the commands; an estimate knows every measurement that is valid by then.

The columns: measurements held (the best sensor's); constant velocity; constant acceleration; the best that those two
can do if the reference tunes them (``oracle``); pumafuse with more and more of its numbers fitted, and in brackets the
error over that of the better generic filter, and over the oracle's.
"""

from __future__ import annotations

import argparse
import json
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
from kinematic import ORDERS, Array, axes_of
from page import REPOSITORY

import pumafuse as pf

Row = dict[str, Any]

DATA = Path(pf.__file__).parent / "data"
SCENARIOS = ("panel-vision", "panel-tracker-outage", "mismatched-arm", "fast-arm", "wrong-latency")
SEED = 1
LEARNT = 40.0  # s of the scan, where its end is kept back
FITS = {"noise": ["noise"], "delay, plant": ["noise", "delay", "plant"], "gain": ["noise", "delay", "plant", "gain"]}
HEAD = ["", "axis", "held", *(f"constant {kind}" for kind in ORDERS), "oracle", *(f"pumafuse, {fit}" for fit in FITS)]

change = msgspec.structs.replace


@dataclass(frozen=True)
class Case:
    """What is learnt from, and what is scored with that.

    Attributes:
        learnt: What every filter is tuned on.
        config: What is known before.
        scored: Names, runs, and from when on [s].
        axes: Which to tell of; all for None.
        also: What pumafuse is to fit besides.
    """

    learnt: pf.Run
    config: pf.FusionConfig
    scored: Sequence[tuple[str, pf.Run, float]]
    axes: Sequence[str] | None = None
    also: Sequence[Any] = ()


def with_sensors(config: pf.FusionConfig, names: Sequence[str]) -> pf.FusionConfig:
    """The configuration with these sensors, and their own gates."""
    return change(config, sensors={name: sensor for name, sensor in config.sensors.items() if name in names})


def beginning(run: pf.Run, config: pf.FusionConfig, until: float) -> pf.Run:
    """What is commanded, and what measurements are valid, up to that long after the first command [s]."""
    end = int(run.command.stamp.min()) + round(until * 1e9)
    sensors = {name: run.sensors[name] for name in config.sensors}
    latest = {name: end + round(config.sensors[name].latency * 1e9) for name in sensors}
    kept = {name: source.rows(source.stamp <= latest[name]) for name, source in sensors.items()}
    return replace(run, command=run.command.rows(run.command.stamp <= end), sensors=kept)


def cases(servo: Path | None) -> Iterator[Case]:
    """All of them, each made when its turn comes."""
    scan, config = pf.Run.read(DATA / "scan1"), pf.FusionConfig.load(DATA / "fusion.toml")
    for kept_back in (False, True):
        for sensors in ("vision", "tracker", "tracker + vision", "vision + range", "tracker + vision + range"):
            chosen = with_sensors(config, sensors.split(" + "))
            axes = ["radial"] if "range" in sensors else None  # the others are as without it
            if kept_back:
                learnt = beginning(scan, chosen, LEARNT)
                yield Case(learnt, chosen, [(f"scan, kept back: {sensors}", scan, LEARNT)], axes)
            else:
                yield Case(scan, chosen, [(f"scan: {sensors}", scan, 0.0)], axes)
    for name in SCENARIOS:
        simulated = pf.simulate(pf.Scenario.load(REPOSITORY / "scenarios" / f"{name}.toml"), SEED)
        run, every = simulated.run, list(simulated.config.sensors)
        for sensors in (every, ["vision"]) if len(every) > 1 else (every,):
            chosen, title = with_sensors(simulated.config, sensors), f"{name}: {' + '.join(sensors)}"
            yield Case(run, chosen, [(title, run, 0.0)])
            if name == "wrong-latency":
                yield Case(run, chosen, [(f"{title}, its latency fitted too", run, 0.0)], also=["latency"])
    if servo is not None:
        runs = {name: pf.Run.read(servo / name) for name in ("sin_time_square", "sin_sin")}
        tip = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.030))
        arm = pf.ArmModel(name="servo", update_period=0.020, delay=0.020, axes={"tip": tip})
        config = pf.FusionConfig(arm=arm, sensors={"encoder": pf.Sensor(sd=1e-4)})
        scored = [(f"servo, {name}: encoder", run, 0.0) for name, run in runs.items()]
        yield Case(runs["sin_time_square"], with_sensors(config, ["encoder"]), scored)


def error(est: pf.Estimates, axis: str, since: float, position: Array) -> float:
    """RMSE on the reference from ``since`` [s] on [mm]."""
    late, sd = est.time >= since, est[axis].position_sd  # the RMSE has no use for it
    assert est.reference is not None
    scored = pf.score(est.time[late], est.segment[late], position[late], sd[late], est.reference, axis)
    return math.nan if scored is None else 1e3 * scored.rmse


def measure(case: Case) -> Iterator[Row]:
    """A row for each axis of what is scored."""
    tuned = {name: pf.tune([case.learnt], case.config, fit=[*fit, *case.also]).config for name, fit in FITS.items()}
    numbers: dict[str, dict[str, list[Array]]] = {}
    for name, axis in axes_of(case.learnt, case.config).items():
        if case.axes is None or name in case.axes:
            likeliest = {kind: axis.likeliest(order) for kind, order in ORDERS.items()}
            numbers[name] = {kind: [best, axis.closest(ORDERS[kind], best)] for kind, best in likeliest.items()}
    for name, run, since in case.scored:
        estimates = {fit: pf.fuse(run, config) for fit, config in tuned.items()}
        est, measured = estimates["noise"], axes_of(run, case.config)
        for axis, found in numbers.items():
            here = measured[axis]
            generic = {
                kind: [error(est, axis, since, here.position(order, one)) for one in found[kind]]
                for kind, order in ORDERS.items()
            }
            row: Row = {"set": name, "axis": axis}
            row["held"] = min(error(est, axis, since, position) for position in here.held())
            row |= {kind: errors[0] for kind, errors in generic.items()}
            row["oracle"] = min(min(errors) for errors in generic.values())
            row |= {fit: error(ours, axis, since, ours[axis].position) for fit, ours in estimates.items()}
            best = min(row[kind] for kind in ORDERS)
            yield row | {f"{fit}, ratios": [row[fit] / best, row[fit] / row["oracle"]] for fit in FITS}


def cells(row: Row) -> list[str]:
    """A row of the table."""
    theirs = [f"{row[key]:.4f}" for key in ("held", *ORDERS, "oracle")]
    ratios = {fit: ", ".join(f"{ratio:.2f}" for ratio in row[f"{fit}, ratios"]) for fit in FITS}
    return [row["set"], row["axis"], *theirs, *(f"{row[fit]:.4f} ({ratios[fit]})" for fit in FITS)]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="what has this in its name")
    parser.add_argument("--servo", type=Path, metavar="DIR", help="recordings of a real servo, not in this repository")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all numbers there")
    given = parser.parse_args()
    warnings.simplefilter("ignore", pf.PumafuseWarning)  # what is odd in the runs, and what fits cannot tell
    rows: list[Row] = []
    for line in (HEAD, ["---", "---", *["---:"] * (len(HEAD) - 2)]):
        print(f"| {' | '.join(line)} |")
    for case in cases(given.servo):
        if any(given.only in name for name, _, _ in case.scored):
            for row in measure(case):
                rows.append(row)
                print(f"| {' | '.join(cells(row))} |", flush=True)
    above = [
        f"{row['set']}, {row['axis']}, {fit} ({', '.join(f'{ratio:.3f}' for ratio in row[f'{fit}, ratios'])})"
        for row, fit in product(rows, FITS)
        if max(row[f"{fit}, ratios"]) > 1.0
    ]
    print(f"\nA ratio above 1: {'; '.join(above) or 'none'}.")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Recorded runs as streams of events, fed to a live estimator in any order and compared with the offline result."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

import pumafuse as pf
from pumafuse.arrays import NO_STAMP

FIELDS = ("position", "position_sd", "velocity", "velocity_sd", "offset", "offset_sd")


class Event(NamedTuple):
    """A command (no sensor) or a reading: stamp in int ns, values in m."""

    stamp: int
    sensor: str
    values: dict[str, float]


def events_of(run: pf.Run) -> list[Event]:
    """All rows of a run in the order of their stamps, readings before commands of the same instant."""
    found = []
    for sensor, source in [("", run.command), *run.sensors.items()]:
        columns = {axis: value.tolist() for axis, value in source.values.items()}
        for row, stamp in enumerate(source.stamp.tolist()):
            if stamp != NO_STAMP:
                values = {axis: column[row] for axis, column in columns.items() if column[row] == column[row]}
                found.append(Event(stamp, sensor, values)) if values else None
    return sorted(found, key=lambda event: (event.stamp, event.sensor == ""))


def delayed(events: Sequence[Event], longest: float, seed: int, *, twice: float = 0.0) -> list[Event]:
    """The events as they arrive, each up to ``longest`` s late; a share of them comes ``twice``."""
    rng = np.random.default_rng(seed)
    again = [event for event, share in zip(events, rng.random(len(events)), strict=True) if share < twice]
    pool = [*events, *again]
    late = rng.uniform(0.0, longest * 1e9, len(pool))
    order = np.argsort([event.stamp + delay for event, delay in zip(pool, late, strict=True)], kind="stable")
    return [pool[place] for place in order]


def feed(live: pf.LiveEstimator, event: Event) -> pf.Told:
    if event.sensor:
        return live.reading(event.stamp, event.sensor, **event.values)
    return live.command(event.stamp, **event.values)


def differences(
    live: pf.LiveEstimator, arrivals: Iterable[Event], offline: pf.Estimates, settled_after: float
) -> list[str]:
    """Feed all events, ask for every offline estimate once ``settled_after`` [s] has gone by, and list what differs."""
    found: list[str] = []
    origin = offline.origin
    stamps = [origin + round(time * 1e9) for time in offline.time.tolist()]
    asked = 0

    def ask() -> None:
        estimate = live.estimate(stamps[asked])
        if estimate.outcome is not pf.Outcome.FUSED:
            found.append(f"{offline.time[asked]}: {estimate.outcome.word}, {estimate.reason}")
            return
        for axis, theirs in offline.axes.items():
            for field in FIELDS:
                expected, got = getattr(theirs, field)[asked], getattr(estimate[axis], field)
                if expected != got:
                    found.append(f"{offline.time[asked]:.6f} {axis} {field}: {got - expected:+.2e}")
        for name, values in (offline.cartesian or {}).items():
            if estimate.cartesian is None or estimate.cartesian[name] != values[asked]:
                found.append(f"{offline.time[asked]:.6f} {name}")

    for event in arrivals:
        feed(live, event)
        while asked < len(stamps) and live.newest is not None and live.newest >= stamps[asked] + settled_after * 1e9:
            ask()
            asked += 1
    while asked < len(stamps):
        ask()
        asked += 1
    return found


def outcomes_of(offline: pf.Estimates) -> dict[str, dict[str, int]]:
    """How many scalars of each sensor had which outcome."""
    readings = offline.readings
    return {
        sensor: {
            outcome.word: int(np.sum((readings.sensor == number) & (readings.outcome == outcome)))
            for outcome in pf.Outcome
        }
        for number, sensor in enumerate(readings.sensors)
    }

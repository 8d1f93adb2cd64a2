"""The compiled filter over a whole recorded run: as read, with outcomes that are known, or as a live user had it."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math

from ..arrays import BoolArray, IntArray, TimeArray
from ..compiled import compiled
from .kernels import (
    Axes,
    Held,
    Log,
    Met,
    Outputs,
    Rows,
    Sensors,
    State,
    advance,
    estimate,
    fuse,
    go_back,
    keep,
    meet,
    predicted,
)
from .outcome import Outcome

_FUSED, _REACQUIRED = int(Outcome.FUSED), int(Outcome.REACQUIRED)


@compiled
def filter_run(
    axes: Axes,
    sensors: Sensors,
    rows: Rows,
    state: State,
    times: TimeArray,
    met: Met,
    log: Log,
    held: Held,
    outputs: Outputs,
) -> None:
    """Every row at its valid time, whenever it arrived, and an estimate at each of ``times`` (ascending)."""
    at = 0
    for row in range(len(rows.valid)):
        while at < len(times) and times[at] < rows.valid[row]:
            estimate(axes, state, log, times[at], held, outputs, at)
            at += 1
        meet(axes, sensors, rows, state, met, log, row)
    while at < len(times):
        estimate(axes, state, log, times[at], held, outputs, at)
        at += 1


@compiled
def replay(axes: Axes, sensors: Sensors, rows: Rows, state: State, met: Met, log: Log) -> None:
    """Every row at its valid time with the outcomes that ``met`` brings, whatever a gate would say now."""
    for row in range(len(rows.valid)):
        sensor = rows.sensor[row]
        for component in range(rows.first[row], rows.end[row]):
            advance(axes, state, log, rows.axis[component], rows.valid[row])
            nu, S = predicted(axes, sensors, rows, state, component, sensor)
            met.innovation[component], met.innovation_sd[component] = nu, math.sqrt(S)
            if met.outcome[component] == _FUSED:
                fuse(axes, sensors, rows, state, met, log, row, component, math.inf)
            elif met.outcome[component] == _REACQUIRED:
                fuse(axes, sensors, rows, state, met, log, row, component, 0.0)


@compiled
def filter_as_live(
    axes: Axes,
    sensors: Sensors,
    rows: Rows,
    arrival: TimeArray,
    queue: IntArray,
    arrived: BoolArray,
    state: State,
    kept: State,
    times: TimeArray,
    met: Met,
    log: Log,
    held: Held,
    outputs: Outputs,
) -> None:
    """At each of ``times`` only the rows that had arrived: late ones make the filter go back and replay.

    ``queue`` lists the rows by ``arrival``, ``arrived`` is all false; ``kept`` has two places more than rows may have
    to be taken back.
    """
    due, done, reach = 0, 0, 0  # rows before `done` are dealt with: fused, or not here yet
    places = len(kept.clock)
    for n in range(len(times) + 1):
        earliest = done
        while due < len(queue) and (n == len(times) or arrival[queue[due]] <= times[n]):
            row = queue[due]
            arrived[row] = True
            earliest, reach = min(earliest, row), max(reach, row + 1)
            due += 1
        if earliest < done:
            go_back(state, kept, earliest % places)
        for row in range(earliest, reach):
            keep(state, kept, row % places)
            if arrived[row]:
                meet(axes, sensors, rows, state, met, log, row)
        done = reach
        if n < len(times):
            keep(state, kept, done % places)  # the state goes on with estimates, rows still to come may be before that
            estimate(axes, state, log, times[n], held, outputs, n)
            go_back(state, kept, done % places)

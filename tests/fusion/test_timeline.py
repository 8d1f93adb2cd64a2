"""The total order of events, what becomes of each measurement before any filter, and which rows command the arm."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.arrays import NO_STAMP
from pumafuse.errors import RunError, UnknownNameError
from pumafuse.fusion.config import FusionConfig, Sensor
from pumafuse.fusion.outcome import Outcome
from pumafuse.fusion.timeline import Timeline, build, output_times
from pumafuse.logs.run import Clock, Run
from pumafuse.model.arm import ArmModel, AxisModel
from pumafuse.model.plants import FirstOrder

MS = 1_000_000
SECOND = 1000 * MS
PERIOD = 0.028
TICK = 28 * MS
DELAY = 60_450_000
ORIGIN = 1_700_000_000_123_456_789

# A gain of 1: the drive is the commands themselves, relative to the start level.
ARM = ArmModel(
    name="two axes",
    update_period=PERIOD,
    delay=DELAY * 1e-9,
    axes={
        "radial": AxisModel(plant=FirstOrder(time_constant=0.04)),
        "vertical": AxisModel(plant=FirstOrder(time_constant=0.04), delay=0.01),
    },
)

properties = settings(derandomize=True, deadline=None, max_examples=100)

Rows = tuple[Sequence[int], Mapping[str, Sequence[float]]]  # stamps and values by axis


def config(**sensors: Sensor) -> FusionConfig:
    return FusionConfig(arm=ARM, sensors=sensors)


def recorded(sensors: Mapping[str, Rows] | None = None, axes: Sequence[str] = ("radial",), **more: Any) -> Run:
    """Two commands, the first at ``ORIGIN``, and the measurements of the sensors."""
    return Run.from_arrays([ORIGIN, ORIGIN + TICK], {axis: [0.5, 0.51] for axis in axes}, sensors, **more)


def measurements(*rows: tuple[float, float]) -> Rows:
    """Radial measurements by (ms after the first command, value)."""
    stamps = [ORIGIN + round(time * MS) if math.isfinite(time) else NO_STAMP for time, _ in rows]
    return stamps, {"radial": [value for _, value in rows]}


def outcomes(timeline: Timeline) -> list[str]:
    """Of one sensor on one axis, by their stamps."""
    return [Outcome(code).word for code in timeline.components.outcome]


def commanded(
    stamp: Sequence[int], value: Sequence[float], clock: Clock = "stamps", start: Mapping[str, float] | None = None
) -> list[tuple[int, float]]:
    """The commands that act on the radial axis, (stamp, u)."""
    run = Run.from_arrays(np.array(stamp, dtype=np.int64), {"radial": value}, clock=clock, start=start)
    timeline = build(run, config())
    (axis,) = timeline.axes
    assert axis.given.tolist() == axis.drive.time.tolist() == timeline.commands.tolist()
    return list(zip(axis.given.tolist(), (axis.drive.value + axis.start).round(12).tolist(), strict=True))


def one_note(timeline: Timeline, word: str) -> str:
    (note,) = [note for note in timeline.notes if word in note]
    return note


# ---- the order of measurements


@st.composite
def crowded_runs(draw: st.DrawFn) -> tuple[Run, FusionConfig]:
    """Runs whose measurements collide in valid time, with every defect a row may have."""
    latency = st.sampled_from([0.0, 0.002, 0.003, -0.001])
    sd = st.sampled_from([1e-4, {"radial": 1e-4}, {"vertical": 1e-4}])
    names = draw(st.permutations(["b", "a", "c"]))
    sensors = {name: Sensor(sd=draw(sd), latency=draw(latency)) for name in names}
    value = st.sampled_from([0.0, 1.0, 2.0, np.nan, np.inf])
    stamp = st.one_of(
        st.integers(-2, 8).map(lambda ms: ORIGIN + ms * MS), st.sampled_from([NO_STAMP, ORIGIN + 2 * SECOND])
    )
    streams = {}
    for name in draw(st.permutations([*names, "stranger"])):
        axes = draw(st.sampled_from([("radial",), ("vertical", "radial")]))
        rows = draw(st.lists(st.tuples(stamp, *[value] * len(axes)), min_size=1, max_size=10))
        streams[name] = ([row[0] for row in rows], {axis: [row[k + 1] for row in rows] for k, axis in enumerate(axes)})
    return recorded(streams, ("radial", "vertical")), config(**sensors)


def order_by_hand(run: Run, config: FusionConfig) -> list[tuple[Any, ...]]:
    """(valid, sensor, stamp, row, axis) of every component, sorted as the contract says."""
    names = [*config.sensors, *(name for name in run.sensors if name not in config.sensors)]
    found: list[tuple[Any, ...]] = []
    for index, name in enumerate(names):
        latency = round(config.sensors[name].latency * 1e9) if name in config.sensors else 0
        source = run.sensors[name]
        for row, stamp in enumerate(source.stamp.tolist()):
            valid = NO_STAMP if stamp == NO_STAMP else stamp - latency
            found += [
                (valid, index, stamp, row, number) for number, axis in enumerate(run.axes) if axis in source.values
            ]
    return sorted(found)


@properties
@given(crowded_runs())
def test_measurements_come_in_the_total_order(case: tuple[Run, FusionConfig]) -> None:
    """By valid time (stamp − latency), then sensors as in fusion.toml, stamp, place in the file; rows hold together."""
    run, conf = case
    components = build(run, conf).components
    wanted = order_by_hand(run, conf)
    got = list(zip(components.valid, components.sensor, components.stamp, components.axis, strict=True))
    assert got == [(valid, sensor, stamp, axis) for valid, sensor, stamp, _, axis in wanted]
    rows = [(sensor, row) for _, sensor, _, row, _ in wanted]
    changes = [one != other for one, other in pairwise(rows)]
    assert components.row.tolist() == [0, *np.cumsum(changes).tolist()]
    values = [run.sensors[components.sensors[s]].values[run.axes[a]][row] for _, s, _, row, a in wanted]
    np.testing.assert_array_equal(components.value, values)


def reasons(run: Run, conf: FusionConfig, name: str, row: int, axis: str) -> set[str]:
    """Every reason the contract gives not to fuse one component, found by looking at the rows before it."""
    source, sensor = run.sensors[name], conf.sensors.get(name)
    found: set[str] = set()
    if sensor is None or sensor.sd_of(axis) is None:
        found.add("unknown")
    rows = [(stamp, *map(str, values)) for stamp, *values in zip(source.stamp, *source.values.values(), strict=True)]
    stamp = int(source.stamp[row])
    if stamp == NO_STAMP or not math.isfinite(source.values[axis][row]):
        found.add("invalid")
    if rows[row] in rows[:row]:
        found.add("duplicate")
    if stamp != NO_STAMP:
        if max(source.stamp[: row + 1].tolist()) - stamp > SECOND:
            found.add("too_late")
        if stamp - (0 if sensor is None else round(sensor.latency * 1e9)) < ORIGIN:
            found.add("before_start")
    return found


@properties
@given(crowded_runs())
def test_a_measurement_is_left_out_only_for_a_reason_it_has(case: tuple[Run, FusionConfig]) -> None:
    """What goes to the filter has no defect; every other component gets the name of one that it has."""
    run, conf = case
    timeline = build(run, conf)
    for (_, sensor, _, row, axis), code in zip(order_by_hand(run, conf), timeline.components.outcome, strict=True):
        wanted = reasons(run, conf, timeline.components.sensors[sensor], row, run.axes[axis]) or {"fused"}
        assert Outcome(code).word in wanted
    fused = np.flatnonzero(timeline.components.outcome == Outcome.FUSED)
    assert timeline.components.candidates.tolist() == fused.tolist()


def test_the_order_of_the_configuration_decides_ties() -> None:
    """Valid at one instant, sensors come as in fusion.toml, not by stamp, name or place in the run."""
    run = recorded({"a": measurements((5, 1.0)), "b": measurements((15, 2.0)), "c": measurements((10, 3.0))})
    sensors = {
        "b": Sensor(sd=1e-4, latency=0.015),
        "c": Sensor(sd=1e-4, latency=0.01),
        "a": Sensor(sd=1e-4, latency=0.005),
    }
    timeline = build(run, config(**sensors))
    assert timeline.components.valid.tolist() == [ORIGIN] * 3
    assert timeline.components.value.tolist() == [2.0, 3.0, 1.0]
    assert timeline.components.sensors == ("b", "c", "a")


@pytest.mark.parametrize(
    ("latency", "ns"), [(0.001_234_567, 1_234_567), (3600.0, 3600 * SECOND), (-3600, -3600 * SECOND)]
)
def test_valid_times_are_exact_today(latency: float, ns: int) -> None:
    """Stamps of 2023 in ns keep their last digit when the latency, up to an hour, is taken off."""
    timeline = build(recorded({"a": measurements((5, 1.0))}), config(a=Sensor(sd=1e-4, latency=latency)))
    assert timeline.components.valid.tolist() == [ORIGIN + 5 * MS - ns]
    assert timeline.components.stamp.tolist() == [ORIGIN + 5 * MS]


@pytest.mark.parametrize("chosen", [["a"], ["b", "a"], []])
def test_only_chosen_sensors_are_on_the_timeline(chosen: list[str]) -> None:
    """Sensors that are not chosen, configured or not, leave no component and no note."""
    run = recorded({name: measurements((5, 1.0)) for name in ("stranger", "b", "a")})
    timeline = build(run, config(a=Sensor(sd=1e-4), b=Sensor(sd=1e-4), silent=Sensor(sd=1e-4)), chosen)
    assert timeline.components.sensors == tuple(sorted(chosen))
    assert len(timeline.components.value) == len(chosen)
    assert timeline.notes == ()


def test_a_sensor_that_is_not_configured_cannot_be_chosen() -> None:
    """Choosing what fusion.toml has not is refused, even if the run has it."""
    run = recorded({"stranger": measurements((5, 1.0))})
    with pytest.raises(UnknownNameError, match="stranger"):
        build(run, config(a=Sensor(sd=1e-4)), ["stranger"])


def test_an_axis_that_the_arm_has_not_is_refused() -> None:
    """A run that commands an axis without a model is refused with the arm's axes."""
    with pytest.raises(UnknownNameError) as caught:
        build(recorded(axes=["yaw"]), config())
    assert (caught.value.name, caught.value.accepted) == ("yaw", ("radial", "vertical"))


# ---- outcomes


A = Sensor(sd=1e-4, latency=0.005)
nan = math.nan

OUTCOMES: dict[str, tuple[Rows, list[str], tuple[str, ...]]] = {
    # rows as (ms, value), their outcomes in order of valid time, what the one note of this outcome must say
    "duplicate": (
        measurements((10, 1.0), (11, 2.0), (10, 1.0), (10, 3.0), (11, 2.0)),
        ["fused", "duplicate", "fused", "fused", "duplicate"],
        ("2 rows", "row 3"),
    ),
    "before_start": (
        measurements((-3, 1.0), (4.999999, 1.0), (5, 1.0)),
        ["before_start", "before_start", "fused"],
        ("2 rows", "row 1"),
    ),
    "too_late": (
        measurements((3000, 1.0), (1999, 2.0), (2000, 3.0), (1000, 4.0)),
        ["too_late", "too_late", "fused", "fused"],
        ("2 rows", "row 2"),
    ),
    "invalid": (
        measurements((10, 1.0), (11, nan), (12, math.inf), (13, -math.inf)),
        ["fused", "invalid", "invalid", "invalid"],
        ("3 rows", "row 2", "no finite radial value"),
    ),
    "no stamp": (
        measurements((10, 1.0), (nan, 1.0), (nan, nan)),
        ["invalid", "invalid", "fused"],
        ("2 rows", "row 2", "invalid"),
    ),
}


@pytest.mark.parametrize("outcome", OUTCOMES)
def test_each_outcome_is_counted_and_told_once(outcome: str) -> None:
    """A defect is one note for its sensor: how many rows have it, and where the first is."""
    rows, wanted, words = OUTCOMES[outcome]
    timeline = build(recorded({"a": rows}), config(a=A))
    assert outcomes(timeline) == wanted
    note = one_note(timeline, outcome)
    assert note.startswith("a: ")
    for word in words:
        assert word in note


def test_a_clean_run_has_no_notes() -> None:
    """Measurements without a defect are all the filter's, and nothing is said."""
    timeline = build(recorded({"a": measurements((5, 1.0), (6, 1.0), (7, 2.0))}), config(a=A))
    assert outcomes(timeline) == ["fused"] * 3
    assert timeline.notes == ()


def test_stamps_that_step_back_a_little_are_sorted_and_told() -> None:
    """Up to 1 s out of order is sorted, counted and fused."""
    rows = measurements((1500, 1.0), (500, 2.0), (1600, 3.0), (1599, 4.0))
    timeline = build(recorded({"a": rows}), config(a=A))
    assert timeline.components.value.tolist() == [2.0, 1.0, 4.0, 3.0]
    assert outcomes(timeline) == ["fused"] * 4
    note = one_note(timeline, "steps back")
    assert "2 rows" in note
    assert "row 2" in note


def test_a_sensor_that_is_not_configured_is_unknown() -> None:
    """Its rows are kept, named and left out, after those of the configured sensors at the same instant."""
    run = recorded({"stranger": measurements((5, 1.0), (6, nan)), "a": measurements((10, 3.0))})
    timeline = build(run, config(a=A))
    assert timeline.components.sensors == ("a", "stranger")
    assert timeline.components.value[:2].tolist() == [3.0, 1.0]
    assert outcomes(timeline) == ["fused", "unknown", "unknown"]
    note = one_note(timeline, "unknown")
    for word in ("stranger", "2 rows", "row 1"):
        assert word in note


def test_an_axis_without_noise_is_unknown_to_its_sensor() -> None:
    """A sensor with noise for one axis is fused on that axis alone, though it logs another."""
    rows = [ORIGIN + 10 * MS, ORIGIN + 11 * MS], {"radial": [1.0, 2.0], "vertical": [3.0, 4.0]}
    timeline = build(recorded({"a": rows}, ("radial", "vertical")), config(a=Sensor(sd={"vertical": 1e-4})))
    assert timeline.components.axis.tolist() == [0, 1, 0, 1]
    assert outcomes(timeline) == ["unknown", "fused", "unknown", "fused"]
    (note,) = timeline.notes
    for word in ("a: ", "sd_mm", "radial", "unknown"):
        assert word in note
    assert "vertical" not in note


def test_rows_are_told_once_and_values_once_for_each_axis() -> None:
    """What is wrong with a whole row is one note whatever its axes say; what is wrong with values is one an axis."""
    stamp = [ORIGIN + 10 * MS, NO_STAMP, ORIGIN - SECOND, ORIGIN + 10 * MS, ORIGIN + 11 * MS, ORIGIN + 12 * MS]
    columns = {"vertical": [3.0, nan, nan, 3.0, nan, math.inf], "radial": [1.0, nan, nan, 1.0, nan, 2.0]}
    run = recorded({"stranger": (stamp, columns), "a": (stamp, columns)}, ("radial", "vertical"))
    told = [
        "stranger: 1 row has a stamp that steps back",
        "stranger: 6 rows have no sensor of this name in the configuration: unknown (first: row 1)",
        "a: 1 row has a stamp that steps back",
        "a: 1 row has no stamp: invalid (first: row 2)",
        "a: 1 row has the stamp and values of an earlier row: duplicate (first: row 4)",
        "a: 1 row has a stamp more than 1 s behind an earlier one: too_late (first: row 3)",
        "a: 1 row has no finite radial value: invalid (first: row 5)",
        "a: 2 rows have no finite vertical value: invalid (first: row 5)",
    ]
    notes = build(run, config(a=Sensor(sd=1e-4))).notes
    assert len(notes) == len(told)
    for sentence in told:
        assert sum(note.startswith(sentence) for note in notes) == 1, sentence


def test_an_empty_axis_of_a_row_leaves_the_others_to_the_filter() -> None:
    """A row that lacks one axis is invalid on that axis alone."""
    rows = [ORIGIN + 10 * MS], {"radial": [nan], "vertical": [3.0]}
    timeline = build(recorded({"a": rows}, ("radial", "vertical")), config(a=A))
    assert outcomes(timeline) == ["invalid", "fused"]


def test_a_configured_sensor_without_measurements_is_told() -> None:
    """A sensor of fusion.toml that the run has not is a note, not an error."""
    timeline = build(recorded(), config(a=A))
    assert "'a'" in one_note(timeline, "no measurements")
    assert len(timeline.components.value) == 0


def test_notes_of_the_files_come_with_the_run() -> None:
    """What was wrong with the files is among the timeline's notes."""
    assert build(replace(recorded(), notes=("torn line",)), config()).notes == ("torn line",)


# ---- commands


def test_an_axis_is_driven_by_its_own_commands_delay_and_start() -> None:
    """Each axis has its commands, its delay (or the arm's) and its start level, the first command by default."""
    stamp = [ORIGIN, ORIGIN + TICK, ORIGIN + 2 * TICK]
    values = {"vertical": [nan, 0.2, 0.3], "radial": [0.5, nan, 0.7]}
    timeline = build(Run.from_arrays(stamp, values, start={"radial": 0.4}), config())
    radial, vertical = timeline.axes
    assert (radial.name, vertical.name) == ("radial", "vertical")
    assert (radial.start, vertical.start) == (0.4, 0.2)
    assert (radial.delay, vertical.delay) == (DELAY, 10 * MS)
    assert radial.given.tolist() == [stamp[0], stamp[2]]
    assert vertical.given.tolist() == stamp[1:]
    np.testing.assert_allclose(radial.drive.value, [0.1, 0.3], rtol=1e-15)
    np.testing.assert_allclose(vertical.drive.value, [0.0, 0.1], rtol=1e-15, atol=1e-16)
    assert radial.acting.tolist() == [stamp[0] + DELAY, stamp[2] + DELAY]
    assert timeline.commands.tolist() == stamp
    assert timeline.origin == ORIGIN


@pytest.mark.parametrize("clock", ["stamps", "regular"])
@pytest.mark.parametrize("filled", [True, False])
def test_a_column_at_the_rate_of_the_log_is_one_command_per_change(clock: Clock, filled: bool) -> None:
    """At 1 kHz rows repeat the command in force or are empty: only those where it changes command the arm."""
    row = np.arange(2000)
    value = np.where(filled | (row % 28 == 0), 0.5 + np.floor(row / 28) * 1e-3, nan)
    wanted = [(ORIGIN + tick * TICK, round(0.5 + tick * 1e-3, 12)) for tick in range(2000 // 28 + 1)]
    assert commanded((ORIGIN + row * MS).tolist(), value.tolist(), clock) == wanted


@pytest.mark.parametrize(("apart", "count"), [(14 * MS - 1, 1), (14 * MS, 2), (28 * MS, 2)])
def test_a_repetition_within_half_a_period_is_no_command(apart: int, count: int) -> None:
    """The same value again is a command from half a period on; a hold sends it again every period."""
    assert len(commanded([ORIGIN, ORIGIN + apart], [0.5, 0.5])) == count


def test_of_rows_with_one_stamp_the_last_counts() -> None:
    """Said twice at one instant, the later row of the file is the command; an empty one takes nothing back."""
    stamp = [ORIGIN, ORIGIN, ORIGIN + TICK, ORIGIN + TICK, ORIGIN + TICK]
    assert commanded(stamp, [0.1, 0.2, 0.3, 0.4, nan]) == [(ORIGIN, 0.2), (ORIGIN + TICK, 0.4)]


def commands_by_hand(rows: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """Row by row: the last value of each stamp, without those that repeat the one before within half a period."""
    last = {stamp: value for stamp, value in sorted(rows, key=lambda row: row[0]) if math.isfinite(value)}
    kept: list[tuple[int, float]] = []
    before: tuple[int, float] | None = None
    for row in last.items():
        if before is None or row[1] != before[1] or 2 * (row[0] - before[0]) >= TICK:
            kept.append(row)
        before = row
    return kept


@properties
@given(
    st.lists(
        st.tuples(
            st.integers(0, 30).map(lambda step: ORIGIN + step * 7 * MS), st.sampled_from([0.25, 0.5, nan, math.inf])
        ),
        min_size=1,
        max_size=20,
    ).filter(commands_by_hand)
)
def test_commands_are_those_of_a_walk_through_the_rows(rows: list[tuple[int, float]]) -> None:
    """Rows out of order, repeated, empty or at one stamp: what is left commands the arm, from the first on."""
    stamp, value = zip(*rows, strict=True)
    wanted = commands_by_hand(rows)
    assert commanded(stamp, value) == wanted
    run = Run.from_arrays(np.array(stamp), {"radial": value})
    assert build(run, config()).origin == wanted[0][0]


def test_defects_of_the_commands_are_told_once() -> None:
    """Rows without a stamp, without a value, twice or out of order are counted, with where the first is."""
    stamp = [
        ORIGIN,
        NO_STAMP,
        ORIGIN + 2 * TICK,
        ORIGIN + TICK,
        ORIGIN + 2 * TICK,
        ORIGIN + 3 * TICK,
        ORIGIN + 4 * TICK,
    ]
    timeline = build(Run.from_arrays(stamp, {"radial": [0.5, 0.6, 0.7, 0.6, 0.7, nan, math.inf]}), config())
    told = {"no stamp": ("1 row", "row 2"), "steps back": ("1 row", "row 4"), "duplicate": ("1 row", "row 5")}
    told["no finite radial command"] = ("2 rows", "row 6")
    for defect, words in told.items():
        note = one_note(timeline, defect)
        for word in ("command", *words):
            assert word in note
    assert len(timeline.notes) == len(told)
    assert timeline.axes[0].given.tolist() == [ORIGIN, ORIGIN + TICK, ORIGIN + 2 * TICK]


def test_commands_that_step_back_a_little_are_sorted() -> None:
    """The arm gets commands in the order of their stamps, not of the file."""
    wanted = [(ORIGIN, 0.1), (ORIGIN + TICK, 0.2), (ORIGIN + 2 * TICK, 0.3)]
    assert commanded([ORIGIN, ORIGIN + 2 * TICK, ORIGIN + TICK], [0.1, 0.3, 0.2]) == wanted


def test_a_regular_clock_puts_commands_on_even_ticks() -> None:
    """A regular clock takes the jitter off the commands, missing ones or not; otherwise the stamps are believed."""
    rng = np.random.default_rng(0)
    ticks = np.flatnonzero(rng.random(500) < 0.9)
    stamp = ORIGIN + ticks * TICK + rng.integers(-3 * MS, 3 * MS, len(ticks))
    value = 0.5 + 1e-3 * np.arange(len(ticks))
    believed = [time for time, _ in commanded(stamp.tolist(), value.tolist())]
    assert believed == stamp.tolist()
    grid = np.array([time for time, _ in commanded(stamp.tolist(), value.tolist(), clock="regular")])
    assert set(np.diff(grid) % TICK) == {0}
    assert (np.diff(grid) == np.diff(ticks) * TICK).all()
    assert abs(float(np.median(grid - stamp))) <= 1.0


def test_a_regular_clock_moves_the_origin_and_not_the_measurements() -> None:
    """Time 0 is the first tick of the grid, not the first stamp: what is valid between them is before the start."""
    stamp = ORIGIN + np.arange(101) * TICK
    stamp[0] -= 2 * MS
    run = Run.from_arrays(stamp, {"radial": np.arange(101.0)}, {"a": measurements((4, 1.0), (5, 2.0))}, clock="regular")
    timeline = build(run, config(a=A))
    assert timeline.origin == ORIGIN
    assert outcomes(timeline) == ["before_start", "fused"]


def test_a_drift_between_the_clocks_is_told() -> None:
    """The note of the grid on drift is among the timeline's."""
    stamp = ORIGIN + np.rint(np.arange(1000) * TICK * (1 + 50e-6)).astype(np.int64)
    run = Run.from_arrays(stamp, {"radial": np.arange(1000.0)}, clock="regular")
    assert "+50.0 ppm" in one_note(build(run, config()), "clock")


def test_a_regular_clock_with_another_period_is_refused() -> None:
    """Commands every 30 ms are no grid of 28 ms."""
    run = Run.from_arrays(np.arange(100) * 30 * MS, {"radial": np.arange(100.0)}, clock="regular")
    with pytest.raises(RunError, match="28 ms"):
        build(run, config())


def test_the_speed_is_the_fastest_step_of_any_axis() -> None:
    """Highest commanded speed: the largest step over the period, the one from the start level included."""
    stamp = [ORIGIN, ORIGIN + TICK, ORIGIN + 10 * TICK]
    values = {"radial": [0.5, 0.501, 0.501], "vertical": [0.1, 0.1, 0.098]}
    assert build(Run.from_arrays(stamp, values), config()).speed == pytest.approx(2e-3 / PERIOD, rel=1e-9)
    assert build(Run.from_arrays(stamp, values, start={"radial": 0.4}), config()).speed == pytest.approx(0.1 / PERIOD)


# ---- output times


def test_estimates_are_asked_for_at_each_command() -> None:
    """Without a rate there is one estimate for every instant at which any axis was commanded."""
    stamp = [ORIGIN, ORIGIN + TICK, ORIGIN + 2 * TICK]
    run = Run.from_arrays(stamp, {"radial": [0.5, nan, 0.6], "vertical": [0.5, 0.6, nan]})
    assert output_times(build(run, config()), None).tolist() == stamp


@pytest.mark.parametrize(
    ("rows", "end"),
    [
        ([(5, 1.0)], TICK),  # the last command
        ([(905, 1.0), (5, 1.0)], 900 * MS),  # the last measurement, when it was true
        ([(905, 1.0), (2000, nan)], 900 * MS),  # not one that is left out
    ],
)
def test_the_end_is_the_last_event_that_a_filter_meets(rows: list[tuple[float, float]], end: int) -> None:
    """The grid of estimates ends with the last command or the last measurement that can be fused."""
    timeline = build(recorded({"a": measurements(*rows)}), config(a=A))
    assert timeline.end == ORIGIN + end
    assert output_times(timeline, 1000.0)[-1] == ORIGIN + end


@properties
@given(st.integers(1, 2000), st.integers(0, 1000), st.integers(1, 10**5))
def test_an_even_grid_has_every_point_up_to_the_end(rate: int, last: int, more: int) -> None:
    """Estimates at k / rate from the first command on, as long as the run lasts, to the nearest ns."""
    timeline = replace(build(recorded(), config()), end=ORIGIN + math.ceil(Fraction(last * 10**9, rate)) + more)
    wanted = [ORIGIN + round(Fraction(k * 10**9, rate)) for k in range(last + 1)]
    got = output_times(timeline, float(rate))
    assert len(got) == len(wanted)
    assert np.abs(got - np.array(wanted)).max() <= 1


@pytest.mark.parametrize("rate", [10, 50, 100, 200, 250, 1000])
def test_a_run_that_ends_on_a_grid_point_has_that_point(rate: int) -> None:
    """0.29 s at 100 Hz are 30 points, and so for every whole number of points."""
    timeline = build(recorded(), config())
    for count in range(2001):
        end = ORIGIN + count * (SECOND // rate)
        got = output_times(replace(timeline, end=end), float(rate))
        assert (len(got), int(got[-1])) == (count + 1, end)

"""A run as events: their total order, what each measurement is before the filter, which rows command the arm."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.arrays import NO_STAMP
from pumafuse.errors import RunError
from pumafuse.filter.events import COMMAND
from pumafuse.filter.outcome import ABSENT, Outcome
from pumafuse.fusion.config import FusionConfig, Sensor
from pumafuse.fusion.segments import Segment, build_segment, output_times
from pumafuse.logs.run import Clock, Run
from pumafuse.model.arm import ArmModel, AxisModel
from pumafuse.model.plants import FirstOrder

MS = 1_000_000
SECOND = 1000 * MS
PERIOD = 0.028
TICK = 28 * MS
DELAY = 60_450_000
ORIGIN = 1_700_000_000_123_456_789
DELAYS = (10 * MS, DELAY)

ARM = ArmModel(
    name="two axes",
    update_period=PERIOD,
    delay=DELAY * 1e-9,
    axes={
        "radial": AxisModel(plant=FirstOrder(time_constant=0.04)),
        "vertical": AxisModel(plant=FirstOrder(time_constant=0.04), delay=0.01),
    },
)

properties = settings(max_examples=60)

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


def outcomes(segment: Segment) -> list[str]:
    """Of every value that is given, by sensor, stamp and axis."""
    return [Outcome(code).word for code in segment.measurement_rows.codes.ravel() if code != ABSENT]


def commanded(
    stamp: Sequence[int], value: Sequence[float], clock: Clock = "stamps", start: Mapping[str, float] | None = None
) -> list[tuple[int, float]]:
    """The commands that act on the radial axis, (stamp, u)."""
    run = Run.from_arrays(np.array(stamp, dtype=np.int64), {"radial": value}, clock=clock, start=start)
    segment = build_segment(run, config())
    times, values = segment.commands_of("radial")
    assert times.tolist() == segment.commands.tolist()
    return list(zip(times.tolist(), values.round(12).tolist(), strict=True))


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
        st.integers(-2, 8).map(lambda ms: ORIGIN + ms * MS),
        st.sampled_from([NO_STAMP, ORIGIN + SECOND, ORIGIN + 2 * SECOND]),
    )
    streams = {}
    for name in draw(st.permutations([*names, "stranger"])):
        axes = draw(st.sampled_from([("radial",), ("vertical", "radial")]))
        rows = draw(st.lists(st.tuples(stamp, *[value] * len(axes)), min_size=1, max_size=10))
        streams[name] = ([row[0] for row in rows], {axis: [row[k + 1] for row in rows] for k, axis in enumerate(axes)})
    return recorded(streams, ("radial", "vertical")), config(**sensors)


def order_by_hand(run: Run, config: FusionConfig) -> list[tuple[int, int, int, int]]:
    """(time, source, stamp, row) of every event, sorted as the contract says; of a command the row is its delay."""
    names = [*config.sensors, *(name for name in run.sensors if name not in config.sensors)]
    found = [(ORIGIN + k * TICK + delay, COMMAND, ORIGIN + k * TICK, delay) for k in (0, 1) for delay in DELAYS]
    for index, name in enumerate(names):
        latency = round(config.sensors[name].latency * 1e9) if name in config.sensors else 0
        for row, stamp in enumerate(run.sensors[name].stamp.tolist()):
            found.append((NO_STAMP if stamp == NO_STAMP else stamp - latency, index, stamp, row))
    return sorted(found)


@properties
@given(crowded_runs())
def test_events_come_in_the_total_order(case: tuple[Run, FusionConfig]) -> None:
    """By time, commands first, then sensors as in fusion.toml, stamp, place in the file."""
    run, conf = case
    segment = build_segment(run, conf)
    events, place = segment.events(conf)
    wanted = order_by_hand(run, conf)
    got = list(zip(events.time.tolist(), events.source.tolist(), events.stamp.tolist(), strict=True))
    assert got == [event[:3] for event in wanted]
    measured = np.flatnonzero(events.source != COMMAND)
    assert sorted(place.tolist()) == measured.tolist()
    assert len(place) == len(segment.measurement_rows.time)
    row_of = dict(zip(place.tolist(), range(len(place)), strict=True))
    for at, (_, source, _, row) in zip(
        measured.tolist(), [event for event in wanted if event[1] != COMMAND], strict=True
    ):
        logged = run.sensors[segment.sensors[source]].values
        values = [logged[axis][row] if axis in logged else np.nan for axis in run.axes]
        np.testing.assert_array_equal(events.value[at], values)
        np.testing.assert_array_equal(segment.measurement_rows.value[row_of[at]], values)
        np.testing.assert_array_equal(events.codes[at] != ABSENT, [axis in logged for axis in run.axes])


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
    segment = build_segment(run, conf)
    events, _ = segment.events(conf)
    for at, (_, source, _, row) in enumerate(order_by_hand(run, conf)):
        for number, axis in enumerate(run.axes):
            if source != COMMAND and events.codes[at, number] != ABSENT:
                wanted = reasons(run, conf, segment.sensors[source], row, axis) or {"fused"}
                assert Outcome(events.codes[at, number]).word in wanted


# ---- outcomes


A = Sensor(sd=1e-4, latency=0.005)
nan = math.nan


def test_every_defect_is_noted_once() -> None:
    """With its number and its first row: of rows whatever their axes say, of values for each axis."""
    stamp = [ORIGIN + 10 * MS, NO_STAMP, ORIGIN - SECOND, ORIGIN + 10 * MS, ORIGIN + 11 * MS, ORIGIN + 12 * MS]
    columns = {"vertical": [3.0, nan, nan, 3.0, nan, math.inf], "radial": [1.0, nan, nan, 1.0, nan, 2.0]}
    sensors = {"stranger": (stamp, columns), "a": (stamp, columns), "b": (stamp[:1], {"radial": [1.0]})}
    given = [ORIGIN, NO_STAMP, ORIGIN + 2 * TICK, ORIGIN + TICK, ORIGIN + 2 * TICK, ORIGIN + 3 * TICK]
    run = Run.from_arrays(given, {"radial": [0.5, 0.6, 0.7, 0.6, 0.7, nan], "vertical": [0.5] * 6}, sensors)
    wanted = [
        "torn line",
        "command: 1 row has no stamp: not used (first: row 2)",
        "command: 1 row has a stamp that steps back: sorted (first: row 4)",
        "command: 1 row has the stamp and values of an earlier row: duplicate (first: row 5)",
        "command: 1 row has no finite radial command: not used (first: row 6)",
        "sensor 'silent' of the configuration has no measurements in this run",
        "stranger: 1 row has a stamp that steps back",
        "stranger: 6 rows have no sensor of this name in the configuration: unknown (first: row 1)",
        "a: 1 row has a stamp that steps back",
        "a: 1 row has no stamp: invalid (first: row 2)",
        "a: 1 row has the stamp and values of an earlier row: duplicate (first: row 4)",
        "a: 1 row has a stamp more than 1 s behind an earlier one: too_late (first: row 3)",
        "a: 1 row has no finite radial value: invalid (first: row 5)",
        "a: 2 rows have no finite vertical value: invalid (first: row 5)",
        "b: sd_mm has no entry for radial, which is not used: unknown",
    ]
    known = {"a": Sensor(sd=1e-4), "b": Sensor(sd={"vertical": 1e-4}), "silent": Sensor(sd=1e-4)}
    notes = build_segment(replace(run, notes=("torn line",)), config(**known)).notes
    assert len(notes) == len(wanted)
    for sentence in wanted:
        assert sum(note.startswith(sentence) for note in notes) == 1, (sentence, notes)


# ---- commands


def test_an_axis_has_its_own_commands_and_start() -> None:
    """Each axis has its commands and its start level, the first command by default."""
    stamp = [ORIGIN, ORIGIN + TICK, ORIGIN + 2 * TICK]
    values = {"vertical": [nan, 0.2, 0.3], "radial": [0.5, nan, 0.7]}
    segment = build_segment(Run.from_arrays(stamp, values, start={"radial": 0.4}), config())
    assert segment.axes == ("vertical", "radial")
    assert segment.start == {"radial": 0.4, "vertical": 0.2}
    assert [part.tolist() for part in segment.commands_of("radial")] == [[stamp[0], stamp[2]], [0.5, 0.7]]
    assert [part.tolist() for part in segment.commands_of("vertical")] == [stamp[1:], [0.2, 0.3]]
    assert segment.commands.tolist() == output_times(segment, config(), None).tolist() == stamp
    assert segment.origin == ORIGIN


def test_a_command_is_an_event_for_each_distinct_delay() -> None:
    """Axes with one delay are moved by one event, others by events of their own, in the order of acting."""
    arm = msgspec.structs.replace(ARM, axes={**ARM.axes, "tangential": ARM.axes["radial"]})
    run = Run.from_arrays([ORIGIN], {axis: [0.5] for axis in ("tangential", "radial", "vertical")})
    segment = build_segment(run, FusionConfig(arm=arm))
    events, place = segment.events(FusionConfig(arm=arm))
    assert not len(place)
    assert events.time.tolist() == [ORIGIN + 10 * MS, ORIGIN + DELAY]
    assert (events.codes == Outcome.FUSED).tolist() == [[False, False, True], [True, True, False]]
    other = FusionConfig(arm=msgspec.structs.replace(arm, delay=0.01))
    events, _ = segment.events(other)  # another configuration's times need no new segment
    assert events.time.tolist() == [ORIGIN + 10 * MS]
    assert (events.codes == Outcome.FUSED).all()


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
    assert build_segment(run, config()).origin == wanted[0][0]


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
    segment = build_segment(run, config(a=A))
    assert segment.origin == ORIGIN
    assert outcomes(segment) == ["before_start", "fused"]


def test_commands_that_are_no_positions_are_refused() -> None:
    """An axis with nothing but sentinels has no start level."""
    run = Run.from_arrays([ORIGIN, ORIGIN + TICK], {"radial": [0.5, 0.5], "vertical": [1e7, 3.4e38]}, clock="regular")
    with pytest.raises(RunError, match="'vertical'"):
        build_segment(run, config())


# ---- output times


@pytest.mark.parametrize(
    ("rows", "end", "stamped"),
    [
        ([(5, 1.0)], TICK, TICK),  # the last command
        ([(905, 1.0), (5, 1.0)], 900 * MS, 905 * MS),  # the last measurement, when it was true
        ([(905, 1.0), (2000, nan)], 900 * MS, 2000 * MS),  # not one that is left out, but a stream goes on until then
    ],
)
def test_the_end_is_the_last_event_of_the_filter(rows: list[tuple[float, float]], end: int, stamped: int) -> None:
    """The grid ends with the last command or the last measurement that can be fused; live with the last stamp."""
    segment = build_segment(recorded({"a": measurements(*rows)}), config(a=A))
    for as_live, last in ((False, end), (True, stamped)):
        assert segment.end(config(a=A), as_live) == ORIGIN + last
        assert output_times(segment, config(a=A), 1000.0, as_live)[-1] == ORIGIN + last


@properties
@given(st.integers(1, 2000), st.integers(0, 1000), st.just(0) | st.integers(1, 10**5))
def test_an_even_grid_has_every_point_up_to_the_end(rate: int, last: int, more: int) -> None:
    """Estimates at k / rate from the first command on, as long as the run lasts, to the nearest ns."""
    end = ORIGIN + math.ceil(Fraction(last * 10**9, rate)) + more
    segment = replace(build_segment(recorded(), config()), commands=np.array([ORIGIN, end]))
    wanted = [ORIGIN + round(Fraction(k * 10**9, rate)) for k in range(last + 1)]
    got = output_times(segment, config(), float(rate))
    assert len(got) == len(wanted)
    assert np.abs(got - np.array(wanted)).max() <= 1


class ForgottenAtOnce(dict[Any, Any]):
    """What a thread sees where another one has asked for other delays in between."""

    def __setitem__(self, key: Any, value: Any) -> None:
        super().clear()


def test_threads_may_ask_for_the_events_of_other_delays() -> None:
    """A search in threads does; the order that is kept for the next one is then another thread's."""
    given = config(tracker=Sensor(sd=1e-3))
    segment = build_segment(recorded({"tracker": measurements((1.0, 0.5), (2.0, 0.5))}), given)
    expected, _ = segment.events(given)
    object.__setattr__(segment, "_latest", ForgottenAtOnce())
    found, _ = segment.events(given)
    np.testing.assert_array_equal(found.time, expected.time)

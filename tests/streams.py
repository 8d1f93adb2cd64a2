"""Recorded runs as streams of events, fed to a live estimator in any order and compared with the offline result."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.arrays import NO_STAMP
from pumafuse.live.record import Recorder
from pumafuse.live.sources import replay
from pumafuse.live.stream import Stream
from pumafuse.live.wire import Lines

MS = 1_000_000
T = 28 * MS
FIELDS = pf.AxisEstimate.FIELDS


class Event(NamedTuple):
    """A command (no sensor) or a measurement: stamp in int ns, values in m."""

    stamp: int
    sensor: str
    values: dict[str, float]


def events_of(run: pf.Run) -> list[Event]:
    """All rows of a run in the order of their stamps, measurements before commands of the same instant."""
    found = []
    for sensor, one in [("", run.command), *run.sensors.items()]:
        source = one.in_joints()
        columns = {axis: value.tolist() for axis, value in source.values.items()}
        if source.orientation is not None:
            columns["orientation"] = source.orientation.tolist()
        if len(source.noise):
            columns["noise"] = source.noise.tolist()
        for row, stamp in enumerate(source.stamp.tolist()):
            if stamp != NO_STAMP:
                values = {axis: column[row] for axis, column in columns.items() if column[row] == column[row]}
                found.append(Event(stamp, sensor, values)) if values else None
    return sorted(found, key=lambda event: (event.stamp, event.sensor == ""))


def wired(run: pf.Run, seconds: float = math.inf) -> list[bytes]:
    """A run's first seconds on the wire: joints in degrees, positions in mm."""
    joints = () if run.command.joints is None else run.command.joints.chain.joints
    found = []
    for event in events_of(run):
        if event.stamp < seconds * 1e9:
            values = {
                axis: math.degrees(value) if axis in joints else value * 1e3
                for axis, value in event.values.items()
                if axis not in ("orientation", "noise")
            }
            values |= {"q": event.values["orientation"]} if "orientation" in event.values else {}
            values |= {"noise": event.values["noise"]} if "noise" in event.values else {}
            body = {"sensor": event.sensor, **values} if event.sensor else {"command": values}
            found.append(json.dumps({"t_ns": event.stamp, **body}).encode())
    return found


def delayed(events: Sequence[Event], longest: float, seed: int, *, twice: float = 0.0) -> list[Event]:
    """The events as they arrive, each up to ``longest`` s late; a share of them comes ``twice``."""
    rng = np.random.default_rng(seed)
    again = [event for event, share in zip(events, rng.random(len(events)), strict=True) if share < twice]
    pool = [*events, *again]
    late = rng.uniform(0.0, longest * 1e9, len(pool))
    order = np.argsort([event.stamp + delay for event, delay in zip(pool, late, strict=True)], kind="stable")
    return [pool[place] for place in order]


def feed(live: pf.LiveEstimator, event: Event) -> pf.UpdateResult:
    if event.sensor:
        return live.measurement(event.stamp, event.sensor, **event.values)
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
    """How many components of each sensor had which outcome."""
    measurements = offline.measurements
    return {
        sensor: {
            outcome.word: int(np.sum((measurements.sensor == number) & (measurements.outcome == outcome)))
            for outcome in pf.Outcome
        }
        for number, sensor in enumerate(measurements.sensors)
    }


def counted(live: pf.LiveEstimator, *without: str) -> dict[str, dict[str, int]]:
    """The same of a live estimator, of the sensors that gave anything."""
    sensors = live.health().sensors.items()
    return {name: {o: n for o, n in one.outcomes.items() if o not in without} for name, one in sensors if one.rows}


def axes_of(draw: st.DrawFn) -> pf.ArmModel:
    def one() -> pf.AxisModel:
        plant = draw(
            st.sampled_from(
                [
                    pf.FirstOrder(time_constant=0.05),
                    pf.SecondOrder(natural_frequency=50.0, damping=0.8),
                    pf.SecondOrder(natural_frequency=30.0, damping=1.3),
                ]
            )
        )
        gain = pf.Gain(
            slope=draw(st.sampled_from([0.0, 0.05])),
            intercept=draw(st.sampled_from([1.0, 0.97])),
            intercept_ci95=draw(st.sampled_from([None, (0.95, 1.0)])),
        )
        recovery, lag = draw(st.sampled_from([None, 0.01, 0.1, 3.0])), draw(st.sampled_from([None, (0.08, 0.12)]))
        delay, unseen = draw(st.sampled_from([None, 0.0])), draw(st.sampled_from([None, 0.01]))
        return pf.AxisModel(
            plant=plant, gain=gain, gain_recovery=recovery, delay=delay, lag_ci95=lag, unseen_lag_sd=unseen
        )

    return pf.ArmModel(name="any", update_period=0.028, delay=0.06, axes={"radial": one(), "vertical": one()})


def replay_is_as_live(run: pf.Run, config: pf.FusionConfig) -> None:
    """Assert that a run that is replayed as a stream ends with the last estimate of `fuse`, to the bit."""
    offline, live = pf.fuse(run, config), pf.LiveEstimator(config)
    stream = Stream(live, lambda _: None, lambda _: None)
    for events in replay(run, config, np.inf):
        stream.add(events)
    last = live.estimate(offline.origin + round(offline.time[-1] * 1e9))
    for axis, track in offline.axes.items():
        assert last[axis].position == track.position[-1]
        assert last[axis].position_sd == track.position_sd[-1]


def estimates_are_as_live(run: pf.Run, config: pf.FusionConfig) -> pf.Estimates:
    """Assert that the estimate at each command of a stream in order is that of `fuse --as-live`, which is returned."""
    offline, live = pf.fuse(run, config, mode="as-live"), pf.LiveEstimator(config, start=run.start)
    found = [
        live.estimate(event.stamp)
        for event in events_of(run)
        if feed(live, event).outcome is pf.Outcome.FUSED and not event.sensor
    ]
    assert [estimate.stamp for estimate in found] == (offline.origin + np.rint(offline.time * 1e9)).astype(int).tolist()
    for axis, track in offline.axes.items():
        assert [estimate[axis].position for estimate in found] == track.position.tolist()
        assert [estimate[axis].position_sd for estimate in found] == track.position_sd.tolist()
    return offline


def record_is_as_live(folder: Path, run: pf.Run, config: pf.FusionConfig) -> tuple[pf.Run, pf.Estimates, list[dict]]:
    """Assert that what goes out for lines of a run is, to the bit, its record as live; these, and what went out."""
    recorder = Recorder(folder, config, dict(run.start), lambda _: None)
    live, written = pf.LiveEstimator(config, start=run.start, event_log=recorder), list[bytes]()
    stream = Stream(live, written.extend, lambda _: None)
    for one in wired(run):
        stream.add([one])
        recorder.tick(live.sure)
    recorder.close(live.sure)
    found = pf.Run.read(folder)
    assert found.notes == ()
    offline = pf.fuse(found, msgspec.structs.replace(config, robot=None), mode="as-live")
    given = [json.loads(line) for line in written]
    for axis, track in offline.axes.items():
        unit, scale = ("deg", 180.0 / math.pi) if config.arm.axes[axis].kind == "angle" else ("mm", 1e3)
        assert [one[axis][f"position_{unit}"] for one in given] == (track.position * scale).tolist()
        assert [one[axis][f"sd_{unit}"] for one in given] == (track.position_sd * scale).tolist()
    return found, offline, given


def fused_in_any_order(
    run: pf.Run, offline: pf.Estimates, live: pf.LiveEstimator, longest: float
) -> dict[str, dict[str, int]]:
    """Hold a stream with events up to ``longest`` late [s], a tenth twice, to the offline result; its outcomes."""
    events = events_of(run)
    arrivals = delayed(events, longest, seed=5, twice=0.1) if longest else events
    assert differences(live, arrivals, offline, longest + 0.25) == []
    expected = {
        sensor: {outcome: count for outcome, count in counts.items() if outcome != "duplicate"}
        for sensor, counts in outcomes_of(offline).items()
    }
    assert counted(live, "duplicate") == expected
    return expected


@st.composite
def any_stream(draw: st.DrawFn) -> tuple[pf.FusionConfig, pf.Run, int]:
    """A configuration, a run of commands and measurements at any times, and a seed for the order in which they come.

    Commands repeat, share a stamp, begin late; gates reject and re-acquire; on a coarse grid many events are of one
    instant; sensors see the past, or the future.
    """
    arm = axes_of(draw)
    sensors = {
        "tracker": pf.Sensor(sd=1e-4, latency=draw(st.sampled_from([0.008, -0.02])), gate=3.0),
        "vision": pf.Sensor(
            sd={"radial": 5e-4}, latency=0.1, latency_sd=0.002, gate=2.0, gate_rows=False, bias_sd=1e-3
        ),
        "range": pf.Sensor(sd=3e-4, scale=-1.0, bias_sd=1.0, gate=0.0),
    }
    process = pf.Process(maneuver_noise=1e-3, maneuver_drift=1e-2)
    config = pf.FusionConfig(arm=arm, sensors=sensors, process={"radial": process})
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    commands = draw(st.integers(1, 40))
    gaps = draw(st.sampled_from([[T], [T, T, 3 * MS], [T, 0, 10 * MS, 400 * MS]]))
    stamp = np.cumsum(rng.choice(gaps, commands))
    levels = np.array([0.5, 0.501, 0.51])
    command = {axis: rng.choice(levels, commands) for axis in ("radial", "vertical")}
    command["vertical"][: draw(st.integers(0, commands - 1))] = np.nan
    measured, grid = {}, draw(st.sampled_from([1, 4 * MS]))
    for name in sensors:
        rows = draw(st.integers(1, 60))
        when = np.sort(rng.integers(stamp[0] - 200 * MS, stamp[-1] + 500 * MS, rows)) // grid * grid
        value = (-0.5 if name == "range" else 0.5) + rng.normal(0.0, 3e-3, rows)
        value[rng.random(rows) < 0.05] = np.nan
        noise = {"noise": rng.choice([0.5, 1.0, 4.0], rows)} if draw(st.booleans()) else {}
        measured[name] = (when, {"radial": value, "vertical": value[::-1].copy(), **noise})
    start = draw(st.sampled_from([{}, {"radial": 0.5}, dict.fromkeys(command, 0.49)]))
    return config, pf.Run.from_arrays(stamp, command, measured, start=start), draw(st.integers(0, 2**32))


def check_in_any_order(config: pf.FusionConfig, run: pf.Run, seed: int) -> None:
    """Compare estimates and outcomes of a stream that comes in any order with those of the run."""
    offline, events = pf.fuse(run, config), events_of(run)
    longest = events[-1].stamp - events[0].stamp
    live = pf.LiveEstimator(config, window=max(longest / 1e9 + 1.0, 2.0), start=run.start)
    tied = {(event.stamp, event.sensor) for event in events}
    arrivals = delayed(events, 1.9, seed) if len(tied) == len(events) else events  # of one stamp the last counts
    assert differences(live, arrivals, offline, 1e9) == []
    expected = outcomes_of(offline)
    for sensor, counts in counted(live).items():  # live an empty cell is no value, offline an invalid one
        for word in ("fused", "rejected", "reacquired"):
            assert counts[word] == expected[sensor][word]


TRACKED = pf.FusionConfig(
    arm=pf.ArmModel.load("puma560-internal"), sensors={"tracker": pf.Sensor(sd=5e-5, latency=0.008)}
)


class Both:
    """A live estimator and its stream, whose notices and output are kept."""

    def __init__(self, config: pf.FusionConfig = TRACKED, rate: float | None = None, **options: float) -> None:
        self.said: list[str] = []
        self._written: list[bytes] = []
        self.live = pf.LiveEstimator(config, on_notice=self.said.append, **options)
        self.stream = Stream(self.live, self.keep, self.said.append, rate)
        self.lines = Lines()

    def feed(self, piece: bytes) -> None:
        self.stream.add(self.lines.cut(piece))

    def replay(self, run: pf.Run) -> None:
        for events in replay(run, self.live.config, np.inf):
            self.stream.add(events)
        self.stream.end()

    def end(self) -> None:
        self.stream.add(self.lines.take_last())
        self.stream.end()

    def keep(self, lines: list[bytes]) -> None:
        assert all(line.endswith(b"\n") and line.count(b"\n") == 1 for line in lines)
        self._written += lines

    @property
    def written(self) -> bytes:
        return b"".join(self._written)

    @property
    def estimates(self) -> list[dict]:
        return [json.loads(line) for line in self.written.splitlines()]


def line(t: float, sensor: str = "", **axes: float) -> bytes:
    body = {"t": t, "sensor": sensor, **axes} if sensor else {"t": t, "command": axes}
    return json.dumps(body).encode() + b"\n"


def lines(seconds: float, begin: float = 0.0) -> bytes:
    found = b""
    for step in range(round(seconds / 0.028)):
        t = begin + step * 0.028
        found += line(t, radial=570.0) + line(t + 0.01, "tracker", radial=570.0)
    return found

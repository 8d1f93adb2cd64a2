"""Fed event by event, in any order, a run gives the offline numbers bit for bit."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import delayed, differences, events_of, feed, outcomes_of

import pumafuse as pf

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
SCENARIOS = Path(__file__).parents[2] / "scenarios"
RUNS = sorted(path.stem for path in SCENARIOS.glob("*.toml") if "[trajectory]" in path.read_text(encoding="utf-8"))
MS = 1_000_000
T = 28 * MS


def recorded(name: str) -> tuple[pf.Run, pf.FusionConfig]:
    """A run whose commands' stamps are believed, as a stream's are, and a configuration with the run's frame."""
    if name == "scan1":
        data = files("pumafuse") / "data"
        return pf.Run.read(str(data / "scan1")), pf.FusionConfig.load(str(data / "fusion.toml"))
    simulated = pf.simulate(pf.Scenario.load(SCENARIOS / f"{name}.toml"))
    run, config = replace(simulated.run, clock="stamps"), simulated.config
    return run, config if run.frame is None else msgspec.structs.replace(config, frame=run.frame)


def told(live: pf.LiveEstimator, *without: str) -> dict[str, dict[str, int]]:
    sensors = live.health().sensors.items()
    return {name: {o: n for o, n in one.outcomes.items() if o not in without} for name, one in sensors if one.rows}


@pytest.mark.parametrize("longest", [0.0, 0.3, 1.2])
@pytest.mark.parametrize("name", ["scan1", *RUNS])
def test_in_any_order(name: str, longest: float) -> None:
    """Each event up to 1.2 s late, a tenth of them twice: every estimate is the offline one once its readings are in."""
    run, config = recorded(name)
    offline = pf.fuse(run, config)
    live = pf.LiveEstimator(config, start=run.start)
    events = events_of(run)
    arrivals = delayed(events, longest, seed=5, twice=0.1) if longest else events
    assert differences(live, arrivals, offline, longest + 0.25) == []
    expected = {
        sensor: {outcome: count for outcome, count in counts.items() if outcome != "duplicate"}
        for sensor, counts in outcomes_of(offline).items()
    }
    assert told(live, "duplicate") == expected


@pytest.mark.parametrize("name", ["scan1", "panel-vision", "cylindrical-cartesian"])
def test_what_live_said_at_the_time(name: str) -> None:
    """Fed in order, the estimate at each command is that of `fuse --as-live`."""
    run, config = recorded(name)
    offline, live = pf.fuse(run, config, as_live=True), pf.LiveEstimator(config, start=run.start)
    said = []
    for event in events_of(run):
        if feed(live, event).outcome is pf.Outcome.FUSED and not event.sensor:
            said.append(live.estimate(event.stamp))
    assert [estimate.stamp for estimate in said] == (offline.origin + np.rint(offline.time * 1e9)).astype(int).tolist()
    for axis, track in offline.axes.items():
        assert [estimate[axis].position for estimate in said] == track.position.tolist()
        assert [estimate[axis].position_sd for estimate in said] == track.position_sd.tolist()


def test_the_frame_is_where_the_first_command_is_however_late_it_comes() -> None:
    """A frame about the base without a start level, its first commands in any order: as if they had come in order."""
    run, config = recorded("cylindrical-cartesian")
    run = replace(run, start={})
    offline = pf.fuse(run, config)
    for seed in range(4):
        live = pf.LiveEstimator(config)
        assert differences(live, delayed(events_of(run), 1.2, seed), offline, 1.45) == []


def test_a_clock_set_back_begins_a_segment_as_offline() -> None:
    """After the clock of all sources is set back the filter starts anew, and both have the same estimates after it."""
    run, config = recorded("panel-vision")

    def twice(source: pf.runs.run.Source) -> pf.runs.run.Source:
        again = source.stamp - int(20e9)
        values = {axis: np.concatenate((value, value)) for axis, value in source.values.items()}
        return replace(source, stamp=np.concatenate((source.stamp, again)), values=values)

    doubled = replace(run, command=twice(run.command), sensors={n: twice(s) for n, s in run.sensors.items()})
    doubled = replace(doubled, reference=None, start={})
    offline = pf.fuse(doubled, config)
    assert offline.segment.max() == 1
    notices: list[str] = []
    live = pf.LiveEstimator(config, start=doubled.start, on_notice=notices.append)
    first = events_of(replace(run, reference=None, start={}))
    for event in first:
        feed(live, event)
    second = [event._replace(stamp=event.stamp - int(20e9)) for event in first]
    found = [feed(live, event).outcome for event in second[:200]]
    assert live.segment == 1
    assert found.count(pf.Outcome.TOO_LATE) > 0
    for event in second[200:]:
        feed(live, event)
    assert len(notices) == 1
    assert "set back" in notices[0]
    last = live.estimate(run.command.stamp[-1] - int(20e9))
    for axis, track in offline.axes.items():
        assert last[axis].position == track.position[-1]
        assert last[axis].position_sd == track.position_sd[-1]
    counts = live.health().commands
    assert sum(counts.values()) == 2 * len(run.command.stamp)
    assert counts["too_late"] == 0


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
        gain = pf.Gain(slope=draw(st.sampled_from([0.0, 0.05])), intercept=draw(st.sampled_from([1.0, 0.97])))
        recovery = draw(st.sampled_from([None, 0.01, 0.1, 3.0]))
        return pf.AxisModel(plant=plant, gain=gain, gain_recovery=recovery, delay=draw(st.sampled_from([None, 0.0])))

    return pf.ArmModel(name="any", update_period=0.028, delay=0.06, axes={"radial": one(), "vertical": one()})


@st.composite
def streams(draw: st.DrawFn) -> tuple[pf.FusionConfig, pf.Run, int]:
    """A configuration, a run of commands and readings at any times, and a seed for the order in which they come."""
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
    heard = {}
    for name in sensors:
        rows = draw(st.integers(1, 60))
        when = np.sort(rng.integers(stamp[0] - 200 * MS, stamp[-1] + 500 * MS, rows))
        value = (-0.5 if name == "range" else 0.5) + rng.normal(0.0, 3e-3, rows)
        value[rng.random(rows) < 0.05] = np.nan
        heard[name] = (when, {"radial": value, "vertical": value[::-1].copy()})
    return config, pf.Run.from_arrays(stamp, command, heard), draw(st.integers(0, 2**32))


@settings(derandomize=True, deadline=None, max_examples=120)
@given(streams())
def test_any_stream_in_any_order(stream: tuple[pf.FusionConfig, pf.Run, int]) -> None:
    """Commands that repeat, share a stamp or begin late, gates that reopen, biases, any latency: the same bits."""
    config, run, seed = stream
    offline = pf.fuse(run, config)
    events = events_of(run)
    longest = events[-1].stamp - events[0].stamp
    live = pf.LiveEstimator(config, window=max(longest / 1e9 + 1.0, 2.0))
    tied = {(event.stamp, event.sensor) for event in events}
    arrivals = delayed(events, 1.9, seed) if len(tied) == len(events) else events  # of one stamp the last counts
    assert differences(live, arrivals, offline, 1e9) == []


def test_a_reading_before_the_first_command_waits_for_it() -> None:
    """Readings that come before the commands are fused once these are there, if they are valid after the first."""
    config = msgspec.structs.replace(recorded("panel-vision")[1])
    live = pf.LiveEstimator(config)
    assert live.reading(0.30, "vision", vertical=0.101).outcome is pf.Outcome.BEFORE_START
    assert live.estimate(0.3).outcome is pf.Outcome.BEFORE_START
    live.command(0.0, vertical=0.1)
    assert live.health().sensors["vision"].outcomes["fused"] == 1
    assert live.estimate(0.3)["vertical"].position > 0.1


def test_a_source_of_other_axes_changes_nothing() -> None:
    """A biased sensor that is configured but silent moves no bit of the others' estimates."""
    run, config = recorded("scan1")
    silent = {**config.sensors, "panel": pf.Sensor(sd=1e-4, bias_sd=1.0)}
    offline = pf.fuse(run, config, sensors=["vision"])
    chosen = {name: sensor for name, sensor in silent.items() if name != "tracker" and name != "range"}
    live = pf.LiveEstimator(msgspec.structs.replace(config, sensors=chosen))
    events = [event for event in events_of(run) if event.sensor in ("", "vision")]
    assert differences(live, events, offline, 0.25) == []


def test_the_last_of_one_stamp_counts() -> None:
    """Two commands of one stamp: the later one, as in a file; said once more, the first is in force again."""
    config = recorded("panel-vision")[1]

    def end(*values: float) -> float:
        live = pf.LiveEstimator(config)
        live.command(0.0, vertical=0.1)
        for value in values:
            live.command(0.028, vertical=value)
        return live.estimate(1.0)["vertical"].position

    assert end(0.11, 0.12) == end(0.12)
    assert end(0.11, 0.12, 0.11) == end(0.11)

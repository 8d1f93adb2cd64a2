"""Fed event by event, in any order, a run gives the offline numbers bit for bit."""

from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import msgspec
import numpy as np
import pytest

import pumafuse as pf
from pumafuse.logs.source import Source
from streams import (
    counted,
    delayed,
    differences,
    estimates_are_as_live,
    events_of,
    feed,
    fused_in_any_order,
    outcomes_of,
)

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
SCENARIOS = Path(__file__).parents[2] / "scenarios"
RUNS = sorted(path.stem for path in SCENARIOS.glob("*.toml") if "[trajectory]" in path.read_text(encoding="utf-8"))


@cache
def recorded(name: str, seconds: float = 1e9) -> tuple[pf.Run, pf.FusionConfig]:
    """The first seconds of a run whose commands' stamps are believed, as a stream's are; its frame is configured."""
    if name == "scan1":
        data = files("pumafuse") / "data"
        run, config = pf.Run.read(str(data / "scan1")), pf.FusionConfig.load(str(data / "fusion.toml"))
    else:
        simulated = pf.simulate(pf.Scenario.load(SCENARIOS / f"{name}.toml"))
        run, config = replace(simulated.run, clock="stamps"), simulated.config
        config = config if run.frame is None else msgspec.structs.replace(config, frame=run.frame)
    until = run.command.stamp[0] + seconds * 1e9
    command, *sensors = (one.rows(one.stamp <= until) for one in (run.command, *run.sensors.values()))
    return replace(run, command=command, sensors=dict(zip(run.sensors, sensors, strict=True)), reference=None), config


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        *((name, 7.0) for name in ("scan1", "cylindrical-cartesian", "fast-arm", "tool-with-play")),
        *(pytest.param(name, 1e9, marks=pytest.mark.long) for name in ("scan1", *RUNS)),
    ],
)
def test_in_any_order(name: str, seconds: float) -> None:
    """Each event up to 1.2 s late, a tenth of them twice: the offline estimates once measurements are in."""
    run, config = recorded(name, seconds)
    fused_in_any_order(run, pf.fuse(run, config), pf.LiveEstimator(config, start=run.start), 1.2)


BENT = ["saturating-servo", "tool-with-play", "sagging-lever"]


@pytest.mark.parametrize("name", ["scan1", "panel-vision", "cylindrical-cartesian", *BENT])
def test_estimates_at_the_time_are_as_live(name: str) -> None:
    """Fed in order, the estimate at each command is that of `fuse --as-live`."""
    estimates_are_as_live(*recorded(name, 7.0))


def test_the_frame_is_where_the_first_command_is_however_late_it_comes() -> None:
    """A frame about the base without a start level, its first commands in any order: as if they had come in order."""
    run, config = recorded("cylindrical-cartesian")
    run = replace(run, start={})
    offline = pf.fuse(run, config)
    for seed in range(4):
        live = pf.LiveEstimator(config)
        assert differences(live, delayed(events_of(run), 1.2, seed), offline, 1.45) == []
        assert counted(live) == outcomes_of(offline)
        assert live.health().commands["fused"] == len(run.command.stamp)


def test_a_clock_set_back_begins_a_segment_as_offline() -> None:
    """After the clock of all sources is set back the filter starts anew, and both have the same estimates after it."""
    run, config = recorded("panel-vision")

    def twice(source: Source) -> Source:
        again = source.stamp - int(20e9)
        values = {axis: np.concatenate((value, value)) for axis, value in source.values.items()}
        return replace(source, stamp=np.concatenate((source.stamp, again)), values=values)

    doubled = replace(run, command=twice(run.command), sensors={n: twice(s) for n, s in run.sensors.items()})
    doubled = replace(doubled, start={})
    offline = pf.fuse(doubled, config)
    assert offline.segment.max() == 1
    notices: list[str] = []
    live = pf.LiveEstimator(config, start=doubled.start, on_notice=notices.append)
    first = events_of(replace(run, start={}))
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


def test_late_by_nearly_the_window_and_by_its_latency_too() -> None:
    """Measurements that come 1.9 s late, of a sensor that sees the past besides: nothing was let go too soon."""
    config = pf.FusionConfig(
        arm=pf.ArmModel.load("puma560-internal"),
        sensors={"camera": pf.Sensor(sd=1e-4, latency=1.5), "tracker": pf.Sensor(sd=2e-4)},
    )
    rng, stamp = np.random.default_rng(4), np.arange(10_000_000, 8_000_000_000, 10_000_000)
    given = np.arange(0, 8_000_000_000, 28_000_000)
    values = {"radial": 0.5 + rng.normal(0.0, 1e-3, len(stamp))}
    run = pf.Run.from_arrays(
        given, {"radial": 0.5 + 1e-4 * np.arange(len(given))}, {"camera": (stamp, values), "tracker": (stamp, values)}
    )
    offline, live = pf.fuse(run, config), pf.LiveEstimator(config)
    late = 1_900_000_000
    arrivals = sorted(events_of(run), key=lambda event: event.stamp + late * (event.stamp % 7 < 4))
    for event in arrivals:
        assert feed(live, event).outcome not in (pf.Outcome.TOO_LATE, pf.Outcome.INVALID)
    last = live.estimate(int(given[-1]))["radial"]
    assert (last.position, last.position_sd) == (offline["radial"].position[-1], offline["radial"].position_sd[-1])

"""A sensor whose clock is set in mid-run is named, with when and by how much; outages and rest are no clock."""

from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.fusion.clock_steps import find_leaps
from pumafuse.fusion.faults import Fault, find_faults
from pumafuse.fusion.placing import in_base
from pumafuse.fusion.segments import build_segment
from pumafuse.logs.source import Source
from pumafuse.tuning.parameters import changed
from tuning_runs import SCENARIOS, later

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
SCAN = Path(__file__).parents[2] / "src" / "pumafuse" / "data" / "scan"
AT = 30.0  # s after the first command


@cache
def scan() -> tuple[pf.Run, pf.FusionConfig]:
    return replace(pf.Run.read(SCAN), reference=None), pf.FusionConfig.load(SCAN / "fusion.toml")


def clock_set(run: pf.Run, sensor: str, by: float, at: float = AT) -> pf.Run:
    """The run with the clock of a sensor set ahead by so much from an instant after the first command on [s]."""
    source, when = run.sensors[sensor], run.command.stamp[0] + round(at * 1e9)
    stamp = np.where(source.stamp >= when, source.stamp + round(by * 1e9), source.stamp)
    return replace(run, sensors={**run.sensors, sensor: replace(source, stamp=stamp)})


def named(run: pf.Run, config: pf.FusionConfig) -> list[Fault]:
    in_place, _, config = in_base(run, config)
    return [one for one in find_faults(build_segment(in_place, config), config) if one.cause == "set"]


def lost(source: Source, begin: float, end: float) -> Source:
    """A sensor without its rows between two instants [s]."""
    return source.rows((source.stamp < begin * 1e9) | (source.stamp >= end * 1e9))


def with_outages(run: pf.Run, seed: int) -> pf.Run:
    """Every sensor is lost ten times for 40 ms to 1 s, as it likes."""
    rng = np.random.default_rng(seed)

    def change(source: Source) -> Source:
        for begin in rng.uniform(source.stamp[0] / 1e9, source.stamp[-1] / 1e9, 10):
            source = lost(source, begin, begin + rng.uniform(0.04, 1.0))
        return source

    return replace(run, sensors={name: change(one) for name, one in run.sensors.items()})


@pytest.mark.parametrize(("sensor", "by"), [("tracker", 0.05), ("vision", -0.2), ("range", 0.8)])
def test_a_clock_that_is_set_is_named_with_when_and_by_how_much(sensor: str, by: float) -> None:
    """Of each sensor of the shipped scan alone, also where it loses rows just then, as vision does."""
    run, config = scan()
    (fault,) = named(clock_set(run, sensor, by), config)
    assert fault.sensors == (sensor,)
    assert abs(fault.size - by) < 0.015
    assert abs((fault.at - run.command.stamp[0]) / 1e9 - AT - max(by, 0.0)) < 0.1


def test_a_clock_that_is_set_twice_is_named_twice() -> None:
    run, config = scan()
    faults = named(clock_set(clock_set(run, "vision", 0.3, 20.0), "vision", -0.1, 40.0), config)
    assert [round(one.size, 1) for one in faults] == [0.3, -0.1]


def test_an_arm_with_a_wrong_delay_has_sensors_with_right_clocks() -> None:
    """Only what changes tells of a clock."""
    run, config = scan()
    config = delayed(config, 0.1)
    assert named(with_outages(run, 1), config) == []
    (fault,) = named(clock_set(run, "tracker", 0.2), config)
    assert abs(fault.size - 0.2) < 0.01


def delayed(config: pf.FusionConfig, more: float) -> pf.FusionConfig:
    """The configuration with an arm that has a longer dead time [s]."""
    return changed(config, ("arm", "delay"), config.arm.delay + more)


@cache
def logged(name: str) -> tuple[pf.Run, pf.FusionConfig]:
    """The shipped scan, or a run of a scenario."""
    if name == "scan":
        return scan()
    found = pf.simulate(pf.Scenario.load(SCENARIOS / f"{name}.toml"), 1)
    return found.run, found.config


RUNS = ["scan", "panel-tracker-outage", "panel-vision", "mismatched-arm", "saturating-servo", "smooth-disturbance"]
RUNS += ["wrong-latency", "tool-with-play", "sagging-lever"]


def test_leaps_are_as_long_as_time_went_by_without_rows() -> None:
    """Ahead where rows are missing, back where some lie between each other; what scatters is none."""
    rng = np.random.default_rng(1)
    even = np.arange(0.0, 20.0, 0.033)
    stamp = np.rint((even + rng.uniform(0.0, 0.01, len(even))) * 1e9).astype(np.int64)
    assert find_leaps(stamp) == []
    for by in (0.05, 0.2, 0.9, -0.05, -0.2, -0.9):
        (leap,) = find_leaps(np.sort(np.where(even >= 10.0, stamp + round(by * 1e9), stamp)))
        assert abs(leap.by - by) < 0.033
        assert abs(leap.last / 1e9 - 10.0 - min(by, 0.0)) < 0.1
    assert find_leaps(stamp[:: len(stamp)]) == []


@pytest.mark.parametrize(
    ("name", "seed"), [("scan", 1), ("panel-tracker-outage", 1), *(later(*case) for case in product(RUNS, range(2, 9)))]
)
def test_outages_are_no_clock(name: str, seed: int) -> None:
    """Stamps leap by as much, and what is measured goes on as it was, also of an arm with a wrong delay."""
    run, config = logged(name)
    for more in (0.0, 0.1):
        assert named(with_outages(run, 100 + seed), delayed(config, more)) == []

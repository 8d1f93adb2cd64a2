"""What sensors show before anything is filtered: another zero, repeated values, a negative latency."""

from __future__ import annotations

import warnings
from dataclasses import replace

import msgspec
import numpy as np
import pytest

import pumafuse as pf
from pumafuse.fusion.faults import _times_each  # pyright: ignore[reportPrivateUsage]
from pumafuse.logs.run import Source
from tuning_runs import outage

CONFIG = outage(1).config


def notes(run: pf.Run, config: pf.FusionConfig = CONFIG) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)
        given = [one for one in pf.fuse(run, config).notes if one.startswith(("sensor '", "sensors."))]
    return [one for one in given if "contradicts" not in one]


def with_vision(change: object) -> pf.Run:
    run = outage(1).run
    return replace(run, sensors={**run.sensors, "vision": change(run.sensors["vision"])})  # type: ignore[operator]


def moved(off: float, one: Source) -> Source:
    return replace(one, values={axis: value + off for axis, value in one.values.items()})


@pytest.mark.parametrize("off", [-0.3, 0.05])
def test_another_zero_is_said_with_its_distance(off: float) -> None:
    """50 mm where noise and priors are 2 mm; not 5 mm, not with a bias as uncertain as that, not in a good run."""
    assert not notes(outage(1).run) and not notes(with_vision(lambda one: moved(0.005, one)))
    run = with_vision(lambda one: moved(off, one))
    found = [one for one in notes(run) if "where the commands lead" in one]
    assert len(found) == 2
    assert all(abs(float(one.split(" mm ")[0].split()[-1]) - off * 1e3) < 8.0 for one in found), found
    told = msgspec.structs.replace(CONFIG.sensors["vision"], bias_sd=abs(off))
    config = msgspec.structs.replace(CONFIG, sensors={**CONFIG.sensors, "vision": told})
    assert not [one for one in notes(run, config) if "where the commands lead" in one]


def held(times: int, one: Source) -> Source:
    """The sensor logged ``times`` as often as it measures."""
    stamp = np.repeat(one.stamp, times) + np.tile(np.arange(times) * (30_000_000 // times), len(one.stamp))
    return replace(one, stamp=stamp, values={axis: np.repeat(value, times) for axis, value in one.values.items()})


@pytest.mark.parametrize("times", [2, 5])
def test_values_that_come_several_times_are_said(times: int) -> None:
    """Once for the sensor, with how often."""
    found = [one for one in notes(with_vision(lambda one: held(times, one))) if "each value" in one]
    assert len(found) == 1 and found[0].startswith(f"sensor 'vision' gives each value {times} times")


def test_an_encoder_at_rest_and_coarse_steps_are_no_held_samples() -> None:
    """Long rests are few rows of equal values, and a slow motion through coarse steps changes by one step at a time."""
    rng = np.random.default_rng(1)
    motion = np.concatenate([np.zeros(900), np.cumsum(rng.uniform(0.0, 20.0, 100)), np.full(500, 1e3)])
    assert _times_each(np.rint(motion)) == 1
    assert _times_each(np.rint(0.2 * np.arange(1000))) == 1
    assert _times_each(np.repeat(rng.standard_normal(300), 3)) == 3


def test_a_negative_latency_is_questioned() -> None:
    """By its key and value, for a sensor that is in the run."""
    early = msgspec.structs.replace(CONFIG.sensors["vision"], latency=-0.02)
    config = msgspec.structs.replace(CONFIG, sensors={**CONFIG.sensors, "vision": early})
    assert [one[:35] for one in notes(outage(1).run, config)] == ["sensors.vision.latency_ms is -20, s"[:35]]
    run = outage(1).run
    assert not notes(replace(run, sensors={"tracker": run.sensors["tracker"]}), config)[1:]

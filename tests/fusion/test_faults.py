"""What shows before anything is filtered: another zero, repeated values, a negative latency, a begin in mid-motion."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.csv as pacsv
import pytest

import pumafuse as pf
from fusion.test_between import cut
from pumafuse.fusion.faults import _times_each  # pyright: ignore[reportPrivateUsage]
from pumafuse.logs.run import Source
from pumafuse.tuning.likelihood import Likelihood
from tuning_runs import SCENARIOS, outage, scenario

CONFIG = outage(1).config
LATENCY = {"camera": 0.045, "vision": 0.045, "tracker": 0.008}  # s, of recorded sensors


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


# ---- a log that begins in mid-motion --------------------------------------------------------------------------------


def begun(run: pf.Run, config: pf.FusionConfig) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)
        return [one for one in pf.fuse(run, config).notes if "begins in motion" in one]


@pytest.mark.parametrize("name", ["panel-tracker-outage", "panel-vision", "mismatched-arm", "smooth-disturbance"])
def test_a_log_that_was_cut_in_mid_motion_says_so(name: str) -> None:
    """With speed and what it is off by; not the whole log, which begins at rest with commands that move at once.

    Nor the same part of the whole log, nor the file from where the note says on.
    """
    sim = pf.simulate(scenario(name, 0.2, 0.02), 1)
    file = cut(sim.run, 0.5)
    assert not begun(sim.run, sim.config) and not begun(sim.run.between(0.5), sim.config)
    (note,) = begun(file, sim.config)
    assert "(60 mm/s on tangential)" in note and "up to 5.5 mm" in note
    since = float(note.split("--from ")[1].split()[0])
    assert 0.2 < since < 0.3 and not begun(file.between(since), sim.config)
    (fitted,) = [one for one in Likelihood([file], sim.config).notes if "begins in motion" in one]
    assert fitted == f"run '{file.name}': {note}"


def test_runs_that_begin_at_rest_are_not_told_to_be_in_motion() -> None:
    """White noise, a step, one that rests elsewhere with one of its axes; and all with a sensor that hardly knows."""
    white = pf.simulate(pf.Scenario.load(SCENARIOS / "white-noise.toml"), 1)
    assert not begun(white.run, white.config)
    steps = pf.simulate(pf.Scenario.load(SCENARIOS / "step-campaign.toml"), 1)
    first = int(np.flatnonzero(np.diff(steps.run.command.values["tangential"]))[0]) * 0.028
    for since in (0.0, first, first + 0.028):
        assert not begun(cut(steps.run, since), steps.config)
    blind = {name: msgspec.structs.replace(one, sd=0.02) for name, one in CONFIG.sensors.items()}
    assert not begun(cut(outage(1).run, 0.5), msgspec.structs.replace(CONFIG, sensors=blind))


@pytest.mark.parametrize("name", ["trunk-servo", "puma-virtual"])
def test_real_recordings_begin_at_rest(name: str) -> None:
    """Six servos with camera or encoder, and the arm's scan and white noise: nothing is told of them, only when cut."""
    place = Path(__file__).parents[3] / "shared" / "data" / name
    if not place.exists():
        pytest.skip("these recordings are not part of this repository")
    runs = trunk(place) if name == "trunk-servo" else [pf.Run.read(path.parent) for path in place.rglob("run.toml")]
    for run in runs:
        assert not begun(run, guessed(run)), run.name
    longest = [run for run in runs if run.name in ("encoder", "scan1")]
    assert longest and all(begun(cut(run, 20.0), guessed(run)) for run in longest)


def guessed(run: pf.Run) -> pf.FusionConfig:
    """A first-order arm that is about right."""
    axes = {axis: pf.AxisModel(plant=pf.FirstOrder(time_constant=0.045)) for axis in run.axes}
    period = float(np.median(np.diff(run.command.stamp))) / 1e9
    arm = pf.ArmModel(name="guess", update_period=period, delay=0.15 if "m1" in axes else 0.06, axes=axes)
    sensors = {name: pf.Sensor(sd=5e-4, latency=LATENCY.get(name, 0.0)) for name in run.sensors}
    return pf.FusionConfig(arm=arm, sensors=sensors)


def trunk(place: Path) -> list[pf.Run]:
    """Both recordings with the encoder, and with the camera; a degree is a mm."""
    runs: list[pf.Run] = []
    for folder in ("0g", "100g"):
        tables = [pacsv.read_csv(place / folder / f"{name}.csv.gz") for name in ("commands", "encoder", "camera")]
        (time, command), *seen = [
            (table["time_s"].to_numpy(), {f"m{k}": table[f"m{k}"].to_numpy() * 1e-3 for k in range(1, 7)})
            for table in tables
        ]
        for name, rows in zip(("encoder", "camera"), seen, strict=True):
            runs.append(pf.Run.from_arrays(time, command, {name: rows}, name=name))
    return runs

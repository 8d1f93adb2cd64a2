"""The shipped scan with one sensor gone bad: the run ends, the trouble is said in words, the good sensor still counts.

Tracker and camera see all three axes; each test spoils the tracker's measurements and leaves the camera's alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import pumafuse as pf
from pumafuse.fusion.summary import Summary, summarise
from pumafuse.logs.run import Source

DATA = Path(pf.__file__).parent / "data"
AXES = ("tangential", "radial", "vertical")
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def scan() -> pf.Run:
    return pf.Run.read(DATA / "scan1")


@pytest.fixture(scope="module")
def config() -> pf.FusionConfig:
    return pf.FusionConfig.load(DATA / "fusion.toml")


@pytest.fixture(scope="module")
def camera_alone(scan: pf.Run, config: pf.FusionConfig) -> pf.Estimates:
    return pf.fuse(scan, config, sensors=["vision"])


def fused(scan: pf.Run, config: pf.FusionConfig, spoil: Callable[[Source], Source]) -> tuple[pf.Estimates, Summary]:
    """Camera and spoilt tracker; every note of the summary must have been a warning too."""
    run = replace(scan, sensors={**scan.sensors, "tracker": spoil(scan.sensors["tracker"])})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        est = pf.fuse(run, config, sensors=["tracker", "vision"])
    summary = summarise(est)
    assert [str(warning.message) for warning in caught] == [f"run 'scan1': {note}" for note in summary.notes]
    assert all(np.isfinite(est[axis].position).all() for axis in est.axes)
    return est, summary


def changed(source: Source, change: Callable[[np.ndarray], np.ndarray]) -> Source:
    """A source with its values changed."""
    return replace(source, values={axis: change(value) for axis, value in source.values.items()})


def said(summary: Summary, *words: str) -> bool:
    """Whether one note about the tracker holds all the words."""
    return any(note.startswith("tracker") and all(word in note for word in words) for note in summary.notes)


def rmse(est: pf.Estimates, axis: str, after: float = 0.0) -> float:
    """Root mean square error [m] from ``after`` [s] on."""
    late = est.time >= after
    score = pf.score(
        est.time[late], est.segment[late], est[axis].position[late], est[axis].position_sd[late], est.reference, axis
    )
    return score.rmse


def test_a_constant_error_is_found_where_a_bias_is_expected(
    scan: pf.Run, config: pf.FusionConfig, camera_alone: pf.Estimates
) -> None:
    """With bias_sd_mm the 50 mm are estimated on each axis within 3 sd, and the estimate is no worse than without."""
    tracker = msgspec.structs.replace(config.sensors["tracker"], bias_sd=1.0)
    biased = msgspec.structs.replace(config, sensors={**config.sensors, "tracker": tracker})
    est, summary = fused(scan, biased, lambda source: changed(source, lambda value: value + 0.05))
    for axis in AXES:
        bias = est.biases["tracker"][axis]
        assert abs(bias.value - 0.05) < 3.0 * bias.sd
        assert summary.axes[axis].sensors["tracker"].bias_mm == pytest.approx(bias.value * 1e3)
        assert rmse(est, axis) < 1.05 * rmse(camera_alone, axis)


def test_a_frozen_sensor_is_seen(scan: pf.Run, config: pf.FusionConfig) -> None:
    """One value for 20 s: held on every axis, said from when to when; when it thaws the estimate is as good as ever."""
    good, _ = fused(scan, config, lambda source: source)

    def freeze(source: Source) -> Source:
        since = source.stamp - scan.command.stamp.min()
        frozen = (since >= 20 * SECOND) & (since < 40 * SECOND)
        return changed(source, lambda value: np.where(frozen, value[frozen.argmax()], value))

    est, summary = fused(scan, config, freeze)
    assert not any("repeats its value" in note for note in good.notes)
    for axis in AXES:
        assert said(summary, f"{axis} repeats its value", "from 20.02 to 40.00 s", "1999 are held")
        assert summary.axes[axis].sensors["tracker"].outcomes["held"] == 1999
        assert rmse(est, axis, after=41.0) == pytest.approx(rmse(good, axis, after=41.0), rel=0.01)


def test_what_one_axis_does_is_said_of_that_axis(scan: pf.Run, config: pf.FusionConfig) -> None:
    """The last axis alone freezes: the others do not. Half of its values are wild: a sixth of all components."""

    def of_vertical(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Source], Source]:
        return lambda source: Source(
            source.stamp, {**source.values, "vertical": change(source.values["vertical"])}, source.label
        )

    _, frozen = fused(scan, config, of_vertical(lambda value: np.where(np.arange(len(value)) > 3000, value[0], value)))
    assert [axis for axis in AXES if said(frozen, f"{axis} repeats its value")] == ["vertical"]
    sides = np.random.default_rng(0).choice([-0.4, 0.0, 0.0, 0.4], 6000)
    alone = {name: msgspec.structs.replace(one, gate_rows=False) for name, one in config.sensors.items()}
    by_axis = msgspec.structs.replace(config, sensors=alone)
    _, wild = fused(scan, by_axis, of_vertical(lambda value: value + sides[: len(value)]))
    (note,) = [note for note in wild.notes if "of its components were rejected" in note]
    assert note.startswith(("tracker: 16%", "tracker: 17%"))


def nothing(source: Source) -> Source:
    """Of which no value is a number."""
    return changed(source, lambda value: np.full_like(value, np.nan))


def of_the_epoch(source: Source) -> Source:
    """On another clock than the commands."""
    return replace(source, stamp=source.stamp + 1_700_000_000 * SECOND)


@pytest.mark.parametrize(
    ("spoil", "outcomes", "words"),
    [
        (nothing, {"invalid": 5999}, ("5999 rows", "no finite radial value", "invalid")),
        (of_the_epoch, {"fused": 5999}, ("after the last command", "one clock")),
    ],
)
def test_a_sensor_that_says_nothing_of_the_run_changes_nothing(
    scan: pf.Run,
    config: pf.FusionConfig,
    camera_alone: pf.Estimates,
    spoil: Callable[[Source], Source],
    outcomes: dict[str, int],
    words: tuple[str, ...],
) -> None:
    """The same estimates as of the camera alone to rounding, and no surer; what is wrong is said."""
    est, summary = fused(scan, config, spoil)
    for axis in AXES:
        np.testing.assert_allclose(est[axis].position, camera_alone[axis].position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(est[axis].position_sd, camera_alone[axis].position_sd, rtol=1e-9)
    assert said(summary, *words)
    assert summary.axes["radial"].sensors["tracker"].outcomes == outcomes
    if spoil is nothing:
        assert summary.axes["radial"].sensors["tracker"].verdict == "nothing fused"

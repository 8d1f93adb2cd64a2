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


def fused(
    scan: pf.Run, config: pf.FusionConfig, spoil: Callable[[Source], Source], rate: float | None = None
) -> tuple[pf.Estimates, Summary]:
    """Camera and spoilt tracker; every note of the summary must have been a warning too."""
    run = replace(scan, sensors={**scan.sensors, "tracker": spoil(scan.sensors["tracker"])})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        est = pf.fuse(run, config, sensors=["tracker", "vision"], rate=rate)
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


def check_same(est: pf.Estimates, wanted: pf.Estimates) -> None:
    """A sensor that says nothing of the run changes nothing: the same estimates to rounding, and no surer."""
    for axis in AXES:
        np.testing.assert_allclose(est[axis].position, wanted[axis].position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(est[axis].position_sd, wanted[axis].position_sd, rtol=1e-9)


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


def test_a_sensor_of_nothing_but_nan_is_left_out(
    scan: pf.Run, config: pf.FusionConfig, camera_alone: pf.Estimates
) -> None:
    """A minute of NaN: every measurement invalid, counted on each axis, and the estimates are the camera's alone."""
    est, summary = fused(scan, config, lambda source: changed(source, lambda value: np.full_like(value, np.nan)))
    check_same(est, camera_alone)
    for axis in AXES:
        assert said(summary, "5999 rows", f"no finite {axis} value", "invalid")
        found = summary.axes[axis].sensors["tracker"]
        assert found.outcomes == {"invalid": 5999}
        assert found.verdict == "nothing fused"
        assert found.nis_mean is None


def shifted(seconds: float) -> Callable[[Source], Source]:
    return lambda source: replace(source, stamp=source.stamp + int(seconds * 1e9))


def test_a_sensor_on_the_epoch_s_clock_is_asked_about(
    scan: pf.Run, config: pf.FusionConfig, camera_alone: pf.Estimates
) -> None:
    """Stamps of 2023 beside commands from 0 s: asked whether one clock stamped both; nothing of the run is touched."""
    est, summary = fused(scan, config, shifted(1.7e9))
    check_same(est, camera_alone)
    assert said(summary, "after the last command", "one clock")


def test_a_sensor_on_a_clock_since_boot_is_asked_about(
    scan: pf.Run, config: pf.FusionConfig, camera_alone: pf.Estimates
) -> None:
    """The other way round everything lies before the first command: before_start, and the same question."""
    early = replace(scan, command=shifted(1.7e9)(scan.command), reference=None)
    early = replace(early, sensors={"vision": shifted(1.7e9)(scan.sensors["vision"])})
    early = replace(early, sensors={**early.sensors, "tracker": scan.sensors["tracker"]})
    est, summary = fused(early, config, lambda source: source)
    check_same(est, camera_alone)
    assert said(summary, "5999 rows have a time before the first command", "before_start")
    assert said(summary, "before the first command", "one clock")
    assert summary.axes["radial"].sensors["tracker"].outcomes == {"before_start": 5999}

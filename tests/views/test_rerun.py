"""Recordings are read back and compared with the estimates they were made from."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from rerun.chunk import RrdReader

import pumafuse as pf


@pytest.fixture(scope="module")
def fused() -> tuple[pf.Estimates, pf.Run]:
    time = 100.0 + 0.028 * np.arange(50)
    rng = np.random.default_rng(1)
    stamps = 100.0 + 0.01 * np.arange(140)
    sight = 0.5 + 1e-4 * rng.standard_normal(140)
    sight[70] += 0.1
    run = pf.Run.from_arrays(
        time,
        {"radial": 0.5 + 1e-4 * np.arange(50)},
        {"camera": (stamps, {"radial": sight})},
        (stamps, {"radial": np.full(140, 0.5)}),
    )
    config = pf.FusionConfig(
        arm=pf.ArmModel.load("puma560-internal"), sensors={"camera": pf.Sensor(sd=1e-3, latency=0.005, gate=5.0)}
    )
    with pytest.warns(pf.PumafuseWarning, match="before_start"):
        return pf.fuse(run, config, rate=100.0), run


@pytest.fixture(scope="module")
def recorded(fused: tuple[pf.Estimates, pf.Run], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "fused.rrd"
    pf.to_rerun(*fused, path)
    return path


def series(path: Path, entity: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Times [s] and values of one entity."""
    chunks = [
        chunk.to_record_batch()
        for chunk in RrdReader(str(path)).stream()
        if chunk.entity_path == entity and not chunk.is_static
    ]
    times = np.concatenate([batch["time"].to_numpy(zero_copy_only=False).astype("m8[ns]") for batch in chunks])
    values = np.concatenate([batch["Scalars:scalars"].flatten().to_numpy() for batch in chunks])
    return times / np.timedelta64(1, "s"), values


def test_estimates_and_band_are_in_mm_at_their_own_times(fused: tuple[pf.Estimates, pf.Run], recorded: Path) -> None:
    """Position and ±2σ stand at seconds since the first command."""
    est = fused[0]
    for entity, factor in (("", 0.0), ("/upper", 2.0), ("/lower", -2.0)):
        time, value = series(recorded, f"/radial/estimate{entity}")
        assert np.allclose(time, est.time, atol=1e-9, rtol=0)
        assert np.allclose(value, (est["radial"].position + factor * est["radial"].position_sd) * 1e3)


def test_commands_readings_and_reference_are_on_the_same_clock(
    fused: tuple[pf.Estimates, pf.Run], recorded: Path
) -> None:
    """Commands from 0, readings at stamp − latency, the reference at its stamps."""
    est, run = fused
    time, value = series(recorded, "/radial/command")
    assert np.allclose(time, 0.028 * np.arange(50))
    assert np.allclose(value, run.command.values["radial"] * 1e3)
    time, _ = series(recorded, "/radial/camera")
    assert np.allclose(time, np.delete(0.01 * np.arange(1, 140) - 0.005, 69))
    time, _ = series(recorded, "/radial/reference")
    assert np.allclose(time, 0.01 * np.arange(140))
    assert est.readings.counts() == {"fused": 138, "gated": 1, "before_start": 1}


def test_a_rejected_reading_is_marked(recorded: Path) -> None:
    """The outlier stands among the rejected ones, not among the fused."""
    time, value = series(recorded, "/radial/camera/rejected")
    assert np.allclose(time, [-0.005, 0.695])
    assert value[1] > 590.0

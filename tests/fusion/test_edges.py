"""Logs at the edge of sense: infinities, frames, clocks, references that fit nothing. Each is said, none breaks."""

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.fusion import results
from pumafuse.logs.frames import Cylindrical
from refusals import one_line

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
ARM = pf.ArmModel.load("puma560-internal")


def config(**sensor):
    return pf.FusionConfig(arm=ARM, sensors={"camera": pf.Sensor(sd=1e-3, **sensor)})


def test_a_sensor_in_x_y_without_a_frame_is_refused():
    """Its axes are none of the arm's."""
    run = pf.Run.from_arrays([0.0, 0.028], {"radial": [0.5, 0.5]}, {"camera": ([0.01], {"x": [0.5], "y": [0.0]})})
    assert "give a [frame]" in one_line(pf.RunError, lambda: pf.fuse(run, config()))


def test_a_second_segment_keeps_the_frame_of_the_run():
    """R0 and θ0 are the run's: a clock that is set back moves nothing."""
    n = 60
    time = np.concatenate([10 + 0.028 * np.arange(n), 5 + 0.028 * np.arange(n)])
    angle = np.concatenate([np.linspace(0, 0.2, n), np.full(n, 0.2)])
    run = pf.Run.from_arrays(time, {"x": 0.5 * np.cos(angle), "y": 0.5 * np.sin(angle)}, frame=Cylindrical())
    est = pf.fuse(run, pf.FusionConfig(arm=ARM))
    assert est["tangential"].position[-1] == pytest.approx(0.1)


def test_a_reference_s_own_noise_scales_like_a_measurement_s():
    """Scoring: the tangential variance of a reference at r is (sd R0/r)²."""
    time = 0.028 * np.arange(60)
    x = np.linspace(0.5, 0.25, 60)
    run = pf.Run.from_arrays(
        time,
        {"x": x, "y": np.zeros(60)},
        None,
        (time, {"x": x, "y": np.zeros(60)}),
        reference_sd=1e-3,
        frame=Cylindrical(),
    )
    est = pf.fuse(run, pf.FusionConfig(arm=ARM))
    np.testing.assert_allclose(est.reference.sd["tangential"], 1e-3 * 0.5 / x)
    np.testing.assert_allclose(est.reference.sd["radial"], 1e-3)
    table = results.reference_table(est.reference, est.config)
    np.testing.assert_allclose(table["tangential.position_sd_mm"], 0.5 / x)
    np.testing.assert_allclose(table["radial.position_sd_mm"], 1.0)

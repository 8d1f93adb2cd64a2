"""Innovations without estimates: the numbers of a fusion, and of one whose outcomes are known."""

from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings

from fusion.test_oracle import CRITICAL, LAG, MS, NOISE, OVER, PAPER, UNDER, Case, Seen, cases, every, sensor
from fusion_oracle import AxisOracle
from pumafuse.arrays import FloatArray
from pumafuse.filter.events import Results
from pumafuse.filter.outcome import ABSENT, Outcome
from pumafuse.fusion.config import FusionConfig, Process
from pumafuse.fusion.engine import innovation_derivatives, innovations
from pumafuse.fusion.offline import fuse
from pumafuse.fusion.segments import build_segment
from pumafuse.logs.run import Run
from pumafuse.model.arm import AxisModel
from pumafuse.model.plants import Plant
from pumafuse.tuning.parameters import changed as with_number

changed = msgspec.structs.replace
pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
GATE = 1.2  # which rejects a good part of measurements that scatter by 1 mm


def gated(config: FusionConfig, gate: float = GATE) -> FusionConfig:
    return changed(config, sensors={name: changed(one, gate=gate) for name, one in config.sensors.items()})


def check(run: Run, config: FusionConfig) -> Results:
    """Gates decide as in a fusion; with the outcomes given, everything is as it was."""
    segment = build_segment(run, config)
    found, est = innovations(segment, config), fuse(run, config)
    order = np.argsort(segment.events(config)[1])
    given = segment.measurement_rows.codes[order] != ABSENT
    for part in ("outcome", "innovation", "innovation_sd"):  # in the order of processing: it is the same filter
        np.testing.assert_array_equal(getattr(found, part)[order][given], getattr(est.measurements, part))
    known = found.outcome.copy()
    again = innovations(segment, config, known)
    assert [part.tobytes() for part in again[:3]] == [part.tobytes() for part in found[:3]]
    assert (known == found.outcome).all()
    return found


@settings(max_examples=40)
@given(cases())
def test_innovations_of_any_run_are_those_of_its_fusion(case: Case) -> None:
    """Random plants, noise and sensors, gates narrow enough to reject."""
    run, config = case.made()
    check(run, gated(config))


def contradicting() -> tuple[Run, FusionConfig]:
    """A camera of two axes that jumps by 50 mm after a second, when the tracker has ended: it is rejected, then not."""
    camera = Seen(sensor(0.4e-3, latency=0.03), every(30, 60, 7 * MS))
    tracker = Seen(sensor(0.3e-3, latency=0.004), every(11, 10, 3 * MS))
    axes = {"radial": AxisModel(plant=LAG), "vertical": AxisModel(plant=UNDER)}
    run, config = Case(axes, times=np.arange(75) * 28 * MS, seen={"camera": camera, "tracker": tracker}).made()
    for value in run.sensors["camera"].values.values():
        value[30:] += 0.05
    return run, gated(config, 5.0)


def louder(config: FusionConfig) -> FusionConfig:
    """Another noise of everything, with which the gates would decide otherwise."""
    process = Process(input_noise=0.1e-3, drift=2.5e-3, maneuver_noise=0.2e-3, maneuver_drift=1e-3)
    each = {name: changed(one, sd=0.7 * one.sd) for name, one in config.sensors.items()}
    return changed(config, process=dict.fromkeys(config.process, process), sensors=each)


def test_given_outcomes_are_repeated_whatever_the_gates_would_say() -> None:
    """With other noise each component keeps its outcome; ν and √S are those of the joint Gaussian given what was fused.

    Rejected ones are not conditioned on, and those that re-acquired add the ν² they have now.
    """
    run, config = contradicting()
    outcome = check(run, config).outcome
    assert set(np.unique(outcome)) == {Outcome.FUSED, Outcome.REJECTED, Outcome.REACQUIRED}
    segment, other = build_segment(run, config), louder(config)
    assert (innovations(segment, other).outcome != outcome).any()
    repeated = innovations(segment, other, outcome)
    assert (repeated.outcome == outcome).all()
    source, order = segment.measurement_rows.source, np.argsort(segment.events(other)[1])
    names = [(segment.sensors[of], int(np.sum(source[:row] == of))) for row, of in enumerate(source)]
    for column, axis in enumerate(run.axes):
        out, reacquired = (
            {names[row] for row in np.flatnonzero(outcome[:, column] == kind)}
            for kind in (Outcome.REJECTED, Outcome.REACQUIRED)
        )
        nu, sd = AxisOracle(run, other, axis, leave_out=out, reacquired=reacquired).innovations()
        fused = order[outcome[order, column] != Outcome.REJECTED]
        np.testing.assert_allclose(repeated.innovation[fused, column], nu, rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(repeated.innovation_sd[fused, column], sd, rtol=1e-8)


# ---- derivatives ----------------------------------------------------------------------------------------------------

ARMS: dict[str, tuple[Plant, float, Literal["matern", "ou"]]] = {  # plant, recovery of the gain, disturbance
    "lag as slow as the recovery": (LAG, LAG.time_constant, "ou"),
    "recovery at a double pole": (CRITICAL, 1.0 / 45.0, "ou"),
    "recovery at the slow pole of two": (OVER, 0.07348, "matern"),
}
PARTS = {
    "panel": Seen(sensor(3e-4, scale=-1.3, latency=0.004, bias_sd=2e-3), every(31, 7, 41 * MS)),
    "vision": Seen(
        sensor(4e-4, latency=0.09, latency_sd=0.002, bias_drift_sd=1e-3, bias_time=0.3), every(23, 6, 67 * MS)
    ),
}


def numbers(config: FusionConfig, axis: str) -> list[tuple[str, ...]]:
    """Where each number of an axis and of all sensors is."""
    noise = ("input_noise", "drift", "maneuver_noise", "maneuver_drift", "disturbance_sd", "disturbance_time")
    arm = ("delay", "gain.slope", "gain.intercept", "gain_recovery")
    plant = ("plant.time_constant", "plant.natural_frequency", "plant.damping")
    kinds = ("sd", "latency", "latency_sd", "scale", "bias_sd", "bias_drift_sd")
    paths = [
        ("start", "offset_sd"),
        *(("process", axis, name) for name in noise),
        *(("arm", "axes", axis, *name.split(".")) for name in (*arm, *plant)),
        *(("sensors", name, kind) for name in config.sensors for kind in kinds),
    ]
    drifts = [("sensors", name, "bias_time") for name, one in config.sensors.items() if one.bias_drift_sd]
    return [path for path in paths if number(config, path)] + drifts


def number(config: FusionConfig, path: tuple[str, ...]) -> float:
    node: Any = config
    for name in path:
        node = node[name] if isinstance(node, dict) else getattr(node, name, 0.0)
    return node


def beside(config: FusionConfig, path: tuple[str, ...]) -> tuple[FusionConfig, FusionConfig, float]:
    """The configuration a little below and above a number: instants by whole µs."""
    at = number(config, path)
    step = 2e-6 if path[-1] in ("delay", "latency") else 1e-4 * abs(at)
    return with_number(config, path, at - step), with_number(config, path, at + step), 2.0 * step


def near(config: FusionConfig, path: tuple[str, ...]) -> tuple[FusionConfig, float]:
    """The configuration a little above a number, and by how much."""
    _, high, width = beside(config, path)
    return high, 0.5 * width


def alike(found: FloatArray, wanted: FloatArray, path: tuple[str, ...]) -> None:
    """To a millionth of the largest."""
    assert np.abs(wanted).max() > 0.0, path
    assert np.abs(found - wanted).max() < 1e-6 * np.abs(wanted).max(), path


@pytest.mark.parametrize(("plant", "recovery", "kind"), ARMS.values(), ids=ARMS)
def test_derivatives_are_those_of_the_joint_gaussian(
    plant: Plant, recovery: float, kind: Literal["matern", "ou"]
) -> None:
    """Of ν and S by every number of arm, noise and sensors at once: central differences of the dense oracle."""
    noise = changed(NOISE, disturbance_sd=2e-3, disturbance_time=0.2, disturbance_kind=kind)
    arm = {"radial": AxisModel(plant=plant, gain=PAPER, gain_recovery=recovery, delay=0.0412)}
    run, config = Case(arm, times=np.arange(8) * 28 * MS, process=noise, seen=PARTS).made()
    segment, paths = build_segment(run, config), numbers(config, "radial")
    order = np.argsort(segment.events(config)[1])
    outcome = np.zeros_like(segment.measurement_rows.codes)
    _, d_nu, d_s = innovation_derivatives(segment, config, outcome, [near(config, path) for path in paths])
    assert len(paths) > 20
    for path, by_nu, by_s in zip(paths, d_nu[:, order, 0], d_s[:, order, 0], strict=True):
        low, high, width = beside(config, path)
        (nu, sd), (nu_up, sd_up) = (AxisOracle(run, one, "radial").innovations() for one in (low, high))
        alike(by_nu, (nu_up - nu) / width, path)
        alike(by_s, (sd_up**2 - sd**2) / width, path)


def test_derivatives_are_those_of_innovations_whose_outcomes_stay() -> None:
    """By the numbers of two axes, where some measurements are rejected and others re-acquire; twelve go in a pass.

    A parameter alone, or among as many as fill a shorter pass, has the same bits as among others. Without any the
    innovations are the same.
    """
    run, config = contradicting()
    segment, outcome = build_segment(run, config), check(run, config).outcome
    noise = changed(NOISE, disturbance_sd=2e-3, disturbance_time=0.2)
    axes = {axis: changed(one, gain=PAPER, gain_recovery=0.08, delay=0.05) for axis, one in config.arm.axes.items()}
    sensors = {
        "camera": changed(config.sensors["camera"], latency_sd=2e-3, bias_sd=1e-3),
        "tracker": changed(config.sensors["tracker"], bias_drift_sd=1e-3, bias_time=0.3),
    }
    config = changed(config, arm=changed(config.arm, axes=axes), process=dict.fromkeys(axes, noise), sensors=sensors)
    paths = list(dict.fromkeys(path for axis in axes for path in numbers(config, axis)))
    found, d_nu, d_s = innovation_derivatives(segment, config, outcome, [near(config, path) for path in paths])
    for path, by_nu, by_s in zip(paths, d_nu, d_s, strict=True):
        low, high, width = beside(config, path)
        down, up = (innovations(segment, one, outcome) for one in (low, high))
        alike(by_nu, (up.innovation - down.innovation) / width, path)
        alike(by_s, (up.innovation_sd**2 - down.innovation_sd**2) / width, path)
        _, alone_nu, alone_s = innovation_derivatives(segment, config, outcome, [near(config, path)])
        np.testing.assert_array_equal(alone_nu[0], by_nu)
        np.testing.assert_array_equal(alone_s[0], by_s)
    for count in (6, 7, 10, 11):
        _, some_nu, some_s = innovation_derivatives(
            segment, config, outcome, [near(config, path) for path in paths[:count]]
        )
        np.testing.assert_array_equal(some_nu, d_nu[:count])
        np.testing.assert_array_equal(some_s, d_s[:count])
    plain, *none = innovation_derivatives(segment, config, outcome, [])
    assert [len(one) for one in none] == [0, 0]
    for one in (found, innovations(segment, config, outcome)):
        np.testing.assert_array_equal(one.innovation, plain.innovation)
        np.testing.assert_array_equal(one.innovation_sd, plain.innovation_sd)
        np.testing.assert_array_equal(one.outcome, outcome)

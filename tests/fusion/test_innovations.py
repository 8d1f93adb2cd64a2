"""Innovations without estimates: the numbers of a fusion, and of one whose outcomes are known."""

from __future__ import annotations

import warnings
from typing import Literal

import msgspec
import numpy as np
from hypothesis import given, settings

from fusion.test_oracle import LAG, MS, UNDER, Case, Seen, cases, every, sensor
from fusion_oracle import AxisOracle
from pumafuse.errors import PumafuseWarning
from pumafuse.filter.events import Results
from pumafuse.filter.outcome import ABSENT, Outcome
from pumafuse.fusion.config import FusionConfig, Process
from pumafuse.fusion.engine import innovations, innovations_of_each
from pumafuse.fusion.estimates import Estimates
from pumafuse.fusion.offline import fuse
from pumafuse.fusion.segments import Segment, build
from pumafuse.logs.run import Run
from pumafuse.model.arm import AxisModel, Gain
from pumafuse.model.plants import FirstOrder

KINDS: tuple[Literal["matern", "ou"], ...] = ("matern", "ou")
changed = msgspec.structs.replace
GATE = 1.2  # which rejects a good part of measurements that scatter by 1 mm


def quietly(run: Run, config: FusionConfig) -> Estimates:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)
        return fuse(run, config)


def gated(config: FusionConfig, gate: float = GATE, gate_rows: bool = True) -> FusionConfig:
    each = {name: msgspec.structs.replace(one, gate=gate, gate_rows=gate_rows) for name, one in config.sensors.items()}
    return msgspec.structs.replace(config, sensors=each)


def same(found: Results, est: Estimates, segment: Segment, config: FusionConfig) -> None:
    """To the bit, in the order of processing: it is the same filter."""
    order = np.argsort(segment.events(config)[1])
    given = segment.measurement_rows.known[order] != ABSENT
    for part in ("outcome", "innovation", "innovation_sd"):
        np.testing.assert_array_equal(getattr(found, part)[order][given], getattr(est.measurements, part))


def check(run: Run, config: FusionConfig) -> Results:
    """Gates decide as in a fusion; with the outcomes given, everything is as it was."""
    segment = build(run, config)
    found = innovations(segment, config)
    same(found, quietly(run, config), segment, config)
    known = found.outcome.copy()
    again = innovations(segment, config, known)
    assert [part.tobytes() for part in again[:3]] == [part.tobytes() for part in found[:3]]
    assert (known == found.outcome).all()
    return found


@settings(derandomize=True, deadline=None, max_examples=60)
@given(cases())
def test_innovations_of_any_run_are_those_of_its_fusion(case: Case) -> None:
    """Random plants, noise and sensors, gates narrow enough to reject."""
    run, config = case.made()
    check(run, gated(config))


def contradicting() -> tuple[Run, FusionConfig]:
    """A camera of two axes that jumps by 50 mm after a second, when the tracker has ended: it is rejected, then not."""
    camera = Seen(sensor(0.4e-3, latency=0.03), every(30, 60))
    tracker = Seen(sensor(0.3e-3, latency=0.004), every(11, 10, 3 * MS))
    axes = {"radial": AxisModel(plant=LAG), "vertical": AxisModel(plant=UNDER)}
    run, config = Case(axes, times=np.arange(75) * 28 * MS, seen={"camera": camera, "tracker": tracker}).made()
    for value in run.sensors["camera"].values.values():
        value[30:] += 0.05
    return run, gated(config, 5.0)


def louder(config: FusionConfig) -> FusionConfig:
    """Another noise of everything, with which the gates would decide otherwise."""
    process = Process(input_noise=0.1e-3, drift=2.5e-3, maneuver_noise=0.2e-3, maneuver_drift=1e-3)
    each = {name: msgspec.structs.replace(one, sd=0.7 * one.sd) for name, one in config.sensors.items()}
    return msgspec.structs.replace(config, process=dict.fromkeys(config.process, process), sensors=each)


def test_given_outcomes_are_repeated_whatever_the_gates_would_say() -> None:
    """With other noise each component keeps its outcome; ν and √S are those of the joint Gaussian given what was fused.

    Rejected ones are not conditioned on, and those that re-acquired add the ν² they have now.
    """
    run, config = contradicting()
    outcome = check(run, config).outcome
    assert set(np.unique(outcome)) == {Outcome.FUSED, Outcome.REJECTED, Outcome.REACQUIRED}
    segment, other = build(run, config), louder(config)
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


def test_side_by_side_each_configuration_gives_what_it_gives_alone() -> None:
    """To the bit: with other noise, another plant, gain, latency, delay, scale, disturbance, and with a bias."""
    run, config = contradicting()
    segment, arm = build(run, config), config.arm
    outcome = innovations(segment, config).outcome
    smooth, rough = (Process(disturbance_sd=2e-3, disturbance_time=0.2, disturbance_kind=kind) for kind in KINDS)
    radial = msgspec.structs.replace(arm.axes["radial"], plant=FirstOrder(time_constant=0.05))
    gains = {axis: msgspec.structs.replace(one, gain=Gain(intercept=0.9)) for axis, one in arm.axes.items()}
    camera = config.sensors["camera"]

    def seen(**changes: float) -> FusionConfig:
        return changed(config, sensors={**config.sensors, "camera": msgspec.structs.replace(camera, **changes)})

    others = [
        config,
        louder(config),
        changed(config, process={**config.process, "radial": smooth}),
        changed(config, process={**config.process, "vertical": rough}),
        changed(config, arm=changed(arm, axes={**arm.axes, "radial": radial})),
        changed(config, arm=changed(arm, axes=gains)),
        changed(config, arm=changed(arm, delay=arm.delay + 2e-5)),
        seen(latency=camera.latency + 2e-5),
        seen(scale=1.1),
        seen(latency_sd=3e-3),
        seen(bias_sd=1e-3),
        seen(bias_drift_sd=1e-3, bias_time=3.0),
    ]
    for other, found in zip(others, innovations_of_each(segment, others, outcome), strict=True):
        alone = innovations(segment, other, outcome)
        for part in ("outcome", "innovation", "innovation_sd"):
            np.testing.assert_array_equal(getattr(found, part), getattr(alone, part))

"""Innovations without estimates: the numbers of a fusion to the last bit, and of one whose outcomes are known."""

from __future__ import annotations

import warnings
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings

from fusion.test_oracle import CASES, LAG, MS, NOISE, UNDER, VISION, Case, Heard, cases, every, sensor
from fusion_oracle import AxisOracle
from pumafuse.errors import PumafuseWarning
from pumafuse.fusion.config import FusionConfig, Process
from pumafuse.fusion.engine import innovations
from pumafuse.fusion.estimates import Estimates
from pumafuse.fusion.kernels import Met
from pumafuse.fusion.offline import fuse
from pumafuse.fusion.outcome import Outcome
from pumafuse.fusion.timeline import Timeline, build
from pumafuse.logs.run import Run
from pumafuse.model.arm import AxisModel

GATE = 1.2  # which rejects a good part of measurements that scatter by 1 mm


def quietly(run: Run, config: FusionConfig) -> Estimates:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)
        return fuse(run, config)


def rejected(config: FusionConfig, gate: float = GATE, gate_rows: bool = True) -> FusionConfig:
    each = {name: msgspec.structs.replace(one, gate=gate, gate_rows=gate_rows) for name, one in config.sensors.items()}
    return msgspec.structs.replace(config, sensors=each)


def same(met: Met, est: Estimates, timeline: Timeline) -> None:
    """To the last bit, in the order of processing."""
    chosen = timeline.components.candidates
    for name in ("innovation", "innovation_sd", "outcome"):
        assert getattr(met, name).tobytes() == getattr(est.measurements, name)[chosen].tobytes(), name


def check(run: Run, config: FusionConfig) -> Met:
    """Gates decide as in a fusion; replayed, everything is as it was."""
    timeline = build(run, config)
    met = innovations(timeline, config)
    same(met, quietly(run, config), timeline)
    known = met.outcome.copy()
    again = innovations(timeline, config, known)
    assert [part.tobytes() for part in again] == [part.tobytes() for part in met]
    assert (known == met.outcome).all()
    return met


@pytest.mark.parametrize("gate_rows", [True, False], ids=["rows", "components"])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_innovations_are_those_of_a_fusion(case: Case, gate_rows: bool) -> None:
    """ν, √S and outcome of every component that the filter meets, to the last bit; replayed they are the same again."""
    run, config = case.made()
    check(run, config)
    check(run, rejected(config, gate_rows=gate_rows))


@settings(derandomize=True, deadline=None, max_examples=60)
@given(cases())
def test_innovations_of_any_run_are_those_of_its_fusion(case: Case) -> None:
    """Random plants, noise and sensors, gates narrow enough to reject."""
    run, config = case.made()
    check(run, rejected(config))


def contradicting() -> tuple[Run, FusionConfig]:
    """A camera of two axes that jumps by 50 mm after a second: it is rejected until its gate reopens."""
    camera = Heard(sensor(0.4e-3, latency=0.03), every(30, 60))
    tracker = Heard(sensor(0.3e-3, latency=0.004), every(11, 22, 3 * MS))
    axes = {"radial": AxisModel(plant=LAG), "vertical": AxisModel(plant=UNDER)}
    run, config = Case(axes, times=np.arange(75) * 28 * MS, heard={"camera": camera, "tracker": tracker}).made()
    for value in run.sensors["camera"].values.values():
        value[30:] += 0.05
    return run, rejected(config, 5.0)


def louder(config: FusionConfig) -> FusionConfig:
    """Another noise of everything, with which the gates would say something else."""
    process = Process(input_noise=0.1e-3, drift=2.5e-3, maneuver_noise=0.2e-3, maneuver_drift=1e-3)
    each = {name: msgspec.structs.replace(one, sd=0.7 * one.sd) for name, one in config.sensors.items()}
    return msgspec.structs.replace(config, process=dict.fromkeys(config.process, process), sensors=each)


def test_a_replay_repeats_outcomes_whatever_the_gates_would_say() -> None:
    """With other noise each component keeps its outcome; ν and √S are those of the joint Gaussian given what was fused.

    Rejected ones are not conditioned on, and those that reacquired the gate add the ν² they have now.
    """
    run, config = contradicting()
    met = check(run, config)
    assert set(np.unique(met.outcome)) == {Outcome.FUSED, Outcome.REJECTED, Outcome.REACQUIRED}
    timeline, other = build(run, config), louder(config)
    assert (innovations(timeline, other).outcome != met.outcome).any()
    replayed = innovations(timeline, other, met.outcome)
    assert (replayed.outcome == met.outcome).all()
    components = timeline.components
    rows = dict[tuple[int, int], int]()  # each sensor's rows by their stamps
    for number, name in enumerate(components.sensors):
        rows |= {(number, int(stamp)): row for row, stamp in enumerate(run.sensors[name].stamp)}
    names = [
        (components.sensors[of], rows[of, stamp])
        for of, stamp in zip(components.sensor.tolist(), components.stamp.tolist(), strict=True)
    ]
    for number, axis in enumerate(run.axes):
        mine = np.flatnonzero(components.axis == number)
        out, reacquired = (
            {names[place] for place in mine if met.outcome[place] == kind}
            for kind in (Outcome.REJECTED, Outcome.REACQUIRED)
        )
        nu, sd = AxisOracle(run, other, axis, leave_out=out, reacquired=reacquired).innovations()
        fused = mine[met.outcome[mine] != Outcome.REJECTED]
        np.testing.assert_allclose(replayed.innovation[fused], nu, rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(replayed.innovation_sd[fused], sd, rtol=1e-8)


def test_what_was_rejected_is_met_and_then_forgotten() -> None:
    """A rejected component's ν and √S are what it would have if it alone came back; nothing after it knows of it."""
    run, config = contradicting()
    met = innovations(build(run, config), config)
    timeline, other = build(run, config), louder(config)
    replayed = innovations(timeline, other, met.outcome)
    for place in np.flatnonzero(met.outcome == Outcome.REJECTED)[::7]:
        back = met.outcome.copy()
        back[place] = Outcome.FUSED
        other_way = innovations(timeline, other, back)
        until = place + 1
        assert other_way.innovation[:until].tobytes() == replayed.innovation[:until].tobytes()
        assert other_way.innovation_sd[:until].tobytes() == replayed.innovation_sd[:until].tobytes()
        axis = timeline.components.axis
        later = np.flatnonzero(axis[until:] == axis[place])[0] + until
        assert other_way.innovation[later] != replayed.innovation[later]


def test_gating_nothing_is_fusing_without_a_gate() -> None:
    """All outcomes fused, replayed under narrow gates: the innovations of a fusion whose gates are off."""
    case = replace(CASES["axes and missing values"], process=NOISE, heard={"vision": VISION})
    run, config = case.made()
    timeline = build(run, config)
    count = len(timeline.components.candidates)
    replayed = innovations(timeline, rejected(config), np.full(count, Outcome.FUSED, dtype=np.uint8))
    assert (innovations(timeline, rejected(config)).outcome == Outcome.REJECTED).any()
    same(replayed, quietly(run, rejected(config, 0.0)), timeline)

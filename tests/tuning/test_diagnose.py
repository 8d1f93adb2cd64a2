"""What measurements tell only together or not at all is named, and what lies at a bound is said to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.tuning.climb import point
from pumafuse.tuning.diagnose import at_bound, correlations, covariance, shared_time, untold
from pumafuse.tuning.likelihood import Evidence
from pumafuse.tuning.parameters import Parameter, parameters
from pumafuse.tuning.summary import told
from tuning_runs import free_of, learnt, outage, quietly, scenario, with_outliers, with_process, with_sensors

ARM = pf.ArmModel.load("puma560-internal")
CONFIG = pf.FusionConfig(arm=ARM, sensors={"tracker": pf.Sensor(sd=5e-5)})


def free(count: int) -> list[Parameter]:
    return parameters(CONFIG, CONFIG, {"radial": ["tracker"], "vertical": ["tracker"]}, ("noise",))[:count]


@settings(derandomize=True, deadline=None)
@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_a_covariance_is_the_inverse_of_the_information(count: int, seed: int) -> None:
    """However far its scales are apart: I C = 1 to 1e-6."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((count, count + 2))
    scale = 10.0 ** rng.uniform(-2.0, 4.0, count)
    information = root @ root.T * np.outer(scale, scale)
    found = covariance(information, free(count))
    unity = (information @ found) * np.outer(1.0 / scale, scale)
    np.testing.assert_allclose(unity, np.eye(count), atol=1e-6)


def test_what_nothing_tells_has_an_enormous_variance() -> None:
    """A number without information, and the difference of two that are told by their sum alone."""
    found = covariance(np.diag([4.0, 0.0]), free(2))
    assert found[0, 0] == pytest.approx(0.25) and found[1, 1] > 1e10
    found = covariance(np.array([[1.0, 1.0], [1.0, 1.0]]), free(2))
    together, apart = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    assert apart @ found @ apart > 1e10
    assert together @ found @ together == pytest.approx(1.0, rel=1e-3)


def test_bounds_are_where_the_range_ends() -> None:
    """At the least, at the greatest, beyond them, and nowhere between."""
    for one in parameters(CONFIG, CONFIG, {"radial": ["tracker"]}, ("noise", "delay", "gain")):
        low, high = one.bounds
        inside = one.value(0.5 * sum(one.range))
        for value, said in ((low, "least"), (high, "greatest"), (inside, None)):
            assert at_bound(one, one.put(CONFIG, value)) == said, one.key
    none = parameters(CONFIG, CONFIG, {"radial": ["tracker"]}, ("noise",))[0]
    assert at_bound(none, none.put(CONFIG, 0.0)) == "least"


def test_a_parameter_at_a_bound_is_said_to_be() -> None:
    """No noise: the measurements show no sign of it. A gain that belongs beyond its range: the model does not fit."""
    sim = outage(1)
    still = [
        f"process.{axis}.{key}"
        for axis in ("tangential", "vertical")
        for key in ("input_noise_mm_rtHz", "drift_mm_rts")
    ]
    found = quietly(lambda: pf.tune([sim.run], sim.config, hold=[*still, "sd_mm"]))
    none = [one for one in found.summary.parameters if one.value == 0.0]
    assert none and all(one.said == "the measurements show no sign of it" and one.ci95[0] == 0.0 for one in none)
    assert all(one.ci95[1] is not None and one.ci95[1] > 0.0 for one in none)
    sim = pf.simulate(scenario("panel-tracker-outage", 0.1, 0.06), 1)
    early = with_sensors(sim.config, latency=0.12)  # by more than the arm is late
    found = quietly(lambda: pf.tune([sim.run], early, fit=["delay"]))
    for one in found.summary.parameters:
        assert one.ci95[0] is None and "is looked for" in one.said, one


# ---- together -------------------------------------------------------------------------------------------------------


def test_pairs_beyond_nine_tenths_are_named() -> None:
    """Delay and time constant by a camera alone: the correlations of the inverted information, no others."""
    sim = with_outliers(1)
    found = learnt(sim.run, sim.config, ("noise", "delay", "plant"))
    inside = [one for one in found.free if at_bound(one, found.best.config) is None]
    information = found.evidence.slopes(found.best.config, inside, found.best.value.outcomes).information
    inverse = np.linalg.inv(information)
    sd = np.sqrt(np.diag(inverse))
    matrix = inverse / np.outer(sd, sd)
    wanted = {
        frozenset((inside[i].key, inside[j].key)): matrix[i, j]
        for i in range(len(inside))
        for j in range(i)
        if abs(matrix[i, j]) > 0.9
    }
    named = correlations(found.evidence, found.best, found.free)
    assert {frozenset((one, other)): value for one, other, value in named} == pytest.approx(wanted, rel=1e-6)
    assert frozenset(("axes.vertical.time_constant_ms", "axes.vertical.delay_ms")) in wanted


def test_delays_and_latencies_are_told_only_as_a_sum() -> None:
    """All of them are members, a latency is to be held; with one latency held, nothing is untold."""
    sim = outage(1)
    evidence = Evidence([sim.run], sim.config)
    every = free_of(evidence, sim.config, ("noise", "delay", "latency"))
    tie = untold(evidence, point(evidence, sim.config, every), every)
    assert tie is not None and tie.held == "sensors.tracker.latency_ms"
    assert set(tie.members) == {one.key for one in every if one.fit != "noise"}
    sentence = told(tie)
    assert sentence.startswith("sensors.tracker.latency_ms is held: the measurements do not tell it from ")
    assert all(key in sentence for key in tie.members)
    held = [one for one in every if one.key != tie.held]
    assert untold(evidence, point(evidence, sim.config, held), held) is None


Heard = dict[str, list[str]]
HEARD: dict[str, tuple[Heard, list[str], list[str], list[tuple[str, set[str]]]]] = {
    "all hear all": (
        {"tangential": ["good", "poor"], "vertical": ["good", "poor"]},
        ["tangential", "vertical"],
        [],
        [("good", {"good", "poor", "tangential", "vertical"})],
    ),
    "two that hear nothing of each other": (
        {"tangential": ["good"], "vertical": ["poor"]},
        ["tangential", "vertical"],
        [],
        [("good", {"good", "tangential"}), ("poor", {"poor", "vertical"})],
    ),
    "connected by a third": (
        {"tangential": ["good", "third"], "vertical": ["poor", "third"]},
        ["tangential", "vertical"],
        [],
        [("good", {"good", "poor", "third", "tangential", "vertical"})],
    ),
    "a delay that is known": (
        {"tangential": ["good", "poor"], "vertical": ["good"]},
        ["tangential", "vertical"],
        ["axes.tangential"],
        [],
    ),
    "a latency that is known": ({"tangential": ["good", "poor"]}, ["tangential"], ["good.latency_ms"], []),
    "an axis that rests": (
        {"tangential": ["good"], "vertical": ["poor"]},
        ["tangential"],
        [],
        [("poor", {"poor"}), ("good", {"good", "tangential"})],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("heard", "moving", "hold", "wanted"), HEARD.values(), ids=HEARD.keys())
def test_a_time_is_shared_by_those_who_hear_one_another(
    heard: Heard, moving: list[str], hold: list[str], wanted: list[tuple[str, set[str]]]
) -> None:
    """One latency is held of each group of sensors and moving axes connected by measurements, all of whose times are free.

    That of a sensor which hears nothing that moves is held alone.
    """
    sensors = {name: pf.Sensor(sd=sd) for name, sd in (("poor", 1e-3), ("third", 2e-3), ("good", 1e-4))}
    config = pf.FusionConfig(arm=ARM, sensors=sensors)
    every = parameters(config, config, heard, ("delay", "latency"), hold)
    ties = shared_time(heard, moving, every, config)
    names = {f"axes.{axis}.delay_ms": axis for axis in heard} | {f"sensors.{name}.latency_ms": name for name in sensors}
    assert [(names[tie.held], {names[key] for key in tie.members}) for tie in ties] == wanted


def test_the_latency_that_is_held_is_of_the_sensor_with_the_least_noise() -> None:
    """Whichever comes first in the file."""
    sim = outage(1)
    config = with_sensors(sim.config, "tracker", sd=1e-3)
    evidence = Evidence([sim.run], config)
    every = free_of(evidence, config, ("delay", "latency"))
    tie = untold(evidence, point(evidence, config, every), every)
    assert tie is not None and tie.held == "sensors.vision.latency_ms"


def test_noise_is_never_held_for_an_arm() -> None:
    """Where only noises are free, nothing is tied, however little they are told."""
    sim = outage(1)
    config = with_process(sim.config, maneuver_noise=1e-6, maneuver_drift=1e-5)
    evidence = Evidence([sim.run], config)
    every = free_of(evidence, config, ("noise",))
    assert untold(evidence, point(evidence, config, every), every) is None

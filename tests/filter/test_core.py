"""What must not change a bit of what the core makes, and what it refuses."""

import copy
from collections.abc import Sequence

import numpy as np
import pytest

from pumafuse.arrays import FloatArray
from pumafuse.errors import PumafuseError
from pumafuse.filter.core import FINEST, Filter, Model, Output, linearise
from pumafuse.filter.events import COMMAND, Events, Results
from pumafuse.filter.outcome import ABSENT, Outcome
from pumafuse.fusion.config import FusionConfig, Process, Sensor, Start
from pumafuse.fusion.setup import filter_model
from pumafuse.live.estimator import LiveEstimator
from pumafuse.model.arm import ArmModel, AxisModel, Gain
from pumafuse.model.plants import PLANTS, FirstOrder, SecondOrder

MS = 1_000_000  # ns
T, START = 0.028, 0.5
MANEUVER = Process(input_noise=0.2e-3, drift=0.5e-3, maneuver_noise=0.4e-3, maneuver_drift=5e-3)
SMOOTH = Process(input_noise=0.2e-3, drift=0.5e-3, disturbance_sd=2e-3, disturbance_time=0.2)
ROUGH = Process(maneuver_noise=0.4e-3, disturbance_sd=1e-3, disturbance_time=0.05, disturbance_kind="ou")
SENSORS = {
    "plain": Sensor(sd=1e-4, scale=-2.0, gate=0.0),
    "biased": Sensor(sd=3e-4, bias_sd=5e-3, latency_sd=0.004, gate=0.0),
    "drifting": Sensor(sd=3e-4, bias_sd=1e-3, bias_drift_sd=2e-3, bias_time=0.3, gate=0.0),
}


def of(plant: PLANTS, recovery: float | None = 0.15) -> AxisModel:
    return AxisModel(plant=plant, gain=Gain(slope=0.08, intercept=0.93), gain_recovery=recovery)


LAG = of(FirstOrder(time_constant=0.04))
TURNING = of(SecondOrder(natural_frequency=45.0, damping=0.4))
SLOW = of(SecondOrder(natural_frequency=30.0, damping=1.6))
CRITICAL = of(SecondOrder(natural_frequency=45.0, damping=1.0))
AXES = {
    "lag": (LAG, MANEUVER),
    "lag, disturbed": (LAG, SMOOTH),
    "turning": (TURNING, MANEUVER),
    "turning, rough": (TURNING, ROUGH),
    "slow, disturbed": (SLOW, SMOOTH),
    "critical": (CRITICAL, MANEUVER),
    "critical, for good": (of(CRITICAL.plant, recovery=None), SMOOTH),
}
every_axis = pytest.mark.parametrize("axis", AXES)


def config_of(
    axes: Sequence[str], sensors: dict[str, Sensor] = SENSORS, process: Process | None = None, offset_sd: float = 5e-3
) -> FusionConfig:
    arm = ArmModel(name="an arm", update_period=T, delay=0.0, axes={axis: AXES[axis][0] for axis in axes})
    each = {axis: process or AXES[axis][1] for axis in axes}
    return FusionConfig(arm=arm, start=Start(offset_sd=offset_sd), process=each, sensors=sensors)


def model_of(config: FusionConfig) -> Model:
    """Every sensor measures every axis, with its bias."""
    axes, names = tuple(config.arm.axes), list(config.sensors)
    return filter_model(config, axes, names, dict.fromkeys(axes, START), [names] * len(axes))


def any_events(config: FusionConfig, count: int = 80, seed: int = 1) -> Events:
    """Commands, and measurements of all sensors, after gaps from a nanosecond to 0.3 s; each row is of all axes."""
    rng, axes = np.random.default_rng(seed), len(config.arm.axes)
    events = Events.empty(axes, count)
    events.time[:] = events.stamp[:] = np.cumsum(rng.choice([1, MS, 10 * MS, 28 * MS, 300 * MS], count))
    events.source[:] = rng.integers(COMMAND, len(config.sensors), count)
    scale = np.array([*(sensor.scale for sensor in config.sensors.values()), 1.0])[events.source]  # -1: the last
    events.value[:] = scale[:, None] * (START + rng.normal(0.0, 5e-3, (count, 1)))  # the same of every axis
    events.codes[:] = Outcome.FUSED
    return events._replace(spread=rng.uniform(0.5, 2.0, (count, 1)).repeat(axes, axis=1))


def run(config: FusionConfig, events: Events) -> tuple[FloatArray, Results, Filter]:
    """Outputs at each event, by what was known until then."""
    results, core = Results.room(*events.codes.shape), Filter(model_of(config), 0)
    return core.run(events, results, events.time), results, core


def test_what_a_measurement_does_not_see_keeps_its_bits() -> None:
    """A bias that nobody has measured, an offset that is known, an axis that is not in the row."""
    config = config_of(["turning", "lag"])
    events = any_events(config)
    events.codes[:, 0][events.source == 2] = ABSENT
    outputs, results, core = run(config, events)
    assert core.bias(2, 0) == (0.0, SENSORS["drifting"].bias_sd)
    assert core.bias(2, 1) != (0.0, SENSORS["drifting"].bias_sd)
    seen = events.codes[:, 0] == Outcome.FUSED
    alone, others, _ = run(config_of(["turning"]), events.columns([0]).rows(np.flatnonzero(seen)))
    np.testing.assert_array_equal(outputs[:, 0, seen], alone[:, 0])
    np.testing.assert_array_equal(others.innovation[:, 0], results.innovation[seen, 0])
    known = config_of(["turning"], process=Process(input_noise=1e-3, drift=0.0), offset_sd=0.0)
    outputs, _, _ = run(known, events.columns([0]))
    assert not outputs[Output.OFFSET].any() and (outputs[Output.OFFSET_SD] == FINEST).all()


@pytest.mark.parametrize("beside", [1, 13, 58])
@every_axis
def test_an_axis_beside_one_with_more_states_gives_the_same_bits(axis: str, beside: int) -> None:
    """Whatever size the core takes for the two: outputs, innovations and their derivatives."""
    plain = config_of([axis], {"plain": SENSORS["plain"]})
    many = {"plain": SENSORS["plain"]} | {f"s{n}": Sensor(sd=1e-3, bias_sd=1e-3, gate=0.0) for n in range(beside)}
    both = config_of([axis, "turning, rough" if axis != "turning, rough" else "lag"], many)
    wide, model = any_events(both, 60 + 6 * beside), model_of(both)
    model.view["bias_sd"][:, 0] = 0.0
    wide.codes[wide.source > 0, 0] = ABSENT
    mine = np.flatnonzero(wide.source <= 0)
    events, found = wide.rows(mine).columns([0]), Results.room(*wide.codes.shape)
    alone, results, _ = run(plain, events)
    np.testing.assert_array_equal(Filter(model, 0).run(wide, found, wide.time)[:, 0, mine], alone[:, 0])
    np.testing.assert_array_equal(found.innovation[mine, 0], results.innovation[:, 0])
    np.testing.assert_array_equal(found.innovation_sd[mine, 0], results.innovation_sd[:, 0])
    of_both = linearise(model, tangents(model), 0, wide, found)
    of_one = linearise(model_of(plain), tangents(model_of(plain)), 0, events, results)
    for one, other in zip(of_both, of_one, strict=True):
        np.testing.assert_array_equal(one[:, mine, 0], other[:, :, 0])
    assert all(one.any() for one in of_one[0])


def tangents(model: Model) -> list[Model]:
    """By the noise and the delay of the first axis, and by how well the first sensor sees it."""
    found = [Model(*map(np.zeros_like, model)) for _ in range(3)]
    found[0].axis["input_noise"][0] = found[1].axis["delay"][0] = found[2].view["sd"][0, 0] = 1.0
    return found


def test_more_states_than_the_core_is_made_for_are_refused() -> None:
    """64 are filtered, one more is one line that says which limit it is."""
    biased = {f"s{number}": Sensor(sd=1e-3, bias_sd=1e-3) for number in range(62)}
    most, more = (config_of(["lag"], dict(list(biased.items())[:count])) for count in (61, 62))
    outputs, _, core = run(most, any_events(most))
    assert np.isfinite(outputs).all()
    assert core.bias(60, 0) is not None
    with pytest.raises(PumafuseError, match=r"^the filter stops: an axis has more than 64 states"):
        Filter(model_of(more), 0)
    with pytest.raises(PumafuseError, match="more than 64 states"):
        linearise(model_of(more), [], 0, any_events(more), Results.room(80, 1))


def test_what_the_core_has_made_is_no_copys() -> None:
    """It would be freed twice."""
    arm = ArmModel(
        name="an arm", update_period=0.028, delay=0.0, axes={"x": AxisModel(plant=FirstOrder(time_constant=0.04))}
    )
    live = LiveEstimator(FusionConfig(arm=arm))
    for one in (live, live._window):  # pyright: ignore[reportPrivateUsage]
        with pytest.raises(TypeError, match="cannot be copied"):
            copy.deepcopy(one)

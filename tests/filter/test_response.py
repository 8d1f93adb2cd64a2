"""The position that a sequence of commands makes: superposed steps, the differential equation, and the edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from plants import PLANT
from pumafuse import AxisModel, FirstOrder, Gain, SecondOrder
from pumafuse.arrays import FloatArray, TimeArray
from pumafuse.filter.response import response
from pumafuse.model.plants import PLANTS

EPOCH = 1_790_000_000_000_000_000  # ns: stamps of a logger in 2026, too large for a float to hold
PERIOD, DELAY, START = 0.028, 0.06, 0.5
KNOWN: dict[str, PLANTS] = {
    "first order": FirstOrder(time_constant=0.0425),
    "under-damped": SecondOrder(natural_frequency=53.9, damping=0.2),
    "nearly critical": SecondOrder(natural_frequency=60.0, damping=1.0 + 1e-9),
    "over-damped": SecondOrder(natural_frequency=60.0, damping=2.5),
}
plants = pytest.mark.parametrize("plant", KNOWN.values(), ids=KNOWN)


def moved(plant: PLANTS, acting: TimeArray, value: FloatArray, time: TimeArray, gain: float = 1.0) -> FloatArray:
    """The response from a level of 0 to inputs that act at once."""
    return response(AxisModel(plant=plant, gain=Gain(intercept=gain)), PERIOD, 0.0, acting, value, 0.0, time)


def superposed(plant: PLANTS, acting: TimeArray, value: FloatArray, time: TimeArray) -> FloatArray:
    """Every change of the input as a step of its own, each from rest."""
    since = (time[:, None] - acting[None]) * 1e-9
    return plant.step_response(since) @ np.diff(value, prepend=0.0)


@settings(max_examples=40)
@given(PLANT, st.sampled_from([1.0, 0.9]), st.integers(0, 10**6), st.integers(0, 40), st.integers(0, 60))
def test_commands_superpose(plant: PLANTS, gain: float, seed: int, commands: int, times: int) -> None:
    """Any commands at irregular times, asked for at any times, also at one instant, in stamps of a real clock."""
    rng = np.random.default_rng(seed)
    acting = EPOCH + np.sort(rng.integers(0, 200, commands)) * 10**7
    time = EPOCH + np.sort(rng.integers(-10, 300, times)) * 10**7
    value = rng.normal(0.0, 0.01, commands)
    found = moved(plant, acting, value, time, gain)
    assert found.shape == (times,)
    np.testing.assert_allclose(found, gain * superposed(plant, acting, value, time), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("recovery", [None, 0.14, 1.0 / 60.0])
@plants
def test_it_settles_however_long_it_rests(plant: PLANTS, recovery: float | None) -> None:
    """An hour later it is where it was sent, to the last bits; where the gain does not recover, at K times that."""
    hour, axis = 3600 * 10**9, AxisModel(plant=plant, gain=Gain(intercept=0.9), gain_recovery=recovery)
    given, command = np.array([0, hour]), np.array([0.56, 0.57])
    found = response(axis, PERIOD, DELAY, given, command, 0.0, np.array([hour, 2 * hour]))
    np.testing.assert_allclose(found, command * (0.9 if recovery is None else 1.0), rtol=1e-14)


@pytest.mark.parametrize("recovery", [None, 0.14])
@plants
def test_the_lag_is_how_far_a_ramp_is_behind(plant: PLANTS, recovery: float | None) -> None:
    """Settled on a staircase of constant velocity, over a tick: v·lag behind what is held, T/2 more behind v·t.

    Without recovery the motion itself is K times as large; then K is 1 here.
    """
    speed, ticks, fine = 0.2, 400, 4000
    gain = Gain(slope=0.3, intercept=0.9) if recovery is not None else Gain()
    axis = AxisModel(plant=plant, gain=gain, gain_recovery=recovery)
    given = np.arange(ticks) * 28_000_000
    command = speed * given * 1e-9
    time = given[-1] + (np.arange(fine) * 28_000_000 + 14_000_000) // fine  # the last tick, at its fine midpoints
    position = response(axis, PERIOD, DELAY, given, command, 0.0, time)
    held, path = command[-1], speed * time * 1e-9
    arm = pf.ArmModel(name="one", update_period=PERIOD, delay=DELAY, axes={"radial": axis})
    lag = arm.lag_of("radial", speed)
    assert np.mean(held - position) == pytest.approx(speed * lag, rel=1e-6)
    assert np.mean(path - position) == pytest.approx(speed * (lag + 0.5 * PERIOD), rel=1e-6)


@plants
def test_the_filter_predicts_the_same(plant: PLANTS) -> None:
    """Without measurements the estimates are the response, from the start level on."""
    axis = AxisModel(plant=plant, gain=Gain(slope=0.1, intercept=0.9), gain_recovery=0.14)
    rng, given = np.random.default_rng(2), np.arange(50) * 28_000_000
    command = START + rng.normal(0.0, 0.01, 50)
    arm = pf.ArmModel(name="one", update_period=PERIOD, delay=DELAY, axes={"radial": axis})
    run = pf.Run.from_arrays(given, {"radial": command}, start={"radial": START})
    estimates = pf.fuse(run, pf.FusionConfig(arm=arm), rate=100.0)
    time = np.rint(estimates.time * 1e9).astype(np.int64)
    expected = START + response(axis, PERIOD, DELAY, given, command, START, time)
    np.testing.assert_allclose(estimates["radial"].position, expected, rtol=0.0, atol=1e-14)

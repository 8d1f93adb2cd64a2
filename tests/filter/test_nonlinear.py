"""Axes with a fastest speed, play and sag: an ODE solver that knows no piece of the path, and what must always hold."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import pumafuse as pf
from plants import PLANT
from pumafuse import AxisModel, FirstOrder, Gain, Sag, SecondOrder
from pumafuse.arrays import FloatArray, TimeArray
from pumafuse.filter.response import at_rest, follow, record_of, response
from pumafuse.fusion.engine import innovation_derivatives, innovations
from pumafuse.fusion.segments import build_segment
from pumafuse.model.plants import PLANTS

MS = 1_000_000  # ns
PERIOD, DELAY, START = 0.028, 0.06, 0.5
PAPER = Gain(slope=0.1, intercept=0.9)
CURVE = Sag(offset=0.002, slope=-0.05, knee=0.47, slope_beyond=0.1, knee_below=0.45, slope_below=-0.4)
changed = msgspec.structs.replace
KNOWN: dict[str, PLANTS] = {
    "first order": FirstOrder(time_constant=0.0425),
    "swinging": SecondOrder(natural_frequency=30.0, damping=0.1),
    "under-damped": SecondOrder(natural_frequency=100.0, damping=0.5),
    "critical": SecondOrder(natural_frequency=5.0, damping=1.0),
    "over-damped": SecondOrder(natural_frequency=60.0, damping=3.0),
}
RECOVERY = st.sampled_from([None, 0.004, 0.03, 0.3])
SPEED, PLAY = st.sampled_from([0.02, 0.2, 2.0]), st.sampled_from([1e-4, 3e-3, 0.05])


def random_walk(seed: int, commands: int = 30, step: float = 0.02) -> tuple[TimeArray, FloatArray]:
    """Commands at irregular instants, with pauses."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.integers(2, 200, commands)) * MS, START + np.cumsum(rng.normal(0.0, step, commands))


def moved(axis: AxisModel, given: TimeArray, command: FloatArray, time: TimeArray) -> FloatArray:
    return response(axis, PERIOD, DELAY, given, command, START, time)


def solved(axis: AxisModel, given: TimeArray, command: FloatArray, time: TimeArray) -> FloatArray:
    """A Runge-Kutta method over the equations, command by command; the tool is pushed to where the drive turns."""
    plant, fastest, half = axis.plant, axis.max_speed or np.inf, 0.5 * (axis.play or 0.0)
    first, lag = isinstance(plant, FirstOrder), plant.lag
    follows, shortest = (0.0, lag) if isinstance(plant, FirstOrder) else (2.0 / lag, 1.0 / plant.natural_frequency)
    if isinstance(plant, SecondOrder):
        follows = 2.0 * plant.damping * plant.natural_frequency
    decay = 0.0 if axis.gain_recovery is None else 1.0 / axis.gain_recovery
    acting, state, error, u, tool = given + round(DELAY * 1e9), np.zeros(1 if first else 2), 0.0, 0.0, 0.0
    found = np.zeros(len(time))
    for k, begin in enumerate(acting):
        step, u = command[k] - START - u, command[k] - START
        error += (axis.gain.slope * abs(step) / PERIOD + axis.gain.intercept - 1.0) * step
        end = acting[k + 1] if k + 1 < len(acting) else time[-1] + 1
        here = np.flatnonzero((time >= begin) & (time < end))
        asked, last = (time[here] - begin) * 1e-9, (end - begin) * 1e-9

        def wanted(t: float, x: FloatArray, u: float = u, e: float = error) -> float:
            return float(np.clip((u + e * np.exp(-decay * t) - x[0]) / lag, -fastest, fastest))

        path = solve_ivp(
            lambda t, x: [wanted(t, x)] if first else [x[1], follows * (wanted(t, x) - x[1])],
            (0.0, last), state, "DOP853", dense_output=True, rtol=1e-11, atol=1e-13, max_step=0.2 * min(lag, shortest),
            events=lambda t, x: wanted(t, x) if first else x[1],
        )  # fmt: skip
        instants = np.unique(np.concatenate([path.t_events[0], asked, [last]]))
        tools = []
        for x in path.sol(instants)[0]:
            tool = min(max(tool, x - half), x + half)
            tools.append(tool)
        found[here] = np.array(tools)[np.searchsorted(instants, asked)]
        state, error = path.y[:, -1], error * np.exp(-decay * last)
    return found


@pytest.mark.parametrize("plant", [KNOWN["first order"], KNOWN["under-damped"]], ids=["first order", "under-damped"])
def test_the_differential_equation_is_solved(plant: PLANTS) -> None:
    """Linear, with a limit, with play, with both: to 1e-9, in motions that saturate, swing, turn and rest."""
    rng = np.random.default_rng(3)
    cases = [
        (0.004, {"max_speed": 0.2}),
        (0.1, {"play": 0.01}),
        (None, {"max_speed": 0.5, "play": 0.05}),
        (None, {}),
        (0.0425, {}),
    ]
    for seed, (recovery, bends) in enumerate(cases):
        given, command = random_walk(seed, 8, 0.1)
        time = np.sort(rng.integers(0, int(given[-1]) + 500 * MS, 60))
        axis = AxisModel(plant=plant, gain=PAPER, gain_recovery=recovery, **bends)
        found, free = (
            moved(axis, given, command, time),
            moved(changed(axis, max_speed=None, play=None), given, command, time),
        )
        np.testing.assert_allclose(found, solved(axis, given, command, time), rtol=0.0, atol=1e-9)
        assert (np.abs(found - free).max() > 1e-3) == bool(bends)


@settings(max_examples=40)
@given(PLANT, RECOVERY, st.integers(0, 10**6))
def test_what_is_never_reached_changes_no_bit(plant: PLANTS, recovery: float | None, seed: int) -> None:
    """No play, a speed that nothing asks for, and a load that weighs nothing: the linear response to the bit."""
    given, command = random_walk(seed)
    time = np.sort(np.random.default_rng(seed).integers(0, int(given[-1]) + 2000 * MS, 50))
    linear = AxisModel(plant=plant, gain=PAPER, gain_recovery=recovery)
    found = moved(changed(linear, max_speed=1e9, play=0.0, sag=Sag()), given, command, time)
    np.testing.assert_array_equal(found, moved(linear, given, command, time))


@pytest.mark.parametrize(
    ("plant", "recovery", "play", "steps", "ms"),
    [
        (SecondOrder(natural_frequency=26.8, damping=0.96), 0.3, 2.5e-5, {0: 0.118}, 285),
        (SecondOrder(natural_frequency=439.6, damping=1.105), 0.3, 5.97e-4, {0: 0.0339, 106: 0.0376}, 284),
        (FirstOrder(time_constant=0.0051), 0.0051, 3.23e-4, {0: -0.069}, 444),
        (FirstOrder(time_constant=0.0022), 0.0053, 2.78e-4, {0: -0.04}, 377),
    ],
)
def test_a_command_again_changes_nothing(
    plant: PLANTS, recovery: float, play: float, steps: dict[int, float], ms: int
) -> None:
    """Steps that turn, and fade until little but rounding is left: in one move each as in hundreds."""
    axis = AxisModel(plant=plant, gain=PAPER, gain_recovery=recovery, play=play)
    given, command = np.array([*steps]), START + np.cumsum([*steps.values()])
    again, time = np.arange(ms), np.array([ms]) * MS + round(DELAY * 1e9)
    held = command[np.searchsorted(given, again, side="right") - 1]
    at_once = moved(axis, given * MS, command, time)
    np.testing.assert_allclose(at_once, moved(axis, again * MS, held, time), rtol=0.0, atol=1e-12)


@settings(max_examples=40)
@given(PLANT, RECOVERY, SPEED, PLAY, st.integers(0, 10**6))
def test_no_limit_is_exceeded(plant: PLANTS, recovery: float | None, fastest: float, play: float, seed: int) -> None:
    """From one instant to the next the drive goes as fast as it can at most, and the tool stays within the play."""
    given, command = random_walk(seed, step=0.05)
    time = np.arange(0, int(given[-1]) + 500 * MS, 3 * MS)
    axis = AxisModel(plant=plant, gain=PAPER, gain_recovery=recovery, max_speed=fastest)
    drive, tool = (moved(changed(axis, play=width), given, command, time) for width in (0.0, play))
    assert np.abs(np.diff(drive)).max() <= fastest * 3e-3 * (1.0 + 1e-9)
    assert np.abs(np.diff(tool)).max() <= fastest * 3e-3 * (1.0 + 1e-9)
    assert np.abs(tool - drive).max() <= 0.5 * play + 1e-12


@pytest.mark.parametrize("recovery", [None, 0.14])
@pytest.mark.parametrize("plant", [KNOWN["first order"], KNOWN["over-damped"]], ids=["first order", "over-damped"])
def test_it_settles_however_long_it_rests(plant: PLANTS, recovery: float | None) -> None:
    """An hour later the drive is where it was sent, and the tool behind it by half the play or by where it swung."""
    hour = 3600 * 10**9
    axis = AxisModel(plant=plant, gain_recovery=recovery, max_speed=0.05, play=0.01)
    found = moved(axis, np.array([0, hour]), np.array([0.56, 0.53]), np.array([hour, 2 * hour])) + START
    assert np.abs(found - (0.56, 0.53)).max() <= 0.005 + 1e-12
    if plant is not KNOWN["swinging"] and plant is not KNOWN["under-damped"]:
        np.testing.assert_allclose(found, (0.555, 0.535), rtol=0.0, atol=1e-12)


def test_a_load_holds_the_tool_off_by_where_it_is() -> None:
    """A line in three pieces of the position as commanded, added to the response, also at rest before any command."""
    given, command = random_walk(1)
    time = np.arange(0, int(given[-1]), 7 * MS)
    axis = AxisModel(plant=KNOWN["critical"], gain=PAPER, play=0.003, max_speed=0.3)
    straight = moved(axis, given, command, time)
    expected = straight + CURVE.at(START + straight)
    np.testing.assert_allclose(moved(changed(axis, sag=CURVE), given, command, time), expected, rtol=0.0, atol=1e-15)
    p = START + straight
    middle = np.clip(p, 0.45, 0.47)
    by_hand = 0.002 - 0.05 * middle + 0.1 * np.maximum(p - 0.47, 0.0) - 0.4 * np.minimum(p - 0.45, 0.0)
    np.testing.assert_allclose(CURVE.at(p), by_hand, rtol=0.0, atol=1e-15)
    assert (p < 0.45).any() and (p == middle).any() and (p > 0.47).any()


@settings(max_examples=30)
@given(PLANT, RECOVERY, st.none() | SPEED, st.none() | PLAY, st.sampled_from([None, CURVE]), st.integers(0, 10**6))
def test_followed_in_pieces_it_is_the_same_to_the_bit(
    plant: PLANTS, recovery: float | None, fastest: float | None, play: float | None, sag: Sag | None, seed: int
) -> None:
    """Each position alone, by commands that come in pieces, is that of all at once; to rounding it is the response."""
    rng, (given, command) = np.random.default_rng(seed), random_walk(seed)
    time = np.sort(rng.integers(0, int(given[-1]) + 500 * MS, 20))
    axis = AxisModel(plant=plant, gain=PAPER, gain_recovery=recovery, max_speed=fastest, play=play, sag=sag)
    record, value, nothing = record_of(axis, PERIOD, DELAY, 0.0), command - START, np.empty(0)
    found = follow(record, at_rest(), given, value, time)
    rounding = 1e-12 if fastest or play else 1e-14
    np.testing.assert_allclose(found, response(axis, PERIOD, DELAY, given, value, 0.0, time), rtol=0.0, atol=rounding)
    for place, end in enumerate(np.searchsorted(given + round(DELAY * 1e9), time, side="right").tolist()):
        motion, cut = at_rest(), int(rng.integers(0, end + 1))
        for part in (slice(0, cut), slice(cut, end)):
            follow(record, motion, given[part], value[part], nothing.astype(np.int64))
        assert follow(record, motion, given[:0], nothing, time[place : place + 1])[0] == found[place]


LOWER = changed(CURVE, knee=0.4, knee_below=0.35)  # of a walk that goes down
BENDS: dict[str, Any] = {"max_speed": 0.31, "play": 0.0021, "sag": LOWER}


@pytest.mark.parametrize("plant", [KNOWN["first order"], KNOWN["under-damped"]], ids=["first order", "under-damped"])
def test_derivatives_are_those_of_the_innovations(plant: PLANTS) -> None:
    """By fastest speed, play, delay, gain and sag: central differences, but for a few rows that have a kink between."""
    given, command = random_walk(5, 60, 0.02)
    valid = np.sort(np.random.default_rng(5).integers(0, int(given[-1]), 400))
    axis = AxisModel(plant=plant, gain=PAPER, gain_recovery=0.1, **BENDS)
    run = pf.Run.from_arrays(given, {"x": command}, {"camera": (valid, {"x": np.full(400, START)})})
    arm = pf.ArmModel(name="one", update_period=PERIOD, delay=DELAY, axes={"x": axis})
    config = pf.FusionConfig(arm=arm, process={"x": pf.Process(drift=1e-3)}, sensors={"camera": pf.Sensor(sd=1e-3)})
    segment = build_segment(run, config)
    outcome = np.zeros_like(segment.measurement_rows.codes)

    def with_axis(**fields: Any) -> pf.FusionConfig:
        return changed(config, arm=changed(arm, axes={"x": changed(axis, **fields)}))

    steps = {"max_speed": 1e-6, "play": 1e-8, "delay": 1e-6}
    beside = [
        (with_axis(**{key: at - step}), with_axis(**{key: at + step}), 2.0 * step)
        for key, step in steps.items()
        for at in [DELAY if key == "delay" else BENDS[key]]
    ]
    gains = (changed(PAPER, intercept=0.9 + sign * 1e-6) for sign in (-1, 1))
    beside += [(*(with_axis(gain=one) for one in gains), 2e-6)]
    for key in ("slope", "knee", "slope_beyond", "knee_below", "slope_below"):
        sags = (changed(LOWER, **{key: getattr(LOWER, key) + sign * 1e-6}) for sign in (-1, 1))
        beside.append((*(with_axis(sag=one) for one in sags), 2e-6))
    _, d_nu, _ = innovation_derivatives(segment, config, outcome, [(high, 0.5 * width) for _, high, width in beside])
    fused = segment.measurement_rows.codes[:, 0] == pf.Outcome.FUSED
    for found, (low, high, width) in zip(d_nu[:, fused, 0], beside, strict=True):
        down, up = (innovations(segment, one, outcome).innovation[fused, 0] for one in (low, high))
        wanted = (up - down) / width
        off = np.abs(found - wanted) > 1e-5 * np.abs(wanted).max()
        assert np.abs(wanted).max() > 0.01
        assert off.mean() < 0.05

"""The true arm's motion against matrix exponentials and quadratures that share nothing with it.

Noise is compared with its covariance ∫ q(s) g(t − s) g(t' − s) ds, where g(t) = C e^(At) B, by Gauss-Legendre
quadrature. The motion is linear in the numbers it draws, so its covariance is found exactly by drawing each number in
turn as 1.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

import pumafuse as pf
from draws import OneDraw
from pumafuse.filter.response import response
from pumafuse.fusion.config import Process
from pumafuse.model.arm import AxisModel, Gain, Sag
from pumafuse.model.plants import FirstOrder, SecondOrder
from pumafuse.simulation import reverting
from pumafuse.simulation.motion import POINTS, Motion, grid, simulate_axis
from pumafuse.simulation.true_arm import GainCurve, TrueArm, TrueAxis
from pumafuse.simulation.true_sensor import TrueSensor, measure

Floats = NDArray[np.float64]
PERIOD = 0.028
QUIET = Process(input_noise=0.0, drift=0.0)
FIRST = FirstOrder(time_constant=0.0425)
WEAK = SecondOrder(natural_frequency=40.0, damping=0.2)
CRITICAL = SecondOrder(natural_frequency=53.9, damping=1.0)
STRONG = SecondOrder(natural_frequency=53.9, damping=3.0)
PLANTS = pytest.mark.parametrize("plant", [FIRST, WEAK, CRITICAL, STRONG], ids=["first", "weak", "critical", "strong"])


def true_axis(plant: FirstOrder | SecondOrder, **different: Any) -> TrueAxis:
    return TrueAxis(**({"plant": plant, "gain": Gain(), "gain_recovery": None, "delay": 0.0} | different))


def ticks(count: int) -> NDArray[np.int64]:
    return np.rint(np.arange(count) * PERIOD * 1e9).astype(np.int64)


def near(seconds: Any) -> NDArray[np.int64]:
    """The instants of the grid nearest to ``seconds``."""
    number = np.rint(np.asarray(seconds, dtype=np.float64) / (PERIOD / POINTS))
    return np.unique(np.rint(number * (PERIOD * 1e9 / POINTS)).astype(np.int64))


def motion(
    axis: TrueAxis,
    command: Sequence[float] | Floats,
    process: Process = QUIET,
    offset_sd: float = 0.0,
    rng: Any = 0,
) -> Motion:
    u = np.asarray(command, dtype=np.float64)
    generator = np.random.default_rng(rng) if isinstance(rng, int) else rng
    return simulate_axis(axis, process, offset_sd, ticks(len(u)), u, PERIOD, generator)


def state_space(axis: TrueAxis) -> tuple[Floats, Floats, Floats]:
    """A, B and C of the plant and, in series, of the extra lag, written down from their differential equations."""
    if isinstance(axis.plant, FirstOrder):
        A, B = np.array([[-1.0 / axis.plant.time_constant]]), np.array([1.0 / axis.plant.time_constant])
    else:
        w, z = axis.plant.natural_frequency, axis.plant.damping
        A, B = np.array([[0.0, 1.0], [-w * w, -2.0 * z * w]]), np.array([0.0, w * w])
    C = np.eye(len(A))[0]
    if axis.extra_pole is not None:
        n = len(A)
        A = np.block([[A, np.zeros((n, 1))], [C[None, :] / axis.extra_pole, np.array([[-1.0 / axis.extra_pole]])]])
        B, C = np.append(B, 0.0), np.eye(n + 1)[n]
    return A, B, C


def with_gain_error(axis: TrueAxis) -> tuple[Floats, Floats, Floats]:
    """A, B and C with the gain error as one more state: ė = −e / recovery, and e is added to the plant's input."""
    A, B, C = state_space(axis)
    decay = 0.0 if axis.gain_recovery is None else -1.0 / axis.gain_recovery
    whole = np.block([[A, B[:, None]], [np.zeros((1, len(B))), np.array([[decay]])]])
    return whole, np.append(B, 0.0), np.append(C, 0.0)


def jumps(axis: TrueAxis, command: Floats) -> Floats:
    """(K(speed) − 1)(u_n − u_(n−1)) of each command."""
    step = np.diff(command, prepend=0.0)
    return (axis.gain.slope * np.abs(step) / PERIOD + axis.gain.intercept - 1.0) * step


def random_walk(count: int, size: float = 0.004, seed: int = 5) -> Floats:
    """Commands that wander, with rests between, the first of them not zero."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, size, count) * (rng.random(count) < 0.6)
    steps[0] = 0.003
    return np.cumsum(steps)


GAIN = Gain(slope=0.134, intercept=0.941)


def exact(axis: TrueAxis, level: Floats, jump: Floats, acting: Floats, wanted: Floats) -> Floats:
    """Positions at ``wanted`` [s] by matrix exponentials, from command to command and from there to each instant."""
    A, B, C = with_gain_error(axis)
    held = np.block([[A, B[:, None]], [np.zeros((1, len(B) + 1))]])
    states, x = [np.zeros(len(held))], np.zeros(len(held))
    for u, more, hold in zip(level, jump, np.diff(acting, append=acting[-1]), strict=True):
        states.append(np.append(x[:-1] + np.eye(len(B))[-1] * more, u))
        x = expm(held * hold) @ states[-1]
    entry = np.searchsorted(acting, wanted, side="right")
    since = wanted - np.append(0.0, acting)[entry]
    return np.einsum("j,njk,nk->n", C, expm(held * since[:, None, None])[:, :-1], np.array(states)[entry])


def off_exact(
    axis: TrueAxis, command: Floats, level: Floats | None = None, jump: Floats | None = None, stride: int = 17
) -> float:
    """How far a motion is from the plant's exact answer to ``level`` + e, one delay late, over its largest command."""
    found, level = motion(axis, command), command if level is None else level
    jump = jumps(axis, command) if jump is None else jump
    acting = ticks(len(command)) / 1e9 + round(axis.delay * 1e9) / 1e9
    expected = exact(axis, level, jump, acting, found.time[::stride] / 1e9)
    assert expected.any()  # something moves
    return float(np.abs(found.position[::stride] - expected).max() / np.abs(command).max())


LAGS = st.one_of(st.none(), st.floats(0.002, 0.2))


@settings(max_examples=30)
@given(w=st.floats(5.0, 300.0), z=st.floats(0.05, 5.0), lag=LAGS, delay=st.floats(0.0, 0.2), recovery=LAGS)
def test_any_linear_axis_follows_its_differential_equation(
    w: float, z: float, lag: float | None, delay: float, recovery: float | None
) -> None:
    """Natural frequency, damping, extra lag, delay and recovery of any size agree with matrix exponentials to 1e-9."""
    plant = SecondOrder(natural_frequency=w, damping=z)
    axis = true_axis(plant, extra_pole=lag, delay=delay, gain=GAIN, gain_recovery=recovery)
    assert off_exact(axis, random_walk(25)) <= 1e-9


NEAR_CRITICAL = [1.0 + sign * 10.0**-power for power in (6, 8, 9, 9.5, 10, 11, 12, 15.5) for sign in (-1, 1)]


@pytest.mark.parametrize("damping", [1.0, *NEAR_CRITICAL[::3]], ids=lambda damping: f"{damping - 1.0:.1e}")
@pytest.mark.parametrize(("lag", "rel"), [(None, 5e-10), (1.0 / 53.9, 1e-7)], ids=["two", "three"])
def test_poles_that_come_together_are_a_limit_and_not_a_cliff(lag: float | None, rel: float, damping: float) -> None:
    """Around critical damping, from either side, two poles agree with matrix exponentials to 5e-10, three to 1e-7."""
    plant = SecondOrder(natural_frequency=53.9, damping=damping)
    axis = true_axis(plant, extra_pole=lag, gain=GAIN, gain_recovery=1.0 / 53.9)
    assert off_exact(axis, random_walk(25)) <= rel


def test_each_command_has_a_delay_and_its_gain_error_decays_from_when_it_acts() -> None:
    """A command that is late by chance adds its error late; between two that act e has had just that time to decay."""
    axis = true_axis(FIRST, delay=0.0604, delay_jitter=0.01, gain=GAIN, gain_recovery=0.03)
    command, number = random_walk(40), 10
    acting = ticks(40) / 1e9 + 0.0604
    acting[number] += 0.01
    found = motion(axis, command, rng=OneDraw(number))
    expected = exact(axis, command, jumps(axis, command), acting, found.time / 1e9)
    assert np.abs(found.position - expected).max() <= 1e-9 * np.abs(command).max()


def test_a_gain_curve_is_linear_between_its_points_and_level_outside() -> None:
    """And it replaces the gain's line."""
    curve = GainCurve(speed=[0.02, 0.05, 0.3], gain=[0.9, 1.1, 1.05])
    command = np.cumsum(np.random.default_rng(6).choice([0.0003, 0.001, 0.005, 0.012], 40))
    step = np.diff(command, prepend=0.0)
    speeds = step / PERIOD
    assert (speeds < 0.02).any() and (speeds > 0.3).any() and ((speeds > 0.02) & (speeds < 0.05)).any()
    axis = true_axis(STRONG, gain=Gain(intercept=7.0), gain_curve=curve, gain_recovery=0.1)
    expected = (np.interp(speeds, curve.speed, curve.gain) - 1.0) * step
    assert off_exact(axis, command, jump=expected) <= 1e-9


def test_stiction_acts_on_what_the_gain_has_made_of_the_command() -> None:
    """A sticking drive decides by u + e when a command acts, and holds that; recovery alone can set it free."""
    axis = true_axis(FIRST, gain=Gain(slope=0.1, intercept=0.9), gain_recovery=0.1, stiction=0.0008)
    command, e, held, levels = random_walk(40, size=0.002), 0.0, 0.0, []
    for u, jump in zip(command.tolist(), jumps(axis, command).tolist(), strict=True):
        e = e * np.exp(-PERIOD / 0.1) + jump
        held = u + e if abs(u + e - held) > 0.0008 else held
        levels.append(held)
    assert 4 < len(set(levels)) < 30
    assert off_exact(axis, command, np.array(levels), np.zeros(40)) <= 1e-9


def play(position: Floats, width: float) -> Floats:
    """The play operator, one instant after the other: the tool is pushed only at the edges of the gap."""
    found, tool = [], float(position[0])
    for x in position.tolist():
        if x > tool + 0.5 * width:
            tool = x - 0.5 * width
        elif x < tool - 0.5 * width:
            tool = x + 0.5 * width
        found.append(tool)
    return np.array(found)


@pytest.mark.parametrize(("width", "noise"), [(0.002, 0.0), (0.0006, 0.0005)])
def test_backlash_is_the_play_operator(width: float, noise: float) -> None:
    """The tool is where a plain loop over the motion's instants pushes it, noise included, to 1e-12 of the command."""
    command, process = random_walk(40), Process(input_noise=noise, drift=0.0)
    plain, loose = (motion(true_axis(WEAK, delay=0.03, backlash=gap), command, process) for gap in (0.0, width))
    assert (plain.time == loose.time).all()
    assert np.abs(loose.position - play(plain.position, width)).max() <= 1e-12 * np.abs(command).max()


@pytest.mark.parametrize(("plant", "recovery"), [(FIRST, 0.1), (WEAK, None)], ids=["first order", "second order"])
def test_a_limited_drive_and_a_load_are_the_responses(plant: FirstOrder | SecondOrder, recovery: float | None) -> None:
    """A fastest speed, play and sag without noise: what the core's closed forms say, to 1e-6 of a metre of motion.

    The drive is to 1e-9; play is followed from event to event.
    """
    command, sag = 20.0 * random_walk(40), Sag(offset=0.002, slope=-0.05, knee=0.01, slope_beyond=0.1)
    gain, speed = Gain(slope=0.05, intercept=0.9), {"max_speed": 0.3}
    for bends, within in ((speed, 1e-8), (speed | {"play": 0.002, "sag": sag}, 2e-6)):
        model = AxisModel(plant=plant, gain=gain, gain_recovery=recovery, **bends)
        true = TrueArm().over(model, 0.03, "true_arm")
        found = simulate_axis(true, QUIET, 0.0, ticks(40), command, PERIOD, np.random.default_rng(1), start=0.5)
        expected = response(model, PERIOD, 0.03, ticks(40), 0.5 + command, 0.5, found.time)
        assert np.abs(found.position - expected).max() < within
        linear = response(AxisModel(plant=plant, gain=gain), PERIOD, 0.03, ticks(40), command, 0.0, found.time)
        assert np.abs(linear - expected).max() > 0.01


def test_slow_drift_is_a_sine_on_the_position() -> None:
    """A sin(2πt/P) from the first command on, whatever the plant does."""
    command, wanted = random_walk(40), grid(40, PERIOD)
    still, drifting = true_axis(FIRST), true_axis(FIRST, slow_drift=0.0007, slow_drift_period=0.9)
    difference = motion(drifting, command).at(wanted) - motion(still, command).at(wanted)
    assert difference == pytest.approx(0.0007 * np.sin(2.0 * np.pi * wanted / 1e9 / 0.9), abs=1e-14)


def test_commands_with_jittering_delays_do_not_overtake_one_another() -> None:
    """Even where the jitter is far beyond T the last command is where the arm ends, and a ramp never goes back."""
    axis = true_axis(FIRST, delay=0.05, delay_jitter=0.2)
    command = np.minimum(np.arange(1, 181), 60) * 0.001
    position = motion(axis, command, rng=0).position
    assert np.diff(position).min() >= -1e-15
    assert position[-1] == pytest.approx(0.060, rel=1e-9)


@pytest.mark.parametrize("fastest", [None, 0.0004])
def test_a_motion_is_known_on_the_whole_grid(fastest: float | None) -> None:
    """60 even instants a period, to the ns, from the first command to a period after the last, however fast the arm."""
    axis, asked = true_axis(WEAK, delay=0.0123, extra_pole=fastest), grid(7, PERIOD)
    assert len(asked) == 7 * 60 + 1 and (asked[0], asked[-1]) == (0, 196_000_000)
    assert np.abs(asked - np.linspace(0.0, 196e6, 421)).max() <= 0.5
    assert np.isin(asked, motion(axis, np.zeros(7)).time).all()


def covariance(axis: TrueAxis, q: Sequence[float], changes: Sequence[float], wanted: Floats) -> Floats:
    """∫ q(s) g(t − s) g(t' − s) ds by quadrature over pieces of constant q, 24 nodes on each millisecond or less."""
    A, B, C = state_space(axis)
    node, weight = np.polynomial.legendre.leggauss(24)
    edges = np.unique(np.concatenate(([0.0], changes, wanted, np.arange(0.0, float(wanted[-1]), 0.02))))
    edges = edges[edges <= wanted[-1]]
    found = np.zeros((len(wanted), len(wanted)))
    for start, end in itertools.pairwise(edges):
        density = q[int(np.searchsorted(changes, start, side="right"))]
        at = start + 0.5 * (node + 1.0) * (end - start)
        g = np.array([[C @ expm(A * (t - s)) @ B if t >= end else 0.0 for s in at] for t in wanted])
        found += density * 0.5 * (end - start) * (g * weight) @ g.T
    return found


def drawn_covariance(
    axis: TrueAxis, command: Sequence[float], wanted: NDArray[np.int64], process: Process, offset_sd: float = 0.0
) -> Floats:
    """L Lᵀ, the motion being its mean + L times the numbers it draws."""
    counter = OneDraw(-1)
    mean = motion(axis, command, process, offset_sd, counter).at(wanted)
    columns = [
        motion(axis, command, process, offset_sd, OneDraw(number)).at(wanted) - mean
        for number in range(-1 - counter.left)
    ]
    L = np.array(columns).T
    return L @ L.T


FEW = near([0.0052, 0.0131, 0.0135, 0.04, 0.055])
RISING = [0.014, 0.056]  # changes of speed by 0.5 and 1.0 m/s


@PLANTS
@pytest.mark.parametrize("lag", [0.02, *(pytest.param(lag, marks=pytest.mark.long) for lag in (None, 0.0021))])
def test_noise_has_exactly_the_covariance_of_its_impulse_response(
    plant: FirstOrder | SecondOrder, lag: float | None
) -> None:
    """Q = input² + (maneuver_noise · m)² of the command that acts: to 1e-10 of the variance, 4e-9 for equal poles."""
    process = Process(input_noise=4.0, drift=0.0, maneuver_noise=7.0)  # so large that the mean costs no digits
    delay, axis = 0.0061, true_axis(plant, extra_pole=lag, delay=0.0061)
    q = [4.0**2, *(4.0**2 + (7.0 * m) ** 2 for m in (0.5, 1.0))]
    expected = covariance(axis, q, [delay, delay + PERIOD], FEW / 1e9)
    found = drawn_covariance(axis, RISING, FEW, process)
    assert np.abs(found - expected).max() <= (4e-9 if plant is CRITICAL else 1e-10) * expected.max()


def test_the_offset_has_exactly_the_covariance_of_its_walk() -> None:
    """offset_sd² + ∫ drift² + (maneuver_drift · m)² up to the earlier of two instants, to 1e-12."""
    process = Process(input_noise=0.0, drift=0.0003, maneuver_drift=0.0008)
    delay, at = 0.0061, FEW / 1e9
    parts = [(0.0, delay, 0.0), (delay, delay + PERIOD, 0.5), (delay + PERIOD, 9.0, 1.0)]
    walked = sum((0.0003**2 + (0.0008 * m) ** 2) * np.clip(at - start, 0.0, end - start) for start, end, m in parts)
    found = drawn_covariance(true_axis(WEAK, delay=delay), RISING, FEW, process, 0.002)
    assert found == pytest.approx(0.002**2 + np.minimum.outer(walked, walked), rel=1e-12)


def test_kinds_of_noise_draw_from_streams_of_their_own() -> None:
    """The offset is the same with and without input noise and jitter: what one adds, another does not change."""
    command, wanted = np.zeros(20), grid(20, PERIOD)

    def found(process: Process, offset_sd: float, jitter: float) -> Floats:
        return motion(true_axis(FIRST, delay_jitter=jitter), command, process, offset_sd, rng=9).at(wanted)

    alone = found(Process(input_noise=0.0, drift=0.001), 0.0, 0.0)
    noise = found(Process(input_noise=0.001, drift=0.0), 0.0, 0.0)
    start = found(QUIET, 0.003, 0.0)
    together = found(Process(input_noise=0.001, drift=0.001), 0.003, 0.0)
    assert together == pytest.approx(alone + noise + start, abs=1e-15)


SD = 0.7
#: Instants [ns] with equal, tiny (1 ns), zero and long gaps.
TIMES = np.cumsum([5, 20_000_000, 20_000_000, 1, 0, 3_000, 470_000, 900_000_000, 20_000_000, 40_000_000_000])
ARM = pf.ArmModel.load("puma560-internal")
RADIAL = ARM.axis("radial")
AXIS = TrueAxis(plant=RADIAL.plant, gain=RADIAL.gain, gain_recovery=RADIAL.gain_recovery, delay=ARM.delay)


def matern(apart: Floats, length: float) -> Floats:
    rate = np.sqrt(3.0) / length
    return SD**2 * (1.0 + rate * apart) * np.exp(-rate * apart)


def ornstein_uhlenbeck(apart: Floats, length: float) -> Floats:
    return SD**2 * np.exp(-apart / length)


@pytest.mark.parametrize("length", [0.002, 1e4])
@pytest.mark.parametrize(
    ("process", "expected"),
    [(reverting.smooth, matern), (reverting.rough, ornstein_uhlenbeck)],
    ids=["smooth", "rough"],
)
def test_a_process_has_exactly_its_covariance_function(process: Any, expected: Any, length: float) -> None:
    """L Lᵀ to 1e-12 of the variance, L being what each number drawn does: from the first instant on, however far apart.

    Over a gap of 1 ns a process of smoothness 3/2 differs by less than that: that its increments are right to 1e-6 of
    their own variance is asked apart.
    """
    L = np.array([process(TIMES, SD, length, OneDraw(number)) for number in range(2 * len(TIMES))]).T
    apart = np.abs(TIMES[:, None] - TIMES[None, :]) / 1e9
    assert pytest.approx(expected(apart, length), abs=1e-12 * SD**2) == L @ L.T
    grown, gap = np.square(np.diff(L, axis=0)).sum(axis=1), np.diff(TIMES) / 1e9
    rate = np.sqrt(3.0) / length  # the variance of an increment: (λ σ Δ)² (1 − ⅔ λΔ …), or 2 σ² (1 − e^(−λΔ))
    if process is reverting.smooth:
        short = rate * gap < 1e-4
        assert grown[short] == pytest.approx((rate * gap[short] * SD) ** 2, rel=1e-4)
    else:
        assert grown == pytest.approx(-2.0 * SD**2 * np.expm1(-gap / length), rel=1e-9)


def moved(seed: int, kind: Any = "matern", sd: float = 0.0) -> Motion:
    """Through five commands, with a disturbance of 0.2 s."""
    issued, command = np.arange(5) * 28_000_000, np.linspace(0.0, 0.01, 5)
    process = pf.Process(disturbance_sd=sd, disturbance_time=0.2, disturbance_kind=kind)
    return simulate_axis(AXIS, process, 0.001, issued, command, 0.028, np.random.default_rng(seed))


@pytest.mark.parametrize(("kind", "process"), [("matern", reverting.smooth), ("ou", reverting.rough)])
def test_a_disturbance_is_the_process_of_its_sd_and_time(kind: str, process: Any) -> None:
    """To rounding the one that the axis's own random numbers for it give."""
    disturbed = moved(7, kind, SD)
    own = np.random.default_rng(7).spawn(5)[4]
    expected = process(disturbed.time, SD, 0.2, own)
    assert disturbed.position - moved(7).position == pytest.approx(expected, abs=1e-14)


def test_a_sensor_drifts_on_each_axis_by_itself() -> None:
    """Over a long run the drift has its sd and forgets as exp(−Δ / bias_time), and axes have nothing in common."""
    valid = np.arange(40_000) * 50_000_000
    true = {"a": np.zeros(len(valid)), "b": np.zeros(len(valid))}
    sensor = TrueSensor(rate=20.0, sd=1e-12, scale=-2.0, bias_drift_sd=0.004, bias_time=0.5)
    a, b = (measure(sensor, "s", valid, true, np.random.default_rng(3)).values[axis] / 0.004 for axis in "ab")
    se = (2.0 * 20.0 / len(valid)) ** 0.5  # 20 rows to an independent one
    for one in (a, b):
        assert np.mean(one**2) == pytest.approx(1.0, abs=4.0 * se)
        assert np.mean(one[10:] * one[:-10]) == pytest.approx(np.exp(-1.0), abs=4.0 * se)
    assert np.mean(a * b) == pytest.approx(0.0, abs=4.0 * se)
    config = sensor.to_config()
    assert (config["bias_drift_sd_mm"], config["bias_time_s"], config["bias_sd_mm"]) == (0.004, 0.5, 0.0)

"""The true arm's motion against integrators and quadratures that share nothing with it.

Deterministic responses are compared with an adaptive Runge-Kutta method run from one change of the input to the next,
at every instant of the motion, to 1e-9 of the largest command. Noise is compared with its covariance
∫ q(s) g(t − s) g(t' − s) ds, where g(t) = C e^(At) B, by Gauss-Legendre quadrature: once exactly, for the motion is
linear in the numbers it draws, and each in its turn is drawn as 1; and over independent seeds: the covariance's own
Cholesky factor turns all positions into standard normal numbers, whose mean square must lie in the 99.9 % chi-square
band and whose sample covariance within five standard deviations of the identity, entry by entry.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.stats import chi2

from pumafuse.fusion.config import Process
from pumafuse.model.arm import Gain
from pumafuse.model.plants import FirstOrder, SecondOrder
from pumafuse.simulation.lattice import LATTICE, lattice
from pumafuse.simulation.motion import Motion, move
from pumafuse.simulation.true_arm import GainCurve, TrueAxis

Floats = NDArray[np.float64]
PERIOD = 0.028
QUIET = Process(input_noise=0.0, drift=0.0)
FIRST = FirstOrder(time_constant=0.0425)
WEAK = SecondOrder(natural_frequency=40.0, damping=0.2)
CRITICAL = SecondOrder(natural_frequency=53.9, damping=1.0)
STRONG = SecondOrder(natural_frequency=53.9, damping=3.0)
SLOW_POLE_OF_STRONG = 53.9 * (3.0 - 8.0**0.5)  # rad/s
PLANTS = pytest.mark.parametrize("plant", [FIRST, WEAK, CRITICAL, STRONG], ids=["first", "weak", "critical", "strong"])


def true_axis(plant: FirstOrder | SecondOrder, **different: Any) -> TrueAxis:
    plain = TrueAxis(
        plant=plant,
        gain=Gain(),
        gain_curve=None,
        gain_recovery=None,
        delay=0.0,
        delay_jitter=0.0,
        extra_pole=None,
        backlash=0.0,
        stiction=0.0,
        slow_drift=0.0,
        slow_drift_period=600.0,
    )
    return msgspec.structs.replace(plain, **different)


def ticks(count: int) -> NDArray[np.int64]:
    return np.rint(np.arange(count) * PERIOD * 1e9).astype(np.int64)


def ns(seconds: Any) -> NDArray[np.int64]:
    return np.rint(np.asarray(seconds, dtype=np.float64) * 1e9).astype(np.int64)


def near(seconds: Any) -> NDArray[np.int64]:
    """The instants of the lattice nearest to ``seconds``."""
    number = np.rint(np.asarray(seconds, dtype=np.float64) / (PERIOD / LATTICE))
    return np.unique(np.rint(number * (PERIOD * 1e9 / LATTICE)).astype(np.int64))


def motion(
    axis: TrueAxis,
    command: Sequence[float] | Floats,
    process: Process = QUIET,
    offset_sd: float = 0.0,
    rng: Any = 0,
) -> Motion:
    told = np.asarray(command, dtype=np.float64)
    chance = np.random.default_rng(rng) if isinstance(rng, int) else rng
    return move(axis, process, offset_sd, ticks(len(told)), told, PERIOD, chance)


def moved(
    axis: TrueAxis,
    command: Sequence[float] | Floats,
    wanted: NDArray[np.int64],
    process: Process = QUIET,
    offset_sd: float = 0.0,
    seed: int = 0,
) -> Floats:
    found = motion(axis, command, process, offset_sd, seed)
    assert np.isin(wanted, found.time).all()
    return found.at(wanted)


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


def integrated(axis: TrueAxis, v: Sequence[float], acting: Floats, wanted: Floats) -> Floats:
    """Positions at ``wanted`` [s] by DOP853 from each change of the plant's input to the next."""
    A, B, C = state_space(axis)
    x, now, position = np.zeros(len(B)), 0.0, np.full(len(wanted), np.nan)
    entries = [(0.0, 0.0), *zip(acting.tolist(), v, strict=True)]
    ends = [*acting.tolist(), max(float(wanted[-1]), float(acting[-1])) + 1e-3]
    for (_, level), end in zip(entries, ends, strict=True):
        inside = (wanted >= now) & (wanted < end)
        if end > now:
            at = np.unique(np.append(wanted[inside], end))

            def rate(_: float, state: Floats, level: float = level) -> Floats:
                return A @ state + B * level

            solved = solve_ivp(rate, (now, end), x, method="DOP853", t_eval=at, rtol=3e-14, atol=1e-18)
            position[inside] = C @ solved.y[:, np.searchsorted(at, wanted[inside])]
            x, now = solved.y[:, -1], end
    return position


def random_walk(count: int, size: float = 0.004, seed: int = 5) -> Floats:
    """Commands that wander, with rests between, the first of them not zero."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, size, count) * (rng.random(count) < 0.6)
    steps[0] = 0.003
    return np.cumsum(steps)


def check_linear(axis: TrueAxis, v: Sequence[float], command: Floats, rel: float = 1e-9) -> None:
    """The motion is the plant's answer to ``v``, one delay late, at every one of its instants."""
    acting = ticks(len(v)) / 1e9 + round(axis.delay * 1e9) / 1e9
    found = motion(axis, command)
    expected = integrated(axis, v, acting, found.time / 1e9)
    assert np.abs(expected).max() > 0.5 * np.abs(command).max()  # something moves
    assert np.abs(found.position - expected).max() <= rel * np.abs(command).max()


@PLANTS
@pytest.mark.parametrize("delay", [0.0, 0.028, 0.06045])
def test_a_plant_answers_its_commands_one_delay_late(plant: FirstOrder | SecondOrder, delay: float) -> None:
    """First- and second-order plants, ζ = 0.2, 1 and 3, agree with the integrator to 1e-9 of the largest command."""
    command = random_walk(40)
    check_linear(true_axis(plant, delay=delay), command.tolist(), command)


@pytest.mark.parametrize(
    ("plant", "lag"),
    [
        (FIRST, 0.006),
        (WEAK, 0.025),
        (STRONG, 0.006),
        (FIRST, FIRST.time_constant),
        (STRONG, 1.0 / SLOW_POLE_OF_STRONG),
        (FIRST, FIRST.time_constant * (1.0 + 3e-6)),
        (FIRST, FIRST.time_constant * (1.0 + 3e-4)),
    ],
    ids=["first", "weak", "strong", "equal", "equal-to-slow-pole", "nearly-equal", "close"],
)
def test_an_extra_lag_is_in_series_with_the_plant(plant: FirstOrder | SecondOrder, lag: float) -> None:
    """Also a lag equal or nearly equal to one of the plant's own agrees with the integrator to 1e-9."""
    command = random_walk(40)
    check_linear(true_axis(plant, delay=0.01, extra_pole=lag), command.tolist(), command)


def exact(axis: TrueAxis, v: Sequence[float], acting: Floats, wanted: Floats) -> Floats:
    """As :func:`integrated`, by one matrix exponential from change to change and one from a change to each instant."""
    A, B, C = state_space(axis)
    held = np.zeros((len(B) + 1, len(B) + 1))
    held[:-1, :-1], held[:-1, -1] = A, B
    states, x = [np.zeros(len(B) + 1)], np.zeros(len(B) + 1)
    for level, hold in zip(v, np.diff(acting, append=acting[-1]), strict=True):
        states.append(np.append(x[:-1], level))
        x = expm(held * hold) @ states[-1]
    entry = np.searchsorted(acting, wanted, side="right")
    since = wanted - np.append(0.0, acting)[entry]
    return np.einsum("j,njk,nk->n", C, expm(held * since[:, None, None])[:, :-1], np.array(states)[entry])


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.floats(5.0, 300.0), st.floats(0.05, 5.0), st.one_of(st.none(), st.floats(0.002, 0.2)), st.floats(0.0, 0.2))
def test_any_linear_axis_follows_its_differential_equation(w: float, z: float, lag: float | None, delay: float) -> None:
    """Natural frequency, damping, extra lag and delay of any size agree with matrix exponentials to 1e-9."""
    command = random_walk(25)
    axis = true_axis(SecondOrder(natural_frequency=w, damping=z), extra_pole=lag, delay=delay)
    acting = ticks(len(command)) / 1e9 + round(delay * 1e9) / 1e9
    found = motion(axis, command)
    some = slice(None, None, 17)
    difference = found.position[some] - exact(axis, command.tolist(), acting, found.time[some] / 1e9)
    assert np.abs(difference).max() <= 1e-9 * np.abs(command).max()


NEAR_CRITICAL = [
    1.0 + sign * 10.0**-power for power in (6, 8, 8.5, 9, 9.5, 10, 10.5, 11, 12, 14, 15.5) for sign in (-1, 1)
]


@pytest.mark.parametrize("damping", [1.0, *NEAR_CRITICAL], ids=lambda damping: f"{damping - 1.0:.1e}")
@pytest.mark.parametrize(("lag", "rel"), [(None, 5e-10), (1.0 / 53.9, 1e-7)], ids=["two", "three"])
def test_poles_that_come_together_are_a_limit_and_not_a_cliff(lag: float | None, rel: float, damping: float) -> None:
    """Around critical damping, from either side, two poles agree with matrix exponentials to 5e-10, three to 1e-7."""
    command = random_walk(25)
    axis = true_axis(SecondOrder(natural_frequency=53.9, damping=damping), extra_pole=lag)
    found = motion(axis, command)
    some = slice(None, None, 17)
    difference = found.position[some] - exact(axis, command.tolist(), ticks(25) / 1e9, found.time[some] / 1e9)
    assert np.abs(difference).max() <= rel * np.abs(command).max()


@pytest.mark.parametrize("apart", [0.0, 1e-7, 3e-6, 0.99e-5, 1.01e-5, 1e-4, -2e-6])
def test_a_lag_as_slow_as_the_plant_is_a_limit_too(apart: float) -> None:
    """To 5e-10, on both sides of where poles are set apart."""
    command = random_walk(25)
    axis = true_axis(FIRST, extra_pole=FIRST.time_constant * (1.0 + apart))
    found = motion(axis, command)
    difference = found.position - exact(axis, command.tolist(), ticks(25) / 1e9, found.time / 1e9)
    assert np.abs(difference).max() <= 5e-10 * np.abs(command).max()


def gained(command: Floats, gain: Callable[[float], float], recovery: float | None) -> list[float]:
    """V = u + e, one command after the other, from the words of the design."""
    v, e, before = [], 0.0, 0.0
    for u in command.tolist():
        if recovery is not None:
            e *= np.exp(-PERIOD / recovery)
        e += (gain(abs(u - before) / PERIOD) - 1.0) * (u - before)
        before = u
        v.append(u + e)
    return v


@pytest.mark.parametrize("recovery", [None, 0.1, 0.005])
def test_the_gain_acts_on_each_step_and_its_error_recovers(recovery: float | None) -> None:
    """Each step adds (K(speed) − 1) times itself to an error that decays by e^(−T/recovery) a tick, or never."""
    command = random_walk(40)
    axis = true_axis(FIRST, delay=0.0604, gain=Gain(slope=0.134, intercept=0.941), gain_recovery=recovery)
    check_linear(axis, gained(command, lambda speed: 0.134 * speed + 0.941, recovery), command)


def test_a_gain_curve_is_linear_between_its_points_and_level_outside() -> None:
    """And it replaces the gain's line."""
    curve = GainCurve(speed=[0.02, 0.05, 0.3], gain=[0.9, 1.1, 1.05])

    def gain(speed: float) -> float:
        if speed <= 0.02:
            return 0.9
        if speed >= 0.3:
            return 1.05
        if speed <= 0.05:
            return 0.9 + (speed - 0.02) / 0.03 * 0.2
        return 1.1 - (speed - 0.05) / 0.25 * 0.05

    command = np.cumsum(np.random.default_rng(6).choice([0.0003, 0.001, 0.005, 0.012], 40))
    speeds = np.abs(np.diff(command)) / PERIOD
    assert (speeds < 0.02).any() and (speeds > 0.3).any() and ((speeds > 0.02) & (speeds < 0.05)).any()
    axis = true_axis(STRONG, gain=Gain(intercept=7.0), gain_curve=curve, gain_recovery=0.1)
    check_linear(axis, gained(command, gain, 0.1), command)


def test_one_step_without_recovery_ends_at_gain_times_step() -> None:
    """The paper's K · u."""
    axis = true_axis(FIRST, gain=Gain(slope=0.0818, intercept=0.933))
    end = moved(axis, np.full(80, 0.008), near([2.2]))[0]
    assert end == pytest.approx((0.0818 * 0.008 / PERIOD + 0.933) * 0.008, rel=1e-12)


def test_a_sticking_drive_stays_until_its_input_is_far_enough_and_then_goes_all_the_way() -> None:
    """Inputs within the stiction of what the drive holds do nothing; one beyond it is followed whole."""
    command = np.array([0.0004, 0.0008, 0.0012, 0.0014, 0.0010, 0.0003, 0.0003, 0.0023, *[0.0015] * 10])
    held = [0.0, 0.0, 0.0012, 0.0012, 0.0012, 0.0012, 0.0012, 0.0023, *[0.0023] * 10]
    check_linear(true_axis(WEAK, delay=0.02, stiction=0.00095), held, command)


def test_stiction_acts_on_what_the_gain_has_made_of_the_command() -> None:
    """The gain's error counts, and its recovery alone can set the drive free."""
    command, found, held = random_walk(40, size=0.002), [], 0.0
    for v in gained(command, lambda speed: 0.1 * speed + 0.9, 0.1):
        if abs(v - held) > 0.0008:
            held = v
        found.append(held)
    assert 4 < len(set(found)) < 30
    axis = true_axis(FIRST, gain=Gain(slope=0.1, intercept=0.9), gain_recovery=0.1, stiction=0.0008)
    check_linear(axis, found, command)


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


@pytest.mark.parametrize("width", [0.0001, 0.002, 0.02])
def test_backlash_is_the_play_operator(width: float) -> None:
    """The tool is where a plain loop over the motion's instants pushes it, to 1e-12 of the largest command."""
    command = random_walk(40)
    plain, loose = (motion(true_axis(WEAK, delay=0.03, backlash=gap), command) for gap in (0.0, width))
    assert (plain.time == loose.time).all()
    assert np.abs(loose.position - play(plain.position, width)).max() <= 1e-12 * np.abs(command).max()


@pytest.mark.parametrize("seed", range(5))
def test_backlash_holds_under_noise(seed: int) -> None:
    """Noise of the plant goes through the play as commands do: the same seed without play, played, is the same."""
    process = Process(input_noise=0.0005, drift=0.0)
    command = random_walk(30, seed=seed)
    bare, loose = (motion(true_axis(FIRST, backlash=gap), command, process, rng=seed) for gap in (0.0, 0.0006))
    assert np.abs(loose.position - play(bare.position, 0.0006)).max() <= 1e-12 * np.abs(command).max()


@pytest.mark.long
@pytest.mark.parametrize("width", [0.002, pytest.param(0.010, marks=pytest.mark.long)])
def test_backlash_knows_the_turning_points_between_its_instants(width: float) -> None:
    """An overshoot pushes the tool as far as it would if the play were worked out every 0.04 ms.

    To what the tip of a parabola of the largest acceleration, ω² of the step, rises within half a step of the lattice.
    """
    axis, command = true_axis(WEAK, backlash=width), np.full(22, 0.010)
    found = motion(axis, command)
    fine = np.union1d(found.time / 1e9, np.arange(0.0, found.time[-1] / 1e9, 0.00004))
    expected = play(exact(axis, command.tolist(), ticks(22) / 1e9, fine), width)[
        np.searchsorted(fine, found.time / 1e9)
    ]
    tip = 0.5 * WEAK.natural_frequency**2 * 0.010 * (0.5 * PERIOD / LATTICE) ** 2
    assert tip < 0.001 * 0.010
    assert np.abs(found.position - expected).max() <= tip


def test_slow_drift_is_a_sine_on_the_position() -> None:
    """A sin(2πt/P) from the first command on, whatever the plant does."""
    command, wanted = random_walk(40), lattice(40, PERIOD)
    still, drifting = true_axis(FIRST), true_axis(FIRST, slow_drift=0.0007, slow_drift_period=0.9)
    difference = moved(drifting, command, wanted) - moved(still, command, wanted)
    assert difference == pytest.approx(0.0007 * np.sin(2.0 * np.pi * wanted / 1e9 / 0.9), abs=1e-14)


def test_each_command_has_a_delay_of_its_own() -> None:
    """From the rise after each of 300 steps comes its delay, exactly; their mean and spread are those asked for.

    Mean within four standard errors, variance in the 99.9 % chi-square band of 300 delays. With the recovered delays
    the whole motion agrees with superposed step responses to 1e-8.
    """
    tau, jitter, delay, hold, steps = 0.010, 0.004, 0.050, 12, 300
    axis = true_axis(FirstOrder(time_constant=tau), delay=delay, delay_jitter=jitter)
    sign = np.where(np.arange(steps) % 2 == 0, 0.01, -0.01)
    command = np.cumsum(np.kron(sign, np.eye(hold)[0]))
    issued = np.arange(steps) * hold * PERIOD
    look = near(issued + delay + 5.0 * jitter) / 1e9
    wanted = np.union1d(near(look), lattice(len(command), PERIOD)[::107])
    position = moved(axis, command, wanted, seed=4)
    known: list[float] = []
    for start, at, step in zip(issued, look, sign, strict=True):
        before = sum(s * -np.expm1(-(at - a) / tau) for a, s in list(zip(known, sign, strict=False))[-40:])
        settled = sum(sign[: max(len(known) - 40, 0)])
        rise = (position[np.searchsorted(wanted, ns(at))] - before - settled) / step
        known.append(at + tau * np.log1p(-rise))
        assert abs(known[-1] - start - delay) < 5.0 * jitter
    delays = np.array(known) - issued
    assert abs(delays.mean() - delay) < 4.0 * jitter / np.sqrt(steps)
    low, high = chi2.ppf([0.0005, 0.9995], steps - 1) / (steps - 1)
    assert low < delays.var(ddof=1) / jitter**2 < high
    since = np.maximum(wanted[:, None] / 1e9 - np.array(known), 0.0)
    assert np.abs(position - (-np.expm1(-since / tau)) @ sign).max() < 1e-8 * 0.01


@pytest.mark.parametrize("seed", range(5))
def test_commands_with_jittering_delays_do_not_overtake_one_another(seed: int) -> None:
    """Even where the jitter is far beyond T the last command is where the arm ends, and a ramp never goes back."""
    axis = true_axis(FIRST, delay=0.05, delay_jitter=0.2)
    command = np.minimum(np.arange(1, 181), 60) * 0.001
    position = motion(axis, command, rng=seed).position
    assert np.diff(position).min() >= -1e-15
    assert position[-1] == pytest.approx(0.060, rel=1e-9)


def test_the_arm_rests_until_its_first_command_acts() -> None:
    """Exactly, and moves at the very next instant."""
    found = motion(true_axis(WEAK, delay=0.06), [0.01] * 4)
    acts = found.time <= 60_000_000
    assert not found.position[acts].any() and found.position[~acts].all()


@pytest.mark.parametrize("fastest", [None, 0.0004])
def test_a_motion_is_known_on_the_whole_lattice(fastest: float | None) -> None:
    """60 even instants a period, to the ns, from the first command to a period after the last, however fast the arm."""
    axis, asked = true_axis(WEAK, delay=0.0123, extra_pole=fastest), lattice(7, PERIOD)
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


def check_normal(samples: Floats, expected: Floats) -> None:
    """Rows of ``samples`` have the covariance ``expected`` and mean zero, within the bands of the module's text."""
    count, size = samples.shape
    white = np.linalg.solve(np.linalg.cholesky(expected), samples.T).T
    low, high = chi2.ppf([0.0005, 0.9995], count * size) / (count * size)
    assert low < np.mean(white**2) < high
    assert np.abs(white.mean(axis=0)).max() < 5.0 / np.sqrt(count)
    entry_sd = np.where(np.eye(size) > 0.0, np.sqrt(2.0), 1.0) / np.sqrt(count)
    assert (np.abs(white.T @ white / count - np.eye(size)) < 5.0 * entry_sd).all()


class OneDraw:
    """A generator, and all that spawn from it, whose every number is 0 but for one, which is 1."""

    def __init__(self, chosen: int) -> None:
        self.left = chosen

    def spawn(self, count: int) -> list[OneDraw]:
        return [self] * count

    def standard_normal(self, size: Any = None) -> Any:
        drawn = np.zeros(1 if size is None else size)
        if 0 <= self.left < drawn.size:
            drawn.flat[self.left] = 1.0
        self.left -= drawn.size
        return drawn if size is not None else float(drawn[0])


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


SEEDS = 3000
NOISY_AT = near([0.0123, 0.03, 0.0305, 0.07, 0.2, 0.55])


@pytest.mark.long
@PLANTS
@pytest.mark.parametrize("lag", [None, 0.02])
def test_input_noise_has_the_covariance_of_its_impulse_response(
    plant: FirstOrder | SecondOrder, lag: float | None
) -> None:
    """Over seeds; also between neighbours on the lattice, and with an extra lag, which filters it too."""
    axis, at = true_axis(plant, extra_pole=lag, delay=0.02), NOISY_AT if lag is None else NOISY_AT[[0, 1, 3, 4, 5]]
    process = Process(input_noise=0.0004, drift=0.0)
    samples = np.array([moved(axis, np.zeros(20), at, process, seed=seed) for seed in range(SEEDS)])
    check_normal(samples, covariance(axis, [0.0004**2], [], at / 1e9))


@pytest.mark.long
def test_the_offset_starts_uncertain_and_walks() -> None:
    """Its covariance is offset_sd² + drift² · min(t, t')."""
    wanted, process = near([0.0, 0.004, 0.1, 0.5]), Process(input_noise=0.0, drift=0.0007)
    axis = true_axis(WEAK, delay=0.03)
    samples = np.array([moved(axis, np.zeros(20), wanted, process, 0.002, seed) for seed in range(SEEDS)])
    check_normal(samples, 0.002**2 + 0.0007**2 * np.minimum.outer(wanted, wanted) / 1e9)


def test_the_start_offset_alone_is_one_number_for_the_whole_run() -> None:
    """Drawn anew for each seed."""
    wanted = near([0.0, 0.04, 0.084])
    found = np.array([motion(true_axis(FIRST), np.zeros(3), QUIET, 0.002, seed).at(wanted) for seed in range(SEEDS)])
    assert (found == found[:, :1]).all()
    check_normal(found[:, :1], np.array([[0.002**2]]))


@pytest.mark.long
@pytest.mark.parametrize("plant", [FIRST, WEAK], ids=["first", "weak"])
def test_noise_grows_with_the_maneuver_of_the_command_that_acts(plant: FirstOrder | SecondOrder) -> None:
    """Q = input² + (maneuver_noise · m)² and likewise the drift, m = |u_n − 2u_(n−1) + u_(n−2)| / T, one delay late."""
    delay, wanted = 0.0405, near([0.035, 0.05, 0.09, 0.16, 0.3])
    at = wanted / 1e9
    process = Process(input_noise=0.0002, drift=0.0003, maneuver_noise=0.0005, maneuver_drift=0.0008)
    axis = true_axis(plant, delay=delay)
    u = [0.014, 0.014, 0.028, 0.070, 0.112, 0.112, *[0.112] * 6]
    padded = [0.0, 0.0, *u]
    m = [abs(padded[n + 2] - 2.0 * padded[n + 1] + padded[n]) / PERIOD for n in range(len(u))]
    changes = [n * PERIOD + delay for n in range(len(u))]
    assert m[:6] == pytest.approx([0.5, 0.5, 0.5, 1.0, 0.0, 1.5])
    q = [0.0002**2, *(0.0002**2 + (0.0005 * speed) ** 2 for speed in m)]
    drift = [0.0003**2, *(0.0003**2 + (0.0008 * speed) ** 2 for speed in m)]
    edges = [0.0, *changes, 1e9]
    walked = np.array(
        [
            sum(d * max(min(t, end) - start, 0.0) for d, start, end in zip(drift, edges[:-1], edges[1:], strict=True))
            for t in at
        ]
    )
    mean = moved(axis, u, wanted)
    samples = np.array([moved(axis, u, wanted, process, seed=seed) for seed in range(SEEDS)]) - mean
    check_normal(samples, covariance(axis, q, changes, at) + np.minimum.outer(walked, walked))


def test_kinds_of_noise_draw_from_streams_of_their_own() -> None:
    """The offset is the same with and without input noise and jitter: what one adds, another does not change."""
    command, wanted = np.zeros(20), lattice(20, PERIOD)

    def found(process: Process, offset_sd: float, jitter: float) -> Floats:
        return moved(true_axis(FIRST, delay_jitter=jitter), command, wanted, process, offset_sd, seed=9)

    alone = found(Process(input_noise=0.0, drift=0.001), 0.0, 0.0)
    noise = found(Process(input_noise=0.001, drift=0.0), 0.0, 0.0)
    start = found(QUIET, 0.003, 0.0)
    together = found(Process(input_noise=0.001, drift=0.001), 0.003, 0.0)
    assert together == pytest.approx(alone + noise + start, abs=1e-15)


def test_a_motion_is_looked_up_exactly() -> None:
    """`at` gives the position of the very instant, in any order."""
    motion = Motion(np.array([0, 5, 9]), np.array([1.0, 2.0, 3.0]))
    assert motion.at(np.array([9, 0, 5])).tolist() == [3.0, 1.0, 2.0]

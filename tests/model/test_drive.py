"""The plant's input against a component loop written from the definition of gain, recovery and maneuver."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.model.arm import AxisModel, Gain
from pumafuse.model.drive import Drive, drive
from pumafuse.model.plants import FirstOrder

T_NS = 28_000_000
T = 0.028
MINUTE_NS = 60_000_000_000
EPS = np.finfo(float).eps


def axis(slope: float = 0.0, intercept: float = 1.0, recovery: float | None = None) -> AxisModel:
    gain = Gain(slope=slope, intercept=intercept)
    return AxisModel(plant=FirstOrder(time_constant=0.04), gain=gain, gain_recovery=recovery)


def by_definition(model: AxisModel, time: list[int], command: list[float], start: float, period_ns: int) -> list[tuple]:
    """(time, v − u₀, maneuver) of every instant at which the plant's input may change, in a plain loop.

    A gain error is followed for 45 recovery times of a hold; what is left of it then is below 1e-19 of it.
    """
    period, recovery = period_ns * 1e-9, model.gain_recovery or math.inf
    entries, e, u1, u2 = [], 0.0, start, start
    for n, (t, u) in enumerate(zip(time, command, strict=True)):
        if n:
            e *= math.exp(-(t - time[n - 1]) * 1e-9 / recovery)
        gain = model.gain.slope * (abs(u - u1) / period) + model.gain.intercept
        e += (gain - 1.0) * (u - u1)
        maneuver = abs(u - 2.0 * u1 + u2) / period
        u1, u2 = u, u1
        entries.append((t, u - start + e, maneuver))
        end = t + 45.0 * recovery * 1e9 if math.isfinite(recovery) else t
        end = min(end, time[n + 1]) if n + 1 < len(time) else end
        grid = t + period_ns
        while grid < end:
            entries.append((grid, u - start + e * math.exp(-(grid - t) * 1e-9 / recovery), maneuver))
            grid += period_ns
    return entries


def assert_same_input(found: Drive, expected: list[tuple]) -> None:
    """Both are the same function of time: same value and maneuver after each instant at which either changes."""
    time, value, maneuver = (np.array(column) for column in zip(*expected, strict=True))
    instants = np.union1d(time, found.time)
    ours, theirs = (np.searchsorted(t, instants, side="right") - 1 for t in (found.time, time))
    assert found.time[0] == time[0]
    rounding = 5e-15 + 8 * EPS * np.abs(value).max()
    np.testing.assert_allclose(found.value[ours], value[theirs], rtol=0.0, atol=rounding)
    np.testing.assert_allclose(found.maneuver[ours], maneuver[theirs], rtol=1e-12, atol=1e-12)


@st.composite
def sequences(draw: st.DrawFn) -> tuple[AxisModel, list[int], list[float], float, int]:
    """An axis and commands: regular, on multiples of T, at any time, or minutes apart."""
    period_ns = draw(st.integers(1_000_000, 50_000_000))
    gap = st.one_of(
        st.just(period_ns),
        st.integers(1, 12).map(lambda k: k * period_ns),
        st.integers(1, 5 * period_ns),
        st.integers(MINUTE_NS, 9 * MINUTE_NS),
    )
    gaps = draw(st.lists(gap, max_size=9))
    length = st.floats(-1.0, 1.0)
    command = draw(st.lists(length, min_size=len(gaps) + 1, max_size=len(gaps) + 1))
    recovery = draw(st.none() | st.floats(0.2, 10.0).map(lambda r: r * period_ns * 1e-9))
    first = draw(st.sampled_from([0, 17, -5_000_000]))
    model = axis(draw(st.floats(-0.3, 0.3)), draw(st.floats(0.5, 1.5)), recovery)
    return model, np.cumsum([first, *gaps]).tolist(), command, draw(length), period_ns


@settings(derandomize=True, deadline=None, max_examples=150)
@given(sequences())
def test_drive_is_its_definition(case: tuple) -> None:
    """Input and maneuver follow the definition for any commands at any times, with and without recovery."""
    model, time, command, start, period_ns = case
    found = drive(model, np.array(time), np.array(command), start, period_ns * 1e-9)
    assert_same_input(found, by_definition(model, time, command, start, period_ns))


@pytest.mark.parametrize("recovery", [None, 0.1])
@pytest.mark.parametrize("jitter_ns", [0, 1, 9_000_000])
def test_drive_is_its_definition_on_a_long_scan(recovery: float | None, jitter_ns: int) -> None:
    """Thousands of commands of the paper's tangential axis, on the clock or beside it, with a pause of minutes."""
    rng = np.random.default_rng(5)
    time = np.cumsum(np.full(3000, T_NS)) + rng.integers(0, jitter_ns + 1, 3000)
    time[1500:] += 3 * MINUTE_NS
    command = 0.56 + 0.1 * np.sin(np.arange(3000) / 40.0) + rng.normal(0.0, 1e-3, 3000)
    model = axis(0.0518, 1.010, recovery)
    found = drive(model, time, command, 0.56, T)
    assert (np.diff(found.time) > 0).all()
    assert_same_input(found, by_definition(model, time.tolist(), command.tolist(), 0.56, T_NS))


@settings(derandomize=True, deadline=None, max_examples=100)
@given(st.floats(-1.0, 1.0), st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(0.5, 1.5))
def test_one_step_without_recovery_gives_the_gain(start: float, step: float, slope: float, intercept: float) -> None:
    """One step from rest gives K·u, with K at the speed step / T."""
    end = start + step
    found = drive(axis(slope, intercept), np.array([0]), np.array([end]), start, T)
    u = end - start
    gain = slope * abs(u) / T + intercept
    np.testing.assert_allclose(found.value, [gain * u], rtol=0.0, atol=8 * EPS * (1.0 + abs(gain)) * abs(u))
    assert found.maneuver == found.speed == pytest.approx(abs(u) / T)


def test_two_level_signal_without_recovery_gives_the_gain() -> None:
    """A random two-level signal gives K·u however long it lasts: the paper's white-noise test."""
    u = 0.004 * np.random.default_rng(1).integers(0, 2, 2000)
    found = drive(axis(0.0818, 0.933), np.arange(2000) * T_NS, 0.56 + u, 0.56, T)
    gain = 0.0818 * 0.004 / T + 0.933
    np.testing.assert_allclose(found.value, gain * u, rtol=0.0, atol=1e-13)


def test_recovery_takes_the_gain_error_back() -> None:
    """While a command is held v goes to u: e/e after one recovery time, nothing after forty."""
    found = drive(axis(0.0, 1.2, 10 * T), np.array([0]), np.array([0.1]), 0.0, T)
    after = found.value[np.searchsorted(found.time, [0, 10 * T_NS, 400 * T_NS], side="right") - 1]
    np.testing.assert_allclose(after, [0.12, 0.1 + 0.02 / math.e, 0.1], rtol=0.0, atol=5e-15)


def test_without_recovery_the_end_depends_on_the_path() -> None:
    """300 mm in many steps and back again end K − 1 apart when nothing recovers, which is why the presets recover."""
    ramp = np.linspace(0.0, 0.3, 1001)
    time = np.arange(1001) * 10 * T_NS
    off = {r: drive(axis(0.0, 0.95, r), time, ramp, 0.0, T).value[-1] - 0.3 for r in (None, 0.1)}
    assert off[None] == pytest.approx(-0.015)
    assert abs(off[0.1]) <= 2e-15


def test_unit_gain_changes_nothing() -> None:
    """With K = 1 the plant is fed the commands themselves, once each, whatever the recovery."""
    time, command = np.array([0, 3, 5]) * T_NS, np.array([0.57, 0.55, 0.56])
    for recovery in (None, 0.1):
        found = drive(axis(recovery=recovery), time, command, 0.56, T)
        assert found.time.tolist() == time.tolist()
        np.testing.assert_allclose(found.value, command - 0.56, rtol=0.0, atol=EPS)


def test_maneuver_is_the_change_of_commanded_speed() -> None:
    """|u_n − 2u_(n−1) + u_(n−2)| / T from rest: the speed on setting off, zero on a ramp, twice it on turning."""
    command = np.array([0.0, 1.0, 2.0, 3.0, 2.0, 2.0, 2.0]) * 1e-3
    found = drive(axis(), np.arange(7) * T_NS, command, 0.0, T)
    np.testing.assert_allclose(found.maneuver, np.array([0, 1, 0, 0, 2, 1, 0]) * 1e-3 / T, atol=1e-12)
    assert found.speed == pytest.approx(1e-3 / T)


def test_no_commands_give_no_input() -> None:
    """Without commands there is nothing to feed and no speed."""
    found = drive(axis(0.05, 1.1, 0.1), np.array([], dtype=np.int64), np.array([]), 0.56, T)
    assert len(found.time) == len(found.value) == len(found.maneuver) == 0
    assert found.speed == 0.0


@pytest.mark.parametrize("period_ns", [15_700_000, 16_300_000, 33_100_000])
def test_no_grid_point_falls_on_a_command(period_ns: int) -> None:
    """Entries are strictly ascending: a grid point that would fall on the next command is that command."""
    model = AxisModel(plant=FirstOrder(time_constant=0.04), gain=Gain(intercept=0.9), gain_recovery=0.1)
    time = np.array([0, 1, 2, 5, 9]) * period_ns
    found = drive(model, time, np.array([0.0, 0.01, 0.02, 0.01, 0.03]), 0.0, period_ns / 1e9)
    assert (np.diff(found.time) > 0).all()

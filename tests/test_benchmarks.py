"""What pumafuse is compared with: filters without commands, lags by correlation, general filters."""

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import multivariate_normal

from pages import ROOT


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    return importlib.import_module


def covariance(order: int, density: float, time: float, prior: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Of a process at ``s`` with itself at ``t``: its covariance function, not its transitions."""
    first, after = np.minimum(s[:, None], t), np.maximum(s[:, None], t)
    if order == 1:
        return 0.5 * density**2 * time * np.exp(-(after - first) / time)
    noise = {2: first**2 * after / 2 - first**3 / 6, 3: first**3 * (10 * after**2 - 5 * first * after + first**2) / 120}
    powers = [np.outer(s**i, t**i) / max(i, 1) ** 2 for i in range(order)]  # 0! = 1! = 1, 2! = 2
    return density**2 * noise[order] + sum(variance * power for variance, power in zip(prior, powers, strict=True))


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(("late", "smooth"), [(0.0, False), (0.07, False), (0.0, True)])
def test_estimates_are_those_of_a_gaussian_process(
    benchmark: Callable[[str], ModuleType], order: int, late: float, smooth: bool
) -> None:
    """Filtered, as live and smoothed: mean and sd of a regression on the measurements known then, all at once."""
    rng = np.random.default_rng(1)
    time, at = np.append(0.0, np.sort(rng.uniform(0.0, 3.0, 20))), np.sort(rng.uniform(0.2, 3.0, 15))
    value = 3.0 * np.sin(2.0 * time) + rng.normal(0.0, 0.3, len(time))
    model = benchmark("ungated").Process(order, 2.0, 0.3, 0.4)
    mean, sd = model.estimate(time, value, at, late, smooth)
    prior, level = np.var(value) * 100.0 ** np.arange(order), 0.0 if order == 1 else value[0]
    for k, instant in enumerate(at):
        seen = time <= (np.inf if smooth else instant - late)
        K, cross, own = (
            covariance(order, 2.0, 0.4, prior, a, b)
            for a, b in ((time[seen], time[seen]), (at[k : k + 1], time[seen]), (at[k : k + 1], at[k : k + 1]))
        )
        weights = np.linalg.solve(K + 0.09 * np.eye(seen.sum()), cross.T)[:, 0]
        assert mean[k] == pytest.approx(level + weights @ (value[seen] - level), abs=1e-6)
        assert sd[k] ** 2 == pytest.approx(own[0, 0] - cross[0] @ weights, rel=1e-5)


@pytest.mark.parametrize("order", [2, 3])
def test_filters_with_a_gate_are_a_gaussian_process_without_outliers(
    benchmark: Callable[[str], ModuleType], order: int
) -> None:
    """Of two that run side by side: positions and likelihoods of regressions on all but the outlier, at once.

    The outlier counts as if it were at the gate.
    """
    rng = np.random.default_rng(3)
    time, at = np.sort(rng.uniform(0.0, 3.0, 30)), np.sort(rng.uniform(0.2, 3.0, 15))
    value = 0.5 + 0.002 * np.sin(2.0 * time) + rng.normal(0.0, 3e-4, len(time))
    value[20] += 1.0
    known = benchmark("kinematic").Known(np.ones(1), np.zeros(1), np.array([-1]), np.zeros(0), 0.5, 0.002, 0.03)
    densities, sds = np.array([0.01, 0.03]), np.array([3e-4, 5e-4])
    measured = benchmark("kinematic").Measured(time, np.zeros(len(time), dtype=np.int64), value)
    position, likelihood = benchmark("kinematic").follow(order, np.log([densities, sds]), known, measured, at)
    fused, prior = np.arange(len(time)) != 20, np.array([0.002, 0.01, 0.1])[:order] ** 2
    for k, (density, sd) in enumerate(zip(densities, sds, strict=True)):
        K, cross, now = (
            covariance(order, density, 1.0, prior, a, b) for a, b in ((time, time), (at, time), (time[20:21], time))
        )
        K += sd**2 * np.eye(len(time))
        for n, instant in enumerate(at):
            seen = fused & (time <= instant)
            weights = np.linalg.solve(K[np.ix_(seen, seen)], value[seen] - 0.5)
            assert position[n, k] == pytest.approx(0.5 + cross[n, seen] @ weights, abs=1e-9)
        before = np.arange(20)
        S = K[20, 20] - now[0, before] @ np.linalg.solve(K[np.ix_(before, before)], now[0, before])
        rest = multivariate_normal.logpdf(1e3 * (value - 0.5)[fused], cov=1e6 * K[np.ix_(fused, fused)])
        assert likelihood[k] == pytest.approx(rest - 0.5 * (np.log(2e6 * np.pi * S) + 25.0), abs=1e-6)


def test_least_squares_find_what_the_commands_lead_to(benchmark: Callable[[str], ModuleType]) -> None:
    """Superposed step responses, delayed, with another gain and an offset: all four numbers come back."""
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.008, 0.012, 1000))
    command, when = np.cumsum(rng.normal(0.0, 1.0, 1000)), np.sort(rng.uniform(1.0, 9.0, 200))
    late = np.maximum(when[:, None] - 0.13 - time, 0.0)
    moved = command[0] + (1.0 - np.exp(-late[:, 1:] / 0.06)) @ np.diff(command)
    found = benchmark("ungated").least_squares(time, command, when, 2.0 + 0.8 * moved)
    assert [found.delay, found.time_constant] == pytest.approx([0.13, 0.06], abs=1e-4)
    assert [found.gain, found.offset] == pytest.approx([0.8, 2.0], abs=1e-3)
    assert found.at(time, command, when) == pytest.approx(2.0 + 0.8 * moved, abs=1e-2)


# ---- lags of simulated arms -----------------------------------------------------------------------------------------


def test_the_simulated_arm_answers_as_its_equations_say(benchmark: Callable[[str], ModuleType]) -> None:
    """Second order, a gain that recovers: solved as a differential equation by scipy, step by step of the command."""
    axis = benchmark("lag").Axis(delay=0.0437, order=2, lag=0.06, damping=0.8, gain=0.9, recovery=0.12)
    omega, time = 2.0 * 0.8 / 0.06, np.arange(0.0, 1.0, 0.028)
    u = 0.01 * np.sin(4.0 * time)
    state, at, error, known = np.zeros(2), 0.0437, 0.0, [(0.0, 0.0), (0.0437, 0.0)]
    for step, command in zip(np.diff(u, prepend=u[0]), u, strict=True):
        error += -0.1 * step

        def slope(
            t: float, y: np.ndarray, v: float = command - u[0], e: float = error, since: float = at
        ) -> list[float]:
            drive = v + e * np.exp(-(t - since) / 0.12)
            return [y[1], omega**2 * (drive - y[0]) - 2.0 * 0.8 * omega * y[1]]

        state = solve_ivp(slope, (at, at + 0.028), state, rtol=1e-9, atol=1e-12).y[:, -1]
        at, error = at + 0.028, error * np.exp(-0.028 / 0.12)
        known.append((at, state[0]))
    when, where = np.array(known).T
    inside = when < 0.95
    assert benchmark("lag")._response(axis, time, u, 1.0)(when[inside]) == pytest.approx(u[0] + where[inside], abs=2e-6)


@pytest.mark.long
@pytest.mark.parametrize("in_step", [False, True])
def test_intervals_of_lags_hold_on_arms_of_all_kinds(benchmark: Callable[[str], ModuleType], in_step: bool) -> None:
    """Ten runs of two axes: 95 % intervals hold in at least 86 % (95 % less 3.5 sd of some 80), and correlation errs.

    The RMS error of the lag is at most a third of that of the best correlation with the same held command.
    """
    found = [benchmark("lag").examined((seed, 2, 0.0, in_step)) for seed in range(300, 310)]
    numbers = [one for mine, _, _ in found for one in mine]
    errors = np.array([off for _, mine, _ in found for off in mine])
    assert len(numbers) > 60
    assert np.mean([one.low <= one.truth <= one.high for one in numbers]) > 0.86
    ours, rival = np.sqrt(np.mean(errors**2, axis=0))
    assert ours < rival / 3.0
    assert sum(bool(named) for _, _, named in found) <= 1  # nothing drifts or wanders here


# ---- where tables go ------------------------------------------------------------------------------------------------


def test_tables_go_between_the_marks_of_who_makes_them(benchmark: Callable[[str], ModuleType], tmp_path: Path) -> None:
    """The rest of a page stays, also what another one makes."""
    page, text = benchmark("page"), tmp_path / "page.md"
    other, mine = (f"<!-- made by benchmarks/{name}.py -->\n\nold\n\n<!-- until here -->\n" for name in ("a", "b"))
    text.write_text(f"one\n{other}two\n{mine}three\n")
    page.put(text, "b.py", "new")
    assert text.read_text() == f"one\n{other}two\n{mine.replace('old', 'new')}three\n"

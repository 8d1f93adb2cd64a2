"""What coefficients depend on: sums of squares by hand, confounded factors separated, clean trials not outlying."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pumafuse.identification.anova import Dependence, dependences, factors_of, outlying, scatter, welch
from pumafuse.identification.trials import Trial

TIME = np.arange(10) * 0.01


def trial(name: str, step: float = 0.008, speed: float = 0.3, axis: str = "radial", **factors: str) -> Trial:
    return Trial(name, axis, step, speed, factors, TIME, np.zeros(10))


def dependence(values: np.ndarray, cells: Sequence[str]) -> Dependence:
    (found,) = dependences({"gain": values}, {"pose": list(cells)})
    return found


# ---- one factor -----------------------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(st.lists(st.integers(1, 7), min_size=2, max_size=5), st.integers(0, 10**6), st.floats(0.0, 3.0))
def test_the_i_ratio_is_f_over_its_95_percent_point(sizes: list[int], seed: int, apart: float) -> None:
    """Mean squares between and within, unbalanced groups too; scipy's `f_oneway` says the same."""
    sizes = [max(sizes[0], 2), *sizes[1:]]
    rng = np.random.default_rng(seed)
    groups = [apart * k + rng.standard_normal(n) for k, n in enumerate(sizes)]
    values, cells = np.concatenate(groups), np.repeat([f"level {k}" for k in range(len(sizes))], sizes)
    shuffled = rng.permutation(len(values))
    found = dependence(values[shuffled], cells[shuffled].tolist())
    within = sum(float(np.sum((group - group.mean()) ** 2)) for group in groups)
    total = float(np.sum((values - values.mean()) ** 2))
    more, freedom = len(sizes) - 1, len(values) - len(sizes)
    F = (total - within) / more / (within / freedom)
    assert found.i_ratio == pytest.approx(F / stats.f.ppf(0.95, more, freedom), rel=1e-6)
    assert found.p == pytest.approx(stats.f_oneway(*groups).pvalue, rel=1e-6)
    assert found.adjusted_p == pytest.approx(found.p, rel=1e-6, abs=1e-12)
    assert (found.i_ratio > 1.0) == (found.p < 0.05)


def test_welchs_test_of_two_groups_is_his_t_test() -> None:
    """Groups of one value, or of equal ones, do not count."""
    rng = np.random.default_rng(3)
    groups = [rng.normal(0.0, 1.0, 6), rng.normal(0.5, 4.0, 9), np.array([1.0]), np.full(3, 2.0)]
    assert welch(groups) == pytest.approx(stats.ttest_ind(*groups[:2], equal_var=False).pvalue, rel=1e-9)
    assert welch(groups[1:]) is None


# ---- several factors ------------------------------------------------------------------------------------------------


def test_a_factor_that_is_another_by_another_name_is_confounded() -> None:
    """Its levels are known when the other's are: there is no adjusted p."""
    values = np.array([1.0, 1.1, 1.5, 1.6, 2.1, 2.2])
    found = dependences({"gain": values}, {"speed": list("112233"), "load": list("xxyyzz")})
    assert [one.adjusted_p for one in found] == [None, None]
    assert all(one.verdict == "dependent; confounded with the other factors" for one in found)


def test_a_factor_that_is_hidden_by_another_is_found_by_its_adjusted_p() -> None:
    """In a balanced design sums of squares add up: two-way analysis of variance by hand."""
    rng = np.random.default_rng(8)
    pose, speed = np.tile(list("abc"), 8), np.repeat(["1", "2"], 12)
    values = 3.0 * (pose == "b") + 0.6 * (speed == "2") + 0.3 * rng.standard_normal(24)
    by = {one.factor: one for one in dependences({"gain": values}, {"pose": pose.tolist(), "speed": speed.tolist()})}
    total = np.sum((values - values.mean()) ** 2)
    between = {
        name: sum(np.sum(cells == one) * (values[cells == one].mean() - values.mean()) ** 2 for one in set(cells))
        for name, cells in (("pose", pose), ("speed", speed))
    }
    left = (total - sum(between.values())) / (24 - 4)
    assert by["pose"].adjusted_p == pytest.approx(stats.f.sf(between["pose"] / 2 / left, 2, 20), rel=1e-6, abs=1e-15)
    assert by["speed"].adjusted_p == pytest.approx(stats.f.sf(between["speed"] / left, 1, 20), rel=1e-6)
    assert by["speed"].i_ratio < 1.0 and by["speed"].adjusted_p < 0.01
    assert by["speed"].verdict == "independent; beside the other factors dependent"


# ---- scatter --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [-3.0, 1e6])
def test_an_outlying_trial_is_named(far: float) -> None:
    """A delay of 60 ± 1 ms that is once far off; by its name, however many alike there are."""
    values = 60.0 + np.random.default_rng(4).standard_normal(12)
    values[7] = 60.0 + 5.0 * far
    found = scatter("delay_ms", [trial(f"no. {k}") for k in range(12)], values, np.full(12, 0.1))
    assert found.outlying == ["no. 7"]
    assert found.normal_p < 0.001
    assert (found.axis, found.coefficient, found.own_sd) == ("radial", "delay_ms", 0.1)
    assert found.median == pytest.approx(60.0, abs=1.0)
    unsure = np.full(12, 0.1)
    unsure[7] = abs(far)  # its own noise explains it
    assert not outlying(values, unsure).any() or abs(far) > 1e3


def test_clean_trials_are_rarely_called_outlying() -> None:
    """12 Gaussian values: in less than 3 % of 1,000 cases, even with no noise of their own."""
    rng = np.random.default_rng(6)
    named = sum(outlying(60.0 + 2.0 * rng.standard_normal(12), np.zeros(12)).any() for _ in range(1000))
    assert named < 30


def test_replicates_scatter_within_their_settings() -> None:
    """Pooled by hand over what has the same step and factors; `run` only counts; none repeated: none."""
    trials = [
        trial("1", 0.004, pose="a", run="1"),
        trial("2", 0.004, pose="a", run="2"),
        trial("3", 0.004, pose="a", run="3"),
        trial("4", -0.004, pose="a", run="1"),
        trial("5", -0.004, pose="a", run="2"),
        trial("6", -0.004, pose="b", run="1"),
    ]
    values = np.array([1.0, 2.0, 6.0, 10.0, 14.0, 99.0])
    found = scatter("gain", trials, values, np.full(6, 0.5))
    squares = (2.0**2 + 1.0**2 + 3.0**2) + 2 * 2.0**2  # about 3 and about 12
    assert found.replicate_sd == pytest.approx(np.sqrt(squares / 3), rel=1e-12)
    assert scatter("gain", trials[2:4], values[2:4], np.full(2, 0.5)).replicate_sd is None


# ---- factors --------------------------------------------------------------------------------------------------------


def test_factors_are_what_varies_and_no_counter() -> None:
    """Axis, speed, sense and columns of the list; what has one level, counts, or is new in every trial is none."""
    trials = [
        trial(
            str(k), 0.008 * (1 if k % 2 else -1), 0.1 if k < 4 else 0.5, "radial" if k % 4 < 2 else "vertical",
            pose="ab"[k // 4], tool="drill", run=str(k % 3), replicate=str(k % 2), remark=f"no. {k}",
        )
        for k in range(8)
    ]  # fmt: skip
    expected = {
        "axis": ["radial", "radial", "vertical", "vertical"] * 2,
        "speed_m_s": ["0.1"] * 4 + ["0.5"] * 4,
        "sense": ["-", "+"] * 4,
        "pose": ["a"] * 4 + ["b"] * 4,
    }
    assert factors_of(trials, 0.028, "length") == expected
    del expected["speed_m_s"]
    turning = [replace(one, speed=np.deg2rad(1e3 * one.speed)) for one in trials]
    assert factors_of(turning, 0.028, "angle") == expected | {"speed_deg_s": ["100"] * 4 + ["500"] * 4}

"""Validation has the numbers of `fuse`, and a verdict that allows for chance."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.fusion.consistency import consistency, densities_of
from pumafuse.logs.source import Source
from pumafuse.tuning.validation import Check, check
from tuning_runs import replaced, spoiled, with_outliers, with_process, with_sensors

AXES = ("tangential", "vertical")


@cache
def run() -> pf.Simulated:
    return with_outliers(11)


def checks(before: pf.FusionConfig, after: pf.FusionConfig, since: float = 0.0) -> dict[str, Check]:
    found = check(run().run, before, after, since=since)
    assert [one.axis for one in found] == list(AXES)
    return {one.axis: one for one in found}


def test_the_same_twice_is_no_different_and_worse_is_the_opposite_of_better() -> None:
    """Gains of exactly 0 for the same twice; spoiled after the truth is worse, the truth after it as much better."""
    truth, wrong = run().config, spoiled(run().config)
    there, back, same = checks(truth, wrong), checks(wrong, truth), checks(wrong, wrong)
    for axis in AXES:
        assert there[axis].worse and there[axis].verdict.startswith("worse: log-likelihood -")
        assert not back[axis].worse and back[axis].verdict.startswith("better: log-likelihood +")
        assert (there[axis].before, there[axis].after) == (back[axis].after, back[axis].before)
        assert same[axis].before == same[axis].after and not same[axis].worse
        assert same[axis].verdict == "no different: log-likelihood +0.0 (chance: ± 0.0), RMSE +0.0 %"


def test_error_bars_that_do_not_hold_are_no_plain_improvement() -> None:
    """A third of the truth's sd is better than a thousandth, and not right: said with the number that shows it."""

    def noisy(factor: float) -> pf.FusionConfig:
        config = run().config
        sensors = {name: replaced(one, sd=factor * one.sd_of("vertical")) for name, one in config.sensors.items()}
        return replaced(config, sensors=sensors)

    blind = replace(run().run, reference=None)
    for one in (*check(run().run, noisy(1e-3), noisy(1 / 3)), *check(blind, noisy(1e-3), noisy(1 / 3))):
        assert not one.holds and not one.worse
        assert one.verdict.startswith("better, but its error bars do not hold (NIS of vision ")
        assert ("coverage" in one.verdict) == (one.after.coverage is not None and one.after.coverage < 0.8)
    for one in (*check(run().run, noisy(1 / 3), noisy(1.0)), *check(blind, noisy(1 / 3), noisy(1.0))):
        assert one.holds and one.verdict.startswith("better: ")


def test_numbers_are_those_of_a_fusion() -> None:
    """Likelihood, rejections, NIS, whiteness, RMSE and coverage, from measurements and estimates since then only.

    The filter runs from the beginning: estimates and innovations are those of the whole run.
    """
    since = 2.5
    config = with_sensors(run().config, gate=3.5)
    found = checks(config, spoiled(config), since)
    est = pf.fuse(run().run, config)
    reference = est.reference
    late = replace(est, measurements=est.measurements.where(est.measurements.stamp >= since))
    for number, axis in enumerate(AXES):
        state, mine = found[axis].before, late.measurements.where(late.measurements.axis == number)
        assert state.log_likelihood == pytest.approx(densities_of(mine, config.sensors).sum(), rel=1e-12)
        assert state.rejected == np.sum(mine.outcome == pf.Outcome.REJECTED)
        assert (found[axis].components, found[axis].since_s) == (len(mine.value), since)
        tests = consistency(late, "vision", axis)
        sensor = state.sensors["vision"]
        assert (sensor.nis, sensor.whiteness_p, sensor.correlation) == (
            tests.nis,
            tests.whiteness,
            tests.correlation[0],
        )
        kept = est.time >= since
        error = (est[axis].position - np.interp(est.time, reference.time, reference.position[axis]))[kept]
        assert state.rmse_mm == pytest.approx(1e3 * np.sqrt(np.mean(error**2)), rel=1e-9)
        assert state.coverage == pytest.approx(np.mean(np.abs(error) <= 1.96 * est[axis].position_sd[kept]), abs=1e-9)
    assert sum(one.before.rejected for one in found.values()) > 0


def test_chance_is_the_scatter_of_the_gains() -> None:
    """± 1.96 √Σ gain², and a gain within it is no difference (Vuong); an outlier counts as 5 sd off in both."""
    before, after = run().config, with_sensors(run().config, sd=0.53e-3)
    densities: list[np.ndarray] = []
    for config in (before, after):
        measurements = pf.fuse(run().run, config).measurements
        mine = measurements.where(measurements.axis == 1)
        square = np.minimum((mine.innovation / mine.innovation_sd) ** 2, 25.0)
        densities.append(-0.5 * (np.log(2.0 * np.pi * (1e3 * mine.innovation_sd) ** 2) + square))
    gains = densities[1] - densities[0]
    chance = 1.96 * np.sqrt(np.sum(gains**2))
    verdict = checks(before, after)["vertical"].verdict
    assert f"log-likelihood {gains.sum():+.1f} (chance: ± {chance:.1f})" in verdict
    word = "better" if gains.sum() > chance else "worse" if gains.sum() < -chance else "no different"
    assert verdict.startswith(f"{word}:")


def test_a_better_likelihood_with_larger_errors_is_worse() -> None:
    """A reference decides: a sensor noise ten times too small, against an arm 100 ms too late and ten times too large.

    The latter's wide error bars make all measurements likelier, while its estimates are millimetres behind.
    """
    truth = run().config
    late = with_sensors(replaced(truth, arm=replaced(truth.arm, delay=truth.arm.delay + 0.1)), sd=5e-3)
    late = with_process(late, input_noise=0.0, drift=0.0, maneuver_drift=0.0)
    one = checks(with_sensors(truth, sd=0.05e-3, gate=0.0), late)["tangential"]
    assert one.after.log_likelihood > one.before.log_likelihood
    assert one.after.rmse_mm > 3.0 * one.before.rmse_mm
    assert one.worse and one.verdict.startswith("worse:")


def against(before: pf.FusionConfig, after: pf.FusionConfig, nearer: np.ndarray) -> Check:
    """Of the vertical axis, against a reference between both estimates, by ``nearer`` toward the former (0: midway)."""
    old, new = (pf.fuse(run().run, config)["vertical"].position for config in (before, after))
    stamp = run().run.command.stamp
    assert len(stamp) == len(old)
    reference = Source(stamp, {"vertical": 0.5 * (old + new) + 0.5 * nearer * (old - new)}, "reference")
    vertical = replace(run().run, reference=reference)
    return next(one for one in check(vertical, before, after) if one.axis == "vertical")


def test_larger_errors_are_worse_only_beyond_chance() -> None:
    """An RMSE that is 3 to 15 % larger: worse where errors grew all along, no worse where all is of one stretch."""
    before, after = spoiled(run().config), run().config
    count = len(run().run.command.stamp)
    along, once = np.full(count, 0.04), np.zeros(count)
    once[49:56] = 1.0
    for nearer, worse in ((along, True), (once, False)):
        one = against(before, after, nearer)
        assert 1.03 < one.after.rmse_mm / one.before.rmse_mm < 1.15
        assert one.worse == worse


def with_nis(nis: float, since: float = 0.0) -> Check:
    """Of the vertical axis without a reference, all noise being as large as gives its camera this NIS."""
    bare = replace(run().run, reference=None)

    def noisy(factor: float) -> Check:
        config, fields = run().config, ("input_noise", "drift", "maneuver_noise", "maneuver_drift")
        for field in fields:
            config = with_process(config, **{field: factor * getattr(config.process["vertical"], field)})
        camera = config.sensors["vision"]
        config = with_sensors(config, sd=factor * camera.sd, latency_sd=factor * camera.latency_sd, gate=0.0)
        config = replaced(config, start=replaced(config.start, offset_sd=factor * config.start.offset_sd))
        return next(one for one in check(bare, config, config, since=since) if one.axis == "vertical")

    found = noisy(np.sqrt(noisy(1.0).after.sensors["vision"].nis / nis))
    assert found.after.sensors["vision"].nis == pytest.approx(nis, rel=1e-6)
    return found


@pytest.mark.parametrize(("nis", "holds"), [(1.6, False), (0.73, True)])
def test_error_bars_hold_while_the_nis_is_between_0_71_and_1_42(nis: float, holds: bool) -> None:
    """A NIS of some hundred components, of which chance alone makes 0.75 to 1.3."""
    assert with_nis(nis).holds == holds


def test_error_bars_hold_while_the_nis_is_within_chance() -> None:
    """A mean of 1.6 over some ten components is."""
    found = with_nis(1.6, since=3.4)
    assert 8 <= found.components <= 12
    assert found.holds

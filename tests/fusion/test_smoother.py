"""The smoother against the conditional Gaussian given every measurement of the run."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from fusion.test_oracle import (
    CASES,
    GRID,
    IRREGULAR,
    MODES,
    MS,
    OUTLIER,
    PANEL,
    PAPER,
    TRACKER,
    UNDER,
    VISION,
    Case,
    Seen,
    T,
    cases,
    check,
    every,
    one,
    sensor,
    warned,
    with_outlier,
)
from fusion_oracle import AxisOracle, check_estimates, check_innovations, nanoseconds
from pumafuse.errors import PumafuseWarning
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.config import FusionConfig, Process, Sensor
from pumafuse.fusion.estimates import Estimates
from pumafuse.fusion.offline import fuse
from pumafuse.logs.run import Run, Source

LATE = Seen(TRACKER.sensor, every(90, 20, 240 * MS))
EARLY = Seen(TRACKER.sensor, every(90, 15))
FIELDS = ("position", "offset")  # a smoothed velocity is not known


def smoothed(case: Case, rate: float | None = None) -> tuple[Estimates, Run, FusionConfig]:
    run, config = case.made()
    with warned(run, config):
        return fuse(run, config, rate=rate or case.rate, smooth=True), run, config


# ---- against the oracle ---------------------------------------------------------------------------------------------

MORE = {
    "a late first measurement": Case(one(UNDER), seen={"tracker": LATE}, rate=110.0),
    "measurements that end early": Case(seen={"tracker": EARLY, "vision": replace(VISION, valid=EARLY.valid)}),
    "a gap in the measurements": Case(
        one(UNDER), seen={"tracker": Seen(TRACKER.sensor, np.r_[EARLY.valid, LATE.valid])}
    ),
    "measured and estimated as commands act": Case(
        one(UNDER), delay=0.028, seen={"tracker": Seen(sensor(), GRID), "vision": Seen(VISION.sensor, GRID)}
    ),
    "between irregular commands": Case(one(UNDER, gain=PAPER, gain_recovery=0.1), times=IRREGULAR, rate=73.0),
    "a latency that wanders": Case(
        delay=0.02,
        seen={"wandering": Seen(sensor(latency=0.02, latency_sd=0.004, scale=-1.5), GRID), "vision": VISION},
    ),
    "a panel before the tracker": Case(one(UNDER), seen={"panel": PANEL, "tracker": LATE}, rate=60.0),
    "one measurement": Case(seen={"tracker": Seen(TRACKER.sensor, np.array([200 * MS]))}, rate=90.0),
}


@pytest.mark.parametrize("case", MORE.values(), ids=MORE.keys())
def test_smoothed_estimates_know_every_measurement(case: Case) -> None:
    """Mean and error bar are those of the joint Gaussian given the whole run; innovations stay one step ahead."""
    check(case, "smoothed")


def tame(case: Case) -> Case:
    """Priors of at most 30 times a measurement's noise; beyond, rounding of a velocity's mean can pass 1e-12 m/s."""
    seen = {
        name: replace(each, sensor=msgspec.structs.replace(
            each.sensor, sd=max(each.sensor.sd, 0.3e-3), bias_sd=min(each.sensor.bias_sd, 9e-3)))
        for name, each in case.seen.items()
    }  # fmt: skip
    return replace(case, seen=seen, offset_sd=min(case.offset_sd, 5e-3))


@settings(derandomize=True, deadline=None, max_examples=50)
@given(cases())
def test_any_run_is_smoothed_like_the_conditional_gaussian(case: Case) -> None:
    """Random plants, delays, gains, gaps, noise and sensors: nothing deviates from the joint Gaussian."""
    check(tame(case), "smoothed")


@settings(derandomize=True, deadline=None, max_examples=60)
@given(cases())
def test_smoothing_never_widens(case: Case) -> None:
    """To know more measurements never makes anything less certain, whatever their values."""
    after, run, config = smoothed(case)
    with warned(run, config):
        before = fuse(run, config, rate=case.rate)
    for field in FIELDS:
        wide, narrow = (getattr(each["radial"], f"{field}_sd") for each in (before, after))
        assert (narrow <= wide * (1.0 + 1e-9)).all(), field


# ---- without the oracle ------------------------------------------------------------------------


def test_after_the_last_measurement_smoothed_is_filtered() -> None:
    """Nothing is known of the future there; before it nearly everything is."""
    after, run, config = smoothed(MORE["measurements that end early"], 200.0)
    before = fuse(run, config, rate=200.0)
    over = nanoseconds(after) >= EARLY.valid[-1]
    assert over.any()
    for field in (*FIELDS, *(f"{name}_sd" for name in FIELDS)):
        wanted, got = getattr(before["radial"], field), getattr(after["radial"], field)
        np.testing.assert_allclose(got[over], wanted[over], rtol=1e-13, err_msg=field)
    assert (after["radial"].position_sd[~over] < 0.999 * before["radial"].position_sd[~over]).all()


def test_before_anything_acts_the_arm_rests_and_only_the_offset_is_estimated() -> None:
    """There the position is the start level and the offset that later measurements tell."""
    case = Case(one(UNDER), delay=0.2, start={"radial": 0.507}, seen={"tracker": LATE}, rate=100.0,
                process=Process(input_noise=0.0, drift=0.8e-3, maneuver_noise=2e-3))  # fmt: skip
    radial = smoothed(case)[0]["radial"]
    resting = slice(0, 20)
    np.testing.assert_allclose(radial.position[resting], 0.507 + radial.offset[resting], rtol=1e-15)
    np.testing.assert_allclose(radial.position_sd[resting], radial.offset_sd[resting], rtol=1e-15)
    assert (radial.offset_sd[resting] < 0.25 * case.offset_sd).all()


def test_an_offset_that_does_not_drift_is_smoothed_to_one_number() -> None:
    """Given the whole run a constant is the same at every instant, and as certain: what the filter ends up with."""
    case = Case(one(UNDER), process=Process(input_noise=0.3e-3, drift=0.0),
                seen={"vision": VISION, "tracker": Seen(TRACKER.sensor, every(50, 20, 240 * MS))})  # fmt: skip
    after, run, config = smoothed(case)
    end = fuse(run, config, rate=50.0)["radial"]  # its last estimate is at the last measurement
    np.testing.assert_allclose(after["radial"].offset, end.offset[-1], rtol=0.0, atol=1e-9 * end.offset_sd[-1])
    np.testing.assert_allclose(after["radial"].offset_sd, end.offset_sd[-1], rtol=1e-9)


def test_smoothing_changes_no_innovation_outcome_or_bias() -> None:
    """Innovations, outcomes and biases of a smoothed run are those of the filtered one."""
    run, config = CASES["panel"].made()
    before, after = (fuse(run, config, smooth=smooth) for smooth in (False, True))
    assert (before.mode, after.mode) == ("filtered", "smoothed")
    for field in ("innovation", "innovation_sd", "outcome"):
        np.testing.assert_array_equal(getattr(after.measurements, field), getattr(before.measurements, field))
    assert after.biases == before.biases


def test_smoothed_as_live_is_refused() -> None:
    """All measurements, and only those that had arrived: a contradiction."""
    with pytest.raises(ValueError, match="as_live"):
        fuse(*Case().made(), smooth=True, as_live=True)


def test_smoothing_does_not_reach_across_a_clock_that_was_set_back() -> None:
    """Each side is smoothed as if it were a run of its own."""
    parts = [Case(one(UNDER), seed=seed).made() for seed in (1, 2)]
    later, config = 60_000 * MS, parts[0][1]

    def joined(*sources: Source) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        stamps = np.concatenate([sources[0].stamp + later, sources[1].stamp])
        return stamps, {"radial": np.concatenate([source.values["radial"] for source in sources])}

    command = joined(*(run.command for run, _ in parts))
    tracker = joined(*(run.sensors["tracker"] for run, _ in parts))
    with pytest.warns(PumafuseWarning):
        both = fuse(Run.from_arrays(*command, {"tracker": tracker}), config, smooth=True)
    for number, (run, _) in enumerate(parts):
        alone, here = fuse(run, config, smooth=True)["radial"], both.segment == number
        np.testing.assert_array_equal(both["radial"].position[here], alone.position)
        np.testing.assert_array_equal(both["radial"].position_sd[here], alone.position_sd)


# ---- gates ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigmas", [6.0, -1e4])
def test_rejected_measurements_stay_out(sigmas: float) -> None:
    """A measurement beyond the gate leaves the smoothed estimates as if it had never been."""
    run, config, _ = with_outlier(5.0, sigmas)
    estimates = fuse(run, config, smooth=True)
    for axis in estimates.axes:
        oracle = AxisOracle(run, config, axis, leave_out={("tracker", OUTLIER)})
        check_estimates(estimates[axis], oracle.smoothed(nanoseconds(estimates)))


def bumped() -> tuple[Run, FusionConfig]:
    """An arm that somebody pushes aside by 20 mm at 0.6 s and back at 1.4 s; the camera looks away meanwhile."""
    rng = np.random.default_rng(3)
    seen = {
        "vision": Seen(sensor(0.4e-3), every(12, 7)),
        "tracker": Seen(Sensor(sd=0.2e-3, latency=0.008, scale=-1.5, gate=5.0), every(25, 56)),
    }
    run, config = Case(one(UNDER), times=np.arange(85) * T, seen=seen).made()
    oracle = AxisOracle(run, config, "radial")
    for name, each in seen.items():
        pushed = np.where((each.valid > 600 * MS) & (each.valid < 1400 * MS), 0.02, 0.0)
        truth = oracle.undisturbed(each.valid)[0] + pushed
        run.sensors[name].values["radial"][:] = each.sensor.scale * truth + rng.normal(0.0, 0.1e-3, len(each.valid))
    return run, config


def check_gated(run: Run, config: FusionConfig, estimates: Estimates, mode: str) -> dict[Outcome, set[tuple[str, int]]]:
    """Estimates are those of the Gaussian without what was rejected; what re-acquired adds (ν/scale)² to the offset's.

    Returns:
        The rows with each outcome.
    """
    found = estimates.measurements
    stamps = np.rint(found.stamp * 1e9).astype(np.int64) + estimates.origin
    sources = [(found.sensors[number], run.sensors[found.sensors[number]].stamp) for number in found.sensor]
    rows = [(name, int(np.searchsorted(of, stamp))) for (name, of), stamp in zip(sources, stamps, strict=True)]
    by = {kind: {row for row, outcome in zip(rows, found.outcome, strict=True) if outcome == kind} for kind in Outcome}
    oracle = AxisOracle(run, config, "radial", leave_out=by[Outcome.REJECTED], reacquired=by[Outcome.REACQUIRED])
    check_innovations(found.where(np.isin(found.outcome, [Outcome.FUSED, Outcome.REACQUIRED])), oracle)
    check_estimates(estimates["radial"], getattr(oracle, mode)(nanoseconds(estimates)))
    return by


@pytest.mark.parametrize("mode", ["filtered", "smoothed"])
def test_a_reacquired_gate_is_a_jump_of_the_offset(mode: str) -> None:
    """Smoothed estimates know of it before.

    The camera saw the arm at 0.5 s and stands against the tracker until 1.0 s. The second time nobody does.
    """
    run, config = bumped()
    with pytest.warns(PumafuseWarning):
        estimates = fuse(run, config, rate=30.0, **MODES[mode])
    rows = check_gated(run, config, estimates, mode)
    assert rows[Outcome.REJECTED] == {("tracker", row) for row in (*range(16, 26), 35)}
    assert rows[Outcome.REACQUIRED] == {("tracker", 26), ("tracker", 36)}


@settings(derandomize=True, deadline=None, max_examples=50)
@given(cases(), st.sampled_from(["filtered", "smoothed"]))
def test_any_gated_run_is_fused_like_the_conditional_gaussian(case: Case, mode: str) -> None:
    """Gates narrow enough to reject and to re-acquire."""
    run, config = tame(case).made()
    config = msgspec.structs.replace(
        config, sensors={name: msgspec.structs.replace(each, gate=1.0) for name, each in config.sensors.items()}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)
        check_gated(run, config, fuse(run, config, rate=case.rate, **MODES[mode]), mode)


# ---- the shipped scan -----------------------------------------------------------------------------------------------

DATA = Path(pf.__file__).parent / "data"
LIMITS = {"tangential": 0.050e-3, "radial": 0.034e-3, "vertical": 0.040e-3}


@pytest.fixture(scope="module")
def scan() -> tuple[Run, FusionConfig, Estimates]:
    run, config = pf.Run.read(DATA / "scan1"), pf.FusionConfig.load(DATA / "fusion.toml")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)  # of the scan's own faults
        return run, config, pf.fuse(run, config, sensors=["tracker", "vision"], rate=200.0, smooth=True)


def _rmse(scan: tuple[Run, FusionConfig, Estimates], axis: str) -> Mapping[str, float]:
    """RMS errors [m] where both truth and tracker are: of the estimates, and of the tracker interpolated."""
    run, config, estimates = scan
    assert run.reference is not None
    known = {"truth": (run.reference, 0.0), "raw": (run.sensors["tracker"], config.sensors["tracker"].latency)}
    at = {name: (source.stamp - estimates.origin) * 1e-9 - latency for name, (source, latency) in known.items()}
    inside = np.logical_and.reduce([(estimates.time >= t.min()) & (estimates.time <= t.max()) for t in at.values()])
    position = {name: np.interp(estimates.time, at[name], known[name][0].values[axis]) for name in at}
    position["smoothed"] = estimates[axis].position
    assert inside.sum() > 11_000
    return {name: float(np.sqrt(np.mean((position[name] - position["truth"])[inside] ** 2))) for name in position}


@pytest.mark.parametrize("axis", LIMITS)
def test_the_scan_is_smoothed_as_well_as_promised(scan: tuple[Run, FusionConfig, Estimates], axis: str) -> None:
    """With tracker and vision within 0.050 / 0.034 / 0.040 mm of the truth, better than the raw tracker's."""
    error = _rmse(scan, axis)
    assert error["smoothed"] <= LIMITS[axis]
    if axis != "tangential":
        assert error["smoothed"] <= error["raw"]


@pytest.mark.parametrize("axis", LIMITS)
def test_smoothed_error_bars_on_the_scan_are_right(scan: tuple[Run, FusionConfig, Estimates], axis: str) -> None:
    """About 95 % of the errors lie within 1.96 standard deviations."""
    estimates = scan[2]
    assert estimates.reference is not None
    found = pf.score(
        estimates.time, estimates.segment, estimates[axis].position, estimates[axis].position_sd,
        estimates.reference, axis,
    )  # fmt: skip
    assert found is not None
    assert 0.90 <= found.coverage <= 0.99


def test_error_bars_hold_with_a_prior_as_wide_as_a_metre() -> None:
    """An offset and a panel's bias unknown to 1 m, beside a tracker of 0.05 mm: the smoothed error bars are right."""
    case = MORE["a panel before the tracker"]
    seen = {
        **case.seen,
        "tracker": replace(LATE, sensor=msgspec.structs.replace(LATE.sensor, sd=5e-5, bias_sd=0.0)),
    }
    estimates, run, config = smoothed(replace(case, seen=seen, offset_sd=1.0))
    expected = AxisOracle(run, config, "radial").smoothed(nanoseconds(estimates))
    for field in ("position", "offset"):
        found = getattr(estimates["radial"], f"{field}_sd")
        np.testing.assert_allclose(found, getattr(expected, f"{field}_sd"), rtol=1e-7)

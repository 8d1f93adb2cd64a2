"""Tuning as a whole: the result can be used, has its provenance, and is kept when interrupted."""

import json
import math
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np
import pytest

import pumafuse as pf
from pumafuse.logs.source import Source
from pumafuse.tuning.likelihood import Likelihood
from pumafuse.tuning.parameters import Fit
from pumafuse.tuning.stage import Plan
from pumafuse.tuning.summary import TuningSummary
from pumafuse.tuning.tune import Pipeline
from pumafuse.tuning.validation import check
from tuning_runs import (
    fitted,
    free_of,
    outage,
    quietly,
    replaced,
    spoiled,
    spoiled_arm,
    with_order,
    with_outliers,
    with_sensors,
)

AXES = ("tangential", "vertical")
ARM: tuple[Fit, ...] = ("noise", "delay", "plant")


@cache
def tuned() -> pf.Tuning:
    """Noise, delays and plants from one run of tracker and camera, all of them spoiled."""
    return quietly(lambda: pf.tune(outage(1).run, spoiled_arm(outage(1).config), fit=ARM))


def total(run: pf.Run, config: pf.FusionConfig) -> float:
    return Likelihood([run], config).evaluate(config).log_likelihood


# ---- the result -----------------------------------------------------------------------------------------------------


def test_threads_change_no_digit(monkeypatch: pytest.MonkeyPatch) -> None:
    """On one core the axes are fitted one after the other, on two at once: the same numbers and intervals."""
    sim, texts = with_outliers(1), list[str]()
    for cores in ("1", "2"):
        monkeypatch.setenv("LOKY_MAX_CPU_COUNT", cores)
        texts.append(quietly(lambda: pf.tune(sim.run, spoiled(sim.config))).to_json())
    assert texts[0] == texts[1]


def test_numbers_and_intervals_are_there_as_statisticians_have_them() -> None:
    """By key, as in the files: each number inside its interval, an end that is open infinite; a table in plain text."""
    found = tuned()
    params, intervals, lines = found.params, found.conf_int(), found.summary().splitlines()
    assert params.keys() == intervals.keys() == {one.key for one in found.details.parameters}
    assert params["delay_ms"] == pytest.approx(1e3 * found.config.arm.delay, rel=1e-6)
    for one in found.details.parameters:
        low, high = intervals[one.key]
        assert low <= params[one.key] <= high
        assert (math.isinf(low), math.isinf(high)) == tuple(end is None for end in one.ci95)
        (line,) = [line for line in lines if line.startswith(f"{one.key} ")]
        assert line.split()[-3:] == [f"{number:.4g}" for number in (params[one.key], low, high)]
    assert repr(found) == f"Tuning({outage(1).run.name}: {len(params)} parameters)"


def test_the_result_is_likelier_and_reports_by_how_much() -> None:
    """By axis, before and after; values before and after are those of the configurations."""
    found, run = tuned(), outage(1).run
    for config, name in ((found.before, "before"), (found.config, "after")):
        likelihood = Likelihood([run], config)
        axes = likelihood.evaluate(config).axes
        reported = found.details.likelihood
        assert [getattr(reported[axis], name) for axis in AXES] == pytest.approx(axes.tolist(), rel=1e-9)
        assert [reported[axis].components for axis in AXES] == likelihood.count.tolist()
    assert total(run, found.config) > total(run, found.before) + 200.0
    keys = {one.key: one for one in free_of(Likelihood([run], found.config), found.config, ARM)}
    for key, one in fitted(found).items():
        known = keys[key].configured(found.before)
        assert one.before == (None if known is None else pytest.approx(known / keys[key].unit))
        assert one.value == pytest.approx(keys[key].number(found.config) / keys[key].unit)
        low, high = one.ci95
        assert (low is None or low <= one.value) and (high is None or one.value <= high), one
    assert found.details.orders.keys() == set(AXES)
    assert (found.details.pumafuse, found.details.runs) == (version("pumafuse"), [run.name])
    assert (found.details.fit, found.details.fixed, found.details.trusted) == (list(ARM), [], None)
    assert not found.details.interrupted


def test_the_truth_is_near_and_the_rest_stays() -> None:
    """Delays within 3 ms, plants and sds within 20 %, from a run of 4 seconds; what is not commanded stays."""
    found, truth, before = tuned().config, outage(1).config, tuned().before
    for axis in AXES:
        assert found.arm.delay_of(axis) == pytest.approx(0.06045, abs=0.003)
        assert found.arm.axes[axis].plant.lag == pytest.approx(truth.arm.axes[axis].plant.lag, rel=0.2)
        for name in ("tracker", "vision"):
            assert found.sensors[name].sd_of(axis) == pytest.approx(truth.sensors[name].sd_of(axis), rel=0.2)
    assert (found.arm.axes["radial"], found.process["radial"]) == (before.arm.axes["radial"], before.process["radial"])
    # a search uses other gates
    assert {name: replaced(one, sd=1.0) for name, one in found.sensors.items()} == {
        name: replaced(one, sd=1.0) for name, one in before.sensors.items()
    }


def test_what_is_saved_loads_and_is_as_likely(tmp_path: Path) -> None:
    """fusion.toml and arm.toml beside it: the same configuration to six digits, with intervals and provenance."""
    found, run = tuned(), outage(1).run
    found.config.save(tmp_path)
    again = pf.FusionConfig.load(tmp_path / "fusion.toml")
    assert total(run, again) == pytest.approx(total(run, found.config), abs=1e-6)
    for key, one in fitted(found).items():
        assert float(f"{one.value:.6g}") == pytest.approx(one.value, rel=1e-12), key
    arm, numbers = tomllib.loads((tmp_path / "arm.toml").read_text()), fitted(found)
    table = arm["axes"]["tangential"]
    for key in ("delay_ms", "natural_frequency_rad_s", "damping"):
        shared = key == "delay_ms" and key not in table
        one, place = (numbers[key], arm) if shared else (numbers[f"axes.tangential.{key}"], table)
        assert place[key] == pytest.approx(one.value, rel=1e-9)
        assert place[f"{key}_ci95"] == pytest.approx(one.ci95, rel=1e-5)
    assert table["lag_ms_ci95"] == pytest.approx(found.details.lags["tangential"].lag_ms_ci95, rel=1e-5)
    known = outage(1).config.arm.provenance
    assert {key: arm["provenance"][key] for key in known} == known and arm["provenance"]["tuned_on"] == [run.name]


@pytest.mark.long
def test_a_configuration_that_had_seen_the_part_for_validation_says_so() -> None:
    """Tuned on the whole run in the end, it is no stranger to the run's last third; another run it does not know."""
    run, other = outage(1).run, outage(2).run
    first = sds_alone([run], outage(1).config)
    assert first.config.arm.provenance["tuned_on"] == [run.name]
    assert not [note for note in first.details.notes if "fitted on '" in note]
    again = sds_alone([run], first.config)
    assert [
        note
        for note in again.details.notes
        if note.startswith(f"the configuration as given was fitted on '{run.name}'")
    ]
    elsewhere = sds_alone([run], first.config, validate=other)
    assert not [note for note in elsewhere.details.notes if "was fitted on '" in note]
    assert sds_alone([other], first.config).config.arm.provenance["tuned_on"] == [run.name, other.name]


def sds_alone(runs: Sequence[pf.Run], config: pf.FusionConfig, **more: object) -> pf.Tuning:
    """The noise of the sensors with the process fixed, which takes least time."""
    return quietly(lambda: pf.tune(runs, config, fix=["process"], **more))


@pytest.mark.long
def test_the_reference_plays_no_part() -> None:
    """Without it, or with nonsense in its place, the configuration is the same to the last bit."""
    run, config = outage(1).run, spoiled(outage(1).config)
    nonsense = replace(run.reference, values={axis: 1.0 + value[::-1] for axis, value in run.reference.values.items()})
    found = [sds_alone([replace(run, reference=one)], config) for one in (run.reference, None, nonsense)]
    assert found[0].config == found[1].config == found[2].config
    assert found[0].config.arm == with_provenance(config.arm, tuned_on=[run.name])


def with_provenance(arm: pf.ArmModel, **more: object) -> pf.ArmModel:
    """The arm with more said of where it is from."""
    return msgspec.structs.replace(arm, provenance={**arm.provenance, **more})


# ---- validation -----------------------------------------------------------------------------------------------------


def cut(run: pf.Run, until: float, delay: dict[str, float]) -> pf.Run:
    """The run without measurements that are valid later than ``until`` [s]."""
    origin = run.command.stamp[0]

    def early(name: str, one: Source) -> Source:
        return one.rows(one.stamp - round(delay[name] * 1e9) <= origin + round(until * 1e9))

    return replace(run, sensors={name: early(name, one) for name, one in run.sensors.items()})


@pytest.mark.long
def test_the_last_third_is_validated_on_with_numbers_of_the_first_two() -> None:
    """What is compared there was fitted to the first two thirds: as likely there as a search in a run cut there finds.

    The result is fitted to the whole, and more likely there. Without the prior, with which the most likely is not the
    best.
    """
    sim, config = with_outliers(4), spoiled(with_outliers(4).config)
    pipeline = Pipeline([sim.run], config, [Plan(["noise"], ["process"], sd_prior=False)], lambda _, __: None)
    quietly(pipeline.fit)
    stamp = sim.run.command.stamp
    until = 2.0 / 3.0 * float(stamp[-1] - stamp[0]) / 1e9
    early, compared = cut(sim.run, until, {"vision": 0.045}), pipeline.fitted_until(until)
    found = sds_alone([sim.run], config, sd_prior=False)
    assert found.config.sensors == pipeline.result().sensors
    assert found.details.validation == check(sim.run, config, compared, since=until)
    for one in found.details.validation or []:
        assert one.since_s == until
        assert one.components == np.sum(sim.run.sensors["vision"].stamp - stamp[0] >= until * 1e9)
    other = sds_alone([early], config, validate=sim.run, sd_prior=False)
    assert total(early, compared) > total(early, other.config) - 0.1
    assert total(sim.run, compared) < total(sim.run, found.config)


def test_a_run_to_validate_on_is_compared_whole() -> None:
    """By its name and from its beginning; the numbers are those of a check of the result."""
    one, two = outage(1), outage(2)
    found = sds_alone([one.run], with_sensors(one.config, sd=1e-3), validate=two.run)
    assert found.details.validation == check(two.run, found.before, found.config)
    assert {(part.run, part.since_s) for part in found.details.validation or []} == {(two.run.name, 0.0)}
    assert not found.details.worse
    assert not [note for note in found.details.notes if "fitted on" in note]


# ---- a trusted sensor -----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_arm_is_fitted_on_the_trusted_sensor_and_the_others_after_it() -> None:
    """Arm, process noise and its own noise are as from a run without the others; its latency stays.

    The other's is 45 ms within 3 from 10, inside its interval, its sds are within 20 %.
    """
    sim = outage(1)
    config = with_sensors(spoiled(sim.config), "vision", latency=0.010)
    found = quietly(lambda: pf.tune([sim.run], config, fit=["noise", "delay", "latency"], trust="tracker"))
    alone = replace(sim.run, sensors={"tracker": sim.run.sensors["tracker"]})
    lone = replaced(found.before, sensors={"tracker": found.before.sensors["tracker"]})
    other = quietly(lambda: pf.tune([alone], lone, fit=["noise", "delay"])).config
    assert (found.config.process, found.config.sensors["tracker"]) == (other.process, other.sensors["tracker"])
    assert [found.config.arm.delay_of(axis) for axis in AXES] == [other.arm.delay_of(axis) for axis in AXES]
    assert found.config.sensors["vision"].latency == pytest.approx(0.045, abs=0.003)
    low, high = fitted(found)["sensors.vision.latency_ms"].ci95
    assert low is not None and high is not None and low < 45.0 < high
    for axis in AXES:
        assert found.config.sensors["vision"].sd_of(axis) == pytest.approx(5e-4, rel=0.2)
    assert {key for key in fitted(found) if "vision" in key} == {
        "sensors.vision.latency_ms",
        *(f"sensors.vision.sd_mm.{axis}" for axis in AXES),
    }
    assert found.details.trusted == "tracker"


# ---- Ctrl-C ---------------------------------------------------------------------------------------------------------


class Stop:
    """Ctrl-C at the n-th call of the progress; with all calls until then."""

    def __init__(self, at: int) -> None:
        self.at, self.calls = at, list[tuple[str, float]]()

    def __call__(self, what: str, log_likelihood: float) -> None:
        self.calls.append((what, log_likelihood))
        if len(self.calls) == self.at:
            raise KeyboardInterrupt


@cache
def calls(trust: str | None) -> int:
    counted = Stop(-1)
    sim = outage(1)
    quietly(lambda: pf.tune([sim.run], spoiled(sim.config), trust=trust, progress=counted))
    return len(counted.calls)


@pytest.mark.long
@pytest.mark.parametrize(("share", "trust"), [(0.0, None), (0.5, "tracker"), (0.99, None)])
def test_interrupted_it_gives_the_best_so_far(share: float, trust: str | None, tmp_path: Path) -> None:
    """At any moment: a whole configuration with the gates as given, never less likely than the start.

    The summary and a note report the interruption; it can be saved, loaded and written as JSON.
    """
    sim = outage(1)
    config = with_sensors(spoiled(sim.config), "vision", gate=3.5, gate_rows=False)
    stop = Stop(1 + int(share * calls(trust)))
    with pytest.warns(pf.PumafuseWarning, match="interrupted: these are the best numbers until then"):
        found = pf.tune([sim.run], config, trust=trust, progress=stop)
    assert found.details.interrupted and len(stop.calls) == stop.at
    assert total(sim.run, found.config) >= total(sim.run, config)
    for name, sensor in found.config.sensors.items():
        assert (sensor.gate, sensor.gate_rows) == (config.sensors[name].gate, config.sensors[name].gate_rows)
    assert found.config.arm == with_provenance(config.arm, tuned_on=[sim.run.name])
    assert found.config.start == config.start
    written = json.loads(found.to_json())
    assert set(written) == set(TuningSummary.__struct_fields__) and written["interrupted"]
    assert [one["value"] for one in written["parameters"]] == [one.value for one in found.details.parameters]
    found.config.save(tmp_path)
    assert total(sim.run, pf.FusionConfig.load(tmp_path / "fusion.toml")) == pytest.approx(
        total(sim.run, found.config), abs=1e-6
    )
    if stop.calls[-1][0] == "computing intervals":
        assert total(sim.run, found.config) == pytest.approx(stop.calls[-1][1], abs=0.05)


# ---- the shipped scan -----------------------------------------------------------------------------------------------


def tuned_scan() -> tuple[pf.Run, pf.FusionConfig]:
    """The shipped scan tuned by the tracker, all free but latencies; plants of second order at first."""
    data = Path(pf.__file__).parent / "data"
    run, config = pf.Run.read(data / "scan1"), pf.FusionConfig.load(data / "fusion.toml")
    config = with_sensors(config, gate=5.0)
    for axis in config.arm.axes:
        config = with_order(config, axis, 2)
    fit: list[Fit] = ["noise", "delay", "plant", "gain"]
    found = quietly(lambda: pf.tune([run], config, fit=fit, trust="tracker", validate=run))
    return run, found.config


def scan_errors(run: pf.Run, config: pf.FusionConfig, *sensors: str) -> dict[str, float]:
    est = quietly(lambda: pf.fuse(run, config, sensors=sensors))
    return {axis: one.score.rmse_mm for axis, one in pf.summarise(est).axes.items() if one.score}


@pytest.mark.long
def test_the_shipped_scan_is_tuned_as_well_as_it_was_by_hand() -> None:
    """Log-likelihoods at least 4800, 6600 and 7150; errors on the reference, which played no part, are bounded, too.

    At most 0.076, 0.051 and 0.050 mm by tracker and camera, 0.300, 0.192 and 0.160 mm by the camera alone.
    """
    run, config = tuned_scan()
    axes = ("tangential", "radial", "vertical")
    likelihood = Likelihood([run], config, ["tracker"])
    totals = dict(zip(likelihood.axes, likelihood.evaluate(config).axes.tolist(), strict=True))
    assert all(totals[axis] >= least for axis, least in zip(axes, (4800.0, 6600.0, 7150.0), strict=True)), totals
    for sensors, most in ((["tracker", "vision"], (0.076, 0.051, 0.050)), (["vision"], (0.300, 0.192, 0.160))):
        errors = scan_errors(run, config, *sensors)
        assert all(errors[axis] <= limit for axis, limit in zip(axes, most, strict=True)), (sensors, errors)

"""A part of a run: commands before it count, measurements outside it do not, and the arm does not pretend to rest."""

from dataclasses import replace

import numpy as np
import pytest

import pumafuse as pf
from fusion.test_oracle import GRID, MODES, MS, NOISE, PANEL, TRACKER, UNDER, VISION, Case, one, replace_, warned
from fusion_oracle import AxisOracle, check_estimates, check_innovations, nanoseconds
from pumafuse.logs.source import Source
from pumafuse.tuning.likelihood import Likelihood
from refusals import one_line
from tuning_runs import outage

quiet = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
PARTS = {
    "gain and recovery": Case(one(UNDER, gain=pf.Gain(slope=0.08, intercept=0.93), gain_recovery=0.1)),
    "disturbance, bias and latencies": Case(
        one(UNDER),
        process=replace_(NOISE, disturbance_sd=2e-3, disturbance_time=0.2),
        seen={"panel": PANEL, "vision": VISION, "tracker": TRACKER},
    ),
    "grid and nanosecond stamps": Case(origin=1_700_000_000_123_456_789, rate=150.0),
}


def cut(run: pf.Run, since: float, until: float = np.inf) -> pf.Run:
    """A file cut there: no row of any source is before or after, and nobody knows where the arm rested."""
    origin = run.command.stamp[0]

    def kept(_: str, source: Source) -> Source:
        seconds = (source.stamp - origin) / 1e9
        return source.rows((seconds >= since) & (seconds <= until))

    return replace(run.each(kept), start={})


def with_all_commands(run: pf.Run, since: float, until: float) -> pf.Run:
    """A file without measurements before, and without anything after."""
    return replace(cut(run, since, until), command=cut(run, -np.inf, until).command, start=run.start)


@pytest.mark.parametrize(("case", "how"), list(zip(PARTS.values(), MODES, strict=True)), ids=PARTS)
def test_a_part_is_the_conditional_gaussian_given_its_measurements(case: Case, how: str) -> None:
    """In mid-motion: means, error bars and innovations given all commands, and what is stamped from 150 to 360 ms."""
    run, config = case.made()
    with warned(run.between(0.15, 0.36), config):
        est = pf.fuse(run.between(0.15, 0.36), config, rate=case.rate, **MODES[how])
    times, oracle = nanoseconds(est), AxisOracle(with_all_commands(run, 0.15, 0.36), config, "radial")
    grid = GRID if case.rate is None else np.rint(np.arange(99) * 1e9 / case.rate).astype(np.int64)
    ends = [one.stamp if how == "as_live" else one.valid for one in oracle.measurements]
    last = max(oracle.commands.given[-1], *ends)
    assert times.tolist() == grid[(grid >= 150 * MS) & (grid <= last)].tolist()
    assert 0 < len(oracle.measurements) < sum(len(source.stamp) for source in run.sensors.values())
    check_innovations(est.measurements, oracle)
    check_estimates(est["radial"], getattr(oracle, how)(times))


@quiet
def test_a_part_from_the_beginning_is_a_file_that_ends_there() -> None:
    """Estimates, outcomes, skill and notes to the last bit, but for the reference at the very end."""
    sim = outage(1)
    part, file = (pf.fuse(run, sim.config) for run in (sim.run.between(until=2.0), cut(sim.run, 0.0, 2.0)))
    assert part["tangential"].position.tolist() == file["tangential"].position.tolist()
    one, other = pf.summarise(part), pf.summarise(file)
    assert (one.from_s, one.to_s) == (None, 2.0)
    counts = one.commands, *one.rows.values()
    assert all(count.pop("outside") > 0 for count in counts)  # rows that the shorter file does not have
    assert replace_(one, to_s=None) == other


@quiet
def test_tuning_on_a_part_is_tuning_on_its_measurements() -> None:
    """The likelihood is that of a file without the others, and a search leaves the rest of the part for validation."""
    sim = outage(1)
    part, file = sim.run.between(1.0, 3.0), with_all_commands(sim.run, 1.0, 3.0)
    assert Likelihood([part], sim.config).evaluate(sim.config).axes.tolist() == pytest.approx(
        Likelihood([file], sim.config).evaluate(sim.config).axes.tolist(), abs=1e-9
    )
    found = pf.tune([part], sim.config, fix=["process"])
    assert found.details.parts == {sim.run.name: (1.0, 3.0)}
    assert {check.since_s for check in found.details.validation or []} == {1.0 + 2.0 / 3.0 * 2.0}
    assert len({check.axis for check in found.details.validation or []}) == 2


@quiet
def test_a_part_that_cannot_be_used_is_one_line() -> None:
    """No interval, nothing measured or asked for there, and a clock that was set back."""
    sim = outage(1)
    for since, until in ((2.0, 1.0), (-1.0, None), (float("nan"), None), (np.inf, None), (0.0, 0.0)):
        assert "no interval" in one_line(pf.RunError, lambda since=since, until=until: sim.run.between(since, until))
    for since, until, said in (
        (100.0, 200.0, "no measurement"),
        (1e300, None, "no measurement"),
        (0.985, 1.005, "no command"),
        (1.0, 1.0 + 2e-9, "no meas"),
    ):
        part = sim.run.between(since, until)
        line = one_line(pf.RunError, lambda part=part: pf.fuse(part, sim.config))
        assert said in line, line
    whole = pf.fuse(sim.run.between(0.0, 1e300), sim.config)
    assert np.array_equal(whole["vertical"].position, pf.fuse(sim.run, sim.config)["vertical"].position)
    back = sim.run.each(lambda _, one: replace(one, stamp=one.stamp - (one.stamp > 2e9) * 3_600_000_000_000))
    assert len(pf.fuse(back, sim.config).segments) == 2
    assert "set back" in one_line(pf.RunError, lambda: pf.fuse(back.between(1.0), sim.config))

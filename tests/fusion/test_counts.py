"""No row of a log is lost: each source's rows add up to those of its file, by what became of them."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import pumafuse as pf
from fusion.test_segments import MS, ORIGIN, SECOND, TICK, A, config, crowded_runs, measurements, nan, properties
from pumafuse.arrays import NO_STAMP
from pumafuse.fusion import results
from pumafuse.fusion.summary import summarise
from pumafuse.logs.source import Source
from tuning_runs import scenario

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
WORDS = {"fused", "rejected", "reacquired", "duplicate", "before_start", "too_late", "invalid", "unknown"} | {
    *("no_stamp", "stray", "outside", "not_selected")
}
OF_COMMANDS = {"used", "duplicate", "repetition", "invalid", "no_stamp", "stray", "outside"}


@st.composite
def hostile_commands(draw: st.DrawFn) -> tuple[list[int], dict[str, list[float]]]:
    """Rows at the same stamps, out of order, stray, without a stamp or a value, that repeat one another."""
    stamp = st.one_of(
        st.integers(0, 12).map(lambda step: ORIGIN + step * TICK // 4),
        st.sampled_from([NO_STAMP, ORIGIN + SECOND * 50, ORIGIN - SECOND * 50]),
    )
    value = st.sampled_from([0.0, 0.5, 0.6, nan, 1e9])
    rows = draw(st.lists(st.tuples(stamp, value, value), min_size=1, max_size=20))
    return [row[0] for row in rows], {"radial": [row[1] for row in rows], "vertical": [row[2] for row in rows]}


@settings(properties, max_examples=40)
@given(
    crowded_runs(),
    hostile_commands(),
    st.sampled_from([None, ["a"], ["a", "b"]]),
    st.sampled_from([(None, None), (0.0, 0.05), (0.02, None), (None, 0.03)]),
    st.sampled_from(["filtered", "as-live"]),
)
def test_every_row_is_counted_once(
    case: tuple[pf.Run, pf.FusionConfig],
    commands: tuple[list[int], dict[str, list[float]]],
    sensors: list[str] | None,
    part: tuple[float | None, float | None],
    mode: str,
) -> None:
    """Whatever its stamp, whatever part is used, whichever sensors: the counts add up to the rows of the file."""
    run, conf = case
    try:
        run = replace(run, command=pf.Run.from_arrays(*commands).command).between(*part)
        est = pf.fuse(run, conf, sensors=sensors, mode=mode)  # pyright: ignore
    except pf.PumafuseError:
        assume(False)
    summary = summarise(est)
    assert sum(summary.commands.values()) == len(run.command.stamp) and summary.commands.keys() <= OF_COMMANDS
    assert summary.rows.keys() == run.sensors.keys()
    for name, counts in summary.rows.items():
        assert sum(counts.values()) == len(run.sensors[name].stamp), (name, counts)
        assert min(counts.values()) > 0 and counts.keys() <= WORDS


def test_every_reason_by_its_name() -> None:
    """A row of each kind, of commands and of a sensor; of two axes the better outcome counts."""
    given_at = [0, 28, 28, 35, 56, 84, 112, 140, 50_000, 168, 196]
    stamp = [ORIGIN + at * MS for at in given_at] + [NO_STAMP]
    value = [0.5, 0.51, 0.52, 0.52, nan, 0.53, 0.54, 0.55, 0.56, 0.57, 0.58, 0.59]
    rows = [(5.0, 0.5), (5.0, 0.5), (-20.0, 0.5), (10.0, nan), (nan, 0.5), (60_000.0, 0.5), (15.0, 0.5), (150.0, 0.5)]
    rows += [(20.0, 0.5), (25.0, 90.0)]
    sensors = {"a": measurements(*rows), "stranger": measurements((5.0, 0.5)), "b": measurements((5.0, 0.5))}
    conf = config(a=msgspec.structs.replace(A, gate=5.0), b=A)
    run = pf.Run.from_arrays(stamp, {"radial": value}, sensors).between(None, 0.1)
    est = pf.fuse(run, conf)
    assert est.command_counts == {
        "used": 3, "duplicate": 1, "repetition": 1, "invalid": 1, "no_stamp": 1, "stray": 1, "outside": 4
    }  # fmt: skip
    assert est.counts["a"] == {
        "fused": 3, "rejected": 1, "duplicate": 1, "before_start": 1, "invalid": 1, "no_stamp": 1, "stray": 1,
        "outside": 1,
    }  # fmt: skip
    assert est.counts["stranger"] == {"unknown": 1} and est.counts["b"] == {"fused": 1}
    assert pf.fuse(run, conf, sensors=["a"]).counts["b"] == {"not_selected": 1}


def test_a_row_of_several_axes_counts_by_the_best_of_them() -> None:
    """One axis of it is enough for the filter."""
    seen = [ORIGIN + 10 * MS, ORIGIN + 20 * MS], {"radial": [nan, nan], "vertical": [0.5, nan]}
    run = pf.Run.from_arrays([ORIGIN, ORIGIN + TICK], {"radial": [0.5, 0.5], "vertical": [0.5, 0.5]}, {"a": seen})
    assert pf.fuse(run, config(a=A)).counts["a"] == {"fused": 1, "invalid": 1}


@pytest.mark.parametrize("how", [{"mode": "as-live"}, {"mode": "smoothed"}, {"engine": "filterpy"}], ids=str)
def test_stray_rows_change_no_estimate(how: dict[str, str]) -> None:
    """To the bit, of each source one ahead, one behind and one behind at its end, in a log in x, y, z.

    What a sensor has behind is too late.
    """
    made = pf.simulate(scenario("cylindrical-cartesian", 0.04, 0.02))

    def strayed(_: str, one: Source) -> Source:
        end = len(one.stamp)
        rows = one.rows(np.insert(np.arange(end), [10, 20, end], [10, 20, end - 1]))
        rows.stamp[[10, 21, end + 2]] += np.array([3600, -12, -100]) * SECOND
        return rows

    got, wanted = (pf.fuse(run, made.config, **how) for run in (made.run.each(strayed), made.run))
    assert got.to_arrow().equals(wanted.to_arrow()) and got.biases == wanted.biases
    used = [est.measurements.where(np.isfinite(est.measurements.innovation)) for est in (got, wanted)]
    for field in pf.Measurements.ARRAYS:
        np.testing.assert_array_equal(getattr(used[0], field), getattr(used[1], field))
    tables = [results.reference_table(est.reference, est.config) for est in (got, wanted)]
    assert tables[0].equals(tables[1])
    assert got.command_counts["stray"] == 3
    assert {(counts["stray"], counts["too_late"]) for counts in got.counts.values()} == {(1, 2)}
    assert any("command" in note and "stray" in note for note in got.notes)

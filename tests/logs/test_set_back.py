"""Clocks that are set back within a recorded run: their stamps go on; what only comes out of order is left alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.errors import RunError
from pumafuse.fusion.results import Recipe
from pumafuse.logs.set_back import drop_steps_back
from pumafuse.logs.source import Source
from pumafuse.pieces import fusing

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
SPAN = 20.0  # s
RATES = {"tracker": 100.0, "camera": 30.0}  # Hz
CONFIG = pf.FusionConfig(
    arm=pf.ArmModel.load("puma560-internal"), sensors={"tracker": pf.Sensor(sd=1e-4), "camera": pf.Sensor(sd=5e-4)}
)


def moved(t: np.ndarray) -> np.ndarray:
    return 0.5 + 0.05 * np.sin(1.5 * t)


def logged(
    steps: dict[float, float] | None = None,
    only: str | None = None,
    rates: dict[str, float] = RATES,
    jitter: float = 0.0,
    seed: int = 1,
) -> pf.Run:
    """A run whose clocks are set back: by how much [s] at which instants [s], of all sources or ``only`` one."""
    rng = np.random.default_rng(seed)

    def source(name: str, interval: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        t = np.arange(0.0 if name == "command" else 0.05, SPAN, interval)
        t = t + rng.uniform(0.0, jitter * interval, len(t)) if name != "command" else t
        value = moved(t if name == "command" else t - 0.1) + (name != "command") * rng.normal(0.0, 1e-4, len(t))
        for at, back in (steps or {}).items() if only in (None, name) else ():
            t = np.where(np.arange(len(t)) >= np.searchsorted(t, at), t - back, t)
        return np.rint(t * 1e9).astype(np.int64), {"radial": value}

    sensors = {name: source(name, 1.0 / rate) for name, rate in rates.items()}
    return pf.Run.from_arrays(*source("command", 0.028), sensors)


@pytest.mark.parametrize(
    ("rates", "back"), [({"tracker": 1000.0, "camera": 5.0}, 0.1), ({"tracker": 100.0, "camera": 2.0}, 0.9)]
)
def test_stamps_go_on_where_all_clocks_are_set_back(back: float, rates: dict[str, float]) -> None:
    """As in a run whose clocks were right, with a note of how much and where; every estimate is its estimate."""
    run, right = logged({8.0: back}, rates=rates), logged(rates=rates)
    found, (note,) = drop_steps_back(run)
    assert f"all clocks are set back by {back:.3f} s in row 287: stamps go on" in note
    for name, source in {"command": found.command, **found.sensors}.items():
        expected = right.command if name == "command" else right.sensors[name]
        assert np.abs(source.stamp - expected.stamp).max() <= 1
    est = pf.fuse(run, CONFIG)
    assert note in est.notes
    np.testing.assert_allclose(est.axes["radial"].position, pf.fuse(right, CONFIG).axes["radial"].position, atol=1e-9)


def test_sensors_that_do_not_sample_evenly_go_on_too() -> None:
    """Stamps that scatter by a third of their interval: to a few ms, by the commands, which are even."""
    run, right = logged({8.0: 0.4}, jitter=0.3, seed=1), logged(jitter=0.3, seed=1)
    found, notes = drop_steps_back(run)
    assert len(notes) == 1
    assert np.abs(found.sensors["camera"].stamp - right.sensors["camera"].stamp).max() < 5e6


def test_several_steps_go_on() -> None:
    run, right = logged({5.0: 0.4, 9.0: 0.2, 15.0: 0.7}), logged()
    found, notes = drop_steps_back(run)
    assert [one.split(" by ")[1][:5] for one in notes] == ["0.400", "0.200", "0.700"]
    assert np.abs(found.command.stamp - right.command.stamp).max() <= 3


@pytest.mark.parametrize(("back", "rates"), [(0.03, RATES), (0.04, RATES), (0.05, {"tracker": 100.0})])
def test_a_step_of_one_command_is_seen_where_a_sensor_is_dense(back: float, rates: dict[str, float]) -> None:
    """One command alone is behind, at once with three rows or more of a sensor."""
    found, notes = drop_steps_back(logged({8.0: back}, rates=rates))
    assert len(notes) == 1
    assert np.abs(found.command.stamp - logged().command.stamp).max() <= 1
    assert drop_steps_back(logged({8.0: back}, rates={"camera": 25.0}))[1] == []


@pytest.mark.parametrize(("rate", "back", "is_set"), [(1000.0, 0.1, True), (10.0, 0.9, False)])
def test_a_reference_may_have_a_clock_that_goes_on(rate: float, back: float, is_set: bool) -> None:
    """Then its stamps are left as they are, which is said."""
    (right,) = logged(rates={"truth": rate}).sensors.values()
    (stepped,) = logged({8.0: back}, rates={"truth": rate}).sensors.values()
    found, (note,) = drop_steps_back(replace(logged({8.0: back}), reference=stepped if is_set else right))
    assert note.endswith("stamps go on from there" if is_set else "; that of the reference is not")
    assert np.abs(found.reference.stamp - right.stamp).max() <= 1
    assert np.abs(found.command.stamp - logged().command.stamp).max() <= 1


def test_one_sensor_alone_is_named_and_left() -> None:
    run = logged({8.0: 0.06}, only="tracker")
    found, (note,) = drop_steps_back(run)
    assert found is run
    assert note.startswith("tracker: its clock is set back by 0.060 s in row 796, and others are not")


def test_commands_alone_are_not_all() -> None:
    run = logged({8.0: 0.3}, only="command")
    assert drop_steps_back(run)[0] is run


@settings(max_examples=150)
@given(
    st.sampled_from(["late block", "swapped", "twice", "shuffled", "gaps"]), st.integers(0, 10_000), st.floats(0.0, 0.9)
)
def test_rows_out_of_order_are_no_clock(what: str, seed: int, jitter: float) -> None:
    """Blocks that come late, neighbours that change places, rows that come twice, any order within half a second."""
    rng = np.random.default_rng(seed)

    def changed(source: Source) -> Source:
        count = len(source.stamp)
        order = np.arange(count)
        if what == "late block":
            begin, length, later = rng.integers(30, count - 100), rng.integers(1, 40), rng.integers(1, 30)
            block, rest = order[begin : begin + length], np.delete(order, slice(begin, begin + length))
            order = np.insert(rest, min(begin + later, len(rest)), block)
        elif what == "swapped":
            for row in rng.integers(1, count, 20).tolist():
                order[[row - 1, row]] = order[[row, row - 1]]
        elif what == "twice":
            order = np.insert(order, rng.integers(0, count, 20), rng.integers(0, count, 20))
            order = order[np.abs(order - np.arange(len(order))) < 40]
        elif what == "shuffled":
            order = np.argsort(source.stamp + rng.uniform(0.0, 0.5e9, count))
        else:
            order = order[rng.random(count) > 0.3]
        return source.rows(order)

    run = logged(jitter=jitter, seed=seed)
    run = run.each(lambda _, source: changed(source))
    assert drop_steps_back(run) == (run, [])


def test_a_long_run_is_to_be_cut_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Piece by piece nothing moves what comes after: one line."""
    run = logged({8.0: 0.3})
    for name, source in {"command": run.command, **run.sensors}.items():
        table = pa.table({"time_ns": source.stamp, "radial_m": source.values["radial"]})
        pq.write_table(table, tmp_path / f"{name}.parquet")
    heads = {"command": "command", **{name: f"sensors.{name}" for name in run.sensors}}
    lines = [
        f"[{head}]\nfile = '{name}.parquet'\ntime = 'time_ns'\nradial = 'radial_m'\n" for name, head in heads.items()
    ]
    (tmp_path / "run.toml").write_text("\n".join(lines))
    monkeypatch.setattr(fusing, "PIECE", 1000)
    with pytest.raises(RunError, match=r"all clocks are set back by 0\.300 s .* cut the log there"):
        fusing.fuse_to(tmp_path, tmp_path / "out", Recipe(CONFIG))
    whole = pf.Run.read(tmp_path)
    assert np.abs(drop_steps_back(whole)[0].command.stamp - logged().command.stamp).max() <= 1

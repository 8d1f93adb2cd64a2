"""A run that is saved is the run that is read."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse import Run
from pumafuse.arrays import NO_STAMP
from pumafuse.errors import RunError
from pumafuse.logs.frames import Cylindrical, Rotated
from pumafuse.logs.save import save
from pumafuse.logs.source import Source
from refusals import one_line

DAYS_26 = 26 * 86400 * 10**9
TAKEN = ["commands", "truth", "../eye", "/tmp/eye", "", ".eye", "a\0b"]
stamps = st.lists(st.one_of(st.integers(-DAYS_26, DAYS_26), st.just(NO_STAMP)), min_size=1, max_size=8)
nanometres = st.one_of(st.integers(-(10**12), 10**12), st.just(None))


def source(stamp: list[int], values: Mapping[str, list[int | None]], label: str = "s") -> Source:
    # Whole nanometres, as the nearest float that a file in mm gives.
    columns = {
        axis: np.array([np.nan if nm is None else float(f"{nm}e-6") / 1e3 for nm in value])
        for axis, value in values.items()
    }
    return Source(np.array(stamp, dtype=np.int64), columns, label)


def through(run: Run) -> Run:
    with TemporaryDirectory() as folder:
        save(run, Path(folder))
        return Run.read(folder)


def same(one: Source, other: Source) -> None:
    assert (one.stamp == other.stamp).all()
    assert list(one.values) == list(other.values)
    for axis in one.values:
        assert np.array_equal(one.values[axis], other.values[axis], equal_nan=True)


@st.composite
def sources(draw: st.DrawFn, axes: tuple[str, ...]) -> Source:
    stamp = draw(stamps)
    values = {axis: draw(st.lists(nanometres, min_size=len(stamp), max_size=len(stamp))) for axis in axes}
    return source(stamp, values)


def test_arrivals_come_back() -> None:
    command = replace(source([0, 28_000_000], {"x": [1, 2]}), arrival=np.array([5, 28_000_009]))
    again = through(Run("log", command, {"eye": source([0], {"x": [3]})}))
    assert again.command.arrival.tolist() == [5, 28_000_009] and len(again.sensors["eye"].arrival) == 0


@settings(max_examples=60)
@given(sources(("radial", "vertical")), sources(("radial",)), sources(("vertical", "radial")))
def test_any_rows_come_back_to_the_last_bit(command: Source, eye: Source, ear: Source) -> None:
    """Stamps to the ns, lengths to the nm; missing stamps and values stay missing, order and axes stay."""
    command.stamp[0] = 0
    for value in command.values.values():
        value[0] = 0.001
    again = through(Run("any", command, {"eye": eye, "ear": ear}))
    same(command, again.command)
    assert list(again.sensors) == ["eye", "ear"]
    same(eye, again.sensors["eye"])
    same(ear, again.sensors["ear"])
    assert again.reference is None


def plain(**different: object) -> Run:
    given = {"time": [0.0, 0.028], "command": {"radial": [0.5, 0.501]}, "name": "plain"}
    return Run.from_arrays(**(given | different))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "frame",
    [
        None,
        Cylindrical(base=(0.0123456789, -1.1), positive="clockwise"),
        Rotated(azimuth=math.radians(37.25), positive="clockwise"),
    ],
)
def test_frame_start_clock_and_reference_come_back(frame: Cylindrical | Rotated | None) -> None:
    """Everything of a run but its notes, whatever characters its name has."""
    run = plain(
        name='a = [1], "ä"\tb\\c',
        frame=frame,
        clock="regular",
        start={"radial": 0.123456789},
        reference=([0.0, 0.01], {"radial": [0.5, 0.6]}),
        reference_sd=0.00002,
    )
    again = through(run)
    assert (again.name, again.frame, again.clock, again.start) == (run.name, run.frame, run.clock, run.start)
    assert run.reference is not None and again.reference is not None
    same(run.reference, again.reference)
    assert again.reference.sd == 0.00002


@pytest.mark.parametrize("name", ["two words", "a.b", *TAKEN])
def test_a_sensors_file_spoils_no_other(name: str, tmp_path: Path) -> None:
    """A name that would write another file is refused before anything is written; with any other all is read back."""
    rows = ([0.01], {"radial": [0.7]})
    run, folder = plain(sensors={"eye": rows, name: rows}, reference=rows), tmp_path / "run"
    folder.mkdir()
    if name in TAKEN:
        assert "its rows go into a file of its name" in one_line(RunError, lambda: save(run, folder))
        assert not list(folder.iterdir())
    else:
        save(run, folder)
        again = Run.read(folder)
        same(run.command, again.command)
        same(run.sensors[name], again.sensors[name])
    assert [path.name for path in tmp_path.iterdir()] == ["run"]

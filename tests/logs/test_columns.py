"""Field paths and stamps: what pure Python finds in the rows and on the clock, and one line for anything else."""

from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.arrays import NO_STAMP
from pumafuse.errors import PumafuseError, RunError
from pumafuse.logs import tables
from pumafuse.logs.columns import Table
from refusals import one_line

GIGA = 10**9
LAST = 4_599_999_999 * GIGA  # ns, within reach
EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)  # noqa: UP017 - beside timezone(…)
properties = settings(max_examples=50)

names = st.sampled_from(["x", "position", "höhe", "a b", "0"])
shapes: st.SearchStrategy[Any] = st.recursive(
    st.just(float),
    lambda inner: st.one_of(
        st.dictionaries(names, inner, min_size=1, max_size=3),
        st.lists(inner, min_size=1, max_size=1),  # a list of this
        st.tuples(inner, st.integers(1, 3)),  # a list of this and so many
    ),
    max_leaves=6,
)


def kind(shape: Any) -> pa.DataType:
    if isinstance(shape, dict):
        return pa.struct([(name, kind(inner)) for name, inner in shape.items()])
    if isinstance(shape, list):
        return pa.list_(kind(shape[0]))
    return pa.list_(kind(shape[0]), shape[1]) if isinstance(shape, tuple) else pa.float64()


def cells(shape: Any) -> st.SearchStrategy[Any]:
    """What a row may hold, nothing at any depth included."""
    if isinstance(shape, dict):
        found: st.SearchStrategy[Any] = st.fixed_dictionaries({name: cells(inner) for name, inner in shape.items()})
    elif isinstance(shape, list):
        found = st.lists(cells(shape[0]), max_size=3)
    elif isinstance(shape, tuple):
        found = st.lists(cells(shape[0]), min_size=shape[1], max_size=shape[1])
    else:
        found = st.floats(-1e3, 1e3)
    return st.none() | found


def walk(data: st.DataObject, shape: Any) -> tuple[str, list[str | int]]:
    """A path from a column to a number, as text and in steps."""
    text, steps = "column", list[str | int]()
    while shape is not float:
        if isinstance(shape, dict):
            steps.append(data.draw(st.sampled_from(sorted(shape))))
            text, shape = f"{text}.{steps[-1]}", shape[steps[-1]]
        else:
            steps.append(data.draw(st.integers(0, 3)))
            text, shape = f"{text}[{steps[-1]}]", shape[0]
    return text, steps


def reached(cell: Any, steps: list[str | int]) -> Any:
    for step in steps:
        if cell is None or (isinstance(step, int) and step >= len(cell)):
            return None
        cell = cell[step]
    return cell


def chunked(values: list[Any], of: pa.DataType, cut: int) -> pa.ChunkedArray:
    return pa.chunked_array([pa.array(values[:cut], of), pa.array(values[cut:], of)], of)


@properties
@given(st.data(), shapes)
def test_a_path_finds_what_python_finds_in_each_row(data: st.DataObject, shape: Any) -> None:
    """At any depth of structs and lists, in any chunks; null, or a list that is too short, is missing."""
    rows = data.draw(st.lists(cells(shape), max_size=6))
    path, steps = walk(data, shape)
    columns = {"column": chunked(rows, kind(shape), data.draw(st.integers(0, len(rows))))}
    wanted = [reached(row, steps) for row in rows]
    try:
        found = Table(Path("log"), columns, len(rows), ()).column(path).to_pylist()
    except RunError as error:
        assert "no row has an element" in str(error)
        assert set(wanted) == {None}
    else:
        assert found == wanted


@properties
@given(st.data(), st.lists(st.lists(st.sampled_from("abc"), unique=True, max_size=3), min_size=1, max_size=8))
def test_an_element_by_name_is_the_one_at_the_place_of_its_name(data: st.DataObject, rows: list[list[str]]) -> None:
    """In each row anew; a row without the name, or with fewer values than names, has none."""
    values = [data.draw(st.lists(st.floats(-1, 1), max_size=3)) for _ in rows]
    cut = data.draw(st.integers(0, len(rows)))
    of = {"name": pa.list_(pa.string()), "position": pa.list_(pa.float64())}
    columns = {"name": chunked(rows, of["name"], cut), "position": chunked(values, of["position"], len(rows) - cut)}
    known = [dict(zip(row, value, strict=False)).get("b") for row, value in zip(rows, values, strict=True)]
    table = Table(Path("log"), columns, len(rows), ())
    if set(known) == {None}:
        assert "no row has an element 'b'" in one_line(RunError, lambda: table.column("position[b]"))
    else:
        assert table.column("position[b]").to_pylist() == known


NESTED = pa.table(
    {
        "t_s": [0.0, 1.0],
        "a": [{"b": [1.0, 2.0], "name": ["x", "y"]}, None],
        "a.b": pa.array([None, None], pa.list_(pa.float64())),
        "name": [["x"], ["y", "x"]],
        "position": [[1.0], [2.0, 3.0]],
        "word": ["a", None],
        "map": pa.array([[("k", 1)], []], pa.map_(pa.string(), pa.int64())),
        "none": pa.nulls(2),
    }
)
WHOLE = Table(Path("log"), dict(zip(NESTED.column_names, NESTED.columns, strict=True)), 2, ())


@properties
@given(
    st.text(alphabet="ab.[]01xyname_s", max_size=12)
    | st.sampled_from(sorted(WHOLE.columns)).flatmap(
        lambda name: st.text(alphabet=".[]01xnb", max_size=8).map(name.__add__)
    )
)
def test_whatever_a_path_is_it_is_a_column_or_one_line(path: str) -> None:
    for ask in (WHOLE.column, WHOLE.numbers, WHOLE.stamps, WHOLE.zoned, lambda name: WHOLE.numbers(name, "_m")):
        try:
            ask(path)
        except PumafuseError as error:
            assert len(str(error).splitlines()) == 1


def one_column(values: Any, of: pa.DataType | None = None) -> Table:
    return Table(Path("log"), {"t": pa.chunked_array([pa.array(values, of)])}, len(values), ())


@properties
@given(st.data(), st.sampled_from(["", "Z", "z", "offset"]), st.sampled_from([0, 1, 3, 6, 9]))
def test_iso_dates_are_what_the_standard_library_says(data: st.DataObject, zone: str, digits: int) -> None:
    """With and without a zone, with any number of decimals; a blank cell is missing, a word is noted."""
    cells, wanted = list[str](), list[int]()
    for ns in data.draw(st.lists(st.integers(-LAST, LAST), min_size=1, max_size=5)):
        ns -= ns % 10 ** (9 - digits)
        hours, minutes = data.draw(st.tuples(st.integers(-12, 14), st.sampled_from([0, 30])))
        offset = timedelta(hours=hours, minutes=minutes) if zone == "offset" else timedelta()
        local = EPOCH + timedelta(seconds=ns // GIGA) + offset
        fraction = f"{ns % GIGA:09d}"[:digits]
        point = data.draw(st.sampled_from(".,")) if digits else ""
        text = f"{local:%Y-%m-%d}{data.draw(st.sampled_from('T '))}{local:%H:%M:%S}{point}{fraction}"
        total = int(offset.total_seconds()) // 60
        colon = data.draw(st.sampled_from([":", ""]))
        sign = "-" if total < 0 else "+"
        suffix = f"{sign}{abs(total) // 60:02d}{colon}{abs(total) % 60:02d}" if zone == "offset" else zone
        cells.append(f" {text}{suffix}")
        wanted.append(ns)
    found, note = one_column([*cells, "", None]).stamps("t")
    assert found.tolist() == [*wanted, NO_STAMP, NO_STAMP]
    assert note is None
    _, note = one_column([*cells, "tomorrow"]).stamps("t")
    assert "1 cell of column 't' without a date, first 'tomorrow'" in str(note)
    assert one_column(cells).zoned("t") is (zone != "")


@settings(max_examples=100)
@given(st.sampled_from(["s", "ms", "us", "ns"]), st.sampled_from([None, "UTC", "Europe/Berlin", "+05:30"]), st.data())
def test_arrow_timestamps_are_exact(unit: str, zone: str | None, data: st.DataObject) -> None:
    """In any unit; a zone changes how they are shown, not when they are."""
    per = {"s": GIGA, "ms": 10**6, "us": 10**3, "ns": 1}[unit]
    ticks = data.draw(st.lists(st.none() | st.integers(-LAST // per, LAST // per), min_size=1, max_size=5))
    wanted = [NO_STAMP if tick is None else tick * per for tick in ticks]
    table = one_column(ticks, pa.timestamp(unit, zone))
    assert table.stamps("t")[0].tolist() == wanted
    assert table.zoned("t") is (zone is not None)


SIGNED = (pa.int64(), pa.decimal128(20, 0), pa.string())


@properties
@given(
    st.lists(st.none() | st.integers(-LAST, LAST), min_size=1, max_size=6),
    st.sampled_from(SIGNED),
    st.sampled_from([pa.uint32(), pa.int64(), pa.float64()]),
)
def test_seconds_and_nanoseconds_apart_are_exact(
    stamps: list[int | None], first: pa.DataType, second: pa.DataType
) -> None:
    """Of any type of whole numbers; if either is missing, so is the stamp."""
    seconds = [None if one is None else one // GIGA for one in stamps]
    rest = [None if one is None else one % GIGA for one in stamps]
    of = {"sec": pa.array(seconds, pa.int64()).cast(first), "nanosec": pa.array(rest, pa.int64()).cast(second)}
    table = Table(Path("log"), {name: pa.chunked_array([array]) for name, array in of.items()}, len(stamps), ())
    found, note = table.stamps("sec", "nanosec")
    assert found.tolist() == [NO_STAMP if one is None else one for one in stamps]
    assert note is None


@pytest.mark.parametrize("names", [("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos")])
def test_a_struct_of_seconds_and_nanoseconds_is_a_stamp(names: tuple[str, str]) -> None:
    """ROS 2, ROS 1, and Foxglove's schemas in JSON and Protobuf; a null struct is missing."""
    rows = [dict(zip(names, (1_700_000_000, 123_456_789), strict=True)), None]
    assert one_column(rows).stamps("t")[0].tolist() == [1_700_000_000_123_456_789, NO_STAMP]


@pytest.mark.parametrize(
    "cells", [["2024-01-01T00:00:00Z", "1.5"], ["2024-01-01T00:00:00", "2024-01-01T00:00:00Z"], ["12:00:00", "1.5"]]
)
def test_stamps_written_in_two_ways_are_refused(cells: list[str]) -> None:
    """Dates and numbers, and dates with and without a zone, would be of two clocks; both rows are named."""
    text = one_line(RunError, lambda: one_column(cells).stamps("t"))
    assert "row 1" in text and "row 2" in text


@pytest.mark.parametrize(
    ("cell", "ns"),
    [
        ("12:34:56.789", 45_296_789_000_000),
        ("0:00:01", GIGA),
        ("0 days 00:00:01.500000", 1_500_000_000),  # pandas
        ("02:05.5", 125_500_000_000),  # minutes and seconds, as Excel shows them
        ("1 day, 0:00:00.000001", 86_400 * GIGA + 1_000),  # Python
        ("12:34:56:789", 45_296_789_000_000),  # LabVIEW
        ("12:00:00 AM", 0),
        ("13:00:00 PM", 46_800_000_000_000),  # hours of a day, marked all the same
        ("0.02 sec", 20_000_000),  # MATLAB
        ("1.2.1970 00:00:00.25", 31 * 86_400 * GIGA + 250_000_000),
        ("1970/01/02 00:00:00,5", 86_400 * GIGA + 500_000_000),
    ],
)
def test_times_as_programs_write_them(cell: str, ns: int) -> None:
    """Times of day and since the start, and dates with the day first or the year first."""
    table = one_column([cell, "", None])
    assert table.stamps("t")[0].tolist() == [ns, NO_STAMP, NO_STAMP]
    assert table.is_dated("t")


@pytest.mark.parametrize(
    ("cells", "first", "last", "leading"),
    [
        (["25/12/2026 9:05:03", "26/12/2026 0:00:01"], "2026-12-25T09:05:03", "2026-12-26T00:00:01", None),
        (["1/2/2026 9:00:00", "1/13/2026 9:00:00"], "2026-01-02T09:00:00", "2026-01-13T09:00:00", None),
        (["3/4/2026 11:59:59 PM", "3/5/2026 12:00:01 am"], "2026-03-04T23:59:59", "2026-03-05T00:00:01", "month"),
        (["3/4/2026 23:59:59", "4/4/2026 0:00:01"], "2026-04-03T23:59:59", "2026-04-04T00:00:01", "day"),
        (["25/12/26 9:05:03", "26/12/26 0:00:01"], "2026-12-25T09:05:03", "2026-12-26T00:00:01", None),
        (["2026-03-04 9:00:00 PM"], "2026-03-04T21:00:00", "2026-03-04T21:00:00", None),
        (["2031-07-28/6:59:59.25", "2031-07-29_00:00:01"], "2031-07-28T06:59:59.250", "2031-07-29T00:00:01", None),
    ],
)
def test_all_of_a_column_tells_which_number_of_a_date_is_the_day(
    cells: list[str], first: str, last: str, leading: str | None
) -> None:
    """A number above 12 is one; else the log is short; else it is said that the month was taken to come first."""
    found, note = one_column(["", *cells]).stamps("t")
    assert found[1:].astype("datetime64[ns]")[[0, -1]].tolist() == np.array([first, last], "datetime64[ns]").tolist()
    said = f"log: column 't': dates like {cells[0].split()[0]} are read with the {leading} first"
    assert note == (said if leading else None)


@pytest.mark.parametrize("cell", ["2/30/2026 1:00:00", "3/4/126 10:00:00"])
def test_what_is_no_date_with_slashes_is_refused(cell: str) -> None:
    """It is said how to write one."""
    text = one_line(RunError, lambda: one_column(["", cell]).stamps("t"))
    assert f"column 't', row 2: '{cell}' is no number and no ISO 8601 date (2026-" in text


NINES = st.sampled_from([999.0, -9999.0, 99999.0, 32767.0, -32768.0, 2147483647.0])


@properties
@given(st.lists(st.floats(-50.0, 50.0), min_size=12, max_size=40, unique_by=abs), NINES, st.data())
def test_a_number_that_stands_for_none_is_missing_and_noted(numbers: list[float], none: float, data: Any) -> None:
    """Wherever it stands and however often; all others stay what they are."""
    places = data.draw(st.lists(st.integers(0, len(numbers)), min_size=1, max_size=5))
    cells: list[float] = list(numbers)
    for place in places:
        cells.insert(place, none)
    found, note = one_column(cells).numbers("t", "_m")
    assert found[~np.isnan(found)].tolist() == numbers
    first = cells.index(none) + 1
    many = "1 cell" if len(places) == 1 else f"{len(places)} cells"
    assert f"{many} of column 't' with {none:.15g}, " in str(note) and f"first in row {first}: taken" in str(note)


@pytest.mark.parametrize("numbers", [[0.0, 999.0, 0.0, 999.0], [float(n) for n in range(1000)], [9999.0] * 50])
def test_a_number_of_nines_may_be_a_position(numbers: list[float]) -> None:
    """A step to 999 mm, a path that leads there, an axis at rest there."""
    found, note = one_column(numbers).numbers("t", "_mm")
    np.testing.assert_array_equal(found, np.array(numbers) / 1e3)
    assert note is None


@pytest.mark.parametrize("cell", ["2024-02-30T00:00:00", "2024-01-01T25:00:00", "1800-01-01T00:00:00"])
def test_dates_that_are_none_are_refused(cell: str) -> None:
    """A day, an hour or a century too many is one line with the column."""
    assert "'t'" in one_line(RunError, lambda: one_column([cell]).stamps("t"))


@properties
@given(st.lists(st.decimals(-(10**9), 10**9, places=9), min_size=1, max_size=5))
def test_decimal_seconds_are_exact(stamps: list[Any]) -> None:
    table = one_column(stamps, pa.decimal128(20, 9))
    assert table.stamps("t", unit="_s")[0].tolist() == [int(stamp * GIGA) for stamp in stamps]
    np.testing.assert_allclose(table.numbers("t", "_m")[0], [float(stamp) for stamp in stamps], rtol=1e-15)


def test_thousands_with_commas(tmp_path: Path) -> None:
    """Cells such as 1,000.123 are numbers where a point says what the comma is; 1,000 alone may be 1."""
    file = tmp_path / "log.csv"
    file.write_text('t_s,x_mm,y_mm\n0,"1,234.5","1,000"\n1,999.25,2\n2,"-12,345,678.125",3\n')
    table = tables.read(file)
    values, note = table.plain("x_mm")
    assert values.tolist() == [1234.5, 999.25, -12345678.125]
    assert note is None
    values, note = table.plain("y_mm")
    assert np.isnan(values[0])
    assert note is not None

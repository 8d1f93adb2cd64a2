"""Tables: columns in SI units to the last digit, and one clear line for whatever else a file may hold."""

import gzip
import json
import random
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as papq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pumafuse.arrays import NO_STAMP
from pumafuse.errors import PumafuseError, RunError, UnknownNameError
from pumafuse.logs import tables
from pumafuse.logs.tables import Table
from refusals import one_line

LENGTHS = {"_m": 0, "_cm": 2, "_mm": 3, "_um": 6}
TIMES = {"_s": 9, "_ms": 6, "_us": 3, "_ns": 0}
EPOCH_NS = 1_700_000_000_123_456_789  # int64 ns of today: float64 there has a grid of 256 ns
LAST_S = 4_599_999_999  # the last whole second within reach
FIRST_BLOCK = 1 << 20  # pyarrow guesses types from blocks of this size

properties = settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])


def csv(folder: Path, text: str | bytes, name: str = "log.csv") -> Table:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return tables.read(path)


def column(folder: Path, name: str, cells: list[str]) -> Table:
    """A table of one column and a second one, so that an empty cell is no empty line."""
    return csv(folder, "".join(f"{cell},0\n" for cell in [name, *cells]))


refusal = partial(one_line, PumafuseError)


def written(folder: Path, **columns: object) -> Table:
    papq.write_table(pa.table(columns), folder / "log.parquet")
    return tables.read(folder / "log.parquet")


@pytest.mark.parametrize("unit", LENGTHS)
@properties
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20))
def test_lengths_are_the_exact_quotient_by_their_unit(tmp_path: Path, unit: str, values: list[float]) -> None:
    got, note = column(tmp_path, f"x{unit}", [repr(value) for value in values]).numbers(f"x{unit}")
    assert got.tolist() == [float(Fraction(value) / 10 ** LENGTHS[unit]) for value in values]
    assert note is None


@pytest.mark.parametrize("unit", TIMES)
@properties
@given(st.data())
def test_whole_stamps_are_exact_in_every_unit(tmp_path: Path, unit: str, data: st.DataObject) -> None:
    """Integer stamps come out in ns without a rounding, wherever within reach they lie, also beside gaps and words."""
    limit = LAST_S * 10 ** (9 - TIMES[unit])
    stamps = data.draw(st.lists(st.integers(-limit, limit), min_size=1, max_size=20))
    bad = data.draw(st.lists(st.sampled_from(["", "NaN", " ", "word"]), max_size=1))
    got, note = column(tmp_path, f"t{unit}", [*map(str, stamps), *bad]).stamps(f"t{unit}")
    assert got.tolist() == [*(stamp * 10 ** TIMES[unit] for stamp in stamps), *([NO_STAMP] if bad else [])]
    assert (note is not None) == (bad == ["word"])


@pytest.mark.parametrize("unit", ["_s", "_ms", "_us"])
@properties
@given(st.lists(st.integers(-(10**15), 10**15), min_size=1, max_size=20))
def test_decimal_stamps_of_a_run_are_exact(tmp_path: Path, unit: str, stamps: list[int]) -> None:
    """Stamps with decimals down to 1 ns are exact as long as a run lasts, here up to 11 days."""
    cells = [f"{Decimal(stamp).scaleb(-TIMES[unit]):f}" for stamp in stamps]
    assert column(tmp_path, f"t{unit}", [*cells, "0.5"]).stamps(f"t{unit}")[0].tolist()[:-1] == stamps


BLANKS = ("", "NaN", "nan", "NA", "N/A", "NULL", "null", "None", '""')
WORDS = ("1_000", "0x10", "1e", "−1.5", "1 5", "٣")
CELLS = {
    **dict.fromkeys(BLANKS, np.nan),
    **dict.fromkeys(["+1.5", '"1.5"', "15e-1", "0001.5"], 1.5),
    "-inf": -np.inf,
    "1e400": np.inf,
    str(2**64): 2.0**64,
}


@pytest.mark.parametrize("words", [[], ["word"]])
@pytest.mark.parametrize("cell", [BLANKS[0], *list(CELLS)[len(BLANKS) :]])
def test_one_number_however_written(tmp_path: Path, cell: str, words: list[str]) -> None:
    """Also beside words; a blank cell is missing and no word; infinity is kept as a value and is no stamp."""
    values, note = column(tmp_path, "x_mm", ["1", cell, *words]).numbers("x_mm")
    np.testing.assert_allclose(values[:2], [1e-3, CELLS[cell] / 1e3], rtol=4e-16)
    assert (note is None) == (not words)
    if cell != str(2**64):
        ns = CELLS[cell] * 1e9
        stamps, _ = column(tmp_path, "t_s", ["1", cell, *words]).stamps("t_s")
        assert stamps[:2].tolist() == [10**9, int(ns) if np.isfinite(ns) else NO_STAMP]


@pytest.mark.parametrize("cell", WORDS)
def test_words_are_missing_and_noted_once(tmp_path: Path, cell: str) -> None:
    """Cells that are no number are missing; one note has how many, the first of them and its row."""
    values, note = column(tmp_path, "x_mm", ["1", cell, "3", "worse"]).numbers("x_mm")
    np.testing.assert_array_equal(values, [1e-3, np.nan, 3e-3, np.nan])
    shown = cell.strip('"')
    assert f"2 cells of column 'x_mm' without a number, first '{shown}' in row 2" in str(note)


@pytest.mark.parametrize(
    ("first", "far", "missing"), [("1", "word", True), ("", "2.5", False), ("2024-01-01", "2.5", False)]
)
def test_a_cell_beyond_the_first_block_may_be_of_another_kind(
    tmp_path: Path, first: str, far: str, missing: bool
) -> None:
    """What a column holds is not guessed from its beginning: a cell after the first MB counts as much."""
    rows = FIRST_BLOCK // 20
    lines = "".join(f"{EPOCH_NS + row},{first}\n" for row in range(rows))
    table = csv(tmp_path, f"t_ns,x_mm\n{lines}{EPOCH_NS + rows},{far}\n")
    assert (tmp_path / "log.csv").stat().st_size > FIRST_BLOCK
    values, note = table.numbers("x_mm")
    assert np.isnan(values[-1]) if missing else values[-1] == 2.5e-3
    assert (note is not None) == (missing or first not in ("1", ""))
    np.testing.assert_array_equal(table.stamps("t_ns")[0], EPOCH_NS + np.arange(rows + 1))


HEADER = "t_s,x_mm,y_mm\n"


@pytest.mark.parametrize(
    ("text", "kept", "said"),
    [
        (f"{HEADER}0,1,2\n1,2,3\n2,3", [0, 1], "1 line left out: 2 cells where the first has 3, first in line 4"),
        (f"{HEADER}0,1,2\n1,2,3,4\n2,3,4\n", [0, 2], "1 line left out: 4 cells where the first has 3, first in line 3"),
        (
            f"# by hand\n{HEADER}0,1,2\n1\n2,3,4\n",
            [0, 2],
            "1 line left out: 1 cells where the first has 3, first in line 4",
        ),
    ],
)
def test_a_torn_line_is_left_out_and_noted(tmp_path: Path, text: str, kept: list[int], said: str) -> None:
    """A line of another length than the header is left out; one note has how many and where the first is."""
    table = csv(tmp_path, text)
    assert table.stamps("t_s")[0].tolist() == [10**9 * second for second in kept]
    assert table.notes == (f"log.csv: {said}",)


@pytest.mark.parametrize(
    "encoded",
    [
        lambda text: text,
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r"),
        lambda text: text.rstrip("\n"),
        lambda text: text.replace("\n", "\n\n"),
        lambda text: "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text.split()),
    ],
    ids=["plain", "byte-order mark", "CR", "no last newline", "blank lines", "quoted"],
)
def test_one_table_however_encoded(tmp_path: Path, encoded: Callable[[str], str]) -> None:
    """Byte-order mark, line ends, blank lines and quotes are no part of the data."""
    table = csv(tmp_path, encoded("t_s,x_mm\n0.5,1\n1.5,\n"))
    assert list(table.columns) == ["t_s", "x_mm"]
    assert table.stamps("t_s")[0].tolist() == [500_000_000, 1_500_000_000]
    np.testing.assert_array_equal(table.numbers("x_mm")[0], [1e-3, np.nan])
    assert table.notes == ()


ROWS = [(0.5, 1.25), (1.5, -2.0), (2.5, 3e-05)]
LAYOUTS: dict[str, tuple[str, str]] = {
    "blanks": ("t_s x_mm\n" + "".join(f"{t} {x}\n" for t, x in ROWS), ""),
    "aligned": ("   t_s     x_mm\n" + "".join(f"{t:6} {x:8g} \r\n" for t, x in ROWS), ""),
    "header in a comment": ("# t_s x_mm\n" + "".join(f"{t:.18e} {x:.18e}\n" for t, x in ROWS), ""),
    "comments": ("# recorder v3\n\n% by hand\nt_s,x_mm\n" + "".join(f"{t},{x}\n" for t, x in ROWS), ""),
    "settings": (
        "Format,1.23,Take,one,Rate,120\n\n,,Body\nt_s,x_mm\n" + "".join(f"{t},{x}\n" for t, x in ROWS),
        "2 lines above the header left out",
    ),
    "settings of two cells": (
        "Robot,UR5\nt_s;x_mm\n" + "".join(f"{t};{x}\n".replace(".", ",") for t, x in ROWS),
        "1 line above the header left out",
    ),
    "a message below the header": (
        "t_s,x_mm\nINFO  [node-3] recording started\n" + "".join(f"{t},{x}\n" for t, x in ROWS),
        "1 line left out: 1 cells where the first has 2, first in line 2",
    ),
    "settings and units": (
        "Trajectories\n100\nt_s,x_mm\n[s],[mm]\n" + "".join(f"{t},{x}\n" for t, x in ROWS),
        "2 lines above the header left out",
    ),
    "units": ("t_s,x_mm\n[s],[mm]\n" + "".join(f"{t},{x}\n" for t, x in ROWS), ""),
    "decimal commas": ("t_s x_mm\n" + "".join(f"{t} {x}\n".replace(".", ",") for t, x in ROWS), ""),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_table_however_laid_out(tmp_path: Path, layout: str) -> None:
    """As UR's recorder, numpy, MATLAB, Excel and motion capture write tables."""
    text, note = LAYOUTS[layout]
    table = csv(tmp_path, text)
    assert list(table.columns) == ["t_s", "x_mm"]
    assert table.stamps("t_s")[0].tolist() == [round(t * 10**9) for t, _ in ROWS]
    np.testing.assert_allclose(table.numbers("x_mm")[0], [x / 1e3 for _, x in ROWS], rtol=1e-15)
    assert table.notes == ((f"log.csv: {note}",) if note else ())


PRINTED: dict[str, tuple[str, list[str]]] = {
    "{t:.2f} Soll: {a:.1f} | Ist: {b:.2f}": ("column 1", ["Soll", "Ist"]),
    "uptime={t:.2f} wanted={a:.1f} got={b:.2f}": ("uptime", ["wanted", "got"]),
    "ms:{ms:.0f}\tlift goal:{a:.1f}mm\tlift is:{b:.2f} mm": ("ms", ["lift goal [mm]", "lift is [mm]"]),
    "08:15:{t:05.2f} -> q_d[0] = {a:.1f}°, q[0] = {b:.2f}°; ok": ("column 1", ["q_d[0] [°]", "q[0] [°]"]),
    "[INFO] [1790000000.5]: n: {ms:.0f}, x(deg): {a:.1f}, y(deg): {b:.2f}.": ("n", ["x(deg)", "y(deg)"]),
    '{{"t": {t:.2f}, "mode": auto, "to": {a:.1f}, "at": {b:.2f}}}': ("t", ["to", "at"]),
}


@pytest.mark.parametrize("line", PRINTED)
@pytest.mark.parametrize("name", ["log.csv", "serial.log"])
def test_values_behind_labels_are_columns_of_these_names(tmp_path: Path, line: str, name: str) -> None:
    """As sketches print them to a serial line, whose first one is torn; others may be in between."""
    told, seen = [70.0 - n for n in range(40)], [-1.25 * n for n in range(40)]
    lines = [line.format(t=0.02 * n, ms=20 * n, a=a, b=b) for n, (a, b) in enumerate(zip(told, seen, strict=True))]
    path = tmp_path / name
    path.write_text("\n".join([lines[0][-9:], *lines[:20], "homing done", "", *lines[20:], ""]))
    clock, columns = PRINTED[line]
    table = tables.read(path)
    assert tables.holds_numbers(path)
    assert [table.plain(column)[0].tolist() for column in columns] == [told, seen]
    assert clock in table.columns and len(table.columns[clock].drop_null()) == 40
    (note,) = table.notes
    assert "lines of labels and values" in note and "2 lines without these left out" in note


@pytest.mark.parametrize("cells", ["array([{n}.5, 2.0], dtype=float64)", '7,"{{a: {n}, b: 2}}"'])
def test_labels_within_cells_are_no_columns(tmp_path: Path, cells: str) -> None:
    rows = "".join(f"0.{n};{cells.format(n=n)}\n" for n in range(1, 9))
    table = csv(tmp_path, "t_s;state\n" + rows if "array" in cells else "t_s,x_mm,more\n" + rows.replace(";", ","))
    assert "t_s" in table.columns and table.rows == 8 and not table.notes


def test_a_list_behind_a_label_is_a_column_of_lists(tmp_path: Path) -> None:
    table = csv(tmp_path, "".join(f"t: 0.{n} target: [{n}.5, -2] pose: ({n}, 1e-3)\n" for n in range(1, 9)))
    assert table.plain("target[0]")[0].tolist() == [n + 0.5 for n in range(1, 9)]
    assert table.plain("pose[1]")[0].tolist() == [1e-3] * 8


ABOVE: dict[str, tuple[str, list[str], str]] = {
    "LabVIEW: settings, then lines of channels": (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nTime\t10:00:00.1\n***End_of_Header***\t\n\n"
        "Channels\t2\t\t\nSamples\t9\t9\t\nX0\t0.0E+0\t0.0E+0\t\n***End_of_Header***\t\t\t\n"
        "X_Value\tSetPos\tActPos\tComment\n" + "".join(f"{0.02 * n:.6f}\t-{n}.5\t{n}.5\t\n" for n in range(40)),
        ["X_Value", "SetPos", "ActPos", "Comment"],
        "9 lines",
    ),
    "Qualisys: the last setting is no header": (
        "NO_OF_FRAMES\t40\nFREQUENCY\t100\nDATA_INCLUDED\t3D\nMARKER_NAMES\ttool\n"
        + "".join(f"{n}.125\t-{n}.5\t7.0\n" for n in range(40)),
        ["column 1", "column 2", "column 3"],
        "4 lines",
    ),
    "OptiTrack's Motive: a header of several lines": (
        "Format Version,1.23,Take Name,one,Capture Frame Rate,120.0\n\n"
        ",,Rigid Body,Rigid Body,Rigid Body,Rigid Body\n,,tool,tool,tool,tool\n"
        ",,Rotation,Rotation,Position,Position\nFrame,Time (Seconds),X,Y,X,Y\n"
        + "".join(f"{n},-{n}.5,0.1,0.2,0.3,0.5\n" for n in range(40)),
        ["Frame", "Time (Seconds)", "Rotation X", "Rotation Y", "Position X", "Position Y"],
        "3 lines",
    ),
}


@pytest.mark.parametrize("case", ABOVE)
def test_what_stands_above_a_table_is_left_out(tmp_path: Path, case: str) -> None:
    """Settings may look like a table themselves; columns of one name are told apart by the lines above them."""
    text, names, above = ABOVE[case]
    table = csv(tmp_path, text)
    assert (list(table.columns), table.rows) == (names, 40)
    assert table.plain(names[1])[0].tolist() == [-(n + 0.5) for n in range(40)]
    assert table.notes == (f"log.csv: {above} above the header left out",)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("0.00,1,2\n0.02,2,3\n0.04,3,4\n", ["column 1", "column 2", "column 3"]),  # numpy's savetxt
        ("# run of Monday\n0.00 1\n0.02 2\n0.04 3\n", ["column 1", "column 2"]),
        ("5,20000000,base,1.5,2\n5,40000000,base,1.6,3\n6,0,base,1.7,4\n", [f"column {n}" for n in range(1, 6)]),
        (",x_mm\n0.00,1\n0.02,2\n0.04,3\n", ["column 1", "x_mm"]),  # pandas, with its index
        (",0,1\n0,5,6\n1,6,7\n2,7,8\n", ["column 1", "0", "1"]),  # the same, of an array
        ("0,1\n5,6\n6,7\n7,8\n", ["0", "1"]),  # without it
        ("t,1,2,3\n0.0,1,2,3\n0.1,2,3,4\n0.2,3,4,5\n", ["t", "1", "2", "3"]),  # joints by their numbers
    ],
)
def test_columns_without_a_name_are_called_by_their_place(text: str, names: list[str], tmp_path: Path) -> None:
    """The first row of a table without a header is no header."""
    table = csv(tmp_path, text)
    assert (list(table.columns), table.rows, table.notes) == (names, 3, ())


@pytest.mark.parametrize(
    ("cells", "state"),
    [
        (['"[0.5, -1e-2]"', '"[2, nan]"', ""], [[0.5, -0.01], [2.0, None], None]),
        (['"[0.5 -1e-2\n]"', '"[ 2.  nan]"', '"[]"'], [[0.5, -0.01], [2.0, None], [None]]),
        (["\"array('d', [0.5, -1e-2])\"", "\"array('d', [2])\"", ""], [[0.5, -0.01], [2.0], None]),
        (["[0.5, -1e-2]", "[2, 3]", ""], [[0.5, -0.01], [2.0, 3.0], None]),
        (["0.5 -1e-2", "2 nan", ""], [[0.5, -0.01], [2.0, None], None]),
        (["2026-11-25 10:00:00", "7 of 9", ""], ["2026-11-25 10:00:00", "7 of 9", None]),
        (["\"('elbow', 'wrist')\"", "\"['a b' 'c']\"", ""], [["elbow", "wrist"], ["a b", "c"], None]),
        (['"(1) approach, slowly"', '"[2] grasp"', ""], ["(1) approach, slowly", "[2] grasp", None]),
    ],
)
def test_a_cell_may_hold_a_list(tmp_path: Path, cells: list[str], state: list[object]) -> None:
    """As Python and numpy print it, or numbers with blanks between; what is no list stays text."""
    table = csv(tmp_path, "".join(f"{n},{cell},7\n" for n, cell in enumerate(cells)).join(["t_s,state,b\n", ""]))
    assert table.columns["state"].to_pylist() == state
    assert table.plain("b")[0].tolist() == [7.0, 7.0, 7.0] and not table.notes


def test_lists_over_lines_may_fill_a_large_file(tmp_path: Path) -> None:
    """Beyond the blocks in which pyarrow reads; a quote that nothing closes is said."""
    rows = "".join(f'{n},"[{n}.5 -1.0\n  {n}.25]"\n' for n in range(100_000))
    table = csv(tmp_path, f"t_s,state\n{rows}")
    assert table.rows == 100_000
    assert table.columns["state"][99_999].as_py() == [99_999.5, -1.0, 99_999.25]
    lost = "".join(f"{n},{n},z\n" for n in range(200_000))
    assert "is a quote not closed?" in refusal(lambda: csv(tmp_path, f't_s,x_m,who\n0,1,"abc\n{lost}'))


BRACKETS = ("0,[" + "1," * 30_000, '0,"' + "\n" * 60_000 + '"', ',"[' * 20_000)
NO_HEADER = ("\ufeff\n", "# only\n", '"', " \n \n", "a\n\n\n1 2\n3 4")


@pytest.mark.parametrize("text", [*NO_HEADER, *(f"t_s,q\n{one}\n1,[2,3]\n" for one in BRACKETS)])
def test_a_text_without_sense_is_a_table_or_one_line(tmp_path: Path, text: str) -> None:
    try:
        table = csv(tmp_path, text)
    except PumafuseError as error:
        assert "\n" not in str(error)
    else:
        assert table.names == ("t_s", "q") or text in NO_HEADER


@pytest.mark.parametrize("ending", ["csv", "jsonl"])
def test_of_a_wide_text_what_is_asked_for_is_read(tmp_path: Path, ending: str) -> None:
    """Its columns are those of a reading of all, also the second of a name; and an absent one is told among all."""
    file, names = tmp_path / f"log.{ending}", [f"c{n}" for n in range(2_500)] + ["x", "x", ""]
    if ending == "csv":
        file.write_text("\n".join(",".join(row) for row in (names, *(["1.5"] * 2_502 + ["7"],) * 3)) + "\n")
    else:
        file.write_text((json.dumps(dict.fromkeys([*names[:-3], "x", "x.1", "column 2503"], 1.5)) + "\n") * 3)
    whole = tables.read(file)
    for fields in (["x.1", "c7", "column 2503"], lambda known: [known[-1], "c7", "x.1"]):
        some = tables.read(file, fields=fields, where={"c1": 1.5})
        assert set(some.columns) == {"c1", "c7", "x.1", "column 2503"}
        assert (some.names, some.rows, some.notes) == (whole.names, 3, whole.notes)
        assert all(some.columns[name].equals(whole.columns[name]) for name in some.columns)
    with pytest.raises(UnknownNameError, match="did you mean 'c17'"):
        tables.read(file, fields=["c17_"])


@pytest.mark.parametrize("body", ["0,1,2\n1,2,3\n", "0,1,2\n1,h\xf6\n2,3,4\n"])
def test_text_of_windows_is_read_and_said(tmp_path: Path, body: str) -> None:
    """A degree sign or an umlaut, as Excel writes them, also in a line that is left out."""
    table = csv(tmp_path, f"t_s,x [\xb0],h\xf6he_mm\n{body}".encode("cp1252"))
    assert list(table.columns) == ["t_s", "x [°]", "höhe_mm"]
    assert table.rows == 2
    assert table.notes[0] == "log.csv: its text is not UTF-8: taken for Windows-1252"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be"])
def test_text_that_powershell_redirects_is_read(tmp_path: Path, encoding: str) -> None:
    """It is UTF-16 behind a mark, in either order of bytes."""
    text = "\ufeff"[encoding == "utf-16" :] + "t_s,höhe_mm\n0.5,1.25\n"
    table = csv(tmp_path, text.encode(encoding))
    assert table.numbers("höhe_mm")[0].tolist() == [0.00125] and not table.notes


@pytest.mark.parametrize("name", ["log.ndjson", "log.jsonl.gz"])
def test_lines_of_json_are_a_table_of_nested_columns(tmp_path: Path, name: str) -> None:
    """An object a row; what is not there in it is missing."""
    text = b'{"t_s": 0.5, "tool": {"x_mm": 1.5}}\n{"t_s": 1.5}\n'
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    table = tables.read(tmp_path / name)
    assert table.stamps("t_s")[0].tolist() == [500_000_000, 1_500_000_000]
    np.testing.assert_array_equal(table.numbers("tool.x_mm")[0], [1.5e-3, np.nan])
    (tmp_path / "torn.jsonl").write_bytes(b'{"t_s": 0.5}\n{"t_s": 1')
    assert "not a table that can be read" in refusal(lambda: tables.read(tmp_path / "torn.jsonl"))


def test_gzip_and_parquet_say_what_the_csv_says(tmp_path: Path) -> None:
    text = f"t_ns,x_mm,word_mm\n{EPOCH_NS},1.1,1\n,2.2,\n{EPOCH_NS + 1},,bad\n"
    plain = csv(tmp_path, text)
    zipped = csv(tmp_path, gzip.compress(text.encode()), "log.csv.gz")
    stamps = pa.array([EPOCH_NS, None, EPOCH_NS + 1])
    parquet = written(tmp_path, t_ns=stamps, x_mm=[1.1, 2.2, None], word_mm=["1", None, "bad"])
    for other in (zipped, parquet):
        assert other.rows == plain.rows
        assert other.stamps("t_ns")[0].tolist() == plain.stamps("t_ns")[0].tolist()
        for name in ("x_mm", "word_mm"):
            np.testing.assert_array_equal(other.numbers(name)[0], plain.numbers(name)[0])
        assert "'bad' in row 3" in str(other.numbers("word_mm")[1])


UNREADABLE: dict[str, tuple[str, bytes | None, str]] = {
    "absent": ("log.csv", None, "no such file"),
    "header, no newline": ("log.csv", b"t_s,x_mm", "Empty CSV"),
    "one endless line": ("log.csv", b"t_s,x_mm\n0," + b"1" * 3 * FIRST_BLOCK, "not a table"),
    "CSV called gzip": ("log.csv.gz", b"t_s,x_mm\n0,1\n", "cannot be read"),
    "gzip cut short": ("log.csv.gz", gzip.compress(b"t_s,x_mm\n" + b"0,1\n" * 1000)[:-20], "cannot be read"),
    "UTF-16 cut within a letter": ("log.csv", "t_s,x_mm\n0,1\n".encode("utf-16")[:-1], "save it as UTF-8"),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_a_file_that_is_no_table_is_refused_in_one_line(
    tmp_path: Path, case: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """What cannot be read is a one-line error with the file's path and the reason, and nothing is printed."""
    name, content, reason = UNREADABLE[case]
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    text = refusal(lambda: tables.read(path))
    assert text.startswith(f"{path}: ")
    assert reason in text
    assert capfd.readouterr() == ("", "")


def test_the_second_column_of_a_name_gets_a_number(tmp_path: Path) -> None:
    """As pandas counts them; it is said, and a unit is known with the number, too."""
    path = tmp_path / "log.csv"
    path.write_text("t_s,x_mm,q,q,,,q,x_mm\n0,1,2,3,4,5,6,7\n")
    table = tables.read(path)
    assert [table.numbers(name)[0].tolist() for name in ("x_mm", "x_mm.1")] == [[1e-3], [7e-3]]
    assert [table.plain(name)[0].tolist() for name in ("q", "q.1", "q.2")] == [[2], [3], [6]]
    assert table.notes == ("log.csv: headers that are there twice: q, x_mm; the second of each is called .1",)
    assert list(table.columns) == ["t_s", "x_mm", "q", "q.1", "column 5", "column 6", "q.2", "x_mm.1"]


@pytest.mark.parametrize("rest", ["0", "0,000"])
def test_decimal_commas_may_come_late(tmp_path: Path, rest: str) -> None:
    """A log that rests for long shows them after thousands of rows."""
    path = tmp_path / "log.csv"
    path.write_text("t_ms;x_mm\n" + "".join(f"{k};0\n" for k in range(3000)) + f"3000;{rest}\n3001;0,030\n")
    assert tables.read(path).numbers("x_mm")[0].tolist() == [0.0] * 3001 + [0.03 / 1e3]
    path.write_text("t_ms;x_mm;note\n" + "".join(f"{k};0.5;\n" for k in range(3000)) + "3000;0.25;1,5\n")
    assert tables.read(path).numbers("x_mm")[0].tolist() == [5e-4] * 3000 + [2.5e-4]


def test_a_text_that_never_ends_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small file of gzip may hold any amount, and a device file has no end."""
    monkeypatch.setattr(tables, "_MOST_TEXT", 32 << 20)
    bomb = gzip.compress(bytes(33 << 20))
    path = tmp_path / "log.csv.gz"
    path.write_bytes(bomb)
    assert " of text; as Parquet" in one_line(RunError, partial(tables.read, path))
    assert "a pipe or a device" in one_line(RunError, partial(tables.read, Path("/dev/zero")))


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
def test_a_header_without_rows_is_a_table_of_no_rows(tmp_path: Path, name: str) -> None:
    """Its columns are read as nothing, and a note says so with the file's name."""
    text, path = b"t_s,x_mm\n", tmp_path / name
    if name.endswith(".parquet"):
        written(tmp_path, t_s=pa.array([], pa.float64()), x_mm=pa.array([], pa.float64()))
    else:
        path.write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    table = tables.read(path)
    assert table.notes == (f"{name}: the table has no rows",)
    for found, kind in ((table.stamps("t_s")[0], np.int64), (table.numbers("x_mm")[0], np.float64)):
        assert (found.shape, found.dtype) == ((0,), kind)


def test_a_column_that_is_not_there_is_refused_with_those_that_are(tmp_path: Path) -> None:
    """An unknown column is an error that lists the columns, the closest first, and carries the names as data."""
    table = csv(tmp_path, "t_s,x_mm,y_mm\n0,1,2\n")
    for call, name in ((table.numbers, "z_mm"), (table.stamps, "t_ms"), (table.numbers, "")):
        with pytest.raises(UnknownNameError, match=f"{table.path}: unknown column '{name}'") as caught:
            call(name)
        assert (caught.value.name, caught.value.accepted) == (name, ("t_s", "x_mm", "y_mm"))
    assert "did you mean 't_s'?" in refusal(lambda: table.stamps("t_ms"))


def test_a_column_without_its_unit_is_refused_with_the_accepted_ones(tmp_path: Path) -> None:
    """A length needs an ending of length and a stamp one of time; the error names them and gives an example."""
    table = csv(tmp_path, "t,t_s,x,x_mm,v_mm_s,x_MM\n0,0,0,0,0,0\n")
    wanted = [(table.numbers, name, "_m, _mm, _um") for name in ("x", "t_s", "v_mm_s", "x_MM")]
    wanted += [(table.stamps, name, "_s, _ms, _us, _ns") for name in ("t", "x_mm")]
    for call, name, accepted in wanted:
        text = refusal(lambda call=call, name=name: call(name))
        assert f"'{name}'" in text and accepted in text


@pytest.mark.parametrize("cell", ["true", "2024-01-01", "10:00:00"])
def test_a_column_of_another_kind_is_refused(tmp_path: Path, cell: str) -> None:
    assert "not numbers" in refusal(lambda: column(tmp_path, "x_mm", [cell, cell]).numbers("x_mm"))
    if ":" not in cell:
        assert "not numbers" in refusal(lambda: column(tmp_path, "t_s", [cell, cell]).stamps("t_s"))


@pytest.mark.parametrize(
    "cells",
    [
        [str(LAST_S * 10**9), str(-(LAST_S + 1) * 10**9)],
        ["9223372036854775808"],
        ["9999999999999999999", "word"],
        ["1e300"],
    ],
)
def test_stamps_too_far_from_1970_are_refused_in_one_line(tmp_path: Path, cells: list[str]) -> None:
    """Counts that int64 ns cannot hold, or not the difference of, are refused by their column."""
    assert "'t_ns'" in refusal(lambda: column(tmp_path, "t_ns", cells).stamps("t_ns"))


@pytest.mark.long
def test_only_pumafuse_errors_come_out_of_a_mangled_file(tmp_path: Path) -> None:
    """Whatever happens to the text of a log on its way, reading it works or fails with one line."""
    rng, sane = random.Random(1), "t_s,x_mm\n" + "".join(f"{row / 100},{row}\n" for row in range(30))
    pieces = ['"', ",", "\n", "\r", "\0", "inf", "nan", "-", "true", "2024-01-01", "é", " ", "_mm", "word"]
    outcomes = {RunError: 0, UnknownNameError: 0, None: 0}
    for _ in range(1500):
        mangled = list(sane)
        for _ in range(rng.randint(1, 6)):
            place = rng.randrange(len(mangled))
            mangled[place : place + rng.randrange(2)] = rng.choice(pieces)
        try:
            table = csv(tmp_path, "".join(mangled)[: rng.choice((None, rng.randrange(1, 200)))])
            table.numbers("x_mm")
            table.stamps("t_s")
            outcomes[None] += 1
        except PumafuseError as error:
            assert len(str(error).splitlines()) == 1
            outcomes[type(error)] += 1
    assert min(outcomes.values()) > 20


@given(cut=st.integers(0, 200), ends=st.sampled_from(["\n", "\r\n"]))
def test_a_growing_file_read_at_any_moment(tmp_path_factory: pytest.TempPathFactory, cut: int, ends: str) -> None:
    """Cut anywhere, a table that may be growing has whole rows only, and says so if a line was left out."""
    rows = [(1000 + row, (569_700_001 + row) / 1e6) for row in range(12)]
    text = ends.join(["t_ns,x_mm", *(f"{stamp},{x:.6f}" for stamp, x in rows)]) + ends
    header, cut = text.index(ends) + len(ends), min(cut, len(text))
    path = tmp_path_factory.mktemp("growing") / "log.csv"
    path.write_bytes(text[: header + cut].encode())
    table = tables.read(path, growing=True)
    there = text[: header + cut].replace("\r\n", "\n").replace("\r", "\n")
    whole = there.count("\n") - 1
    assert table.stamps("t_ns")[0].tolist() == [stamp for stamp, _ in rows[:whole]]
    np.testing.assert_array_equal(table.numbers("x_mm")[0], [x / 1e3 for _, x in rows[:whole]])
    assert there.endswith("\n") != any("may be torn" in note for note in table.notes)


@pytest.mark.parametrize("before", ["[", "run7 = [ "])
def test_a_matrix_of_matlab_is_a_table(before: str, tmp_path: Path) -> None:
    """Its names stand above it, several words each, with blanks between them."""
    rows = ";\n".join(f"  {n}   {0.01 * n:.3f}   {n * n}  {-n}.5" for n in range(30))
    found = csv(tmp_path, f" No   Time     Demand Angle   Link 2 Angle\n\n{before}{rows}]\n")
    assert list(found.columns) == ["No", "Time", "Demand Angle", "Link 2 Angle"]
    assert found.notes == ()
    assert found.rows == 30
    np.testing.assert_array_equal(found.plain("Link 2 Angle")[0], [float(f"{-n}.5") for n in range(30)])


@pytest.mark.parametrize("separator", [";", "\t"])
def test_names_above_lines_of_properties_are_the_header(separator: str, tmp_path: Path) -> None:
    """As TwinCAT exports a scope: what a column is called, and below it its type, address and scale, line by line."""
    lines = ["Name;lift", "File;C:\\lift.csv", "", "Name;SetPos;ActPos", "Data-Type;REAL64;REAL64", "SampleTime;2;2"]
    lines += ["SymbolName;MAIN.s;MAIN.a", "Port;852;852", "Offset;0;0", "ScaleFactor;1;1", "", "4;1.5;1.25"]
    found = csv(tmp_path, "\n".join([*lines, "6;1.75;1.5", "8;2;1.75", ""]).replace(";", separator))
    assert list(found.columns) == ["Name", "SetPos", "ActPos"]
    np.testing.assert_array_equal(found.plain("ActPos")[0], [1.25, 1.5, 1.75])


def test_a_header_that_lacks_one_name_names_the_columns_that_it_can(tmp_path: Path) -> None:
    """The last has none; of R's row names, in quotes, the first; where rows are counted it may be either: refused."""
    rows = [f"{0.1 * n:.1f};{n * n}.5;7" for n in range(20)]
    found = csv(tmp_path, "\n".join(["t_s;x_mm", *rows, ""]))
    assert list(found.columns) == ["t_s", "x_mm", "column 3"]
    assert found.rows == 20
    assert found.numbers("x_mm")[0][3] == 9.5e-3
    assert found.notes == ("log.csv: the header has 2 names, each of 20 rows 3 cells: the last has no name",)
    of_r = "\n".join(['"t_s","x_mm"', *(f'"{n + 1}",{0.1 * n:.1f},{n * n}.5' for n in range(20)), ""])
    found = csv(tmp_path, of_r)
    assert list(found.columns) == ["column 1", "t_s", "x_mm"]
    assert found.numbers("x_mm")[0][3] == 9.5e-3
    assert "the first has no name" in found.notes[0]
    assert "first or of the last column" in refusal(lambda: csv(tmp_path, of_r.replace('"', "")))
    assert "the table has no rows" in refusal(
        lambda: csv(tmp_path, "a,b\n" + "".join(f"{n},1,2,3\n" for n in range(9)))
    )


def test_what_stands_for_none_in_an_element_that_only_some_rows_have(tmp_path: Path) -> None:
    """A joint that is there from some row on: the parts of the file before have none of its name, and tell nothing."""
    count = 3 * (1 << 16)
    late = np.arange(count) >= count // 2
    names = pa.array([["base", "elbow"] if one else ["base"] for one in late])
    elbow = np.where(np.arange(count) % 1000 == 7, 9999.0, 1e-5 * np.arange(count))
    position = pa.array([[0.5, value] if one else [0.5] for one, value in zip(late, elbow.tolist(), strict=True)])
    written(tmp_path, name=names, position=position)
    assert tables.sentinel_of(tmp_path / "log.parquet", "position[elbow]") == 9999.0


@pytest.mark.parametrize(("levels", "begin", "end"), [(100_000, b'{"a":', b"}"), (150, b"[[],", b"]")])
def test_lines_that_are_nested_without_end_are_refused(tmp_path: Path, levels: int, begin: bytes, end: bytes) -> None:
    """Of 100,000 levels pyarrow ends the process. A line that is only long, and brackets in a text, are none."""
    path = tmp_path / "log.jsonl"
    good = b'{"t_s": 0.1, "x_mm": 1.0, "note": "[[[[[", "more": [' + b"[1], " * 5000 + b"[2]]}\n"
    path.write_bytes(good * 30)
    assert tables.read(path).rows == 30
    path.write_bytes(good + b'{"t_s": 0.2, "x": ' + levels * begin + b"1" + levels * end + b"}\n")
    with pytest.raises(RunError, match=r"nested more than 100 deep: no log|changed from array"):
        tables.read(path)

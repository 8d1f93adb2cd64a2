"""Files of other programs: the same numbers as in CSV, and one line for what cannot be read."""

import csv
import json
import sys
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from openpyxl import Workbook
from scipy.io import savemat

import pumafuse as pf
from discovery.test_survey import written
from pumafuse.arrays import FloatArray
from pumafuse.discovery.survey import survey
from pumafuse.errors import PumafuseError, RunError
from pumafuse.logs import tables
from px4_files import write_ulg
from refusals import one_line

LAG = 0.09  # s
TIME = 0.02 * np.arange(600)
LATER = 0.01 * np.arange(1100) + 0.003


def path(t: FloatArray) -> FloatArray:
    """A smooth motion of two axes from rest [rad], (n, 2)."""
    t = np.maximum(t, 0.0)
    return np.stack([0.4 * (1.0 - np.cos(0.9 * t)), 0.3 * (1.0 - np.cos(1.7 * t))], axis=1)


TOLD, SEEN = path(TIME), path(LATER - LAG)


def npz(folder: Path) -> Path:
    arrays = {"command_t": TIME, "command_rad": TOLD, "encoder_t": LATER, "encoder_rad": SEEN}
    np.savez(folder / "log.npz", **arrays)
    return folder / "log.npz"


def mat(folder: Path) -> Path:
    """Structs, as Simulink saves them: rows and columns of numbers, and a setting."""
    said = {"time": TIME[:, None], "position_rad": TOLD}
    seen = {"time": LATER[None, :], "position_rad": SEEN.T}
    savemat(folder / "log.mat", {"command": said, "encoder": seen, "settings": {"gain": 3.0}})
    return folder / "log.mat"


def records(folder: Path) -> Path:
    whole = {
        name: [{"t": t, "joint": {"a_rad": a, "b_rad": b}} for t, (a, b) in zip(time, values.tolist(), strict=True)]
        for name, time, values in (("command", TIME, TOLD), ("encoder", LATER, SEEN))
    }
    (folder / "log.json").write_text(json.dumps(whole))
    return folder / "log.json"


def columns(folder: Path) -> Path:
    def of(values: FloatArray) -> dict[str, float]:
        return {str(n): float(value) for n, value in enumerate(values)}

    said = {"t": of(TIME), "a_rad": of(TOLD[:, 0]), "b_rad": of(TOLD[:, 1])}
    seen = {"t": of(LATER), "a_rad": of(SEEN[:, 0]), "b_rad": of(SEEN[:, 1])}
    (folder / "log.json").write_text(json.dumps({"command": said, "encoder": seen}))
    return folder / "log.json"


def xlsx(folder: Path) -> Path:
    """Sheets with a title above the header, and dates."""
    book = Workbook()
    book.remove(book.active)
    begin = datetime(2026, 3, 4, 12)
    for name, time, values in (("command", TIME, TOLD), ("encoder", LATER, SEEN)):
        sheet = book.create_sheet(name)
        sheet.append(["recorded in cell 4"])
        sheet.append(["time", "a_rad", "b_rad"])
        for t, (a, b) in zip(time, values.tolist(), strict=True):
            sheet.append([begin + timedelta(seconds=float(t)), a, b])
    book.save(folder / "log.xlsx")
    return folder / "log.xlsx"


def ulg(folder: Path) -> Path:
    topics = {"position_setpoint": ("float[2] joint", TIME, TOLD), "position_measured": ("float[2] joint", LATER, SEEN)}
    return write_ulg(folder / "log.ulg", topics)


@pytest.mark.parametrize("write", [npz, mat, records, columns, xlsx, ulg])
def test_a_log_of_several_tables_is_found_and_read_again(write: Callable[[Path], Path], tmp_path: Path) -> None:
    """Commands and a sensor of another rate in one file: who is who, the unit, the lag; run.toml reads the same."""
    found = survey(write(tmp_path))
    assert len(found.run.axes) == 2
    assert len(found.run.sensors) == 1
    assert set(found.run.kinds.values()) == {"angle"}
    for one in found.relations.values():
        assert one.lag == pytest.approx(LAG, abs=0.003)
        assert one.slope == pytest.approx(1.0, abs=0.02)
    (said,), (seen,) = {len(found.run.command.stamp)}, {len(one.stamp) for one in found.run.sensors.values()}
    assert (said, seen) == (len(TIME), len(LATER))
    read, _ = written(found, tmp_path)
    for axis, told in zip(found.run.axes, TOLD.T, strict=True):
        assert np.array_equal(read.command.values[axis], found.run.command.values[axis])
        assert np.allclose(read.command.values[axis], told, atol=1e-6)


@pytest.mark.parametrize("ending", ["npy", "npz", "mat", "json", "lines", "split", "xlsx"])
def test_a_single_table_needs_no_name(ending: str, tmp_path: Path) -> None:
    """A structured array, arrays, a struct, records, lines of them, pandas' split, a sheet: a run in one table."""
    names = ["time_s", "command.z_mm", "laser.z_mm"]
    rows = np.round(np.stack([TIME, 1e3 * TOLD[:, 0], 1e3 * path(TIME - LAG)[:, 0]], axis=1), 6)
    whole: dict[str, Any] = dict(zip(names, rows.T, strict=True))
    file = tmp_path / f"log.{ending}"
    match ending:
        case "npy":
            np.save(file, np.array(list(map(tuple, rows)), dtype=[(name, ">f8") for name in names]))
        case "npz":
            np.savez(file, **whole)
        case "mat":
            split = {"command": {"z_mm": rows[:, 1]}, "laser": {"z_mm": rows[:, 2]}}
            savemat(file, {"run": {"time_s": rows[:, 0], **split, "note": "a cell"}})
        case "xlsx":
            book = Workbook()
            for row in [names, *rows.tolist()]:
                book.active.append(row)
            book.save(file)
        case "split":
            file = tmp_path / "log.json"
            file.write_text(json.dumps({"columns": names, "index": list(range(len(rows))), "data": rows.tolist()}))
        case _:
            file = tmp_path / "log.json"
            listed = [dict(zip(names, row, strict=True)) for row in rows.tolist()]
            file.write_text("\n".join(map(json.dumps, listed)) if ending == "lines" else json.dumps({"rows": listed}))
    with (tmp_path / "plain.csv").open("w", newline="") as text:
        csv.writer(text).writerows([names, *rows.tolist()])
    found, plain = pf.Run.read(file), pf.Run.read(tmp_path / "plain.csv")
    assert np.array_equal(found.command.stamp, plain.command.stamp)
    assert np.array_equal(found.command.values["z"], plain.command.values["z"])
    assert np.array_equal(found.sensors["laser"].values["z"], plain.sensors["laser"].values["z"])


def test_what_cannot_be_read_says_how_to_convert_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pickled objects are never loaded; HDF5, torn and empty files, other formats, and a missing library."""

    def refusal(name: str) -> str:
        return one_line(PumafuseError, lambda: survey(tmp_path / name))

    np.save(tmp_path / "objects.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    assert refusal("objects.npy").endswith("they may run code; save arrays of numbers")
    (tmp_path / "noise.npy").write_bytes(bytes(range(200)))
    assert refusal("noise.npy").endswith("no array of numpy, or damaged")
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(124, b" ") + b"\x00\x02IM" + bytes(400))
    assert "clear; load('new.mat'); save('new_v7.mat', '-v7')" in refusal("new.mat")
    (tmp_path / "torn.npz").write_bytes(npz(tmp_path).read_bytes()[:900])
    (tmp_path / "torn.json").write_text('{"t": [1, 2')
    (tmp_path / "torn.xlsx").write_bytes(b"PK\x03\x04 no book")
    (tmp_path / "torn.ulg").write_bytes(b"no log of PX4")
    for name in ("torn.npz", "torn.json", "torn.xlsx", "torn.ulg"):
        assert f"{name}: cannot be read" in refusal(name)
    (tmp_path / "empty.json").write_text('{"version": 3, "name": "cell"}')
    assert "no table in it" in refusal("empty.json")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "run.npy").write_bytes(b"")
    assert "run.npy (the file is empty; record or copy it again)" in refusal("empty")
    (tmp_path / "old.xls").write_bytes(b"")
    assert "save it as .xlsx" in refusal("old.xls")
    assert "has: command_t" in one_line(RunError, lambda: tables.read(tmp_path / "log.npz"))
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    (tmp_path / "later.xlsx").write_bytes(b"PK")
    assert "pip install 'pumafuse[formats]'" in refusal("later.xlsx")


def test_arrays_of_a_folder_are_columns_beside_the_one_that_is_their_clock(tmp_path: Path) -> None:
    """Files as long as a clock are its columns, also in another folder; settings and what is no array are none."""
    log = tmp_path / "log"
    for folder, time, name, values in (("arm", TIME, "goal_deg", TOLD), ("tracker", LATER, "seen_deg", SEEN)):
        (log / folder).mkdir(parents=True)
        np.save(log / folder / "epoch.npy", 1e3 * (1_790_000_000 + time))
        np.save(log / folder / f"{name}.npy", np.rad2deg(values))
    np.save(log / "arm" / "gains.npy", np.ones(7))
    np.save(log / "arm" / "about.npy", np.array([{"robot": "ur5"}]), allow_pickle=True)
    found = survey(log)
    run, _ = written(found, tmp_path / "out")
    for read in (found.run, run):
        assert read.command.stamp.tolist() == pytest.approx((1e9 * (1_790_000_000 + TIME)).tolist(), abs=1e3)
        np.testing.assert_allclose(np.column_stack(list(read.command.values.values())), TOLD, atol=1e-12)
        (sensor,) = read.sensors.values()
        np.testing.assert_allclose(np.column_stack(list(sensor.values.values())), SEEN, atol=1e-12)
    assert any("objects of Python" in note for part in found.parts for note in part.notes if part.label == "about.npy")


def test_arrays_of_a_folder_without_one_clock_stay_apart(tmp_path: Path) -> None:
    """Where none rises, or two do as clocks, nothing says whose it is: a rate is asked for, and taken."""
    arrays = {"goal_rad": path(TIME), "encoder_rad": path(TIME - LAG), **dict.fromkeys(["time_cmd", "time_enc"], TIME)}
    for name, values in arrays.items():
        np.save(tmp_path / f"{name}.npy", values)
    assert "give it to init as --rate HZ" in one_line(RunError, lambda: survey(tmp_path))
    assert [one.lag for one in survey(tmp_path, 50.0).relations.values()] == [pytest.approx(LAG, abs=2e-3)] * 2


@pytest.mark.parametrize("kind", ["mat", "csv", "no clock"])
def test_rows_that_are_signals_are_columns(kind: str, tmp_path: Path) -> None:
    """Arrays and texts of few rows of many numbers are read turned, which is said; an array may hold its clock."""
    time, told, seen = 20.0 * np.arange(600), np.rad2deg(path(TIME)), np.rad2deg(path(TIME - LAG))
    whole = np.vstack([time, told.T, seen.T])[kind == "no clock" :]
    file = tmp_path / f"log.{'mat' if kind == 'mat' else 'csv'}"
    if kind == "mat":
        savemat(file, {"recorded": whole})
    else:
        file.write_text("".join("; ".join(map("{:.9f}".format, row)) + "\n" for row in whole))
    said = f"{file.name}: has {len(whole)} rows of 600 numbers: read turned, each row as a column"
    if kind == "no clock":
        assert "--rate HZ" in one_line(RunError, lambda: survey(file))
    found = survey(file, 50.0 if kind == "no clock" else 0.0)
    assert said in found.parts[0].notes
    run, _ = written(found, tmp_path / "out")
    for stream, values in zip(found.roles.streams, (told, seen), strict=True):
        read = np.column_stack([columns[0].plain for columns in stream.axes.values()])
        np.testing.assert_allclose(read, values, atol=1e-8)
    np.testing.assert_allclose(run.command.stamp / 1e9, TIME, atol=1e-9)
    for axis, value in found.run.command.values.items():
        assert np.array_equal(run.command.values[axis], value)


def test_few_long_rows_in_which_nothing_changes_are_refused_and_not_turned(tmp_path: Path) -> None:
    """As those of an array that was never filled, without a warning of the numerics."""
    np.savetxt(tmp_path / "log.csv", np.zeros((6, 400)), "%.3f", delimiter=",")
    assert "no columns of positions" in one_line(RunError, lambda: survey(tmp_path / "log.csv"))


@pytest.mark.parametrize("name", ["arm", "arm.xls"])
def test_a_text_of_numbers_is_a_table_whatever_it_is_called(name: str, tmp_path: Path) -> None:
    """As a file, and as the only one of a folder; prose and bytes are none."""
    header = "recorded by hand\ntime_s goal.a_rad goal.b_rad pv.a_rad pv.b_rad"
    np.savetxt(tmp_path / name, np.column_stack([TIME, TOLD, path(TIME - LAG)]), header=header, comments="")
    (tmp_path / "README.rst").write_text("Arm\n===\nIt moved, 3 times,\nand 4 times, then.\n")
    (tmp_path / "thumbnail").write_bytes(b"1 2\n3 4\n5 6\n\0\xff")
    for log in (tmp_path / name, tmp_path):
        assert [one.lag for one in survey(log).relations.values()] == [pytest.approx(LAG, abs=2e-3)] * 2
    for other in ("README.rst", "thumbnail"):
        assert "no log that can be read" in one_line(RunError, lambda other=other: survey(tmp_path / other))

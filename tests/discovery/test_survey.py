"""What is found in logs of many kinds, and that the files written load and fuse."""

import csv
import json
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as papq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import structs
from scipy.io import savemat
from scipy.spatial.transform import Rotation

import bag_files
import pumafuse as pf
from bag_files import KINDS
from pumafuse.arrays import FloatArray
from pumafuse.discovery import names
from pumafuse.discovery.contents import parts_of
from pumafuse.discovery.drafts import drafts
from pumafuse.discovery.guesses import guess
from pumafuse.discovery.questions import decisions, questions
from pumafuse.discovery.survey import Survey, survey
from pumafuse.errors import ConfigError, RunError
from pumafuse.space.kinematics import Chain
from pumafuse.units import wraps
from px4_files import write_ulg
from refusals import one_line
from tuning_runs import later

START = 1_790_000_000  # s
LAG = 0.1  # s
URDF = Path(__file__).parents[2] / "examples" / "pose-virtual" / "puma560.urdf"


def path(t: FloatArray) -> FloatArray:
    """Three axes of a smooth motion from rest [m], (n, 3)."""
    t = np.maximum(t, 0.0)[:, None]
    return np.array([0.3, 0.2, 0.1]) * (1.0 - np.cos(t * np.array([0.7, 1.1, 1.7])))


def write(file: Path, columns: dict[str, Any]) -> None:
    with file.open("w", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def surveyed(folder: Path, columns: dict[str, Any]) -> Survey:
    """What is found in a table of these columns."""
    write(folder / "log.csv", columns)
    return survey(folder / "log.csv")


def refusal(folder: Path, columns: dict[str, Any]) -> str:
    """The line that refuses a table of these columns."""
    return one_line(RunError, lambda: surveyed(folder, columns))


def xyz(values: FloatArray, name: str = "{}_m") -> dict[str, Any]:
    return {name.format(axis): values[:, place] for place, axis in enumerate("xyz")}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A folder for the files of a log, beside what is made of it."""
    (tmp_path / "log").mkdir()
    return tmp_path / "log"


def recorded(count: int = 1000, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Times and commands every 20 ms; times and measurements 4 ms later, 0.1 s late, with 0.5 mm of noise."""
    t = 0.02 * np.arange(count)
    noise = np.random.default_rng(seed).normal(scale=5e-4, size=(count, 3))
    return t, path(t), t + 0.004, path(t + 0.004 - LAG) + noise


def recorded_at_once() -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same with commands and measurements in the same rows: times, commands, measurements."""
    t, u, s, z = recorded()
    return t, u, path(t - LAG) + z - path(s - LAG)


T, U, S, Z = recorded()
ZT = recorded_at_once()[2]


def asked(found: Survey) -> list[str]:
    return list(questions(found, guess(found)[1]))


def written(found: Survey, folder: Path) -> tuple[pf.Run, pf.FusionConfig]:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in drafts(found, *guess(found), folder).items():
        (folder / name).write_text(text)
    return pf.Run.read(folder), pf.FusionConfig.load(folder / "fusion.toml")


def check_fuses(log: Path, folder: Path, axes: tuple[str, ...] = ("x", "y", "z"), rate: float = 0.0) -> Survey:
    """A log of :func:`recorded` fuses as it is, and well."""
    found = survey(log, rate)
    run, config = written(found, folder)
    assert run.axes == axes == tuple(config.arm.axes)
    assert tuple(run.sensors) == tuple(config.sensors)
    assert config.arm.update_period == pytest.approx(0.02, rel=0.01)
    for axis in axes:
        assert config.arm.lag_of(axis) == pytest.approx(LAG - 0.01, abs=0.01)  # behind the held command
    est = pf.fuse(run, config)
    counts = est.measurements.counts()
    assert counts["fused"] > 0.9 * sum(counts.values()), counts
    truth = path((est.time - est.time[0]) - LAG)
    for number, axis in enumerate(axes):
        error = est[axis].position[50:] - truth[50:, number]
        assert np.sqrt(np.mean(error**2)) < 5e-4, axis
    return found


@pytest.mark.parametrize("kind", ["csv", later("parquet"), later("json")])
def test_among_thousands_of_columns_names_tell_who_is_who(tmp_path: Path, kind: str) -> None:
    t, u, z = (one[:300] for one in recorded_at_once())
    told = {"cmd_x": u[:, 0], "meas_x": z[:, 0], "time": t}
    others = {f"c{n}": np.full(len(t), n % 7) + t for n in range(2_100)}
    found = list[Survey]()
    for name, columns in (("few", told), ("many", {**others, **told})):
        file = tmp_path / f"{name}.{kind}"
        if kind == "json":
            file.write_text(json.dumps({key: value.tolist() for key, value in columns.items()}))
        else:
            write(file, columns) if kind == "csv" else papq.write_table(pa.table(columns), file)
        found.append(survey(file))
    few, many = found
    assert many.relations == few.relations
    assert (many.run.command.values["x"] == few.run.command.values["x"]).all()
    assert "of 2103 columns the 2000 are read whose names tell most" in many.parts[0].notes[-1]


@pytest.mark.parametrize(
    ("name", "stamps", "unit"),
    [
        ("time_s", lambda t: [repr(float(one)) for one in t], ""),
        ("t", lambda t: [repr(float(one)) for one in t], "s"),
        ("t", lambda t: [repr(float(1e3 * one)) for one in t], "ms"),
        ("timestamp", lambda t: [round(1e6 * (START + one)) for one in t], "us"),
        ("stamp", lambda t: [START * 10**9 + round(1e9 * one) for one in t], "ns"),
        ("Time [ms]", lambda t: [repr(float(1e3 * (START + one))) for one in t], "ms"),
        ("uptime_s", lambda t: [repr(float(one)) for one in t], ""),
        ("uptime_ms", lambda t: [repr(float(1e3 * one)) for one in t], ""),
        ("date", lambda t: [str(np.datetime64(START * 10**9 + round(1e9 * one), "ns")) for one in t], ""),
        ("asctime", lambda t: [f"2026-11-25 10:00:{one:06.3f}".replace(".", ",") for one in t], ""),
        ("Zeit", lambda t: [f"25.11.2026 10:00:{one:06.3f}" for one in t], ""),
        ("Time", lambda t: [f"{one:g} sec" for one in t], ""),
        ("time", lambda t: [f"12:00:{one:06.3f}" for one in t], ""),
        ("", lambda t: [f"0 days 00:00:{one:09.6f}" for one in t], ""),
        ("", lambda t: [repr(float(one)) for one in t], "s"),
    ],
)
def test_clocks_are_known_by_name_by_date_and_by_interval(
    name: str, stamps: Any, unit: str, log: Path, tmp_path: Path
) -> None:
    """Whatever the unit of the stamps, and whatever says it, the log is the same one."""
    t, u, s, z = recorded()
    write(log / "commands.csv", {name: stamps(t), **xyz(u)})
    write(log / "camera.csv", {name: stamps(s), **xyz(z)})
    found = check_fuses(log, tmp_path / "out")
    assert {part.clock.time.unit for part in found.parts if part.clock} == {unit}


@pytest.mark.parametrize(("unit", "scale"), [("_deg", 180.0 / np.pi), ("_rad", 1.0), ("", 1.0)])
@pytest.mark.parametrize("all_within", [False, True])
def test_angles_that_begin_anew_after_a_turn(
    unit: str, scale: float, all_within: bool, log: Path, tmp_path: Path
) -> None:
    """A table that turns four times, seen within a turn: it follows, and both files say that it goes on."""

    def yaw(time: FloatArray) -> FloatArray:
        return 1.2 * np.maximum(time, 0.0) + 0.5 * np.sin(1.9 * np.maximum(time, 0.0))

    def within(angle: FloatArray) -> FloatArray:
        return (angle + np.pi) % (2.0 * np.pi) - np.pi

    noisy = yaw(S - LAG) + np.random.default_rng(1).normal(scale=1e-3, size=len(S))
    write(log / "commands.csv", {"t_s": T, f"yaw{unit}": scale * (within(yaw(T)) if all_within else yaw(T))})
    write(log / "gyro_sensor.csv", {"t_s": S, f"yaw{unit}": scale * within(noisy)})
    found = survey(log)
    run, config = written(found, tmp_path / "out")
    assert config.sensors["gyro_sensor"].turn == pytest.approx(2.0 * np.pi)
    assert np.ptp(run.sensors["gyro_sensor"].values["yaw"]) > 20.0
    assert config.start.offset_sd_of("yaw") < 0.1
    est = pf.fuse(run, config)
    assert (est.measurements.outcome == pf.Outcome.FUSED).all()
    assert np.std(est["yaw"].position[50:] - yaw(est.time - est.time[0] - LAG)[50:]) < 2e-3


@pytest.mark.parametrize("file", ["poses.csv", "poses.txt", "groundtruth.txt"])
def test_a_trajectory_of_tum_is_a_sensor(file: str, log: Path) -> None:
    """With its header in a comment, or without; other texts beside it are none.

    z moves as x does: names decide. What is called the truth is a sensor where there is no other.
    """
    t, u, s, z = recorded()
    alike = [0, 1, 0]
    write(log / "commands.csv", {"t_s": START + t, **{f"{a}_m": u[:, n] for n, a in zip(alike, "xyz", strict=True)}})
    rows = zip(s, *z[:, alike].T, strict=True)
    text = "".join(
        f"{START + at:.4f} {x:.7f} {y:.7f} {z:.7f} 0 0 {np.sin(at):.4f} {np.cos(at):.4f}\n" for at, x, y, z in rows
    )
    (log / file).write_text(f"# tracker\n# timestamp tx ty tz qx qy qz qw\n{text}")
    (log / "README.txt").write_text("A table that was moved\nby hand, 1 m at a time.\n")
    (log / "notes.dat").write_bytes(b"\x00\x01\x02")
    found = survey(log)
    (sensor,) = found.roles.sensors
    assert {axis: one[0].column for axis, one in sensor.axes.items()} == {"x": "tx", "y": "ty", "z": "tz"}
    assert {part.label for part in found.parts} == {"commands.csv", file}


def test_tables_without_a_header(log: Path, tmp_path: Path) -> None:
    """As ``ros2 topic echo --csv`` writes poses: seconds and nanoseconds apart, then a word."""
    t, u, s, z = recorded()
    for name, time, value in (("goal_pose", t, u), ("tracker", s, z)):
        rows = zip(time, *value.T, strict=True)
        lines = [f"{START + int(a)},{round(1e9 * (a % 1.0)):d},base,{x:.7f},{y:.7f},{z:.7f}\n" for a, x, y, z in rows]
        (log / f"{name}.csv").write_text("".join(lines))
    found = check_fuses(log, tmp_path / "out", ("column_4", "column_5", "column_6"))
    assert {part.clock.time.nanoseconds for part in found.parts if part.clock} == {"column 2"}


def test_columns_of_a_turned_sensor_are_in_their_order(log: Path) -> None:
    """Turned by 125°, the second follows x against its sign, and the first y: exchanged they would be mirrored."""
    write(log / "goal.csv", {"time": T, **xyz(U)})
    turned = np.add(Rotation.from_euler("z", -125.0, degrees=True).apply(Z), [4.0, -5.0, 0.5])
    np.savetxt(log / "tracker.txt", np.column_stack([S, turned]), "%.7f")
    found = survey(log)
    (sensor,) = found.roles.sensors
    assert [sensor.axes[axis][0].column for axis in "xyz"] == ["column 2", "column 3", "column 4"]


@pytest.mark.parametrize("stamps", ["none", "frames", "seconds"])
def test_tables_without_stamps_need_a_rate(stamps: str, log: Path, tmp_path: Path) -> None:
    """Without any column of time, with a number of frames, of which some are lost, and with stamps of whole seconds."""
    kept = np.ones(len(T), dtype=np.bool_)
    kept[300:302] = stamps != "frames"
    clock = {"none": {}, "frames": {"Frame": np.arange(len(T))[kept]}, "seconds": {"pc_ts": START + T.astype(np.int64)}}
    for name, value in (("goal", U), ("camera", ZT)):
        write(log / f"{name}.csv", {**clock[stamps], **xyz(value[kept])})
    said = one_line(RunError, lambda: survey(log))
    assert "if rows come at a constant rate, give it to init as --rate HZ; or say in run.toml" in said
    stands = "pc_ts is no clock: 20 distinct stamps, one every 1 s, in 1000 rows"
    assert (stands in said) == (stamps == "seconds")
    check_fuses(log, tmp_path / "out", rate=50.0)
    time = tomllib.loads((tmp_path / "out" / "run.toml").read_text())["command"]["time"]
    assert time == ({"column": "Frame", "rate_hz": 50} if stamps == "frames" else {"rate_hz": 50})


LISTS: dict[str, Callable[[FloatArray], str]] = {
    "python": lambda row: f'"[{row[0]:.7f}, {row[1]:.7f}, {row[2]:.7f}]"',
    "tuple": lambda row: f'"({row[0]:.7f}, {row[1]:.7f}, {row[2]:.7f})"',
    "array": lambda row: f"\"array('d', [{row[0]:.7f}, {row[1]:.7f}, {row[2]:.7f}])\"",
    "numpy": lambda row: f'"array([{row[0]:.7f}, {row[1]:.7f}, {row[2]:.7f}], dtype=float32)"',
    "numpy over lines": lambda row: f'"[{row[0]:.7e} {row[1]:.7e}\n {row[2]:.7e}]"',
    "without quotes": lambda row: f"[{row[0]:.7f}, {row[1]:.7f}, {row[2]:.7f}]",
    "numpy without quotes": lambda row: f"[{row[0]:.7f} {row[1]:.7f} {row[2]:.7f}]",
}


@pytest.mark.parametrize("form", LISTS)
def test_cells_that_hold_lists_as_text(form: str, log: Path) -> None:
    """As Python, pandas and numpy write them, also over several lines; names beside them are those of the elements."""
    for name, time, value in (("cmd", T, U), ("joint_states", S, Z)):
        names_of = "\"['x', 'y', 'z']\""
        lines = [f"{at:.6f},{names_of},{LISTS[form](row)}\n" for at, row in zip(time, value, strict=True)]
        if "without" in form:
            lines = [line.replace(f"{names_of},", "") for line in lines]
        header = "time,position\n" if "without" in form else "time,name,position\n"
        (log / f"{name}.csv").write_text("".join([header, *lines]))
    found = survey(log)
    assert found.roles is not None and all(part.rows == len(T) for part in found.parts)
    axes = {"joint0", "joint1", "joint2"} if "without" in form else {"x", "y", "z"}
    assert set(found.roles.command.axes) == axes
    for number, value in enumerate(found.roles.command.source.values.values()):
        np.testing.assert_allclose(value, U[:, number], atol=1e-7)


def long_rows(kind: str) -> list[list[str]]:
    """The log of :func:`recorded` with axes, or sources, in rows of their own, in the order of time."""
    t, u, z = recorded_at_once()
    rows: list[tuple[float, list[str]]] = []
    for number, axis in enumerate("xyz"):
        apart = 3e-4 * number if kind == "stamps of their own" else 0.0
        for at, goal, state in zip(t + apart, u[:, number], z[:, number], strict=True):
            if kind == "tags":
                rows += [(at, [f"root.{axis}.{what}", f"{x:.7f}"]) for what, x in (("SetPos", goal), ("ActPos", state))]
            else:
                rows.append((at, [str(11 + number) if kind == "numbers" else axis, f"{goal:.7f}", f"{state:.7f}"]))
    if kind == "sources":
        rows = [(at, ["goal", *map("{:.7f}".format, row)]) for at, row in zip(t, u, strict=True)]
        rows += [(at + 1e-6, ["camera", *map("{:.7f}".format, row)]) for at, row in zip(t, z, strict=True)]
    return [[f"{at:.6f}", *cells] for at, cells in sorted(rows, key=lambda row: row[0])]


@pytest.mark.parametrize(
    ("kind", "header", "axes"),
    [
        ("names", "time_s,joint,desired_position_m,actual_position_m", "xyz"),
        ("stamps of their own", "time_s,joint,desired_position_m,actual_position_m", "xyz"),
        ("numbers", "time_s,id,goal_position_m,present_position_m", ["joint_11", "joint_12", "joint_13"]),
        ("tags", "time_s,tag,value_m", ["root_x", "root_y", "root_z"]),
        ("sources", "time_s,source,x_m,y_m,z_m", "xyz"),
    ],
)
def test_axes_and_sources_in_rows_of_their_own(kind: str, header: str, axes: Sequence[str], tmp_path: Path) -> None:
    """As loggers of joints, historians and databases of time series write them: a column says whose a row is."""
    lines = [header, *(",".join(row) for row in long_rows(kind))]
    (tmp_path / "log.csv").write_text("\n".join([*lines, ""]))
    check_fuses(tmp_path / "log.csv", tmp_path / "out", tuple(axes))


def test_a_signal_that_hardly_ever_speaks_is_in_nobody_elses_way(tmp_path: Path) -> None:
    """A door that opened twice in a minute, among signals in rows of their own: these are told apart all the same."""
    rows = [",".join(row) for row in long_rows("tags")]
    rows[40:40], rows[900:900] = ["0.131,cell.door,1"], ["2.991,cell.door,0"]
    (tmp_path / "log.csv").write_text("\n".join(["time_s,tag,value_m", *rows, ""]))
    check_fuses(tmp_path / "log.csv", tmp_path / "out", ("root_x", "root_y", "root_z"))


@pytest.mark.parametrize("kind", ["signals", "joints", "words behind, no header", "words in front, no header", "dates"])
def test_signals_one_below_another(kind: str, tmp_path: Path) -> None:
    """As pandas melts a table: a column tells which signal a row is of, and the clock begins anew with each."""
    rows = list[list[str]]()
    for number, axis in enumerate("xyz" if kind == "joints" else ""):
        both = zip(T, U[:, number], ZT[:, number], strict=True)
        rows += [[f"{a:.4f}", f"{told:.7f}", f"{seen:.7f}", axis] for a, told, seen in both]
    for time, value, role in ((T, U, "demand"), (T[::2], ZT[::2], "vicon")) if kind != "joints" else ():
        for number, axis in enumerate("xyz"):
            cells = [f"{a:.4f}" if kind != "dates" else f"2026-02-03T04:05:{a:07.4f}" for a in time]
            rows += [[a, f"{one:.7f}", f"{role}_{axis}"] for a, one in zip(cells, value[:, number], strict=True)]
    rows = [row[::-1] for row in rows] if "front" in kind else rows
    header = {"joints": "t_s,target_m,reached_m,axis", "signals": "t_s,val_m,variable", "dates": "when,number,tag"}
    lines = [header[kind]] if kind in header else []
    (tmp_path / "log.csv").write_text("\n".join([*lines, *map(",".join, rows), ""]))
    found = survey(tmp_path / "log.csv")
    run, _ = written(found, tmp_path / "out")
    (sensor,) = run.sensors.values()
    for number, axis in enumerate(run.axes):
        for source, value in ((run.command, U), (sensor, ZT if kind == "joints" else ZT[::2])):
            stamp, read = source.series(axis)
            assert (np.diff(stamp) > 0).all()
            np.testing.assert_allclose(read, value[:, number], atol=1e-6)
    assert {round(one.lag, 2) for one in found.relations.values()} == {LAG}


@pytest.mark.parametrize(
    ("told", "seen", "roles"),
    [
        ("goal{}", "measured{}", ("command", "sensor")),
        ("{}soll", "{}ist", ("command", "sensor")),
        ("setpoint{}", "actual{}", ("command", "sensor")),
        ("reference{}", "{}", ("reference", None)),
        ("target{}2", "real{}2", ("command", "sensor")),
    ],
)
def test_words_of_roles_need_no_separator(told: str, seen: str, roles: tuple[str | None, ...], tmp_path: Path) -> None:
    """Before or behind an axis; what is no position is none then, either."""
    others = {told.format("vel"): U[:, 0], seen.format("torque"): ZT[::-1, 1]}
    found = surveyed(tmp_path, {"t_s": T, **xyz(ZT, seen), **xyz(U, told), **others})
    assert (
        found.roles is not None and [one.lag for one in found.relations.values()] == [pytest.approx(LAG, abs=5e-3)] * 3
    )
    assert tuple(names.column_role(form.format("y")) for form in (told, seen)) == roles
    for stream, form in zip(found.roles.streams, (told, seen), strict=True):
        assert [one[0].column for one in stream.axes.values()] == [form.format(axis) for axis in "xyz"]
    assert set(found.parts[0].left_out) >= set(others)


@pytest.mark.parametrize(
    "word", ["comx", "wristx", "realtime", "preset_x", "offset", "dataset", "desk", "refine", "isty2k"]
)
def test_words_that_only_look_so_are_one(word: str) -> None:
    """A centre of mass, a joint, a clock: no role."""
    assert not names.role_words(word)


@pytest.mark.parametrize("first", ["beacon", "measured"])
def test_columns_beside_the_commands_are_called_by_what_stands_before_their_axes(first: str, tmp_path: Path) -> None:
    """In whatever order they stand, and where all of them have it; what is called measured keeps its name."""
    seen = {"beacon": path(T - 0.14), "measured": ZT}
    columns = [xyz(seen[name], f"{name}_{{}}_m") for name in sorted(seen, key=lambda name: name != first)]
    write(tmp_path / "log.csv", {"t_s": T, **xyz(U, "goal_{}_m"), **columns[0], **columns[1]})
    lags = {name: one.lag for (name, _), one in survey(tmp_path / "log.csv").relations.items()}
    assert lags == {"beacon": pytest.approx(0.14, abs=5e-3), "measured": pytest.approx(LAG, abs=5e-3)}
    write(tmp_path / "log.csv", {"t_s": T, **xyz(U, "goal_{}_m"), "one_x_m": ZT[:, 0], "other_y_m": ZT[:, 1]})
    assert set(survey(tmp_path / "log.csv").run.sensors) == {"measured"}


@pytest.mark.parametrize(
    ("raw", "filtered"),
    [
        ("{}", "{}_lowpass"),
        ("{}_raw", "{}_smoothed"),
        ("raw_seen_{}", "seen_{}"),
        ("encoder_{}", "encoder_{}_filt"),
        ("measured_{}", "ekf_{}"),
        ("pv_{}", "estimated_{}"),
        ("pose_raw.csv", "pose_filtered.csv"),
    ],
)
def test_of_raw_and_filtered_numbers_of_one_quantity_the_raw_ones_are_the_sensor(
    raw: str, filtered: str, tmp_path: Path
) -> None:
    """Whichever follows the commands more closely, and it is said; alone, filtered ones are a sensor."""
    smooth = {"t_s": T, **xyz(path(T - 0.02), f"{filtered}_m" if "csv" not in filtered else "{}_m")}
    rough = {"t_s": T, **xyz(ZT, f"{raw}_m" if "csv" not in raw else "{}_m")}
    (tmp_path / "log").mkdir()
    for name, beside in (("both", rough), ("alone", {})):
        if "csv" in raw:
            write(tmp_path / "log" / "goal.csv", {"t_s": T, **xyz(U)})
            write(tmp_path / "log" / filtered, smooth)
            (write if beside else lambda file, _: file.unlink())(tmp_path / "log" / raw, beside)
        else:
            write(tmp_path / "log" / "log.csv", {**xyz(U, "goal_{}_m"), **smooth, **beside})
        found = survey(tmp_path / "log")
        assert found.roles is not None and len(found.run.sensors) == 1
        lag = LAG if name == "both" else 0.02
        assert {round(one.lag, 2) for one in found.relations.values()} == {lag}
        said = [why for _, why in found.roles.left_out if "is not raw by its name: " in why]
        assert len(said) == (name == "both")


def test_a_filtered_sensor_beside_another_device_stays(tmp_path: Path) -> None:
    columns = {**xyz(U, "goal_{}_m"), **xyz(ZT, "camera_{}_m"), **xyz(path(T - LAG), "encoder_filt_{}_m")}
    assert (
        len(surveyed(tmp_path, {"t_s": T, **columns, **xyz(2.0 * ZT - path(T - LAG), "tracker_{}_m")}).run.sensors) == 3
    )


def test_a_sensor_that_says_again_what_another_says_is_no_second_one(tmp_path: Path) -> None:
    """As the log of a policy has the encoders twice, as what it observes and as what is measured."""
    columns = {**xyz(U, "goal_{}_m"), **xyz(ZT, "encoder_{}_m"), **xyz(ZT, "observed_{}_m")}
    found = surveyed(tmp_path, {"t_s": T, **columns})
    assert found.roles is not None and list(found.run.sensors) == ["encoder"]
    assert [why for _, why in found.roles.left_out] == ["the same numbers as encoder, at the same time"]


def many_joints(tmp_path: Path) -> list[str]:
    """What a policy of 21 joints logs: what it puts out, set points made from that, and joints under other names."""
    t = 0.02 * np.arange(600)
    limbs, parts = ("left", "right", "rear"), ("hip", "thigh", "calf", "foot", "toe", "heel", "sole")
    joints = [f"{limb}_{part}" for limb in limbs for part in parts]
    pulse = np.linspace(0.5, 2.5, len(joints))
    put_out = np.sin(t[:, None] * pulse + pulse)
    seen = 0.2 * np.sin((t - LAG)[:, None] * pulse + pulse) + np.random.default_rng(3).normal(0.0, 1e-4, put_out.shape)
    columns = {"t_s": t, **{f"action_net_{joint}": put_out[:, n] for n, joint in enumerate(joints)}}
    columns |= {f"target_sent_{joint}": 0.2 * put_out[:, n] for n, joint in enumerate(joints)}
    write(tmp_path / "log.csv", columns | {f"in_{n}: dof_pos_{joint}": seen[:, n] for n, joint in enumerate(joints)})
    return joints


def test_of_many_joints_the_ends_of_their_names_tell_which_is_which(tmp_path: Path) -> None:
    """More pairs than could be compared by how they move."""
    joints = many_joints(tmp_path)
    relations = survey(tmp_path / "log.csv").relations
    assert [axis.removeprefix("sent_") for _, axis in relations] == joints
    assert {round(one.lag, 2) for one in relations.values()} == {LAG}


def test_set_points_are_what_is_followed_as_far_not_what_they_are_scaled_from(tmp_path: Path) -> None:
    joints = many_joints(tmp_path)
    found = survey(tmp_path / "log.csv")
    assert of_roles(found)[0] == [f"target_sent_{joint}" for joint in joints]
    questions_asked = asked(found)
    assert not [question for question in questions_asked if "times as far" in question]
    assert [question for question in questions_asked if "other commands than target: exchange the two" in question]


def test_a_command_that_leaps_away_decides_no_unit(tmp_path: Path) -> None:
    t, u, z = recorded_at_once()
    u[500, 1] *= 1000.0
    found = surveyed(tmp_path, {"t_s": t, **xyz(u, "sp_{}"), **xyz(z, "pv_{}")})
    assert "are the numbers of log.csv in m? No name says it (run.toml)" in asked(found)


@pytest.mark.parametrize("alarm", ["", "HIHI MAJOR"])
def test_lines_as_the_monitor_of_epics_writes_them(alarm: str, tmp_path: Path) -> None:
    """A channel, a date, a time and a value, with blanks between: no line is a header, by whatever name.

    Behind the first there may be an alarm.
    """
    rows = [
        (at + late, f"BL7:{a}.{what}", value[n, k])
        for k, a in enumerate("xyz")
        for what, value, late in (("SP", U, 0.0), ("RBV", ZT, 1e-4))
        for n, at in enumerate(T)
    ]
    lines = [f"{channel:<30} 2026-03-05 14:02:{at:09.6f} {value:.6f}  " for at, channel, value in sorted(rows)]
    (tmp_path / "stage.log").write_text("\n".join([lines[0] + alarm, *lines[1:], ""]))
    relations = survey(tmp_path / "stage.log").relations
    assert len(relations) == 3
    assert [(one.lag, one.slope) for one in relations.values()] == [pytest.approx((LAG, 1.0), abs=0.02)] * 3


def test_trials_one_below_another_are_no_signals(tmp_path: Path) -> None:
    """Where each part holds commands and measurements of the same axes, the words beside them tell runs apart."""
    twice = {
        name: np.concatenate([value, value]) for name, value in {**xyz(U, "goal.{}_m"), **xyz(ZT, "pv.{}_m")}.items()
    }
    assert surveyed(
        tmp_path, {"t_s": np.tile(T, 2), "load": np.repeat(["empty", "full"], len(T)), **twice}
    ).run.axes == ("x", "y", "z")


def test_signals_that_nothing_tells_apart_are_described_and_no_column_is_both(tmp_path: Path) -> None:
    """The refusal says what the table looks like; what it says to add makes it a log; a column measures not itself."""
    stacked = {"stamp_ms": np.tile(1e3 * T, 2), "reading_mm": 1e3 * np.concatenate([U[:, 0], ZT[:, 0]])}
    said = refusal(tmp_path, stacked)
    assert "the clock of log.csv begins anew in row 1001: if its rows are signals one below another, add" in said
    for name, (first, second) in {"log": ("command_x", "measured_x"), "other": ("soll_x", "ist_x")}.items():
        write(tmp_path / f"{name}_2.csv", {**stacked, "signal": np.repeat([first, second], len(T))})
        check_fuses(tmp_path / f"{name}_2.csv", tmp_path / name, ("x_reading",))
    table = 'file = "log.csv"\ntime = "stamp_ms"\nx = '
    for told, measured in (
        ('"reading_mm"', '"reading_mm"'),
        ('["reading_mm", "reading_mm"]', '"reading_mm"'),
        ('["stamp_ms", "reading_mm"]', '["reading_mm", "stamp_ms"]'),
    ):
        (tmp_path / "run.toml").write_text(f"[command]\n{table}{told}\n[sensors.arm]\n{table}{measured}\n")
        assert ", and so is command.x: give each" in one_line(ConfigError, lambda: survey(tmp_path))
    (tmp_path / "run.toml").write_text(f'[command]\n{table}"reading_mm"\n[sensors.arm]\n{table}"reading_mm"\n')
    said = one_line(ConfigError, lambda: survey(tmp_path))
    assert "sensors.arm.x is the column 'reading_mm' of log.csv, and so is command.x" in said
    (tmp_path / "run.toml").write_text("[command\n")
    assert "run.toml" in one_line(ConfigError, lambda: survey(tmp_path))


def test_set_points_are_what_is_measured_and_the_error_of_a_controller(tmp_path: Path) -> None:
    """A log without them: a measured column may be part of a sum that is commanded, and the sum is followed."""
    write(
        tmp_path / "log.csv", {"t_s": T, "level_mm": 1e3 * ZT[:, 0], "error_mm": 1e3 * (U - ZT)[:, 0], "duty": ZT[:, 1]}
    )
    columns = 'file = "log.csv"\ntime = "t_s"\nboom = '
    told = f'[command]\n{columns}["level_mm", "error_mm"]\n'
    (tmp_path / "run.toml").write_text(f'{told}[sensors.gauge]\n{columns}"level_mm"\n')
    relation = survey(tmp_path).relations["gauge", "boom"]
    assert relation.lag == pytest.approx(LAG, abs=0.01) and relation.slope == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("error", ["error_mm", "following_err"])
def test_the_error_of_a_controller_alone_is_no_command(error: str, tmp_path: Path) -> None:
    """It is said what it is, and that the set points are its sum with what is measured."""
    text = refusal(tmp_path, {"t_s": T, "level_mm": 1e3 * ZT[:, 0], error: 1e3 * (U - ZT)[:, 0]})
    assert f"{error} of log.csv is an error: if it is the set point less what is measured" in text
    columns = 'file = "log.csv"\ntime = "t_s"\nboom = '
    told = f'[command]\n{columns}{{ column = "{error}", unit = "mm" }}\n'
    (tmp_path / "run.toml").write_text(f'{told}[sensors.gauge]\n{columns}"level_mm"\n')
    for read in (survey, pf.Run.read):
        text = one_line(ConfigError, lambda read=read: read(tmp_path))
        assert f'the commands are the sum of both: boom = ["MEASURED", "{error}"]' in text


def test_a_status_that_changes_all_the_time_tells_nothing_apart(tmp_path: Path) -> None:
    words = np.where(np.random.default_rng(1).random(len(T)) < 0.5, "good", "poor")
    columns = {**xyz(U, "goal.{}_m"), **xyz(ZT, "camera.{}_m")}
    write(tmp_path / "log.csv", {"time_s": T, "status": words, **columns})
    check_fuses(tmp_path / "log.csv", tmp_path / "out")


def test_commands_that_are_samples_of_a_path(tmp_path: Path) -> None:
    """An arm that follows the path between commands 30 ms late: it is far better fused if that is known, and is said.

    One that is late by more than half an interval may as well hold each command.
    """
    t = 0.1 * np.arange(400)
    s = np.arange(0.05, 39.0, 0.1)
    noise = np.random.default_rng(3).normal(scale=2e-4, size=(len(s), 3))
    error = {}
    for late in (0.03, 0.08):
        for name, at, value in (("goal", t, path(t)), ("camera", s, path(s - late) + noise)):
            write(tmp_path / f"{name}.csv", {"time_s": at, **xyz(value)})
        found = survey(tmp_path)
        if late == 0.08:
            assert not found.interpolation
            continue
        assert found.interpolation == 0.01
        assert "(interpolation_ms in run.toml)" in "\n".join(asked(found))
        run, config = written(found, tmp_path / "out")
        assert config.arm.update_period == pytest.approx(0.01)
        assert not survey(tmp_path / "out").interpolation
        text = (tmp_path / "out" / "run.toml").read_text()
        (tmp_path / "out" / "run.toml").write_text(text.replace("interpolation_ms", "# interpolation_ms"))
        described = survey(tmp_path / "out")
        assert described.interpolation == 0.01 and len(described.run.command.stamp) == len(t)
        assert "(interpolation_ms in run.toml)" in "\n".join(asked(described))
        held = pf.Run.read(tmp_path / "out")
        for what, one in (("path", run), ("held", held)):
            arm = structs.replace(config.arm, update_period=0.01 if what == "path" else 0.1)
            est = pf.fuse(one, structs.replace(config, arm=arm), rate=50)
            inside = est.time > 2.0
            error[what] = np.sqrt(np.mean((est["x"].position - path(est.time - late)[:, 0])[inside] ** 2))
        assert error["path"] < 0.3 * error["held"], error


def test_joints_have_the_names_that_are_beside_them(log: Path, tmp_path: Path) -> None:
    """As ``rostopic echo -p`` writes joint states: angles, stamped by their header, not when they were written."""
    for file, time, value in (("joint_command", T, U), ("joint_states", S, Z)):
        stamp = [START * 10**9 + round(1e9 * one) for one in time]
        write(
            log / f"{file}.csv",
            {
                "%time": [one + 30_000_000 for one in stamp],
                "field.header.stamp": stamp,
                **{f"field.name{n}": [name] * len(time) for n, name in enumerate(("pan", "lift", "wrist"))},
                **{f"field.position{n}": value[:, n] for n in range(3)},
                **{f"field.velocity{n}": np.gradient(value[:, n], 0.02) for n in range(3)},
            },
        )
    found = check_fuses(log, tmp_path / "out", ("pan", "lift", "wrist"))
    assert {part.clock.time.column for part in found.parts if part.clock} == {"field.header.stamp"}
    assert {one.unit for part in found.parts for one in part.signals} == {"rad"}


@pytest.mark.parametrize("commanded", ["joints", "tool"])
def test_joints_and_the_tool_in_space_need_the_robot(commanded: str, log: Path) -> None:
    """Of commands in one and measurements in the other it is said what makes both poses."""
    joints, tool = ("pan_rad", "lift_rad", "wrist_rad"), ("x_m", "y_m", "z_m")
    told, other = (joints, tool) if commanded == "joints" else (tool, joints)
    write(log / "commands.csv", {"t_s": T, **dict(zip(told, U.T, strict=True))})
    write(log / "encoders.csv", {"t_s": S, **dict(zip(told, Z.T, strict=True))})
    write(log / "seen.csv", {"t_s": S, **dict(zip(other, np.sin(9.0 * Z.T), strict=True))})
    roles = survey(log).roles
    assert roles is not None
    assert ["[robot] in run.toml" in why for stream, why in roles.left_out if stream.name == "seen"] == [True]


@pytest.mark.parametrize(("yes", "no", "key"), [(1, 0, "1"), (True, False, "true")])
def test_rows_that_a_sensor_calls_invalid_are_left_out(yes: Any, no: Any, key: str, tmp_path: Path) -> None:
    """Where it was lost it writes 0, which is a position; ``where`` chooses the others, and that is said."""
    log, lost = tmp_path / "log", np.arange(1000) % 5 == 0
    log.mkdir()
    write(log / "commands.csv", {"t_s": T, **xyz(U)})
    columns = xyz(np.where(lost[:, None], 0.0, Z))
    write(log / "camera.csv", {"t_s": S, **columns, "is_valid": [no if one else yes for one in lost]})
    found = check_fuses(log, tmp_path / "out")
    assert f"where = {{ is_valid = {key} }}" in (tmp_path / "out/run.toml").read_text()
    (camera,) = (part for part in found.parts if part.label == "camera.csv")
    assert "200 of 1000 rows are not is_valid: left out" in camera.notes


@pytest.mark.parametrize("unit", ["", "_m", "_mm", "_um"])
def test_units_without_a_name_are_those_in_which_both_move_alike(unit: str, log: Path, tmp_path: Path) -> None:
    """Commands in m by name: measurements without a unit that are 1000 times as large are in mm."""
    scale = {"": 1e3, "_m": 1.0, "_mm": 1e3, "_um": 1e6}[unit]
    write(log / "commands.csv", {"time_s": T, **xyz(U)})
    write(log / "camera.csv", {"time_s": S, **xyz(scale * Z, f"{{}}{unit}")})
    found = check_fuses(log, tmp_path / "out")
    assert any("No name says it" in one for one in asked(found)) is (unit == "")


def test_one_table_with_everything_needs_no_names(tmp_path: Path) -> None:
    log = tmp_path / "both"
    log.mkdir()
    write(log / "b.csv", {"t": T, **xyz(U)})
    write(log / "a.csv", {"t": T + 0.004, **xyz(Z)})
    found = check_fuses(log, tmp_path / "out")
    assert found.roles.command.part.label == "b.csv"
    assert found.roles.command.why == "others follow it"


@pytest.mark.parametrize("unit", ["_mm", ""])
def test_what_moves_half_as_far_follows_no_commands_that_only_run_ahead(unit: str, tmp_path: Path) -> None:
    """Two points of one body, in a unit that both say or that of one table: one that runs ahead is no command."""
    text = refusal(tmp_path, {"t": T, **xyz(U, f"tip_{{}}{unit}"), **xyz(0.6 * Z, f"wrist_{{}}{unit}")})
    assert "which numbers are the commands?" in text


@pytest.mark.parametrize(
    ("commanded", "measured"),
    [
        ("command.{}_mm", "camera.{}_mm"),
        ("{}_ref_mm", "{}_mm"),
        ("ctrl_{}_mm", "qpos_{}_mm"),
        ("ASPos.{}", "AIPos.{}"),
        ("act_{}", "obs_{}"),
        ("first_{}_mm", "second_{}_mm"),
        ("{}d_mm", "{}_mm"),
    ],
)
def test_a_single_table_is_taken_apart_by_the_names_of_its_columns(
    commanded: str, measured: str, tmp_path: Path
) -> None:
    """By words of roles, or else by those that tell them apart and what runs ahead; empty cells are rows of others."""
    blank = [""] * len(T)
    order = np.argsort([*T, *S])
    columns: dict[str, Any] = {"time_s": [*T, *S]}
    for n, axis in enumerate("xyz"):
        columns[commanded.format(axis)] = [*(1e3 * U[:, n]), *blank]
        columns[measured.format(axis)] = [*blank, *(1e3 * Z[:, n])]
    log = tmp_path / "log.csv"
    write(log, {key: [column[row] for row in order] for key, column in columns.items()})
    check_fuses(log, tmp_path / "out")


def test_the_state_of_a_controller_names_its_joints(tmp_path: Path) -> None:
    """As ros2_control writes it: what the controller sends on is no sensor, but the commands again."""
    noise = np.random.default_rng(1).normal(scale=5e-4, size=U.shape)
    told, seen = path(T), path(T - LAG) + noise
    rows = [
        {
            "header": {"stamp": {"sec": START + int(at), "nanosec": round(1e9 * (at % 1.0))}},
            "joint_names": ["pan", "slider", "wrist"],
            **{name: {"positions": list(one), "velocities": [1.0, at, 2.0]} for name, one in sources},
        }
        for at, *sources in (
            (at, ("reference", a), ("feedback", b), ("error", a - b), ("output", a))
            for at, a, b in zip(T.tolist(), told, seen, strict=True)
        )
    ]
    log = tmp_path / "state.jsonl"
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = check_fuses(log, tmp_path / "out", ("pan", "slider", "wrist"))
    assert [one.name for one in found.roles.sensors] == ["feedback"]
    assert [why for _, why in found.roles.left_out] == ["the same numbers as the commands, at the same time"]
    assert {one.axis: one.unit for part in found.parts for one in part.signals} == {
        "pan": "rad",
        "slider": "m",
        "wrist": "rad",
    }


@pytest.mark.parametrize("begins", [START, -7.3, 3 * 3600.0])
def test_a_clock_of_its_own_is_shifted_and_said(begins: float, log: Path, tmp_path: Path) -> None:
    """Motion capture counts from its own start, or in another time zone: whatever its file is called, it is found."""
    moving = slice(3, 1000)  # a capture that begins 60 ms later
    write(log / "commands.csv", {"time_s": T + begins, **xyz(U)})
    write(log / "take1.csv", {"time_s": S[moving], **xyz(Z[moving])})
    found = survey(log)
    (doubt,) = [one for one in asked(found) if "is the clock of take1" in one]
    side = "behind" if begins > 0 else "ahead of"
    assert f"{side} the commands'" in doubt
    run, _ = written(found, tmp_path / "out")
    assert abs(run.sensors["take1"].stamp[0] / 1e9 - begins - 0.06) < 0.061
    for axis in "xyz":
        assert found.relations["take1", axis].lag == pytest.approx(LAG, abs=0.065)  # less what nobody can tell


@pytest.mark.parametrize("late", [0.9, 4.9])
def test_a_lag_that_may_be_a_period_longer_is_asked(late: float, tmp_path: Path) -> None:
    """A motion that goes up and down each 4 s, not quite as far each time, seen on the commands' clock."""
    t = 0.04 * np.arange(1500)
    height = np.random.default_rng(8).uniform(0.8, 1.2, 30)

    def at(t: FloatArray) -> FloatArray:
        return 0.02 * np.interp(t, 4.0 * np.arange(30), height) * np.cos(0.25 * np.pi * np.maximum(t, 0.0)) ** 4

    found = surveyed(tmp_path, {"t_s": t, "chest_goal_m": at(t), "chest_state_m": at(t - late)})
    assert found.relations["state", "chest"].lag == pytest.approx(0.9, abs=0.05)
    asked = [one for one in questions(found, {}) if " s late? " in one]
    assert [one[:20] for one in asked] == (["is state 4.9 s late?"] if late > 4.0 else [])
    assert all("add shift_s = -4.8 to its time" in one for one in asked)  # 0.1 s of lag is left


def test_a_clock_that_nothing_tells_from_the_lag_is_said_to_be_a_guess(log: Path) -> None:
    """A sensor that is recorded for the middle of a run, 5.5 s ahead: its shift is found, its lag is called a guess."""
    t, u, s, z = recorded(2000)
    part = slice(300, 1500)
    write(log / "commands.csv", {"time_s": t, **xyz(u)})
    write(log / "camera.csv", {"time_s": s[part] + 5.5, **xyz(z[part])})
    (doubt,) = [one for one in asked(survey(log)) if "is the clock of camera" in one]
    ahead = float(doubt.partition("camera ")[2].split()[0])
    assert ahead == pytest.approx(5.5, abs=0.02)  # a bin
    assert "the lag is a guess" in doubt


def test_two_cameras_of_one_table_are_two_sensors(tmp_path: Path) -> None:
    z = path(T - LAG) + np.random.default_rng(4).normal(0.0, 1e-4, (2, *U.shape))
    columns = {f"camera{n}_{axis}_m": z[n - 1, :, place] for n in (1, 2) for place, axis in enumerate("xy")}
    found = surveyed(tmp_path, {"time_s": T, **columns, "goal_x_m": U[:, 0], "goal_y_m": U[:, 1]}).roles
    assert {one.name: [*one.axes] for one in found.sensors} == {"camera1": ["x", "y"], "camera2": ["x", "y"]}


@pytest.mark.parametrize("columns", ["x_m,y_m,z_m", "left_x_m,right_x_m,right_y_m", "pan_rad,tilt_rad"])
def test_what_moves_at_once_is_no_command_and_its_sensor(columns: str, tmp_path: Path) -> None:
    """Axes of one sensor, two sensors, two joints: no word tells commands from measurements, and nothing runs ahead."""
    moves = path(T)[:, 0]
    rng = np.random.default_rng(3)
    turned = {"pan_rad": moves, "tilt_rad": np.roll(moves, 20)}
    values = {name: turned.get(name, moves) + rng.normal(0.0, 1e-4, len(T)) for name in columns.split(",")}
    assert "which numbers are the commands" in refusal(tmp_path, {"time_s": T, **values})


def test_axes_of_other_names_are_known_by_how_they_move(log: Path, tmp_path: Path) -> None:
    """A camera turned by 90° about z, and a range finder that looks along −y from a metre away."""
    write(log / "goal.csv", {"time_s": T, **xyz(U)})
    write(log / "camera.csv", {"time_s": S, "u_mm": 1e3 * Z[:, 2], "v_mm": 1e3 * Z[:, 0]})
    write(log / "range.csv", {"time_s": S, "range_mm": 1e3 * (1.0 - Z[:, 1])})
    found = survey(log)
    run, config = written(found, tmp_path / "out")
    assert {name: set(source.values) for name, source in run.sensors.items()} == {"camera": {"x", "z"}, "range": {"y"}}
    assert config.sensors["range"].scale == -1.0
    assert config.sensors["range"].bias_sd_of("y") > 1.0
    est = pf.fuse(run, config)
    assert np.sqrt(np.mean((est["y"].position[50:] - path(est.time - est.time[0] - LAG)[50:, 1]) ** 2)) < 1e-3


def lerobot(folder: Path) -> None:
    """A data set of three episodes at 50 Hz, joints in degrees."""
    t, u, _, _ = recorded(600)
    state = path(t - LAG) + np.random.default_rng(2).normal(scale=5e-4, size=u.shape)
    kind = pa.list_(pa.float32(), 3)
    table = pa.table(
        {
            "action": pa.array([(200.0 * row).tolist() for row in np.vstack([u, -u, u])], kind),
            "observation.state": pa.array([(200.0 * row).tolist() for row in np.vstack([state, -state, state])], kind),
            "timestamp": pa.array([*t, *t, *t], pa.float32()),
            "frame_index": [*range(600)] * 3,
            "episode_index": [index for index in range(3) for _ in t],
        }
    )
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    papq.write_table(table, folder / "data" / "chunk-000" / "file-000.parquet")
    motors = {"names": {"motors": ["shoulder_pan.pos", "elbow_flex.pos", "gripper.pos"]}}
    info = {"features": {"action": motors, "observation.state": motors}}
    (folder / "meta" / "info.json").write_text(json.dumps(info))


def test_a_data_set_of_lerobot_is_read_by_its_layout(tmp_path: Path) -> None:
    """Action is the command, observation.state the sensor, joints have their names, one episode is the run."""
    lerobot(tmp_path / "set")
    found = survey(tmp_path / "set")
    run, config = written(found, tmp_path / "out")
    assert run.axes == ("shoulder_pan", "elbow_flex", "gripper")
    assert run.kinds == dict.fromkeys(run.axes, "angle")
    assert len(run.command.stamp) == 600
    assert tuple(run.sensors) == ("observation_state",)
    tree = tomllib.loads((tmp_path / "out" / "run.toml").read_text())
    assert tree["command"]["where"] == {"episode_index": 0}
    est = pf.fuse(run, config)
    truth = np.radians(200.0 * path(est.time - est.time[0] - LAG))
    for number, axis in enumerate(run.axes):
        assert np.sqrt(np.mean((est[axis].position[50:] - truth[50:, number]) ** 2)) < np.radians(0.1)


@pytest.mark.parametrize("kind", ["mcap", "json", "rrd"])
def test_recordings_of_all_kinds(kind: str, tmp_path: Path) -> None:
    """The topic called command is that, cameras follow it, poses are in metres by their type."""
    log = tmp_path / KINDS[kind].name
    KINDS[kind].write(log, bag_files.motion(200))
    run, config = written(survey(log), tmp_path / "out")
    assert {"camera", "level"} <= set(run.sensors)
    if KINDS[kind].manifest == bag_files.ROS:
        assert run.axes == ("x", "y", "z")
        assert set(run.sensors["camera"].values) == {"x", "y", "z"}
        # a joint called slide is in metres, and moves as z does; a number without any name is in mm as it moves like x
        assert set(run.sensors["joints"].values) == {"z"}
        assert set(run.sensors["level"].values) == {"x"}
        tree = tomllib.loads((tmp_path / "out" / "run.toml").read_text())
        assert tree["sensors"]["level"]["x"] == {"column": "data", "unit": "mm"}
        assert tree["sensors"]["camera"]["time"] == "header.stamp"
        assert config.sensors["camera"].sd_of("x") == pytest.approx(1e-3, rel=0.2)
    counts = pf.fuse(run, config).measurements.counts()
    assert counts["fused"] > 0.95 * sum(counts.values())


def test_joints_and_a_pose_that_no_command_moves(tmp_path: Path) -> None:
    """Joints are angles in rad; the pose is there for the user, commented out, with the reason."""
    log = tmp_path / "drive.mcap"
    joints(log)
    found = survey(log)
    run, config = written(found, tmp_path / "out")
    assert run.axes == ("shoulder", "elbow")
    assert run.kinds == {"shoulder": "angle", "elbow": "angle"}
    assert tuple(run.sensors) == ("joint_states",)
    text = (tmp_path / "out" / "run.toml").read_text()
    assert "# Not used: none of the commands that were taken is a length, as x, y, z are" in text
    assert '# x = { column = "pose.position.x", unit = "m" }' in text
    assert pf.fuse(run, config).measurements.counts() == {"fused": 800}


def joints(log: Path, first: str = "shoulder", second: str = "elbow", alike: bool = False) -> None:
    """Commands and states of two joints, whose order changes, and the pose of a tool, which may move as these do."""
    from mcap_ros2.writer import Writer

    t = 0.02 * np.arange(400)
    stores = {"/joint_commands": "sensor_msgs/msg/JointState", "/joint_states": "sensor_msgs/msg/JointState"}
    with log.open("wb") as file:
        writer = Writer(file)
        kinds = {**stores, "/tool/pose": "geometry_msgs/msg/PoseStamped"}
        schemas = {topic: writer.register_msgdef(kind, bag_files.definition_of(kind)) for topic, kind in kinds.items()}
        draw = np.random.default_rng(3)
        for k, (told, there) in enumerate(zip(path(t), path(t - LAG), strict=True)):
            ns = START * 10**9 + 20_000_000 * k
            header = {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "base"}
            names_, places = ([second, first], [1, 0]) if k % 2 else ([first, second], [0, 1])
            seen = there + draw.normal(scale=2e-4, size=3)
            for topic, value in (("/joint_commands", told), ("/joint_states", seen)):
                position = [float(value[place]) for place in places]
                message = {"header": header, "name": names_, "position": position, "velocity": [], "effort": []}
                writer.write_message(topic, schemas[topic], message, log_time=ns, publish_time=ns)
            point = dict(zip("xyz", (there if alike else np.cos(3.0 * there)).tolist(), strict=True))
            pose = {"position": point, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
            message = {"header": header, "pose": pose}
            writer.write_message("/tool/pose", schemas["/tool/pose"], message, log_time=ns, publish_time=ns)
        writer.finish()


HOSTILE = [
    'x"]\n[sensors.evil]\nfile = "/etc/passwd',
    "[bold red]x[/bold red]",
    "x\x1b[31m",
    'é x\'\\u0000"""',
    "[[x",
    "x.y[0].z",
    "__proto__",
    "# x",
]


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_stay_names(name: str, tmp_path: Path) -> None:
    """Columns and files of any name give valid files that say the same, whatever a name tries to be."""
    t, u, s, z = recorded(300)
    log = tmp_path / "log [red]"
    log.mkdir()
    write(log / "goal.csv", {"time_s": t, name: u[:, 0], "x_m": u[:, 1]})
    write(log / "camera [x] \x1b.csv", {"time_s": s, name: z[:, 0], "x_m": z[:, 1]})
    run, config = written(survey(log), tmp_path / "out")
    for file in ("run.toml", "arm.toml", "fusion.toml"):
        text = (tmp_path / "out" / file).read_text()
        assert all(letter.isprintable() or letter == "\n" for letter in text)
    tree = tomllib.loads((tmp_path / "out" / "run.toml").read_text())
    assert len(tree["sensors"]) == 1
    assert len(run.axes) == 2
    columns = [
        one["column"] if isinstance(one, dict) else one for key, one in tree["command"].items() if key in run.axes
    ]
    assert columns == [name, "x_m"]
    pf.fuse(run, config)


@pytest.mark.parametrize(
    ("axis", "turns"), [("q", True), ("q_0", True), ("a1", True), ("elbow", True), ("x", False), ("a", False)]
)
def test_joints_are_known_by_their_names(axis: str, turns: bool) -> None:
    """The generalized coordinate q alone, as logs of one joint have it, is one, too."""
    assert names.is_turning(axis) is turns


@pytest.mark.parametrize(
    ("column", "role"),
    [
        ("set_point_deg", "command"),
        ("Sollwert_1", "command"),
        ("process_value", "sensor"),
        ("Istwert_1", "sensor"),
        ("axis1_pv", "sensor"),
        *((f"{word}_x_mm", "command") for word in ("goal", "set", "ctrl", "input", "goal_position", "cmd")),
        *((f"{word}_x_mm", "sensor") for word in ("actual", "estimate", "present_position", "fbk")),
        ("value", None),
    ],
)
def test_roles_of_columns_by_name(column: str, role: str | None) -> None:
    """As controllers of processes and of machines call them, in German, too."""
    assert names.column_role(column) == role


@pytest.mark.parametrize(
    ("column", "axis", "unit"),
    [
        ("x_mm", "x", "mm"),
        ("command.shoulder_deg", "shoulder", "deg"),
        ("x_target_m", "x", "m"),
        ("pose.pose.position.x", "x", ""),
        ("position[elbow_joint]", "elbow_joint", ""),
        ("observation.state[2]", "joint2", ""),
        ("translation[1]", "y", ""),
        ("Tool Position X [mm]", "x", "mm"),
        ("goalPosition1 (rad)", "position1", "rad"),
        ("RSol.X", "r_x", ""),
        ("QTarget2_rad", "q_2", "rad"),
        ("camera2_x_mm", "x", "mm"),
        ("A1_Soll [°]", "a1", "deg"),
        ("m3", "m3", ""),
        ("range_mm", "position", "mm"),
        ("tcp_y_cm", "y", "cm"),
        ("ziel_x [cm]", "ziel_x", "cm"),
        ("x [µm]", "x", "um"),
        ("x(in)", "x", "inch"),
        ("carriage_inches", "carriage", "inch"),
        ("lift_in", "lift_in", ""),
        ("command.arm_deg", "arm", "deg"),
        ("robot.position_mm", "position", "mm"),
        ("position[肩]", "position", ""),
        ("position[start]", "start_axis", ""),
    ],
)
def test_axes_and_units_by_name(column: str, axis: str, unit: str) -> None:
    assert (names.axis_of(column, []), names.unit_of(column)) == (axis, unit)


@pytest.mark.parametrize(
    "column",
    [
        *("speed_m_s", "velocity[0]", "orientation.x", "frame", "quality", "twist.linear.x", "actual_qd_0"),
        *("current_1", "qx", "qvel_0", "field.velocity0", "vx", "setpoint.vz", "ay", "az", "motor_amps", "thrust_2"),
        *("moment[1]", "pwm.3", "delta_x_mm", "sd_x_mm", "rel_yaw_deg", "T [°C]", "success_rate", "delta_q_reset[0]"),
        *("Motor/MotorFbTor#0", "MotorCmdKp#0", "kd_2", "actual_cur", "cur_3", "current_joint2"),
        *("Z2_CurrentFeedback", "measured_current_y", "target_tensions[2]", "cable_tension_4"),
        *("u_px", "u_ref_px", "target_x_pixels", "x [px]", "K_Nm_per_rad", "spring [N/mm]", "encoder counts per deg"),
    ],
)
def test_what_is_no_position_is_left_out(column: str) -> None:
    assert names.no_position(column)


@pytest.mark.parametrize(
    "column",
    [
        *("q_d_0", "qd_0", "current_position.x", "current_x_mm", "ax1", "v_x"),
        *("az_deg", "az [deg]", "ay_cmd_rad", "load_x_mm", "index_mcp_deg", "vx_mm.1"),
        *("px", "cmd_px", "current_x", "cur_y", "cur_pos_1", "currentAngle", "current_yaw", "curr_pos2", "CurrAngle"),
    ],
)
def test_what_may_be_a_position_is_not(column: str) -> None:
    assert not names.no_position(column)


@pytest.mark.parametrize(("column", "is_time"), [("t_deg", False), ("t", True), ("t_s", True), ("stamp [mm]", False)])
def test_a_unit_of_positions_is_of_no_clock(column: str, is_time: bool) -> None:
    """A robot's axis may be called T."""
    assert names.is_time(column) is is_time


def of_roles(found: Survey) -> list[list[str]]:
    streams = (found.roles.command, *found.roles.sensors)
    return [[one.column for (one,) in stream.axes.values()] for stream in streams]


@pytest.mark.parametrize(
    ("desired", "measured"),
    [
        ("j_d[{}]", "j[{}]"),
        ("q_d{}", "q{}"),
        ("theta_d_{}", "theta_{}"),
        ("q_d{}_rad", "q{}_rad"),
        ("q_d[{}]", "s.q[{}]"),
        ("q_d_{}", "q_{}"),
    ],
)
def test_desired_values_are_the_commands_of_those_beside_them(desired: str, measured: str, tmp_path: Path) -> None:
    """Elements of lists and numbered names; rates run ahead, too, but not as alike, and a constant is between them."""
    z = path(T - LAG) + np.random.default_rng(2).normal(0.0, 1e-4, U.shape)
    columns = {"t_s": T, "success_rate": np.ones(len(T)), **{f"w_{n}": np.gradient(z[:, n], T) for n in range(3)}}
    columns |= {measured.format(n): z[:, n] for n in range(3)} | {f"dq[{n}]": np.gradient(U[:, n], T) for n in range(3)}
    found = surveyed(tmp_path, columns | {desired.format(n): U[:, n] for n in range(3)})
    assert of_roles(found) == [[name.format(n) for n in range(3)] for name in (desired, measured)]
    assert [one.correlation > 0.99 for one in found.relations.values()] == [True] * 3
    assert set(found.run.kinds.values()) == {"angle"}


def test_of_two_sources_of_desired_values_the_earlier_one_is_the_commands(tmp_path: Path) -> None:
    """A header that is there twice: the second one is sent a row before the first one acts."""
    z = path(T - LAG) + np.random.default_rng(2).normal(0.0, 1e-4, U.shape)
    header = ["t_s", *(f"{name}[{n}]" for name in ("state.p", "p_d", "p_d") for n in range(3))]
    rows = np.column_stack([T, z, path(T - 0.01), U])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=",".join(header), comments="", fmt="%.9f")
    found = survey(tmp_path / "log.csv")
    assert of_roles(found) == [[f"p_d[{n}].1" for n in range(3)], [f"state.p[{n}]" for n in range(3)]]
    assert {axis for _, axis in found.relations} == {"joint0", "joint1", "joint2"}
    assert set(found.run.kinds.values()) == {"angle"}


def test_torques_and_attitudes_that_move_alike_are_no_sensors(log: Path) -> None:
    """A torque follows one axis well and the others badly; four columns of length 1 are a quaternion."""
    turned = np.column_stack([0.1 * U, np.sqrt(1.0 - (0.01 * U**2).sum(axis=1))])
    write(log / "JQ_com.csv", {"t_s": T, **{f"p{n}": U[:, n] for n in range(3)}})
    write(log / "JQ_state.csv", {"t_s": S, **{f"p{n}": Z[:, n] for n in range(3)}})
    write(log / "MT.csv", {"t_s": S, **{f"p{n}": [-9.0, 30.0, 2.0][n] * (Z[:, n] - U[:, 0]) for n in range(3)}})
    write(log / "attitude.csv", {"t_s": T, **{f"o[{n}]": turned[:, n] for n in range(4)}})
    found = survey(log)
    assert of_roles(found) == [["p0", "p1", "p2"]] * 2
    assert found.roles is not None and [one.name for one in found.roles.sensors] == ["JQ_state"]
    assert {why for part in found.parts for why in part.left_out.values()} == {"of a quaternion"}


@pytest.mark.parametrize("called", ["column {}", "Var{}"])
def test_columns_without_names_are_told_apart_by_which_follows_which(called: str, tmp_path: Path) -> None:
    """As far and later: commands, what measures them in another order, and what is none of these, in one table.

    Without a header, and under the names that MATLAB gives where there are none.
    """
    torque = 40.0 * np.gradient(ZT[:, 0])
    columns = [T, ZT[:, 1], U[:, 0], torque, U[:, 1], ZT[:, 2], U[:, 2], ZT[:, 0]]
    header = ",".join(called.format(number) for number in range(1, 9)) if called.startswith("Var") else ""
    np.savetxt(tmp_path / "log.txt", np.column_stack(columns), "%.6f", delimiter=",", header=header, comments="")
    found = survey(tmp_path / "log.txt")
    told, (seen,) = found.roles.command, found.roles.sensors
    pairs = {told.axes[axis][0].column: seen.axes[axis][0].column for axis in told.axes}
    assert pairs == {called.format(one): called.format(other) for one, other in ((3, 8), (5, 2), (7, 6))}
    np.savetxt(tmp_path / "log.txt", np.column_stack([T, U, 1.5 * ZT]), "%.6f")
    assert "which numbers are the commands" in one_line(RunError, lambda: survey(tmp_path / "log.txt"))


def test_of_columns_without_names_those_that_add_up_to_others_are_velocities(tmp_path: Path) -> None:
    """Of commands and of what measures them; on a circle at 1 rad/s no coordinate is taken for the other's velocity."""
    smooth = path(T - LAG)
    speeds = [np.gradient(smooth, 0.02, axis=0) + np.random.default_rng(2).normal(scale=5e-3, size=U.shape)]
    speeds += [np.gradient(U, 0.02, axis=0)]
    np.savetxt(tmp_path / "log.txt", np.column_stack([T, *speeds, ZT, U]), "%.6f")
    found = survey(tmp_path / "log.txt")
    told, (seen,) = found.roles.command, found.roles.sensors
    pairs = {told.axes[axis][0].column: seen.axes[axis][0].column for axis in told.axes}
    assert pairs == {"column 11": "column 8", "column 12": "column 9", "column 13": "column 10"}
    assert found.parts[0].left_out["column 2"].startswith("velocity: it adds up to column 8")
    assert set(found.parts[0].left_out) == {f"column {number}" for number in range(2, 8)}
    np.savetxt(tmp_path / "log.txt", np.column_stack([T, np.cos(T), np.sin(T)]), "%.6f")
    assert parts_of(tmp_path / "log.txt")[0].left_out == {}


def test_what_adds_up_to_a_position_is_its_velocity_by_whatever_name(tmp_path: Path) -> None:
    """And what adds up to that an acceleration: none is an axis. Senders may be called as ``K2S`` and ``S2K``."""
    columns = {"t_s": (t := 0.02 * np.arange(1000))}
    for who, late in (("K2S", 0.0), ("S2K", LAG)):
        ram = path(3.0 * (t - late)).sum(axis=1)
        columns[f"{who} ram L"] = ram + np.random.default_rng(4).normal(scale=1e-5, size=len(t))
        columns[f"{who} ram W"] = np.gradient(ram, t)
        columns[f"{who} ram B"] = np.gradient(columns[f"{who} ram W"], t)
    found = surveyed(tmp_path, columns)
    assert of_roles(found) == [["K2S ram L"], ["S2K ram L"]]
    assert set(found.parts[0].left_out.values()) == {
        f"velocity: it adds up to {who} ram {what} by the clock" for who in ("K2S", "S2K") for what in "LW"
    }


def test_of_columns_without_names_that_move_at_once_the_one_that_stands_is_the_command(tmp_path: Path) -> None:
    """What follows within a row has no lag that tells it; its noise does, where the commands rest."""
    t = 0.01 * np.arange(900)
    told = 0.4 * np.sin(np.minimum(t, 6.0)) ** 2
    seen = told + np.random.default_rng(3).normal(scale=2e-4, size=t.shape)
    np.savetxt(tmp_path / "log.txt", np.column_stack([t, seen, told]), "%.6f")
    found = survey(tmp_path / "log.txt")
    assert [one.column for (one,) in found.roles.command.axes.values()] == ["column 3"]
    assert [one.column for (one,) in found.roles.sensors[0].axes.values()] == ["column 2"]


def test_what_follows_as_positions_do_is_none_where_velocities_tell_which_are(tmp_path: Path) -> None:
    """A log of positions, their velocities, and motor currents behind the wanted ones: nothing there was commanded."""
    wanted, drawn = (9.0 * path(0.8 * T - late)[:, ::-1] - 3.0 for late in (0.0, 0.03))
    np.savetxt(tmp_path / "log.txt", np.column_stack([T, U, np.gradient(U, 0.02, axis=0), drawn, wanted]), "%.6f")
    assert "which numbers are the commands?" in one_line(RunError, lambda: survey(tmp_path / "log.txt"))
    np.savetxt(tmp_path / "log.txt", np.column_stack([T, drawn, wanted]), "%.6f")  # where nothing says so, they are
    assert set(survey(tmp_path / "log.txt").run.sensors) == {"measured"}


def test_columns_without_names_of_another_joint_that_moves_alike_are_no_second_sensor(tmp_path: Path) -> None:
    """It follows the same commands, but not as far; an encoder that goes as far is one."""
    coupled, encoder = 1.3 - 0.6 * ZT[:, 1], path(T - 0.15)[:, 1]
    np.savetxt(tmp_path / "log.txt", np.column_stack([T, U[:, 1], ZT[:, 1], 2.6 - coupled, encoder]), "%.6f")
    found = survey(tmp_path / "log.txt")
    assert of_roles(found) == [["column 2"], ["column 3"], ["column 5"]]
    (left_out,) = ((list(stream.axes), why) for stream, why in found.roles.left_out)
    assert left_out == (["column_4"], "they follow nothing as far, at the same level")


def test_of_two_columns_without_names_one_may_follow_steps_slowly(tmp_path: Path) -> None:
    """A square wave has two levels and no middle; an axis that swings behind it is as far, and never quite alike."""
    t = 0.005 * np.arange(3000)
    told = np.where(t % 4.0 < 2.1, 0.7, -0.7)
    seen = np.zeros(len(t))
    for row in range(1, len(t)):
        seen[row] = seen[row - 1] + (told[row - 1] - seen[row - 1]) * 0.005 / 0.11
    np.savetxt(tmp_path / "steps.txt", np.column_stack([t, seen, told]), "%.6f")
    found = survey(tmp_path / "steps.txt")
    assert of_roles(found) == [["column 3"], ["column 2"]]
    assert next(iter(found.relations.values())).correlation < 0.98


def test_bodies_that_a_tracker_sees_in_turns_command_each_other_nothing(tmp_path: Path) -> None:
    """One tool with two bodies, whose positions are a little later on one axis as it turns; their quaternions."""
    t, u, _, _ = recorded(600)
    rotation = Rotation.from_rotvec(np.sin(0.9 * t)[:, None] * np.array([0.1, 0.3, 0.2]))
    other = u + np.array([0.0, 0.1, 0.02]) + 0.002 * np.gradient(u, t, axis=0) * np.array([-9.0, 0.0, 0.5])
    both = [[("disc", u), ("rod", other)][row % 2] for row in range(2 * len(t))]
    columns: dict[str, Any] = {"t_s": np.repeat(t, 2), "body": [name for name, _ in both]}
    for axis in range(3):
        columns[f"pos{axis}"] = [at[row // 2, axis] for row, (_, at) in enumerate(both)]
    columns |= {f"rot{part}": np.repeat(rotation.as_quat()[:, part], 2) for part in range(4)}
    said = refusal(tmp_path, columns)
    assert "which numbers are the commands?" in said and "rot" not in said


def test_an_axis_that_moves_before_its_commands_says_nothing_of_another_clock_in_the_same_rows(log: Path) -> None:
    """A weld: y follows along the seam; the torch is drawn back by another program, and the commands catch up."""
    t = 0.012 * np.arange(2424)
    seam = np.minimum(t, 25.8) * 3.4
    back, lift = (np.clip((t - at) / took, 0.0, 1.0) * 66.0 for at, took in ((29.04, 0.02), (28.6, 0.4)))
    seen = np.round(np.minimum(np.maximum(t - 0.06, 0.0), 25.8) * 3.4, 1)
    told = {"y_setpoint_mm": seam, "z_setpoint_mm": 900.0 + back}
    write(log / "weld.csv", {"t_s": t, **told, "y_actual_mm": seen, "z_actual_mm": np.round(900.0 + lift, 1)})
    found = survey(log / "weld.csv")
    assert found.relations["actual", "y"].lag == pytest.approx(0.06, abs=0.012)  # a row
    assert not any("s late?" in question for question in asked(found))


def test_of_a_stroke_at_constant_speed_no_other_clock_is_made(log: Path) -> None:
    """It stops shortly before the end: at no lag of an arm a trend leaves much of it, at others the stop is not seen.

    Where the last shift at which it is seen does best, none does.
    """
    t = 0.015 * np.arange(1800)
    s = t[7::9]
    noise = np.random.default_rng(6).normal(scale=0.08, size=s.shape)
    stroke = 210.0 - 5.2 * np.minimum(t, 24.4)
    write(log / "target.csv", {"t_s": t, "feed_mm": stroke})
    write(log / "scale.csv", {"t_s": s, "feed_mm": np.interp(s - 0.09, t, stroke) + noise})
    found = survey(log)
    (relation,) = found.relations.values()
    assert relation.lag == pytest.approx(0.09, abs=0.01)
    assert not any("clock" in question for question in asked(found))


@pytest.mark.parametrize("first", [3, 3.0])
def test_what_counts_poses_is_no_clock_however_it_is_written(first: float, tmp_path: Path) -> None:
    """Poses at rest, numbered, of which some were left out: there is no time in it, as the refusal says."""
    count = first + np.delete(np.arange(1020), np.arange(200, 220))
    said = refusal(tmp_path, {"pose_index": count, "goal_q_rad": U[:, 0], "measured_q_rad": ZT[:, 0]})
    assert "no clock for its 1000 rows" in said and "--rate HZ" in said


def test_columns_without_names_are_called_as_nothing(log: Path) -> None:
    """The second column of torques is not that of the commands, nor is a clock in a file of its own a joint."""
    t, u, s, z = recorded()
    u, z = u + 0.3 * t[:, None], z + 0.3 * s[:, None]  # which a clock is alike
    torques = np.column_stack([0.05 * z[:, 0], -np.roll(z[:, 1], -40), np.cos(s), np.sin(3.0 * s)])
    for name, time, columns in (("JQ_com", t, u), ("JQ_state", s, z), ("JT", s, torques)):
        np.savetxt(log / f"{name}.txt", np.column_stack([time, columns]), "%.6f")
    np.savetxt(log / "ticks.txt", np.column_stack([s, 3.0 + 0.5 * s]), "%.6f")
    found = survey(log)
    assert found.roles is not None and [one.name for one in found.roles.sensors] == ["JQ_state"]
    assert not any("ticks" in one for one in asked(found))


def test_what_columns_without_names_are_is_in_the_name_of_their_file(tmp_path: Path) -> None:
    """A controller that writes a file for each quantity: neither speeds nor forces are commands, and joints turn."""
    speeds = np.gradient(U, 0.02, axis=0)
    files = {"wantedJointAngles": U, "jointAngles": ZT, "wantedJointSpeeds": speeds, "force": 9.0 * ZT}
    for name, values in files.items():
        np.savetxt(tmp_path / f"{name}.csv", values, "%.6f", delimiter=",")
    found = survey(tmp_path, rate=50.0)
    assert found.roles is not None and [one.name for one in found.roles.sensors] == ["jointAngles"]
    assert [part.stem for part in found.parts if part.signals] == ["jointAngles", "wantedJointAngles"]
    assert found.run.kinds == dict.fromkeys(("joint_1", "joint_2", "joint_3"), "angle")


@pytest.mark.parametrize("nested", [[["hip", "Knee", "lArmYaw"]], {"axes": {"hip": 0, "Knee": 1, "lArmYaw": 2}}])
def test_names_of_lerobot_are_found_where_converters_write_them(nested: Any, tmp_path: Path) -> None:
    """A list in a list, or a table of places; in radians, as they are joints."""
    lerobot(tmp_path / "set")
    info = {"features": {"action": {"names": nested}, "observation.state": {"names": nested}}}
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps(info))
    run = survey(tmp_path / "set").run
    assert run.kinds == dict.fromkeys(("hip", "Knee", "lArmYaw"), "angle")


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({}, "no log in it that can be read"),
        ({"a.csv": "x_mm,y_mm\n" + "1,2\n3,4\n" * 20}, "no columns of positions with a clock"),
        (
            {"a.csv": "t_s,command.x_mm\n" + "".join(f"{k},5\n" for k in range(40))},
            "no columns of positions with a clock beside them, but command.x_mm (always 5); say in run.toml",
        ),
        ({"a.csv": ""}, "the file is empty"),
        ({"a.parquet": "PAR1"}, "not a table that can be read"),
        ({"a.mcap": "no"}, "the recording is empty; the recording was cut off"),
        ({"goal.csv": "t_s,x_mm\n" + "".join(f"{n},{n % 7}\n" for n in range(50))}, "nothing that measures where they"),
    ],
)
def test_what_is_no_log_is_refused_in_a_line(files: dict[str, str], said: str, tmp_path: Path) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert said in one_line(RunError, lambda: survey(tmp_path))


def nested_table(file: Path) -> bytes:
    """A command and a camera in nested columns of a Parquet file, with the bytes of the file."""
    t, u, _, z = recorded(300)
    stamp = [{"stamp": {"sec": int(one), "nanosec": round(one % 1.0 * 1e9)}} for one in t]
    columns = {"header": stamp, "goal": [{"pos": one} for one in u.tolist()], "camera": z[:, 0]}
    papq.write_table(pa.table(columns), file)
    return file.read_bytes()


def test_a_column_whose_name_is_damaged_is_a_line(tmp_path: Path) -> None:
    """Pyarrow gives a table without a word then, or an error of Python's own."""
    file = tmp_path / "log.parquet"
    file.write_bytes(nested_table(file).replace(b"goal", b"g\x89al"))
    assert "not a table that can be read" in one_line(RunError, lambda: survey(file))


@pytest.mark.long
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=300, suppress_health_check=list(HealthCheck))
def test_a_damaged_table_is_surveyed_or_refused_in_a_line(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Bytes of a file with nested columns replaced, its end cut off: never a traceback."""
    folder = tmp_path_factory.getbasetemp() / "damaged"
    folder.mkdir(exist_ok=True)
    file, draw = folder / "log.parquet", np.random.default_rng(seed)
    content = bytearray(nested_table(file))
    for place in draw.integers(0, len(content), draw.choice([1, 5, 30])):
        content[place] = draw.integers(256)
    file.write_bytes(content[: len(content) if seed % 3 else draw.integers(len(content))])
    try:
        found = survey(file)
        drafts(found, *guess(found), folder / "out")
    except pf.PumafuseError as error:
        assert len(str(error).splitlines()) == 1


def test_commands_that_never_move_are_named(tmp_path: Path) -> None:
    text = refusal(tmp_path, {"t_s": T, "arm": ZT[:, 0], "GoalTicks": np.full(len(T), 42)})
    assert "What is called so never moves: GoalTicks, always 42, and none runs ahead" in text
    assert "None is called" not in text
    write(tmp_path / "log.csv", {"t_s": T, "swing": ZT[:, 0]})
    write(tmp_path / "desired.csv", {"t_s": T, "swing": np.zeros(len(T))})
    assert "What is called so never moves: swing, always 0" in one_line(RunError, lambda: survey(tmp_path))


def test_texts_of_commands_that_never_move_are_named(log: Path) -> None:
    np.savetxt(log / "Left_Des_Z.txt", np.full((len(ZT), 3), 0.07))
    np.savetxt(log / "Left_Foot_Z.txt", ZT)
    text = one_line(RunError, lambda: survey(log, 100.0))
    assert "What is called so never moves: column 1, always 0.07" in text


def test_texts_without_a_clock_are_named_and_read_at_a_rate(log: Path) -> None:
    """Alone in a folder; beside a table they may be anything."""
    for name, at in (("planned", U), ("measured", ZT)):
        np.savetxt(log / f"{name}.txt", at, "%.6f")
    said = one_line(RunError, lambda: survey(log))
    assert "measured.txt (no clock for its 1000 rows), planned.txt (no clock for its 1000 rows)" in said
    assert survey(log, 50.0).relations["measured", "column_1"].lag == pytest.approx(LAG, abs=3e-3)
    write(log / "camera.csv", {"t_s": T, "x_mm": 1e3 * ZT[:, 0]})
    assert [part.label for part in parts_of(log)] == ["camera.csv"]


def test_what_has_no_clock_is_named_where_nothing_tells_the_commands(tmp_path: Path) -> None:
    """Arrays of a loop that was stopped are shorter than its stamps; a rate makes up for that."""
    t = 0.02 * np.arange(600)
    np.savez(tmp_path / "log.npz", time=t, plan=path(t), seat=path(t - LAG)[:570])
    text = one_line(RunError, lambda: survey(tmp_path / "log.npz"))
    assert "joint0, joint1, joint2; seat (no clock for its 570 rows)); if rows come" in text
    assert "at a constant rate, give it to init as --rate HZ; or say it in run.toml" in text


@pytest.mark.parametrize("has_positions", [True, False])
def test_velocities_are_to_be_integrated_only_where_no_positions_are_commanded(
    has_positions: bool, tmp_path: Path
) -> None:
    columns = {"lathe_vel_demand": np.gradient(U[:, 0]), "lathe_pos_encoder": ZT[:, 0]}
    text = refusal(tmp_path, columns | ({"lathe_pos_demand": U[:, 0]} if has_positions else {}))
    assert ("integrate them" in text) is not has_positions
    assert "give it to init as --rate HZ" in text


@pytest.mark.parametrize("kind", ["npz", "csv", "csv of nan"])
def test_columns_without_a_number_beside_commands_are_named(kind: str, tmp_path: Path) -> None:
    none = np.full(len(T), np.nan)
    log = tmp_path / f"log.{kind[:3]}"
    columns = {"t_s": T, "boom_goal_m": U[:, 0], "boom_seen_m": none if kind != "csv" else [""] * len(T)}
    if kind == "npz":
        np.savez(log, **columns)
    else:
        write(log, columns)
    assert "lead: boom_seen_m (no number)" in one_line(RunError, lambda: survey(log))


def test_an_axis_that_does_not_follow_is_left_out_and_the_others_are_fused(log: Path, tmp_path: Path) -> None:
    """Its commands, too: where nothing measures them no lag is known, and none is made up."""
    own = np.random.default_rng(6).normal(size=len(S)).cumsum()
    write(log / "goal.csv", {"t_s": T, "a_mm": 1e3 * U[:, 0], "b_mm": 1e3 * U[:, 1], "c_mm": 1e3 * U[:, 2]})
    write(log / "encoder.csv", {"t_s": S, "a_mm": 1e3 * Z[:, 0], "b_mm": own})
    write(log / "laser.csv", {"t_s": S, "q_mm": np.roll(own, 300)})
    found = survey(log)
    run, config = written(found, tmp_path / "out")
    assert run.axes == ("a",) == tuple(config.arm.axes)
    said = "\n".join(asked(found))
    assert "encoder is not used on b: it does not follow the commands (correlation" in said
    assert "goal is not used on b, c: nothing measures where these commands lead" in said
    assert "laser is not used on q: its axes are called otherwise than the commands', and follow none" in said


@pytest.mark.parametrize(("gain", "expected"), [(2.002, True), (0.45, True), (1.0, False), (0.93, False)])
def test_a_gain_that_is_not_about_1_is_a_question(gain: float, expected: bool, tmp_path: Path) -> None:
    """Consistent as it may be: a gear, or a unit. What is decided says so, too."""
    write(tmp_path / "goal.csv", {"t_s": T, "turn_rad": U[:, 0]})
    write(tmp_path / "encoder.csv", {"t_s": S, "turn_rad": gain * Z[:, 0]})
    found = survey(tmp_path)
    gear = "times as far as commanded on turn: is that its gear, or a unit?"
    assert any(gear in one for one in asked(found)) is expected
    checked = {what: sure for what, _, sure in decisions(found)}
    assert [*checked] == ["clock", "units", "who is who", "encoder follows"]
    assert [*checked.values()] == ["sure", "sure", "sure", "a question" if expected else "sure"]


def test_where_nothing_follows_no_columns_are_exchanged(tmp_path: Path) -> None:
    write(tmp_path / "goal.csv", {"t_s": T, "x_mm": 1e3 * U[:, 0]})
    write(tmp_path / "camera.csv", {"t_s": S, "x_mm": np.random.default_rng(3).normal(size=len(S))})
    said = "\n".join(asked(survey(tmp_path)))
    assert "camera does not follow the commands on x" in said and "exchanged" not in said


@pytest.mark.parametrize(
    ("clocks", "column", "unit", "known"),
    [
        # a counter of ms, rows 1 ms apart: nothing but the motion says that they are no seconds
        (lambda n: {"clock": 5_000_000 + n}, "clock", "ms", "motion"),
        (lambda n: {"t": 812.5 + 1.25 * n}, "t", "ms", "motion"),
        # whole seconds, beside a counter whose unit is told by them
        (lambda n: {"stamp": 1_700_000_000 + n // 1000, "KRC": 40_000 + n}, "", "", ""),
        (
            lambda n: {"date": [f"2026-03-01 08:00:{k // 250:02d}" for k in n], "KRC": 77_000 + 4 * n},
            "KRC",
            "ms",
            "another clock",
        ),
        (lambda n: {"stamp": 1_700_000_000 + n // 500, "ticks": 9 + 2000 * n}, "ticks", "us", "another clock"),
        # the name says it
        (lambda n: {"millis": 70 + 2 * n}, "millis", "ms", "name"),
        (lambda n: {"usec": 2**32 - 1_000_000 + 2000 * n - 2**32 * (n >= 500)}, "usec", "us", "name"),
        # days of Excel and of MATLAB
        (lambda n: {"Time": 45_678.25 + n * 0.004 / 86400}, "Time", "days", "range"),
        (lambda n: {"time": 739_000.5 + n * 0.008 / 86400}, "time", "days", "range"),
        # 100 ns of Windows and of .NET
        (lambda n: {"stamped": 133_500_000_000_000_000 + 40_000 * n}, "stamped", "ticks", "range"),
        (lambda n: {"time": 638_500_000_000_000_000 + 20_000 * n + n % 3}, "time", "ticks", "range"),
    ],
)
def test_clocks_are_those_that_make_sense_of_the_table(
    clocks: Callable[[Any], dict[str, Any]], column: str, unit: str, known: str, tmp_path: Path
) -> None:
    """Numbers of a clock by the motion beside them, by another clock, by their name, or by their date."""
    n = np.arange(3000)
    u = np.stack([np.sin(n / 230.0 + k) for k in range(2)])
    z = np.roll(u, 40, axis=1)
    columns = {"goal_x_m": u[0], "goal_y_m": u[1], "actual_x_m": z[0], "actual_y_m": z[1], "load": 100 + n % 7}
    write(tmp_path / "log.csv", clocks(n) | columns)
    (part,) = parts_of(tmp_path / "log.csv")
    if not column:  # steps of 1 count rows
        assert part.clock is None
        return
    assert (part.clock.time.column, part.clock.time.unit) == (column, unit)
    assert part.clock.basis == f"{unit} by {known}"
    assert bool(part.clock.doubt) == (known == "motion")
    steps = np.diff(part.clock.stamp) / 1e6  # ms
    assert steps.min() > 0.9
    assert steps.max() < 9.0
    assert {one.column for one in part.signals}.isdisjoint({"stamp", "KRC", "ticks"})


@pytest.mark.parametrize("every", [1, 2])
def test_a_clock_that_counts_its_rows_tells_no_unit(every: int, tmp_path: Path) -> None:
    """It is asked what it is; rows at a rate that is given are so far apart. One that leaves numbers out is a clock."""
    n = np.arange(2500)
    told = np.sin(n / 90.0) + 0.4 * np.sin(n / 37.0)
    found = surveyed(tmp_path, {"stamp": 310 + every * n, "goal_x_m": told, "actual_x_m": np.roll(told, 4)})
    assert any("a count of rows?" in one and "--rate HZ" in one for one in asked(found)) is (every == 1)
    assert next(decisions(found)) == ("clock", "stamp: ms by motion", "a guess: stamp")
    (part,) = parts_of(tmp_path / "log.csv", rate=40.0)
    assert np.diff(part.clock.stamp)[0] / 1e6 == pytest.approx(25.0 if every == 1 else 2.0)
    assert survey(tmp_path / "log.csv", 40.0).relations["actual", "x"].lag == pytest.approx(
        0.1 if every == 1 else 8e-3, abs=2e-3
    )


@pytest.mark.parametrize(
    ("begins", "lasts", "unit", "known"),
    [
        (12.0, 140.0, "s", "another clock"),
        (0.01, 0.2, "ms", "motion"),  # as long in ms
        (9000.0, 140.0, "ms", "motion"),  # at another time
        (12.0, 2.0, "ms", "motion"),  # much longer or shorter in each
    ],
)
def test_a_guessed_unit_is_one_in_which_tables_tell_one_time(
    begins: float, lasts: float, unit: str, known: str, tmp_path: Path
) -> None:
    """Rows 0.125 apart on a path that takes minutes are none of a robot in s, but another table lasts as long."""
    t, s = np.arange(0.0, 150.0, 0.125), np.linspace(0.0, lasts, 4000)
    write(tmp_path / "goal.csv", {"time": 10.0 + t, "z_mm": 30.0 * np.sin(t / 60.0)})
    write(tmp_path / "eye.csv", {"time_s": begins + s, "z_mm": np.sin(s)})
    clock = next(one.clock for one in parts_of(tmp_path) if one.file.name == "goal.csv")
    assert clock is not None and (clock.time.unit, clock.basis) == (unit, f"{unit} by {known}")
    assert np.ptp(clock.stamp) == pytest.approx(149.875e9 if unit == "s" else 149.875e6)
    assert bool(clock.doubt) == (known == "motion")


def test_seconds_stay_seconds_where_the_motion_is_one_of_a_robot(tmp_path: Path) -> None:
    """Rows 0.5 s apart with strokes of ten seconds."""
    n = np.arange(400)
    write(tmp_path / "log.csv", {"time": 0.5 * n, "goal_x_m": np.sin(n / 6.0), "actual_x_m": np.sin((n - 1) / 6.0)})
    (part,) = parts_of(tmp_path / "log.csv")
    assert part.clock.basis == "s by interval"


def test_a_clock_that_was_counted_gives_way_to_one_that_was_measured(tmp_path: Path) -> None:
    """A loop that was to run at 500 Hz and ran at half of it: 80 ms late, not 40. Clocks that agree are no question."""
    rng = np.random.default_rng(2)
    real = np.cumsum(rng.uniform(0.003, 0.005, 4000))
    told, seen = np.sin(2.0 * real) + 0.3 * np.sin(7.1 * real), real - 0.08
    seen = np.sin(2.0 * seen) + 0.3 * np.sin(7.1 * seen) + rng.normal(0.0, 1e-3, len(real))
    nominal = 0.8 + 0.002 * np.arange(4000)
    columns = {"timestamp": nominal, "real_time": real, "x_target_m": told, "x_actual_m": seen}
    found = surveyed(tmp_path, columns)
    assert found.relations["actual", "x"].lag == pytest.approx(0.08, abs=3e-3)
    assert any(
        "which is the clock of log.csv? By timestamp it lasts 7.998 s, by real_time 16" in one for one in asked(found)
    )
    assert not any(
        "which is the clock" in one for one in asked(surveyed(tmp_path, columns | {"timestamp": np.round(real, 2)}))
    )


@pytest.mark.parametrize(("told", "measured"), [("reference", "theta"), ("goal_RF_AA", "dof_RF_AA")])
def test_an_angle_by_the_name_of_what_measures_it_is_one(told: str, measured: str, tmp_path: Path) -> None:
    """``reference`` beside ``theta``, without a unit: both in rad, not in m."""
    t = np.arange(0.0, 30.0, 0.02)
    columns = {"time_s": t, told: np.sin(t) + 0.3 * np.sin(3.3 * t)}
    found = surveyed(tmp_path, columns | {measured: np.interp(t - 0.1, t, columns[told])})
    assert set(found.run.kinds.values()) == {"angle"}
    (value,) = found.run.command.values.values()
    assert value.max() == pytest.approx(columns[told].max())


@pytest.mark.parametrize(("word", "unit", "far"), [("", "rad", 2.5), ("", "deg", 80.0), ("rail_", "m", 2.5)])
def test_joints_that_are_called_so_before_their_axis_turn(word: str, unit: str, far: float, tmp_path: Path) -> None:
    """``cmd_joint_pos_RL``, beside a coordinate in mm; a rail slides."""
    columns = {f"{what}_joint_pos_{word}RL": 2.0 * far * one[:, 0] for what, one in (("cmd", U), ("meas", ZT))}
    write(
        tmp_path / "log.csv", {"t_s": T, **columns, "height": 900.0 * ZT[:, 1]} if not word else {"t_s": T, **columns}
    )
    (part,) = parts_of(tmp_path / "log.csv")
    assert {one.unit for one in part.signals if one.column in columns} == {unit}


def test_rows_in_packets_are_spread_by_what_counts_them(log: Path, tmp_path: Path) -> None:
    """A camera that sends 16 rows at a time follows as late as it would one by one; without a counter it is asked."""
    n = np.arange(len(S))
    sent = S[np.minimum(n // 16 * 16 + 15, len(S) - 1)] + 1e-5 * (n % 16)
    axes = xyz(Z)
    write(log / "commands.csv", {"time_s": T, **xyz(U)})
    write(log / "camera.csv", {"received_s": sent, "frame": 300 + n, **axes})
    found = check_fuses(log, tmp_path / "out")
    assert "counter" in drafts(found, *guess(found), tmp_path)["run.toml"]
    write(log / "camera.csv", {"received_s": sent, **axes})
    assert any("camera.csv: rows arrive" in one and "no column counts them" in one for one in asked(survey(log)))


def test_of_two_clocks_the_one_that_stamps_each_row_is_taken(tmp_path: Path) -> None:
    """A loop that also writes the stamp of the last frame, which many rows share; durations of a loop are no clock."""
    frame = 0.1 * np.floor(T / 0.1 + 0.5)
    stamps = {"image_stamp_us": np.round(frame * 1e6), "steady_us": np.round(T * 1e6)}
    stamps["cycle_time_ms"] = 15.0 + np.arange(len(T)) // 40 % 2
    found = surveyed(tmp_path, stamps | xyz(U, "goal_{}_m") | xyz(ZT, "actual_{}_m"))
    assert [one.lag for one in found.relations.values()] == pytest.approx(3 * [LAG], abs=5e-3)
    assert not any("rows arrive" in one or "which is the clock" in one for one in asked(found))


def test_a_sensor_that_moves_against_the_commands_is_said_to(tmp_path: Path) -> None:
    """A column that nothing names, mounted the other way round: not that it follows by a correlation of -1."""
    text = refusal(tmp_path, {"t_s": T, "goal_bend": U[:, 0], "potentiometer": -40.0 * ZT[:, 0]})
    assert "it moves against the commands (correlation -1.00), as errors do, or a sensor of scale -1" in text


def test_units_that_are_neither_lengths_nor_angles_are_asked_by_their_name(tmp_path: Path) -> None:
    """Ticks of an encoder are no mm by their range; what is in brackets is said, but no label of a list."""
    numbers = {"goal lift [ticks]": 5e4 * U[:, 0], "actual lift [ticks]": 5e4 * ZT[:, 0]}
    (question,) = (one for one in asked(surveyed(tmp_path, {"t_s": T} | numbers)) if "are the numbers of" in one)
    assert "Names say ticks, which is no length and no angle" in question
    assert not names.other_unit_of("position[elbow]") and not names.other_unit_of("x [mm]")


def test_stamps_that_were_counted_are_said(tmp_path: Path) -> None:
    """Stamps that are frames over a rate, to the rounding of float32, but not such as were measured."""
    columns = {"step": np.arange(len(T)), "goal_x_m": U[:, 0], "actual_x_m": ZT[:, 0]}
    log = tmp_path / "log.csv"
    write(log, {"time": np.arange(len(T), dtype=np.float32) / np.float32(50.0), **columns})
    assert any("exactly step / 50" in one for one in asked(survey(log)))
    write(log, {"time": T + np.random.default_rng(1).normal(scale=1e-4, size=len(T)), **columns})
    assert not any("exactly" in one for one in asked(survey(log)))


def test_thrust_says_nothing_about_the_unit_of_positions(tmp_path: Path) -> None:
    """Columns that follow nothing, however large, leave the unit alone, and axes of one source share it."""
    columns = {**xyz(30.0 * U, "goal_{}"), **xyz(30.0 * ZT, "actual_{}")}  # up to 18 and only 6
    roles = surveyed(tmp_path, {"time": T, **columns, "propeller": 4e4 + 1e3 * np.sin(T)}).roles
    assert {one.unit for some in roles.command.axes.values() for one in some} == {"mm"}
    small = {name: 0.2 * value for name, value in columns.items()}
    roles = surveyed(tmp_path, {"time": T, **small, "propeller": 4e4 + 1e3 * np.sin(T)}).roles
    assert {one.unit for some in roles.command.axes.values() for one in some} == {"m"}


@pytest.mark.parametrize("stem", ["flight", "reference_log"])
def test_a_reference_beside_one_other_is_a_set_point(stem: str, tmp_path: Path) -> None:
    """Where what is measured leads it, as of an arm that looks ahead, the log is refused: the two are not exchanged."""
    tables = {"t_s": T, "ref_x_m": ZT[:, 0], "pos_x_m": U[:, 0]}
    write(tmp_path / f"{stem}.csv", tables)
    assert "it does not follow the commands" in one_line(RunError, lambda: survey(tmp_path / f"{stem}.csv"))
    write(tmp_path / f"{stem}.csv", tables | {"ref_x_m": U[:, 0], "pos_x_m": ZT[:, 0]})
    found = survey(tmp_path / f"{stem}.csv")
    assert "set point" in found.roles.command.why
    assert found.relations[found.roles.sensors[0].name, "x"].lag == pytest.approx(LAG, abs=0.01)


@pytest.mark.parametrize(
    ("told", "measured", "scale", "unit"),
    [("setpoint", "pan_deg", 57.3, "deg"), ("demand", "lift_cm", 100.0, "cm"), ("goal", "tilt_rad", 1.0, "rad")],
)
def test_commands_without_a_unit_have_that_of_what_follows_them(
    told: str, measured: str, scale: float, unit: str, tmp_path: Path
) -> None:
    """A column that says its unit, beside a set point that does not and goes as far, measures it in that unit."""
    found = surveyed(tmp_path, {"t_s": T, told: scale * U[:, 0], measured: scale * ZT[:, 0]})
    (axis,) = found.run.axes
    assert {stream.axes[axis][0].unit for stream in found.roles.streams} == {unit}
    assert found.relations["measured", axis].lag == pytest.approx(LAG, abs=0.01)


@pytest.mark.parametrize(
    ("clock", "told", "measured"),
    [("tempo", "Referência", "Ângulo (deg)"), ("tiempo", "Consigna", "Posición"), ("Zeit", "Referenz", "Winkel_deg")],
)
def test_headers_in_other_languages(clock: str, told: str, measured: str, tmp_path: Path) -> None:
    """Set points and clocks of Portuguese, Spanish and German tables are known by their names, also with accents."""
    found = surveyed(tmp_path, {clock: T, told: 50.0 * U[:, 0], measured: 50.0 * ZT[:, 0]})
    (sensor,) = found.roles.sensors
    assert found.roles.command.axes[found.run.axes[0]][0].column == told
    assert found.relations[sensor.name, found.run.axes[0]].lag == pytest.approx(LAG, abs=0.01)


def test_speeds_that_are_never_commanded_are_not_to_be_added_up(tmp_path: Path) -> None:
    """Desired positions and speeds that stay 0: the refusal says so, and does not advise to integrate the speeds."""
    columns = {"t_s": T, "actual_x_m": ZT[:, 0], "desired_x_m": 0.0 * T, "desired_vel_x": 0.0 * T}
    line = refusal(tmp_path, columns)
    assert "What is called so never moves: desired_x_m, always 0; desired_vel_x, always 0" in line
    assert "velocities" not in line


def test_a_reference_that_runs_ahead_of_the_commands_is_no_truth(tmp_path: Path) -> None:
    """Steps that a controller shapes into commands: left out and named; nothing is scored against them."""
    steps = np.sign(U[:, 0] - 0.3) * 0.3
    ahead = np.roll(steps, -25)
    shaped = np.convolve(np.pad(ahead, (50, 0), mode="edge"), np.full(51, 1.0 / 51.0), mode="valid")
    measured = np.interp(T - LAG, T, shaped) + np.random.default_rng(5).normal(0.0, 1e-4, len(T))
    found = surveyed(tmp_path, {"t_s": T, "reference_x_m": ahead, "command_x_m": shaped, "actual_x_m": measured})
    assert found.run.reference is None
    (line,) = (one for one in asked(found) if one.startswith("reference is not used on x: it moves "))
    assert float(line.split()[8]) == pytest.approx(500.0, abs=20.0) and "ms before its commands" in line


def test_of_two_clocks_that_were_counted_the_first_is_taken(tmp_path: Path) -> None:
    """Cycles of 4 ms beside the time that they make: another count tells it no better."""
    t, n = 0.004 * np.arange(3000), np.arange(3000)
    columns = {"time_run": t, "time_cycle": n, "bend_target": np.sin(2.0 * t), "bend_actual": np.sin(2.0 * (t - 0.06))}
    found = surveyed(tmp_path, columns)
    assert found.relations["actual", "bend"].lag == pytest.approx(0.06, abs=3e-3)
    assert any("By time_run it lasts 12 s, by time_cycle" in one for one in asked(found))


def test_what_repeats_the_commands_later_is_no_copy(tmp_path: Path) -> None:
    """An ideal drive, its steps apart by 80 times its lag: nine in ten of its numbers are those of the commands."""
    t = np.arange(0.0, 60.0, 0.01)
    told = 0.3 * (np.floor(t / 4.0) % 2.0) + 0.1 * (np.floor(t / 4.0) % 3.0)
    seen = np.interp(np.floor((t - 0.05) * 100.0 + 0.5) / 100.0, t, told)
    write(tmp_path / "drive.csv", {"t_s": t, "target_x_m": told, "actual_x_m": np.round(seen, 6)})
    found = survey(tmp_path / "drive.csv")
    assert found.relations["actual", "x"].lag == pytest.approx(0.05 - 0.005, abs=0.01)
    write(tmp_path / "drive.csv", {"t_s": t, "target_x_m": told, "actual_x_m": told})
    assert "the same numbers as the commands, at the same time" in one_line(
        RunError, lambda: survey(tmp_path / "drive.csv")
    )


@pytest.mark.parametrize(("tick", "every"), [(1.0 / 64.0, 0.004), (0.05, 0.01)])
def test_stamps_of_a_headerless_table_may_repeat(tick: float, every: float, tmp_path: Path) -> None:
    """As a clock that ticks more slowly than rows are written; seconds are too coarse, and said to be."""
    t = np.arange(0.0, 40.0, every)
    for name, ticks in (("fine", np.floor(t / tick) * tick), ("coarse", np.floor(t))):
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([ticks, path(t), path(t - LAG)]), "%.4f", ",")
    (fine,) = parts_of(tmp_path / "fine.csv")
    assert fine.clock.stamp[-1] == pytest.approx(40e9, abs=1.1e9 * tick)
    (coarse,) = parts_of(tmp_path / "coarse.csv")
    assert coarse.clock is None
    assert any("is no clock: 40 distinct stamps, one every 1 s" in note for note in coarse.notes)


@pytest.mark.parametrize("later", [0.3, 0.8])
def test_what_moves_alike_much_later_measures_nothing_in_a_table_without_a_header(later: float, tmp_path: Path) -> None:
    """Legs of a gait follow each other by a share of a stride, and no arm is so late."""
    t = np.arange(0.0, 30.0, 0.02)
    np.savetxt(tmp_path / "walk.csv", np.column_stack([t, path(t)[:, 1], path(t - later)[:, 1]]), "%.5f", ",")
    if later < 0.5:
        assert set(survey(tmp_path / "walk.csv").run.sensors) == {"measured"}
    else:
        assert "which numbers are the commands?" in one_line(RunError, lambda: survey(tmp_path / "walk.csv"))


@pytest.mark.parametrize("jitter", [0.0, 0.05])
def test_rows_that_a_clock_of_ticks_gets_may_vary(jitter: float, tmp_path: Path) -> None:
    """Three to five rows of a logger in each tick of about 5 ms; commands and measurements without a header."""
    rng = np.random.default_rng(1)
    rows = rng.choice([3, 4, 5], 2000, p=[0.17, 0.58, 0.25])
    t = np.repeat(0.36 + 0.005 * (np.arange(2000) + jitter * rng.uniform(-1.0, 1.0, 2000)), rows)
    np.savetxt(tmp_path / "shoulder.csv", np.column_stack([t, path(t)[:, 0], path(t - LAG)[:, 0]]), "%.6f", ",")
    (part,) = parts_of(tmp_path / "shoulder.csv")
    assert part.clock is not None and part.clock.time.column == "column 1"


def test_an_empty_array_beside_others_is_left_out(tmp_path: Path) -> None:
    """With the reason; alone it is refused."""
    np.savez(tmp_path / "arm.npz", time=T, target=U, actual=ZT)
    np.save(tmp_path / "attitude.npy", np.zeros(0))
    parts = parts_of(tmp_path)
    assert [note for one in parts for note in one.notes] == [
        "no table in it: nothing has rows of numbers; save an array, or a list of records"
    ]
    assert {one.file.name for one in parts if one.signals} == {"arm.npz"}
    assert "no table in it" in one_line(RunError, lambda: parts_of(tmp_path / "attitude.npy"))


def test_what_is_called_an_error_is_no_position(tmp_path: Path) -> None:
    """However alike it moves."""
    columns = {"time": T, "target_y_m": U[:, 1], "robot_y_m": ZT[:, 1], "robot_y_err": ZT[:, 1] - U[:, 1]}
    write(tmp_path / "log.csv", columns | {"errs_y_m": 0.9 * ZT[:, 1]})
    (part,) = parts_of(tmp_path / "log.csv")
    assert {one.column for one in part.signals} == {"target_y_m", "robot_y_m"}


def test_how_a_tool_leans_is_not_where_it_is(tmp_path: Path) -> None:
    """A vehicle that leans before it goes, each about as the way that it is told."""
    t, rng = np.arange(0.0, 40.0, 0.02), np.random.default_rng(4)
    told = path(t)
    lean = 0.2 * path(t - 0.2)[:, :2] + 0.014 * np.sin(3.1 * t)[:, None] + rng.normal(0.0, 1e-4, (len(t), 2))
    columns = {"t_s": t, "target_x": told[:, 0], "target_y": told[:, 1]}
    said = refusal(tmp_path, columns | {"measured_roll_rad": lean[:, 1], "measured_pitch_rad": lean[:, 0]})
    assert "commands, but nothing that measures where they lead" in said


def test_a_set_point_is_not_measured_by_another(tmp_path: Path) -> None:
    """Paths of a motor and of its joint, both planned: nothing in the log says where the arm was."""
    columns = {"t_s": T, "ref_motor[0]": U[:, 0], "ref_motor[1]": U[:, 1]}
    assert "commands" in refusal(
        tmp_path, columns | {"ref_joint[0]": ZT[:, 0], "ref_joint[1]": ZT[:, 1], "spring[0]": 2.0 * T % 3}
    )


def test_one_coordinate_of_a_point_is_a_joint_only_where_it_moves_as_that_does(tmp_path: Path) -> None:
    """An instrument that slides in and turns: its tip goes about as far along z as it slides, and is not the slide."""
    told = {"time": T, "cmd.insertion_m": U[:, 0], "cmd.yaw_rad": U[:, 1]}
    seen = {"state.insertion_m": ZT[:, 0], "state.yaw_rad": ZT[:, 1]}
    write(tmp_path / "robot.csv", told | seen)
    for share, followed in ((0.5, False), (0.0, True)):
        tip = {"time": T, "x_m": 0.3 + ZT[:, 2], "y_m": np.sin(2.0 * T), "z_m": ZT[:, 0] + share * ZT[:, 2]}
        write(tmp_path / "tip.csv", tip)
        found = survey(tmp_path)
        of_tip = [one for one in found.roles.sensors if one.axes["insertion"][0].column == "z_m"]
        assert bool(of_tip) is followed


def test_a_guessed_unit_of_one_joint_makes_no_length_of_another(tmp_path: Path) -> None:
    """A message's joints are in rad but for the slide, a guess; a coordinate that moves as a turn is no angle."""
    joints(tmp_path / "drive.mcap", "yaw", "insertion", alike=True)
    found = survey(tmp_path / "drive.mcap")
    assert found.run.kinds == {"insertion": "length", "yaw": "angle"}
    assert set(found.run.sensors["joint_states"].values) == {"yaw", "insertion"}
    assert all("yaw" not in one.values for name, one in found.run.sensors.items() if name != "joint_states")


@pytest.mark.parametrize("restart", ["within a turn until then", "a turn less in motion", "a turn more at rest"])
def test_an_angle_goes_on_over_a_restart_of_what_counts_its_turns(restart: str, tmp_path: Path) -> None:
    t = np.arange(0.0, 50.0, 0.02)
    rests = restart == "a turn more at rest"
    u = 900.0 * np.sin(0.11 * np.clip(t, 0.0, 25.0)) if rests else 25.0 * t + 70.0 * np.sin(0.8 * t)
    z = np.interp(t - LAG, t, u) + np.random.default_rng(3).normal(0.0, 0.04, len(t))
    later = t > 29.0
    seen = {
        "within a turn until then": np.where(later, z, np.mod(z, 360.0)),
        "a turn less in motion": z - 360.0 * later,
        "a turn more at rest": z + 360.0 * later,
    }[restart]
    found = surveyed(tmp_path, {"t_s": t, "goal_az_deg": u, "encoder_az_deg": seen})
    one = found.relations["encoder", "az"]
    assert one.lag == pytest.approx(LAG, abs=0.003) and abs(one.offset) < 0.01
    assert any(what == "turns" and "encoder az" in words for what, words, _ in decisions(found))


def test_whole_turns_that_are_commanded_and_a_fast_rotation_are_no_restart() -> None:
    """Steps of exactly a turn from rest, over four; 335 deg from row to row; steps at random."""
    rng, turn = np.random.default_rng(9), 2.0 * np.pi
    steps = turn * np.repeat([0.0, 1.0, 2.0, 3.0, 4.0, 2.0, 1.0], 50)
    fast = 0.93 * turn * np.arange(400.0)
    wild = np.repeat(rng.uniform(-3.0, 3.0, 40) * turn, 20) + rng.normal(0.0, 1e-3, 800)
    assert [len(wraps(one)) for one in (steps, fast, wild)] == [0, 0, 0]


def test_a_run_in_joints_is_drafted_for_another_folder(tmp_path: Path) -> None:
    """The tables and the robot of the log's own run.toml are found from there: the commands are the same poses."""
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "arm.urdf").write_text(URDF.read_text(encoding="utf-8"), encoding="utf-8")
    t = 0.02 * np.arange(1000)
    at = np.radians([107.0, 45.0, 161.0, 19.0, 64.0, -98.0]) + 0.4 * np.sin(np.outer(t, np.arange(3.0, 9.0) / 5.0))
    joints = [f"j{one}" for one in range(1, 7)]
    write(folder / "told.csv", {"t_s": t} | dict(zip(joints, np.degrees(at).T, strict=True)))
    chain = Chain.load(folder / "arm.urdf", "base_link", "tool0")
    seen = np.column_stack([np.interp(t - LAG, t, one) for one in chain.pose(at)[0].T])
    write(folder / "camera.csv", {"t_s": t} | dict(zip(("x_m", "y_m", "z_m"), seen.T, strict=True)))
    lines = [
        *("[robot]", 'urdf = "arm.urdf"', 'base = "base_link"', 'tip = "tool0"'),
        *("[command]", 'file = "told.csv"', 'time = "t_s"'),
        "joints = { " + ", ".join(f'{one} = {{ column = "{one}", unit = "deg" }}' for one in joints) + " }",
        *("[sensors.camera]", 'file = "camera.csv"', 'time = "t_s"', 'x = "x_m"', 'y = "y_m"', 'z = "z_m"'),
    ]
    (folder / "run.toml").write_text("\n".join(lines))
    run, config = written(survey(folder), tmp_path / "beside" / "out")
    given = pf.Run.read(folder)
    assert run.name == given.name == "log"
    for axis in "xyz":
        np.testing.assert_array_equal(run.command.values[axis], given.command.values[axis])
    np.testing.assert_array_equal(run.command.orientation, given.command.orientation)
    assert config.arm.lag_of("x") == pytest.approx(LAG, abs=0.02)


@pytest.mark.parametrize("given", ["xy", "xyz"])
def test_a_sensor_that_lacks_what_a_frame_is_found_by_is_told_so(given: str, tmp_path: Path) -> None:
    """One that does not follow and gives no z; not one that gives all three."""
    turned = Z[:, [1, 2, 0]]
    write(tmp_path / "goal.csv", {"t_s": T} | {f"{axis}_m": one for axis, one in zip("xyz", U.T, strict=True)})
    write(tmp_path / "camera.csv", {"t_s": S} | {f"{axis}_m": one for axis, one in zip("xyz", turned.T, strict=True)})
    tables = {"command": ("goal", "xyz"), "sensors.camera": ("camera", given)}
    text = "".join(
        f'[{table}]\nfile = "{file}.csv"\ntime = "t_s"\n' + "".join(f'{axis} = "{axis}_m"\n' for axis in axes)
        for table, (file, axes) in tables.items()
    )
    (tmp_path / "run.toml").write_text(text)
    said = "\n".join(asked(survey(tmp_path)))
    assert ("It gives no z, without which no frame of its own is found" in said) is (given == "xy")
    assert "camera does not follow the commands on x" in said


@pytest.mark.parametrize("share", [0.08, 0.3])
def test_rows_out_of_order_have_a_clock(tmp_path: Path, share: float) -> None:
    """Written by several threads, up to five rows late: the clock is found; what moves to and fro is none."""
    rng = np.random.default_rng(1)
    for name, time, value in (("commands", T, U), ("tracker", S, Z)):
        place = np.arange(len(time)) + np.where(rng.random(len(time)) < share, rng.uniform(1.0, 6.0, len(time)), 0.0)
        order = np.argsort(place, kind="stable")
        write(tmp_path / f"{name}.csv", {"t_s": time[order], "x_mm": 1e3 * value[order, 0]})
    assert survey(tmp_path).relations["tracker", "x"].lag == pytest.approx(LAG, abs=5e-3)
    write(tmp_path / "commands.csv", {"t_s": 1e3 * U[:, 1], "x_mm": 1e3 * U[:, 0]})
    assert "which numbers are the commands" in one_line(RunError, lambda: survey(tmp_path))


def test_of_a_log_of_px4_topics_of_positions_count(tmp_path: Path) -> None:
    """What sticks, estimators and magnetometers say is no motion in metres, however alike it moves."""
    xyz = "float x;float y;float z"
    topics = {
        "manual_control_setpoint": (xyz, T, path(T + 0.05)),
        "estimator_innovations": ("float[3] gps_hpos", T, path(T - 0.05)),
        "vehicle_magnetometer": ("float[3] magnetometer_ga", T, 0.4 + path(T - 0.15)),
        "trajectory_setpoint": ("float[3] position;float[3] velocity", T, np.hstack([U, np.gradient(U, axis=0)])),
        "vehicle_local_position": (f"{xyz};float dist_bottom;float eph", S, np.column_stack([Z, Z[:, 2] + 1.0, S])),
    }
    found = survey(write_ulg(tmp_path / "flight.ulg", topics))
    assert found.roles.command.part.label == "trajectory_setpoint"
    assert [one.part.label for one in found.roles.sensors] == ["vehicle_local_position"]
    assert found.run.axes == ("x", "y", "z")
    assert {one.unit for some in found.roles.command.axes.values() for one in some} == {"m"}
    for one in found.relations.values():
        assert one.lag == pytest.approx(LAG, abs=0.003)


def test_fingers_are_joints(tmp_path: Path) -> None:
    """An index finger and a turning thumb beside a word of a role; a column that counts is none."""
    columns = {"t_s": T, "frame_index": np.arange(len(T)) // 3}
    for name, place in (("ring", 0), ("index", 1), ("thumb_rotation", 2)):
        columns |= {f"wish.target.{name}": U[:, place], f"hand.actual.{name}": ZT[:, place]}
    found = surveyed(tmp_path, columns)
    assert len(found.run.axes) == 3
    assert {axis.rpartition("_")[2] for axis in found.run.axes} == {"ring", "index", "rotation"}


def test_the_same_axes_under_another_word_are_another_sensor(tmp_path: Path) -> None:
    """What the robot itself tells and a tracker in the columns of one table: one beside the other, each as it is."""
    columns = {"t_s": T}
    for place, axis in enumerate("xyz"):
        columns |= {f"{axis}_goal_m": U[:, place], f"{axis}_m": ZT[:, place], f"{axis}_data_m": ZT[:, place] + 1e-3}
    found = surveyed(tmp_path, columns | {"battery_m": np.sin(7.1 * T)})
    assert sorted(one.axes["x"][0].column for one in found.roles.sensors) == ["x_data_m", "x_m"]
    (left,) = [why for one, why in found.roles.left_out if "battery" in one.axes]
    assert "no command is left that is called so or moves alike" in left


def test_joints_at_rest_do_not_hide_the_one_that_moves(tmp_path: Path) -> None:
    """Six of seven stick: their encoders toggle by a step while the commands creep. Names without a word say whose."""
    rng = np.random.default_rng(5)
    t = 0.02 * np.arange(1500)
    u = 1e-3 * np.cumsum(rng.normal(size=(1500, 7)), axis=0)
    u[:, 6] = 0.5 * np.sin(0.9 * t) + 0.2 * np.sin(2.3 * t)
    z = 4e-4 * rng.integers(0, 2, (1500, 7)).astype(float)
    z[:, 6] = np.interp(t - 0.08, t, u[:, 6])
    np.savez(tmp_path / "arm.npz", time=t, p=z, p_cmd=u)
    found = survey(tmp_path / "arm.npz")
    assert found.run.axes == ("joint6",)
    ((_, one),) = found.relations.items()
    assert one.lag == pytest.approx(0.08, abs=0.012)
    np.savez(tmp_path / "other.npz", time=t, flux=z, p_cmd=u)  # of another name most axes have to follow
    with pytest.raises(RunError, match=r"follows the commands on 1 of \d axes"):
        survey(tmp_path / "other.npz")


def test_of_steps_how_far_an_axis_goes_tells_its_gain(tmp_path: Path) -> None:
    """Changes over a tenth of a second are cut by steps that take longer: no gear is asked for. Half is."""
    rng, t = np.random.default_rng(3), 0.1 * np.arange(900)
    u = rng.choice([0.1, 0.4, 0.8], 90).repeat(10)
    z = np.interp(t - 0.35, t, u)
    for gain, asks in ((1.0, False), (0.5, True)):
        write(tmp_path / "steps.csv", {"t_s": t, "goal_j_rad": u, "encoder_j_rad": gain * z})
        assert any("times as far as commanded" in one for one in asked(survey(tmp_path / "steps.csv"))) is asks


def test_where_no_column_leads_they_are_named(tmp_path: Path) -> None:
    rng, t = np.random.default_rng(4), 0.02 * np.arange(500)
    noise = {name: np.cumsum(rng.normal(size=500)) for name in ("r", "y", "w1", "w2")}
    write(tmp_path / "log.csv", {"t_s": t, **noise})
    with pytest.raises(RunError, match=r"log\.csv: r, y, w1, w2"):
        survey(tmp_path / "log.csv")


def test_files_that_each_are_a_whole_run_are_not_one(tmp_path: Path) -> None:
    """Three takes of a demonstration in a folder: the first is used, the others are named. A table beside it stays."""
    for number in range(3):
        t, u, s, z = recorded(count=600, seed=number)
        turn = 1.0 - 0.4 * number
        table = {"t_s": t, "wish_cmd_m": turn * u[:, 0], "wish_state_m": turn * np.interp(t, s, z[:, 0])}
        write(tmp_path / f"take_{number}.csv", table)
    write(tmp_path / "tracker.csv", {"t_s": s, "wish_m": z[:, 0]})
    found = survey(tmp_path)
    assert found.roles.command.part.label == "take_0.csv"
    assert sorted(one.part.label for one in found.roles.sensors) == ["take_0.csv", "tracker.csv"]
    (note,) = [note for part in found.parts for note in part.notes if "a run each" in note]
    assert note == "2 other tables, a run each, left out: take_1.csv …"


@pytest.mark.parametrize(("told", "seen"), [("goal", "encoder"), ("ref", "q"), ("goal", "q")])
def test_of_lists_of_trials_the_first_trial_is_used(told: str, seen: str, tmp_path: Path) -> None:
    """Two lists, each trial with what it was told beside what was seen of it: none of another one is its sensor."""
    t = 0.02 * np.arange(400)
    trials = [
        {"t": t.tolist(), told: turn.tolist(), seen: np.interp(t - LAG, t, turn).tolist()}
        for turn in (path(t + 3.0 * number)[:, 1] for number in range(6))
    ]
    log = tmp_path / "log.json"
    log.write_text(json.dumps({"monday": trials[:3], "tuesday": trials[3:]}))
    found = survey(log)
    assert [one.part.label for one in found.roles.streams] == ["monday[0]", "monday[0]"]
    assert found.roles.command.part.notes == ("5 other tables, a run each, left out: monday[1] …",)
    assert [one.lag for one in found.relations.values()] == [pytest.approx(LAG, abs=0.01)]


@pytest.mark.parametrize(("told", "seen"), [("PosTgt", "PosAct"), ("pos_tar", "actPos"), ("setpoint", "readback")])
def test_of_tables_of_one_file_each_with_stamps_of_its_own_the_first_is_used(
    told: str, seen: str, tmp_path: Path
) -> None:
    """As of sheets with a trial each, by names that say who is who. Those that share the stamps are one run."""
    t = 0.02 * np.arange(400)

    def trial(number: int, late: float) -> dict[str, list[float]]:
        turn = path(t + 3.0 * number)[:, 1]
        stamps = np.where(t > 0.0, t + late, 0.0)
        return {"t": stamps.tolist(), told: turn.tolist(), seen: np.interp(t - LAG, t, turn).tolist()}

    log = tmp_path / "trials.json"
    log.write_text(json.dumps({f"speed {n}": trial(n, 1e-3 * n) for n in range(4)}))
    found = survey(log)
    assert [one.part.label for one in found.roles.streams] == ["speed 0", "speed 0"]
    assert found.roles.command.part.notes == ("3 other tables, a run each, left out: speed 1 …",)
    assert [one.lag for one in found.relations.values()] == [pytest.approx(LAG, abs=0.01)]
    log.write_text(json.dumps({arm: trial(n, 0.0) for n, arm in enumerate(("left", "right"))}))
    assert [(part.label, part.notes) for part in parts_of(log)] == [("left", ()), ("right", ())]


def test_two_actual_positions_are_not_each_other_s_commands(tmp_path: Path) -> None:
    """A counter of steps and an encoder, and nothing that says what the axis was told."""
    columns = {"t_s": T, "rotor.PosAct": U[:, 0], "enc.fActPosition": ZT[:, 0]}
    assert "which numbers are the commands?" in refusal(tmp_path, columns)


def test_a_long_name_of_a_file_tells_of_a_load_and_not_what_is_in_it(tmp_path: Path) -> None:
    """Of columns without names; a short one, load_cell, does."""
    t = 0.01 * np.arange(900)
    for name, signals in (("no-load-sine-3Hz.txt", 2), ("temp-wave-no-2.txt", 2), ("load_cell.txt", 0)):
        np.savetxt(tmp_path / name, np.column_stack([t, path(t)[:, 0], path(t - LAG)[:, 0]]), "%.5f")
        (part,) = parts_of(tmp_path / name)
        assert len(part.signals) == signals


@pytest.mark.parametrize("first", [0, 5])
def test_without_names_what_rises_in_fractions_beside_a_count_is_the_clock(first: int, tmp_path: Path) -> None:
    """In an array of MATLAB and in a text: rows are counted in front, then stamped every 8 ms."""
    t = 0.008 * np.arange(700)
    columns = np.column_stack([np.arange(700) + first, t, path(t)[:, 0], path(t - LAG)[:, 0]])
    savemat(tmp_path / "run.mat", {"run": columns})
    np.savetxt(tmp_path / "run.txt", columns, "%.5f")
    for name, column in (("run.mat", "run[1]"), ("run.txt", "column 2")):
        found = survey(tmp_path / name)
        assert found.roles.command.part.clock.time.column == column
        assert [one.lag for one in found.relations.values()] == [pytest.approx(LAG, abs=0.01)]


def test_a_clock_may_be_any_column_that_alone_goes_on(log: Path) -> None:
    """Two tables without a header, the clock in the last column, rows of one are missing; it is asked."""
    kept = np.random.default_rng(2).random(len(T)) > 0.02
    for name, time, values in (("command", T[kept], U[kept]), ("camera", S, Z)):
        rows = np.column_stack([values, time + 400.0])
        lines = [",".join(f"{one:.6f}" for one in row) for row in rows]
        lines[7] = lines[7].rpartition(",")[0] + ","  # a stamp that is missing
        (log / f"{name}.csv").write_text("\n".join(lines) + "\n")
    found = survey(log)
    assert "is column 4 the clock of camera.csv? It alone rises from row to row" in asked(found)
    lags = [one.lag for one in found.relations.values()]
    assert len(lags) == 3 and lags == pytest.approx([LAG] * 3, abs=0.005)
    for name in ("command", "camera"):
        text = (log / f"{name}.csv").read_text()
        (log / f"{name}.csv").write_text("".join(f"{line},{n}.5\n" for n, line in enumerate(text.splitlines())))
    assert "no clock" in one_line(RunError, lambda: survey(log))  # of two, nothing tells which
    both = log / "command.csv"
    both.write_text("\n".join(f"{n},{n + 0.5 * (n % 2)}" for n in np.arange(0.0, 300.0, 0.3)))
    (part,) = parts_of(both)
    assert part.clock is not None and part.clock.time.column == "column 1"  # the first is one before any is looked for


def test_a_sensor_beside_the_commands_is_not_called_after_the_file(tmp_path: Path) -> None:
    """So what is fitted to one log is a configuration of another."""
    for name in ("monday", "tuesday"):
        write(tmp_path / f"{name}.csv", {"t_s": T, "target x_mm": 1e3 * U[:, 0], "x_mm": 1e3 * ZT[:, 0]})
        assert [*survey(tmp_path / f"{name}.csv").run.sensors] == ["measured"]


def test_columns_without_words_are_what_their_file_is_called(log: Path) -> None:
    """A torque follows, too. A file of commands, of a sensor or of times is none of these."""
    write(log / "command.csv", {"time": T, "value": U[:, 0]})
    for name, sign in (("torque", 0.5), ("measured_load", -1.0), ("encoder", 1.0), ("time_series", 1.0)):
        write(log / f"{name}.csv", {"time": S, "value": sign * Z[:, 0]})
    left_out = {part.file.stem: [*part.left_out.values()] for part in parts_of(log)}
    assert left_out["torque"] == ["torque, as torque.csv is called"]
    assert left_out["measured_load"] == ["load, as measured_load.csv is called"]
    assert left_out["encoder"] == left_out["time_series"] == left_out["command"] == []
    for name in ("encoder", "time_series"):
        (log / f"{name}.csv").unlink()
    said = one_line(RunError, lambda: survey(log))
    assert "measures where they lead: value (load, as measured_load.csv is called); value (torque, as torque" in said


def test_inputs_that_nothing_follows_are_no_commands_where_a_plan_is_followed(log: Path) -> None:
    """A controller's inputs to rotors stand beside the plan; alone they would be the commands."""
    drawn = np.random.default_rng(8).normal(size=(len(T), 2))
    write(log / "plan.csv", {"t_s": T, "x_m": U[:, 0], "y_m": U[:, 1], "input 1": drawn[:, 0], "input 2": drawn[:, 1]})
    write(log / "state.csv", {"t_s": S, "x_m": Z[:, 0], "y_m": Z[:, 1]})
    found = survey(log)
    assert set(found.run.axes) == {"x", "y"}
    assert [one.lag for one in found.relations.values()] == pytest.approx([LAG] * 2, abs=0.005)
    assert any("other commands than" in question for question in asked(found))
    write(log / "plan.csv", {"t_s": T, "input x": U[:, 0], "input y": U[:, 1]})
    assert set(survey(log).run.axes) == {"x", "y"}


def test_what_a_controller_puts_out_is_no_command_beside_a_set_point(tmp_path: Path) -> None:
    """Also where it runs ahead of what is measured, and the set point hardly does."""
    t, u, _ = recorded_at_once()
    columns = {"t_s": t, "lift_setpoint": u[:, 0], "lift_present": path(t - 0.001)[:, 0]}
    found = surveyed(tmp_path, columns | {"lift_control_output": 40.0 * path(t + 0.3)[:, 0]})
    assert [signal.column for signal in found.roles.command.axes["lift"]] == ["lift_setpoint"]


@pytest.mark.parametrize("late", [0.12, 0.004])
def test_what_moves_at_once_with_the_commands_is_them_again_where_a_sensor_is_late(late: float, tmp_path: Path) -> None:
    """What was sent, with jitter; where the sensor that is called so moves at once, too, it may be another one."""
    t = 0.02 * np.arange(900)
    u, jitter = path(t)[:, :2], np.random.default_rng(6).normal(0.0, 2e-3, (len(t), 2))
    pairs = {"wanted_{}": u, "dithered_{}": u + jitter, "encoder_{}": path(t - late)[:, :2]}
    found = surveyed(tmp_path, {"t_s": t} | {name.format(n): x[:, n] for name, x in pairs.items() for n in (0, 1)})
    assert [sensor.name for sensor in found.roles.sensors] == (["encoder"] if late > 0.1 else ["measured", "encoder"])


def test_a_count_of_microseconds_beside_zeros_is_no_count_of_seconds(tmp_path: Path) -> None:
    """A table without a header, in which the second column is no nanoseconds: it hardly ever is anything."""
    t, u, z = recorded_at_once()
    columns = [81_000_000 + np.rint(1e6 * t), np.where(t > t[0], 0, 70_200_000), 1e3 * u[:, 0], 1e3 * z[:, 0]]
    np.savetxt(tmp_path / "log.csv", np.column_stack(columns), "%d,%d,%.4f,%.4f")
    (part,) = parts_of(tmp_path / "log.csv")
    assert part.clock is not None and (part.clock.time.nanoseconds, part.clock.time.unit) == ("", "us")


def test_a_clock_of_zeros_at_first_does_not_begin_anew(tmp_path: Path) -> None:
    """Rows that were made before the first message came are left out of what the refusal says."""
    rows = np.column_stack([S, Z, np.random.default_rng(4).normal(size=len(S))])
    np.savetxt(tmp_path / "log.txt", np.vstack([np.zeros((3, 5)), rows + np.array([300.0, 0, 0, 0, 0])]))
    assert "begins anew" not in one_line(RunError, lambda: survey(tmp_path / "log.txt"))


def test_commands_in_inches_and_a_sensor_in_centimetres_are_fused_in_metres(log: Path) -> None:
    """Their names say it; another sensor has the unit in which it goes as far, and whether it has is asked."""
    write(log / "command.csv", {"t_s": T, "x(in)": U[:, 0] / 0.0254})
    for name, column, size in (("camera", "x [cm]", 0.01), ("gauge", "x", 0.0254)):
        write(log / f"{name}.csv", {"t_s": S, column: Z[:, 0] / size})
    found = survey(log)
    run, _ = written(found, log.parent / "described")
    np.testing.assert_allclose(run.command.values["x"], U[:, 0], atol=1e-9)
    for sensor in ("camera", "gauge"):
        np.testing.assert_allclose(run.sensors[sensor].values["x"], Z[:, 0], atol=1e-9)
    assert "are the numbers of gauge.csv in inch? No name says it" in " ".join(asked(found))


@pytest.mark.parametrize("name", ["ki07.txt", "delta_task2.csv", "good_mode_b.log"])
def test_a_run_is_called_after_what_its_numbers_are_not(name: str, tmp_path: Path) -> None:
    """A gain, a robot and a task in the name of a file without a header say nothing of its columns."""
    np.savetxt(tmp_path / name, np.column_stack([T, U[:, 0], ZT[:, 0]]))
    assert [one.lag for one in survey(tmp_path / name).relations.values()] == pytest.approx([LAG], abs=0.005)


def test_the_best_pairs_of_axes_come_first(tmp_path: Path) -> None:
    """Joints and their rates in deg/s, called otherwise than the commands: no rate takes the place of a joint."""
    t = 0.01 * np.arange(1500)
    joints = [a * np.sin(1.9 * t + p) + 0.3 * a * np.sin(4.5 * t + 2.0 * p) for a, p in ((0.5, 0), (0.8, 1), (0.4, 2))]
    columns: dict[str, Any] = {"t": t}
    for place, joint in enumerate(joints):
        columns[f"cmd_q{place}"] = joint
        columns |= {
            f"cmd_qd{place}": np.gradient(joint, t),
            f"was_qd{place}": np.degrees(np.gradient(np.roll(joint, 5), t)),
        }
        columns[f"was_q{place}"] = np.interp(t - 0.05, t, joint)
    found = surveyed(tmp_path, columns)
    (sensor,) = found.roles.sensors
    assert {axis: one[0].column for axis, one in sensor.axes.items()} == {f"q{n}": f"was_q{n}" for n in range(3)}
    assert found.parts[0].left_out == {f"cmd_qd{place}": "velocity" for place in range(3)}


def test_many_axes_are_matched_by_what_follows_the_words_that_all_share(tmp_path: Path) -> None:
    """Of 24 joints, too many to compare each with each by their motion; with a word before those of one source."""
    rng, t = np.random.default_rng(6), 0.02 * np.arange(500)
    joints = [f"{part}_{side}" for part in ("hip", "knee", "ankle", "toe", "jaw", "hand") for side in "abcd"]
    speed, phase = rng.uniform(0.4, 1.5, 24), rng.uniform(0.0, 6.0, 24)

    def at(t: FloatArray) -> FloatArray:
        return 0.4 * np.sin(t[:, None] * speed + phase)

    seen = at(t - LAG) + rng.normal(scale=1e-4, size=(500, 24))
    columns = {f"wanted_rover_{joint}": values for joint, values in zip(joints, at(t).T, strict=True)}
    columns |= {f"encoder_{joint}": values for joint, values in zip(joints[::-1], seen.T[::-1], strict=True)}
    found = surveyed(tmp_path, {"t_s": t, **columns})
    assert [axis for _, axis in found.relations] == [f"rover_{joint}" for joint in joints]
    assert [one.lag for one in found.relations.values()] == [pytest.approx(LAG, abs=0.005)] * 24


def test_an_axis_whose_name_ends_as_that_of_a_command_is_that(tmp_path: Path) -> None:
    """``p_RS_R_x`` is x, if it moves alike, though another command moves more alike."""
    y = U[:, 0] + 0.08 * np.sin(1.3 * T)
    columns = {
        "t_s": T,
        "cmd_x_m": U[:, 0],
        "cmd_y_m": y,
        "p_RS_R_x_m": np.roll(y, 5),
        "p_RS_R_y_m": np.roll(y, 5) + ZT[:, 2],
    }
    found = surveyed(tmp_path, {name: value[10:] for name, value in columns.items()})
    (sensor,) = found.roles.sensors
    assert {axis: one[0].column for axis, one in sensor.axes.items()} == {"x": "p_RS_R_x_m", "y": "p_RS_R_y_m"}


def test_a_sensor_whose_command_rests_is_said_to_be_that(tmp_path: Path) -> None:
    columns = {"target_x_mm": 1e3 * U[:, 0], "target_z_mm": np.full(len(T), 15.0)}
    assert "actual is not used on z: its command never moves" in asked(
        surveyed(tmp_path, {"t_s": T, **columns, "actual_x_mm": 1e3 * ZT[:, 0], "actual_z_mm": 1e3 * ZT[:, 2]})
    )


@pytest.mark.parametrize("form", ["{:02d}:{:02d}:{:02d}", "2026-03-04T{:02d}:{:02d}:{:02d}"])
def test_a_clock_of_whole_seconds_says_how_many_rows_a_second_has(form: str, tmp_path: Path) -> None:
    """Which is what --rate asks for."""
    time = [form.format(17, 22, 25 + n // 50) for n in range(1000)]
    said = refusal(tmp_path, {"x_cmd_mm": 1e3 * U[:, 0], "x_meas_mm": 1e3 * ZT[:, 0], "time": time})
    assert "time is no clock: 20 distinct stamps, one every 1 s, in 1000 rows with x_" in said
    assert "stands still: 50 rows a second); if rows come at a constant rate, give it to init as --rate HZ" in said
    assert survey(tmp_path / "log.csv", rate=50.0).run.sensors


@pytest.mark.parametrize("late", [0.1, -0.012])
def test_what_is_asked_about_a_sensor_is_not_sure(late: float, tmp_path: Path) -> None:
    """A lag that is a little less than none is asked about, and decided accordingly."""
    found = surveyed(tmp_path, {"t_s": T, "target_x_mm": 1e3 * U[:, 0], "actual_x_mm": 1e3 * path(T - late)[:, 0]})
    (sure,) = [sure for what, _, sure in decisions(found) if what == "actual follows"]
    assert sure == ("sure" if late > 0.0 else "a question")
    assert any("ahead of the commands on x" in one for one in asked(found)) is (late < 0.0)


def test_what_nothing_names_and_moves_nine_times_as_far_is_no_sensor(tmp_path: Path) -> None:
    """In units that names tell: a spindle's turn follows the table's in time alone."""
    columns = {"t_s": T, "goal_pan_deg": 10.0 * U[:, 0], "spindle_deg": 90.0 * np.interp(T - LAG, T, U[:, 0])}
    assert "9 to 9 times as far" in refusal(tmp_path, columns)
    found = surveyed(tmp_path, columns | {"pan_deg": 10.0 * np.interp(T - LAG, T, U[:, 0])})
    assert {*found.run.sensors} == {"measured"}


def test_an_axis_that_does_not_follow_is_left_out_beside_one_that_hardly_does(tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    loose = np.interp(T - 0.2, T, U[:, 0]) + 0.065 * np.interp(T, T[::60], draw.normal(size=len(T[::60])))
    columns = {"t_s": T, "cmd_x_m": U[:, 0], "cmd_y_m": U[:, 1], "meas_x_m": loose, "meas_y_m": 0.1 * np.sin(9.0 * T)}
    found = surveyed(tmp_path, columns)
    assert 0.8 < found.relations["meas", "x"].correlation < 0.9
    assert {*found.run.axes} == {"x"}
    assert any("meas is not used on y: it does not follow the commands" in asked for asked in questions(found, {}))


def test_a_place_that_is_called_p_is_x_y_z_and_follows_what_is_desired_of_it(tmp_path: Path) -> None:
    """Also where a controller that knows the path is 8 ms ahead on one of two axes, and z stands still."""
    t = 0.02 * np.arange(1000)
    u, z = path(t), np.stack([path(t + 0.008)[:, 0], path(t - 0.012)[:, 1], path(t)[:, 2]], axis=1)
    columns = {"t": t} | {f"p[{place}]": z[:, place] for place in range(3)}
    columns |= {f"p_d[{place}]": u[:, place] if place < 2 else np.full(len(t), 1.2) for place in range(3)}
    found = surveyed(tmp_path, columns)
    assert found.run.axes == ("x", "y")
    assert found.run.kinds == {"x": "length", "y": "length"}
    assert "p is not used on z: its command never moves" in [*questions(found, {})]


@pytest.mark.parametrize("tau", [0.05, 0.3])
def test_commands_that_add_up_to_what_is_measured_are_velocities(tau: float, tmp_path: Path) -> None:
    """Of a hovering drone that takes up a speed in 0.05 or 0.3 s."""
    t = 0.02 * np.arange(1500)
    speed = np.stack([0.5 * np.sin(2.0 * t), 0.4 * np.sin(0.9 * t + np.sin(0.2 * t))], axis=1)
    taken, share = np.zeros_like(speed), 1.0 - np.exp(-0.02 / tau)
    for row in range(1, len(t)):
        taken[row] = taken[row - 1] + share * (speed[row - 1] - taken[row - 1])
    columns = {"t": t, "cmd_x": speed[:, 0], "cmd_y": speed[:, 1]}
    at = 0.02 * np.cumsum(taken, axis=0) + np.random.default_rng(2).normal(0.0, 1e-3, speed.shape)
    text = refusal(tmp_path, columns | {"pos_x": at[:, 0], "pos_y": at[:, 1]})
    assert "cmd_x" in text
    assert "are velocities, and commands must be positions" in text


@pytest.mark.parametrize("seen", ["meas_{}", "actual_traj_{}"])
def test_a_trajectory_is_commanded_where_no_word_says_otherwise(seen: str, tmp_path: Path) -> None:
    found = surveyed(tmp_path, {"t_s": 0.02 * np.arange(1000), **xyz(U, "traj_{}"), **xyz(ZT, seen)})
    assert found.roles is not None
    assert found.roles.command.why == "its columns are called 'traj'"
    assert found.relations[next(iter(found.run.sensors)), "y"].lag == pytest.approx(LAG, abs=3e-3)


@pytest.mark.parametrize(
    ("told", "seen", "unit"),
    [("x_cmd_in", "x_act_in", "inch"), ("x_target_in", "x_in", "inch"), ("x_in", "x_out", "m")],
)
def test_in_is_a_unit_beside_words_of_roles_and_an_input_beside_an_output(
    told: str, seen: str, unit: str, tmp_path: Path
) -> None:
    found = surveyed(tmp_path, {"t_s": 0.02 * np.arange(1000), told: U[:, 0], seen: ZT[:, 0]})
    assert found.roles is not None
    assert {some[0].unit for stream in found.roles.streams for some in stream.axes.values()} == {unit}
    assert found.run.axes == ("x",)


def test_a_line_below_the_header_says_the_units(tmp_path: Path) -> None:
    """Of stamps, positions, and what is none by its unit alone; what a name says wins."""
    header = "Clock,Set [rad],Act Angle,Drive,Drift\nms,-,deg,Nm,[deg/s]\n"
    rows = zip(1e3 * T, U[:, 0], np.degrees(ZT[:, 0]), 3.0 * U[:, 1], 5.0 * U[:, 2], strict=True)
    (tmp_path / "log.csv").write_text(header + "".join(",".join(map(str, row)) + "\n" for row in rows))
    found = survey(tmp_path / "log.csv")
    (part,) = found.parts
    assert part.left_out == {"Drive": "in Nm", "Drift": "in deg/s"} and part.clock is not None
    assert part.clock.basis == "ms by name" and {(one.unit, one.basis) for one in part.signals} == {
        ("rad", "name"),
        ("deg", "name"),
    }
    assert [relation.lag for relation in found.relations.values()] == [pytest.approx(LAG, abs=0.01)]
    run, _ = written(found, tmp_path / "out")
    (angle,) = run.command.values.values()
    assert np.abs(angle - U[:, 0]).max() < 1e-9


@pytest.mark.parametrize(("called", "size"), [("Time (min)", 60.0), ("elapsed_hours", 3600.0)])
def test_a_clock_may_count_minutes_or_hours(called: str, size: float, tmp_path: Path) -> None:
    found = surveyed(tmp_path, {called: T / size, "goal_x_m": U[:, 0], "x_m": ZT[:, 0]})
    run, _ = written(found, tmp_path / "out")
    assert np.abs(np.diff(run.command.stamp) / 1e9 - 0.02).max() < 1e-6
    assert [relation.lag for relation in found.relations.values()] == [pytest.approx(LAG, abs=0.01)]


def test_a_leader_commands_its_followers(tmp_path: Path) -> None:
    """Joints of two arms that are only numbered: angles, no lengths."""
    columns = {f"follower_{n}": ZT[:, n] for n in range(3)} | {f"leader_{n}": U[:, n] for n in range(3)}
    found = surveyed(tmp_path, {"t": T, **columns})
    assert of_roles(found) == [[f"leader_{n}" for n in range(3)], [f"follower_{n}" for n in range(3)]]
    assert {*found.run.kinds.values()} == {"angle"}


@pytest.mark.parametrize("unit", ["kPa", "rpm", "N.m", "mV", "deg/s", "µm/s", "rad/s^2"])
def test_other_units_in_brackets_are_no_positions(unit: str) -> None:
    assert names.no_position(f"P_ref_0 [{unit}]") == f"in {unit}"


def test_a_speed_that_is_missed_is_no_error_to_add_to_a_position(tmp_path: Path) -> None:
    t = 0.02 * np.arange(600)
    columns = {"t_s": t, "target_speed_mps": 1.0 + np.sin(t), "speed_mps": np.sin(t), "error_mps": np.cos(t)}
    text = refusal(tmp_path, columns)
    assert "is an error" not in text


def test_points_of_one_body_that_nothing_names_are_no_commands_and_sensors(tmp_path: Path) -> None:
    """Five on a car that turns: each seems to follow those in front of it, by 20 to 60 ms."""
    t = 0.02 * np.arange(1000)
    points = {"nose": 0.0, "roof": 0.02, "seat": 0.03, "boot": 0.045, "tail": 0.06}
    columns = {
        f"{name}_{axis}": path(t - late)[:, place] for name, late in points.items() for place, axis in enumerate("xy")
    }
    text = refusal(tmp_path, {"t": t} | columns)
    assert "move alike, as points of one body do; say it in run.toml" in text

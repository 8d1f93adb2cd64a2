"""Sources as they are: the same log in any layout gives the same run, bit for bit, and a wrong one gives one line."""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as papq
import pytest

from pumafuse import ArmModel, AxisModel, FirstOrder, FusionConfig, Sensor, fuse
from pumafuse.arrays import NO_STAMP
from pumafuse.errors import PumafuseError, PumafuseWarning
from pumafuse.logs.run import Run
from pumafuse.logs.source import Source
from refusals import one_line

ROWS = 500
GIGA = 10**9
RNG = np.random.default_rng(21)
STAMP = 1_700_000_000_000_000_000 + np.cumsum(
    RNG.integers(5_000_000, 15_000_000, ROWS)
)  # of today: beyond float's grid
X, ANGLE = RNG.normal(0.0, 0.1, ROWS), RNG.normal(0.0, 1.0, ROWS)  # m, rad
X[3] = np.nan
JOINTS = ("elbow", "wrist", "gripper")
refusal = partial(one_line, PumafuseError)


def nullable(values: npt.ArrayLike) -> pa.Array:
    return pa.array(np.asarray(values), from_pandas=True)


def split(stamp: npt.NDArray[np.int64] = STAMP) -> tuple[pa.Array, pa.Array]:
    return pa.array(stamp // GIGA, pa.int32()), pa.array(stamp % GIGA, pa.uint32())


def header() -> pa.Array:
    return pa.StructArray.from_arrays([pa.StructArray.from_arrays(split(), ["sec", "nanosec"])], ["stamp"])


def pose(x: npt.ArrayLike = X) -> pa.Array:
    position = pa.StructArray.from_arrays([nullable(x), nullable(np.zeros(ROWS))], ["x", "y"])
    return pa.StructArray.from_arrays([position], ["position"])


def joint_states() -> tuple[pa.Array, pa.Array]:
    """Names and positions in an order that changes; the elbow is an extra name in some rows, absent in row 7."""
    names, positions = list[list[str]](), list[list[float]]()
    for row in range(ROWS):
        order = RNG.permutation(JOINTS).tolist()
        if row == 7:
            order.remove("elbow")
        names.append(order)
        positions.append([ANGLE[row] if name == "elbow" else 99.0 for name in order])
    return pa.array(names), pa.array(positions)


def read(folder: Path, command: str, columns: Mapping[str, Any] | pa.Table, name: str = "log.parquet") -> Run:
    table = columns if isinstance(columns, pa.Table) else pa.table(dict(columns))
    if name.endswith(".csv"):
        pacsv.write_csv(table, folder / name)
    else:
        papq.write_table(table, folder / name, row_group_size=64)
    (folder / "run.toml").write_text(f'[command]\nfile = "{name}"\n{command}\n', encoding="utf-8")
    return Run.read(folder)


def same(source: Source, stamp: npt.NDArray[np.int64], **values: npt.NDArray[np.float64]) -> None:
    np.testing.assert_array_equal(source.stamp, stamp)
    assert set(source.values) == set(values)
    for axis, wanted in values.items():
        assert source.values[axis].tobytes() == wanted.tobytes(), axis  # bit for bit, NaN too


def texts() -> list[str]:
    """ISO 8601 to the ns, by the standard library."""
    whole = [datetime.fromtimestamp(int(stamp) // GIGA, UTC) for stamp in STAMP]
    return [f"{at:%Y-%m-%dT%H:%M:%S}.{stamp % GIGA:09d}" for at, stamp in zip(whole, STAMP, strict=True)]


def axis(column: str) -> str:
    """Rows with stamps, and x from a column or a field path in m."""
    return f'time = "t_ns"\nx = {{ column = "{column}", unit = "m" }}'


X_M = 'x = { column = "x", unit = "m" }'
POSE_X = X_M.replace('"x"', '"pose.position.x"')
LAYOUTS: dict[str, tuple[str, Callable[[], dict[str, Any]]]] = {
    "flat": ('time = "t_ns"\nx = "x_m"', lambda: {"t_ns": STAMP, "x_m": nullable(X)}),
    "unit beside": (f'time = {{ column = "t", unit = "ns" }}\n{X_M}', lambda: {"t": STAMP, "x": nullable(X)}),
    "unit overrules the name": (
        'time = { column = "t_s", unit = "ns" }\nx = { column = "x_mm", unit = "m" }',
        lambda: {"t_s": STAMP, "x_mm": nullable(X)},
    ),
    "ISO": (f'time = "t"\n{X_M}', lambda: {"t": texts(), "x": nullable(X)}),
    "timestamp": (f'time = "t"\n{X_M}', lambda: {"t": pa.array(STAMP, pa.timestamp("ns")), "x": nullable(X)}),
    "duration": (f'time = "t"\n{X_M}', lambda: {"t": pa.array(STAMP, pa.duration("ns")), "x": nullable(X)}),
    "two columns": (
        f'time = ["sec", "nanosec"]\n{X_M}',
        lambda: {"sec": split()[0], "nanosec": split()[1], "x": nullable(X)},
    ),
    "two field paths": (
        f'time = ["header.stamp.sec", "header.stamp.nanosec"]\n{POSE_X}',
        lambda: {"header": header(), "pose": pose()},
    ),
    "ROS 2 header": (f'time = "header.stamp"\n{POSE_X}', lambda: {"header": header(), "pose": pose()}),
    "lists": (
        axis("state[1]"),
        lambda: {"t_ns": STAMP, "state": pa.array([[0.0, None if np.isnan(x) else x] for x in X])},
    ),
    "lists, some too short": (
        axis("state[1]"),
        lambda: {"t_ns": STAMP, "state": pa.array([[] if np.isnan(x) else [0.0, x, 1.0] for x in X])},
    ),
    "lists of fixed size": (axis("observation.state[1]"), lambda: {"t_ns": STAMP, "observation.state": fixed(X)}),
    "names with dots and brackets": (
        axis("a.b[1]"),
        lambda: {"t_ns": STAMP, "a.b[1]": nullable(X), "a.b": pa.array([[0.0, 0.0]] * ROWS)},
    ),
    "structs in lists": (
        axis("points[1].position.x"),
        lambda: {"t_ns": STAMP, "points": pa.array([[{"position": {"x": 9.0}}, point(x)] for x in X])},
    ),
}


def fixed(x: npt.NDArray[np.float64]) -> pa.Array:
    flat = np.column_stack([np.zeros(len(x)), x]).ravel()
    return pa.FixedSizeListArray.from_arrays(nullable(flat), 2)


def point(x: float) -> dict[str, Any] | None:
    return None if np.isnan(x) else {"position": {"x": x}}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_of_a_log_gives_the_same_run(tmp_path: Path, layout: str) -> None:
    """Stamps are exact to the ns, values are the numbers in the file, and what is null anywhere is missing."""
    command, columns = LAYOUTS[layout]
    run = read(tmp_path, command, columns())
    same(run.command, STAMP, x=X)
    assert run.notes == ()


def test_elements_are_found_by_their_names_in_any_order(tmp_path: Path) -> None:
    """A joint keeps its values though messages list joints in changing order; where it is absent, it is missing."""
    names, positions = joint_states()
    command = 'time = "t_ns"\nelbow = { column = "joints.position[elbow]", unit = "rad" }'
    joints = pa.StructArray.from_arrays([names, positions], ["name", "position"])
    wanted = np.where(np.arange(ROWS) == 7, np.nan, ANGLE)
    same(read(tmp_path, command, {"t_ns": STAMP, "joints": joints}).command, STAMP, elbow=wanted)
    command = command.replace("joints.", "")
    same(read(tmp_path, command, {"t_ns": STAMP, "name": names, "position": positions}).command, STAMP, elbow=wanted)


@pytest.mark.parametrize(("unit", "kind", "factor"), [("um", "length", 1e6), ("mrad", "angle", 1e3)])
def test_a_unit_beside_the_column_is_the_unit_of_its_name(tmp_path: Path, unit: str, kind: str, factor: float) -> None:
    named = read(tmp_path, f'time = "t_ns"\na = "x_{unit}"', {"t_ns": STAMP, f"x_{unit}": X})
    beside = read(tmp_path, f'time = "t_ns"\na = {{ column = "x", unit = "{unit}" }}', {"t_ns": STAMP, "x": X})
    same(named.command, STAMP, a=X / factor)
    same(beside.command, STAMP, a=X / factor)
    assert named.kinds == beside.kinds == {"a": kind}


def episodes(**more: object) -> dict[str, Any]:
    group = np.arange(ROWS) // 50  # 0 to 9
    meta = pa.StructArray.from_arrays([pa.array(group)], ["run"])
    columns = {"t_ns": STAMP, "x_m": X, "group": group, "even": pa.array(group % 2 == 0), "meta": meta}
    columns["tags"] = pa.array([[0, one] if one > 2 else [] for one in group.tolist()])
    return {**columns, "name": [f"run{one}" for one in group], "part": (group / 10).astype(np.float32), **more}


AXIS = 'time = "t_ns"\nx = "x_m"'


@pytest.mark.parametrize(
    ("where", "rows"),
    [
        ("name = 'run3'", (150, 200)),
        ("'tags[1]' = 3", (150, 200)),
        ("part = 0.3", (150, 200)),
        ("group = 4, even = true", (200, 250)),
    ],
)
@pytest.mark.parametrize("name", ["log.parquet", "log.csv"])
def test_where_chooses_rows(tmp_path: Path, where: str, rows: tuple[int, int], name: str) -> None:
    """Equality on one column or more, of numbers, texts and booleans."""
    columns = episodes()
    if name == "log.csv":
        del columns["meta"], columns["tags"]
        where = where.replace("'meta.run'", "group").replace("'tags[1]'", "group")
    run = read(tmp_path, f"{AXIS}\nwhere = {{ {where} }}", columns, name)
    same(run.command, STAMP[slice(*rows)], x=X[slice(*rows)])


@pytest.mark.parametrize("kind", [pa.string_view(), pa.dictionary(pa.int32(), pa.string())])
def test_where_compares_text_of_each_type(tmp_path: Path, kind: pa.DataType) -> None:
    """Text has three types: pandas writes large strings and categories, polars views."""
    columns = episodes()
    columns["name"] = pa.array(columns["name"]).cast(kind)
    run = read(tmp_path, f"{AXIS}\nwhere = {{ name = 'run3' }}", columns)
    same(run.command, STAMP[150:200], x=X[150:200])


@pytest.mark.parametrize("name", ["log.parquet", "log.csv"])
def test_rows_that_come_at_a_rate_need_no_stamps(tmp_path: Path, name: str) -> None:
    """Without a column each row is the next; a column of frames says which are missing, and where both clocks begin."""
    columns = {"x_m": nullable(X), "frame": np.arange(ROWS) + 7 + 2 * (np.arange(ROWS) > 99)}
    run = read(tmp_path, 'time = { rate_hz = 400 }\nx = "x_m"', columns, name)
    same(run.command, 2_500_000 * np.arange(ROWS), x=X)
    run = read(tmp_path, 'time = { column = "frame", rate_hz = 400 }\nx = "x_m"', columns, name)
    same(run.command, 2_500_000 * columns["frame"], x=X)


@pytest.mark.parametrize("name", ["log.parquet", "log.csv"])
def test_axes_in_rows_of_their_own_are_put_beside_each_other(tmp_path: Path, name: str) -> None:
    """Rows of one stamp are one row; an axis without one there is absent, and nothing is said of it."""
    stamp, elbow = np.repeat(STAMP[:200], 2), np.tile([True, False], 200)
    keep = np.delete(np.arange(400), [20, 41])  # no elbow of row 10, no wrist of row 20
    columns = pa.table(
        {"t_ns": stamp, "joint": np.where(elbow, "elbow", "wrist"), "goal": ANGLE[:400], "state": X[:400]}
    ).take(keep)

    def axes(column: str) -> str:
        return "\n".join(
            f'{axis} = {{ column = "{column}", unit = "rad", where = {{ joint = "{axis}" }} }}'
            for axis in ("elbow", "wrist")
        )

    sensor = f'[sensors.s]\nfile = "{name}"\ntime = "t_ns"\n{axes("state")}'
    run = read(tmp_path, f'time = "t_ns"\n{axes("goal")}\n{sensor}', columns, name)
    absent = np.arange(200)
    wanted = {
        "elbow": np.where(absent == 10, np.nan, ANGLE[:400:2]),
        "wrist": np.where(absent == 20, np.nan, ANGLE[1:400:2]),
    }
    same(run.command, STAMP[:200], **wanted)
    assert np.isnan(run.sensors["s"].values["elbow"][10]) and not run.notes
    plants = {axis: AxisModel(kind="angle", plant=FirstOrder(time_constant=0.02)) for axis in wanted}
    arm = ArmModel(name="arm", update_period=0.01, delay=0.0, axes=plants)
    with pytest.warns(PumafuseWarning) as said:
        est = fuse(run, FusionConfig(arm=arm, sensors={"s": Sensor(sd=0.1, gate=0.0)}))
    assert all("does not follow the commands" in str(one.message) for one in said)
    assert est.measurements.counts() == {"fused": 398 - 1}  # X has one NaN


def test_commands_between_which_a_controller_interpolates(tmp_path: Path) -> None:
    """They lie on the line, in steps that fit; a pause is none, and where a value is missing none is made up."""
    time = np.concatenate([np.arange(50) * 0.1, 20.0 + np.arange(50) * 0.1])
    value = np.sin(time)
    value[70] = np.nan
    columns = {"t_s": time, "x_m": value}
    run = read(tmp_path, 'time = "t_s"\nx = "x_m"\ninterpolation_ms = 20', columns)
    stamp, x = run.command.stamp / 1e9, run.command.values["x"]
    assert len(stamp) == 2 * (49 * 5 + 1)
    np.testing.assert_allclose(np.diff(stamp)[[0, 1, 244, 245, 246]], [0.02, 0.02, 0.02, 20.0 - 4.9, 0.02], atol=1e-9)
    known = np.isfinite(x)
    np.testing.assert_allclose(x[known], np.interp(stamp[known], time, np.sin(time)), atol=2e-3)
    assert (~known).sum() == 9 and np.isin(value[np.isfinite(value)], x).all()
    many = {"t_s": np.arange(40_000) * 0.1, "x_m": np.zeros(40_000)}
    text = refusal(partial(read, tmp_path, 'time = "t_s"\nx = "x_m"\ninterpolation_ms = 0.1', many))
    assert "makes 40 million commands, more than 30 million" in text
    for step in (100, 100.9):  # the interval itself, as it is written: nothing is between
        whole = read(tmp_path, f'time = "t_s"\nx = "x_m"\ninterpolation_ms = {step}', columns).command
        np.testing.assert_array_equal(whole.stamp / 1e9, np.rint(time * 1e9) / 1e9)
    for step in (102, 0.05):
        text = refusal(partial(read, tmp_path, f'time = "t_s"\nx = "x_m"\ninterpolation_ms = {step}', columns))
        assert f"interpolation_ms = {step} is not between a thousandth of the interval of the commands, 100 ms" in text


def test_what_is_between_commands_is_stamped_to_the_nanosecond() -> None:
    """Also since 1970, where a float has a grain of 256 ns; a row without a stamp has nothing after it."""
    stamp = 1_790_000_000_000_000_117 + 28_000_118 * np.arange(5)
    stamp[2] = NO_STAMP
    finer = Run.from_arrays(stamp, {"x": np.arange(5.0)}).command.interpolated(0.014)
    half = 14_000_059
    wanted = [stamp[0], stamp[0] + half, stamp[1], NO_STAMP, stamp[3], stamp[3] + half, stamp[4]]
    assert finer.stamp.tolist() == wanted


def test_when_rows_came_is_a_column_of_any_unit(tmp_path: Path) -> None:
    """Empty: at its stamp; a command between two has come with the next one; axes with rows of their own have none."""
    columns = {"t_s": [0.0, 0.1, 0.2], "came": pa.array([5.0, None, 230.0]), "x_m": [0.0, 0.1, 0.2]}
    arrived = 'time = "t_s"\narrived = { column = "came", unit = "ms" }\n'
    run = read(tmp_path, f'{arrived}x = "x_m"', columns)
    assert run.command.arrival.tolist() == [5_000_000, 100_000_000, 230_000_000]
    assert any("do not tell when they came: 1, taken as at their stamp" in note for note in run.notes)
    finer = read(tmp_path, f'{arrived}x = "x_m"\ninterpolation_ms = 50', columns).command
    assert finer.arrival.tolist() == [5_000_000, 100_000_000, 100_000_000, 230_000_000, 230_000_000]
    own_rows = 'x = { column = "x_m", where = { came = 5 } }'
    assert "arrived: axes with rows of their own have none" in refusal(
        partial(read, tmp_path, arrived + own_rows, columns)
    )


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("group = 30", ("no row has group = 30", "group goes from 0 to 9")),
        ("name = 'walk'", ("no row has name = 'walk'", "'run0', 'run1'", "…")),
        ("group = 3, even = true", ("no row has group = 3 and even = true", "even goes from false to true")),
        ("group = '3'", ("column 'group' holds int64, never '3'",)),
        ("even = 1", ("column 'even' holds bool, never 1",)),
        ("gruop = 3", ("unknown column 'gruop'", "did you mean 'group'", "t_ns")),
        (f"group = {2**70}", ("command.where", "expected a number")),
    ],
)
def test_where_that_leaves_no_row_is_refused_with_what_there_is(
    tmp_path: Path, where: str, said: tuple[str, ...]
) -> None:
    """One line with the range of the column, some of its values, or its type."""
    columns = episodes()
    del columns["meta"], columns["tags"]
    text = refusal(lambda: read(tmp_path, f"{AXIS}\nwhere = {{ {where} }}", columns, "log.csv"))
    assert all(words in text for words in said), text


def test_only_what_is_asked_for_is_read_of_parquet(tmp_path: Path) -> None:
    """Columns and parts of the file that are not needed may be destroyed: nobody sees it."""
    run = f"{AXIS}\nwhere = {{ group = 3 }}"
    columns = episodes(group=np.arange(ROWS) // 64, image=pa.array([RNG.bytes(1000) for _ in range(ROWS)]))
    read(tmp_path, run, columns)
    path = tmp_path / "log.parquet"
    content = bytearray(path.read_bytes())
    metadata = papq.read_metadata(path)
    for place in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            chunk = metadata.row_group(place).column(number)
            if place != 3 or chunk.path_in_schema not in ("t_ns", "x_m", "group"):
                first = min(chunk.data_page_offset, chunk.dictionary_page_offset or chunk.data_page_offset)
                content[first : first + chunk.total_compressed_size] = b"\xff" * chunk.total_compressed_size
    path.write_bytes(content)
    same(Run.read(tmp_path).command, STAMP[192:256], x=X[192:256])
    (tmp_path / "run.toml").write_text(f'[command]\nfile = "log.parquet"\n{AXIS}', encoding="utf-8")
    assert "log.parquet" in refusal(lambda: Run.read(tmp_path))


def moving(ticks: npt.NDArray[np.float64], rows: int = 7500, rate: float = 125.0) -> tuple[Any, Any]:
    """Stamps [ns] of a clock that ticks as given, and a sine of 5 Hz, on which a second begins and ends alike."""
    time = np.arange(rows) / rate
    stamp = np.floor(time / ticks) * ticks
    return np.rint(stamp * 1e9).astype(np.int64), 0.1 * np.sin(2 * np.pi * 5.0 * time)


@pytest.mark.parametrize(("source", "tick", "rate"), [("command", 0.1, 125.0), ("sensor", 1e6, 10.0)])
def test_a_clock_that_stands_still_is_refused(tmp_path: Path, source: str, tick: float, rate: float) -> None:
    """Whole seconds, one decimal of them, today in float32, or all 0: the line has how many stamps there are."""
    stamp, x = moving(tick, rate=rate)
    fine, _ = moving(1e-9, rate=rate)
    stamps = {"command": (stamp, fine), "sensor": (fine, stamp)}[source]
    columns = {"a_ns": stamps[0], "b_ns": stamps[1], "x_m": x}
    sensor = '[sensors.s]\nfile = "log.parquet"\ntime = "b_ns"\nx = "x_m"'
    text = refusal(lambda: read(tmp_path, f'time = "a_ns"\nx = "x_m"\n{sensor}', columns))
    distinct = len(np.unique(stamp))
    assert f"{distinct} distinct stamp" in text and "7500 rows" in text and "finer" in text
    assert "distinct stamp" in refusal(lambda: Run.from_arrays(stamp, {"x": x}))


@pytest.mark.parametrize(
    ("names", "name"),
    [(("sec_s", "nanosec"), "log.csv"), (("header.stamp.sec", "header.stamp.nanosec"), "log.parquet")],
)
def test_seconds_without_their_nanoseconds_are_refused_with_the_line_to_write(
    tmp_path: Path, names: tuple[str, str], name: str
) -> None:
    """Who writes the line that the refusal has fuses all commands."""
    stamp, x = moving(1e-9)
    columns = {names[0]: stamp // GIGA, "x_m": x, names[1]: stamp % GIGA}
    seconds = f'time = {{ column = "{names[0]}", unit = "s" }}\nx = "x_m"'
    text = refusal(lambda: read(tmp_path, seconds, columns, name))
    assert text.startswith(name) and "60 distinct stamps, one every 1 s, in 7500 rows" in text
    line = text.partition("write ")[2]
    same(read(tmp_path, f'{line}\nx = "x_m"', columns, name).command, stamp, x=x)


@pytest.mark.parametrize(("tick", "rate", "rows"), [(1e-3, 4000.0, 5624), (0.015625, 1000.0, 7019), (1.0, 1.0, 0)])
def test_a_coarse_clock_is_told(tick: float, rate: float, rows: int) -> None:
    """Whole ms at 4 kHz, jiffies, Windows: fused, and the rows that share a stamp are counted."""
    stamp, x = moving(tick, rate=rate)
    x += np.linspace(0.0, 1.0, len(x))  # no two in a row alike
    run = Run.from_arrays(stamp, {"x": x})
    counted = np.count_nonzero(np.diff(stamp) == 0)
    assert abs(counted - rows) < 80
    if rows:
        assert f"command: {counted} rows have the stamp of the row before and another x" in run.notes[0]
    else:
        assert run.notes == ()


def honest() -> dict[str, tuple[npt.NDArray[np.int64], dict[str, npt.NDArray[np.float64]]]]:
    """Logs with many rows a stamp that lose nothing, or that say what a stamp is."""
    seconds = np.repeat(np.arange(100), 10) * GIGA
    level = np.repeat(RNG.normal(0.0, 0.1, 100), 10)
    odd = np.arange(1000) % 2 == 0
    return {
        "rows repeated": (seconds, {"x": level}),
        "a row for each axis": (
            seconds[::5],
            {"x": np.where(odd, X[0], np.nan)[:200], "y": np.where(odd, np.nan, 1.0)[:200]},
        ),
        "measured ten times at each place": (seconds, {"x": level + RNG.normal(0.0, 1e-4, 1000)}),
        "few rows": (np.zeros(9, np.int64), {"x": np.arange(9.0)}),
        "one row": (np.zeros(1, np.int64), {"x": np.zeros(1)}),
        "without stamps": (np.full(50, NO_STAMP), {"x": np.arange(50.0)}),
    }


@pytest.mark.parametrize("case", honest())
def test_honest_rows_with_one_stamp_are_not_refused(case: str) -> None:
    """Repeated rows, rows of an axis each, measurements repeated at a standstill, and logs too short to judge."""
    stamp, values = honest()[case]
    fine = (np.arange(20) * 10_000_000, {axis: np.arange(20.0) for axis in values})
    run = Run.from_arrays(*fine, sensors={"s": (stamp, values)})
    assert len(run.sensors["s"].stamp) == len(stamp)


def timed(time: str) -> str:
    return f'time = {time}\nx = "x_m"'


RECORDED = '[sensors.s]\nfile = "a.mcap"\ntime = "log_time"\nx = "x_m"'
REFUSALS: dict[str, tuple[str, tuple[str, ...]]] = {
    "unit of time for an axis": (axis("x_m").replace('"m"', '"s"'), ("command.x", "'s'", "m, mm, um, cm, inch, rad")),
    "no unit": ('time = "t_ns"\nx = "plain"', ("'plain'", "_mm", "unit = 'mm'")),
    "time without unit": (timed('"plain"'), ("'plain'", "_ms", "unit = 's'")),
    "unknown key of a column": (axis("x_m").replace("unit", "scale"), ("'command.x.scale'", "column, unit")),
    "a rate of 0": (timed("{ rate_hz = 0 }"), ("command.time", "{ rate_hz = 100 }")),
    "a rate of centuries": (timed("{ rate_hz = 1e-8 }"), ("log.parquet", "beyond the year 2115")),
    "rows of nobody": (
        'time = "t_ns"\nx = { column = "x_m", where = { plain = 1000 } }',
        ("no row has plain = 1000", "0 to 499"),
    ),
    "one time in a list": (timed('["t_ns"]'), ("command.time", "['sec', 'nanosec']")),
    "where is a text": ('where = "group"\n' + AXIS, ("command.where", "episode_index = 3")),
    "topic of a table": ('topic = "/servo"\n' + AXIS, ("log.parquet", "no topic", ".mcap", "'where'")),
    "field of a number": ('time = "t_ns"\nx = "x_m.y_m"', ("'x_m.y_m'", "no field 'y_m'", "double")),
    "a whole struct": (axis("pose"), ("'pose'", "structs of position", "not numbers")),
    "field that is not there": (axis("pose.positoin.x"), ("'pose.positoin.x'", "did you mean 'position'")),
    "element too far": (axis("list[2]"), ("'list[2]'", "no row has", "at most 2 elements")),
    "negative element": (axis("list[-1]"), ("'-1'", "0, 1, 2")),
    "element without names": (axis("list[elbow]"), ("'elbow'", "'name'")),
    "unknown name of an element": (axis("joints.position[ellbow]"), ("'ellbow'", "elbow")),
    "bracket without end": (axis("list[0"), ("'list[0'", "without ']'")),
    "a deep path": (axis("pose" + ".position" * 1200), ("unknown field", "accepted: x, y")),
    "an endless name": (axis("x" * 10_000), ("unknown column", "…")),
    "booleans": (axis("yes"), ("'yes'", "bool", "not numbers")),
    "nanoseconds beyond a second": (timed('["plain", "t_ns"]'), ("'t_ns'", "row 1", "999999999")),
    "a recording": (f"{AXIS}\n{RECORDED}", ("a.mcap",)),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_wrong_source_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    command, named = REFUSALS[case]
    names, positions = joint_states()
    joints = pa.StructArray.from_arrays([names, positions], ["name", "position"])
    columns = {"t_ns": STAMP, "x_m": X, "plain": np.arange(ROWS), "half": np.full(ROWS, 0.5), "joints": joints}
    more = {"pose": pose(), "list": pa.array([[0.0, 1.0]] * ROWS), "yes": pa.array([True] * ROWS)}
    text = refusal(lambda: read(tmp_path, command, {**columns, **more}))
    assert all(words in text for words in named), text
    assert len(text) < 700


def test_a_sensor_of_a_regular_clock_is_put_on_its_own_ticks(tmp_path: Path) -> None:
    """Its stamps jitter by a sixth of its period, which nobody names; without ticks it is refused in one line."""
    rng = np.random.default_rng(12)
    ticks = np.flatnonzero(rng.random(900) < 0.95)
    true = 17.0 + ticks / 72.0
    stamps = {
        "jitter": true + rng.normal(0.0, 1.0 / 72.0 / 6.0, len(ticks)),
        "none": 17.0 + np.sort(rng.random(900) * 12),
    }
    (tmp_path / "host.csv").write_text("t_s,x_mm\n" + "".join(f"{t},{t}\n" for t in range(17, 30)), encoding="utf-8")
    for name, stamp in stamps.items():
        table = np.column_stack([stamp, rng.normal(0.0, 1.0, len(stamp))])
        np.savetxt(tmp_path / "seen.csv", table, "%.9f", ",", header="t_s,x_mm", comments="")
        described = (
            '[command]\nfile = "host.csv"\ntime = "t_s"\nx = "x_mm"\n'
            '[sensors.eye]\nfile = "seen.csv"\ntime = "t_s"\nclock = "regular"\nx = "x_mm"\n'
        )
        (tmp_path / "run.toml").write_text(described, encoding="utf-8")
        if name == "none":
            assert "do not come on ticks" in refusal(lambda: Run.read(tmp_path))
            continue
        got = Run.read(tmp_path).sensors["eye"].stamp
        assert np.abs(np.diff(got) / GIGA - np.diff(true)).max() < 1e-5
        assert np.abs(got / GIGA - true).max() < 4.0 / 72.0 / 6.0 / np.sqrt(len(ticks)) * 2.5  # slope and median

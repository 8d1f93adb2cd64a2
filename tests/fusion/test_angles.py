"""Axes that are angles: in rad and in degrees the same, mixed with lengths, within a turn, in every file."""

import json
import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as papq
import pytest

import pumafuse as pf
from executable import pumafuse
from pumafuse.cli.tables import outcome_table
from pumafuse.fusion import results
from pumafuse.units import of_kind, unwrapped, wraps

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
DEG = math.pi / 180.0
T = 0.02
ARM = """
name = "bench"
update_period_ms = 20.0
delay_ms = 30.0
[validity]
max_speed_{fast} = 1000.0
[axes.a]
{kind}plant = "second-order"
natural_frequency_rad_s = 40.0
damping = 0.9
gain = {{ slope_s_{si} = 0.1, intercept = 0.97 }}
gain_recovery_ms = 120.0
[axes.b]
{kind}plant = "first-order"
time_constant_ms = 50.0
"""
FUSION = """
arm = "arm.toml"
[start]
offset_sd_{u} = 2.0
[process]
input_noise_{u}_rtHz = 0.1
drift_{u}_rts = 0.3
[process.b]
maneuver_noise_{u}_rtHz_per_{fast} = {per_fast}
disturbance_sd_{u} = 0.4
disturbance_time_ms = 200.0
[sensors.eye]
sd_{u} = {{ a = 0.2, b = 0.3 }}
latency_ms = 15.0
latency_sd_ms = 2.0
bias_sd_{u} = 1.0
gate = 4.0
gate_rows = true
[sensors.gauge]
sd_{u} = 0.1
bias_drift_sd_{u} = 0.2
bias_time_s = 3.0
"""


def motion(rows: int, seed: int = 3) -> np.ndarray:
    """Commands that go to and fro, in the unit of the file."""
    rng = np.random.default_rng(seed)
    return np.round(20.0 * np.sin(np.arange(rows) * T * 2.0) + np.cumsum(rng.normal(0.0, 0.05, rows)), 6)


def write_run(folder: Path, unit: str, rows: int = 300) -> None:
    """A run with two sensors and a reference."""
    rng, time = np.random.default_rng(7), np.arange(rows) * T
    u = motion(rows)
    columns = {"a": u, "b": 0.5 * u}

    def table(name: str, at: np.ndarray, sd: float) -> None:
        seen = {
            f"{axis}_{unit}": np.round(np.interp(at - 0.08, time, value) + rng.normal(0.0, sd, len(at)), 6)
            for axis, value in columns.items()
        }
        pacsv.write_csv(pa.table({"time_s": at, **seen}), folder / f"{name}.csv")

    table("commands", time + 0.08, 0.0)
    table("eye", np.arange(10, 560) * 0.01, 0.2)
    table("gauge", np.arange(10, 200) * 0.03, 0.1)
    table("truth", time + 0.001, 0.02)
    sources = [("command", "commands"), ("sensors.eye", "eye"), ("sensors.gauge", "gauge"), ("reference", "truth")]
    text = "".join(
        f'[{key}]\nfile = "{name}.csv"\ntime = "time_s"\na = "a_{unit}"\nb = "b_{unit}"\n' for key, name in sources
    )
    (folder / "run.toml").write_text(text)


def write_config(folder: Path, angle: bool) -> None:
    """The same arm and filter, with each mm for a degree."""
    fast, si = ("deg_s", "rad") if angle else ("m_s", "m")
    kind = 'kind = "angle"\n' if angle else ""
    per_fast = 0.3 / 1000.0 if angle else 0.3
    slope_per_unit = 0.1 / DEG if angle else 0.1 * 1e3  # s per rad, so that a degree does what a mm does
    arm = ARM.format(fast=fast, si=si, kind=kind).replace(
        f"slope_s_{si} = 0.1", f"slope_s_{si} = {slope_per_unit * 1e-3!r}"
    )
    (folder / "arm.toml").write_text(arm)
    (folder / "fusion.toml").write_text(FUSION.format(u="deg" if angle else "mm", fast=fast, per_fast=per_fast))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One run in mm and in degrees, each with arm and configuration."""
    found: dict[str, Path] = {}
    for unit in ("mm", "deg"):
        found[unit] = tmp_path_factory.mktemp(unit)
        write_run(found[unit], unit)
        write_config(found[unit], unit != "mm")
    return found


def fused(folder: Path, **options: Any) -> pf.Estimates:
    return pf.fuse(pf.Run.read(folder), pf.FusionConfig.load(folder / "fusion.toml"), **options)


def test_an_angle_is_filtered_like_a_length(folders: dict[str, Path]) -> None:
    """With each mm for a degree, every estimate and every innovation is the same number in its own unit."""
    length, angle = fused(folders["mm"]), fused(folders["deg"])
    for axis in "ab":
        for name in pf.AxisEstimate.FIELDS:
            inside, wanted = getattr(angle[axis], name) / DEG, getattr(length[axis], name) * 1e3
            np.testing.assert_allclose(inside, wanted, rtol=1e-8, atol=1e-9)
    assert (angle.measurements.outcome == length.measurements.outcome).all()
    np.testing.assert_allclose(angle.measurements.nis, length.measurements.nis, rtol=1e-7)


def test_files_and_screens_have_the_units_of_the_axis(folders: dict[str, Path], tmp_path: Path) -> None:
    """Tables, summary, configuration and screen of an angle say deg, with the numbers that mm have for a length."""
    shown: dict[str, str] = {}
    for unit in ("mm", "deg"):
        given = ["fuse", folders[unit], "-c", folders[unit] / "fusion.toml", "-o", tmp_path / unit]
        shown[unit] = pumafuse(*given).stdout
    words = {unit: re.sub(r"─+|\S*/\S*", "", text).replace("deg", "mm").split() for unit, text in shown.items()}
    assert words["deg"][1:] == words["mm"][1:]  # but for the run's name
    for file in ("estimates", "measurements", "reference"):
        tables = {unit: papq.read_table(tmp_path / unit / f"{file}.parquet") for unit in shown}
        names = [of_kind(name, "angle") for name in tables["mm"].column_names]
        assert tables["deg"].column_names == names
        for one, other in zip(tables["mm"].columns, tables["deg"].columns, strict=True):
            if str(one.type) == "double":
                np.testing.assert_allclose(one.to_numpy(), other.to_numpy(), rtol=1e-7, atol=1e-9)
    summaries = {unit: json.loads((tmp_path / unit / "summary.json").read_text()) for unit in shown}
    length, angle = (summaries[unit]["axes"]["a"] for unit in shown)
    assert angle["kind"] == "angle" and length["kind"] == "length"
    assert angle["score"]["rmse_deg"] == pytest.approx(length["score"]["rmse_mm"], rel=1e-8)
    assert angle["score"]["velocity_rmse_deg_s"] == pytest.approx(length["score"]["velocity_rmse_mm_s"], rel=1e-8)
    for one, key in ((length, "_mm"), (angle, "_deg")):
        eye = one["sensors"]["eye"]
        assert {f"innovation_rms{key}", f"innovation_sd{key}", f"bias{key}", f"bias_sd{key}"} <= set(eye)
        assert set(eye["skill"]["filter"]) == {f"rms{key}", f"median{key}"}
    assert summaries["deg"]["validity"]["commanded_speed_deg_s"] > 10.0
    assert summaries["deg"]["validity"]["commanded_speed_m_s"] is None
    result = results.read(tmp_path / "deg")
    again = result.scores(result.reference)
    assert again["a"].rmse_deg == pytest.approx(angle["score"]["rmse_deg"], rel=1e-9)
    assert pf.FusionConfig.load(tmp_path / "deg" / "fusion.toml") == fused(folders["deg"]).config
    compared = json.loads(pumafuse("compare", tmp_path / "deg", tmp_path / "mm", "--json").stdout)
    assert compared[0]["axes"]["a"]["rmse_deg"] == pytest.approx(compared[1]["axes"]["a"]["rmse_mm"], rel=1e-8)


BOTH = {
    "arm": {
        "name": "both",
        "update_period_ms": 20.0,
        "delay_ms": 30.0,
        "axes": {
            "x": {"plant": "first-order", "time_constant_ms": 50.0},
            "yaw": {"kind": "angle", "plant": "first-order", "time_constant_ms": 40.0},
        },
    },
    "process": {"input_noise_mm_rtHz": 0.5, "input_noise_deg_rtHz": 0.7},
    "sensors": {"camera": {"sd_mm": 0.3, "sd_deg": 0.1, "bias_sd_deg": 2.0, "turn_deg": 360.0}},
}


def mixed(turns: float = 0.0) -> tuple[pf.Run, pf.FusionConfig]:
    """An arm with x and yaw, and a camera that sees both; yaw goes round, measured within a turn or not."""
    rng, time = np.random.default_rng(11), np.arange(150) * T
    x, yaw = 30.0 * np.sin(time), 150.0 + 180.0 * time
    seen = np.interp(time - 0.09, time, yaw) + rng.normal(0.0, 0.1, 150)
    if turns:
        seen = (seen + 180.0) % 360.0 - 180.0
    run = pf.Run.from_arrays(
        time,
        {"x": x / 1e3, "yaw": yaw * DEG},
        {
            "camera": (
                time + 0.003,
                {"x": (np.interp(time - 0.08, time, x) + rng.normal(0.0, 0.3, 150)) / 1e3, "yaw": seen * DEG},
            )
        },
        reference=(time, {"x": x / 1e3, "yaw": yaw * DEG}),
    )
    return run, pf.FusionConfig.parse(BOTH)


def test_one_run_may_have_both(tmp_path: Path) -> None:
    """Columns, keys and tables of each axis are in its own unit, and a configuration reads back."""
    run, config = mixed()
    est = pf.fuse(run, config)
    summary = results.write(est, tmp_path / "out", force=False)
    table = papq.read_table(tmp_path / "out" / "measurements.parquet").to_pydict()
    by_axis = {axis: [n for n, one in enumerate(table["axis"]) if one == axis] for axis in ("x", "yaw")}
    assert all(table["value_deg"][n] is None and table["value_mm"][n] is not None for n in by_axis["x"])
    assert all(table["value_mm"][n] is None and table["value_deg"][n] is not None for n in by_axis["yaw"])
    assert {"x.position_mm", "yaw.position_deg"} <= set(
        papq.read_table(tmp_path / "out" / "estimates.parquet").column_names
    )
    assert [len(outcome_table(summary, kind).rows) for kind in ("length", "angle")] == [1, 1]
    assert pf.FusionConfig.load(tmp_path / "out" / "fusion.toml") == config
    assert config.sensors["camera"].sd == {"x": 0.3e-3, "yaw": pytest.approx(0.1 * DEG)}
    assert config.process["yaw"].input_noise == pytest.approx(0.7 * DEG)
    assert config.start.offset_sd_of("yaw") == pytest.approx(5.0 * DEG)
    again, score = (one.axes["yaw"].score for one in (results.read(tmp_path / "out").summary, summary))
    assert msgspec.structs.asdict(again) == pytest.approx(msgspec.structs.asdict(score), rel=1e-13)  # by way of degrees


@pytest.mark.parametrize("mode", [{"mode": "smoothed"}, {"engine": "filterpy"}])
def test_a_sensor_within_a_turn_is_as_good_as_one_that_counts_them(mode: dict[str, Any]) -> None:
    """Estimates are those of the same measurements without the jumps by 360°, and so is the skill."""
    whole, within = (pf.fuse(*mixed(turns), **mode) for turns in (0.0, 1.0))
    assert np.ptp(within.measurements.of("camera", "yaw").value) <= 360.0 * DEG < np.ptp(within["yaw"].position)
    sd = whole["yaw"].position_sd
    assert np.max(np.abs(within["yaw"].position - whole["yaw"].position) / sd) < 1e-8
    assert (within.measurements.outcome == 0).all()
    one, other = (pf.summarise(est).axes["yaw"].sensors["camera"].skill for est in (whole, within))
    assert one is not None and other is not None
    for mine, its in zip(msgspec.structs.astuple(one)[1:], msgspec.structs.astuple(other)[1:], strict=True):
        assert its.rms == pytest.approx(mine.rms, rel=1e-6)
    shown = within.measured_positions("camera", "yaw").value
    np.testing.assert_allclose(shown, whole.measured_positions("camera", "yaw").value, atol=1e-9)


def within(yaw: np.ndarray) -> np.ndarray:
    """Angles from -180 to 180."""
    return (yaw + 180.0) % 360.0 - 180.0


@pytest.mark.parametrize(("rate", "noise", "turns"), [(-200.0, 0.3, 2), (45.0, 0.3, 1), (600.0, 0.0, 1)])
def test_angles_that_begin_anew_are_known(rate: float, noise: float, turns: int) -> None:
    """Slowly and fast, also where noise goes to and fro across the turn: every row in which a turn is counted.

    Some drivers count two turns.
    """
    time = np.arange(500) * T
    whole = 100.0 + rate * time + 25.0 * np.sin(3.0 * time) + noise * np.random.default_rng(5).normal(size=500)
    rows = wraps(turns * within(whole) * DEG)
    counted = np.flatnonzero(np.diff(np.floor((whole + 180.0) / 360.0))) + 1
    assert rows.tolist() == counted.tolist() and len(rows) > 0
    np.testing.assert_allclose(np.diff(unwrapped(within(whole) * DEG)), np.diff(whole) * DEG, atol=1e-9)
    assert len(wraps(whole * DEG)) == 0


@pytest.mark.parametrize(
    "angle",
    [
        np.repeat([-179.0, 179.0], 50) * np.repeat([1.0, 0.5], 50),
        np.repeat(np.random.default_rng(3).uniform(-180.0, 180.0, 60), 5),
        np.full(50, np.nan),
    ],
)
def test_steps_are_no_turns(angle: np.ndarray) -> None:
    """A servo that is commanded from end to end, or at random."""
    assert len(wraps(angle * DEG)) == 0


def turned(folder: Path, how: str, command: str = "", sensor: str = "") -> pf.Run:
    """A table that turns by 90 deg/s, commanded, measured 100 ms late from 2 s on and scored within a turn or not."""
    folder.mkdir()
    time = np.arange(500) * T
    yaw, noise = 170.0 + 90.0 * time, np.random.default_rng(4).normal(0.0, 0.1, 500)
    shown = within if how == "within" else np.asarray
    tables = {"commands": yaw, "eye": np.maximum(yaw - 9.0, 170.0) + noise, "truth": np.maximum(yaw - 9.0, 170.0)}
    for name, values in tables.items():
        first = 100 if name == "eye" else 0
        pacsv.write_csv(pa.table({"t_s": time[first:], "yaw_deg": shown(values)[first:]}), folder / f"{name}.csv")
    of = {"command": ("commands", command), "sensors.eye": ("eye", sensor), "reference": ("truth", sensor)}
    (folder / "run.toml").write_text(
        "".join(
            f'[{key}]\nfile = "{name}.csv"\ntime = "t_s"\nyaw = {{ column = "yaw_deg"{more} }}\n'
            for key, (name, more) in of.items()
        )
    )
    return pf.Run.read(folder)


def turning(turn_deg: float = 0.0) -> pf.FusionConfig:
    """A table that turns and a sensor of it."""
    axes = {"yaw": {"kind": "angle", "plant": "first-order", "time_constant_ms": 40.0}}
    arm = {"name": "table", "update_period_ms": 20.0, "delay_ms": 30.0, "axes": axes}
    sensors = {"eye": {"sd_deg": 0.1, "turn_deg": turn_deg}}
    return pf.FusionConfig.parse({"arm": arm, "process": {"input_noise_deg_rtHz": 0.3}, "sensors": sensors})


def test_columns_within_a_turn_go_on_beside_the_commands(tmp_path: Path) -> None:
    """Wherever a source begins, with ``turn_deg`` it gives what one gives that counts its turns."""
    whole, made = (
        turned(tmp_path / "whole", "whole"),
        turned(tmp_path / "made", "within", ', unit = "deg", turn_deg = 360.0', ', unit = "deg", turn_deg = 360.0'),
    )
    for one, other in zip(
        (whole.command, *whole.sensors.values(), whole.reference),
        (made.command, *made.sensors.values(), made.reference),
        strict=True,
    ):
        np.testing.assert_allclose(other.values["yaw"], one.values["yaw"], atol=1e-9)
    config = turning()
    first, second = (pf.fuse(run, config) for run in (whole, made))
    np.testing.assert_allclose(first["yaw"].position, second["yaw"].position, atol=1e-9)
    assert np.ptp(first["yaw"].position) > 600.0 * DEG


def test_two_rejected_measurements_on_both_sides_of_the_turn_agree() -> None:
    """A slip by about half a turn is seen as +179.5° and −179.5°: one degree apart, so the second is believed."""
    _, config = mixed()
    time = np.arange(100) * T
    yaw = np.full(100, 10.0)
    seen = yaw.copy()
    seen[50:] = np.where(np.arange(50) % 2, -169.7, 189.7)  # one direction, logged in two ways
    still = pf.Run.from_arrays(time, {"x": 0.0 * time, "yaw": yaw * DEG}, {"camera": (time, {"yaw": seen * DEG})})
    sensor = msgspec.structs.replace(config.sensors["camera"], gate=5.0, bias_sd=0.0, sd=0.5 * DEG)
    config = msgspec.structs.replace(config, sensors={"camera": sensor})
    for engine in ("compiled", "filterpy"):
        est = pf.fuse(still, config, engine=engine)
        outcome = est.measurements.of("camera", "yaw").outcome
        assert outcome[50:53].tolist() == [int(pf.Outcome.REJECTED), int(pf.Outcome.REACQUIRED), int(pf.Outcome.FUSED)]


@pytest.mark.parametrize(
    ("sd", "gate_rows", "wanted"),
    [
        ({"yaw": 1e-3}, None, False),
        (1e-3, None, True),
        ({"yaw": 1e-3}, True, True),
    ],
)
def test_an_encoder_for_each_axis_is_gated_apart(
    sd: float | dict[str, float], gate_rows: bool | None, wanted: bool
) -> None:
    """A sensor of angles alone rejects one axis, one of lengths the row, unless the configuration says otherwise."""
    assert pf.Sensor(sd=sd, gate_rows=gate_rows).gates_rows(mixed()[1].arm) is wanted


WRONG = [  # with the keys of angles, what is replaced by what, and what is said
    ("sd_deg = { a", "sd_mm = { a", "sensors.eye.sd_mm: no axis of the arm is an angle|sensors.eye.sd_mm.*give sd_deg"),
    ("input_noise_deg_rtHz", "input_noise_mm_rtHz", "input_noise_mm_rtHz.*input_noise_deg_rtHz"),
    ("sd_deg = { a", "# sd_deg = { a", "'sensors.eye.sd_deg' is missing; accepted: sd_deg, .*bias_sd_deg"),
    ("sd_deg = { a = ", "sd_deg = { a = 10000000000000", r"sensors.eye.sd_deg: must be <= 5.72958e\+10"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_a_unit_of_the_other_kind_is_refused_with_the_right_one(
    folders: dict[str, Path], old: str, new: str, message: str, tmp_path: Path
) -> None:
    """One line that names the key and the one to give."""
    (tmp_path / "arm.toml").write_text((folders["deg"] / "arm.toml").read_text())
    text = (folders["deg"] / "fusion.toml").read_text()
    assert old in text
    (tmp_path / "fusion.toml").write_text(text.replace(old, new))
    with pytest.raises(pf.ConfigError, match=message) as caught:
        pf.FusionConfig.load(tmp_path / "fusion.toml")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("unit", "right", "wrong", "said"),
    [
        ("deg", "max_speed_deg_s", "max_speed_m_s", r"validity\.max_speed_m_s: no axis .*; give max_speed_deg_s$"),
        ("deg", "delay_ms = 30.0", "delay_ms = 2e7", r"delay_ms: must be <= 1e\+07$"),
    ],
)
def test_a_limit_of_the_other_kind_and_a_number_out_of_bounds_are_refused(
    folders: dict[str, Path], unit: str, right: str, wrong: str, said: str, tmp_path: Path
) -> None:
    """A limit would never be passed; and a bound has the unit of its key: 0.001 ms is 1e-6 s."""
    text = (folders[unit] / "arm.toml").read_text()
    assert f"\n{right}" in text
    (tmp_path / "arm.toml").write_text(text.replace(right, wrong))
    with pytest.raises(pf.ConfigError, match=rf"arm\.toml: {said}"):
        pf.ArmModel.load(tmp_path / "arm.toml")

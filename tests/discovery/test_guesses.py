"""First guesses: where an arm starts, and which gate its sensors need."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from discovery.test_survey import write, written
from executable import pumafuse
from pumafuse.arrays import FloatArray
from pumafuse.discovery.guesses import guess
from pumafuse.discovery.survey import survey

T = 0.02  # s
LATE = 0.12  # s


def log(folder: Path, position: FloatArray, command: FloatArray) -> Path:
    """A table of an axis in mm."""
    time = T * np.arange(len(command))
    write(folder / "gantry.csv", {"time_s": time, "target.z_mm": command, "actual.z_mm": position.round(6)})
    return folder / "gantry.csv"


def mount(folder: Path, t: FloatArray, **tables: tuple[FloatArray, int]) -> Path:
    """A folder of tables of an axis [mm], each of every n-th row."""
    folder.mkdir()
    for name, (value, every) in tables.items():
        write(folder / f"{name}.csv", {"time_s": t[::every], "z_mm": value[::every].round(6)})
    return folder


def swings(count: int = 900) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times; commands that rest for a second at 40 mm, then swing; where a lag of first order leads from 40 mm [mm]."""
    t = T * np.arange(count)
    u = 40.0 + 25.0 * np.sin(np.maximum(t - 1.0, 0.0) * 1.3)
    z = np.full(count, 40.0)
    for k in range(1, count):
        z[k] = u[k - 1] + (z[k - 1] - u[k - 1]) * np.exp(-T / LATE)
    return t, u, z


@pytest.mark.parametrize("away", [-35.0, 0.05])
def test_an_arm_that_starts_elsewhere_starts_where_its_sensor_says(away: float, tmp_path: Path) -> None:
    """35 mm below its first command: run.toml has the level; less than the noise and lag explain: not."""
    t, u, z = swings()
    z = z + away * np.exp(-t / LATE) + np.random.default_rng(1).normal(0.0, 0.02, len(t))
    run, _ = written(survey(log(tmp_path, z, u)), tmp_path / "out")
    if abs(away) < 1.0:
        assert run.start == {}
        return
    assert run.start["z"] == pytest.approx(1e-3 * (40.0 + away), abs=5e-4)


@pytest.mark.long
def test_one_command_follows_an_arm_that_homes(tmp_path: Path) -> None:
    """80 mm above its first command: no measurement is rejected, and the lag is right to 1 ms."""
    t, u, z = swings()
    z = z + 80.0 * np.exp(-t / LATE) + np.random.default_rng(3).normal(0.0, 0.02, len(t))
    pumafuse("fuse", log(tmp_path, z, u), "-o", tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["axes"]["z"]["sensors"]["actual"]["outcomes"] == {"fused": 900}
    arm = pf.ArmModel.load(tmp_path / "out" / "arm.toml")
    assert arm.lag_of("z") == pytest.approx(LATE, abs=1e-3)


def jerks(z: FloatArray) -> FloatArray:
    """An arm that jumps by 0.5 mm and comes back, twice."""
    z = z.copy()
    z[[300, 640]] += 0.5
    return z


def glitch(z: FloatArray) -> FloatArray:
    """A sensor that says 0 three times in a row, once."""
    z = z.copy()
    z[420:423] = 0.0
    return z


def outliers(z: FloatArray) -> FloatArray:
    """One value in fifty is 3 mm off."""
    z = z.copy()
    z[25::50] += 3.0
    return z


@pytest.mark.parametrize(("spoilt", "gate"), [(jerks, 0.0), (glitch, 50.0), (outliers, 5.0)])
def test_gates_are_for_what_leaves_its_neighbours_far(spoilt: object, gate: float, tmp_path: Path) -> None:
    """Jerks of an arm are none of its sensor's faults."""
    assert callable(spoilt)
    t, u, z = swings()
    value = spoilt(z + np.random.default_rng(2).normal(0.0, 0.01, len(t)))
    _, sensors = guess(survey(log(tmp_path, value, u)))
    assert sensors["actual"].gate == gate


@pytest.mark.parametrize(("off", "gate"), [(0.0, 0.0), (1.5, 5.0)])
def test_an_encoder_at_rest_that_flickers_by_a_count_needs_no_gate(off: float, gate: float, tmp_path: Path) -> None:
    """It rests in most rows, and has no noise; one value that was written otherwise tells nothing of its counts."""
    t = T * np.arange(1200)
    u = 40.0 + 15.0 * (1.0 - np.cos(np.clip(t - 1.0, 0.0, 5.0) * 2.0))
    z, count = np.interp(t - LATE, t, u), 0.02
    z = np.round(z / count) * count
    z[500] += 2e-6
    z[600::80] += count
    z[560::40] += off
    _, sensors = guess(survey(log(tmp_path, z, u)))
    assert sensors["actual"].gate == gate


@pytest.mark.long
def test_a_camera_whose_latency_steps_tells_nothing_of_the_arms_lag(tmp_path: Path) -> None:
    """40 ms late, from 18 s on 90 ms: said, with its sd, and the arm's lag is right to 2 ms beside an encoder.

    In parts, as it advises, the latency is that of each.
    """
    rng = np.random.default_rng(4)
    t, u, z = swings(1800)
    late = np.where(t < 18.0, 0.04, 0.09)
    seen = np.interp(t - late, t, z) + rng.normal(0.0, 0.3, len(t))
    encoder = z + rng.normal(0.0, 0.05, len(t))
    folder = mount(tmp_path / "mount", t, command=(u, 1), encoder=(encoder, 1), camera=(seen, 3))
    found = survey(folder)
    _, sensors = guess(found)
    pair = sensors["camera"].pair
    assert pair is not None
    (doubt,) = pair.alignment.doubts("camera", pair.other)
    assert doubt.startswith("the latency of camera steps from ")
    assert [float(one) for one in re.findall(r"[\d.]+", doubt)][:3] == pytest.approx([40.0, 90.0, 18.0], abs=2.0)
    assert pair.alignment.unsteadiness == pytest.approx(0.035, abs=0.002)  # RMS of 0 and 50 ms
    pumafuse("fuse", folder, "-o", tmp_path / "out")
    assert pf.ArmModel.load(tmp_path / "out" / "arm.toml").lag_of("z") == pytest.approx(LATE, abs=2e-3)
    for part, latency in (((None, 18.0), 0.04), ((18.0, None), 0.09)):
        _, sensors = guess(replace(found, run=found.run.between(*part)))
        assert sensors["camera"].latency == pytest.approx(latency, abs=2e-3)


def test_latencies_that_are_known_are_not_looked_for(tmp_path: Path) -> None:
    """That of a camera beside an encoder, which is otherwise compared with it."""
    t, u, z = swings(1800)
    found = survey(mount(tmp_path / "mount", t, command=(u, 1), encoder=(z, 1), camera=(z, 3)))
    camera = guess(found, {"encoder": 0.002, "camera": 0.05})[1]["camera"]
    assert camera.latency == pytest.approx(0.048, abs=1e-12)
    assert camera.pair is None


@pytest.mark.parametrize("seed", [0, 1])
def test_chance_makes_no_sensor_the_earliest(seed: int, tmp_path: Path) -> None:
    """A camera of a sixth of the rows and ten times the noise: the time of all is the encoder's, not the camera's."""
    rng = np.random.default_rng(seed)
    t, u, z = swings(1800)
    encoder, camera = (z + rng.normal(0.0, sd, len(t)) for sd in (0.05, 0.5))
    folder = mount(tmp_path / "mount", t, command=(u, 1), encoder=(encoder, 1), camera=(camera, 6))
    _, sensors = guess(survey(folder))
    assert sensors["encoder"].latency == 0.0


def test_an_axis_that_a_sensor_never_tells_does_not_refuse_the_others(tmp_path: Path) -> None:
    """A run.toml may name a column that has no number in any row."""
    t, command, position = swings()
    rows = {"time_s": t, "u_mm": command, "v_mm": command, "x_mm": position.round(6), "y_mm": np.full(len(t), np.nan)}
    write(tmp_path / "log.csv", rows)
    tables = [
        f'[{table}]\nfile = "log.csv"\ntime = "time_s"\nx = "{x}_mm"\ny = "{y}_mm"\n'
        for table, x, y in (("command", "u", "v"), ("sensors.eye", "x", "y"))
    ]
    (tmp_path / "run.toml").write_text("".join(tables), encoding="utf-8")
    arm, sensors = guess(survey(tmp_path))
    assert arm.axes["x"].follows == "eye" and arm.axes["y"].follows == ""
    assert sensors["eye"].gate == 0.0

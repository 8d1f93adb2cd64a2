"""`pumafuse identify` and `verify` by the executable on joints: angles in degrees, also beside a length."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest

import pumafuse as pf
from executable import pumafuse

pytestmark = pytest.mark.long  # the same numbers by Python: tests/identification/test_angles.py

DEGREE = math.pi / 180.0
PERIOD, DELAY, SLOPE, INTERCEPT, NOISE = 0.02, 0.05, 0.1, 0.93, 0.002  # s, s, s/rad, 1, degrees
PLANTS = {
    "shoulder": pf.FirstOrder(time_constant=0.04),
    "wrist": pf.SecondOrder(natural_frequency=60.0, damping=0.9),
}
TICKS = np.arange(300)
SAMPLED = np.arange(0.0, 6.2, 0.004)  # s
RAIL = '[axes.rail]\nplant = "first-order"\ntime_constant_ms = 40.0\n'


def gain(step: float) -> float:
    """K of a step in degrees."""
    return SLOPE * abs(step) * DEGREE / PERIOD + INTERCEPT


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign in degrees, and the arm identified from it."""
    made, rng, times = tmp_path_factory.mktemp("joints"), np.random.default_rng(3), np.arange(-4, 60) * 0.005
    (made / "steps").mkdir()
    listed, sampled = ["trial,axis,step_deg,speed_deg_s"], ["trial,time_s,position_deg"]
    for axis, plant in PLANTS.items():
        for step in (0.2, -0.5, 1.0, -2.0) * 3:
            listed.append(f"{len(listed)},{axis},{step},{abs(step) / PERIOD}")
            answer = plant.step_response(times - DELAY - 0.002 * rng.standard_normal())
            position = gain(step) * step * answer + NOISE * rng.standard_normal(len(times))
            rows = zip(times.tolist(), position.tolist(), strict=True)
            sampled += [f"{len(listed) - 1},{time:.4f},{value:.6f}" for time, value in rows]
    (made / "steps" / "trials.csv").write_text("\n".join(listed) + "\n")
    (made / "steps" / "samples.csv").write_text("\n".join(sampled) + "\n")
    assert pumafuse("identify", made / "steps", "-o", made / "arm.toml", "--tolerance", 0.2).stderr == ""
    return made


@pytest.fixture(scope="module")
def run(folder: Path) -> Path:
    """White noise of 1 degree on the joints from 30 and -10 degrees, and of 4 mm on a rail, superposed by hand."""
    made, rng = folder / "run", np.random.default_rng(8)
    made.mkdir()
    time = TICKS * PERIOD
    commands, measured = {"time_s": time}, {"time_s": SAMPLED}
    axes = {**dict.fromkeys(PLANTS, (1.0, "deg")), "rail": (4.0, "mm")}
    for (axis, (size, unit)), start in zip(axes.items(), (30.0, -10.0, 500.0), strict=True):
        command = start + size * rng.integers(0, 2, len(TICKS))
        command[:2] = start + size, start
        plant = PLANTS.get(axis, pf.FirstOrder(time_constant=0.04))
        position = np.full(len(SAMPLED), start)
        for at, step in zip(time, np.diff(command, prepend=start), strict=True):
            factor = 1.0 if axis == "rail" else gain(step)
            position += factor * step * plant.step_response(SAMPLED - at - DELAY)
        commands[f"{axis}_{unit}"] = command
        measured[f"{axis}_{unit}"] = position + 10.0 * NOISE * rng.standard_normal(len(SAMPLED))
    for name, columns in (("commands", commands), ("encoder", measured)):
        pacsv.write_csv(pa.table(columns), made / f"{name}.csv")
    columns = 'time = "time_s"\nshoulder = "shoulder_deg"\nwrist = "wrist_deg"\nrail = "rail_mm"\n'
    tables = f'[command]\nfile = "commands.csv"\n{columns}\n[sensors.encoder]\nfile = "encoder.csv"\n{columns}'
    (made / "run.toml").write_text(f'name = "noise"\n\n{tables}')
    arm = (folder / "arm.toml").read_text().replace("[axes.shoulder]", f"{RAIL}\n[axes.shoulder]", 1)
    (folder / "mixed.toml").write_text(arm)
    return made


def test_verify_shows_each_axis_in_its_unit(folder: Path, run: Path, tmp_path: Path) -> None:
    """A table for the rail and one for the joints, on the page too, with the numbers of the JSON: the noise is left."""
    options = ("verify", run, "--arm", folder / "mixed.toml", "--start", "wrist=-10", "--start", "rail=500")
    found = {one["axis"]: one for one in json.loads(pumafuse(*options, "--json").stdout)}
    assert {axis: one["kind"] for axis, one in found.items()} == {
        "shoulder": "angle",
        "wrist": "angle",
        "rail": "length",
    }
    units = {"shoulder": "deg", "wrist": "deg", "rail": "mm"}
    shown = pumafuse(*options, "--report", tmp_path / "page").stdout
    assert shown.index("mm RMS") < shown.index(" rail ") < shown.index("deg RMS") < shown.index(" shoulder ")
    for axis, one in found.items():
        unit = units[axis]
        rms, best = one["model"][f"rms_{unit}"], one["best_in_class"]["fit"][f"rms_{unit}"]
        assert rms == pytest.approx(10.0 * NOISE, rel=0.1)
        assert one[f"amplitude_{unit}"] == pytest.approx({"deg": 1.0, "mm": 4.0}[unit])
        (line,) = [line.split() for line in shown.splitlines() if f" {axis} " in line and "encoder" in line]
        assert {f"{rms:.3f}", f"{best:.3f}"} <= set(line)
        assert f"start level is {one[f'start_{unit}']:g} {unit} ({one['start_from']})" in shown
        assert f"noise, {axis}: the model is off by {rms:.3f} {unit} RMS" in shown
        assert f"by the model the arm is {one['lag_ms']:.1f} ms late, here it is " in shown
        gain, delay = (one["best_in_class"][key] for key in ("gain", "delay_ms"))
        assert f"a gain of {gain:.3f}, a dead time of {delay:.1f} ms" in shown
        assert not any(key.endswith({"deg": "_mm", "mm": "_deg"}[unit]) for key in one)
    assert [found[axis]["start_from"] for axis in ("wrist", "rail")] == ["given", "given"]
    assert (found["wrist"]["start_deg"], found["rail"]["start_mm"]) == (-10.0, 500.0)
    assert found["shoulder"]["start_deg"] == pytest.approx(30.0)
    page = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    assert page.count("mm RMS</th>") == page.count("deg RMS</th>") == 1
    figures = [page.count(f"position without its mean [{unit}]") for unit in ("mm", "deg")]
    assert figures[1] == 2 * figures[0] > 0


def test_fuse_takes_the_arm_with_both_kinds(folder: Path, run: Path, tmp_path: Path) -> None:
    """The identified joints beside the rail: estimates of each in its unit."""
    (tmp_path / "fusion.toml").write_text(
        f'arm = "{folder / "mixed.toml"}"\n[sensors.encoder]\nsd_mm = 0.02\nsd_deg = 0.02\n'
    )
    pumafuse("fuse", run, "-c", tmp_path / "fusion.toml", "-o", tmp_path / "out")
    used = pf.ArmModel.load(tmp_path / "out" / "arm.toml")
    assert used.axes == pf.ArmModel.load(folder / "mixed.toml").axes
    axes = json.loads((tmp_path / "out" / "summary.json").read_text())["axes"]
    assert axes["shoulder"]["sensors"]["encoder"]["innovation_rms_deg"] < 0.2
    assert axes["rail"]["sensors"]["encoder"]["innovation_rms_mm"] < 0.2

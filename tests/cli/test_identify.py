"""`pumafuse identify`: the real executable on a campaign whose truth is known, and on campaigns that are broken."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from executable import pumafuse

TIMES = np.arange(-5, 60) * 0.00563  # s, a few samples before the command
TRUE = {
    "radial": pf.FirstOrder(time_constant=0.0425),
    "vertical": pf.SecondOrder(natural_frequency=53.9, damping=0.864),
}
DELAY, SLOPE, INTERCEPT, NOISE = 0.0604, 0.08, 0.94, 2e-5  # s, s/m, 1, m
SCENARIO = """
name = "noise"
arm = "puma560-internal"
[trajectory]
kind = "white-noise"
axes = ["radial", "vertical"]
amplitude_mm = 5.0
duration_s = 2.0
[sensors.eye]
rate_hz = 30.0
sd_mm = 0.5
"""


def refused(*arguments: object) -> str:
    """The one line that a refusal prints, beside warnings; nothing on stdout."""
    done = pumafuse(*arguments, code=1)
    assert done.stdout == ""
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    return line


def samples(name: str, plant: pf.FirstOrder | pf.SecondOrder, step_mm: float, seed: int) -> str:
    """Superposed by hand: delay, gain and plant of the truth, a zero of 0.3 mm and noise."""
    gain = SLOPE * abs(step_mm) / 28.0 + INTERCEPT
    noise = NOISE * np.random.default_rng(seed).standard_normal(len(TIMES))
    position = 1e3 * (0.0003 + gain * step_mm * 1e-3 * plant.step_response(TIMES - DELAY) + noise)
    return "".join(f"{name},{t:.6f},{p:.5f}\n" for t, p in zip(TIMES, position, strict=True))


def campaign(
    folder: Path, axes: tuple[str, ...] = ("radial", "vertical"), listed: str = "", sampled: str = "", header: str = ""
) -> Path:
    """Two steps each of four sizes on each axis, up and down, and what more is asked for."""
    folder.mkdir(parents=True, exist_ok=True)
    lines, rows, number = [], [], 0
    for axis in axes:
        for size in (2.0, 4.0, 8.0, 14.0):
            for step in (size, -size, size):
                number += 1
                lines.append(f"t{number},{axis},{step},{size / 28.0:.6f}\n")
                rows.append(samples(f"t{number}", TRUE[axis], step, number))
    (folder / "trials.csv").write_text((header or "trial,axis,step_mm,speed_m_s\n") + "".join(lines) + listed)
    (folder / "samples.csv").write_text("trial,time_s,position_mm\n" + "".join(rows) + sampled)
    return folder


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return campaign(tmp_path_factory.mktemp("identify") / "bench")


@pytest.fixture(scope="module")
def identified(trials: Path) -> tuple[Path, dict[str, object]]:
    """The arm file, and what --json says."""
    path = trials.parent / "new" / "arm.toml"
    done = pumafuse("identify", trials, "-o", path, "--json")
    assert done.stderr == ""
    return path, json.loads(done.stdout)


def within(truth: float, interval: tuple[float, float], value: float) -> bool:
    """In twice its 95 % interval, which is not a wide one."""
    low, high = interval
    half = 0.5 * (high - low)
    return low <= value <= high and abs(value - truth) <= 2.0 * half and half < 0.05 * truth


def test_the_arm_is_the_truth_and_says_where_it_comes_from(identified: tuple[Path, dict[str, object]]) -> None:
    """Order, delay, gain line and plant, each within twice its interval; counts and method in the provenance."""
    arm = pf.ArmModel.load(identified[0])
    assert (arm.name, arm.update_period) == ("bench", 0.028)
    assert set(arm.axes) == {"radial", "vertical"}
    assert arm.delay_ci95 is not None
    assert within(DELAY, arm.delay_ci95, arm.delay)
    radial, vertical = arm.axes["radial"], arm.axes["vertical"]
    assert isinstance(radial.plant, pf.FirstOrder)
    assert radial.plant.time_constant_ci95 is not None
    assert within(0.0425, radial.plant.time_constant_ci95, radial.plant.time_constant)
    plant = vertical.plant
    assert isinstance(plant, pf.SecondOrder)
    assert plant.natural_frequency_ci95 is not None and plant.damping_ci95 is not None
    assert within(53.9, plant.natural_frequency_ci95, plant.natural_frequency)
    assert within(0.864, plant.damping_ci95, plant.damping)
    for axis in (radial, vertical):
        gain = axis.gain
        assert gain.intercept_ci95 is not None and gain.slope_ci95 is not None
        assert within(INTERCEPT, gain.intercept_ci95, gain.intercept)
        assert abs(gain.slope - SLOPE) <= gain.slope_ci95[1] - gain.slope_ci95[0] < 0.08
        assert axis.gain_recovery is None
    assert arm.validity.max_speed == pytest.approx(0.5)
    assert arm.provenance["made_by"].startswith("pumafuse identify ")
    assert arm.provenance["trials"] == {"radial": 12, "vertical": 12}
    assert arm.provenance["method"] == "all parameters fitted"
    assert arm.provenance["samples"] == "all"


def test_json_agrees_with_the_file(identified: tuple[Path, dict[str, object]]) -> None:
    """The arm with its intervals in file units; trials in the order of the list with their own fits."""
    path, told = identified
    arm, expected = told["arm"], pf.ArmModel.load(path)
    assert arm["update_period_ms"] == 28.0
    assert arm["delay_ms"] == pytest.approx(1e3 * expected.delay, rel=1e-12)
    radial = arm["axes"]["radial"]
    own = expected.axes["radial"]
    assert radial["plant"]["time_constant_ms"] == pytest.approx(1e3 * own.plant.time_constant, rel=1e-12)
    assert radial["plant"]["time_constant_ms_ci95"] == pytest.approx(1e3 * np.array(own.plant.time_constant_ci95))
    assert radial["gain"]["slope_s_m"] == pytest.approx(own.gain.slope, rel=1e-12)
    assert arm["validity"]["max_speed_m_s"] == pytest.approx(0.5)
    assert [one["trial"] for one in told["trials"]] == [f"t{n}" for n in range(1, 25)]
    assert (told["method"], told["samples"], told["tolerance_mm"], told["notes"]) == ("fitted", None, 1.0, [])
    for one in told["trials"]:
        size = abs(one["step_mm"])
        assert one["speed_m_s"] == pytest.approx(size / 28.0, rel=1e-4)
        assert one["first"]["gain"] == pytest.approx(SLOPE * size / 28.0 + INTERCEPT, abs=0.04)
        if one["axis"] == "radial":
            assert one["first"]["time_constant_ms"] == pytest.approx(42.5, abs=6.0 / size)
            assert one["first"]["delay_ms"] == pytest.approx(60.4, abs=6.0 / size)
            assert one["first"]["rms_mm"] == pytest.approx(1e3 * NOISE, rel=0.4)
            assert one["first"]["rms_percent"] == pytest.approx(100.0 * one["first"]["rms_mm"] / size, rel=1e-9)
        assert one["combined_rms_mm"] < 0.06
    lag = told["axes"]["vertical"]["delays"]["lag_ms"]["value"]
    assert lag == pytest.approx(60.4 + 2e3 * 0.864 / 53.9, abs=0.5)


def test_fuse_takes_the_file_as_it_is(identified: tuple[Path, dict[str, object]], tmp_path: Path) -> None:
    """A recorded run is fused with the identified arm beside its fusion.toml; the result keeps the arm as read."""
    (tmp_path / "noise.toml").write_text(SCENARIO)
    run = tmp_path / "run"
    pumafuse("simulate", tmp_path / "noise.toml", "-o", run)
    (run / "arm.toml").write_bytes(identified[0].read_bytes())
    lines = (run / "fusion.toml").read_text().splitlines()
    kept, skip = [], False
    for line in lines:  # what the scenario's arm has and this one has not
        skip = line.startswith("[process.tangential") if line.startswith("[") else skip
        kept.extend([] if skip else [line])
    (run / "fusion.toml").write_text("\n".join(kept))
    pumafuse("fuse", run, "-c", run / "fusion.toml", "-o", tmp_path / "out")
    used, expected = pf.ArmModel.load(tmp_path / "out" / "arm.toml"), pf.ArmModel.load(identified[0])
    assert (used.axes, used.delay) == (expected.axes, expected.delay)
    assert set(json.loads((tmp_path / "out" / "summary.json").read_text())["axes"]) == {"radial", "vertical"}


@pytest.mark.long
def test_an_arm_file_is_kept_unless_forced(
    trials: Path, identified: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    """To the last byte; what replaces it is what was written elsewhere before. What is no model is never replaced."""
    path = tmp_path / "arm.toml"
    path.write_text("mine")
    assert refused("identify", trials, "-o", path) == f"pumafuse: {path}: exists; --force replaces it"
    assert "no arm model, which is not ours to replace" in refused("identify", trials, "-o", path, "--force")
    assert path.read_text() == "mine"
    path.write_text(identified[0].read_text().replace('name = "', 'name = "an older '))
    said = pumafuse("identify", trials, "-o", path, "--force").stdout
    assert path.read_bytes() == identified[0].read_bytes()
    assert f"next: pumafuse verify RUN --arm {path}" in said
    assert [one.name for one in tmp_path.iterdir()] == ["arm.toml"]


@pytest.mark.long
def test_an_axis_with_too_few_trials_gets_no_model(tmp_path: Path) -> None:
    """It is said, and the others are done."""
    few = "".join(f"{name},vertical,8.0,0.285714\n" for name in ("a", "b"))
    sampled = samples("a", TRUE["vertical"], 8.0, 1) + samples("b", TRUE["vertical"], 8.0, 2)
    trials = campaign(tmp_path / "bench", ("radial",), few, sampled)
    done = pumafuse("identify", trials, "-o", tmp_path / "arm.toml")
    assert done.stderr == "warning: vertical: no model: 2 usable trials, at least 3 are needed\n"
    assert pf.ArmModel.load(tmp_path / "arm.toml").axes.keys() == {"radial"}


@pytest.mark.long
@pytest.mark.parametrize(("how", "header"), [("none", "trial,axis,step_mm,note\n"), ("two", "")])
def test_a_period_that_is_not_told_must_be_given(how: str, header: str, tmp_path: Path) -> None:
    """No speeds, or speeds that disagree: one line; with --period it is done, K against step over exactly that."""
    other = "x,radial,8.0,0.4\n" if how == "two" else ""
    trials = campaign(tmp_path / "bench", ("radial",), other, samples("x", TRUE["radial"], 8.0, 9), header)
    line = refused("identify", trials, "-o", tmp_path / "arm.toml")
    assert line.startswith("pumafuse: ") and line.endswith("give --period")
    assert not (tmp_path / "arm.toml").exists()
    if how == "none":
        pumafuse("identify", trials, "-o", tmp_path / "arm.toml", "--period", 28)
        arm = pf.ArmModel.load(tmp_path / "arm.toml")
        assert arm.update_period == 0.028
        assert arm.axes["radial"].gain.slope == pytest.approx(SLOPE, abs=0.02)
        pumafuse("identify", trials, "-o", tmp_path / "arm.toml", "--period", 33.3, "--force")
        assert "update_period_ms = 33.3\n" in (tmp_path / "arm.toml").read_text()


@pytest.mark.long
def test_samples_and_the_papers_method_change_the_answer(
    trials: Path, identified: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    """--samples uses only so many, and says so; --paper reads delay and gain off, which is near and not the same."""
    told = {"fitted": identified[1]}
    for name, options in (("short", ("--samples", 45)), ("paper", ("--paper", "--samples", 45))):
        said = pumafuse("identify", trials, "-o", tmp_path / f"{name}.toml", *options, "--json").stdout
        told[name] = json.loads(said)
    arms = {name: pf.ArmModel.load(tmp_path / f"{name}.toml") for name in ("short", "paper")}
    arms["fitted"] = pf.ArmModel.load(identified[0])
    assert [told[name]["samples"] for name in told] == [None, 45, 45]
    assert [told[name]["method"] for name in told] == ["fitted", "fitted", "published"]
    assert arms["paper"].provenance["method"].endswith("(--paper)")
    assert arms["short"].provenance["samples"] == 45
    assert (
        arms["short"].axes["radial"].plant != arms["fitted"].axes["radial"].plant != arms["paper"].axes["radial"].plant
    )
    for name, arm in arms.items():
        assert arm.delay == pytest.approx(DELAY, abs=0.006), name
        assert arm.axes["radial"].gain.intercept == pytest.approx(INTERCEPT, abs=0.03), name
    assert abs(arms["fitted"].delay - DELAY) < 0.0005
    assert arms["paper"].delay != pytest.approx(arms["fitted"].delay, abs=1e-4)


def test_what_is_not_there_is_one_line(trials: Path, tmp_path: Path) -> None:
    """No folder, no samples; usage errors exit with 2."""
    out = tmp_path / "arm.toml"
    assert "no trials.csv" in refused("identify", tmp_path / "none", "-o", out)
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "trials.csv").write_text("trial,axis,step_mm\n1,radial,8\n")
    assert "no samples.csv" in refused("identify", tmp_path / "half", "-o", out)
    for wrong in (("--period", "nan"), ("--samples", 3), ("--tolerance", 0)):
        pumafuse("identify", trials, "-o", out, *wrong, code=2)
    assert not out.exists()


def test_a_place_that_cannot_be_written_is_one_line(trials: Path, tmp_path: Path) -> None:
    """Below a file, which stays as it is."""
    (tmp_path / "file").write_text("mine")
    assert "cannot be written" in refused("identify", trials, "-o", tmp_path / "file" / "arm.toml")
    assert (tmp_path / "file").read_text() == "mine"

"""`pumafuse identify`: the command line on a campaign of a known arm, and on campaigns that are broken."""

import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from executable import names, pumafuse, refused
from pages import ROOT

TIMES = np.arange(-5, 60) * 0.00563  # s, a few samples before the command
TRUE = {
    "radial": pf.FirstOrder(time_constant=0.0425),
    "vertical": pf.SecondOrder(natural_frequency=53.9, damping=0.864),
}
DELAY, SLOPE, INTERCEPT, NOISE = 0.0604, 0.08, 0.94, 2e-5  # s, s/m, 1, m


def samples(name: str, plant: pf.FirstOrder | pf.SecondOrder, step_mm: float, seed: int) -> str:
    """Superposed by hand: delay, gain and plant of the truth, a zero of 0.3 mm and noise."""
    gain = SLOPE * abs(step_mm) / 28.0 + INTERCEPT
    noise = NOISE * np.random.default_rng(seed).standard_normal(len(TIMES))
    position = 1e3 * (0.0003 + gain * step_mm * 1e-3 * plant.step_response(TIMES - DELAY) + noise)
    return "".join(f"{name},{t:.6f},{p:.5f}\n" for t, p in zip(TIMES, position, strict=True))


def campaign(
    folder: Path, axes: tuple[str, ...] = ("radial", "vertical"), few: tuple[str, ...] = (), extra: str = "speed_m_s"
) -> Path:
    """Two steps each of four sizes on each axis, up and down, and two steps on axes with too few."""
    folder.mkdir(parents=True, exist_ok=True)
    steps = [(axis, step) for axis in axes for size in (2.0, 4.0, 8.0, 14.0) for step in (size, -size, size)]
    steps += [(axis, 8.0) for axis in few for _ in range(2)]
    lines, rows = [f"trial,axis,step_mm,{extra}"], ["trial,time_s,position_mm\n"]
    for number, (axis, step) in enumerate(steps, start=1):
        lines.append(f"t{number},{axis},{step},{abs(step) / 28.0:.6f}")
        rows.append(samples(f"t{number}", TRUE[axis], step, number))
    (folder / "trials.csv").write_text("\n".join(lines) + "\n")
    (folder / "samples.csv").write_text("".join(rows))
    return folder


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return campaign(tmp_path_factory.mktemp("identify") / "bench")


@pytest.fixture(scope="module")
def identified(trials: Path) -> tuple[Path, dict[str, object]]:
    """The arm file, and the output of --json."""
    path = trials.parent / "new" / "arm.toml"
    done = pumafuse("identify", trials, "-o", path, "--json")
    assert done.stderr == ""
    return path, json.loads(done.stdout)


def test_json_agrees_with_the_file(identified: tuple[Path, dict[str, object]]) -> None:
    """The arm with its intervals in file units; trials in the order of the list with their own fits."""
    path, found = identified
    arm, expected = found["arm"], pf.ArmModel.load(path)
    assert (expected.name, set(expected.axes)) == ("bench", {"radial", "vertical"})
    assert expected.provenance["made_by"].startswith("pumafuse identify ")
    counted = {"trials": {"radial": 12, "vertical": 12}, "method": "all parameters fitted", "samples": "all"}
    assert {key: expected.provenance[key] for key in counted} == counted
    radial, own = arm["axes"]["radial"], expected.axes["radial"]
    assert arm["update_period_ms"] == 28.0
    assert arm["delay_ms"] == pytest.approx(1e3 * expected.delay, rel=1e-12)
    assert radial["plant"]["time_constant_ms_ci95"] == pytest.approx(1e3 * np.array(own.plant.time_constant_ci95))
    assert radial["gain"]["slope_s_m"] == pytest.approx(own.gain.slope, rel=1e-12)
    assert arm["validity"]["max_speed_m_s"] == pytest.approx(0.5)
    assert [one["trial"] for one in found["trials"]] == [f"t{n}" for n in range(1, 25)]
    assert (found["method"], found["samples"], found["tolerance_mm"], found["notes"]) == ("fitted", None, 1.0, [])
    for one in found["trials"]:
        size, first = abs(one["step_mm"]), one["first"]
        assert one["speed_m_s"] == pytest.approx(size / 28.0, rel=1e-4)
        assert first["gain"] == pytest.approx(SLOPE * size / 28.0 + INTERCEPT, abs=0.04)
        if one["axis"] == "radial":
            assert [first["time_constant_ms"], first["delay_ms"]] == pytest.approx([42.5, 60.4], abs=6.0 / size)
            assert first["rms_mm"] == pytest.approx(1e3 * NOISE, rel=0.4)
            assert first["rms_percent"] == pytest.approx(100.0 * first["rms_mm"] / size, rel=1e-9)
        assert one["combined_rms_mm"] < 0.06
    lag = found["axes"]["vertical"]["delays"]["lag_ms"]["value"]
    assert lag == pytest.approx(60.4 + 2e3 * 0.864 / 53.9, abs=0.5)


@pytest.mark.long
def test_an_arm_file_is_kept_unless_forced(
    trials: Path, identified: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    """To the last byte; what replaces it is what was written elsewhere before. What is no model is never replaced."""
    path = tmp_path / "arm.toml"
    path.write_text("mine")
    assert "no arm model, which is not ours to replace" in refused("identify", trials, "-o", path, "--force")
    assert path.read_text() == "mine"
    path.write_text(identified[0].read_text().replace('name = "', 'name = "an older '))
    assert refused("identify", trials, "-o", path) == f"pumafuse: {path}: exists; --force replaces it"
    shown = pumafuse("identify", trials, "-o", path, "--force").stdout
    assert path.read_bytes() == identified[0].read_bytes()
    assert f"next: pumafuse verify RUN --arm {path}" in shown
    assert names(tmp_path) == {"arm.toml"}


@pytest.mark.long
def test_an_axis_with_too_few_trials_gets_no_model_and_an_unknown_period_must_be_given(tmp_path: Path) -> None:
    """The axis is named, and the others are done; with --period, K is against step over exactly that."""
    trials = campaign(tmp_path / "bench", ("radial",), ("vertical",), extra="note")
    arm = tmp_path / "arm.toml"
    assert refused("identify", trials, "-o", arm).endswith("give --period")
    assert not arm.exists()
    done = pumafuse("identify", trials, "-o", arm, "--period", 33.3)
    assert done.stderr == "warning: vertical: no model: 2 usable trials, at least 3 are needed\n"
    found = pf.ArmModel.load(arm)
    assert found.axes.keys() == {"radial"}
    assert "update_period_ms = 33.3\n" in arm.read_text()
    assert found.axes["radial"].gain.slope == pytest.approx(SLOPE * 33.3 / 28.0, abs=0.02)


@pytest.mark.long
def test_samples_and_the_papers_method_are_recorded(trials: Path, tmp_path: Path) -> None:
    """--samples uses only so many; --paper reads delay and gain off."""
    path = tmp_path / "new" / "arm"  # a name without an ending is no preset
    found = json.loads(pumafuse("identify", trials, "-o", path, "--paper", "--samples", 45, "--json").stdout)
    assert (found["samples"], found["method"]) == (45, "published")
    assert pf.ArmModel.load(path).provenance["method"].endswith("(--paper)")


def test_what_is_not_there_is_one_line(trials: Path, tmp_path: Path) -> None:
    """No folder, no samples, a place below a file, which stays as it is."""
    out, half, file = tmp_path / "arm.toml", tmp_path / "half", tmp_path / "file"
    half.mkdir()
    (half / "trials.csv").write_text("trial,axis,step_mm\n1,radial,8\n")
    file.write_text("mine")
    assert "no such file" in refused("identify", tmp_path / "none", "-o", out)
    assert "no samples.csv" in refused("identify", half, "-o", out)
    assert "cannot be written" in refused("identify", trials, "-o", file / "arm.toml")
    assert file.read_text() == "mine" and not out.exists()


TRUNK = ROOT / "examples" / "trunk-servo"
LENGTH = 60.0  # s that are used


@pytest.fixture(scope="module")
def trunk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of the run without payload, of one of its axes."""
    folder = tmp_path_factory.mktemp("latency") / "run"
    folder.mkdir()
    text = re.sub(r"^m[2-6] = .*\n", "", (TRUNK / "0g" / "run.toml").read_text(encoding="utf-8"), flags=re.MULTILINE)
    (folder / "run.toml").write_text(text.replace("../", ""), encoding="utf-8")
    for name in ("commands", "camera", "encoder"):
        source = TRUNK / ("" if name == "commands" else "0g") / f"{name}.csv.gz"
        lines = gzip.decompress(source.read_bytes()).decode().splitlines()
        rows = [line for line in lines[1:] if float(line.split(",")[0]) < LENGTH]
        with gzip.open(folder / f"{name}.csv.gz", "wt", encoding="utf-8") as written:
            written.write("\n".join([lines[0], *rows]) + "\n")
    return folder


@pytest.fixture(scope="module")
def told(trunk: Path) -> tuple[str, Path]:
    """What is printed, and the page."""
    page = trunk.parent / "page"
    return pumafuse("latency", trunk, "--report", page).stdout, page / "report.html"


def test_it_says_how_late_the_arm_and_the_camera_are(told: tuple[str, Path]) -> None:
    """The README of the recording: m1 is 202 to 209 ms late, the camera 45; both lie in their intervals."""
    text, _ = told
    numbers = r"([\d.]+) \(([\d.]+) to ([\d.]+)\) ms l"
    lag, camera = (
        tuple(map(float, found.groups()))
        for found in (re.search(f"{name} is {numbers}", text) for name in ("m1", "camera"))
        if found
    )
    assert lag[1] < 209.0
    assert lag[2] > 202.0
    assert lag[2] - lag[1] < 20.0
    assert camera[1] < 45.0 < camera[2]
    assert camera[2] - camera[1] < 6.0
    assert "The stamps of reference are taken to be right" in text


def test_it_says_what_to_write_where(told: tuple[str, Path], tmp_path: Path) -> None:
    """The lines for arm.toml are one; the others have units."""
    text, _ = told
    settings = text.partition("latter):\n")[2].partition("elsewhere:")[0]
    sensors, _, arm = settings.partition("name =")
    assert "[sensors.camera]" in sensors
    (tmp_path / "arm.toml").write_text(f"name ={arm}", encoding="utf-8")
    assert list(pf.ArmModel.load(tmp_path / "arm.toml").axes) == ["m1"]
    for program in ("MoveIt Servo", "Isaac Lab", "MuJoCo", "LeRobot"):
        assert program in text.partition("elsewhere:")[2]


def test_the_page_has_a_picture_and_the_answers(told: tuple[str, Path]) -> None:
    """One HTML page that loads nothing."""
    text, page = told
    html = page.read_text(encoding="utf-8")
    assert "<svg" in html
    assert text.splitlines()[0].split(" (")[0] in html
    assert not re.search(r'(src|href)="http', html)


@pytest.mark.long
def test_identify_writes_an_arm_with_intervals(trunk: Path, tmp_path: Path) -> None:
    """From motion, without a guess; JSON in the units of its names; an arm file in the way is refused."""
    path = tmp_path / "arm.toml"
    summary = json.loads(pumafuse("identify", trunk, "-o", path, "--sensor", "reference", "--json").stdout)
    arm, one = pf.ArmModel.load(path), summary["axes"]["m1"]
    assert arm.axes["m1"].kind == "angle"
    assert arm.lag_of("m1") * 1e3 == pytest.approx(one["lag_ms"], abs=1e-2)
    assert one["lag_ms_ci95"][0] < one["lag_ms"] < one["lag_ms_ci95"][1]
    assert arm.axes["m1"].delay_ci95 is not None
    assert summary["sensors"]["camera"]["latency_ms"] == pytest.approx(45.0, abs=3.0)
    assert "--force" in refused("identify", trunk, "-o", path)


def test_what_does_not_go_together_is_refused(trunk: Path, tmp_path: Path) -> None:
    """Options of trials with a run; a folder without run.toml; a sensor that is not there; a part without motion."""
    assert "step trials" in refused("identify", trunk, "-o", tmp_path / "arm.toml", "--paper")
    assert "pumafuse init" in refused("latency", tmp_path)
    assert "laser" in refused("latency", trunk, "--sensor", "laser")
    assert refused("latency", trunk, "--from", 500)

"""`pumafuse latency` and `identify RUN`: the command line on the real robot of the examples."""

import gzip
import json
import re
from pathlib import Path

import pytest

import pumafuse as pf
from executable import pumafuse, refused
from pages import ROOT

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

"""Campaigns of angles: the same trials in mm and in degrees are one arm; numbers are in the units of their names."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.identification.anova import performances, validity
from pumafuse.identification.trials import StepTrials, TrialsError
from pumafuse.units import Kind, of_kind
from pumafuse.views import report
from refusals import one_line

TIMES = np.arange(-4, 46) * 0.006  # s
PERIOD, DELAY, SLOPE, INTERCEPT, NOISE = 0.028, 0.055, 0.0002, 0.95, 0.02  # s, s, per 1/s, 1, 1
UNITS = {"_mm": (1.0, "_m_s", 1e-3), "_deg": (1.0, "_deg_s", 1.0), "_rad": (math.pi / 180, "_rad_s", math.pi / 180)}
PER_DEGREE = math.pi / 180.0


def campaign(folder: Path, unit: str) -> StepTrials:
    """Steps of 2 to 19 of first order and of second order, written in a unit; one of them hardly moves.

    A factor and a trial have names that end in units of lengths: they are no numbers of the axis.
    """
    folder.mkdir()
    size, speed_unit, speed_size = UNITS[unit]
    rng = np.random.default_rng(5)
    listed = [f"trial,axis,step{unit},speed{speed_unit},radius_mm"]
    sampled = [f"trial,time_s,position{unit}"]
    for axis in ("shoulder", "elbow"):
        for step in (2.0, 4.0, -8.0, 19.0, 2.0, -4.0, 8.0, -19.0):
            name, t = f"{axis}{len(listed)}_mm", np.maximum(TIMES - DELAY, 0.0)
            lag = 1.0 - np.exp(-t / 0.04) if axis == "shoulder" else 1.0 - (1.0 + 60.0 * t) * np.exp(-60.0 * t)
            speed = abs(step) / PERIOD
            moved = 0.1 if len(listed) == 7 else SLOPE * speed + INTERCEPT
            position = moved * step * lag + NOISE * rng.standard_normal(len(TIMES))
            listed.append(f"{name},{axis},{step * size!r},{speed * speed_size!r},{400 + 100 * (len(listed) % 2)}")
            sampled += [
                f"{name},{time:.6f},{value!r}" for time, value in zip(TIMES, (position * size).tolist(), strict=True)
            ]
    (folder / "trials.csv").write_text("\n".join(listed) + "\n")
    (folder / "samples.csv").write_text("\n".join(sampled) + "\n")
    return StepTrials.read(folder)


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> dict[str, StepTrials]:
    folder = tmp_path_factory.mktemp("angles")
    return {unit: campaign(folder / unit, unit) for unit in UNITS}


@pytest.fixture(scope="module")
def found(trials: dict[str, StepTrials]) -> dict[str, pf.Identification]:
    tolerance = {"_mm": 1e-3, "_deg": PER_DEGREE, "_rad": PER_DEGREE}
    return {unit: pf.identify(of, tolerance=tolerance[unit], name="bench") for unit, of in trials.items()}


def numbers(tree: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number of a JSON tree, with its place."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from numbers(value, f"{path}.{key}")
    elif isinstance(tree, list):
        for place, value in enumerate(tree):
            yield from numbers(value, f"{path}.{place}")
    elif isinstance(tree, int | float):
        yield path, float(tree)


def _near(key: str) -> dict[str, float]:
    """Of a single trial ω and ζ make up for each other: where its search ends differs in the last digits."""
    return {"rel": 1e-7 if key == "axes" else 1e-4, "abs": 1e-9}


def test_json_has_the_same_numbers_under_the_names_of_its_kind(found: dict[str, pf.Identification]) -> None:
    """Every number of the mm's JSON under the key for angles; speeds are a thousand times those in m/s.

    Names that users gave are as they are: a factor radius_mm and trials that end in _mm.
    """
    length, angle = (json.loads(found[unit].to_json()) for unit in ("_mm", "_deg"))
    assert angle["tolerance_deg"] == pytest.approx(1.0, rel=1e-12)
    assert {trial["trial"] for trial in angle["trials"]} == {trial["trial"] for trial in length["trials"]}
    assert all(set(trial["factors"]) == {"radius_mm"} for trial in angle["trials"])
    assert angle["axes"]["shoulder"]["left_out"] == length["axes"]["shoulder"]["left_out"]
    (left_out,) = angle["axes"]["shoulder"]["left_out"]
    assert left_out.endswith("_mm") and angle["arm"]["provenance"]["left_out"].keys() == {left_out}
    for key in ("trials", "axes", "scatter"):
        ours, theirs = dict(numbers(angle[key])), dict(numbers(length[key]))
        assert len(ours) == len(theirs)
        for path, number in theirs.items():
            factor = {"speed_m_s": 1e3, "slope_s_m": 1e-3 / PER_DEGREE}
            stem = next((part for part in factor if part in path), "")
            renamed = ".".join(of_kind(part, "angle") for part in path.split("."))
            assert ours[renamed] == pytest.approx(number * factor.get(stem, 1.0), **_near(key)), path
    for one, other in zip(length["performance"], angle["performance"], strict=True):
        assert other["factor"] == of_kind(one["factor"], "angle") if one["factor"] != "radius_mm" else "radius_mm"
        means = [[level["mean"] for level in each["levels"]] for each in (one, other)]
        assert means[0] == pytest.approx(means[1], rel=1e-7)
        assert "mm" not in other["verdict"]
    assert "deg, second" in angle["axes"]["elbow"]["choice"]["why"]


def test_degrees_and_radians_are_the_same_campaign(found: dict[str, pf.Identification]) -> None:
    """The arm to the last of its six digits, and every number of the JSON."""
    one, other = (json.loads(found[unit].to_json()) for unit in ("_deg", "_rad"))
    assert {**one["arm"], "provenance": {}} == {**other["arm"], "provenance": {}}
    for key in ("axes", "trials", "performance", "tolerance_deg"):
        for (path, a), (_, b) in zip(numbers(one[key]), numbers(other[key]), strict=True):
            assert a == pytest.approx(b, **_near(key)), path


def test_the_arm_says_what_it_is_and_can_be_loaded(found: dict[str, pf.Identification], tmp_path: Path) -> None:
    """Keys of angles, the limit of speed in round degrees/s, and the same model when read."""
    arm = found["_deg"].arm
    arm.save(tmp_path / "arm.toml")
    text = (tmp_path / "arm.toml").read_text()
    assert pf.ArmModel.load(tmp_path / "arm.toml") == arm
    assert "max_speed_deg_s = 678.571\n" in text and text.count('kind = "angle"') == 2
    assert text.count("slope_s_rad = ") == 2 and "_m_s" not in text.partition("[provenance]")[0]
    assert (arm.validity.max_speed, arm.validity.max_radius) == (None, None)


def test_a_limit_is_in_the_unit_of_its_factor() -> None:
    """Speed from degrees/s, radius from mm; RMS and tolerance in degrees: 0.1 is passed halfway from 40 to 80."""
    rms = PER_DEGREE * np.array([0.02, 0.05, 0.15])
    factors = {"speed_deg_s": ["20", "40", "80"], "radius_mm": ["500", "700", "900"]}
    found = performances(factors, rms, 0.1 * PER_DEGREE, "angle")
    assert [one.limit for one in found] == pytest.approx([60.0, 800.0], rel=1e-9)
    assert [level.mean for level in found[0].levels] == pytest.approx([0.02, 0.05, 0.15])
    assert found[0].verdict.startswith("within 0.1 deg up to 60 ")
    limits = validity(found, 7.0, "angle")
    assert limits.max_speed is None
    assert (limits.max_angular_speed, limits.max_radius) == pytest.approx((60.0 * PER_DEGREE, 0.8), rel=1e-9)
    assert validity(found[1:], 7.0, "angle").max_angular_speed == 7.0


@pytest.mark.long
def test_the_page_of_angles_names_no_length(
    found: dict[str, pf.Identification], trials: dict[str, StepTrials], tmp_path: Path
) -> None:
    """Units of tables, figures and sentences; the numbers of trials are those of the JSON."""
    report.write_identification(found["_deg"], trials["_deg"], tmp_path / "page", False)
    text = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    assert "<th>step, deg</th>" in text and "<th>speed, deg/s</th>" in text and "<th>combined RMS, deg</th>" in text
    assert " mm" not in text.replace("radius_mm", "") and "m/s]" not in text.replace("rad/s]", "")
    assert "speed [deg/s]" in text and "RMS of the combined model [deg]" in text
    for trial in json.loads(found["_deg"].to_json())["trials"]:
        numbers = f'<td class="n">{trial["step_deg"]:g}</td><td class="n">{trial["speed_deg_s"]:.3g}</td>'
        assert f"<td>{trial['trial']}</td><td>{trial['axis']}</td>{numbers}" in text


@pytest.mark.parametrize(
    ("listed", "sampled", "named"),
    [
        ("step_deg,speed_deg_s", "position_mm", ("position_mm", "step_deg")),
        ("step_deg,speed_m_s", "position_deg", ("speed_m_s", "step_deg")),
        ("step_mm,step_deg", "position_mm", ("step_mm", "step_deg")),
    ],
)
def test_a_campaign_of_both_kinds_is_refused(listed: str, sampled: str, named: tuple[str, str], tmp_path: Path) -> None:
    """In one line, with the two columns and what to do."""
    (tmp_path / "trials.csv").write_text(f"trial,axis,{listed}\n1,tip,4,2\n")
    (tmp_path / "samples.csv").write_text(f"trial,time_s,{sampled}\n" + "".join(f"1,{k / 100},1\n" for k in range(20)))
    line = one_line(TrialsError, lambda: StepTrials.read(tmp_path))
    assert f"{named[0]} is of a length, {named[1]} of an angle" in line
    assert line.endswith("in two campaigns, then put the axes into one arm.toml")


@pytest.mark.parametrize(("unit", "kind"), [("_um", "length"), ("_mrad", "angle")])
def test_other_units_of_both_kinds(unit: str, kind: Kind, tmp_path: Path) -> None:
    """Speeds may be absent, or in the other unit of the kind."""
    speed = {"length": "speed_mm_s", "angle": "speed_rad_s"}[kind]
    (tmp_path / "trials.csv").write_text(f"trial,axis,step{unit},{speed}\n1,tip,4000,0.2\n")
    (tmp_path / "samples.csv").write_text(
        f"trial,time_s,position{unit}\n" + "".join(f"1,{k / 100},{k}\n" for k in range(20))
    )
    read = StepTrials.read(tmp_path)
    (trial,) = read.trials
    assert read.kind == kind and trial.factors == {}
    assert trial.step == pytest.approx({"_um": 0.004, "_mrad": 4.0}[unit], rel=1e-12)
    assert trial.position[3] == pytest.approx({"_um": 3e-6, "_mrad": 3e-3}[unit], rel=1e-12)
    assert trial.speed == pytest.approx({"length": 0.2e-3, "angle": 0.2}[kind], rel=1e-12)

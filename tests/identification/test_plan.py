"""Campaigns are balanced and random, their ticks are the listed trials, and they warn of what will spoil them."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.folders import FolderError
from pumafuse.identification.plan import Design, plan, write
from refusals import one_line

ARM = pf.ArmModel.load("puma560-internal")
POSITIONS = ({"y_mm": "350", "z_mm": "-90"}, {"y_mm": "700", "z_mm": "210"}, {"y_mm": "525", "z_mm": "-400"})


def design(**changes: Any) -> Design:
    made: dict[str, Any] = {
        "axes": ("radial", "tangential"),
        "speeds": (0.1, 0.2, 0.4),
        "period": 0.028,
        "positions": POSITIONS,
        "replicates": 3,
        "hold": 0.5,
        "rest": 0.5,
        "amplitudes": (0.004, 0.008),
        "noise_duration": 4.0,
        "seed": 1,
    }
    return Design(**{**made, **changes})


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_block_holds_every_combination_once() -> None:
    """So a campaign that is cut short after a block is balanced, and factors cannot be confounded."""
    trials = plan(design()).trials
    assert len(trials) == 3 * 2 * 3 * 3
    for block in range(3):
        part = trials[18 * block : 18 * (block + 1)]
        assert {trial.replicate for trial in part} == {block + 1}
        assert set(Counter((t.axis, t.speed, t.position["y_mm"]) for t in part).values()) == {1}


def test_the_order_is_random_and_comes_again_with_its_seed() -> None:
    """Blocks differ from one another."""
    one, again, other = (plan(design(seed=seed)).trials for seed in (1, 1, 2))
    assert one == again != other
    assert [t.speed for t in one[:18]] != [t.speed for t in one[18:36]]


def test_the_ticks_are_the_trials(tmp_path: Path) -> None:
    """Rest, step, rest: on the axis, of the size and in the order that trials.csv lists; all else stays 0.

    White noise has two levels and goes from rest to rest; the duration is that of all rows.
    """
    planned = plan(design())
    write(planned, tmp_path / "plan", False)
    listed, ticks = table(tmp_path / "plan" / "trials.csv"), table(tmp_path / "plan" / "steps.csv")
    count = len(ticks) // len(listed)
    for number, trial in enumerate(listed):
        part = ticks[count * number : count * (number + 1)]
        assert {row["trial"] for row in part} == {trial["trial"]}
        assert [int(row["tick"]) for row in part] == list(range(count))
        np.testing.assert_allclose([float(row["time_s"]) for row in part], 0.028 * np.arange(count), atol=1e-9)
        for axis in ("radial", "tangential"):
            command = np.array([float(row[f"{axis}_mm"]) for row in part])
            size = float(trial["step_mm"]) if axis == trial["axis"] else 0.0
            expected = np.repeat([0.0, size, 0.0], [18, 18, 18])
            np.testing.assert_array_equal(command, expected)
        assert float(trial["step_mm"]) == pytest.approx(28.0 * float(trial["speed_m_s"]))
        assert {"y_mm": trial["y_mm"], "z_mm": trial["z_mm"]} in POSITIONS
    for path in (tmp_path / "plan").glob("white-noise-*"):
        _, _, axis, size = path.stem.removesuffix("mm").rsplit("-", 3)
        noise = np.array([float(row[f"{axis}_mm"]) for row in table(path)])
        assert set(noise) == {0.0, float(size)} and not noise[:18].any() and not noise[-18:].any()
    rows = sum(len(table(path)) for path in (tmp_path / "plan").iterdir() if path.name != "trials.csv")
    assert planned.duration == pytest.approx(0.028 * rows)


def test_a_planned_campaign_is_read_by_identify(tmp_path: Path) -> None:
    """trials.csv is what StepTrials reads, the period comes out of it."""
    write(plan(design()), tmp_path / "plan", False)
    names = [row["trial"] for row in table(tmp_path / "plan" / "trials.csv")]
    rows = [f"{name},{time:.4f},{min(time, 0.1) * 10:.3f}" for name in names for time in np.arange(20) * 0.01]
    (tmp_path / "plan" / "samples.csv").write_text("trial,time_s,position_mm\n" + "\n".join(rows) + "\n")
    read = pf.StepTrials.read(tmp_path / "plan")
    assert (len(read.trials), read.notes, read.period()) == (54, (), pytest.approx(0.028))
    assert set(read.trials[0].factors) == {"y_mm", "z_mm", "replicate"}
    with pytest.raises(FolderError, match=r"samples\.csv"):
        write(plan(design()), tmp_path / "plan", True)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"hold": 0.2}, "radial: the hold of 200 ms is too short to settle: 227 ms are needed"),
        ({"rest": 0.05}, "radial: the rest between steps of 128 ms is too short to settle: 227 ms are needed"),
        ({"speeds": (0.1, 0.6)}, "commanded speeds reach 0.6 m/s, the limit is 0.5 m/s"),
        ({"amplitudes": (0.02,)}, "commanded speeds reach 0.714 m/s, the limit is 0.5 m/s"),
        ({"speeds": (0.1,)}, "one speed only: the gain's dependence on speed is not identifiable"),
        ({"replicates": 1}, "no replicates: scatter from trial to trial cannot be separated"),
        ({"amplitudes": ()}, "no white noise: there will be nothing to verify the model with"),
        ({"speeds": (100.0, 200.0)}, "steps are 5.6e+03 mm at most, 200 m/s at T; is a unit wrong?"),
        ({"speeds": (1e-3,), "amplitudes": ()}, "steps are 0.028 mm at most, 0.001 m/s at T; is a unit wrong?"),
        ({"positions": (POSITIONS[0], POSITIONS[0])}, "positions: one is listed twice"),
    ],
)
def test_what_will_spoil_a_campaign_is_warned_of(changes: dict[str, Any], words: str) -> None:
    """A good plan has no warning. The plant of 42.5 ms settles to 2 % in 166 ms, after a delay of 60 ms."""
    assert plan(design(), ARM).warnings == ()
    assert any(line.startswith(words) for line in plan(design(**changes), ARM).warnings)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"axes": ()}, "at least one axis"),
        ({"axes": ("radial", "radial")}, "each once"),
        ({"axes": ("reach_mm",)}, "must not end in a unit"),
        ({"speeds": ()}, "at least one speed"),
        ({"speeds": (0.1, -0.1)}, "speeds must make steps of 0.001 mm to 10000 mm"),
        ({"speeds": (1e-300,)}, "speeds must make steps"),
        ({"speeds": (0.07, 0.07000000001)}, "two speeds make the same step"),
        ({"amplitudes": (np.inf,)}, "amplitudes must make steps"),
        ({"replicates": 100_000}, "at most 100000 of"),
        ({"hold": 1e9}, "at most 100000 of 5e"),
        ({"noise_duration": 1e9}, "at most 200000"),
        ({"positions": ({"axis": "1"},)}, "cannot have a column 'axis'"),
        ({"axes": ("a/b",)}, "cannot be called 'a/b'"),
        ({"axes": ("tick",)}, "cannot be called 'tick'"),
        ({"kind": "angle", "speeds": (400.0,)}, "speeds must make steps of 0.0001 deg to 360 deg"),
        ({"kind": "angle", "amplitudes": (1e-7,)}, "amplitudes must make steps of 0.0001 deg"),
        ({"positions": ({"step_deg": "1"},)}, "cannot have a column 'step_deg'"),
    ],
)
def test_a_design_that_cannot_be_carried_out_is_refused(changes: dict[str, Any], words: str) -> None:
    """In one line."""
    assert words in one_line(pf.ConfigError, lambda: design(**changes))

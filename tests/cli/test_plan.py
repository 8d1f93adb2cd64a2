"""`pumafuse plan` by the executable: files, words, exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from executable import names, pumafuse


def test_axes_and_period_are_the_arms(tmp_path: Path) -> None:
    """A plan for an arm of one's own names nothing of a PUMA; positions come from a table."""
    arm, where, plan = tmp_path / "arm.toml", tmp_path / "where.csv", tmp_path / "plan"
    plant = '[axes.tip]\nplant = "first-order"\ntime_constant_ms = 30.0\n'
    arm.write_text(f'name = "lever"\nupdate_period_ms = 20.0\ndelay_ms = 45.0\n{plant}')
    where.write_text("pose,load_kg\nnear,0\nfar,2\n")
    options = ("--arm", arm, "--speeds", "0.1,0.2", "--positions", where, "--noise", "5")
    done = pumafuse("plan", "-o", plan, *options)
    assert done.stderr == ""
    assert "8 step trials and 1 white-noise sequences" in done.stdout
    assert names(plan) == {"trials.csv", "steps.csv", "white-noise-tip-5mm.csv"}
    lines = (plan / "trials.csv").read_text().splitlines()
    assert lines[0].replace('"', "") == "trial,axis,step_mm,speed_m_s,pose,load_kg,replicate"
    assert sorted(line.split(",")[2] for line in lines[1:]) == ["2"] * 4 + ["4"] * 4


@pytest.mark.parametrize(
    ("arguments", "words", "code"),
    [
        (("--speeds", ""), "at least one speed", 1),
        (("--axes", "a", "--arm", "puma560-internal"), "unknown axis 'a'", 1),
        (("--positions", "none.csv"), "none.csv: no such file", 1),
        (("--noise", "loud"), "--noise", 2),
        (("--noise-duration", "0"), "--noise-duration", 2),
    ],
)
def test_what_cannot_be_planned_is_one_line(arguments: tuple[str, ...], words: str, code: int, tmp_path: Path) -> None:
    """Nothing is written then."""
    done = pumafuse("plan", "-o", tmp_path / "plan", *arguments, code=code)
    assert words in done.stderr.splitlines()[-1]
    assert names(tmp_path) == set()

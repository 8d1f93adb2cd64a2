"""Step trials from files: units, factors, and every kind of broken trial named in one line while the rest is read."""

from pathlib import Path

import numpy as np
import pytest

from pumafuse.identification.trials import StepTrials, TrialsError
from refusals import one_line

TIMES = np.round(np.arange(-2, 12) * 0.005, 6)


def rows(name: str, times: np.ndarray = TIMES, value: float = 1.5) -> str:
    return "".join(f"{name},{time},{value if time > 0.02 else 0.25}\n" for time in times)


def written(folder: Path, listed: str, sampled: str) -> Path:
    (folder / "trials.csv").write_text("trial,axis,step_mm,speed_m_s,height_mm,tool\n" + listed)
    (folder / "samples.csv").write_text("trial,time_s,position_mm\n" + sampled)
    return folder


def test_trials_come_in_the_order_of_the_list(tmp_path: Path) -> None:
    """Steps and positions in metres, factors as written, samples of each trial however the file mixes them."""
    listed = "7,radial,8.0,0.2857,350,drill\n3,vertical,-2.0,0.0714,-90,\n"
    pairs = zip(rows("3", value=-0.5).splitlines(), rows("7").splitlines(), strict=True)
    sampled = "".join(f"{one}\n{other}\n" for one, other in pairs)
    found = StepTrials.read(written(tmp_path, listed, sampled))
    assert [trial.name for trial in found.trials] == ["7", "3"]
    assert found.axes == ("radial", "vertical")
    assert [trial.name for trial in found.of("vertical")] == ["3"]
    first, second = found.trials
    assert (first.step, first.speed, second.step) == (0.008, 0.2857, -0.002)
    assert dict(first.factors) == {"height_mm": "350", "tool": "drill"}
    assert dict(second.factors) == {"height_mm": "-90", "tool": ""}
    np.testing.assert_allclose(first.time, TIMES, atol=1e-12)
    np.testing.assert_array_equal(second.position, np.where(TIMES > 0.02, -0.0005, 0.00025))
    assert found.notes == ()
    cut = first.cut(4)
    assert ((cut.time < 0.0).sum(), (cut.time >= 0.0).sum()) == (2, 4)
    np.testing.assert_array_equal(cut.position, first.position[:6])
    assert len(first.cut(None).time) == len(TIMES)


WHOLE = "1,radial,8,0.2857,350,a\n"
LISTED = "2,radial,8,0.2857,350,a\n"
BROKEN: dict[str, tuple[str, str, str]] = {
    "twice": (2 * LISTED, rows("2"), "listed 2 times"),
    "no step": (LISTED.replace("8", "0", 1), rows("2"), "its step is 0 or no number"),
    "step that is a word": (LISTED.replace("8", "big", 1), rows("2"), "its step is 0 or no number"),
    "no axis": (LISTED.replace("radial", ""), rows("2"), "it names no axis"),
    "one sample": (LISTED, "2,0.1,1.0\n", "1 samples from the step on"),
    "only before": (LISTED, rows("2", TIMES - 1.0), "0 samples from the step on"),
    "all NaN": (LISTED, rows("2", value=np.nan).replace("0.25", "nan"), "0 samples"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_trial_costs_only_itself(case: str, tmp_path: Path) -> None:
    """It is named once, with the reason; alone it is refused in one line."""
    listed, sampled, reason = BROKEN[case]
    found = StepTrials.read(written(tmp_path, WHOLE + listed, rows("1") + sampled))
    assert [trial.name for trial in found.trials] == ["1"]
    notes = [note for note in found.notes if note.startswith("trial '2'")]
    assert notes
    assert all(note.startswith(f"trial '2': {reason}") and note.endswith(": left out") for note in notes)
    refused = one_line(TrialsError, lambda: StepTrials.read(written(tmp_path, listed, sampled)))
    assert "no trial can be used; " in refused and f"trial '2': {reason}" in refused


def test_what_can_be_mended_is_mended_and_reported(tmp_path: Path) -> None:
    """Samples without a number are left out, samples out of order sorted, samples of no listed trial reported."""
    mixed = "1,0.061,1.0\n1,0.057,nan\n1,0.058,2.0\n"
    found = StepTrials.read(written(tmp_path, WHOLE, rows("1") + mixed + rows("9")))
    (trial,) = found.trials
    assert (np.diff(trial.time) >= 0.0).all()
    assert trial.position[-2:].tolist() == [0.002, 0.001]
    assert found.notes == (
        "samples.csv: 1 trials are not listed, first '9': left out",
        "trial '1': 1 samples without a number: left out",
        "trial '1': times step back: sorted",
    )


def campaign(folder: Path, *steps: tuple[float, float]) -> StepTrials:
    listed = "".join(f"{k},radial,{step},{speed},0,a\n" for k, (step, speed) in enumerate(steps))
    return StepTrials.read(written(folder, listed, "".join(rows(str(k)) for k in range(len(steps)))))


def test_the_update_period_is_step_over_speed_where_all_agree(tmp_path: Path) -> None:
    """Within 3 %, as the paper's rounded speeds do; one that is given needs none of it."""
    found = campaign(tmp_path, (2.0, 0.071), (4.0, 0.14), (-8.0, 0.28), (19.0, 0.68))
    assert found.period() == pytest.approx(0.0283, abs=4e-4)
    assert found.period(0.02) == 0.02


@pytest.mark.parametrize(
    "steps",
    [[(2.0, 0.07), (4.0, 0.10)], [(100.0, 0.1)], [(0.01, 0.1)], [(2.0, 0.0)]],
    ids=["two", "a second", "too short", "none"],
)
def test_no_period_is_guessed(steps: list[tuple[float, float]], tmp_path: Path) -> None:
    """Trials that disagree, a velocity step, a period below 1 ms, no speed."""
    with pytest.raises(TrialsError, match="give --period"):
        campaign(tmp_path, *steps).period()

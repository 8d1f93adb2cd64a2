"""Pages stand alone, hold every table and figure with its sentence, and cannot be broken by what users name things."""

import re
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from outline import outline
from pumafuse.identification.trials import Trial
from pumafuse.tuning.latency import AxisLag, LatencySummary, SensorLag
from pumafuse.views import report

DATA = Path(pf.__file__).parent / "data"
TIMES = np.arange(50) * 0.006


def trials(names: str = "t", axis: str = "tip", speeds: int = 4) -> pf.StepTrials:
    rng = np.random.default_rng(3)
    made = []
    for number in range(4 * speeds):
        step = 0.002 * (1 + number % speeds)
        c = 1.0 - np.exp(-np.maximum(TIMES - 0.05 - 0.002 * rng.standard_normal(), 0.0) / 0.03)
        position = step * c + 2e-5 * rng.standard_normal(len(TIMES))
        made.append(Trial(f"{names}{number}", axis, step, step / 0.02, {"tool": "ab"[number % 2]}, TIMES, position))
    return pf.StepTrials(tuple(made), ())


FIGURES = [
    "Every trial under its axis's common plant",
    "Delays",
    "Gain against speed",
    "How the coefficients scatter",
    "First or second order, by factor",
    "Is there one solution?",
    "Where the model holds",
]


def page_of(folder: Path, of: pf.StepTrials) -> str:
    report.write_identification(pf.identify(of), of, folder, False)
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.long
def test_the_page_of_the_recorded_campaign_has_the_papers_tables_and_figures(tmp_path: Path) -> None:
    """The paper's Tables I and II, Figs. 4 to 7, each figure under a sentence; nothing is loaded from elsewhere."""
    of = pf.StepTrials.read(DATA / "steps")
    text = page_of(tmp_path, of)
    found = outline(text)
    assert "The combined model" in found.headings and found.pictures == FIGURES
    for heading in ("What the coefficients depend on", *FIGURES):
        assert len(found.sentences[heading]) > 40, heading
    assert not re.search(r"""(src|href)=["'](?!#)""", text.replace('xlink:href="#', ""))
    assert "<script" not in text and "@import" not in text and "url(http" not in text
    for trial in of.trials:
        assert f"<td>{trial.name}</td>" in text
    assert "stiction" in text


@pytest.mark.long
def test_names_are_text_and_nothing_else(tmp_path: Path) -> None:
    """Trials and axes named like markup are shown as they are written, and the same trials give the same page."""
    text = page_of(tmp_path / "a", trials("<b>&</b>", axis="<i>tip$x$"))
    assert "&lt;b&gt;&amp;&lt;/b&gt;0" in text
    assert "<b>" not in text and "<i>" not in text
    outline(text)
    assert text == page_of(tmp_path / "b", trials("<b>&</b>", axis="<i>tip$x$"))


def test_a_verification_has_its_table_and_a_figure_for_each_run(tmp_path: Path) -> None:
    """Its errors, and measured beside modelled with the start level that was taken."""
    arm = pf.ArmModel.load("puma560-internal")
    runs = [pf.Run.read(DATA / "white-noise" / f"{axis}_8mm_r1") for axis in ("radial", "vertical")]
    report.write_verification([one for run in runs for one in pf.verify(run, arm)], arm, tmp_path, False)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    found = outline(text)
    assert "Root mean square error" in found.headings
    assert len(found.pictures) == 2
    assert text.count("chosen among the run&#39;s 2 levels by RMS") == 2


def test_lags_are_said_with_their_sign_and_in_the_units_of_each_program() -> None:
    """By hand: 84 ms are 16.8 steps of 5 ms; behind the path T/2 = 10 ms more; an earlier sensor is not a later one."""
    axis = AxisLag(
        sensor="tracker",
        lag=0.124,
        lag_ci95=(0.120, 0.128),
        delay=0.084,
        delay_ci95=(0.081, 0.087),
        shared_delay=False,
        plant="first-order",
        time_constant=0.04,
        time_constant_ci95=(0.036, 0.044),
        gain=1.0,
    )
    sensors = {"eye": SensorLag(latency=-0.037, latency_ci95=(-0.039, -0.035))}
    found = LatencySummary(
        pumafuse="", runs=["run"], sensor="tracker", update_period=0.02, axes={"x": axis}, sensors=sensors, notes=[]
    )
    said = " ".join(report.answers(found))
    assert "x is 124.0 (120.0 to 128.0) ms late" in said
    assert "eye is 37.0 (35.0 to 39.0) ms earlier than tracker." in said
    assert "behind the commanded path it is 10 ms more" in said
    programs = " ".join(report.elsewhere(found))
    assert "max_expected_latency [s]: 0.134" in programs
    assert "x 16 to 18" in programs
    assert "x 0.0400; actuator_delay [s]: x 0.0840" in programs

"""The report of a tuning stands alone, has every number and sentence, and draws the right likelihood."""

import html
import re
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from outline import outline
from pumafuse.fusion.consistency import consistency
from pumafuse.identification.trials import Trial
from pumafuse.model.arm import AxisModel
from pumafuse.model.plants import FirstOrder
from pumafuse.tuning.intervals import Profile
from pumafuse.tuning.latency import AxisLag, LatencySummary, SensorLag
from pumafuse.views import report
from pumafuse.views.tuning_report import page
from tuning_runs import fitted, quietly

T, END = 0.02, 20.0
STEADY = ("maneuver_noise_mm_rtHz_per_m_s", "maneuver_drift_mm_rts_per_m_s")  # fixed: the process noise is constant


def recorded(axis: str, sensor: str, name: str) -> pf.Run:
    """An arm with a delay of 30 ms and a time constant of 40 ms, seen with a noise of 0.2 mm."""
    rng = np.random.default_rng(1)
    stamp = np.arange(0.0, END, T)
    command = 0.001 * np.cumsum(rng.standard_normal(len(stamp)))
    fine = np.arange(0.0, END, 0.001)
    true = np.empty(len(fine))
    at = command[0]
    for number, aim in enumerate(command[np.maximum(((fine - 0.03) / T).astype(int), 0)]):
        at += 0.001 / 0.04 * (aim - at)
        true[number] = at
    true += 3e-4 * np.cumsum(np.sqrt(1e-3) * rng.standard_normal(len(fine)))
    seen = np.arange(0.1, END - 0.1, 0.0173)
    measurement = np.interp(seen, fine, true) + 2e-4 * rng.standard_normal(len(seen))
    return pf.Run.from_arrays(
        stamp, {axis: command}, {sensor: (seen, {axis: measurement})}, (fine, {axis: true}), name=name
    )


def known(axis: str, sensor: str) -> pf.FusionConfig:
    """The configuration before: too slow, too noisy."""
    model = AxisModel(plant=FirstOrder(time_constant=0.06))
    arm = pf.ArmModel(name="an arm", update_period=T, delay=0.05, axes={axis: model})
    return pf.FusionConfig(arm=arm, sensors={sensor: pf.Sensor(sd=5e-4)})


@cache
def tuned(axis: str = "tip", sensor: str = "camera", name: str = "a run") -> tuple[pf.Tuning, pf.Run]:
    run = recorded(axis, sensor, name)
    given = partial(pf.tune, [run], known(axis, sensor), fit=["noise", "delay", "plant"], fix=STEADY, profiles=True)
    return quietly(given), run


@cache
def shown() -> str:
    """The page of the default tuning."""
    found, run = tuned()
    return page(found, [run])


def drawn(found: pf.Tuning) -> dict[str, Profile]:
    return {one.key: one for one in found.profiles}


def test_every_part_of_the_page_is_there_and_nothing_is_loaded() -> None:
    """Parts in their order with sentences, pictures, and each parameter's numbers; all addresses are the page's own."""
    (found, _), text = tuned(), shown()
    seen = outline(text)
    parts = ["Tuning: a run", "What to know", "What was fitted", "Profiles of the likelihood", "Validation"]
    parts += ["Innovations before and after", "fusion.toml", "arm.toml"]
    assert seen.headings == parts
    for heading in (parts[0], *parts[2:6]):
        assert len(seen.sentences[heading]) > 60, heading
    assert seen.pictures == [parts[3], parts[5]]
    assert not re.search(r"""(src|href)=["'](?!#|data:image/png;base64,)""", text)
    assert "<script" not in text and "@import" not in text and "url(http" not in text
    assert len(found.details.parameters) == 5
    for one in found.details.parameters:
        row = re.search(rf"<tr><td>{re.escape(one.key)}</td>(.*)</tr>", text)
        assert row is not None, one.key
        low, high = ("…" if end is None else f"{end:.4g}" for end in one.ci95)
        cells = re.findall(r"<td[^>]*>([^<]*)</td>", row[1])
        assert cells == [f"{one.before:.4g}", f"{one.value:.4g}", f"{low} to {high}", one.notes]


@pytest.mark.long
def test_an_interval_ends_where_its_profile_has_dropped_by_half_a_chi_square() -> None:
    """At each closed end the curve is at −1.92, nowhere is it above 0, and it is 0 at the best value."""
    found, _ = tuned()
    curves, ends = drawn(found), 0
    assert curves.keys() == fitted(found).keys()
    for key, one in fitted(found).items():
        curve = curves[key]
        assert (np.diff(curve.values) > 0.0).all()
        assert curve.drop.max() == pytest.approx(0.0, abs=0.01)
        assert curve.values[np.argmax(curve.drop)] == pytest.approx(one.value, rel=1e-3, abs=0.01 * curve.values[-1])
        for end in one.ci95:
            if end:  # neither open nor none
                ends += 1
                assert np.interp(end, curve.values, curve.drop) == pytest.approx(-1.92, abs=0.25), key
    assert ends == 9
    noise = curves["process.tip.input_noise_mm_rtHz"]  # its interval includes 0: on a linear scale, from 0 on
    assert not noise.log and noise.values[0] < 0.01 * noise.values[-1] and (np.diff(noise.drop) < 0.0).all()


def test_the_page_has_the_numbers_of_fusions_and_the_files_as_they_are_written(tmp_path: Path) -> None:
    """NIS of the run before and after, each number of the validation, and what `pumafuse tune` writes."""
    (found, run), text = tuned(), shown()
    before, after = (consistency(pf.fuse(run, config), "camera", "tip") for config in (found.before, found.config))
    assert abs(after.nis - 1.0) < 0.1 < abs(before.nis - 1.0)
    sentence = outline(text).sentences["Innovations before and after"]
    assert f"tip, camera: NIS {before.nis:.2f} → {after.nis:.2f}" in sentence
    assert "came nearer to it for 1 of 1; 0 → 1 of 1 are white" in sentence
    (check,) = found.details.validation or ()
    old, new = check.before, check.after
    for part in (
        f"{old.sensors['camera'].nis:.2f} → {new.sensors['camera'].nis:.2f}",
        f"{old.rmse_mm:.3f} → {new.rmse_mm:.3f}",
        f"{old.coverage:.3f} → {new.coverage:.3f}",
        check.verdict,
    ):
        assert part in text
    (answer,) = re.findall('<p class="says answer">(.*)</p>', text)
    assert "Better on 1 of 1 axis, on measurements that nothing had been fitted on." in answer
    assert "The error bars hold on 1 of 1." in answer
    found.config.save(tmp_path)
    files = [html.unescape(text) for text in re.findall(r"<pre>(.*?)</pre>", text, re.DOTALL)]
    assert files == [(tmp_path / name).read_text(encoding="utf-8") for name in ("fusion.toml", "arm.toml")]


@pytest.mark.long
def test_an_interrupted_tuning_has_a_page_too() -> None:
    """With what was fitted until then, and without profiles, as it is no maximum."""
    run = recorded("tip", "camera", "a run")

    def interrupt(what: str, _: object) -> None:
        if what == "searching":
            raise KeyboardInterrupt

    found = quietly(lambda: pf.tune([run], known("tip", "camera"), fit=["noise"], progress=interrupt))
    seen = outline(page(found, [run]))
    assert found.details.interrupted
    assert "Profiles of the likelihood" not in seen.headings
    assert seen.pictures == ["Innovations before and after"]


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

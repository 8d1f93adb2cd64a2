"""The report of a tuning stands alone, has every number and sentence, and draws the right likelihood."""

from __future__ import annotations

import html
import re
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import pumafuse as pf
from outline import outline
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.consistency import consistency, densities_of
from pumafuse.model.arm import AxisModel
from pumafuse.model.plants import FirstOrder
from pumafuse.tuning.intervals import Profile
from pumafuse.views import colours as style
from pumafuse.views import tuning_report
from pumafuse.views.tuning_report import page
from tuning_runs import fitted, quietly, with_sensors

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


def test_the_profile_of_a_lone_parameter_is_the_likelihood_of_a_fusion() -> None:
    """With all else fixed, the curve is the log density of what `fuse` reports, less the one at the best."""
    run, config = recorded("tip", "camera", "a run"), known("tip", "camera")
    found = quietly(lambda: pf.tune([run], config, fix=["process"], sd_prior=False, profiles=True))
    (curve,) = drawn(found).values()
    assert curve.key == "sensors.camera.sd_mm.tip"
    assert curve.log

    def height(sd: float) -> float:
        est = pf.fuse(run, with_sensors(config, sd=sd))
        return float(densities_of(est.measurements, est.config.sensors).sum())

    heights = np.array([height(value * 1e-3) for value in curve.values])
    np.testing.assert_allclose(curve.drop, heights - heights[np.argmax(curve.drop)], atol=1e-3)
    assert curve.drop.min() < -3.0


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved, kept to look into them."""
    kept: list[Figure] = []
    save = Figure.savefig

    def keep(figure: Figure, *args: object, **more: object) -> None:
        kept.append(figure)
        save(figure, *args, **more)

    monkeypatch.setattr(Figure, "savefig", keep)
    return kept


def test_panels_show_profile_interval_and_the_number_before(figures: list[Figure]) -> None:
    """A panel for each: a curve through the profile, the interval shaded, a tick at what it was or an arrow to it."""
    found, _ = tuned()
    tuning_report.profile_figure(list(drawn(found).values()), fitted(found))
    panels = {axes.get_title(loc="left").replace("\n", "."): axes for axes in figures[0].axes if axes.get_visible()}
    assert panels.keys() == fitted(found).keys()
    for key, axes in panels.items():
        one, profile = fitted(found)[key], drawn(found)[key]
        (curve,) = (line for line in axes.lines if len(line.get_xdata()) > 2)
        at, drop = np.asarray(curve.get_xdata()), np.asarray(curve.get_ydata())
        np.testing.assert_allclose(np.interp(profile.values, at, drop), profile.drop, atol=0.02)
        (shaded,) = axes.patches
        box = shaded.get_extents().transformed(axes.transData.inverted())
        np.testing.assert_allclose((box.x0, box.x1), one.ci95, rtol=1e-6, atol=0.01 * at[-1])
        ticks = [line.get_xdata()[0] for line in axes.lines if line.get_color() == style.REJECTED]
        arrows = [text.get_text() for text in axes.texts]
        within = one.before < profile.values[-1]
        assert (ticks, arrows) == (([one.before], []) if within else ([], [f"{one.before:.4g} →"]))


def test_innovations_are_shown_before_and_after_on_one_scale(figures: list[Figure]) -> None:
    """Those that were fused, over their standard deviations; and the autocorrelations of both."""
    found, run = tuned()
    pair = [pf.fuse(run, config) for config in (found.before, found.config)]
    tests = tuple(consistency(est, "camera", "tip") for est in pair)
    tuning_report.innovation_figure(*pair, "camera", "tip", tests)
    *series, correlation = figures[0].axes
    for axes, est in zip(series, pair, strict=True):
        fused = est.measurements.where(est.measurements.outcome == Outcome.FUSED)
        (dots,) = axes.lines
        np.testing.assert_array_equal(dots.get_xdata(), fused.time)
        np.testing.assert_array_equal(dots.get_ydata(), fused.innovation / fused.innovation_sd)
    assert series[0].get_ylim() == series[1].get_ylim()
    bars = [bar.get_height() for bars in correlation.containers for bar in bars]
    np.testing.assert_array_equal(bars, np.concatenate([one.correlation for one in tests if one is not None]))


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
def test_names_are_text_and_nothing_else() -> None:
    """Runs, sensors and axes named like markup or mathematics are shown as they are written."""
    found, run = tuned("<i>tip$x^$", "<b>&</b>", "<u>run</u>")
    text = page(found, [run])
    outline(text)
    assert "sensors.&lt;b&gt;&amp;&lt;/b&gt;.sd_mm.&lt;i&gt;tip$x^$" in text
    assert "Tuning: &lt;u&gt;run&lt;/u&gt;" in text
    assert not re.search("<[biu]>", text)


@pytest.mark.parametrize("after", ["searching", "validating"])
def test_an_interrupted_tuning_has_a_page_too(after: str) -> None:
    """With what was fitted until then, and without profiles, as it is no maximum."""
    run = recorded("tip", "camera", "a run")

    def interrupt(what: str, _: object) -> None:
        if what == after:
            raise KeyboardInterrupt

    found = quietly(lambda: pf.tune([run], known("tip", "camera"), fit=["noise"], progress=interrupt))
    seen = outline(page(found, [run]))
    assert found.details.interrupted
    assert "Profiles of the likelihood" not in seen.headings
    assert seen.pictures == ["Innovations before and after"]

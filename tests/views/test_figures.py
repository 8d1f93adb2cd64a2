"""Figures are drawn for every kind of run, show what the estimates say, and leave nothing open behind them."""

from __future__ import annotations

import gc
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import pumafuse as pf
from pumafuse.fusion.consistency import consistency
from pumafuse.logs.frames import Cylindrical
from pumafuse.views.figures import error_figure, fused_figure, validation_figure

NAMES = ("tangential", "radial", "vertical")
WIDTH_PX, PANEL_PX, MARGIN_PX = 13.0 * 130, 2.4 * 130, 0.8 * 130


@dataclass(frozen=True)
class Case:
    """A run, fused, and how many panels each figure has below one another."""

    run: pf.Run
    est: pf.Estimates
    fused: int
    validated: int


def moved(time: np.ndarray, axis: int) -> np.ndarray:
    """Where the arm is commanded to be [m]: a slow way out, another for each axis."""
    return 0.4 + 0.01 * (axis + 1) * np.sin(time)


def case(
    *,
    axes: int = 3,
    commands: int = 60,
    sensors: tuple[str, ...] = ("camera",),
    reference: bool = True,
    frame: bool = False,
    bias: float = 0.0,
    scale: float = 1.0,
    outlier: bool = False,
) -> Case:
    """A run of a second or two, seen at 100 Hz from its first command on."""
    rng = np.random.default_rng(7)
    names = ("x", "y", "z")[:axes] if frame else NAMES[:axes]
    time = 10.0 + 0.028 * np.arange(commands)
    seen = np.arange(10.01, time[-1] + 0.02, 0.01)
    true = {name: moved(np.maximum(seen - 10.1, 0.0), axis) for axis, name in enumerate(names)}

    def measurements() -> tuple[np.ndarray, dict[str, np.ndarray]]:
        noisy = {name: scale * value + bias + 5e-4 * rng.standard_normal(len(seen)) for name, value in true.items()}
        if outlier:
            noisy[names[0]][len(seen) // 2] += 0.2
        return seen, noisy

    run = pf.Run.from_arrays(
        time,
        {name: moved(time - 10.0, axis) for axis, name in enumerate(names)},
        {name: measurements() for name in sensors},
        (seen, true) if reference else None,
        frame=Cylindrical() if frame else None,
        name="a run",
    )
    sensor = pf.Sensor(sd=5e-4, gate=5.0, scale=scale, bias_sd=1.0 if bias else 0.0)
    process = dict.fromkeys(NAMES, pf.Process(input_noise=1e-3, drift=5e-3))
    config = pf.FusionConfig(
        arm=pf.ArmModel.load("puma560-internal"), process=process, sensors=dict.fromkeys(sensors, sensor)
    )
    return Case(run, pf.fuse(run, config), axes, axes * len(sensors))


CASES: dict[str, Callable[[], Case]] = {
    "three axes": case,
    "no reference": lambda: case(axes=1, reference=False),
    "commands and nothing else": lambda: case(axes=1, sensors=(), reference=False),
    "a biased sensor": lambda: case(axes=1, bias=-0.3, scale=-1.0),
    "a frame": lambda: case(axes=2, frame=True),
    "an outlier": lambda: case(axes=1, outlier=True),
}


def check_png(path: Path, rows: int) -> None:
    """A PNG of 13 inches by 2.4 inches a row at 130 dpi, and of a size that is neither empty nor unreasonable."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    assert width == pytest.approx(WIDTH_PX, abs=1)
    assert height == pytest.approx(rows * PANEL_PX + MARGIN_PX, abs=1)
    assert 10_000 < len(data) < 2_000_000
    assert data[-8:-4] == b"IEND"


@pytest.mark.parametrize(
    "name", ["three axes", *(pytest.param(name, marks=pytest.mark.long) for name in CASES if name != "three axes")]
)
def test_every_figure_is_drawn_for_every_kind_of_run(name: str, tmp_path: Path) -> None:
    """With and without reference, sensors, frame and bias: a whole PNG each, and nothing where there is nothing."""
    this = CASES[name]()
    fused_figure(this.est, this.run, tmp_path / "fused.png")
    check_png(tmp_path / "fused.png", this.fused)
    validation_figure(this.est, tmp_path / "validation.png")
    if this.validated:
        check_png(tmp_path / "validation.png", this.validated)
    else:
        assert not (tmp_path / "validation.png").exists()
    if this.est.reference is None:
        with pytest.raises(ValueError, match="no reference"):
            error_figure(this.est, tmp_path / "error.png")
    else:
        error_figure(this.est, tmp_path / "error.png")
        check_png(tmp_path / "error.png", this.fused)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved, kept to look into them; no file is written."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    return figures


def line(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of the one line of this label."""
    (found,) = [line for line in axes.lines if line.get_label() == label]
    return np.asarray(found.get_xdata()), np.asarray(found.get_ydata())


def test_the_fused_figure_shows_command_estimate_and_measurements(drawn: list[Figure], tmp_path: Path) -> None:
    """In mm against seconds since the first command; each axis twice, whole and zoomed in."""
    this = case(axes=2)
    fused_figure(this.est, this.run, tmp_path / "none.png")
    panels = drawn[0].axes
    assert len(panels) == 4
    for number, name in enumerate(NAMES[:2]):
        for axes in panels[2 * number : 2 * number + 2]:
            time, value = line(axes, "command")
            np.testing.assert_allclose(time, 0.028 * np.arange(60), atol=1e-9)
            np.testing.assert_allclose(value, this.run.command.values[name] * 1e3)
            time, value = line(axes, "estimate")
            np.testing.assert_allclose(time, this.est.time)
            np.testing.assert_allclose(value, this.est[name].position * 1e3)
            time, value = line(axes, "camera")
            np.testing.assert_allclose(time, this.run.sensors["camera"].stamp / 1e9 - 10.0, atol=1e-9)
            np.testing.assert_allclose(value, this.run.sensors["camera"].values[name] * 1e3)


def test_a_rejected_measurement_is_crossed_out(drawn: list[Figure], tmp_path: Path) -> None:
    """The outlier alone carries the cross, and is not among the dots."""
    this = case(axes=1, outlier=True)
    fused_figure(this.est, this.run, tmp_path / "none.png")
    _, rejected = line(drawn[0].axes[0], "camera, rejected")
    _, fused = line(drawn[0].axes[0], "camera")
    assert rejected == pytest.approx([400.0 + 200.0], abs=25.0)
    assert np.ptp(fused) < 30.0


def test_the_error_figure_draws_and_names_the_error(drawn: list[Figure], tmp_path: Path) -> None:
    """Its line is estimate − reference, its title the root mean square that `score` finds."""
    this = case()
    error_figure(this.est, tmp_path / "none.png")
    est = this.est
    for axes, name in zip(drawn[0].axes, NAMES, strict=True):
        found = pf.score(est.time, est.segment, est[name].position, est[name].position_sd, est.reference, name)
        assert axes.get_title(loc="left") == f"{name}: RMS error {found.rmse * 1e3:.3f} mm"
        _, error = line(axes, "estimate")
        true = np.interp(est.time, est.reference.time, est.reference.position[name])
        known = np.isfinite(error)
        assert known.sum() == found.rows
        np.testing.assert_allclose(error[known], (est[name].position - true)[known] * 1e3, atol=1e-9)


def test_the_validation_figure_draws_what_it_judges(drawn: list[Figure], tmp_path: Path) -> None:
    """Each row: the fused components' ν/√S, their autocorrelation as bars, and the verdict above."""
    this = case(axes=2, outlier=True)
    validation_figure(this.est, tmp_path / "none.png")
    for number, name in enumerate(NAMES[:2]):
        series, _, correlation = drawn[0].axes[3 * number : 3 * number + 3]
        found = consistency(this.est, "camera", name)
        (dots,) = series.lines
        mine = this.est.measurements.of("camera", name)
        mine = mine.where(mine.outcome == pf.Outcome.FUSED)
        np.testing.assert_allclose(dots.get_ydata(), mine.innovation / mine.innovation_sd)
        assert len(mine.value) == len(this.run.sensors["camera"].stamp) - 1
        assert series.get_title(loc="left") == f"{name}, camera. {found.verdict}"
        np.testing.assert_allclose([bar.get_height() for bar in correlation.patches[:20]], found.correlation)


def in_memory() -> int:
    """How many figures there are."""
    gc.collect()
    return sum(isinstance(thing, Figure) for thing in gc.get_objects())


def test_nothing_stays_open(tmp_path: Path) -> None:
    """After each kind of figure none is known to pyplot and none is left in memory."""
    this, before = case(axes=1), in_memory()
    fused_figure(this.est, this.run, tmp_path / "fused.png")
    error_figure(this.est, tmp_path / "error.png")
    validation_figure(this.est, tmp_path / "validation.png")
    assert plt.get_fignums() == []
    assert in_memory() <= before

"""Figures are drawn for every kind of run and show what the estimates say."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import pumafuse as pf
from pumafuse.fusion.consistency import consistency
from pumafuse.fusion.verdicts import sentence
from pumafuse.logs.frames import Cylindrical
from pumafuse.views.figures import error_figure, fused_figure, validation_figure

NAMES = ("tangential", "radial", "vertical")


def moved(time: np.ndarray, axis: int) -> np.ndarray:
    """Where the arm is commanded to be [m]: a slow way out, another for each axis."""
    return 0.4 + 0.01 * (axis + 1) * np.sin(time)


def case(
    *,
    axes: int = 3,
    sensors: tuple[str, ...] = ("camera",),
    reference: bool = True,
    frame: bool = False,
    bias: float = 0.0,
    scale: float = 1.0,
    outlier: bool = False,
) -> tuple[pf.Estimates, pf.Run]:
    """A run of a second or two, seen at 100 Hz from its first command on."""
    rng = np.random.default_rng(7)
    names = ("x", "y", "z")[:axes] if frame else NAMES[:axes]
    time = 10.0 + 0.028 * np.arange(60)
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
    return pf.fuse(run, config), run


def panels(figure: Figure | None) -> float:
    """How many rows of 2.4 inch a picture of 13 inch has, beside its 0.8 inch of title; 0 for none."""
    if figure is None:
        return 0
    width, height = figure.get_size_inches()
    assert width == pytest.approx(13.0)
    return round((float(height) - 0.8) / 2.4, 2)


@pytest.mark.parametrize(
    ("what", "rows", "validated"),
    [
        ({"axes": 2, "frame": True}, 2, 2),
        ({"axes": 1, "sensors": (), "reference": False}, 1, 0),
    ],
)
def test_every_figure_is_drawn_for_every_kind_of_run(what: dict, rows: int, validated: int, tmp_path: Path) -> None:
    """With and without reference, sensors and frame: a whole picture each, and none where there is nothing."""
    est, _ = case(**what)
    drawn = [fused_figure(est), validation_figure(est)]
    if est.reference is None:
        with pytest.raises(ValueError, match="no reference"):
            error_figure(est)
    else:
        drawn.append(error_figure(est))
    assert list(map(panels, drawn)) == [2 * rows, validated, *([rows] if est.reference is not None else [])]
    for figure in filter(None, drawn):
        figure.savefig(tmp_path / "any.png")


def line(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of the one line of this label."""
    (found,) = [line for line in axes.lines if line.get_label() == label]
    return np.asarray(found.get_xdata()), np.asarray(found.get_ydata())


def test_the_fused_figure_shows_command_estimate_measurements_and_reference() -> None:
    """In mm against seconds since the first command; each axis twice; a cross where the axis itself was rejected."""
    est, run = case(axes=2, outlier=True)
    every = fused_figure(est).axes
    for number, name in enumerate(NAMES[:2]):
        for axes in every[4 * number : 4 * number + 2]:
            seen = run.sensors["camera"]
            good = np.arange(len(seen.stamp)) != len(seen.stamp) // 2  # the whole row of an outlier is rejected
            for label, wanted_time, wanted in (
                ("command", 0.028 * np.arange(60), run.command.values[name]),
                ("estimate", est.time, est[name].position),
                ("reference", est.reference.time, est.reference.position[name]),
                ("camera", seen.stamp[good] / 1e9 - 10.0, seen.values[name][good]),
            ):
                time, value = line(axes, label)
                np.testing.assert_allclose(time, wanted_time, atol=1e-9)
                np.testing.assert_allclose(value, wanted * 1e3)
            label = "camera, rejected" if number == 0 else "camera, with its row"
            assert line(axes, label)[1] == pytest.approx(seen.values[name][~good] * 1e3)


def test_a_measurement_after_the_last_estimate_has_no_difference_from_it() -> None:
    """The estimate is not held on: the arm moves, and that would look like an error."""
    est, _ = case(axes=1)
    time, left = line(fused_figure(est).axes[2], "camera")
    np.testing.assert_array_equal(np.isnan(left), time > est.time[-1])
    assert np.isnan(left).any()


def test_the_validation_figure_draws_what_it_judges() -> None:
    """Each row: the fused components' ν/√S, their autocorrelation as bars, and the verdict above."""
    est, run = case(axes=2, outlier=True)
    figure = validation_figure(est)
    for number, name in enumerate(NAMES[:2]):
        series, _, correlation = figure.axes[3 * number : 3 * number + 3]
        found = consistency(est, "camera", name)
        (dots,) = series.lines
        mine = est.measurements.of("camera", name)
        mine = mine.where(mine.outcome == pf.Outcome.FUSED)
        np.testing.assert_allclose(dots.get_ydata(), mine.innovation / mine.innovation_sd)
        assert len(mine.value) == len(run.sensors["camera"].stamp) - 1
        assert series.get_title(loc="left") == f"{name}, camera. {sentence(found)}"
        np.testing.assert_allclose([bar.get_height() for bar in correlation.patches[:20]], found.correlation)

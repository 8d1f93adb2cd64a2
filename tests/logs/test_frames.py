"""Frames: logs in x, y, z as tangential, radial and vertical, against trigonometry done the other way round.

A path is made from radii and angles with cos and sin; what the frame makes of its x and y must be those numbers again.
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.logs.axes import in_axes
from pumafuse.logs.frames import Cylindrical, Frame, Placed, Rotated
from pumafuse.logs.source import Source
from refusals import one_line

SIGN = {"counterclockwise": 1.0, "clockwise": -1.0}
EXACT = 1e-12  # m

directions = st.sampled_from(sorted(SIGN))
coordinates = st.floats(-2.0, 2.0)
radii = st.floats(0.05, 2.0)


@dataclass(frozen=True)
class Path2D:
    """A way round a base: angles [rad] that are not wrapped, and radii [m]."""

    base: tuple[float, float]
    angle: np.ndarray
    radius: np.ndarray

    @property
    def x(self) -> np.ndarray:
        return np.array([self.base[0] + r * math.cos(a) for r, a in zip(self.radius, self.angle, strict=True)])

    @property
    def y(self) -> np.ndarray:
        return np.array([self.base[1] + r * math.sin(a) for r, a in zip(self.radius, self.angle, strict=True)])


@st.composite
def paths(draw: st.DrawFn) -> tuple[Path2D, Path2D]:
    """Commands that turn by less than half a turn each, and what a sensor sees less than half a turn from them."""
    count = draw(st.integers(2, 30))
    turns = draw(st.lists(st.floats(-3.0, 3.0), min_size=count - 1, max_size=count - 1))
    apart = np.array(draw(st.lists(st.floats(-3.0, 3.0), min_size=count, max_size=count)))
    base = draw(st.tuples(coordinates, coordinates))
    angle = np.cumsum([draw(st.floats(-math.pi, math.pi)), *turns])
    commanded, seen = (np.array(draw(st.lists(radii, min_size=count, max_size=count))) for _ in range(2))
    return Path2D(base, angle, commanded), Path2D(base, angle + apart, seen)


def stamps(count: int) -> np.ndarray:
    return 1_000_000_000 + 28_000_000 * np.arange(count)


def logged(path: Path2D, seen: Path2D | None = None, frame: Frame | None = None, **more: object) -> pf.Run:
    """A run whose commands, and whose camera if there is one, follow paths in x and y."""
    time = stamps(len(path.angle))
    sensors = None if seen is None else {"camera": (time, {"x": seen.x, "y": seen.y})}
    return pf.Run.from_arrays(time, {"x": path.x, "y": path.y}, sensors, frame=frame, **more)


def config(frame: Frame | None = None, sd: float = 1e-3, **process: float) -> pf.FusionConfig:
    arm = pf.ArmModel.load("puma560-internal")
    noise = {axis: pf.Process(**process) for axis in arm.axes}
    return pf.FusionConfig(arm=arm, process=noise, frame=frame, sensors={"camera": pf.Sensor(sd=sd, gate=0.0)})


refusal = partial(one_line, pf.RunError)


def check(source: Source, placed: Placed, wanted: Path2D, tangential: np.ndarray, radial: np.ndarray) -> None:
    """A source is at these positions of the axes, and they are the path's x and y."""
    pairs = [(source.values["tangential"], tangential), (source.values["radial"], radial)]
    pairs += zip(placed.to_log(tangential, radial), (wanted.x, wanted.y), strict=True)
    for found, right in pairs:
        np.testing.assert_allclose(found, right, rtol=0, atol=EXACT)


@settings(max_examples=60)
@given(paths(), directions)
def test_cylindrical_axes_are_radius_and_arc(drawn: tuple[Path2D, Path2D], positive: str) -> None:
    """Radial = r, tangential = ±R0·(θ − θ0) over several turns, a sensor's turns those of the commands; and back."""
    path, measured = drawn
    run, placed = in_axes(logged(path, measured, Cylindrical(base=path.base, positive=positive)), None)
    for source, wanted in ((run.command, path), (run.sensors["camera"], measured)):
        arc = SIGN[positive] * path.radius[0] * (wanted.angle - path.angle[0])
        check(source, placed, wanted, arc, wanted.radius)


@settings(max_examples=60)
@given(paths(), directions, st.floats(-720.0, 720.0))
def test_rotated_axes_are_a_fixed_rotation(drawn: tuple[Path2D, Path2D], positive: str, azimuth: float) -> None:
    """(x + iy)·e^(−i·azimuth) = radial ± i·tangential: to the left of radial, or to its right; and back to x, y."""
    path, seen = drawn
    run, placed = in_axes(logged(path, seen, Rotated(azimuth=math.radians(azimuth), positive=positive)), None)
    turn = math.cos(math.radians(azimuth)) - 1j * math.sin(math.radians(azimuth))
    for source, wanted in ((run.command, path), (run.sensors["camera"], seen)):
        turned = (wanted.x + 1j * wanted.y) * turn
        check(source, placed, wanted, SIGN[positive] * turned.imag, turned.real)


def test_sensors_are_placed_by_the_command_of_their_own_time() -> None:
    """After two turns a measurement at the first command's place is two turns on, whatever its row in the file."""
    path = Path2D((0.0, 0.0), np.linspace(0.0, 4.0 * math.pi, 33), np.full(33, 0.5))
    late, early = stamps(33)[[-1, 0]]
    run = pf.Run.from_arrays(
        stamps(33),
        {"x": path.x, "y": path.y},
        {"camera": (np.array([late, early]), {"x": np.array([0.4, 0.4]), "y": np.zeros(2)})},
        frame=Cylindrical(),
    )
    found = in_axes(run, None)[0].sensors["camera"].values["tangential"]
    np.testing.assert_allclose(found, [0.5 * 4.0 * math.pi, 0.0], atol=EXACT)


def test_without_a_start_level_the_first_command_places_the_frame() -> None:
    """First by its stamp, not by its row, and only if it has both x and y."""
    time = stamps(4)[[2, 1, 0, 3]]
    values = {"x": [0.5, 0.0, np.nan, 0.6], "y": [0.1, 0.3, 0.2, 0.0]}
    found = in_axes(pf.Run.from_arrays(time, values, frame=Cylindrical()), None)[0].command.values
    assert found["tangential"][1] == pytest.approx(0.0, abs=1e-15)
    assert found["tangential"][3] == pytest.approx(-0.3 * math.pi / 2.0)
    assert found["radial"][[1, 3]] == pytest.approx([0.3, 0.6])


def test_sources_that_name_axes_are_taken_as_they_are() -> None:
    """Beside commands in x, y, z a sensor that names axes keeps its values to the bit, and its noise."""
    path = Path2D((0.0, 0.0), np.linspace(0.0, 1.0, 5), np.full(5, 0.5))
    own = {"radial": np.array([-0.1, 7.0, np.nan, 0.0, 1e-9]), "vertical": np.arange(5.0)}
    run = pf.Run.from_arrays(
        stamps(5), {"x": path.x, "y": path.y, "z": np.zeros(5)}, {"range": (stamps(5), own)}, frame=Cylindrical()
    )
    found = in_axes(run, None)[0].sensors["range"]
    assert set(found.values) == set(own)
    assert not found.spread
    for axis, values in own.items():
        np.testing.assert_array_equal(found.values[axis], values)


X, Y, Z = [0.5, 0.6], [0.0, 0.1], [0.0, 0.0]


@pytest.mark.parametrize(
    ("command", "camera", "message"),
    [
        ({"x": X, "y": Y}, {"x": X}, "camera: gives x without y"),
        ({"x": X, "y": Y}, {"x": X, "y": Y, "radial": X}, "camera: gives radial both by its name and by x, y"),
        ({"x": [0.2, 0.3], "y": [-0.1, 0.0]}, None, "starts on its base's axis"),
        ({"x": X, "z": Z}, None, "give the commands, or start, in x and y"),
        ({"x": [0.5, np.nan], "y": [np.nan, 0.1]}, None, "no command has both x and y"),
    ],
)
def test_what_a_frame_cannot_place_is_refused(
    command: dict[str, list[float]], camera: dict[str, list[float]] | None, message: str
) -> None:
    """Half a position, one axis twice, and a start without an angle: one line that names the source."""
    sensors = None if camera is None else {"camera": (stamps(2), camera)}
    run = pf.Run.from_arrays(stamps(2), command, sensors, frame=Cylindrical(base=(0.2, -0.1)))
    assert message in refusal(lambda: in_axes(run, None))


def test_tangential_and_radial_need_both_x_and_y_vertical_needs_neither() -> None:
    """NaN where one is missing or infinite, and on the base's axis, where there is no angle; no turn is lost."""
    x, y = [0.5, np.nan, 0.0, -0.1, 0.0, np.inf, 0.1], [0.0, 0.1, np.nan, 0.5, 0.0, 0.1, -np.inf]
    z = [0.0, 0.0, 0.0, np.nan, 0.0, 0.0, 0.0]
    run = pf.Run.from_arrays(stamps(7), {"x": x, "y": y, "z": z}, frame=Cylindrical())
    found = in_axes(run, None)[0].command.values
    assert np.flatnonzero(np.isnan(found["tangential"])).tolist() == [1, 2, 4, 5, 6]
    assert np.flatnonzero(np.isnan(found["radial"])).tolist() == [1, 2, 4, 5, 6]
    assert np.flatnonzero(np.isnan(found["vertical"])).tolist() == [3]
    assert found["tangential"][3] == pytest.approx(0.5 * math.atan2(0.5, -0.1))


def test_commands_in_x_y_z_without_a_frame_are_refused_with_what_is_missing() -> None:
    run = pf.Run.from_arrays(stamps(2), {"x": X, "y": Y, "z": Z})
    message = refusal(lambda: pf.fuse(run, config()))
    assert message == (
        "command: commands are in x, y, z, the arm 'PUMA 560, internal ALTER' has tangential, radial, vertical: write"
        " an arm.toml with axes x, y, z, or give a [frame] in run.toml or fusion.toml"
    )


@pytest.mark.parametrize(
    ("file", "frame", "tangential", "radial"),
    [
        ("log.csv", "", 500.0, 100.0),  # at azimuth 0 radial is x and tangential y
        ("run.toml", '[frame]\nkind = "rotated"\nazimuth_deg = 90.0\n', -100.0, 500.0),
        ("run.toml", '[frame]\nkind = "cylindrical"\nbase_mm = [100.0, 200]\npositive = "clockwise"\n', 0.0, 300.0),
    ],
)
def test_the_frame_of_the_run_beats_that_of_fusion_toml(
    tmp_path: Path, file: str, frame: str, tangential: float, radial: float
) -> None:
    """A single table cannot hold a frame, a manifest need not; files are in mm and degrees; estimates get x, y back."""
    (tmp_path / "log.csv").write_text("time_s,command.x_mm,command.y_mm\n0,100,500\n0.028,100,500\n")
    command = '[command]\nfile = "log.csv"\ntime = "time_s"\nx = "command.x_mm"\ny = "command.y_mm"\n'
    (tmp_path / "run.toml").write_text(command + frame)
    own = '[frame]\nkind = "rotated"\nazimuth_deg = 0.0\n'
    (tmp_path / "fusion.toml").write_text('arm = "puma560-internal"\n' + own)
    est = pf.fuse(pf.Run.read(tmp_path / file), pf.FusionConfig.load(tmp_path / "fusion.toml"))
    assert est["tangential"].position[-1] * 1e3 == pytest.approx(tangential)
    assert est["radial"].position[-1] * 1e3 == pytest.approx(radial)
    assert (est.cartesian["x"][0], est.cartesian["y"][0]) == pytest.approx((0.1, 0.5))


@settings(max_examples=10)
@given(st.lists(st.floats(0.2, 1.5), min_size=8, max_size=8), st.floats(0.3, 0.65))
def test_tangential_noise_grows_as_the_lever_shortens(seen: list[float], start: float) -> None:
    """S = P + (sd·R0/r)² on tangential, P + sd² on radial; P is what the measurements before leave of the offset.

    Without process noise the offset is a constant: its information is 1/σ0² + Σ 1/R.
    """
    sd, prior = 2e-3, 5e-3
    camera = Path2D((0.0, 0.0), np.full(8, 0.3), np.array(seen))
    path = Path2D((0.0, 0.0), np.full(8, 0.3), np.full(8, start))
    est = pf.fuse(logged(path, camera, Cylindrical()), config(sd=sd, input_noise=0.0, drift=0.0))
    for axis, R in (("tangential", (sd * start / np.array(seen)) ** 2), ("radial", np.full(8, sd**2))):
        information = 1.0 / prior**2 + np.concatenate(([0.0], np.cumsum(1.0 / R)[:-1]))
        np.testing.assert_allclose(
            est.measurements.of("camera", axis).innovation_sd, np.sqrt(1.0 / information + R), rtol=1e-9
        )

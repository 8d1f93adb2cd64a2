"""Frames: logs in x, y, z as tangential, radial and vertical, against trigonometry done the other way round.

A path is made from radii and angles with cos and sin; what the frame makes of its x and y must be those numbers again.
"""

from __future__ import annotations

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
from pumafuse.logs.frames import Cylindrical, Frame, Rotated
from refusals import one_line

PERIOD = 0.028
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


@settings(derandomize=True, deadline=None, max_examples=60)
@given(paths(), directions)
def test_cylindrical_axes_are_radius_and_arc(drawn: tuple[Path2D, Path2D], positive: str) -> None:
    """Radial = r, tangential = ±R0·(θ − θ0) over several turns, a sensor's turns those of the commands; and back."""
    path, measured = drawn
    run, placed = in_axes(logged(path, measured, Cylindrical(base=path.base, positive=positive)), None)
    for source, wanted in ((run.command, path), (run.sensors["camera"], measured)):
        tangential, radial = source.values["tangential"], source.values["radial"]
        arc = SIGN[positive] * path.radius[0] * (wanted.angle - path.angle[0])
        np.testing.assert_allclose(tangential, arc, rtol=0, atol=EXACT)
        np.testing.assert_allclose(radial, wanted.radius, rtol=0, atol=EXACT)
        x, y = placed.to_log(tangential, radial)
        np.testing.assert_allclose(x, wanted.x, rtol=0, atol=EXACT)
        np.testing.assert_allclose(y, wanted.y, rtol=0, atol=EXACT)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(paths(), directions, st.floats(-720.0, 720.0))
def test_rotated_axes_are_a_fixed_rotation(drawn: tuple[Path2D, Path2D], positive: str, azimuth: float) -> None:
    """(x + iy)·e^(−i·azimuth) = radial ± i·tangential: to the left of radial, or to its right; and back to x, y."""
    path, seen = drawn
    run, placed = in_axes(logged(path, seen, Rotated(azimuth=azimuth, positive=positive)), None)
    turn = math.cos(math.radians(azimuth)) - 1j * math.sin(math.radians(azimuth))
    for source, wanted in ((run.command, path), (run.sensors["camera"], seen)):
        turned = (wanted.x + 1j * wanted.y) * turn
        np.testing.assert_allclose(source.values["radial"], turned.real, rtol=0, atol=EXACT)
        np.testing.assert_allclose(source.values["tangential"], SIGN[positive] * turned.imag, rtol=0, atol=EXACT)
        x, y = placed.to_log(source.values["tangential"], source.values["radial"])
        np.testing.assert_allclose(x, wanted.x, rtol=0, atol=EXACT)
        np.testing.assert_allclose(y, wanted.y, rtol=0, atol=EXACT)


@pytest.mark.parametrize(("positive", "way"), [("counterclockwise", 1.0), ("clockwise", -1.0)])
@pytest.mark.parametrize("kind", ["cylindrical", "rotated"])
def test_directions_are_seen_from_above(kind: str, positive: str, way: float) -> None:
    """With x to the right and y up, going up on the right of the base is counterclockwise."""
    frame = Cylindrical(positive=positive) if kind == "cylindrical" else Rotated(azimuth=0.0, positive=positive)
    run = pf.Run.from_arrays(stamps(2), {"x": [0.6, 0.6], "y": [0.0, 1e-3]}, frame=frame)
    moved = np.diff(in_axes(run, None)[0].command.values["tangential"])
    assert moved == pytest.approx(way * 1e-3, rel=1e-5)


def test_the_turns_count_from_the_start_level() -> None:
    """At rest at 179°, first commanded to −179°: that is 2° on, not 358° back."""
    degree = math.pi / 180.0
    start = {"x": 0.5 * math.cos(179.0 * degree), "y": 0.5 * math.sin(179.0 * degree)}
    path = Path2D((0.0, 0.0), np.array([-179.0, -178.0]) * degree, np.full(2, 0.5))
    found = in_axes(logged(path, path, Cylindrical(), start=start), None)[0]
    for source in (found.command, found.sensors["camera"]):
        np.testing.assert_allclose(source.values["tangential"], np.array([1.0, 1.5]) * degree, atol=EXACT)


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


def test_the_start_level_places_the_frame() -> None:
    """R0 and θ0 are those of [command.start]: from (0, −0.4) to (0.6, 0) is a quarter turn, 0.4 m out."""
    start = {"x": 0.0, "y": -0.4, "z": 0.1}
    run = pf.Run.from_arrays(stamps(1), {"x": [0.6], "y": [0.0], "z": [0.2]}, start=start, frame=Cylindrical())
    found = in_axes(run, None)[0]
    assert found.command.values["tangential"] == pytest.approx(0.4 * math.pi / 2.0)
    assert found.command.values["radial"] == pytest.approx(0.6)
    assert dict(found.start) == pytest.approx({"tangential": 0.0, "radial": 0.4, "vertical": 0.1})


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
        ({"x": X, "y": Y}, {"y": X}, "camera: gives y without x"),
        ({"x": X, "y": Y}, {"x": X, "y": Y, "radial": X}, "camera: gives radial both by its name and by x, y"),
        ({"x": X, "y": Y}, {"x": X, "y": Y, "tangential": X}, "camera: gives tangential both by its name and by x, y"),
        ({"x": X, "y": Y, "z": Z}, {"z": Z, "vertical": Z}, "camera: gives vertical both by its name and by z"),
        ({"x": X, "y": Y, "radial": X}, None, "command: gives radial both by its name and by x, y"),
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


def test_a_row_without_x_or_y_is_invalid_but_its_z_is_fused() -> None:
    """Tangential and radial need both; vertical needs neither."""
    values = {"x": np.full(6, 0.5), "y": np.zeros(6), "z": np.zeros(6)}
    camera = {axis: value.copy() for axis, value in values.items()}
    camera["x"][1] = camera["y"][2] = camera["z"][3] = np.nan
    camera["x"][4] = camera["y"][4] = np.nan
    run = pf.Run.from_arrays(stamps(6), values, {"camera": (stamps(6), camera)}, frame=Cylindrical())
    with pytest.warns(pf.PumafuseWarning, match="no finite"):
        est = pf.fuse(run, config())
    for axis, invalid in (("tangential", [1, 2, 4]), ("radial", [1, 2, 4]), ("vertical", [3])):
        outcome = est.measurements.of("camera", axis).outcome
        wanted = [pf.Outcome.INVALID if row in invalid else pf.Outcome.FUSED for row in range(6)]
        assert outcome.tolist() == wanted, axis
    assert all(np.isfinite(est[axis].position).all() for axis in est.axes)


def test_commands_in_x_y_z_without_a_frame_are_refused_with_what_is_missing() -> None:
    """One line that names the file and says to give [frame]."""
    run = pf.Run.from_arrays(stamps(2), {"x": X, "y": Y, "z": Z})
    message = refusal(lambda: pf.fuse(run, config()))
    assert message == "command: commands are in x, y, z; give a [frame] in run.toml or fusion.toml"


RUN_TOML = """
[command]
file = "log.csv"
time = "time_s"
x = "command.x_mm"
y = "command.y_mm"
"""
FUSION_TOML = """
arm = "puma560-internal"
[frame]
kind = "rotated"
azimuth_deg = 0.0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "log.csv").write_text("time_s,command.x_mm,command.y_mm\n0,100,500\n0.028,100,500\n")
    (tmp_path / "run.toml").write_text(RUN_TOML)
    (tmp_path / "fusion.toml").write_text(FUSION_TOML)
    return tmp_path


def resting(folder: Path, run: str) -> tuple[float, float]:
    """Tangential and radial [mm] of an arm that rests at x = 100, y = 500."""
    est = pf.fuse(pf.Run.read(folder / run), pf.FusionConfig.load(folder / "fusion.toml"))
    assert est.cartesian["x"] == pytest.approx(0.1)
    assert est.cartesian["y"] == pytest.approx(0.5)
    return est["tangential"].position[-1] * 1e3, est["radial"].position[-1] * 1e3


@pytest.mark.parametrize("run", ["log.csv", "run.toml"])
def test_the_frame_of_fusion_toml_serves_runs_without_one(folder: Path, run: str) -> None:
    """A single table cannot hold a frame, a manifest need not: at azimuth 0 radial is x and tangential y."""
    assert resting(folder, run) == pytest.approx((500.0, 100.0))


def test_the_frame_of_the_run_beats_that_of_fusion_toml(folder: Path) -> None:
    """What the log says of itself goes: at azimuth 90° radial is y and tangential −x."""
    (folder / "run.toml").write_text(RUN_TOML + '[frame]\nkind = "rotated"\nazimuth_deg = 90.0\n')
    assert resting(folder, "run.toml") == pytest.approx((-100.0, 500.0))


def test_a_frame_in_a_file_is_in_mm_and_degrees(folder: Path) -> None:
    """base_mm is the base's axis: about (100, 200) the arm rests 300 mm out at tangential 0."""
    frame = '[frame]\nkind = "cylindrical"\nbase_mm = [100.0, 200]\npositive = "clockwise"\n'
    (folder / "run.toml").write_text(RUN_TOML + frame)
    assert pf.Run.read(folder).frame == Cylindrical(base=(0.1, 0.2), positive="clockwise")
    assert resting(folder, "run.toml") == pytest.approx((0.0, 300.0))


@settings(derandomize=True, deadline=None, max_examples=10)
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

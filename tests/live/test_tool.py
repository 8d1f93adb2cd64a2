"""A tool that turns, live: orientations, sensors in frames of their own, and what they are to the last bit."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
from pumafuse.fusion.config import Placement
from pumafuse.fusion.placing import add_tool
from pumafuse.live.wire import BadLine, Event, LineDecoder
from pumafuse.logs.frames import Rotated
from streams import (
    delayed,
    differences,
    estimates_are_as_live,
    events_of,
    fused_in_any_order,
    record_is_as_live,
    replay_is_as_live,
)

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
LENGTH = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04), gain=pf.Gain(slope=0.001))
ANGLE = pf.AxisModel(
    kind="angle",
    plant=pf.SecondOrder(natural_frequency=45.0, damping=0.9),
    gain=pf.Gain(intercept=0.98),
    gain_recovery=0.1,
)
# It acts later than the others.
SLOW = msgspec.structs.replace(ANGLE, delay=0.06, plant=pf.FirstOrder(time_constant=0.026))
ARM = pf.ArmModel(
    name="any",
    update_period=0.028,
    delay=0.046,
    axes={"x": LENGTH, "y": LENGTH, "z": LENGTH, "rx": ANGLE, "ry": SLOW, "rz": ANGLE},
)
MOCAP = Placement(at=(2.1, -1.3, 0.7), rotation=(-2.585, 0.919, -0.12))
ON_TOOL = Placement(at=(0.03, -0.05, 0.12), rotation=(1.147, -0.726, -0.106))
TRACKER, REFLECTOR = (
    Placement(at=(-0.9, 3.2, 0.45), rotation=(-0.035, 0.004, -1.955)),
    Placement(at=(0.0, 0.062, 0.035)),
)
SD = {"x": 1.5e-4, "y": 1.5e-4, "z": 4e-4, "rx": 9e-4, "ry": 9e-4, "rz": 2e-3}
CONFIG = pf.FusionConfig(
    arm=ARM,
    sensors={
        "mocap": pf.Sensor(sd=SD, latency=0.012, gate=8.0, frame=MOCAP, marker=ON_TOOL),
        "tracker": pf.Sensor(sd=dict.fromkeys("xyz", 2e-4), latency=0.005, frame=TRACKER, marker=REFLECTOR),
        "camera": pf.Sensor(sd=SD, latency=0.03),
    },
)


def pose(time: np.ndarray) -> tuple[np.ndarray, Rotation]:
    at = 0.1 * np.column_stack([np.sin(time), np.sin(0.7 * time + 1.0), np.cos(1.3 * time)]) + [0.5, 0.2, -0.1]
    turn = np.column_stack([0.9 * np.sin(0.9 * time), 0.5 * np.sin(1.7 * time), 0.8 * np.cos(0.6 * time)])
    return at, Rotation.from_rotvec(turn) * Rotation.from_rotvec([-1.6, 0.2, 0.4])


def seen(sensor: pf.Sensor, at: np.ndarray, turned: Rotation, rng: np.random.Generator) -> tuple[np.ndarray, Rotation]:
    """What a sensor measures of poses, with noise: by scipy, the other way round than pumafuse computes."""
    frame, marker = sensor.frame or Placement(), sensor.marker or Placement()
    stands, on_tool = Rotation.from_rotvec(frame.rotation), Rotation.from_rotvec(marker.rotation)
    point = stands.inv().apply(at + turned.apply(marker.at) - frame.at)
    noise = Rotation.from_rotvec(rng.normal(0.0, 9e-4, point.shape))
    return point + rng.normal(0.0, 1e-4, point.shape), noise * (stands.inv() * turned * on_tool)


def run_of(config: pf.FusionConfig = CONFIG, seconds: float = 4.1, noisy: bool = False) -> pf.Run:
    """A run of commands and of all sensors, of which the tracker tells no orientation; ``noisy``: some rows more."""
    rng, lag = np.random.default_rng(8), 0.086
    given = np.sort(
        np.arange(0, round(seconds * 1e9), 28_000_000) + rng.integers(0, 3_000_000, round(seconds / 0.028) + 1)
    )
    at, turned = pose(given / 1e9)
    command = dict(zip("xyz", at.T, strict=True)) | {"orientation": turned.as_quat()}
    sensors = {}
    for name, rate in (("mocap", 90.0), ("tracker", 70.0), ("camera", 25.0)):
        stamp = np.sort(rng.integers(-50_000_000, round(seconds * 1e9), round(seconds * rate)))
        sensor = config.sensors[name]
        point, oriented = seen(sensor, *pose(np.maximum(stamp / 1e9 - sensor.latency - lag, 0.0)), rng)
        values = dict(zip("xyz", point.T, strict=True))
        values |= {"noise": rng.choice([1.0, 1.0, 5.0], len(stamp))} if noisy else {}
        sensors[name] = stamp, values if name == "tracker" else values | {"orientation": oriented.as_quat()}
    return pf.Run.from_arrays(given, command, sensors)


RUN, NOISY = run_of(), run_of(noisy=True)
KNOWN = add_tool(CONFIG, RUN)


# The same arm, its log in another frame: x, y, z are turned into its axes once they are the tool's.
FRAMED = msgspec.structs.replace(
    KNOWN,
    arm=msgspec.structs.replace(
        ARM,
        axes={**dict.fromkeys(("tangential", "radial", "vertical"), LENGTH), "rx": ANGLE, "ry": SLOW, "rz": ANGLE},
    ),
    frame=Rotated(azimuth=0.4),
    process={},
    sensors={name: msgspec.structs.replace(sensor, sd=3e-4) for name, sensor in KNOWN.sensors.items()},
)


ALL_RUNS = pytest.mark.parametrize("run", [RUN, NOISY], ids=["even", "noisy"])


def test_in_a_frame_of_the_arm() -> None:
    """What sensors and commands tell in x, y, z becomes the arm's tangential, radial and vertical, as offline."""
    offline, live = pf.fuse(NOISY, FRAMED), pf.LiveEstimator(FRAMED)
    assert differences(live, delayed(events_of(NOISY), 1.2, seed=2), offline, 1.45) == []


@ALL_RUNS
def test_in_any_order(run: pf.Run) -> None:
    """Each event up to 1.2 s late, a tenth twice: the offline estimates, also of what the commands place."""
    offline, live = pf.fuse(run, KNOWN), pf.LiveEstimator(KNOWN)
    expected = fused_in_any_order(run, offline, live, 1.2)
    for sensor in ("mocap", "tracker", "camera"):
        assert expected[sensor]["fused"] > 400
        assert expected[sensor]["rejected"] < 40


@ALL_RUNS
def test_a_recorded_stream_fuses_to_what_live_gave(tmp_path: Path, run: pf.Run) -> None:
    """Lines with orientations, which go out as quaternions."""
    found, offline, given = record_is_as_live(tmp_path / "record", run, KNOWN)
    assert found.sensors["tracker"].orientation is None
    vector = np.column_stack([offline.axes[axis].position for axis in ("rx", "ry", "rz")])
    expected = Rotation.from_rotvec(vector) * Rotation.from_rotvec(KNOWN.tool.reference)
    off = Rotation.from_quat([one["q"] for one in given]) * expected.inv()
    assert off.magnitude() == pytest.approx(0.0, abs=1e-12)


def test_estimates_at_the_time_are_as_live() -> None:
    """Fed in order, at each command; and replayed, of a run whose rows are in a tenth without an orientation."""
    estimates_are_as_live(RUN, KNOWN)
    run = run_of(noisy=True)
    run.sensors["mocap"].orientation[::10] = np.nan
    replay_is_as_live(run, KNOWN)


DECODER = LineDecoder(ARM.kind_of, framed=False)
Q = Rotation.from_rotvec(KNOWN.tool.reference).as_quat().tolist()


def test_orientations_on_the_wire() -> None:
    """Of a command and of a measurement q is a quaternion; null is none; an arm without rx may have an axis q."""
    values = {"x": 0.5, "orientation": (0.5, -0.5, 0.5, 0.5)}
    assert DECODER.decode(b'{"t": 1.0, "command": {"x": 500.0, "q": [0.5, -0.5, 0.5, 0.5]}}') == Event(1.0, "", values)
    line = b'{"t": 1.0, "sensor": "mocap", "x": 500.0, "q": [0.5, -0.5, 0.5, 0.5]}'
    assert DECODER.decode(line) == Event(1.0, "mocap", values)
    assert DECODER.decode(b'{"t": 1.0, "sensor": "mocap", "x": 500.0, "q": null}').values == {"x": 0.5}
    joint = LineDecoder({"q": "length"}, framed=False)
    assert joint.decode(b'{"t": 1.0, "sensor": "encoder", "q": 500.0}').values == {"q": 0.5}
    with pytest.raises(pf.ConfigError, match="axis 'q'"):
        LineDecoder({**ARM.kind_of, "q": "length"}, framed=False)


@pytest.mark.parametrize("q", ["[0, 0, 1]", '[0, 0, 0, "1"]', "[0, 0, 0, NaN]"])
def test_a_line_with_a_q_of_another_form_has_a_reason(q: str) -> None:
    """Each is refused with a reason that names it, or is no JSON."""
    with pytest.raises(BadLine, match=r"\.q|not JSON"):
        DECODER.decode(f'{{"t": 1.0, "sensor": "mocap", "x": 500.0, "q": {q}}}'.encode())


@pytest.mark.parametrize(
    "orientation",
    [
        np.eye(4),
        [[0], 0, 0, 1],
        [0.0, 0.0, 0.0, 0.0],
        "north",
        [0.0, 0.0, 0.0, math.nan],
        [0, 0, 0, 1.2],
    ],
)
def test_what_is_no_orientation_is_refused(orientation: object) -> None:
    """The whole row is refused with one reason, and counted by axis; so is a command."""
    live = pf.LiveEstimator(KNOWN)
    live.command(0.0, x=0.5, y=0.2, z=0.1, orientation=Q)
    for result in (
        live.measurement(0.1, "mocap", x=0.5, y=0.2, z=0.1, orientation=orientation),
        live.command(0.1, x=0.5, orientation=orientation),
    ):
        assert result.outcome is pf.Outcome.INVALID
        assert "no quaternion x, y, z, w of norm 1" in result.reason
        assert {"x", "rx", "ry", "rz"} <= set(result.axes)
    assert live.health().sensors["mocap"].outcomes["invalid"] == 6


@pytest.mark.parametrize("seen", [{"x": 1.0, "y": 0.2}, {"x": 0.0, "y": 0.0, "z": 0.0}])
def test_a_row_that_tells_no_point_is_invalid(seen: dict[str, float]) -> None:
    """Of a sensor in a frame of its own: two coordinates, or the zeros that it writes while its target is lost."""
    live = pf.LiveEstimator(KNOWN)
    live.command(0.0, x=0.5, y=0.2, z=0.1, orientation=Q)
    assert dict(live.measurement(0.1, "tracker", **seen).axes) == dict.fromkeys("xyz", pf.Outcome.INVALID)


def test_a_command_that_turns_too_far_is_refused() -> None:
    """Near half a turn from the reference a rotation vector changes its sign; from 120° on that is said."""
    said: list[str] = []
    live = pf.LiveEstimator(KNOWN, on_notice=said.append)
    for turn, taken in ((130.0, True), (172.0, False)):
        q = Rotation.from_rotvec([0.0, 0.0, math.radians(turn)]) * Rotation.from_rotvec(KNOWN.tool.reference)
        result = live.command(turn, x=0.5, y=0.2, z=0.1, orientation=q.as_quat())
        assert (result.outcome is pf.Outcome.FUSED) == taken
    assert "170°" in result.reason
    assert ["beyond 120°" in text for text in said] == [True]

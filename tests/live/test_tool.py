"""A tool that turns, live: orientations, sensors in frames of their own, and what they are to the last bit."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
from pumafuse.fusion.config import Placement
from pumafuse.fusion.placing import with_tool
from streams import counted, delayed, differences, events_of, feed, outcomes_of

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
    """A motion of the tool: where it is [m], (n, 3), and how it is turned, up to 70° from its mean."""
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


def run_of(config: pf.FusionConfig = CONFIG, seconds: float = 6.0) -> pf.Run:
    """A run of commands and of all sensors, of which the tracker tells no orientation."""
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
        sensors[name] = stamp, values if name == "tracker" else values | {"orientation": oriented.as_quat()}
    return pf.Run.from_arrays(given, command, sensors)


RUN = run_of()
KNOWN = with_tool(CONFIG, RUN)


@pytest.mark.parametrize("longest", [0.0, 1.2])
def test_in_any_order(longest: float) -> None:
    """Each event up to 1.2 s late, a tenth twice: the offline estimates, also of what the commands place."""
    offline, live = pf.fuse(RUN, KNOWN), pf.LiveEstimator(KNOWN)
    events = events_of(RUN)
    arrivals = delayed(events, longest, seed=5, twice=0.1) if longest else events
    assert differences(live, arrivals, offline, longest + 0.25) == []
    expected = {
        sensor: {outcome: count for outcome, count in counts.items() if outcome != "duplicate"}
        for sensor, counts in outcomes_of(offline).items()
    }
    assert counted(live, "duplicate") == expected
    for sensor in ("mocap", "tracker", "camera"):
        assert expected[sensor]["fused"] > 400
        assert expected[sensor]["rejected"] < 40


def test_estimates_at_the_time_are_as_live() -> None:
    """Fed in order, the estimate at each command is that of `fuse --as-live`."""
    offline, live = pf.fuse(RUN, KNOWN, mode="as-live"), pf.LiveEstimator(KNOWN)
    found = [
        live.estimate(event.stamp)
        for event in events_of(RUN)
        if feed(live, event).outcome is pf.Outcome.FUSED and not event.sensor
    ]
    for axis, track in offline.axes.items():
        assert [estimate[axis].position for estimate in found] == track.position.tolist()
        assert [estimate[axis].position_sd for estimate in found] == track.position_sd.tolist()

"""One sensor wrong beside a good one: a tracker of 0.05 mm at 100 Hz, a camera of 0.5 mm at 30 Hz with outliers.

Errors are against the true motion, which the simulation here follows by the filter's own model.
"""

import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import pumafuse as pf
from pumafuse.arrays import FloatArray
from pumafuse.filter.response import response

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
MS = 1_000_000  # ns
SECONDS = 25
SLIP = 0.05  # m
PROCESS = pf.Process(input_noise=0.03e-3, drift=0.4e-3)
AXIS = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04))
ARM = pf.ArmModel(name="an arm", update_period=0.028, delay=0.06, axes={"radial": AXIS})
SENSORS = {
    "tracker": pf.Sensor(sd=0.05e-3, latency=0.008, gate=5.0),
    "camera": pf.Sensor(sd=0.5e-3, latency=0.04, gate=5.0),  # 3 mm are beyond it
}
ORDERS = [("tracker", "camera"), ("camera", "tracker")]
COMMANDS = 28 * MS * np.arange(SECONDS * 1000 // 28)
U = 0.5 + 0.05 * np.sin(COMMANDS / 1e9)


@cache
def simulated() -> tuple[FloatArray, FloatArray, FloatArray]:
    """The true position at every millisecond, and what tracker and camera measure there [m]."""
    rng, ms = np.random.default_rng(1), np.arange(SECONDS * 1000)
    a = np.exp(-1e-3 / 0.04)
    plant = lfilter([1], [1, -a], PROCESS.input_noise * np.sqrt((1 - a * a) / 0.08) * rng.standard_normal(len(ms)))
    offset = np.cumsum(PROCESS.drift * np.sqrt(1e-3) * rng.standard_normal(len(ms)))
    true = 0.5 + response(AXIS, 0.028, 0.06, COMMANDS, U, 0.5, ms * MS) + plant + offset
    outliers = np.where(rng.random(len(ms)) < 0.01, rng.normal(0.0, 0.1, len(ms)), 0.0)
    noise = rng.standard_normal((2, len(ms)))
    return true, true + 0.05e-3 * noise[0], true + 0.5e-3 * noise[1] + outliers


def error_of(*args: Any, **kwargs: Any) -> FloatArray:
    """Errors [mm] at every 10 ms of what :func:`fused` makes of a run."""
    est, true = fused(*args, **kwargs)
    count = (SECONDS - 1) * 100
    return 1e3 * (est["radial"].position[:count] - true[: 10 * count : 10])


def fused(
    order: tuple[str, ...] = ORDERS[0],
    *,
    tracker: float = 0.0,
    camera: FloatArray | float = 0.0,
    tracker_since: float = 5.0,
    camera_since: float = 5.0,
    clock: float = 0.0,
    frozen: bool = False,
    slip: bool = False,
    silent: bool = False,
    **kwargs: Any,
) -> tuple[pf.Estimates, FloatArray]:
    """A run with a fault, fused, and the true position at every millisecond [m].

    Tracker or camera are off [m] from some second on, the camera's stamps by ``clock`` [s], or it says the same for
    5 s; the arm itself slips at 5 s; the tracker is silent from 9 to 15 s.
    """
    true, tracked, seen = simulated()
    second = np.arange(len(true)) / 1000
    slipped = SLIP * (slip & (second >= 5.0))
    tracked, seen = tracked + slipped, seen + slipped
    ours, theirs = np.arange(10, len(true), 10), np.arange(33, len(true), 33)
    if silent:
        ours = ours[(ours < 9000) | (ours >= 15_000)]
    tracked = tracked + tracker * (second >= tracker_since)
    wrong = second >= camera_since
    seen = seen + camera * wrong
    if frozen:
        seen = np.where(wrong & (second < camera_since + 5.0), seen[theirs[wrong[theirs]][0]], seen)
    late = np.rint(1e9 * clock * wrong[theirs]).astype(np.int64)
    streams = {
        "tracker": (ours * MS + 8 * MS, {"radial": tracked[ours]}),
        "camera": (theirs * MS + 40 * MS + late, {"radial": seen[theirs]}),
    }
    config = pf.FusionConfig(arm=ARM, process={"radial": PROCESS}, sensors={name: SENSORS[name] for name in order})
    est = pf.fuse(pf.Run.from_arrays(COMMANDS, {"radial": U}, streams), config, rate=100.0, **kwargs)
    return est, true + slipped


def rms(error: FloatArray, since: float = 0.0) -> float:
    return float(np.sqrt(np.mean(error[round(since * 100) :] ** 2)))


DRIFTING = 1e-3 * np.maximum(np.arange(SECONDS * 1000) / 1000 - 5.0, 0.0)
FAULTS: dict[str, dict[str, Any]] = {
    "3 mm off": {"camera": 3e-3},
    "50 mm off": {"camera": 50e-3},
    "3 mm off from the start": {"camera": 3e-3, "camera_since": 0.0},
    "50 mm off from the start": {"camera": 50e-3, "camera_since": 0.0},
    "frozen": {"frozen": True},
    "drifting": {"camera": DRIFTING},
    "clock ahead": {"clock": 0.2},
    "clock behind": {"clock": -0.2},
}


in_any_order = pytest.mark.parametrize("order", ORDERS, ids="+".join)


@in_any_order
@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_camera_beside_a_good_tracker_does_no_harm(fault: str, order: tuple[str, ...]) -> None:
    """At most 1.2 times the error without the fault, as live, too."""
    for mode in ({}, {"mode": "as-live"}):
        assert rms(error_of(order, **FAULTS[fault], **mode)) < 1.2 * rms(error_of(**mode))


@in_any_order
def test_who_contradicts_whom_is_said_with_the_time(order: tuple[str, ...]) -> None:
    """One note each, nothing without a fault; a drift shows when it is 5 sd, 2.5 s later. What is frozen is held."""
    assert not [note for note in fused(order)[0].notes if "contradicts" in note]
    faults = {name: fault for name, fault in FAULTS.items() if "from the start" not in name and name != "frozen"}
    for wrong in ({"tracker": 50e-3}, *faults.values()):
        names = ("'tracker'", "'camera'") if "tracker" in wrong else ("'camera'", "'tracker'")
        (note,) = [note for note in fused(order, **wrong)[0].notes if " contradicts ".join(names) in note]
        assert "radial" in note
        assert any(5.0 <= float(number) < 8.5 for number in re.findall(r"(\d+\.\d+) s", note)), note


@in_any_order
def test_a_wrong_tracker_leaves_what_the_camera_knows(order: tuple[str, ...]) -> None:
    """50 mm off from 5 s on: at most 1.2 times the error of the camera alone."""
    alone = error_of(sensors=["camera"])
    assert rms(error_of(order, tracker=50e-3)) < min(1.2 * rms(alone), 0.3)


@in_any_order
def test_a_slip_that_both_see_is_followed(order: tuple[str, ...]) -> None:
    """Within 0.6 s, and then as if nothing had been."""
    error = error_of(order, slip=True)
    assert np.abs(error[500:550]).min() > 40.0
    assert np.abs(error[560:]).max() < 0.5
    assert rms(error, 5.6) < 1.05 * rms(error_of(), 5.6)


@in_any_order
def test_the_harm_of_an_outage_ends_with_it(order: tuple[str, ...]) -> None:
    """A tracker silent from 9 to 15 s beside a wrong camera: the camera alone is believed meanwhile."""
    error = error_of(order, camera=50e-3, silent=True)
    assert np.abs(error[:950]).max() < 1.0
    assert np.abs(error[960:1500]).min() > 40.0
    assert rms(error, 15.2) < 1.05 * rms(error_of(), 15.2)


@in_any_order
def test_a_slip_long_ago_does_not_decide_for_a_wrong_sensor(order: tuple[str, ...]) -> None:
    """A slip that both saw and, 10 s later, a wrong camera: as if there had been no slip."""
    error = error_of(order, slip=True, camera=50e-3, camera_since=15.0)
    assert rms(error, 5.6) < 1.05 * rms(error_of(), 5.6)

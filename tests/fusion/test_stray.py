"""A run with stray stamps is fused as if their rows were not there, to the bit; each of them is counted and noted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.logs.frames import Cylindrical

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
SECOND = 1_000_000_000
ORIGIN = 1_700_000_000 * SECOND
TICK = 28_000_000
LATENCY = 8_000_000

CONFIG = pf.FusionConfig(
    arm=pf.ArmModel.load("puma560-internal"),
    sensors={"tracker": pf.Sensor(sd=5e-5, latency=LATENCY / SECOND), "camera": pf.Sensor(sd=1e-3, bias_sd=0.1)},
)

Stray = tuple[str, int, float]  # source, the row before which it stands, and by how many seconds it is off


def recorded(strays: Sequence[Stray] = (), frame: Cylindrical | None = None, **more: Any) -> pf.Run:
    """Three seconds of commands, two sensors and a reference, with rows whose stamps are off."""
    rng = np.random.default_rng(7)
    stamps = {
        "command": ORIGIN + TICK * np.arange(108),
        "tracker": ORIGIN + 10_000_000 * np.arange(1, 300),
        "camera": ORIGIN + 90_000_000 * np.arange(1, 33),
        "reference": ORIGIN + 20_000_000 * np.arange(150),
    }
    sources: dict[str, tuple[np.ndarray, Mapping[str, np.ndarray]]] = {}
    for name, own in stamps.items():
        stamp = own
        turn = 0.2 * np.sin((stamp - ORIGIN) / SECOND)
        values = {"x": 0.56 * np.cos(turn), "y": 0.56 * np.sin(turn)} if frame else {"radial": 0.56 + 0.1 * turn}
        noise = {"tracker": 5e-5, "camera": 1e-3}.get(name, 0.0)
        values = {axis: value + noise * rng.standard_normal(len(stamp)) for axis, value in values.items()}
        for source, row, off in reversed(strays):
            if source == name:
                stamp = np.insert(stamp, row, own[min(row, len(own) - 1)] + round(off * SECOND))
                values = {axis: np.insert(value, row, 0.5) for axis, value in values.items()}
        sources[name] = (stamp, values)
    reference, command = sources.pop("reference"), sources.pop("command")
    return pf.Run.from_arrays(*command, sources, reference, frame=frame, **more)


def assert_same(got: pf.Estimates, wanted: pf.Estimates) -> None:
    """Every estimate, every component decided on, the biases and the reference are equal to the bit."""
    assert (got.origin, got.speed, got.radius) == (wanted.origin, wanted.speed, wanted.radius)
    np.testing.assert_array_equal(got.time, wanted.time)
    np.testing.assert_array_equal(got.segment, wanted.segment)
    assert got.axes.keys() == wanted.axes.keys()
    for axis in wanted.axes:
        for field in pf.AxisEstimate.FIELDS:
            np.testing.assert_array_equal(getattr(got[axis], field), getattr(wanted[axis], field), err_msg=field)
    assert got.biases == wanted.biases
    decided = [est.measurements.where(np.isfinite(est.measurements.innovation)) for est in (got, wanted)]
    for field in pf.Measurements.ARRAYS:
        np.testing.assert_array_equal(getattr(decided[0], field), getattr(decided[1], field), err_msg=field)
    for axis in wanted.axes:
        np.testing.assert_array_equal(got.reference.position[axis], wanted.reference.position[axis])


CASES: dict[str, tuple[list[Stray], list[str]]] = {
    "a command ahead": ([("command", 50, 3600.0)], ["command: 1 row has a stray stamp, more than 1 s ahead", "row 51"]),
    "a command back": ([("command", 50, -3600.0)], ["command: 1 row has a stray stamp, more than 1 s behind"]),
    "the last command back": ([("command", 108, -100.0)], ["(first: row 109, by 100.000 s)"]),
    "two commands, apart": ([("command", 50, 9.0), ("command", 90, -12.0)], ["more than 1 s ahead", "1 s behind"]),
    "a measurement ahead": (
        [("tracker", 80, 40.0)],
        ["tracker: 1 row has a stray stamp", "(first: row 81, by 40.010 s)"],
    ),
    "all at once": ([(name, 20, 77.0) for name in ("command", "tracker", "camera", "reference")], ["command: 1 row"]),
}


HOW: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
    *((case, {}, {"mode": "as-live"}) for case in CASES),
    ("all at once", {"frame": Cylindrical()}, {}),
    ("all at once", {}, {"mode": "smoothed"}),
    ("all at once", {}, {"engine": "filterpy"}),
]


@pytest.mark.parametrize(("case", "of_run", "how"), HOW, ids=str)
def test_a_stray_row_changes_no_estimate_and_is_noted(case: str, of_run: dict[str, Any], how: dict[str, Any]) -> None:
    """The run goes on as if the row had not been there; a note names the source, the row and by how much it is off."""
    strays, words = CASES[case]
    got, wanted = (pf.fuse(recorded(some, **of_run), CONFIG, **how) for some in (strays, ()))
    assert_same(got, wanted)
    for word in words:
        assert any(word in note for note in got.notes), (word, got.notes)
    assert not any("stray" in note for note in wanted.notes)

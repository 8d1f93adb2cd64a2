"""Lines in and out: the wire format, and what is no line of it."""

from __future__ import annotations

import json
import math

import pytest

import pumafuse as pf
from pumafuse.live.wire import BadLine, Event, LineDecoder, encode
from pumafuse.logs.frames import Cylindrical

DECODER = LineDecoder(("radial", "vertical"), framed=True)


def test_the_lines_of_the_design() -> None:
    """A command and a measurement in mm and s are an event in m and s; whole ns stay whole."""
    assert DECODER.decode(b'{"t": 12.345, "command": {"radial": 570.0}}') == Event(12.345, "", {"radial": 0.57})
    line = b'{"t_ns": 1700000000123456789, "sensor": "tracker", "radial": 569.7, "vertical": -93.2}'
    assert DECODER.decode(line) == Event(1700000000123456789, "tracker", {"radial": 569.7 / 1e3, "vertical": -93.2 / 1e3})
    assert DECODER.decode(b'{"t": 1, "sensor": "tracker", "x": 1, "y": 2, "z": 3}').values == {
        "x": 0.001,
        "y": 0.002,
        "z": 0.003,
    }


def test_null_is_no_number() -> None:
    """An axis that a sensor has lost is given, but not finite."""
    assert math.isnan(DECODER.decode(b'{"t": 1, "sensor": "tracker", "radial": null}').values["radial"])


def test_unknown_names_are_kept_to_be_told() -> None:
    """A row with a further field is still a row; what the field is called comes with it."""
    event = DECODER.decode(b'{"t": 1, "sensor": "tracker", "radial": 570, "quality": {"snr": [1, 2]}}')
    assert (event.t, event.sensor) == (1.0, "tracker")
    assert set(event.values) == {"radial", "quality"}
    event = DECODER.decode(b'{"t": 1, "command": {"radial": 570, "speed": 3}, "id": 7}')
    assert set(event.values) == {"radial", "speed", "id"}


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"hello", "not JSON"),
        (b'{"t": 1, "sensor": "tracker", "radial": ' + b"1" * 70_000 + b"}", "longer than 64 KiB"),
        (b"", "not JSON"),
        (b"\xff\xfe\x00\x01", "not JSON"),
        (b'{"t": 1, "sensor": "tracker", "radial": 5', "not JSON"),
        (b"[1, 2, 3]", "Expected `object`"),
        (b"12", "Expected `object`"),
        (b'{"sensor": "tracker", "radial": 570}', "needs one of 't'"),
        (b'{"t": 1, "t_ns": 1, "sensor": "tracker", "radial": 570}', "needs one of 't'"),
        (b'{"t": "1", "sensor": "tracker", "radial": 570}', "Expected `float | null`"),
        (b'{"t": NaN, "sensor": "tracker", "radial": 570}', "not JSON"),
        (b'{"t": 1e999, "sensor": "tracker", "radial": 570}', "out of range"),
        (b'{"t_ns": 1.5, "sensor": "tracker", "radial": 570}', "Expected `int | null`"),
        (b'{"t": 1, "radial": 570}', "neither 'command' nor 'sensor'"),
        (b'{"t": 1, "sensor": "", "radial": 570}', "'sensor' is empty"),
        (b'{"t": 1, "sensor": 5, "radial": 570}', "Expected `str | null`"),
        (b'{"t": 1, "sensor": "tracker", "radial": "570"}', "Expected `float | null`"),
        (b'{"t": 1, "command": 5}', "Expected `object | null`"),
        (b'{"t": 1, "command": {"radial": 570}, "sensor": "tracker"}', "at once"),
        (b'{"t": 1, "command": {"radial": 570}, "radial": 5}', "at once"),
        (b"[" * 60_000, "not JSON|Expected `object`"),
        (b'{"a":' * 10_000, "not JSON"),
        (b'{"t": 1, "sensor": "tracker", "a": ' + b"[" * 20_000 + b"]" * 20_000 + b"}", "not JSON|nest"),
    ],
)
def test_what_is_no_line_says_why(line: bytes, reason: str) -> None:
    """Each is refused with a reason, and nothing else is raised."""
    with pytest.raises(BadLine, match=reason):
        DECODER.decode(line)


def test_an_axis_may_not_be_called_as_a_part_of_a_line() -> None:
    """An arm with an axis 't' cannot be told from a stamp."""
    with pytest.raises(pf.ConfigError, match="axis 't'"):
        LineDecoder(("t",), framed=False)


def test_an_estimate_is_one_line() -> None:
    """Position, its sd and velocity in mm and mm/s, what is stale, and ns where the stream has them."""
    live = pf.LiveEstimator(
        pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal"), sensors={"tracker": pf.Sensor(sd=1e-4)})
    )
    live.command(0.5, radial=0.57)
    estimate = live.estimate(3.5)
    text = encode(estimate, with_ns=True)
    assert text.endswith(b"}\n")
    assert json.loads(text) == {
        "t": 3.5,
        "t_ns": 3_500_000_000,
        "radial": {
            "position_mm": 570.0,
            "sd_mm": estimate["radial"].position_sd * 1e3,
            "velocity_mm_s": 0.0,
        },
        "stale": ["radial"],
    }
    assert "t_ns" not in json.loads(encode(estimate, with_ns=False))


def test_velocity_and_x_y_z_are_in_mm_too() -> None:
    """An arm that moves, in a frame: what goes out is a thousand times what Python has, each under its own name."""
    config = pf.FusionConfig(
        arm=pf.ArmModel.load("puma560-internal"), sensors={"tracker": pf.Sensor(sd=1e-4)}, frame=Cylindrical()
    )
    live = pf.LiveEstimator(config)
    for step in range(40):
        live.command(0.028 * step, x=0.1 + 1e-3 * step, y=0.5, z=-0.1)
    estimate, line = live.estimate(1.0), json.loads(encode(live.estimate(1.0), with_ns=False))
    assert estimate.cartesian is not None
    assert [line[f"{name}_mm"] / 1e3 for name in "xyz"] == pytest.approx(list(estimate.cartesian.values()))
    assert 0.11 < estimate.cartesian["x"] < 0.14  # not where z or y is
    assert estimate.cartesian["y"] == pytest.approx(0.5, abs=1e-3)
    for axis, now in estimate.axes.items():
        assert line[axis]["velocity_mm_s"] == pytest.approx(now.velocity * 1e3)
        assert line[axis]["position_mm"] == pytest.approx(now.position * 1e3)
    assert abs(line["tangential"]["velocity_mm_s"]) == pytest.approx(1e3 * 1e-3 / 0.028, rel=0.1)

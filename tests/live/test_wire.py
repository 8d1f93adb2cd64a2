"""The wire format: decoding of lines into events, encoding of estimates."""

import json
import math

import pytest

import pumafuse as pf
from pumafuse.live.wire import BadLine, Event, LineDecoder, encode
from pumafuse.logs.frames import Cylindrical

DECODER = LineDecoder({"radial": "length", "vertical": "length"}, framed=True)


def test_the_lines_of_the_design() -> None:
    """A command and a measurement in mm and s are an event in m and s; whole ns stay whole; null is no number."""
    assert DECODER.decode(b'{"t": 12.345, "command": {"radial": 570.0}}') == Event(12.345, "", {"radial": 0.57})
    line = b'{"t_ns": 1700000000123456789, "sensor": "tracker", "radial": 569.7, "vertical": -93.2}'
    values = {"radial": 569.7 / 1e3, "vertical": -93.2 / 1e3}
    assert DECODER.decode(line) == Event(1700000000123456789, "tracker", values)
    line = b'{"t": 1, "sensor": "tracker", "x": 1, "y": 2, "z": 3}'
    assert DECODER.decode(line).values == {"x": 0.001, "y": 0.002, "z": 0.003}
    assert math.isnan(DECODER.decode(b'{"t": 1, "sensor": "tracker", "radial": null}').values["radial"])


def test_a_byte_order_mark_may_come_first() -> None:
    """As PowerShell pipes text; many are nothing."""
    line, mark = b'{"t": 1, "sensor": "tracker", "radial": 570}', "\ufeff".encode()
    assert DECODER.decode(mark + line) == DECODER.decode(line)
    with pytest.raises(BadLine, match="not JSON"):
        DECODER.decode(mark * 20_000 + line)


def test_values_under_unknown_names_are_passed_on() -> None:
    """A row with a further field is still a row; the field comes with it, so that it can be reported."""
    event = DECODER.decode(b'{"t": 1, "sensor": "tracker", "radial": 570, "quality": {"snr": [1, 2]}}')
    assert (event.t, event.sensor) == (1.0, "tracker")
    assert set(event.values) == {"radial", "quality"}
    event = DECODER.decode(b'{"t": 1, "command": {"radial": 570, "speed": 3}, "id": 7}')
    assert set(event.values) == {"radial", "speed", "id"}


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b'{"t": 1, "sensor": "tracker", "radial": ' + b"1" * 70_000 + b"}", "longer than 64 KiB"),
        (b"\xff\xfe\x00\x01", "not JSON"),
        (b'{"t": 1, "sensor": "tracker", "radial": 5', "not JSON"),
        (b'{"sensor": "tracker", "radial": 570}', "needs one of 't'"),
        (b'{"t": 1, "t_ns": 1, "sensor": "tracker", "radial": 570}', "needs one of 't'"),
        (b'{"t": NaN, "sensor": "tracker", "radial": 570}', "not JSON"),
        (b'{"t": 1e999, "sensor": "tracker", "radial": 570}', "out of range"),
        (b'{"t_ns": 1.5, "sensor": "tracker", "radial": 570}', "Expected `int | null`"),
        (b'{"t": 1, "radial": 570}', "neither 'command' nor 'sensor'"),
        (b'{"t": 1, "sensor": "", "radial": 570}', "'sensor' is empty"),
        (b'{"t": 1, "sensor": "tracker", "radial": "570"}', "Expected `float | null`"),
        (b'{"t": 1, "command": {"radial": 570}, "sensor": "tracker"}', "at once"),
        (b'{"t": 1, "command": {"radial": 570}, "radial": 5}', "at once"),
        (b"[" * 60_000, "not JSON|Expected `object`"),
        (b'{"t": 1, "sensor": "tracker", "a": ' + b"[" * 20_000 + b"]" * 20_000 + b"}", "not JSON|nest"),
    ],
)
def test_what_is_no_event_has_a_reason(line: bytes, reason: str) -> None:
    """Each is refused with a reason, and nothing else is raised."""
    with pytest.raises(BadLine, match=reason):
        DECODER.decode(line)


def test_an_axis_may_not_be_called_as_a_part_of_a_line() -> None:
    """An arm with an axis 't' cannot be told from a stamp."""
    with pytest.raises(pf.ConfigError, match="axis 't'"):
        LineDecoder({"t": "length"}, framed=False)


@pytest.mark.parametrize("name", ["a\\b", 'the "tip"', "x\x1b[31m"])
def test_an_axis_that_no_line_can_name_is_refused(name: str) -> None:
    """In one line, and so is a joint."""
    for axes, joints in (({name: "length"}, {}), ({"x": "length"}, {name: "angle"})):
        with pytest.raises(pf.ConfigError, match="no quotes, backslashes or control characters"):
            LineDecoder(axes, framed=False, joints=joints)


def test_an_estimate_is_one_line() -> None:
    """Position, sd and velocity of each axis, x, y, z in a frame, stale axes, and ns where the stream has them."""
    config = pf.FusionConfig(
        arm=pf.ArmModel.load("puma560-internal"), sensors={"tracker": pf.Sensor(sd=1e-4)}, frame=Cylindrical()
    )
    live = pf.LiveEstimator(config)
    for step in range(40):
        live.command(0.028 * step, x=0.1 + 1e-3 * step, y=0.5, z=-0.1)
    estimate = live.estimate(1.5)
    text = encode(estimate, config.arm.kind_of, with_ns=True)
    assert text.endswith(b"}\n")
    line = json.loads(text)
    assert (line["t"], line["t_ns"], set(line["stale"])) == (1.5, 1_500_000_000, {"tangential", "radial", "vertical"})
    for axis, now in estimate.axes.items():
        expected = [1e3 * now.position, 1e3 * now.position_sd, 1e3 * now.velocity]
        assert [line[axis][name] for name in ("position_mm", "sd_mm", "velocity_mm_s")] == expected
    assert {name: line[f"{name}_mm"] / 1e3 for name in "xyz"} == pytest.approx(estimate.cartesian)
    assert 0.11 < estimate.cartesian["x"] < 0.14  # not where z or y is
    moving = json.loads(encode(live.estimate(1.0), config.arm.kind_of, with_ns=False))
    assert "t_ns" not in moving
    assert abs(moving["tangential"]["velocity_mm_s"]) == pytest.approx(1e3 * 1e-3 / 0.028, rel=0.1)

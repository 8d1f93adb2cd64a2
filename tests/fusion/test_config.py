"""`fusion.toml`: what it means, that it survives being saved, and one line for whatever is wrong in it."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pumafuse.errors import ConfigError, PumafuseError, UnknownNameError
from pumafuse.fusion.config import FusionConfig, Process, Sensor, Start
from pumafuse.logs.frames import Cylindrical, Rotated
from pumafuse.model.arm import ArmModel
from refusals import one_line

PRESET = "puma560-internal"
AXES = ("tangential", "radial", "vertical")
ARM = f'arm = "{PRESET}"\n'
TRACKER = "[sensors.tracker]\nsd_mm = 0.05\n"

DESIGN = (
    ARM
    + """
[start]
offset_sd_mm = 3.0
[process]
input_noise_mm_rtHz = 0.05
drift_mm_rts = 0.7
[process.radial]
drift_mm_rts = 0.9
maneuver_noise_mm_rtHz_per_m_s = 0.2
maneuver_drift_mm_rts_per_m_s = 20
[sensors.tracker]
sd_mm = { radial = 0.05, vertical = 0.08 }
latency_ms = 8.0
latency_sd_ms = 1.5
gate = 4
gate_rows = false
[sensors.range]
sd_mm = 0.3
latency_ms = -4.1
scale = -1.0
bias_sd_mm = 1000
"""
)


def load(folder: Path, text: str) -> FusionConfig:
    (folder / "fusion.toml").write_text(text, encoding="utf-8")
    return FusionConfig.load(folder / "fusion.toml")


refusal = partial(one_line, PumafuseError)


def test_every_key_arrives_in_si_units(tmp_path: Path) -> None:
    """mm, ms and their densities become m and s with no rounding in between."""
    config = load(tmp_path, DESIGN)
    assert config.arm == ArmModel.load(PRESET)
    assert config.start == Start(offset_sd=3e-3)
    assert config.sensors == {
        "tracker": Sensor(
            sd={"radial": 5e-5, "vertical": 8e-5}, latency=8e-3, latency_sd=1.5e-3, gate=4.0, gate_rows=False
        ),
        "range": Sensor(sd=3e-4, latency=-4.1e-3, scale=-1.0, bias_sd=1.0),
    }
    common = Process(input_noise=5e-5, drift=7e-4)  # of every axis; a table of its own replaces keys for one
    own = Process(input_noise=5e-5, drift=9e-4, maneuver_noise=2e-4, maneuver_drift=20e-3)
    assert config.process == {"tangential": common, "radial": own, "vertical": common}


def test_sensors_keep_the_order_of_the_file(tmp_path: Path) -> None:
    """The order of the file decides between measurements valid at one instant, also for a choice of sensors."""
    names = ("zeta", "alpha", "mu")
    config = load(tmp_path, ARM + "".join(f"[sensors.{name}]\nsd_mm = 1\n" for name in names))
    assert config.sensor_names(None) == names
    assert config.sensor_names(["mu", "zeta", "mu"]) == ("zeta", "mu")
    assert config.sensor_names([]) == ()


not_negative = st.floats(0.0, 1e6)
positive = st.floats(1e-9, 1e6)
processes = st.builds(
    Process, input_noise=not_negative, drift=not_negative, maneuver_noise=not_negative, maneuver_drift=not_negative
)
sensors = st.builds(
    Sensor,
    sd=st.one_of(positive, st.dictionaries(st.sampled_from(AXES), positive, min_size=1)),
    latency=st.floats(-3600.0, 3600.0),
    latency_sd=not_negative,
    scale=st.floats(-1e3, 1e3).filter(lambda scale: abs(scale) >= 1e-9),
    bias_sd=not_negative,
    gate=not_negative,
    gate_rows=st.booleans(),
)
configurations = st.builds(
    FusionConfig,
    arm=st.sampled_from([ArmModel.load(PRESET), ArmModel.load("puma560-external")]),
    start=st.builds(Start, offset_sd=not_negative),
    process=st.dictionaries(st.sampled_from(AXES), processes),
    frame=st.sampled_from(
        [None, Cylindrical(base=(0.1, -0.2), positive="clockwise"), Rotated(azimuth=0.58, positive="clockwise")]
    ),
    sensors=st.dictionaries(st.sampled_from(["tracker", "a b", "ä.β", '"', "0"]), sensors),
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(config=configurations)
def test_what_is_saved_is_loaded_to_the_last_bit(tmp_path: Path, config: FusionConfig) -> None:
    """Saved and loaded, any configuration is equal, its arm and the order of its sensors included."""
    config.save(tmp_path)
    again = FusionConfig.load(tmp_path / "fusion.toml")
    assert again == config
    assert list(again.sensors) == list(config.sensors)


def test_a_saved_file_is_in_the_units_of_its_keys(tmp_path: Path) -> None:
    """What is written reads like what was given: 0.05 mm and −4.1 ms, not 4.9999999999999996e-05."""
    load(tmp_path, DESIGN).save(tmp_path)
    lines = (tmp_path / "fusion.toml").read_text(encoding="utf-8").splitlines()
    for line in ('arm = "arm.toml"', "offset_sd_mm = 3.0", "radial = 0.05", "latency_ms = -4.1", "bias_sd_mm = 1000.0"):
        assert line in lines


def test_an_arm_is_a_file_beside_or_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm's path counts from the file that names it, wherever one stands; a preset needs no file."""
    (tmp_path / "arms").mkdir()
    ArmModel.load("puma560-external").save(tmp_path / "arms" / "mine.toml")
    monkeypatch.chdir(tmp_path / "arms")
    assert load(tmp_path, 'arm = "arms/mine.toml"').arm == ArmModel.load("puma560-external")
    assert load(tmp_path, f'arm = "{tmp_path}/arms/mine.toml"').arm == ArmModel.load("puma560-external")
    for name in (PRESET, "puma560-external"):
        assert load(tmp_path, f'arm = "{name}"').arm == ArmModel.load(name)


REFUSALS: dict[str, tuple[str, tuple[str, ...]]] = {
    # what the file says: what the one line must name
    "no arm": ("", ("'arm'", "arm = 'arm.toml'")),
    "arm with a null character": ('arm = "a\\u0000b"', ("arm = ", "no such file")),
    "unknown key": (ARM + "sensor = 3", ("'sensor'", "did you mean 'sensors'", "arm, start, process")),
    "start without unit": (ARM + "[start]\noffset_sd = 1", ("'start.offset_sd'", "offset_sd_mm")),
    "process of an unknown axis": (
        ARM + "[process.radail]\ndrift_mm_rts = 1",
        ("process", "'radail'", "did you mean 'radial'", "tangential, radial, vertical"),
    ),
    "sensor named like a length": (ARM + "[sensors.laser_mm]\nsd_mm = 1", ("'laser_mm'", "unit (_mm)")),
    "sd of an unknown axis": (
        ARM + TRACKER.replace("0.05", "{ yaw = 1 }"),
        ("sensors.tracker.sd_mm", "'yaw'", "tangential, radial, vertical"),
    ),
    "scale next to zero": (ARM + TRACKER + "scale = 1e-320", ("sensors.tracker.scale", "1e-9")),
    "escape in a name": (ARM + '[sensors."a\\u001b[31m"]\nsd_mm = 1.0\n', ("a?[31m", "control characters")),
    "latency beyond an hour": (ARM + TRACKER + "latency_ms = 3600001", ("sensors.tracker.latency_ms", "hour")),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    """Unknown keys, missing units, wrong types and values: one line with the file, the key and the accepted names."""
    content, named = REFUSALS[case]
    text = refusal(lambda: load(tmp_path, content))
    assert text.startswith(f"{tmp_path / 'fusion.toml'}: ")
    for words in named:
        assert words in text


@pytest.mark.parametrize("content", [None, b"\xff\xfe"], ids=["absent", "not UTF-8"])
def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path, content: bytes | None) -> None:
    """An absent file and bytes that are no text are one line with the path."""
    path = tmp_path / "fusion.toml"
    if content is not None:
        path.write_bytes(content)
    assert str(path) in refusal(lambda: FusionConfig.load(path))


def test_a_configuration_made_in_python_is_checked_like_a_file() -> None:
    """Axes that the arm has not, a name like a unit, a number out of range: refused without a file too."""
    arm = ArmModel.load(PRESET)
    for key, number in {"disturbance_sd": np.nan, "disturbance_time": 1e-120, "disturbance_kind": "Matern"}.items():
        with pytest.raises(ConfigError, match=rf"process\.radial\.{key}"):
            FusionConfig(arm=arm, process={"radial": Process(**{key: number})})
    for wrong in ({"process": {"yaw": Process()}}, {"sensors": {"tracker": Sensor(sd={"yaw": 1e-3})}}):
        with pytest.raises(UnknownNameError):
            FusionConfig(arm=arm, **wrong)
    for name, sensor in {
        "tracker": Sensor(sd=1e-3, scale=0.0),
        "laser_mm": Sensor(sd=1e-3),
        "early": Sensor(sd=1e-3, latency=1e10),
    }.items():
        with pytest.raises(ConfigError, match=name):
            FusionConfig(arm=arm, sensors={name: sensor})
    assert FusionConfig(arm=arm).process == dict.fromkeys(AXES, Process())

"""Every parameter has the name of its key in the files, moves alone, and can be fixed by its name."""

import tomllib
from collections.abc import Callable
from functools import reduce
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.tuning.arms import Arm
from pumafuse.tuning.parameters import (
    FITS,
    Parameter,
    changed,
    check_fixed,
    is_fixed,
    kinds_of,
    parameters,
    set_arm,
    set_disturbance,
    set_drifts,
    set_own_delays,
)
from tuning_runs import replaced, with_process

ARM = pf.ArmModel.load("puma560-internal")  # tangential is second order, radial and vertical are first
TRACKER, CAMERA = pf.Sensor(sd=5e-5, latency=0.008), pf.Sensor(sd={"radial": 4e-4, "vertical": 3e-4}, latency=0.045)
SHARED = pf.FusionConfig(arm=ARM, sensors={"tracker": TRACKER, "camera": CAMERA, "spare": pf.Sensor(sd=1.0)})
CONFIG = set_drifts(set_own_delays(SHARED, ARM.axes))
SENSORS = {"tangential": ["tracker"], "radial": ["tracker", "camera"], "vertical": ["camera"]}


def everything(*fixed: str, config: pf.FusionConfig = CONFIG) -> list[Parameter]:
    return parameters(config, CONFIG, SENSORS, FITS, fixed)


def names(*fixed: str) -> set[str]:
    return {one.key for one in everything(*fixed)}


def of(key: str, config: pf.FusionConfig = CONFIG) -> Parameter:
    (found,) = [one for one in everything(config=config) if one.key == key]
    return found


def snapshot(config: pf.FusionConfig) -> dict[str, float]:
    return {one.key: one.number(config) for one in everything(config=config)}


def test_what_can_be_fitted() -> None:
    """Kinds and keys, of each axis, sensor and order; sensors without measurements have none."""
    keys = {kind: {one.key for one in parameters(CONFIG, CONFIG, SENSORS, [kind])} for kind in FITS}
    noises = ("input_noise_mm_rtHz", "drift_mm_rts", "maneuver_noise_mm_rtHz_per_m_s", "maneuver_drift_mm_rts_per_m_s")
    sds = {f"sensors.{name}.sd_mm.{axis}" for axis, sensors in SENSORS.items() for name in sensors}
    assert keys["noise"] == sds | {f"process.{axis}.{key}" for axis in SENSORS for key in noises}
    assert keys["delay"] == {f"axes.{axis}.delay_ms" for axis in SENSORS}
    assert {one.key for one in parameters(SHARED, SHARED, SENSORS, ["delay"])} == {"delay_ms"}
    some = set_own_delays(SHARED, ["radial"])
    assert {one.key for one in parameters(some, some, SENSORS, ["delay"])} == {"delay_ms", "axes.radial.delay_ms"}
    second = {"axes.tangential.natural_frequency_rad_s", "axes.tangential.damping"}
    assert keys["plant"] == {*second, "axes.radial.time_constant_ms", "axes.vertical.time_constant_ms"}
    assert keys["gain"] == {f"axes.{axis}.{key}" for axis in SENSORS for key in ("gain.intercept", "gain_recovery_ms")}
    for kind, numbers in {"latency": ["latency_ms"], "bias": ["bias_drift_sd_mm", "bias_time_s"]}.items():
        assert keys[kind] == {f"sensors.{name}.{key}" for name in ("tracker", "camera") for key in numbers}
    assert parameters(SHARED, SHARED, SENSORS, ["bias"]) == []  # no bias drifts


@pytest.mark.parametrize(("noise", "damping"), [("input_noise", 0.39), ("maneuver_noise", 0.41)])
def test_a_plant_that_rings_is_given_no_noise(noise: str, damping: float) -> None:
    """What it has stays free; what an axis drifts is not meant; nor is a plant that is damped well."""
    config = with_process(CONFIG, input_noise=0.0, maneuver_noise=0.0, drift=0.0)
    plant = pf.SecondOrder(natural_frequency=20.0, damping=damping)
    ringing = changed(config, ("arm", "axes", "radial", "plant"), plant)

    def free(config: pf.FusionConfig) -> set[str]:
        return {one.path[-1] for one in everything(config=config) if one.axis == "radial"}

    assert "drift" in free(ringing)
    assert (noise in free(ringing)) == (damping > 0.4)
    assert noise in free(changed(ringing, ("process", "radial", noise), 1e-3))


def test_a_noise_is_believed_within_a_factor_and_not_below_what_is_resolved() -> None:
    """The prior is of the ratio: 1.9 times as much costs ½, as does a 1.9th; only of the sensor and axis it is of."""
    at, fine, coarse = ("tracker", "radial"), {("camera", "radial"): 2e-5}, {("camera", "vertical"): 1e-12}
    free = {one.key: one for one in parameters(CONFIG, CONFIG, SENSORS, FITS, (), fine | coarse, {at: 4e-5})}
    noise = free["sensors.tracker.sd_mm.radial"]
    for factor, log in ((1.0, 0.0), (1.9, -0.5), (1.0 / 1.9, -0.5), (1.9**2, -2.0)):
        assert noise.log_prior(noise.set(CONFIG, factor * 4e-5)) == pytest.approx(log, abs=1e-9)
    assert all(one.prior is None for one in free.values() if one.is_noise and one is not noise)
    unbounded = of("sensors.camera.sd_mm.radial").bounds
    assert free["sensors.camera.sd_mm.radial"].bounds == (2e-5, unbounded[1])
    assert free["sensors.camera.sd_mm.vertical"].bounds == noise.bounds == unbounded


@pytest.mark.parametrize("scale", [-1.0, 0.06])
def test_a_scale_stays_within_half_of_what_is_configured(scale: float) -> None:
    """So it is never 0, and never turns its sign."""
    config = replaced(CONFIG, sensors={**CONFIG.sensors, "tracker": replaced(TRACKER, scale=scale)})
    (found,) = (one for one in parameters(config, config, SENSORS, ["scale"]) if one.sensor == "tracker")
    assert found.bounds == pytest.approx((scale - 0.5 * abs(scale), scale + 0.5 * abs(scale)))


def in_file(tree: dict[str, object], key: str) -> object:
    return reduce(lambda table, part: table[part], key.split("."), tree)  # pyright: ignore


@pytest.mark.parametrize("key", sorted(names()))
def test_a_parameter_is_under_its_key_in_the_files(key: str, tmp_path: Path) -> None:
    """With a new value it is written under its key in the key's unit; no other parameter has changed."""
    one = of(key)
    value = one.value(0.3 * one.range[0] + 0.7 * one.range[1])
    changed = one.set(CONFIG, value)
    assert one.number(changed) == value
    assert {name: number for name, number in snapshot(changed).items() if name != key} == {
        name: number for name, number in snapshot(CONFIG).items() if name != key
    }
    changed.save(tmp_path)
    file = "arm.toml" if key.startswith("axes.") else "fusion.toml"
    written = in_file(tomllib.loads((tmp_path / file).read_text()), key)
    assert written == pytest.approx(value / one.unit, rel=1e-12)
    assert one.number(pf.FusionConfig.load(tmp_path / "fusion.toml")) == pytest.approx(value, rel=1e-12)


def test_what_may_be_none() -> None:
    """A process noise, a disturbance's sd and a drifting bias's; no sensor's noise and no time."""
    disturbed = reduce(lambda config, axis: set_disturbance(config, axis, 1e-3, 0.3), SENSORS, CONFIG)
    none = {one.path[-1] for one in everything(config=disturbed) if one.vanishes}
    walk = {"input_noise", "drift", "maneuver_noise", "maneuver_drift"}
    assert none == {*walk, "disturbance_sd", "bias_drift_sd"}


# ---- fixing ---------------------------------------------------------------------------------------------------------

FIXED: dict[str, Callable[[str], bool]] = {
    "tracker": lambda key: key.startswith("sensors.tracker."),
    "radial.drift_mm_rts": lambda key: key == "process.radial.drift_mm_rts",
    "camera.radial": lambda key: key == "sensors.camera.sd_mm.radial",
    "sd_mm": lambda key: ".sd_mm." in key,
    "gain": lambda key: key.endswith(".gain.intercept"),
    "damping": lambda key: key == "axes.tangential.damping",
}


@pytest.mark.parametrize("name", FIXED)
def test_a_name_fixes_what_it_names_and_only_that(name: str) -> None:
    """All of its parts, in their order, are parts of the key; `gain` is not `gain_recovery_ms`."""
    check_fixed(CONFIG, [name])
    gone = {key for key in names() if FIXED[name](key)}
    assert gone
    assert names(name) == names() - gone == {key for key in names() if not is_fixed(key, [name])}


@pytest.mark.parametrize("wrong", ["drift", "sd_mm.tracker", "process.radial.sd_mm"])
def test_a_name_that_names_nothing_is_refused_with_the_parts_that_do(wrong: str) -> None:
    """Parts of words, parts in the wrong order, parts that never occur together; the message has the accepted parts."""
    with pytest.raises(pf.ConfigError) as refused:
        check_fixed(CONFIG, ["radial", wrong])
    line = str(refused.value)
    assert f"--fix: '{wrong}'" in line
    parts = line.partition("parts of names: ")[2].split(", ")
    assert set(parts) >= {"tracker", "camera", "spare", "drift_mm_rts", "radial", "bias_sd_mm", "latency_ms", "damping"}
    assert "time_constant_ms" in parts  # whichever the order
    for part in parts:
        check_fixed(CONFIG, [part])


def test_an_unknown_kind_is_refused_with_the_nearest() -> None:
    """And with all that are accepted; nothing at all is refused too. Known ones are put in order, once each."""
    assert kinds_of(["latency", "noise", "noise"]) == ["noise", "latency"]
    with pytest.raises(pf.ConfigError, match=r"--fit: unknown 'latencies'; did you mean 'latency'\? accepted: noise, "):
        kinds_of(["noise", "latencies"])
    with pytest.raises(pf.ConfigError, match="--fit: names nothing; accepted: noise, delay, plant, gain, latency"):
        kinds_of([])


# ---- plants ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["tangential", "radial"])
def test_an_arm_has_the_lag_that_its_plant_shows(axis: str) -> None:
    """Of either order: it is behind a ramp by ∫ (1 − step response) dt."""
    time = np.linspace(0.0, 2.0, 200_001)
    slower = set_arm(CONFIG, axis, Arm.of(ARM.axes[axis], 0.0)._replace(lag=0.07))
    for config, lag in ((CONFIG, ARM.axes[axis].plant.lag), (slower, 0.07)):
        plant = config.arm.axes[axis].plant
        assert type(plant) is type(ARM.axes[axis].plant)
        assert np.trapezoid(1.0 - plant.step_response(time), time) == pytest.approx(lag, rel=1e-6)


@pytest.mark.parametrize("gain", [0.25, 1.0, 2.0])
def test_a_gain_may_be_a_fifth_to_four_times_what_is_configured(gain: float) -> None:
    """Never 0 or less, which no arm has, however small it is."""
    axes = {name: replaced(axis, gain=pf.Gain(intercept=gain)) for name, axis in CONFIG.arm.axes.items()}
    config = replaced(CONFIG, arm=replaced(CONFIG.arm, axes=axes))
    gains = [one for one in parameters(config, config, SENSORS, ["gain"]) if one.path[-1] == "intercept"]
    assert gains and all(one.bounds == pytest.approx((0.2 * gain, 4.0 * gain)) for one in gains)

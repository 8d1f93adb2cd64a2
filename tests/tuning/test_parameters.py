"""Every number is called what its file calls it, moves alone, and stays where it is told to."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.tuning.parameters import (
    FITS,
    Parameter,
    check_holds,
    is_held,
    kinds_of,
    parameters,
)
from pumafuse.tuning.variants import with_axis_of, with_lag, with_order
from tuning_runs import replaced

ARM = pf.ArmModel.load("puma560-internal")  # tangential is second order, radial and vertical are first
TRACKER, CAMERA = pf.Sensor(sd=5e-5, latency=0.008), pf.Sensor(sd={"radial": 4e-4, "vertical": 3e-4}, latency=0.045)
CONFIG = pf.FusionConfig(arm=ARM, sensors={"tracker": TRACKER, "camera": CAMERA, "spare": pf.Sensor(sd=1.0)})
HEARD = {"tangential": ["tracker"], "radial": ["tracker", "camera"], "vertical": ["camera"]}


def everything(*hold: str, config: pf.FusionConfig = CONFIG) -> list[Parameter]:
    return parameters(config, CONFIG, HEARD, FITS, hold)


def names(*hold: str) -> set[str]:
    return {one.key for one in everything(*hold)}


def of(key: str, config: pf.FusionConfig = CONFIG) -> Parameter:
    (found,) = [one for one in everything(config=config) if one.key == key]
    return found


def snapshot(config: pf.FusionConfig) -> dict[str, float]:
    return {one.key: one.get(config) for one in everything(config=config)}


def test_what_can_be_fitted() -> None:
    """Four noises, a delay, a plant and two of a gain for each axis, an sd for each pair that is heard, a latency each.

    Sensors without measurements have neither.
    """
    noises = ("input_noise_mm_rtHz", "drift_mm_rts", "maneuver_noise_mm_rtHz_per_m_s", "maneuver_drift_mm_rts_per_m_s")
    plants = {
        "tangential": ("natural_frequency_rad_s", "damping"),
        "radial": ("time_constant_ms",),
        "vertical": ("time_constant_ms",),
    }
    wanted = {f"process.{axis}.{key}" for axis in HEARD for key in noises}
    wanted |= {f"axes.{axis}.{key}" for axis in HEARD for key in ("delay_ms", "gain.intercept", "gain_recovery_ms")}
    wanted |= {f"axes.{axis}.{key}" for axis, keys in plants.items() for key in keys}
    wanted |= {f"sensors.{name}.sd_mm.{axis}" for axis, heard in HEARD.items() for name in heard}
    wanted |= {"sensors.tracker.latency_ms", "sensors.camera.latency_ms"}
    assert names() == wanted
    kinds = {kind: {one.key for one in parameters(CONFIG, CONFIG, HEARD, [kind])} for kind in FITS}
    assert set().union(*kinds.values()) == wanted
    assert sum(map(len, kinds.values())) == len(wanted)
    assert kinds["latency"] == {"sensors.tracker.latency_ms", "sensors.camera.latency_ms"}
    assert kinds["delay"] == {f"axes.{axis}.delay_ms" for axis in HEARD}
    assert kinds["gain"] == {f"axes.{axis}.{key}" for axis in HEARD for key in ("gain.intercept", "gain_recovery_ms")}
    assert all(key.startswith(("process.", "sensors.")) and "latency" not in key for key in kinds["noise"])


def in_file(tree: dict[str, object], key: str) -> object:
    return reduce(lambda table, part: table[part], key.split("."), tree)  # pyright: ignore


@pytest.mark.parametrize("key", sorted(names()))
def test_a_number_is_where_its_name_says_in_the_files(key: str, tmp_path: Path) -> None:
    """Put and written, it stands under its own key in the key's unit; nothing else that can be fitted has changed."""
    one = of(key)
    value = one.value(0.3 * one.range[0] + 0.7 * one.range[1])
    changed = one.put(CONFIG, value)
    assert one.get(changed) == value
    assert {name: number for name, number in snapshot(changed).items() if name != key} == {
        name: number for name, number in snapshot(CONFIG).items() if name != key
    }
    changed.save(tmp_path)
    file = "arm.toml" if key.startswith("axes.") else "fusion.toml"
    written = in_file(tomllib.loads((tmp_path / file).read_text()), key)
    assert written == pytest.approx(value / one.unit, rel=1e-12)
    assert one.get(pf.FusionConfig.load(tmp_path / "fusion.toml")) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("key", sorted(names()))
def test_coordinates_and_numbers_are_each_others_inverse(key: str) -> None:
    """Within the bounds; what lies beyond them is moved to them. Noise and plants are on a log scale, times are not."""
    one = of(key)
    low, high = one.range
    assert low < one.coordinate(one.get(CONFIG)) < high or one.vanishes
    for coordinate in np.linspace(low, high, 7).tolist():
        assert one.coordinate(one.value(coordinate)) == pytest.approx(coordinate, rel=1e-12, abs=1e-12)
        assert one.get(one.move(CONFIG, coordinate)) == one.value(coordinate)
    assert one.coordinate(one.bounds[0] - 1.0) == low and one.coordinate(one.bounds[1] + 1.0) == high
    assert one.log == (not key.endswith(("delay_ms", "latency_ms", "gain.intercept")))


def test_units_are_those_of_the_keys() -> None:
    """Milliseconds and millimetres, per root and per m/s too; ratios and rad/s are as they are."""
    for key in names():
        last = key.removesuffix(".radial").removesuffix(".vertical").removesuffix(".tangential")
        milli = "_mm" in last or last.endswith("_ms")
        assert of(key).unit == (1e-3 if milli else 1.0), key


def test_an_arms_delay_is_what_an_axis_without_its_own_has() -> None:
    """Before it is moved; after that the axis has its own and the others keep the arm's."""
    one = of("axes.radial.delay_ms")
    assert one.get(CONFIG) == ARM.delay == 0.06045
    moved = one.put(CONFIG, 0.05)
    assert moved.arm.delay_of("radial") == 0.05
    assert moved.arm.delay_of("vertical") == 0.06045 == moved.arm.delay


def test_an_sd_of_all_axes_becomes_one_for_each() -> None:
    """The others keep what was said of all."""
    moved = of("sensors.tracker.sd_mm.radial").put(CONFIG, 1e-4)
    assert moved.sensors["tracker"].sd == {"tangential": 5e-5, "radial": 1e-4, "vertical": 5e-5}
    moved = of("sensors.camera.sd_mm.radial").put(CONFIG, 1e-4)
    assert moved.sensors["camera"].sd == {"radial": 1e-4, "vertical": 3e-4}


def test_what_was_not_configured_has_no_number_before() -> None:
    """A recovery that the arm has not, and a plant's number that one of the other order has not."""
    arm = replaced(ARM, axes={**ARM.axes, "radial": replaced(ARM.axes["radial"], gain_recovery=None)})
    config = replaced(CONFIG, arm=arm)
    assert of("axes.radial.gain_recovery_ms").given(CONFIG) == 0.1
    assert of("axes.radial.gain_recovery_ms").given(config) is None
    assert 0.02 < of("axes.radial.gain_recovery_ms").get(config) < 0.5
    second = with_order(CONFIG, "radial", 2)
    assert of("axes.radial.damping", second).given(CONFIG) is None
    assert of("axes.radial.damping", second).given(second) == 1.0


# ---- holding --------------------------------------------------------------------------------------------------------

HOLDS: dict[str, Callable[[str], bool]] = {
    "sensors.tracker": lambda key: key.startswith("sensors.tracker."),
    "tracker": lambda key: key.startswith("sensors.tracker."),
    "drift_mm_rts": lambda key: key.endswith(".drift_mm_rts"),
    "radial": lambda key: "radial" in key,
    "radial.drift_mm_rts": lambda key: key == "process.radial.drift_mm_rts",
    "process.radial": lambda key: key.startswith("process.radial."),
    "process.drift_mm_rts": lambda key: key.endswith(".drift_mm_rts"),
    "camera.radial": lambda key: key == "sensors.camera.sd_mm.radial",
    "sd_mm.vertical": lambda key: key == "sensors.camera.sd_mm.vertical",
    "sd_mm": lambda key: ".sd_mm." in key,
    "latency_ms": lambda key: key.endswith(".latency_ms"),
    "gain": lambda key: key.endswith(".gain.intercept"),
    "intercept": lambda key: key.endswith(".gain.intercept"),
    "gain_recovery_ms": lambda key: key.endswith(".gain_recovery_ms"),
    "axes.vertical": lambda key: key.startswith("axes.vertical."),
    "damping": lambda key: key == "axes.tangential.damping",
    "axes": lambda key: key.startswith("axes."),
}


@pytest.mark.parametrize("hold", HOLDS)
def test_a_name_holds_what_it_names_and_only_that(hold: str) -> None:
    """All of its parts, in their order, are parts of the key; `gain` is not `gain_recovery_ms`."""
    check_holds(CONFIG, [hold])
    gone = {key for key in names() if HOLDS[hold](key)}
    assert gone
    assert names(hold) == names() - gone


def test_several_names_hold_the_sum_of_what_each_does() -> None:
    """And none holds nothing."""
    assert names("tracker", "damping") == names("tracker") & names("damping")
    assert names() - names("tracker", "damping") == {key for key in names() if "tracker" in key or "damping" in key}


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.sampled_from(sorted(names())), st.data())
def test_any_parts_of_a_name_in_their_order_hold_it(key: str, data: st.DataObject) -> None:
    """The other way round or with a foreign part they do not."""
    parts = key.split(".")
    chosen = data.draw(st.lists(st.sampled_from(range(len(parts))), min_size=1, unique=True).map(sorted))
    hold = ".".join(parts[place] for place in chosen)
    assert is_held(key, [hold])
    assert not is_held(key, [f"{hold}.foreign"])
    assert not is_held(key, [f"foreign.{hold}"])
    if len(chosen) > 1:
        assert not is_held(key, [".".join(reversed(hold.split(".")))])
    assert not is_held(key, [hold[:-1]])


@pytest.mark.parametrize("wrong", ["drift", "tracker.camera", "sd_mm.tracker", "radia", "", "process.radial.sd_mm"])
def test_a_name_that_names_nothing_is_refused_with_the_parts_that_do(wrong: str) -> None:
    """Parts of words, parts in the wrong order, parts that never meet; the accepted parts are said."""
    with pytest.raises(pf.ConfigError) as refused:
        check_holds(CONFIG, ["radial", wrong])
    said = str(refused.value)
    assert f"--hold: '{wrong}'" in said
    parts = said.partition("parts of names: ")[2].split(", ")
    assert set(parts) >= {"tracker", "camera", "spare", "drift_mm_rts", "radial", "bias_sd_mm", "latency_ms", "damping"}
    assert "time_constant_ms" in parts  # whichever the order
    for part in parts:
        check_holds(CONFIG, [part])


def test_kinds_are_those_asked_for_in_their_order() -> None:
    """Once each."""
    assert kinds_of(["latency", "noise", "noise"]) == ["noise", "latency"]
    assert kinds_of(reversed(FITS)) == list(FITS)


def test_an_unknown_kind_is_refused_with_the_nearest() -> None:
    """And with all that are accepted; nothing at all is refused too."""
    with pytest.raises(pf.ConfigError, match=r"--fit: unknown 'latencies'; did you mean 'latency'\? accepted: noise, "):
        kinds_of(["noise", "latencies"])
    with pytest.raises(pf.ConfigError, match="--fit: names nothing; accepted: noise, delay, plant, gain, latency"):
        kinds_of([])


# ---- plants ---------------------------------------------------------------------------------------------------------


def far_behind(plant: pf.FirstOrder | pf.SecondOrder) -> float:
    """The lag behind a ramp, from the step response: ∫ (1 − c) dt."""
    time = np.linspace(0.0, 2.0, 200_001)
    return float(np.trapezoid(1.0 - plant.step_response(time), time))


@pytest.mark.parametrize("axis", ["tangential", "radial"])
def test_another_order_lags_as_far_behind(axis: str) -> None:
    """∫ (1 − step response) dt is what it was; the same order is left alone."""
    for order in (1, 2):
        other = with_order(CONFIG, axis, order)
        plant = other.arm.axes[axis].plant
        assert isinstance(plant, pf.FirstOrder if order == 1 else pf.SecondOrder)
        assert far_behind(plant) == pytest.approx(far_behind(ARM.axes[axis].plant), rel=1e-6)
        assert with_order(other, axis, order) == other
    assert with_order(CONFIG, "tangential", 2) == CONFIG


@pytest.mark.parametrize("axis", ["tangential", "radial"])
def test_a_plant_lags_as_told_in_its_own_shape(axis: str) -> None:
    """The damping stays."""
    for lag in (0.004, 0.07):
        plant = with_lag(CONFIG, axis, lag).arm.axes[axis].plant
        assert far_behind(plant) == pytest.approx(lag, rel=1e-6)
        if isinstance(plant, pf.SecondOrder):
            assert plant.damping == 0.864


def test_an_axis_is_taken_over_with_all_that_is_its_own() -> None:
    """Model, noise and sds of that axis are the other's, everything else stays: latencies too."""
    other = CONFIG
    for one in everything():
        other = one.move(other, 0.4 * one.range[0] + 0.6 * one.range[1])
    mixed, before, after = snapshot(with_axis_of(CONFIG, other, "radial")), snapshot(CONFIG), snapshot(other)
    for key in names():
        assert mixed[key] == (after if "radial" in key else before)[key], key
    assert all(not math.isclose(before[key], after[key]) for key in names())

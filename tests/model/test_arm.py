"""The arm model: Table II, ``arm.toml`` out and in without loss, and what is refused and how."""

import datetime
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.errors import ConfigError, UnknownNameError
from pumafuse.model.arm import ArmModel, AxisModel, Gain, Sag, Validity, commanded_speed
from pumafuse.model.plants import FirstOrder, SecondOrder
from pumafuse.units import ending

TOP = "name, update_period_ms, delay_ms, delay_ms_ci95, validity, axes, joints, provenance"

ARM = """\
name = "bench"
update_period_ms = 28.0
delay_ms = 60.45
[validity]
max_speed_m_s = 0.5
max_radius_mm = 700.0
[axes.tangential]
plant = "second-order"
natural_frequency_rad_s = 53.9
damping = 0.864
[axes.radial]
plant = "first-order"
time_constant_ms = 42.5
gain = { slope_s_m = 0.0818, intercept = 0.933 }
gain_recovery_ms = 100.0
delay_ms = 38.5
delay_ms_ci95 = [38.0, 39]
[provenance]
window_ms = 169
date = 2024-05-01
"""

finite = st.floats(-1e9, 1e9)
positive = st.floats(0.0, 1e9, exclude_min=True)
not_tiny = st.floats(1e-6, 1e9)
interval = st.none() | st.tuples(finite, finite)
word = st.text(max_size=8)

ascending = st.none() | st.tuples(finite, finite).map(lambda ends: (min(ends), max(ends)))
gains = st.builds(Gain, slope=finite, intercept=finite, slope_ci95=interval, intercept_ci95=ascending)
slopes = st.floats(-1.0, 1e3, exclude_min=True)
sags = st.builds(Sag, offset=finite, slope=slopes) | st.builds(
    lambda ends, **slopes: Sag(knee_below=min(ends), knee=max(ends), **slopes),
    st.tuples(finite, finite), offset=finite, slope=slopes, slope_beyond=slopes, slope_below=slopes,
)  # fmt: skip
first_order = st.builds(FirstOrder, time_constant=positive, time_constant_ci95=interval)
second_order = st.builds(
    SecondOrder,
    natural_frequency=not_tiny,
    damping=positive,
    natural_frequency_ci95=interval,
    damping_ci95=interval,
)
axis_models = st.builds(
    AxisModel,
    plant=first_order | second_order,
    gain=gains,
    gain_recovery=st.none() | not_tiny,
    delay=st.none() | st.floats(0.0, 1e4),
    max_speed=st.none() | positive,
    play=st.floats(0.0, 1e6),
    sag=st.none() | sags,
    delay_ci95=interval,
    lag_ci95=ascending,
    seen_lag_sd=st.none() | st.floats(0.0, 1e4),
    unseen_lag_sd=st.none() | st.floats(0.0, 1e4),
)
provenance = st.fixed_dictionaries(
    {},
    optional={
        "source": word,
        "trials": st.integers(-(2**63), 2**63 - 1),
        "robust": st.booleans(),
        "rms_error_mm": finite,
        "levels_m_s": st.lists(finite, max_size=4),
        "outliers": st.dictionaries(word, word | st.booleans() | st.lists(word, max_size=2), max_size=3),
    },
)
names = word.filter(lambda name: ending(name) is None and name.isprintable())
axis_names = st.sampled_from(["tangential", "radial", "vertical"]) | names
arms = st.builds(
    ArmModel,
    name=word,
    update_period=not_tiny,
    delay=st.floats(0.0, 1e4),
    delay_ci95=interval,
    validity=st.builds(Validity, max_speed=st.none() | positive, max_radius=st.none() | positive),
    axes=st.dictionaries(axis_names, axis_models, min_size=1, max_size=4),
    provenance=provenance,
)


@pytest.fixture
def load(tmp_path: Path):

    def from_text(text: str) -> ArmModel:
        path = tmp_path / "arm.toml"
        path.write_text(text, encoding="utf-8")
        return ArmModel.load(path)

    return from_text


@settings(max_examples=100)
@given(arm=arms)
def test_arm_toml_loses_nothing(tmp_path_factory: pytest.TempPathFactory, arm: ArmModel) -> None:
    """Any arm, with any optional key and any finite numbers, comes back from its file to the last bit."""
    path = tmp_path_factory.getbasetemp() / "arm.toml"
    arm.save(path)
    again = ArmModel.load(path)
    assert again == arm
    assert again.to_toml() == path.read_text(encoding="utf-8")


@settings(max_examples=60)
@given(value=st.floats(1e-6, 1e6))
def test_numbers_are_converted_without_rounding_twice(tmp_path_factory: pytest.TempPathFactory, value: float) -> None:
    """What stands in a file in ms is the float nearest to its thousandth in seconds."""
    path = tmp_path_factory.getbasetemp() / "units.toml"
    path.write_text(ARM.replace("60.45", repr(value)), encoding="utf-8")
    assert ArmModel.load(path).delay == float(Fraction(repr(value)) / 1000)


def test_file_is_in_file_units_and_python_in_si(load) -> None:
    """Each key of the file lands in its attribute, in SI, but provenance; what is absent has its default."""
    assert load(ARM) == ArmModel(
        name="bench",
        update_period=0.028,
        delay=0.06045,
        validity=Validity(max_speed=0.5, max_radius=0.7),
        axes={
            "tangential": AxisModel(plant=SecondOrder(natural_frequency=53.9, damping=0.864)),
            "radial": AxisModel(
                plant=FirstOrder(time_constant=0.0425),
                gain=Gain(slope=0.0818, intercept=0.933),
                gain_recovery=0.1,
                delay=0.0385,
                delay_ci95=(0.038, 0.039),
            ),
        },
        provenance={"window_ms": 169, "date": datetime.date(2024, 5, 1)},
    )


@pytest.mark.parametrize(("preset", "delay"), [("puma560-internal", 0.06045), ("puma560-external", 0.0385)])
def test_presets_are_table_ii(preset: str, delay: float) -> None:
    """A preset, taken by its name, is the paper's combined model, its gains recovering in 100 ms."""
    arm = ArmModel.load(preset)
    plants = {
        "tangential": (SecondOrder(natural_frequency=53.9, damping=0.864), 0.0518, 1.010),
        "radial": (FirstOrder(time_constant=0.0425), 0.0818, 0.933),
        "vertical": (FirstOrder(time_constant=0.0356), 0.134, 0.941),
    }
    assert (arm.update_period, arm.delay) == (0.028, delay)
    assert arm.validity == Validity(max_speed=0.5, max_radius=0.7)
    assert list(arm.axes) == list(plants)
    for name, (plant, slope, intercept) in plants.items():
        gain = Gain(slope=slope, intercept=intercept)
        assert arm.axes[name] == AxisModel(plant=plant, gain=gain, gain_recovery=0.1)


REFUSED = {
    "unknown key below": ("max_speed_m_s", "speed_m_s", "'validity.speed_m_s'", "max_speed_deg_s, max_radius_mm"),
    "missing unit of a plant": ("natural_frequency_rad_s", "natural_frequency", "'axes.tangential.natural_frequency'",
                                "natural_frequency_rad_s"),
    "text for a number": ("28.0", '"28"', "update_period_ms", "float"),
    "number for an axis": ("[axes.tangential]", "[axes]\nvertical = 3\n[axes.tangential]", "axes.vertical", "table"),
    "interval backwards": ("42.5", "42.5\nlag_ms_ci95 = [110.0, 95.0]", "axes.radial.lag_ms_ci95", "lower end first"),
    "missing key of a plant": ("damping = 0.864", "", "'axes.tangential.damping' is missing", ""),
    "not a number": ("0.864", "nan", "damping", "not a finite number"),
    "unknown plant": ('"first-order"', '"third-order"', "axes.radial.plant", "first-order, second-order"),
    "no axis": (ARM[ARM.index("[axes.t") : ARM.index("[prov")], "", "'axes' is missing", TOP),
    "exponent beyond decimal": ("28.0", "1e99999999999999999999", "number", "out of range"),
    "key with a newline": ("42.5", '42.5\n"a\\nb" = 1', "axes.radial", ""),
    "axis named like a unit": ("axes.radial", "axes.rail_mm", "axis 'rail_mm'", "must not end in a unit"),
    "a period of nothing": ("28.0", "1e-160", "update_period_ms", ">= 0.001"),
    "negative": ("60.45", "-1.0", "delay_ms", ">= 0"),
    "a speed of an angle": ("42.5", "42.5\nmax_speed_deg_s = 9.0", "axes.radial.max_speed_deg_s: for a length",
                            "max_speed_mm_s"),
    "a speed in m/s": ("42.5", "42.5\nmax_speed_m_s = 0.3", "'axes.radial.max_speed_m_s'", "max_speed_mm_s"),
    "play below nothing": ("42.5", "42.5\nplay_mm = -0.1", "axes.radial.play_mm", ">= 0"),
    "unknown key of a sag": ("42.5", "42.5\nsag = { knee = 3.0 }", "'axes.radial.sag.knee'", "knee_mm"),
    "a slope without a knee": ("42.5", "42.5\nsag = { slope_below = 0.1 }", "sag: knee_below", "give both or neither"),
    "knees that have changed places": (
        "42.5",
        "42.5\nsag = { knee_mm = 3.0, slope_beyond = 0.1, knee_below_mm = 4.0, slope_below = 0.1 }",
        "sag: knee_below",
        "above the knee: move it to the knee or below",
    ),
    "a knee without a slope": ("42.5", "42.5\nsag = { knee_mm = 3.0 }", "sag: a knee", "give both or neither"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "key", "accepted"), REFUSED.values(), ids=REFUSED.keys())
def test_a_wrong_file_is_refused_in_one_line(load, tmp_path: Path, old: str, new: str, key: str, accepted: str):
    """A wrong file is refused with one line that names the file, the key and what would be accepted."""
    assert old in ARM
    with pytest.raises(ConfigError) as caught:
        load(ARM.replace(old, new, 1))
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'arm.toml'}: ")
    assert key in message
    assert accepted in message
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("puma650-internal", r"puma650-internal: .*puma560-internal, puma560-external"),
        ("x" * 300, "no such arm file"),
    ],
    ids=["misspelled preset", "name too long for a file"],
)
def test_a_source_that_is_no_arm_is_refused(source: str, message: str) -> None:
    """Neither a file nor a preset; the presets are named."""
    with pytest.raises(ConfigError, match=message):
        ArmModel.load(source)


def test_an_unknown_axis_is_refused_with_the_known_ones(load) -> None:
    """Asking for an axis that the arm does not have names the ones it has."""
    with pytest.raises(
        UnknownNameError, match="bench: unknown axis 'vertical'; accepted: tangential, radial"
    ) as caught:
        load(ARM).axis("vertical")
    assert caught.value.accepted == ("tangential", "radial")


def test_an_axis_may_override_the_delay(load) -> None:
    """An axis's own delay wins over the arm's, also when it is zero."""
    arm = load(ARM.replace("0.864", "0.864\ndelay_ms = 0"))
    assert arm.delay_of("tangential") == 0.0
    assert arm.delay_of("radial") == 0.0385
    assert load(ARM).delay_of("tangential") == 0.06045


def test_numbers_of_numpy_come_back_as_plain_ones(tmp_path: Path) -> None:
    """And so do whole numbers in place of floats, and open intervals."""
    axes = {"radial": AxisModel(plant=FirstOrder(time_constant=2))}
    arm = ArmModel(name="x", update_period=np.float64(0.028), delay=0.06, axes=axes, delay_ci95=(0.05, np.inf))
    arm.save(tmp_path / "arm.toml")
    assert ArmModel.load(tmp_path / "arm.toml") == arm


def test_gain_is_equation_11() -> None:
    """K = a·speed + b, speed being a step over the update period whichever way it goes."""
    speed = commanded_speed(np.array([0.002, -0.019, 0.0]), 0.028)
    np.testing.assert_allclose(speed, [0.0714286, 0.6785714, 0.0], atol=1e-7)
    np.testing.assert_allclose(
        Gain(slope=0.134, intercept=0.941).at(speed), [0.9505714, 1.0319286, 0.941], rtol=0.0, atol=1e-7
    )


LIMITS = Validity(max_speed=0.5, max_radius=0.7)


@pytest.mark.parametrize(
    ("limits", "speed", "radius", "exceeded"),
    [
        (LIMITS, 0.68, 0.7321, ["0.68 m/s, 1.36 times the 0.5 m/s", "732.1 mm from the base axis, 32.1 mm beyond"]),
        (LIMITS, 0.5001, 0.7, []),
        (LIMITS, 0.51, None, ["1.02 times"]),
        (Validity(), 9.0, 9.0, []),
    ],
)
def test_validity_counts_only_what_is_exceeded(
    limits: Validity, speed: float, radius: float | None, exceeded: list[str]
) -> None:
    """A sentence for each, with the excess; beyond by less than is shown is within; an unknown radius is no limit."""
    sentences = limits.excess({"length": speed}, radius)
    assert all(words in sentence for words, sentence in zip(exceeded, sentences, strict=True))


def test_what_bends_an_axis_is_said_with_its_size_and_interval() -> None:
    """In the units of its kind; the slopes of a sag are told as what they are beside its line; else nothing is said."""
    plant = FirstOrder(time_constant=0.05)
    assert AxisModel(plant=plant, play=0.0).bends == []
    length = AxisModel(plant=plant, play=2e-4, play_ci95=(1.5e-4, 2.5e-4), max_speed=0.3)
    assert length.bends == [
        "play: 0.2 (0.15 to 0.25) mm, half of which over its speed adds to its lag",
        "fastest speed: about 300 mm/s, up to which its lag holds",
    ]
    sag = Sag(offset=0.01, slope=-0.2, knee=0.5, slope_beyond=-0.6, slope_beyond_ci95=(-0.64, -0.56))
    angle = AxisModel(kind="angle", plant=plant, sag=sag)
    assert angle.bends == [
        "sag: off by 0.573 deg at 0, and moves 0.8 times as far as commanded",
        "sag: above about 28.65 deg it moves 0.5 (0.45 to 0.55) times as far as elsewhere",
    ]
    arm = ArmModel(name="bent", update_period=0.02, delay=0.0, axes={"x": length, "turn": angle})
    assert arm.bends() == [f"x: {'; '.join(length.bends)}", f"turn: {'; '.join(angle.bends)}"]

"""The arm model: a plant, a gain and a delay for each axis, and ``arm.toml``."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray
from ..errors import ConfigError, UnknownNameError, suggestion
from ..toml import Interval, NotNegative, Positive, Time
from ..units import AN, KINDS, MM, MS, SCREEN, Kind, Screen, of_kind, refuse_name
from .plants import PLANTS, Delay

# arms by name: files beside this one; the PUMA 560 is the paper's Table II, "The Combined Model"
PRESETS = {name: Path(__file__).with_name(f"{name}.toml") for name in ("puma560-internal", "puma560-external")}
CANONICAL_AXES = ("tangential", "radial", "vertical")
Slope = Annotated[float, msgspec.Meta(gt=-1, le=1e3)]  # at -1 or less a tool would go backwards, at 1000 run away
EXCEEDED = 1.005  # share of a limit from which two decimals show that it is exceeded


class Gain(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Gain K = slope · speed + intercept of a step, equation 11.

    Attributes:
        slope: a [s/m or s/rad] (the paper's Table II prints m/s; K has no unit, so it is s/m).
        intercept: b, the gain of an infinitely slow step.
        slope_ci95: 95 % interval of a, if it was identified.
        intercept_ci95: 95 % interval of b.
    """

    slope: float = msgspec.field(name="slope_s_m", default=0.0)
    intercept: float = 1.0
    slope_ci95: Interval | None = msgspec.field(name="slope_s_m_ci95", default=None)
    intercept_ci95: Interval | None = None

    def at(self, speed: FloatArray) -> FloatArray:
        """K at ``speed`` [m/s or rad/s]; the shape of ``speed``."""
        return self.slope * speed + self.intercept


class Sag(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How far a load or a stop holds the tool off, by its position p as commanded: a line in up to three pieces.

    Attributes:
        offset: At p = 0 [m or rad], along the line that holds there below the knee.
        slope: What each 1 of p adds.
        knee: The p [m or rad] above which another slope holds; None: none does.
        slope_beyond: The slope there.
        knee_below: The p [m or rad] below which another slope holds; None: none does.
        slope_below: The slope there.
        knee_ci95: The knee's 95 % interval [m or rad], if it was fitted.
        slope_beyond_ci95: That of the slope beyond.
        knee_below_ci95: That of the knee below.
        slope_below_ci95: That of the slope below.
    """

    offset: float = msgspec.field(name="offset_mm", default=0.0)
    slope: Slope = 0.0
    knee: float | None = msgspec.field(name="knee_mm", default=None)
    slope_beyond: Slope | None = None
    knee_below: float | None = msgspec.field(name="knee_below_mm", default=None)
    slope_below: Slope | None = None
    knee_ci95: Interval | None = msgspec.field(name="knee_mm_ci95", default=None)
    slope_beyond_ci95: Interval | None = None
    knee_below_ci95: Interval | None = msgspec.field(name="knee_below_mm_ci95", default=None)
    slope_below_ci95: Interval | None = None

    def __post_init__(self) -> None:
        if (self.knee is None) != (self.slope_beyond is None):
            raise ConfigError("sag: a knee and slope_beyond belong together: give both or neither")
        if (self.knee_below is None) != (self.slope_below is None):
            raise ConfigError("sag: knee_below and slope_below belong together: give both or neither")
        if self.knee is not None and self.knee_below is not None and self.knee_below > self.knee:
            raise ConfigError("sag: knee_below is above the knee: move it to the knee or below")

    def at(self, position: FloatArray) -> FloatArray:
        """Off by how much [m or rad] at positions as commanded; the shape of ``position``."""
        line = self.offset + self.slope * position
        if self.knee is not None and self.slope_beyond is not None:
            line = line + (self.slope_beyond - self.slope) * np.maximum(position - self.knee, 0.0)
        if self.knee_below is not None and self.slope_below is not None:
            line = line + (self.slope_below - self.slope) * np.minimum(position - self.knee_below, 0.0)
        return line

    def words(self, screen: Screen) -> list[str]:
        """How far off it holds the tool, with the intervals, a phrase for each piece that is no offset of 0."""
        line = (
            f"off by {self.offset * screen.scale:.4g} {screen.unit} at 0, and moves {1.0 + self.slope:.4g} times as far"
        )
        phrases = [f"sag: {line} as commanded"] if self.offset or self.slope else []
        for side, knee, knee_ci95, slope, slope_ci95 in (
            ("above", self.knee, self.knee_ci95, self.slope_beyond, self.slope_beyond_ci95),
            ("below", self.knee_below, self.knee_below_ci95, self.slope_below, self.slope_below_ci95),
        ):
            if knee is not None and slope is not None:
                ends = None if slope_ci95 is None else (1.0 + slope_ci95[0], 1.0 + slope_ci95[1])
                times = _scale(1.0 + slope, ends, 1.0 / (1.0 + self.slope))
                at = f"{_scale(knee, knee_ci95, screen.scale)} {screen.unit}"
                phrases.append(f"sag: {side} {at} it moves {times} times as far as elsewhere")
        return phrases


class AxisModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The model of one axis.

    Attributes:
        kind: Whether its positions are lengths [m] or angles [rad].
        plant: The plant, of unit gain.
        gain: The gain over speed, which acts on the command before the plant.
        gain_recovery: Time constant [s] with which the gain error decays, by the servo's integral action; None: never.
        gain_recovery_ci95: Its 95 % interval [s], if it was fitted.
        max_speed: The fastest that the axis itself goes [m/s or rad/s]; None: as fast as it is asked to.
        max_speed_ci95: Its 95 % interval [m/s or rad/s], if it was fitted.
        play: Width of the backlash between drive and tool [m or rad]; None: it has none.
        play_ci95: Its 95 % interval [m or rad], if it was fitted.
        sag: How far a static load holds the tool off.
        delay: Dead time [s] of this axis if it differs from the arm's.
        delay_ci95: Its 95 % interval [s], if it was fitted.
        lag_ci95: The 95 % interval of :meth:`lag` at slow motion [s], if it was fitted: delay and plant make up for
            each other, so that their sum is known better than either.
        seen_lag_sd: The standard deviation of the lag [s] at the one instant of each step at which sensors in step with
            the commands saw the arm that was fitted; None: the interval tells.
        unseen_lag_sd: What is more than that at the commands [s], where no measurement told.
    """

    kind: Kind = "length"
    plant: PLANTS
    gain: Gain = Gain()
    gain_recovery: Time | None = msgspec.field(name="gain_recovery_ms", default=None)
    gain_recovery_ci95: Interval | None = msgspec.field(name="gain_recovery_ms_ci95", default=None)
    max_speed: Positive | None = msgspec.field(name="max_speed_mm_s", default=None)
    max_speed_ci95: Interval | None = msgspec.field(name="max_speed_mm_s_ci95", default=None)
    play: NotNegative | None = msgspec.field(name="play_mm", default=None)
    play_ci95: Interval | None = msgspec.field(name="play_mm_ci95", default=None)
    sag: Sag | None = None
    delay: Delay | None = msgspec.field(name="delay_ms", default=None)
    delay_ci95: Interval | None = msgspec.field(name="delay_ms_ci95", default=None)
    lag_ci95: Interval | None = msgspec.field(name="lag_ms_ci95", default=None)
    seen_lag_sd: Delay | None = msgspec.field(name="seen_lag_sd_ms", default=None)
    unseen_lag_sd: Delay | None = msgspec.field(name="unseen_lag_sd_ms", default=None)

    def lag(self, delay: float, speed: float = 0.0) -> float:
        """Total lag [s] behind the held command at constant velocity: Td + τ, or Td + 2ζ/ω, plus (1 − K)·recovery.

        Behind the path through the commanded points it is T/2 more: a held command is that late itself. A gain that
        does not recover is no lag; it makes the motion smaller.

        Args:
            delay: Td [s] of this axis; :meth:`ArmModel.lag_of` knows it.
            speed: At which K is taken [m/s or rad/s]; 0: slow motion.
        """
        gain_error = 1.0 - (self.gain.slope * speed + self.gain.intercept)
        return delay + self.plant.lag + gain_error * (self.gain_recovery or 0.0)

    @property
    def bends(self) -> list[str]:
        """Play, fastest speed and sag, with intervals, and of which motion the lag is; nothing of a linear axis."""
        screen, phrases = SCREEN[self.kind], list[str]()
        if self.play:
            size = f"{_scale(self.play, self.play_ci95, screen.scale)} {screen.unit}"
            phrases.append(f"play: {size}, half of which over its speed adds to its lag")
        if self.max_speed:
            size = f"{_scale(self.max_speed, self.max_speed_ci95, screen.scale)} {screen.unit}/s"
            phrases.append(f"fastest speed: {size}, up to which its lag holds")
        return [*phrases, *(self.sag.words(screen) if self.sag else [])]


class Joint(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A joint of an arm that is commanded in joints and whose axes are those of its tool.

    Attributes:
        later: By how much it answers later than the joint that answers first [s].
        later_ci95: Its 95 % interval, if it was fitted.
    """

    later: Delay = msgspec.field(name="later_ms", default=0.0)
    later_ci95: Interval | None = msgspec.field(name="later_ms_ci95", default=None)


class Validity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits within which the model was found to hold; beyond them pumafuse warns and goes on.

    Attributes:
        max_speed: Commanded speed of an axis that is a length [m/s].
        max_angular_speed: Of one that is an angle [rad/s].
        max_radius: Distance from the base's vertical axis [m].
    """

    max_speed: Positive | None = msgspec.field(name="max_speed_m_s", default=None)
    max_angular_speed: Positive | None = msgspec.field(name="max_speed_deg_s", default=None)
    max_radius: Positive | None = msgspec.field(name="max_radius_mm", default=None)

    def limit_of(self, kind: Kind) -> float | None:
        """The highest commanded speed of axes of a kind [m/s or rad/s]."""
        return self.max_speed if kind == "length" else self.max_angular_speed

    def excess(self, speed: Mapping[Kind, float], radius: float | None) -> list[str]:
        """One sentence for each limit that is exceeded.

        Args:
            speed: The highest commanded one for each kind of axis [m/s or rad/s].
            radius: The largest commanded one [m]; None: not known.
        """
        sentences: list[str] = []
        for kind, fastest in speed.items():
            limit, screen = self.limit_of(kind), SCREEN[kind]
            if limit is not None and fastest > limit * EXCEEDED:
                shown = f"{limit * screen.fast_scale:g} {screen.fast}"
                sentences.append(
                    f"commanded speed reaches {fastest * screen.fast_scale:.3g} {screen.fast},"
                    f" {fastest / limit:.2f} times the {shown} that the arm model is valid for"
                )
        if self.max_radius is not None and radius is not None and radius > self.max_radius:
            beyond = (radius - self.max_radius) * MM
            sentences.append(
                f"commands reach {radius * MM:.1f} mm from the base axis, {beyond:.1f} mm beyond the"
                f" {self.max_radius * MM:g} mm that the arm model is valid for"
            )
        return sentences


class ArmModel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The model of an arm: what ``arm.toml`` holds, in SI units.

    Attributes:
        name: For people.
        update_period: T [s], the time between commands.
        delay: Td [s], from the command to the plant's input.
        axes: One model for each axis.
        joints: The joints by which the tool is commanded and that do not all answer alike; the axes answer as the first
            of them does.
        delay_ci95: Its 95 % interval [s], if it was fitted.
        validity: Limits beyond which the model was not tried.
        provenance: Where the numbers come from; kept as it is.
    """

    name: str
    update_period: Time = msgspec.field(name="update_period_ms")
    delay: Delay = msgspec.field(name="delay_ms")
    delay_ci95: Interval | None = msgspec.field(name="delay_ms_ci95", default=None)
    validity: Validity = Validity()
    axes: Annotated[dict[str, AxisModel], msgspec.Meta(min_length=1)]
    joints: dict[str, Joint] = {}
    provenance: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if not self.axes:
            raise ConfigError("axes: an arm has one at least")
        for name, axis in self.axes.items():
            refuse_name("axis", name)
            self._check(name, axis)
        keys: dict[Kind, str] = {"length": "max_speed_m_s", "angle": "max_speed_deg_s"}
        for kind in KINDS:
            if self.validity.limit_of(kind) is not None and kind not in self.kinds:
                right = keys[self.kinds[0]]
                raise ConfigError(f"validity.{keys[kind]}: no axis of the arm is {AN[kind]}; give {right}")

    def _check(self, name: str, axis: AxisModel) -> None:
        """Refuse numbers that no file may have: an arm may be made in Python, too."""
        plant = [number for number in msgspec.structs.astuple(axis.plant) if isinstance(number, float | int)]
        optional = [1.0 if number is None else number for number in (axis.gain_recovery, axis.max_speed)]
        positive = self.update_period, *optional, *plant
        may_be_none = axis.delay, axis.play, axis.seen_lag_sd, axis.unseen_lag_sd
        not_negative = self.delay, *(0.0 if number is None else number for number in may_be_none)
        if not math.isfinite(sum(positive) + sum(not_negative) + axis.gain.slope + axis.gain.intercept):
            raise ConfigError(f"axes.{name}: period, delay, plant, gain, fastest speed, play and sds must be finite")
        if min(positive) <= 0.0 or min(not_negative) < 0.0:
            raise ConfigError(
                f"axes.{name}: period, plant, recovery and fastest speed must be > 0, delay, play and sds >= 0"
            )
        for key, ci95 in {"lag_ms_ci95": axis.lag_ci95, "gain.intercept_ci95": axis.gain.intercept_ci95}.items():
            if ci95 is not None and not ci95[0] <= ci95[1]:
                raise ConfigError(f"axes.{name}.{key}: an interval has its lower end first, then its upper end")

    def __repr__(self) -> str:
        lags = ", ".join(f"{axis} {self.lag_of(axis) * MS:.4g} ms" for axis in self.axes)
        return f"ArmModel({self.name!r}, T {self.update_period * MS:g} ms; lags: {lags})"

    @staticmethod
    def load(source: str | Path) -> ArmModel:
        """Read ``arm.toml``, or take a preset by its name.

        Raises:
            ConfigError: No such file or preset, or its content is not an arm; names the key and the accepted ones.
        """
        path = PRESETS.get(str(source), Path(source))
        if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises on a name that is too long
            raise ConfigError(f"{source}: no such arm file, and not a preset ({', '.join(PRESETS)})")
        return arm_of(toml.read(path), str(source))

    @staticmethod
    def parse(source: str | Mapping[str, Any]) -> ArmModel:
        """Make an arm of the text of an ``arm.toml``, or of a dict with the same keys.

        Raises:
            ConfigError: It is not an arm; names the key and the accepted ones.
        """
        return arm_of(toml.parsed(source, "arm"), "arm")

    def save(self, path: str | Path) -> None:
        """Write ``arm.toml``; reading it back gives the same model, to the last bit."""
        Path(path).write_text(self.to_toml(), encoding="utf-8")

    def to_toml(self) -> str:
        """The text of ``arm.toml``."""
        tree = toml.builtins(self)
        for name, axis in self.axes.items():
            table = toml.builtins(axis, axis.kind)
            kind = {} if axis.kind == "length" else {"kind": axis.kind}
            tree["axes"][name] = {**kind, **table.pop("plant"), **{key: table[key] for key in table if key != "kind"}}
        return toml.text({key: value for key, value in tree.items() if value != {}})

    def axis(self, name: str) -> AxisModel:
        """The model of one axis.

        Raises:
            UnknownNameError: The arm has no axis of this name.
        """
        if name not in self.axes:
            raise UnknownNameError(self.name, "axis", name, self.axes)
        return self.axes[name]

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of its axes."""
        return tuple(kind for kind in KINDS if any(axis.kind == kind for axis in self.axes.values()))

    @property
    def kind_of(self) -> dict[str, Kind]:
        """What each of its axes is."""
        return {name: axis.kind for name, axis in self.axes.items()}

    def screen_of(self, axis: str) -> Screen:
        """How files and screens show positions of one axis."""
        return SCREEN[self.axis(axis).kind]

    def delay_of(self, axis: str) -> float:
        """Td [s] of one axis: its own, or the arm's."""
        delay = self.axis(axis).delay
        return self.delay if delay is None else delay

    @property
    def later(self) -> dict[str, float]:
        """How much later than the first each joint answers [s]."""
        return {name: joint.later for name, joint in self.joints.items()}

    def joint_doubts(self) -> list[str]:
        """A sentence if joints answer later than the axes do, of which commands that are not in joints tell nothing."""
        late = ", ".join(f"{name} {by * MS:.3g} ms" for name, by in self.later.items() if by)
        return [f"joints that answer later ({late}) are not heeded: the commands are not in joints"] if late else []

    def doubts(self) -> list[str]:
        """A sentence if the gain of axes depends on the speed and does not recover."""
        axes = [name for name, axis in self.axes.items() if axis.gain.slope and axis.gain_recovery is None]
        if not axes:
            return []
        of = f"axis {axes[0]}" if len(axes) == 1 else f"axes {', '.join(axes)}"
        return [
            f"{of}: a gain that depends on the speed without gain_recovery_ms: where a motion ends depends on how fast"
            " it went, which no arm does for long; tune --fit gain finds a recovery"
        ]

    def bends(self) -> list[str]:
        """A sentence on each axis that has play, a fastest speed or a sag: :attr:`AxisModel.bends`."""
        return [f"{name}: {'; '.join(axis.bends)}" for name, axis in self.axes.items() if axis.bends]

    def lag_of(self, axis: str, speed: float = 0.0) -> float:
        """Total lag [s] of one axis behind the held command at constant velocity: :meth:`AxisModel.lag`."""
        return self.axis(axis).lag(self.delay_of(axis), speed)


def commanded_speed(step: FloatArray, period: float) -> FloatArray:
    """Speed of each command: its step over the update period [s] (the paper's "speed" of a step)."""
    return np.abs(step) / period


def _scale(value: float, ci95: Interval | None, scale: float) -> str:
    """A number with its interval, if there is one, both times ``scale``."""
    if ci95 is None:
        return f"about {value * scale:.4g}"
    return f"{value * scale:.4g} ({ci95[0] * scale:.4g} to {ci95[1] * scale:.4g})"


def arm_of(tree: Mapping[str, Any], where: str) -> ArmModel:
    """The arm of the tables of an ``arm.toml`` (SI numbers).

    Raises:
        ConfigError: They are not an arm; names the key and the accepted ones.
    """
    axes = tree.get("axes")
    if isinstance(axes, dict):
        made = {name: _axis(table, where, f"axes.{name}") for name, table in axes.items()}  # pyright: ignore
        tree = {**tree, "axes": made}
    return toml.struct(tree, ArmModel, where)


def _axis(table: Any, where: str, path: str) -> AxisModel:
    """The model of an axis from its table, in which the plant's keys stand beside the axis's own."""
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: {path}: expected a table")
    keys: dict[str, Any] = dict(table)  # pyright: ignore[reportUnknownArgumentType]
    plants = {str(kind.__struct_config__.tag): kind for kind in get_args(PLANTS)}
    name = str(keys.pop("plant", "none"))
    if name not in plants:
        raise ConfigError(f"{where}: {path}.plant: unknown plant '{name}'; {suggestion(name, plants)}")
    plant = [field.encode_name for field in msgspec.structs.fields(plants[name])]
    kind: Kind = "angle" if keys.get("kind") == "angle" else "length"
    fields = [field.encode_name for field in msgspec.structs.fields(AxisModel)]
    accepted = dict.fromkeys(["plant", *plant, *(of_kind(key, kind) for key in fields)])
    for key in keys.keys() - accepted.keys() - {of_kind(key, other) for key in fields for other in KINDS}:
        raise ConfigError(f"{where}: unknown key '{path}.{key}'; {suggestion(key, accepted)}")
    parameters = {key: keys.pop(key) for key in plant if key in keys}
    made = toml.struct(parameters, plants[name], where, path)
    return toml.struct({**keys, "plant": made}, AxisModel, where, path, kind)

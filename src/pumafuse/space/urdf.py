"""The links and joints of a URDF file (wiki.ros.org/urdf/XML): nothing in it is expanded, fetched or run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ..arrays import FloatArray
from ..errors import ConfigError, UnknownNameError
from ..toml import MOST_TEXT, text_of
from ..units import Kind

MOST = 1e9  # m, rad, or a factor: what is larger is no size of a robot, and would overflow
_KINDS: dict[str, Kind | None] = {"revolute": "angle", "continuous": "angle", "prismatic": "length", "fixed": None}


@dataclass(frozen=True)
class Joint:
    """A joint as its file has it."""

    where: str  # the file and the joint, for errors
    type: str
    parent: str  # the link that holds it
    child: str  # the link that it moves
    at: FloatArray  # its origin in the parent's frame [m], (1, 3)
    rpy: tuple[float, ...]  # the turns of its origin about the parent's x, then y, then z [rad]
    axis: FloatArray  # that it moves about or along, of length 1, (1, 3); some files have 0 0 0 where it is fixed
    mimic: tuple[str, float, float] | None  # the joint that drives it, a factor and an offset; None: itself

    @property
    def kind(self) -> Kind | None:
        """What it moves by; None where it does not move."""
        if self.type not in _KINDS:
            raise ConfigError(f"{self.where} is of type '{self.type}'; in a chain it must be {', '.join(_KINDS)}")
        return _KINDS[self.type]


@dataclass(frozen=True)
class Urdf:
    """The links and joints of a file, by name."""

    path: Path
    links: list[str]
    joints: dict[str, Joint]

    def route(self, base: str, tip: str) -> list[str]:
        """The joints that lead from one link to another."""
        for link in (base, tip):
            if link not in self.links:
                raise UnknownNameError(str(self.path), "link", link, self.links)
        above: dict[str, str] = {}
        for name, joint in self.joints.items():
            if joint.child in above:
                raise ConfigError(f"{joint.where}: joint '{above[joint.child]}' has the same child '{joint.child}'")
            above[joint.child] = name
        passed, route = [tip], list[str]()
        while passed[-1] != base:
            if passed[-1] not in above:
                higher = ", ".join(passed[1:]) or "no link"
                raise ConfigError(f"{self.path}: no joints lead from link '{base}' to '{tip}'; above it: {higher}")
            route.append(above[passed[-1]])
            parent = self.joints[route[-1]].parent
            if parent in passed:
                raise ConfigError(f"{self.path}: the links go in a circle: {', '.join([*passed, parent])}")
            passed.append(parent)
        return route[::-1]

    def driver(self, name: str) -> tuple[str, float, float]:
        """The joint that drives one, by itself or through others that mimic it, with a factor and an offset."""
        multiplier, offset, passed = 1.0, 0.0, [name]
        while (mimic := self.joints[passed[-1]].mimic) is not None:
            where = self.joints[passed[-1]].where
            if mimic[0] not in self.joints:
                raise UnknownNameError(f"{where}: mimic", "joint", mimic[0], self.joints)
            if mimic[0] in passed:
                raise ConfigError(f"{where}: joints mimic in a circle: {', '.join([*passed, mimic[0]])}")
            passed.append(mimic[0])
            offset += multiplier * mimic[2]
            multiplier *= mimic[1]
        return passed[-1], multiplier, offset


def read(path: Path) -> Urdf:
    """The robot of a file; a ConfigError says where it is none."""
    robot = _root(path)
    joints: dict[str, Joint] = {}
    for element in robot.findall("joint"):
        name = element.get("name", "")
        if name in joints:
            raise ConfigError(f"{path}: two joints have the name '{name}'")
        joints[name] = _joint(f"{path}: joint '{name}'", element)
    return Urdf(path, [link.get("name", "") for link in robot.findall("link")], joints)


def _root(path: Path) -> Element:
    text = text_of(path)
    if len(text) > MOST_TEXT:
        raise ConfigError(f"{path}: more than {MOST_TEXT >> 20} MB: no URDF")
    if "<!DOCTYPE" in text:  # there alone entities are declared, which made of one another fill any memory
        raise ConfigError(f"{path}: it has a DOCTYPE, which a URDF does not need: remove it")
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path}: not a URDF: {error}") from None
    if any("xacro}" in element.tag for element in robot.iter()):
        raise ConfigError(f"{path}: a xacro file, not yet a URDF: run `xacro {path.name} > expanded.urdf` first")
    if robot.tag != "robot":
        raise ConfigError(f"{path}: not a URDF: it begins with <{robot.tag}>, a URDF with <robot>")
    return robot


def _joint(where: str, element: Element) -> Joint:
    def text(tag: str, key: str, default: str | None = None) -> str:
        part = element.find(tag)
        value = default if part is None else part.get(key, default)
        if value is None:
            raise ConfigError(f'{where} has no <{tag} {key}="…">')
        return value

    def numbers(tag: str, key: str, default: str) -> tuple[float, ...]:
        written, count = text(tag, key, default), len(default.split())
        try:
            values = tuple(map(float, written.split()))
        except ValueError:
            values = ()
        if len(values) != count or not all(abs(value) <= MOST for value in values):
            wanted = "a number" if count == 1 else f"{count} numbers"
            raise ConfigError(f'{where}: {tag} {key}="{written}": expected {wanted}, each at most {MOST:.0e}')
        return values

    origin = element.find("origin")
    if origin is not None and not {"xyz", "rpy"}.issuperset(origin.keys()):
        raise ConfigError(f"{where}: origin has {', '.join(origin.keys())}; known are xyz and rpy")
    direction = numbers("axis", "xyz", "1 0 0")
    mimic = None
    if element.find("mimic") is not None:
        (multiplier,), (offset,) = numbers("mimic", "multiplier", "1"), numbers("mimic", "offset", "0")
        mimic = text("mimic", "joint"), multiplier, offset
    return Joint(
        where=where,
        type=element.get("type", ""),
        parent=text("parent", "link"),
        child=text("child", "link"),
        at=np.array(numbers("origin", "xyz", "0 0 0"))[None],
        rpy=numbers("origin", "rpy", "0 0 0"),
        axis=np.array(direction)[None] / (math.hypot(*direction) or 1.0),
        mimic=mimic,
    )

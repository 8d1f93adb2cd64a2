"""A configuration as a C header: the numbers that a program in C gives to the filter's core, ``pumafuse.h``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.metadata import version

from ..filter.core import VERSION, Record
from ..fusion.config import FusionConfig
from ..fusion.setup import live_model

MARK = "/* Made by pumafuse"  # what every header begins with
_HEADER = """\
{mark} {version} from {source}: make it anew rather than change it.
 *
 * Arm and sensors as `pumafuse live` has them, to the bit, in SI{frame}. pumafuse.h says what each number is.
 */
#ifndef {upper}_MODEL_H
#define {upper}_MODEL_H

#include <math.h>

#include "pumafuse.h"

#if PF_VERSION != {interface}
#error "this is for interface {interface} of pumafuse.h: make it anew with the pumafuse that this one is of"
#endif

enum {{ {axes}, {upper}_AXES }};
enum {{ {sensors}, {upper}_SENSORS }};

static const pf_axis {name}_axis[{upper}_AXES] = {{
{axis}}};

static const pf_sensor {name}_sensor[{upper}_SENSORS] = {{
{sensor}}};

static const pf_view {name}_view[] = {{
{view}}};

static const pf_model {name}_model = {{{upper}_AXES, {upper}_SENSORS, {name}_axis, {name}_sensor, {name}_view}};

#endif
"""


def header(config: FusionConfig, name: str, source: str) -> str:
    """The text of a header with the numbers that :class:`.LiveEstimator` gives to the filter."""
    axes, sensors, upper = tuple(config.arm.axes), tuple(config.sensors), name.upper()
    axis, sensor, view = live_model(config)
    return _HEADER.format(
        mark=MARK,
        version=version("pumafuse"),
        source=_comment(source),
        frame="" if (missing := omissions(config)) is None else f", in the axes of the arm: {missing} not in here",
        upper=upper,
        name=name,
        interface=VERSION,
        axes=", ".join(_identifiers(f"{upper}_AXIS", axes)),
        sensors=", ".join(_identifiers(f"{upper}_SENSOR", sensors)),
        axis=_structs(axis, axes),
        sensor=_structs(sensor, sensors),
        view=_structs(view.ravel(), (f"{sensor} on {axis}" for sensor in sensors for axis in axes)),
    )


def omissions(config: FusionConfig) -> str | None:
    """What of a configuration turns events into the arm's axes and is not in its header, with a verb; or None."""
    placed = [name for name, sensor in config.sensors.items() if sensor.is_placed]
    parts = ["its [frame]"] if config.frame is not None else []
    parts += ["the reference of its [tool]"] if config.tool is not None else []
    parts += ["the kinematics of its [robot]"] if config.robot is not None else []
    parts += [f"frame and marker of {', '.join(placed)}"] if placed else []
    return f"{'; '.join(parts)} {'is' if len(parts) == 1 and not placed else 'are'}" if parts else None


def identifier(text: str) -> str:
    """A text as a name in C, with underscores for what no name in C may have."""
    return re.sub(r"\W|^(?=\d)", "_", text, flags=re.ASCII)


def _identifiers(prefix: str, names: Iterable[str]) -> list[str]:
    """A constant of its own for each name."""
    identifiers: list[str] = []
    for name in names:
        constant = identifier(f"{prefix}_{name}").upper()
        while constant in identifiers:
            constant += "_"
        identifiers.append(constant)
    return identifiers


def _structs(records: Record, names: Iterable[str]) -> str:
    """Initialisers of an array of structs, a line for each number."""
    structs = ""
    for record, name in zip(records, names, strict=True):
        fields = zip(record.dtype.names or (), record.tolist(), strict=True)
        numbers = "".join(f"        .{field} = {_exact(number)}\n" for field, number in fields)
        structs += f"    {{ /* {_comment(name)} */\n{numbers}    }},\n"
    return structs


def _exact(number: float) -> str:
    """A double to the last bit: a compiler may round decimals as it likes, but no hexadecimal ones."""
    if number != number:
        return "NAN,"
    return f"{number:.1f}," if number.is_integer() and abs(number) < 2**53 else f"{number.hex()}, /* {number!r} */"


def _comment(text: str) -> str:
    return text.replace("*/", "* /").replace("/*", "/ *")

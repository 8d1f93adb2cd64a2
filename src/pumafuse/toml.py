"""Files as msgspec structs: a struct's field types are what is checked, its encoded names the accepted keys."""

from __future__ import annotations

import datetime
import errno
import os
import re
import select
import stat
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin

import msgspec
import tomli_w

from .errors import ConfigError, PumafuseError, suggestion
from .units import AN, KINDS, Kind, as_length, ending, from_si, in_unit, of_kind, to_si

MOST_TEXT = 16 << 20  # characters; what is longer, a device perhaps, is no configuration
_PATIENCE = 3.0  # s for somebody to open a pipe and write
# A key of so many parts takes tomllib seconds and gigabytes.
_DEEP = re.compile(r"^[ \t\[]*(?:[^\n.=,#\[\]{}]*\.){100}", re.MULTILINE)
_BOUND = re.compile(r"Expected `(?:float|int)` (>=|<=|>|<) (\S+)")
S = TypeVar("S", bound=msgspec.Struct)

MOST = 1e9  # in SI, of any number: what is larger is no size of an arm, and would overflow
Positive = Annotated[float, msgspec.Meta(gt=0, le=MOST)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=MOST)]
Time = Annotated[float, msgspec.Meta(ge=1e-6, le=MOST)]  # s, after which something is forgotten
Interval = tuple[float, float]  # lower and upper end


class Reported(msgspec.Struct, frozen=True, kw_only=True):
    """SI numbers that can also be had in the unit of a name: ``score.rmse_mm`` or ``score.rmse_deg`` of ``rmse``."""

    def __getattr__(self, name: str) -> Any:
        unit = ending(name) or ""
        if not unit or name.removesuffix(unit) not in self.__struct_fields__:
            raise AttributeError(f"{type(self).__name__} has no '{name}'")
        value = getattr(self, name.removesuffix(unit))
        return float(in_unit(value, unit)) if isinstance(value, float) else value


def read(path: Path) -> dict[str, Any]:
    """The tables of a TOML file with every number in SI."""
    return parsed(text_of(path), str(path))


def text_of(path: Path) -> str:
    """The text of a file that describes something, one character more than it may have at most."""
    try:
        with open(path, encoding="utf-8", opener=_opened) as file:
            return file.read(MOST_TEXT + 1)
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file in UTF-8") from None
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def _opened(path: str, flags: int) -> int:
    """Open a file; of a pipe, such as a shell's ``<(...)``, wait for what is written, but not for somebody to write."""
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if stat.S_ISFIFO(os.fstat(descriptor).st_mode):
        if not select.select([descriptor], [], [], _PATIENCE)[0]:
            with suppress(BlockingIOError):  # somebody has opened it and will write
                if not os.read(descriptor, 1):
                    os.close(descriptor)
                    raise OSError(errno.EPIPE, f"a pipe into which nobody writes, for {_PATIENCE:g} s")
        os.set_blocking(descriptor, True)
    return descriptor


def parsed(source: str | Mapping[str, Any], where: str) -> dict[str, Any]:
    """The tables of a TOML text, or of a dict that has what such a text would have, with every number in SI."""
    if not isinstance(source, str | Mapping):  # pyright: ignore  (who is not checked may give anything)
        raise ConfigError(f"{where}: expected a text or a dict, got {type(source).__name__}")
    try:
        if not isinstance(source, str):
            return to_si(_plain(source, ""))
        if len(source) > MOST_TEXT:
            raise ConfigError(f"more than {MOST_TEXT >> 20} MB: no configuration")
        if _DEEP.search(source):
            raise ConfigError("a key of more than 100 parts: no configuration")
        return to_si(tomllib.loads(source, parse_float=Decimal))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not valid TOML: {error}") from None
    except (ArithmeticError, ValueError, RecursionError):
        raise ConfigError(f"{where}: not valid TOML: a number is out of range, or it nests too deeply") from None
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _plain(value: Any, path: str) -> Any:
    """A value of a dict as TOML has it: numbers of numpy are numbers, tuples lists."""
    if getattr(value, "shape", None) == ():
        value = value.item()
    if isinstance(value, Mapping):
        tree, ahead = cast(Mapping[Any, Any], value), f"{path}." if path else ""
        for key in tree:
            if not isinstance(key, str):
                raise ConfigError(f"{path or 'the dict'}: a key is {key!r:.40}, not a text")
        return {str(key): _plain(value, f"{ahead}{key}") for key, value in tree.items()}
    if isinstance(value, list | tuple):
        return [_plain(value, path) for value in cast(Sequence[Any], value)]
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode()
    if isinstance(value, bool | int | float | Decimal | datetime.date | datetime.time):
        return value
    raise ConfigError(f"{path}: expected a number, a text, a list or a table, got {type(value).__name__}")


def struct(tree: Any, kind: type[S], where: str, path: str = "", axis: Kind = "length") -> S:
    """``tree`` (SI numbers) as a struct of ``kind``.

    Args:
        tree: The result of :func:`read`, or a table of it.
        kind: The struct that declares the accepted keys.
        where: The file, for errors.
        path: The table's path in the file, such as ``axes.x``.
        axis: What the axes are to which the table belongs: its keys have the units of that.

    Raises:
        ConfigError: An unknown key, a missing one, a wrong type or a value out of range; names file, key and the
            accepted names.
    """
    if axis != "length" and (problem := next(_problems(tree, kind, path, axis), None)):
        raise ConfigError(f"{where}: {problem}")
    try:
        return msgspec.convert(tree if axis == "length" else as_lengths(tree, kind), kind)
    except msgspec.ValidationError as error:
        problem = next(_problems(tree, kind, path, axis), f"{path}: {error}" if path else str(error))
        raise ConfigError(f"{where}: {problem}") from None
    except PumafuseError as error:  # a struct's own check
        raise ConfigError(f"{where}: {error}") from None


def check(value: Any, kind: Any, where: str, path: str) -> None:
    """Refuse a value (SI numbers) that is not of a type."""
    for problem in _problems(value, kind, path):
        raise ConfigError(f"{where}: {problem}")


def text(tree: Mapping[str, Any]) -> str:
    """SI tables as the text of a TOML file, in the units of their names."""
    return tomli_w.dumps(from_si(tree))


def builtins(value: msgspec.Struct, axis: Kind = "length") -> dict[str, Any]:
    """A struct as plain tables with the file's key names; None is left out, as TOML has none."""
    dates = (datetime.datetime, datetime.date, datetime.time)
    tree = msgspec.to_builtins(_of_kind(value, axis), builtin_types=dates, enc_hook=float)  # numpy's numbers are floats
    return _without_none(tree)


def reported(value: msgspec.Struct, axis: Kind = "length") -> dict[str, Any]:
    """A struct (SI numbers) as plain tables for JSON, in the units of the file's key names; None stays."""
    return from_si(msgspec.to_builtins(_of_kind(value, axis), enc_hook=float))


def json_text(tree: Any) -> str:
    """A tree of dictionaries, lists and structs as JSON to read."""
    return msgspec.json.format(msgspec.json.Encoder(decimal_format="number").encode(tree), indent=2).decode()


def as_lengths(tree: Any, kind: Any = None) -> Any:
    """Tables with the key names for lengths, which are those of structs; names of fields of ``kind`` stay."""
    if not isinstance(tree, Mapping):
        return tree
    names = {field.encode_name for field in msgspec.structs.fields(kind)} if isinstance(kind, type) else ()
    named = cast(Mapping[str, Any], tree).items()
    return {key if key in names else as_length(key): as_lengths(value, kind) for key, value in named}


def _without_none(tree: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _without_none(value) if isinstance(value, dict) else value  # pyright: ignore[reportUnknownArgumentType]
        for key, value in tree.items()
        if value is not None
    }


def _of_kind(value: Any, axis: Kind) -> Any:
    """A tree in which structs are tables with the keys of a kind of axis; the keys of a dict are names, and stay."""
    if axis == "length":
        return value
    if isinstance(value, msgspec.Struct):
        tag = value.__struct_config__
        fields = {} if tag.tag_field is None else {tag.tag_field: tag.tag}
        for field in msgspec.structs.fields(value):
            fields[of_kind(field.encode_name, axis)] = _of_kind(getattr(value, field.name), axis)
        return fields
    if isinstance(value, Mapping):
        return {key: _of_kind(item, axis) for key, item in cast(Mapping[str, Any], value).items()}
    if isinstance(value, list | tuple):
        return [_of_kind(item, axis) for item in cast(Sequence[Any], value)]
    return value


def _tagged(kind: Any) -> dict[str, type[msgspec.Struct]]:
    """The structs of a union by their tags."""
    return {str(part.__struct_config__.tag): part for part in _structs(kind) if part.__struct_config__.tag is not None}


def _structs(kind: Any) -> list[type[msgspec.Struct]]:
    """The structs of a union."""
    return [part for part in get_args(kind) if isinstance(part, type) and issubclass(part, msgspec.Struct)]


def _words(kind: Any) -> tuple[str, ...]:
    """The values that a Literal, alone or in a union, accepts."""
    return tuple(word for part in (kind, *get_args(kind)) if get_origin(part) is Literal for word in get_args(part))


def _problems(tree: Any, kind: Any, path: str, axis: Kind = "length") -> Iterator[str]:
    """The faults of ``tree``, the deepest first, each with its key."""
    prefix = f"{path}." if path else ""
    if isinstance(tree, Mapping) and type(None) in get_args(kind) and len(structs := _structs(kind)) == 1:
        kind = structs[0]  # of a table that may be absent
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and isinstance(tree, Mapping):
        fields = {of_kind(field.encode_name, axis): field for field in msgspec.structs.fields(kind)}
        of_others = {of_kind(field.encode_name, other): name for name, field in fields.items() for other in KINDS}
        tag = kind.__struct_config__.tag_field
        for key, value in tree.items():  # pyright: ignore[reportUnknownVariableType]
            if key in fields:
                yield from _problems(value, fields[key].type, f"{prefix}{key}", axis)
            elif key in of_others:
                yield f"{prefix}{key}: for {AN[axis]} it is '{of_others[key]}'"
            elif key != tag:
                yield f"unknown key '{prefix}{key}'; {suggestion(str(key), fields)}"  # pyright: ignore
        for key, field in fields.items():
            if field.required and key not in tree:
                yield f"'{prefix}{key}' is missing; accepted: {', '.join(fields)}"
    elif isinstance(tree, Mapping) and (tagged := _tagged(kind)):
        tag = next(iter(tagged.values())).__struct_config__.tag_field or ""
        name = str(tree.get(tag, "none"))  # pyright: ignore[reportUnknownArgumentType]
        if name in tagged:
            yield from _problems(tree, tagged[name], path, axis)
        else:
            yield f"{path}.{tag}: unknown {tag} '{name}'; {suggestion(name, tagged)}"
    elif isinstance(tree, str) and (words := _words(kind)) and tree not in words:
        yield f"{path}: unknown value '{tree}'; {suggestion(tree, words)}"
    elif get_origin(kind) is dict and isinstance(tree, Mapping):
        for key, value in tree.items():  # pyright: ignore[reportUnknownVariableType]
            yield from _problems(value, get_args(kind)[1], f"{prefix}{key}", axis)
    else:
        try:
            msgspec.convert(tree, cast(Any, kind))
        except msgspec.ValidationError as error:
            yield f"{path}: {_in_words(str(error).split(' - at ')[0], path)}"


def _in_words(problem: str, path: str) -> str:
    """What msgspec says of a value, a bound [SI] in the unit of its key."""
    bound = _BOUND.fullmatch(problem)
    if bound is None:
        return problem
    unit = next((unit for name in reversed(path.split(".")) if (unit := ending(name))), "")
    value = float(bound[2])
    return f"must be {bound[1]} {float(in_unit(value, unit)) if unit else value:g}"

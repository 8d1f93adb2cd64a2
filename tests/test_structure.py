"""The rooms of the package and which way they import."""

import ast
import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import pytest

import pumafuse as pf
from pumafuse.cli.screen import say, say_json

SOURCE = Path(pf.__file__).parent
# each imports itself and those before it
ROOMS = [
    "model",
    "space",
    "logs",
    "discovery",
    "filter",
    "fusion",
    "pieces",
    "simulation",
    "tuning",
    "registration",
    "identification",
    "live",
    "views",
    "cli",
]
GROUND = {"arrays", "errors", "units", "toml", "folders"}


def imported_rooms(path: Path) -> set[str]:
    """Rooms and ground-floor modules that a module imports, from its own relative imports and from strings."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and re.fullmatch(r"pumafuse\.[\w.]+", str(node.value)):
            found.add(node.value.split(".")[1])
        if isinstance(node, ast.ImportFrom) and node.level:
            parts = (node.module or "").split(".")
            if node.level == 2 or path.parent == SOURCE:
                found |= {parts[0]} if parts[0] else {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_imports_run_one_way(room: str) -> None:
    """No module imports a room that comes after its own."""
    allowed = GROUND | set(ROOMS[: ROOMS.index(room) + 1])
    for path in (SOURCE / room).glob("**/*.py"):
        assert imported_rooms(path) <= allowed, path


def test_every_room_is_known() -> None:
    """A new room must take its place in the order above."""
    assert {path.name for path in SOURCE.iterdir() if (path / "__init__.py").exists()} == set(ROOMS)


def test_names_say_the_thing() -> None:
    """Nothing is called by a word that says nothing of what it holds or does, but keys of files: `rest_s`."""
    silent = {"found", "one", "known", "given", "rest", "own", "place", "like", "aside", "mine", "there"}
    for path in SOURCE.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        keys = {
            id(line.target)
            for line in ast.walk(tree)
            if isinstance(line, ast.AnnAssign) and "name=" in ast.unparse(line.value or line.target)
        }
        for node in ast.walk(tree):
            match node:
                case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                    pass
                case ast.arg(arg=name) | ast.FunctionDef(name=name):
                    pass
                case _:
                    continue
            assert name.lstrip("_") not in silent or id(node) in keys, f"{path}, line {node.lineno}: {name}"


def test_one_verb_stands_for_one_action() -> None:
    """Of several verbs for one action functions have one, which CONTRIBUTING.md lists; these are the others."""
    others = {
        *("make", "create", "produce", "generate", "feed", "enter", "give", "hand", "insert", "deliver", "store"),
        *("fetch", "seek", "detect", "solve", "display", "tell", "post", "drain", "release", "remaining"),
        *("with", "put", "search"),
    }
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("__"):
                assert node.name.lstrip("_").split("_")[0] not in others, f"{path}, line {node.lineno}: {node.name}"


def test_no_room_hides_a_public_name() -> None:
    """A module that is imported becomes an attribute of the package: none is called what a function or class is."""
    assert {path.stem for path in SOURCE.iterdir()}.isdisjoint(pf.__all__)


def test_the_ground_floor_imports_no_room() -> None:
    """What every room stands on stands on nothing but itself."""
    for name in GROUND:
        assert imported_rooms(SOURCE / f"{name}.py") <= GROUND


def test_public_names_exist_and_are_lazy() -> None:
    """Every public name resolves, and importing pumafuse alone imports no numpy."""
    import subprocess
    import sys

    for name in pf.__all__:
        assert getattr(pf, name) is not None
    code = "import sys, pumafuse; sys.exit(bool({'numpy', 'pyarrow', 'msgspec'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = pf.nothing


def test_every_public_name_is_documented() -> None:
    """Each has its place on the page of the API."""
    page = (SOURCE.parents[1] / "docs" / "api.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^::: pumafuse\.(\w+)$", page, re.MULTILINE)) == sorted(pf.__all__)


def test_what_public_functions_take_and_return_is_public() -> None:
    """Also methods and properties of public classes: nobody needs a private import to say what a variable is."""
    foreign = SimpleNamespace(Table=object, StateSpace=object, TransferFunction=object)  # imported where they are used
    known = {"pa": foreign, "control": foreign, "Figure": object, "KalmanFilter": object, "Recording": object}
    public = {getattr(pf, name) for name in pf.__all__}
    found: dict[str, set[type]] = {}
    for name in pf.__all__:
        one = getattr(pf, name)
        members = inspect.getmembers_static(one) if inspect.isclass(one) else [("", one)]
        for member, value in members:
            function = getattr(value, "fget", getattr(value, "__func__", value))
            if inspect.isfunction(function) and (member == "__init__" or not member.startswith("_")):
                hints = get_type_hints(function, localns=known)
                found[f"{name}.{member}"] = {part for hint in hints.values() for part in classes_of(hint)}
    assert len(found) > 100
    own = {key: {part for part in parts if part.__module__.startswith("pumafuse")} for key, parts in found.items()}
    assert {key: parts - public for key, parts in own.items() if parts - public} == {}


def classes_of(hint: Any) -> Iterator[type]:
    """The classes that a type hint is made of."""
    if inspect.isclass(hint):
        yield hint
    for part in get_args(hint):
        yield from classes_of(part)


def test_one_place_writes_text_to_the_terminal() -> None:
    """Tables and lines of progress are rich's, which shows no control characters; all else is said by ``say``."""
    called = {
        path.relative_to(SOURCE).as_posix()
        for path in SOURCE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {"print", "typer.echo", "click.echo", "typer.secho"}
    }
    assert called == {"cli/screen.py"}


def test_what_a_terminal_would_obey_is_not_said(capsys: pytest.CaptureFixture[str]) -> None:
    """Escapes, a bell, an end of a page, marks of direction; JSON stays JSON, of the same text."""
    text = "a\x1b[31m\x9b0m\x07\x0c\u202eb\n肩 ± ζ"
    say(text)
    assert capsys.readouterr().out == "a?[31m?0m???b\n肩 ± ζ\n"
    say_json({"name": text})
    out = capsys.readouterr().out
    assert json.loads(out) == {"name": text}
    assert all(one.isprintable() or one == "\n" for one in out)

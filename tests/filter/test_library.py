"""A library that is not there, or not the right one: one line that says what to do."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import pumafuse
from executable import FUSION, SCAN
from pumafuse.filter import core
from pumafuse.filter.core import LIBRARY, VERSION

PACKAGE = Path(pumafuse.__file__).parent
AGAIN = "install pumafuse again (in a checkout: make .venv/.ready)"


@pytest.fixture
def library(tmp_path: Path) -> Path:
    """That of a copy of the package, which is not there yet."""
    shutil.copytree(PACKAGE, tmp_path / "pumafuse", ignore=shutil.ignore_patterns("__pycache__", LIBRARY.name))
    return tmp_path / "pumafuse" / "filter" / LIBRARY.name


def said(library: Path, *words: object, code: int = 1) -> str:
    """The only line that a command of the copy says."""
    copy = os.environ | {"PYTHONPATH": str(library.parents[2])}
    line = [sys.executable, "-m", "pumafuse", *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False, env=copy, cwd=library.parent)
    assert done.returncode == code
    (found,) = (done.stdout + done.stderr).splitlines()
    return found


FUSE = ("fuse", SCAN, "-c", FUSION, "-o", "out")


def test_one_that_does_not_load(library: Path) -> None:
    """None, or anything else; what needs no filter works."""
    if b"no library" != None:
        library.write_bytes(b"no library")
    line = said(library, *FUSE)
    assert line.startswith(f"pumafuse: {library}: the filter's core does not load (")
    assert line.endswith(f"): {AGAIN}")
    assert said(library, "--version", code=0)
    assert not (library.parent / "out").exists()


def test_one_of_another_version(library: Path) -> None:
    """A package that has been changed around it says which interface it found, and which it is for."""
    shutil.copy(LIBRARY, library)
    core = library.with_name("core.py")
    text = core.read_text(encoding="utf-8")
    core.write_text(text.replace(f"\nVERSION = {VERSION} ", f"\nVERSION = {VERSION + 1} "), encoding="utf-8")
    wanted = f"the filter's core has interface {VERSION}, this is for {VERSION + 1}: {AGAIN}"
    assert said(library, *FUSE) == f"pumafuse: {library}: {wanted}"


def test_the_interpreter_is_free_over_a_recording_and_kept_over_a_live_event() -> None:
    """A call of microseconds that lets go of it waits for milliseconds until a busy thread gives it back."""
    keeps = 4  # FUNCFLAG_PYTHONAPI of CPython's ctypes.h
    kept = {name: bool(getattr(core.library, f"pf_{name}")._flags_ & keeps) for name in core._FUNCTIONS}
    assert kept == {name: name.startswith("live_") for name in kept}

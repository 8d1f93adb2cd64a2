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


TESTS = Path(__file__).parents[1]
CORE = TESTS.parent / "core"
SANITIZERS = ("address,undefined,float-cast-overflow", "address,undefined")  # the first of them that there are
FLAGS = (  # what only one branch needs is computed where it is written, or a fault in it would not be seen
    *("-std=c++20", "-O1", "-fno-tree-sink", "-g", "-ffp-contract=off"),
    *("-fno-sanitize-recover=all", "-D_GLIBCXX_ASSERTIONS"),
)
RUN = (
    *("filter", "fusion/test_gates.py", "fusion/test_innovations.py", "fusion/test_extremes.py", "live/test_clock.py"),
    "fusion/test_oracle.py::test_smoothing_does_not_reach_across_a_clock_that_was_set_back",
    "fusion/test_oracle.py::test_any_gated_run_is_fused_like_the_conditional_gaussian",
    "live/test_window.py::test_any_order_of_arrival_gives_the_same_window",
    "live/test_window.py::test_the_first_room_serves_for_ever",
    *(f"pieces/test_pieces.py::test_pieces_are_the_whole[{one}]" for one in ("True-how0", "False-how1")),
    "--ignore=filter/test_transitions.py",  # the same lines, thousands of times
    "--ignore=filter/test_library.py",  # other libraries, in processes of their own
)


def sanitized(library: Path) -> dict[str, str]:
    """Make a core that stops at the first fault; returns what Python needs to know to load it."""
    why = "there is no g++ or clang++"
    for compiler in filter(None, map(shutil.which, ("g++", "clang++"))):
        clang = "clang" in Path(compiler).name
        for sanitizers in SANITIZERS:
            words = [compiler, *FLAGS, f"-fsanitize={sanitizers}", *(["-shared-libasan"] if clang else [])]
            words += ["-shared", "-fPIC", f"-I{CORE / 'include'}", *map(str, CORE.glob("*.cpp")), "-o", str(library)]
            made = subprocess.run(words, capture_output=True, text=True, check=False)
            if made.returncode:
                why = made.stderr.strip().splitlines()[-1]
                continue
            # Before Python, which is of C alone; with that of C++, or what a core throws would not be known.
            names = (f"libclang_rt.asan-{os.uname().machine}.so" if clang else "libasan.so", "libstdc++.so")
            ask = [[compiler, f"-print-file-name={name}"] for name in names]
            found = [subprocess.run(one, capture_output=True, text=True, check=True).stdout.strip() for one in ask]
            stops = {"ASAN_OPTIONS": "detect_leaks=0", "UBSAN_OPTIONS": "print_stacktrace=1", "PYTHONMALLOC": "malloc"}
            return {"LD_PRELOAD": " ".join(found), **stops}
    pytest.skip(f"the core cannot be made with sanitizers: {why}")


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD is of Linux")
def test_the_core_does_nothing_that_is_not_defined(tmp_path: Path) -> None:
    """Tests of filter, gates, extremes, windows and pieces, with a core that ends the process at the first fault."""
    shutil.copytree(Path(pumafuse.__file__).parent, tmp_path / "pumafuse")
    library = tmp_path / "pumafuse" / "filter" / LIBRARY.name
    library.unlink()
    environment = os.environ | sanitized(library) | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{TESTS}"}
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-m", "not long", "--capture=sys", *RUN]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment, cwd=TESTS, timeout=1200)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[:3000]
    assert " passed" in done.stdout

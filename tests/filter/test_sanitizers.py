"""The core under the compiler's sanitizers: no access outside of memory, and no arithmetic that C++ does not define."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import pumafuse
from pumafuse.filter.core import LIBRARY

TESTS = Path(__file__).parents[1]
CORE = TESTS.parent / "core"
SANITIZERS = ("address,undefined,float-cast-overflow", "address,undefined")  # the first of them that there are
FLAGS = (  # what only one branch needs is computed where it is written, or a fault in it would not be seen
    *("-std=c++20", "-O1", "-fno-tree-sink", "-g", "-ffp-contract=off"),
    *("-fno-sanitize-recover=all", "-D_GLIBCXX_ASSERTIONS"),
)
RUN = (
    *("filter", "fusion/test_gates.py", "fusion/test_innovations.py", "fusion/test_smoother.py"),
    *("fusion/test_extremes.py", "live/test_clock.py"),
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

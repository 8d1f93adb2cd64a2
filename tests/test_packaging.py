"""Wheel and sdist, each in an environment that holds nothing else."""

import os
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import distribution, requires, version
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = pytest.mark.xdist_group("packaging")  # built once
ROOT = Path(__file__).parent.parent
BUILDS_NOTHING = """
import os, backend
print(*backend.get_requires_for_build_wheel())
backend.build.build_wheel = lambda *_: print(os.environ["CXX"])
backend.build_wheel("nowhere")
"""


def run(*words: object, **environment: str) -> str:
    """What a command writes to its output, in the folder of the project."""
    there = {name: value for name, value in os.environ.items() if name != "CXX"} | environment
    words = tuple(map(str, words))
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False, cwd=ROOT, env=there)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def what_it_asks_for(name: str) -> set[str]:
    """The distributions that one asks for here, and all that those ask for."""
    found, left = set[str](), [name]
    while left:
        asked = map(Requirement, requires(left.pop()) or ())
        needed = (one.name for one in asked if one.marker is None or one.marker.evaluate({"extra": ""}))
        new = set(map(canonicalize_name, needed)) - found
        found |= new
        left += new
    return found


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--sdist", "--wheel", "--outdir", folder)
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


def test_the_citation_is_of_this_version() -> None:
    """That of pyproject.toml, which is the only other place that says it."""
    project, citation = ((ROOT / name).read_text() for name in ("pyproject.toml", "CITATION.cff"))
    assert f"\nversion: {tomllib.loads(project)['project']['version']}\n" in citation


@pytest.mark.long
def test_the_wheel_works_in_an_empty_environment(built: tuple[Path, Path], tmp_path: Path) -> None:
    """Installed with nothing but what it asks for, at the locked versions: version, demo and completion work.

    What it asks for is linked from this environment; pip finds nothing missing and nothing at a wrong version. The
    demo's accuracy is, digit by digit, that of this checkout. One wheel is for every Python.
    """
    assert built[0].name.startswith(f"pumafuse-{version('pumafuse')}-py3-none-") and "any" not in built[0].name
    venv.create(tmp_path / "empty", symlinks=True)
    place = tmp_path / "empty" / "bin"
    site = next((tmp_path / "empty").glob("lib/*/site-packages"))
    for asked in map(distribution, what_it_asks_for("pumafuse")):
        for top in {path.parts[0] for path in asked.files or ()} - {"..", "__pycache__"}:
            (site / top).symlink_to(asked.locate_file(top))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", place / "python"]
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", built[0])
    assert run(*pip, "check") == "No broken requirements found.\n"
    assert run(place / "pumafuse", "--version") == f"pumafuse {version('pumafuse')}\n"
    here = run(sys.executable, "-m", "pumafuse", "demo", "--output", tmp_path / "here")
    there = run(place / "pumafuse", "demo", "--output", tmp_path / "demo")
    accuracy = [line for line in here.splitlines() if line.split()[:1] == ["scan1"]]
    assert len(accuracy) == 3
    assert accuracy == [line for line in there.splitlines() if line.split()[:1] == ["scan1"]]
    assert {"fused.png", "fused.rrd", "summary.json"} <= {path.name for path in (tmp_path / "demo").iterdir()}
    in_a_shell = f"'{place / 'pumafuse'}' --show-completion; true"  # it looks for the shell that it was started by
    assert "_PUMAFUSE_COMPLETE" in run("bash", "-c", in_a_shell)


@pytest.mark.long
def test_the_sdist_makes_the_same_wheel(built: tuple[Path, Path], tmp_path: Path) -> None:
    """What pip builds from the sdist, in another folder, is file by file the wheel: also the library, bit by bit."""
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    run(*pip, "--wheel-dir", tmp_path, built[1])
    made, direct = (zipfile.ZipFile(wheel) for wheel in (next(tmp_path.glob("*.whl")), built[0]))
    assert {name: made.read(name) for name in made.namelist()} == {
        name: direct.read(name) for name in direct.namelist()
    }


@pytest.mark.long
def test_what_is_in_them(built: tuple[Path, Path]) -> None:
    """The wheel holds the package, typed, with its data and nothing else; the sdist all that tests and docs need."""
    wheel = set(zipfile.ZipFile(built[0]).namelist())
    sources = {str(path.relative_to(ROOT / "src")) for path in (ROOT / "src").rglob("*") if path.is_file()}
    sources = {name for name in sources if "__pycache__" not in name and ".egg-info" not in name}
    assert {name for name in wheel if ".dist-info" not in name} == sources
    assert {"pumafuse/py.typed", "pumafuse/data/fusion.toml", "pumafuse/data/scan1/run.toml"} <= wheel
    with tarfile.open(built[1]) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {"Makefile", "requirements.lock", "mkdocs.yml", "docs/model.md", "tests/pages.py"} <= inside
    assert {"CMakeLists.txt", "core/backend.py", "core/pumafuse.cpp", "core/include/pumafuse.h"} <= inside
    assert len([name for name in wheel if name.startswith("pumafuse/filter/_core.")]) == 1
    assert not [name for name in inside if name.startswith((".venv", "build/", "demo/", "site/")) or "/_core." in name]


@pytest.mark.long
def test_without_a_compiler_it_is_built_by_zigs(tmp_path: Path) -> None:
    """With no compiler on the path pip is asked for zig's, and says in one line that it is taken; else it is not.

    Where make has installed it, as it does on a machine without one, the wheel is built by it, for any machine of this
    kind and without the names of folders.
    """
    assert "ziglang" not in run(sys.executable, "-c", BUILDS_NOTHING, CXX="c++", PYTHONPATH="core")
    bare = {"PATH": str(tmp_path), "PYTHONPATH": "core"}
    asked, said, compiler = run(sys.executable, "-c", BUILDS_NOTHING, **bare).splitlines()
    assert {"ninja", "ziglang"} <= set(asked.split())
    assert said.startswith("There is no C++ compiler: zig's is taken, from the ziglang wheel")
    assert compiler.endswith(" -m ziglang c++ -mcpu=baseline")
    if find_spec("ziglang"):
        told = run(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", tmp_path, **bare)
        assert said in told.splitlines()
        with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
            (library,) = (name for name in wheel.namelist() if "/_core." in name)
            assert str(ROOT).encode() not in wheel.read(library)

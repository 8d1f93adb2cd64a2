"""Wheel and sdist, each in an environment that holds nothing else."""

import subprocess
import sys
import tarfile
import venv
import zipfile
from importlib.metadata import distribution, requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
EVERY_KERNEL = """
import pumafuse as pf
from importlib.resources import files
data = files("pumafuse") / "data" / "scan"
run, config = pf.Run.read(data), pf.FusionConfig.load(data / "fusion.toml")
for mode in ("filtered", "as-live", "smoothed"):
    pf.summarise(pf.fuse(run, config, mode=mode))
pf.LiveEstimator(config).warm_up()
"""


def run(*words: object) -> tuple[str, str]:
    """What a command writes to its output and to its errors."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


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
    """The wheel and the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", str(folder)], cwd=ROOT, check=True)
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


@pytest.mark.long
def test_the_wheel_works_in_an_empty_environment(built: tuple[Path, Path], tmp_path: Path) -> None:
    """Installed with nothing but what it asks for, at the locked versions: version, demo and completion work.

    What it asks for is linked from this environment; pip finds nothing missing and nothing at a wrong version. The
    demo's accuracy is, digit by digit, that of this checkout. It compiles, and says so, for all that comes after.
    """
    venv.create(tmp_path / "empty", symlinks=True)
    place = tmp_path / "empty" / "bin"
    site = next((tmp_path / "empty").glob("lib/*/site-packages"))
    for asked in map(distribution, what_it_asks_for("pumafuse")):
        for top in {path.parts[0] for path in asked.files or ()} - {"..", "__pycache__"}:
            (site / top).symlink_to(asked.locate_file(top))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", place / "python"]
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", built[0])
    assert run(*pip, "check")[0] == "No broken requirements found.\n"
    assert run(place / "pumafuse", "--version")[0] == f"pumafuse {version('pumafuse')}\n"
    here, _ = run(sys.executable, "-m", "pumafuse", "demo", "--output", tmp_path / "here")
    there, said = run(place / "pumafuse", "demo", "--output", tmp_path / "demo")
    accuracy = [line for line in here.splitlines() if line.split()[:1] == ["scan1"]]
    assert len(accuracy) == 3
    assert accuracy == [line for line in there.splitlines() if line.split()[:1] == ["scan1"]]
    assert {"fused.png", "fused.rrd", "summary.json"} <= {path.name for path in (tmp_path / "demo").iterdir()}
    assert said.splitlines()[0] == "compiling the filter for this machine, once (some 15 s) ..."
    assert run(place / "python", "-c", EVERY_KERNEL) == ("", "")
    source = (path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    kernels = sum(text.count("\n@kernel\n") for text in source)
    assert len(list((tmp_path / "empty").glob("lib/*/site-packages/pumafuse/**/*.nbi"))) == kernels > 10
    in_a_shell = f"'{place / 'pumafuse'}' --show-completion; true"  # it looks for the shell that it was started by
    assert "_PUMAFUSE_COMPLETE" in run("bash", "-c", in_a_shell)[0]


@pytest.mark.long
def test_the_sdist_makes_the_same_wheel(built: tuple[Path, Path], tmp_path: Path) -> None:
    """What pip builds from the sdist is, file by file, the wheel."""
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, built[1])
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
    assert not [name for name in inside if name.startswith((".venv", "demo/", "site/"))]

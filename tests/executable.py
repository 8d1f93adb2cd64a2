"""The real executable, as the tests of every command run it."""

from __future__ import annotations

import subprocess
import sys
from importlib.resources import files
from pathlib import Path

EXECUTABLE = Path(sys.executable).parent / "pumafuse"
DATA = Path(str(files("pumafuse") / "data"))
SCAN, FUSION = DATA / "scan1", DATA / "fusion.toml"


def pumafuse(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command line; its exit code must be ``code`` and it must never show a traceback."""
    words = [str(EXECUTABLE), *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def refused(*arguments: object) -> str:
    """The one line that a refusal prints, beside warnings; nothing on stdout."""
    done = pumafuse(*arguments, code=1)
    assert done.stdout == ""
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    return line


def names(folder: Path) -> set[str]:
    """What is in a folder."""
    return {path.name for path in folder.iterdir()}

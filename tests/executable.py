"""The real executable, as the tests of every command run it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

EXECUTABLE = Path(sys.executable).parent / "pumafuse"


def pumafuse(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command line; its exit code must be ``code`` and it must never show a traceback."""
    words = [str(EXECUTABLE), *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done

"""The real executable, as the tests of every command run it."""

from __future__ import annotations

import io
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from importlib.resources import files
from pathlib import Path
from unittest import mock

import pytest

from pumafuse.cli.main import main

EXECUTABLE = Path(sys.executable).parent / "pumafuse"
DATA = Path(str(files("pumafuse") / "data"))
SCAN, FUSION = DATA / "scan1", DATA / "fusion.toml"


def pumafuse(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command line; its exit code must be ``code`` and it must never show a traceback.

    What is to be refused is refused in this process, which saves the start of another one.
    """
    words = [str(EXECUTABLE), *map(str, arguments)]
    if code in (1, 2, 70):
        done = _here(words)
    else:
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def _here(words: list[str]) -> subprocess.CompletedProcess[str]:
    out, err = io.StringIO(), io.StringIO()
    with (
        warnings.catch_warnings(),
        mock.patch.object(sys, "argv", words),
        redirect_stdout(out),
        redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return subprocess.CompletedProcess(words, int(ended.value.code or 0), out.getvalue(), err.getvalue())


def printed(*arguments: object) -> str:
    """What a command that succeeds prints, run in this process, which saves the start of another one."""
    done = _here([str(EXECUTABLE), *map(str, arguments)])
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(*arguments: object) -> str:
    """The one line that a refusal prints, beside warnings; nothing on stdout."""
    done = pumafuse(*arguments, code=1)
    assert done.stdout == ""
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    return line


def names(folder: Path) -> set[str]:
    """What is in a folder."""
    return {path.name for path in folder.iterdir()}

"""The command line, as the tests of every command run it."""

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

    It is run in this process, with the warnings of a new one: to start another one takes longer than most commands.
    """
    words = [str(EXECUTABLE), *map(str, arguments)]
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    with (
        warnings.catch_warnings(),
        mock.patch.object(sys, "argv", words),
        redirect_stdout(out),
        redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        warnings.onceregistry.clear()
        warnings.resetwarnings()
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)
        main()
    texts = (stream.buffer.getvalue().decode() for stream in (out, err))
    done = subprocess.CompletedProcess(words, int(ended.value.code or 0), *texts)
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
    return {path.name for path in folder.iterdir()}

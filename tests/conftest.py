"""What tests need before any of them runs."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import pumafuse

SOURCE = Path(pumafuse.__file__).parent


def pytest_configure(config: pytest.Config) -> None:
    """Make signals heard and the kernels new.

    Who starts the tests in the background, or with nohup, may have made them and all that they start deaf to signals.
    numba does not notice that a kernel which another file calls has changed: what it keeps on disk is removed if it is
    older than any of its sources. Workers would each compile all of them anew, so that is done before. Each worker has
    a core to itself: threads of several would wait for one another.
    """
    if hasattr(config, "workerinput"):
        os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    kernels = (path for path in SOURCE.rglob("*.py") if "compiled import" in path.read_text(encoding="utf-8"))
    newest = max(path.stat().st_mtime for path in (SOURCE / "compiled.py", *kernels))
    for kept in SOURCE.rglob("*.nb[ic]"):
        if kept.stat().st_mtime < newest:
            kept.unlink(missing_ok=True)
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        first_use = [sys.executable, "-m", "pumafuse.live.first_use"]
        alone = os.environ | {"PUMAFUSE_COMPILES_BESIDE": "1"}
        if any(
            half.wait() for half in [subprocess.Popen([*first_use, part], env=alone) for part in ("forward", "rest")]
        ):
            raise pytest.UsageError("the kernels cannot be compiled")


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads and worker processes, where a worker of the tests has none."""
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "2")

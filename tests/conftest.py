"""numba keeps compiled kernels on disk and does not notice that a kernel which another file calls has changed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import pumafuse

SOURCE = Path(pumafuse.__file__).parent


def pytest_configure(config: pytest.Config) -> None:
    """Remove compiled kernels that are older than any of their sources; workers would each compile all of them anew."""
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

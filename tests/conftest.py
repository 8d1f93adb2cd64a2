"""numba keeps compiled kernels on disk and does not notice that a kernel which another file calls has changed."""

import subprocess
import sys
from pathlib import Path

import pytest

import pumafuse

SOURCE = Path(pumafuse.__file__).parent
READ = f"""
import warnings, numpy as np, pumafuse as pf
warnings.simplefilter("ignore")
data = {str(SOURCE / "data")!r}
run, config = pf.Run.read(data + "/scan1"), pf.FusionConfig.load(data + "/fusion.toml")
"""
RECORDED = """
for how in ({}, {"mode": "as-live"}, {"mode": "smoothed"}):
    pf.fuse(run, config, **how)
"""
STREAM = """
pf.LiveEstimator(config).warm_up()
"""


def pytest_configure(config: pytest.Config) -> None:
    """Remove compiled kernels that are older than any of their sources; workers would each compile all of them anew."""
    kernels = (path for path in SOURCE.rglob("*.py") if "compiled import" in path.read_text(encoding="utf-8"))
    newest = max(path.stat().st_mtime for path in (SOURCE / "compiled.py", *kernels))
    for kept in SOURCE.rglob("*.nb[ic]"):
        if kept.stat().st_mtime < newest:
            kept.unlink(missing_ok=True)
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        halves = [subprocess.Popen([sys.executable, "-c", READ + kernels]) for kernels in (RECORDED, STREAM)]
        if any(half.wait() for half in halves):
            raise pytest.UsageError("the kernels cannot be compiled")

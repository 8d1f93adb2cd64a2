"""What compiling tells the user."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import pumafuse as pf

CODE = """
import numpy as np
from pumafuse.model.arm import AxisModel
from pumafuse.model.plants import FirstOrder
from pumafuse.model.response import response
axis, stamps = AxisModel(plant=FirstOrder(time_constant=0.02)), np.arange(3) * 28_000_000
print(response(axis, 0.028, 0.0, stamps, np.ones(3), 0.0, stamps))
"""


ALL = """
import pumafuse as pf
from importlib.resources import files
data = files("pumafuse") / "data" / "scan"
run, config = pf.Run.read(data), pf.FusionConfig.load(data / "fusion.toml")
for mode in ("filtered", "as-live", "smoothed"):
    pf.summarise(pf.fuse(run, config, mode=mode))
pf.LiveEstimator(config).warm_up()
"""


@pytest.mark.long
def test_compiling_is_said_once_on_a_machine(tmp_path: Path) -> None:
    """By what needs one kernel first; then all that needs the others is silent. The result is the same."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, again, others = (
        subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=300
        )
        for code in (CODE, CODE, ALL)
    )
    assert first.stderr.splitlines() == ["compiling the filter for this machine, once (some 15 s) ..."]
    assert again.stderr == others.stderr == ""
    assert first.stdout == again.stdout
    source = Path(pf.__file__).parent.rglob("*.py")
    kernels = sum(path.read_text(encoding="utf-8").count("\n@kernel\n") for path in source)
    assert len(list(tmp_path.rglob("*.nbi"))) == kernels > 10


@pytest.mark.long
def test_without_a_place_on_disk_it_compiles_all_the_same() -> None:
    """A service without a home on files that it may not write: a word on what to do, and the result."""
    nowhere = "from numba.core.caching import CacheImpl\nCacheImpl._locator_classes = []\n"
    found, usual = (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=200)
        for code in (nowhere + CODE, CODE)
    )
    assert "set NUMBA_CACHE_DIR to a folder" in found.stderr
    assert found.stdout == usual.stdout

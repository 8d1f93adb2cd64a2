"""What compiling tells the user."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import numpy as np
from pumafuse.model.arm import AxisModel
from pumafuse.model.plants import FirstOrder
from pumafuse.model.response import response
axis, stamps = AxisModel(plant=FirstOrder(time_constant=0.02)), np.arange(3) * 28_000_000
print(response(axis, 0.028, 0.0, stamps, np.ones(3), 0.0, stamps))
"""


@pytest.mark.long
def test_the_first_use_says_once_that_it_compiles_and_the_next_loads(tmp_path: Path) -> None:
    """On stderr, when nothing is on disk yet; the second process finds it there, is silent, and has the same result."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    words = [sys.executable, "-c", CODE]
    first, second = (
        subprocess.run(words, env=environment, capture_output=True, text=True, check=True, timeout=200)
        for _ in range(2)
    )
    assert first.stderr.splitlines() == [
        "compiling the filter for this machine, once for each part of it (some 10 s) ..."
    ]
    assert second.stderr == ""
    assert first.stdout == second.stdout


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

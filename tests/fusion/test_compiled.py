"""What compiling tells the user."""

from __future__ import annotations

import subprocess
import sys

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
def test_without_a_place_on_disk_it_compiles_all_the_same() -> None:
    """A service without a home on files that it may not write: a word on what to do, and the result."""
    nowhere = "from numba.core.caching import CacheImpl\nCacheImpl._locator_classes = []\n"
    found, usual = (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=200)
        for code in (nowhere + CODE, CODE)
    )
    assert "set NUMBA_CACHE_DIR to a folder" in found.stderr
    assert found.stdout == usual.stdout

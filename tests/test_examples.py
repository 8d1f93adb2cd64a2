"""The senders to copy, as they stand: what they send is fused."""

import itertools
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from listening import LONGEST, live

EXAMPLES = Path(__file__).parent.parent / "examples"
SECONDS = "1.5"


@pytest.mark.long
@pytest.mark.parametrize("language", ["python", "c"])
def test_commands_and_measurements_are_fused(tmp_path: Path, language: str) -> None:
    """A second and a half of both loops at their own pace: every datagram is taken, the measurements are fused."""
    if language == "c":
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("there is no C compiler")
        for name in ("commands", "readings"):
            flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-o", str(tmp_path / name)]
            subprocess.run([compiler, *flags, str(EXAMPLES / f"{name}.c"), "-lm"], check=True)
    with live("udp://127.0.0.1:0", EXAMPLES / "fusion.toml") as process:
        where = ["127.0.0.1", str(process.port()), SECONDS]
        words = [
            [str(tmp_path / name), *where]
            if language == "c"
            else [sys.executable, str(EXAMPLES / f"{name}.py"), *where]
            for name in ("commands", "readings")
        ]
        senders = [subprocess.Popen(one) for one in words]
        assert [sender.wait(LONGEST) for sender in senders] == [0, 0]
        estimates = [json.loads(line) for line in process.received(54)]
        report = process.end()
    assert "commands: 54 fused; 54 estimates" in report
    assert "0 lost" in report
    assert "0 of them bad" in report
    periods = [after["t_ns"] - before["t_ns"] for before, after in itertools.pairwise(estimates)]
    assert sum(periods) / len(periods) == pytest.approx(28e6, rel=0.05)
    for found in estimates[36:]:  # the tracker measures what was 8 ms before its stamp
        seen = 560.0 + 20.0 * math.sin(0.2 * math.pi * (found["t_ns"] / 1e9 - 0.1 + 0.008))
        assert found["x"]["position_mm"] == pytest.approx(seen, abs=0.5)
        assert "stale" not in found

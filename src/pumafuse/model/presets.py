"""Arms by name: ``arm.toml`` files beside this one. The PUMA 560 is the paper's Table II, "The Combined Model"."""

from __future__ import annotations

from pathlib import Path

PRESETS = {name: Path(__file__).with_name(f"{name}.toml") for name in ("puma560-internal", "puma560-external")}

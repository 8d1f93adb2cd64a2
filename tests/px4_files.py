"""Logs of PX4 for tests."""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np


def write_ulg(file: Path, topics: Mapping[str, tuple[str, np.ndarray, np.ndarray]]) -> Path:
    """A log, by its format: a message of definitions for each topic, then rows.

    Args:
        file: Where it goes.
        topics: By name their fields of floats, as ``float x;float[2] q``, when rows were made [s], (n,), and what they
            hold, (n, k).
    """

    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    parts += [message("F", f"{name}:uint64_t timestamp;{fields};".encode()) for name, (fields, *_) in topics.items()]
    parts += [message("A", struct.pack("<BH", 0, n) + name.encode()) for n, name in enumerate(topics)]
    for n, (_, time, values) in enumerate(topics.values()):
        layout = f"<HQ{values.shape[1]}f"
        rows = zip(time.tolist(), values.tolist(), strict=True)
        parts += [message("D", struct.pack(layout, n, 5_000_000 + round(t * 1e6), *at)) for t, at in rows]
    file.write_bytes(b"".join(parts))
    return file

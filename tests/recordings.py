"""What is in a recording of Rerun."""

import contextlib
import warnings
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader


def columns(path: Path, entity: str, *, static: bool = False) -> list[dict[str, object]]:
    """The columns of one entity, chunk by chunk, as far as they have arrived in a file that is still being written."""
    found = []
    with contextlib.suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for chunk in RrdReader(str(path)).stream():
            if chunk.entity_path == entity and chunk.is_static == static:
                batch = chunk.to_record_batch()
                found.append(dict(zip(batch.schema.names, batch.columns, strict=True)))
    return found


def times(chunks: list[dict[str, object]]) -> np.ndarray:
    """When the values of chunks are for [s]."""
    moments = [chunk["time"].to_numpy(zero_copy_only=False).astype("m8[ns]") for chunk in chunks]
    return np.concatenate([np.empty(0), *(one / np.timedelta64(1, "s") for one in moments)])


def series(path: Path, entity: str, of: str = "values") -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and values of one entity; of one that has a variance, these or its ``variances``."""
    found = columns(path, entity)
    names = [f"Measurements:{of}" if f"Measurements:{of}" in one else "Scalars:scalars" for one in found]
    every = (one[name].flatten().to_numpy() for one, name in zip(found, names, strict=True))
    return times(found), np.concatenate([np.empty(0), *every])

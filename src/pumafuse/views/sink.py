"""Where the entities of a Rerun recording go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import rerun as rr

from ..arrays import FloatArray
from ..units import MM
from . import styles


@dataclass(frozen=True)
class Sink:
    """Where entities go.

    Attributes:
        stream: The recording.
        times: The timelines of seconds since the first command, (n,).
        root: What their paths begin with.
        scale: How many units of the scene a metre is.
    """

    stream: rr.RecordingStream
    times: Callable[[FloatArray], list[rr.TimeColumn]] = styles.timeline
    root: str = ""
    scale: float = MM

    def log(self, path: str, style: rr.AsComponents) -> None:
        """Send what holds at all times."""
        rr.log(f"{self.root}{path}", style, static=True, recording=self.stream)

    def columns(self, path: str, time: FloatArray, columns: rr.ComponentColumnList) -> None:
        """Send what is for times [s since the first command], (n,)."""
        rr.send_columns(f"{self.root}{path}", self.times(time), columns, recording=self.stream)

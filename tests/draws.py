"""Random numbers of which all but one are 0: what each does to what is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np


class OneDraw:
    """A generator, and all that spawn from it, whose every number is 0 but for one, which is 1."""

    def __init__(self, chosen: int) -> None:
        self.left = chosen

    def spawn(self, count: int) -> list[OneDraw]:
        return [self] * count

    def standard_normal(self, size: Any = None) -> Any:
        drawn = np.zeros(1 if size is None else size)
        if 0 <= self.left < drawn.size:
            drawn.flat[self.left] = 1.0
        self.left -= drawn.size
        return drawn if size is not None else float(drawn[0])

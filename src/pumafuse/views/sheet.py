"""Axes to draw on that become SVG text for a page."""

from __future__ import annotations

import io
from collections.abc import Generator, Sequence
from contextlib import contextmanager

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure


class Sheet:
    """Axes to draw on; ``svg`` is the picture when the drawing is done."""

    def __init__(self, axes: list[Axes]) -> None:
        self.axes = axes
        self.svg = ""


@contextmanager
def drawing(
    columns: int,
    rows: int = 1,
    *,
    width: float | None = None,
    height: float = 2.9,
    ratios: Sequence[float] | None = None,
) -> Generator[Sheet]:
    """Axes row by row, drawn to SVG when done.

    Args:
        columns: How many beside one another.
        rows: How many below one another.
        width: Of the whole [inch]; by the columns for None.
        height: Of a row [inch].
        ratios: Of the columns' widths; all alike for None.
    """
    with matplotlib.rc_context(
        {
            "font.size": 9,
            "axes.titlesize": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "svg.hashsalt": "pumafuse",  # the same data give the same page
            "text.parse_math": False,  # a name with $ in it is a name
        }
    ):
        figure = Figure(figsize=(width or 3.6 * columns, height * rows), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False, width_ratios=ratios)
        sheet = Sheet(grid.ravel().tolist())
        yield sheet
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
        sheet.svg = text.getvalue()[text.getvalue().index("<svg") :]

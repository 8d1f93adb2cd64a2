"""Axes to draw on that become SVG text for a page."""

from __future__ import annotations

import io
from collections.abc import Generator, Sequence
from contextlib import contextmanager

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_EDGE = 0.12  # inch, right of all


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
    room: tuple[float, float, float] | None = None,
) -> Generator[Sheet]:
    """Axes row by row, drawn to SVG when done.

    Args:
        columns: How many beside one another.
        rows: How many below one another.
        width: Of the whole [inch]; by the columns for None.
        height: Of a row [inch].
        ratios: Of the columns' widths; all alike for None.
        room: Left of, below and above every axes [inch], which is fast and the same in every picture; for None as much
            as what is written there takes.
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
        size = (width or 3.6 * columns, height * rows)
        figure = Figure(figsize=size, layout="constrained" if room is None else None)
        if room is not None:
            _reserve(figure, columns, rows, *room)
        grid = figure.subplots(rows, columns, squeeze=False, width_ratios=ratios)
        sheet = Sheet(grid.ravel().tolist())
        yield sheet
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
        sheet.svg = text.getvalue()[text.getvalue().index("<svg") :]


def _reserve(figure: Figure, columns: int, rows: int, left: float, below: float, above: float) -> None:
    width, height = figure.get_size_inches().tolist()
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - _EDGE / width,
        bottom=below / height,
        top=1.0 - above / height,
        wspace=left / ((width - _EDGE) / columns - left),
        hspace=(below + above) / (height / rows - below - above),
    )

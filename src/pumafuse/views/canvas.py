"""HTML pages from templates, and SVG pictures with matplotlib for them."""

from __future__ import annotations

import io
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_EDGE = 0.12  # inch, right of the last column


def render(template: str, content: Mapping[str, Any]) -> str:
    """The text of a page; ``content`` is escaped, except for its ``Markup``."""
    pages = Environment(loader=PackageLoader("pumafuse.views", "pages"), autoescape=True, undefined=StrictUndefined)
    return pages.get_template(template).render(content)


class Canvas:
    """Axes to draw on; ``svg`` is the picture as text once the drawing is done."""

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
) -> Generator[Canvas]:
    """A canvas of ``rows`` by ``columns`` axes, row by row, turned into SVG on leaving the block.

    Args:
        columns: How many axes in a row.
        rows: How many rows.
        width: Width of the picture [inch]; None: 3.6 a column.
        height: Height of a row [inch].
        ratios: Relative widths of the columns; None: all alike.
        room: Margins left of, below and above every axes [inch], the same in every picture and fast to lay out; None:
            as much as the labels take.
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
            _set_margins(figure, columns, rows, *room)
        grid = figure.subplots(rows, columns, squeeze=False, width_ratios=ratios)
        canvas = Canvas(grid.ravel().tolist())
        yield canvas
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
        canvas.svg = text.getvalue()[text.getvalue().index("<svg") :]


def _set_margins(figure: Figure, columns: int, rows: int, left: float, below: float, above: float) -> None:
    width, height = figure.get_size_inches().tolist()
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - _EDGE / width,
        bottom=below / height,
        top=1.0 - above / height,
        wspace=left / ((width - _EDGE) / columns - left),
        hspace=(below + above) / (height / rows - below - above),
    )

"""HTML pages from templates, and matplotlib's figures in the style of all pictures."""

from __future__ import annotations

import io
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure


def render(template: str, content: Mapping[str, Any]) -> str:
    """The text of a page; ``content`` is escaped, except for its ``Markup``."""
    pages = Environment(loader=PackageLoader("pumafuse.views", "pages"), autoescape=True, undefined=StrictUndefined)
    return pages.get_template(template).render(content)


def draw_legend(figure: Figure) -> None:
    """Say below all axes what the lines of the first are: inside they would cover data."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)


def svg(figure: Figure) -> Markup:
    """A picture as text for a page."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return Markup(text.getvalue()[text.getvalue().index("<svg") :])


@contextmanager
def drawing(
    columns: int,
    rows: int = 1,
    *,
    width: float | None = None,
    height: float = 2.9,
    ratios: Sequence[float] | None = None,
    sharex: Literal["none", "col"] = "none",
    projection: Literal["3d"] | None = None,
) -> Generator[Figure]:
    """A figure of ``rows`` by ``columns`` axes, row by row; what is drawn and saved in the block is in our style."""
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
        subplot = {} if projection is None else {"projection": projection}
        figure = Figure(figsize=(width or 3.6 * columns, height * rows), layout="constrained")
        figure.subplots(rows, columns, sharex=sharex, width_ratios=ratios, subplot_kw=subplot)
        yield figure

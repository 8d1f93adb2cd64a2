"""A page from its template."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, content: Mapping[str, Any]) -> str:
    """The text of a page; what ``content`` holds is escaped, but for its ``Markup``."""
    pages = Environment(loader=PackageLoader("pumafuse.views", "pages"), autoescape=True, undefined=StrictUndefined)
    return pages.get_template(template).render(content)

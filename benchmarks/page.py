"""Tables of Markdown, and their places on the pages: between a mark that says who makes them and one where they end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
COMPARISON, LIVE = (REPOSITORY / "docs" / f"{name}.md" for name in ("comparison", "live"))
END = "<!-- until here -->"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int, notes: int = 0) -> str:
    """A table of Markdown; so many columns in front hold words, and so many at the end."""
    rule = ["---"] * words + ["---:"] * (len(head) - words - notes) + ["---"] * notes
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *rows))


def put(page: Path, script: str, text: str) -> None:
    """Put a text, made by one of the scripts here, into its place on a page."""
    begin, old = f"<!-- made by benchmarks/{script} -->", page.read_text(encoding="utf-8")
    head, rest = old.split(begin, 1)
    page.write_text(f"{head}{begin}\n\n{text}\n\n{rest[rest.index(END) :]}", encoding="utf-8")

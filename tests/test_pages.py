"""What README and documentation say: every command and snippet is carried out, page by page."""

import ast
import re
from pathlib import Path

import pytest

import pumafuse as pf
from pages import ROOT, Reader, blocks, paths, shows

LANGUAGES = {"bash", "python", "toml", "text", "json"}


@pytest.mark.parametrize("page", paths(), ids=lambda page: page.stem)
def test_blocks_are_of_a_kind_that_is_carried_out(page: Path) -> None:
    """Each block has a language that means something here, or a reason why it is left out."""
    for block in blocks(page):
        assert block.left_out or block.language in LANGUAGES, f"{page.name}:{block.line}"
        assert block.left_out or block.language != "toml" or block.file, f"{page.name}:{block.line}: which file?"


@pytest.mark.long
@pytest.mark.xdist_group("pages")  # they listen on the ports that they name
@pytest.mark.parametrize("page", paths(), ids=lambda page: page.stem)
def test_a_page_does_what_it_says(page: Path, tmp_path: Path) -> None:
    """From top to bottom in a new folder, every command ends well and prints what the page shows."""
    Reader(page, tmp_path).read()


@pytest.mark.parametrize(
    ("expected", "found"),
    [
        ("b  1\nc 2\n", True),
        ("b …\n…\nd", True),
        ("a\n…\nb 1", True),
        ("a\n\nb 1", True),
        ("b", False),
        ("c 2\nb 1", False),
        ("b …\nd", False),
    ],
)
def test_expected_lines_are_looked_for_in_a_row(expected: str, found: bool) -> None:
    """White space does not count; an ellipsis is anything in its line, alone any lines; all else is as it stands."""
    assert shows("a\nb   1\nc 2\nd\n", expected) is found


def _told() -> list[str]:
    """Every text in the sources that the program may say, f-strings in pieces."""
    return [
        node.value
        for path in Path(pf.__file__).parent.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]


@pytest.mark.parametrize(("page", "heading"), [("symptoms", "## Fusing"), ("live", "### What goes wrong")])
def test_messages_that_a_table_quotes_are_what_the_program_says(page: str, heading: str) -> None:
    """What stands in backquotes at the beginning of a row is a text of the program, whatever stands for its `…`."""
    _, _, text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").partition(f"\n{heading}")
    rows = [row for row in text.splitlines() if row[:3] == "| `"]
    quoted = [piece for row in rows for text in re.findall("`([^`]+)`", row.split("|")[1]) for piece in text.split("…")]
    assert len(rows) > 8
    told = _told()
    for piece in quoted:
        assert any(piece.strip() in text for text in told), piece

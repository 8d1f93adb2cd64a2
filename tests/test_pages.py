"""What README and documentation say: every command and snippet is carried out, page by page."""

import ast
import os
import re
import subprocess
import sys
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


@pytest.mark.long
def test_the_site_is_built_without_a_warning_and_fetches_nothing(tmp_path: Path) -> None:
    """Every link, anchor and public name is found; a page loads no script, style or picture from elsewhere."""
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    surroundings = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=surroundings, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert {page.stem for page in (ROOT / "docs").glob("*.md")} <= {page.stem for page in pages}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)[^>]+src="(https?:[^"]+)|<link[^>]+href="(https?:[^"]+)', text)
        assert not loaded, f"{page.name}: {loaded}"
        assert 'class="arithmatex"' not in text, f"{page.name}: a formula was not drawn"


@pytest.mark.parametrize(
    "words",
    ["rosbag", "MCAP", "LeRobot", "pandas", "quaternion", "joint", "no step trials", "ground truth", "orientation"],
)
def test_what_a_newcomer_looks_for_is_on_a_page_with_the_answer(words: str) -> None:
    """The glossary has the word in a row that leads to a page; the site's search is by words of pages."""
    rows = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8").splitlines()
    assert any(words in row and "](" in row for row in rows if row.startswith("| "))

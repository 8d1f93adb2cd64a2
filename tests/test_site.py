"""The documentation as a site."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


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

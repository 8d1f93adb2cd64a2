"""What the site (``mkdocs.yml``) shows beside this folder, and formulas that need no script.

Pages link to each other as they lie in the repository, so that they can be read there as well.
"""

from __future__ import annotations

import re
from pathlib import Path
from posixpath import normpath

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
FIRST_NOTEBOOK = "notebooks/1-step-trials-to-arm-model.ipynb"
_LINK = re.compile(r"(?<=\]\()([^)#:\s]+)(?=[)#])")  # of Markdown, to a file
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies elsewhere in the repository; a page's place there is kept in its file."""
    for source, place in PAGES.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / source)))
    for pattern in ("notebooks/*.ipynb", "examples/**/*.*", "scenarios/*"):
        for path in sorted(ROOT.glob(pattern)):
            files.append(File.generated(config, str(path.relative_to(ROOT)), abs_src_path=str(path)))
    for file in files:
        if file.src_uri.endswith(".py") and not file.src_uri.startswith("examples/"):
            file.inclusion = InclusionLevel.EXCLUDED
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links between files of the repository as links between places of the site."""
    at = {place: source for source, place in PAGES.items()}.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def place(link: re.Match[str]) -> str:
        target = normpath(f"{at}/../{link[1]}")
        return (PAGES | {"notebooks": FIRST_NOTEBOOK}).get(target, target.removeprefix("docs/"))

    return markdown if page.file.src_uri.endswith(".ipynb") else _LINK.sub(place, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """LaTeX as MathML, which browsers draw by themselves."""
    return _FORMULA.sub(
        lambda formula: convert(formula[2], display="inline" if formula[1] == "span" else "block"), html
    )

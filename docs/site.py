"""What the site (``mkdocs.yml``) shows beside this folder, and formulas that need no script.

Pages link to each other as they lie in the repository, so that they can be read there as well.
"""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path
from posixpath import normpath

from click import Context
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page
from typer.cli import get_docs_for_click
from typer.main import get_command

from pumafuse.cli.main import app

ROOT = Path(__file__).parent.parent
PAGES = {f"{name}.md": f"{name.lower()}.md" for name in ("CONTRIBUTING", "SECURITY", "CHANGELOG")}
PAGES |= {"README.md": "index.md", "examples/ros2/README.md": "ros2.md"}
FIRST_NOTEBOOK = "notebooks/1-step-trials-to-arm-model.ipynb"
_LINK = re.compile(r"(?<=\]\()([^)#:\s]+)(?=[)#])")  # of Markdown, to a file
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


@event_priority(50)  # before the plugin that makes pages of notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies elsewhere in the repository; a page's place there is kept in its file."""
    for source, place in PAGES.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / source)))
    for pattern in ("notebooks/*.ipynb", "examples/**/*.*", "scenarios/*"):
        for path in sorted(path for path in ROOT.glob(pattern) if path.suffix != ".md"):
            files.append(File(str(path.relative_to(ROOT)), str(ROOT), config.site_dir, config.use_directory_urls))
    for file in files:
        if file.src_uri.endswith(".py") and not file.src_uri.startswith("examples/"):
            file.inclusion = InclusionLevel.EXCLUDED
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links between files of the repository as links between places of the site, and the command line in its place."""
    at = {place: source for source, place in PAGES.items()}.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def place(link: re.Match[str]) -> str:
        target = normpath(f"{at}/../{link[1]}")
        return (PAGES | {"notebooks": FIRST_NOTEBOOK}).get(target, target.removeprefix("docs/"))

    if page.file.src_uri.endswith(".ipynb"):
        return markdown
    return _LINK.sub(place, markdown).replace("{{ commands }}", commands())


def commands() -> str:
    """What each command's help says, as Markdown."""
    command = get_command(app)
    told = get_docs_for_click(obj=command, ctx=Context(command), name="pumafuse")
    return told[told.index("\n## ") :].replace("```console\n$ ", "```text\n")


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """LaTeX as MathML, which browsers draw by themselves."""
    return _FORMULA.sub(
        lambda found: convert(unescape(found[2]), display="inline" if found[1] == "span" else "block"), html
    )

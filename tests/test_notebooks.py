"""The notebooks: they run as they stand, in an empty folder, and say what is stored in them."""

import itertools
import shutil
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

pytestmark = [pytest.mark.long]
NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
LONGEST = 120  # s that one cell may take


def read(path: Path) -> nbformat.NotebookNode:
    notebook: nbformat.NotebookNode = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    return notebook


def code(notebook: nbformat.NotebookNode) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts(cell: Any) -> list[tuple[str, str]]:
    """What a cell says; a stream comes in as many pieces as the kernel happened to send."""
    said: list[tuple[str, str]] = []
    for kind, outputs in itertools.groupby(cell.outputs, lambda one: one.get("name", one.output_type)):
        if kind in ("stdout", "stderr"):
            lines = "".join(output.text for output in outputs).splitlines()
            said += [(kind, line) for line in lines]
        else:
            said += [(kind, output.data["text/plain"]) for output in outputs]
    return said


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def stored(request: pytest.FixtureRequest) -> Path:
    path: Path = request.param
    return path


def test_there_are_four() -> None:
    """The tests below would be silent if the notebooks were elsewhere."""
    assert [path.name[0] for path in NOTEBOOKS] == ["1", "2", "3", "4"]


def test_what_is_stored_was_run_from_top_to_bottom(stored: Path) -> None:
    """Cells were run once each in their order, without an error or a warning, and pictures are there to be shown."""
    cells = code(read(stored))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = list(itertools.chain.from_iterable(cell.outputs for cell in cells))
    assert {output.output_type for output in outputs} <= {"stream", "display_data"}
    assert all(output.name == "stdout" for output in outputs if output.output_type == "stream")
    assert any("image/png" in output.get("data", {}) for output in outputs)


def test_a_fresh_run_says_what_is_stored(stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a fresh kernel and an empty folder each cell says, to the last letter, what is stored, and leaves no file."""
    folder = tmp_path / "empty"
    folder.mkdir()
    copy = Path(shutil.copy(stored, tmp_path))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))  # nobody's own start-up files
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel's own shows pictures
    notebook, expected = read(copy), code(read(stored))
    NotebookClient(
        notebook, timeout=LONGEST, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    for ran, before in zip(code(notebook), expected, strict=True):
        assert texts(ran) == texts(before), before.source
    assert list(folder.iterdir()) == []

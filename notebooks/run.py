"""Runs the notebooks anew, in place: ``make notebooks``. Nothing is stored that changes from run to run."""

from __future__ import annotations

import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ANNOUNCED = "compiling the filter for this machine"  # said in a first run on a machine


def main() -> None:
    """Each in a kernel of its own, in an empty folder."""
    for path in sorted(Path(__file__).parent.glob("*.ipynb")):
        print(path.name, flush=True)
        notebook = nbformat.read(path, as_version=4)
        language = notebook.metadata.language_info
        with tempfile.TemporaryDirectory() as folder:
            NotebookClient(
                notebook,
                kernel_name="python3",
                resources={"metadata": {"path": folder}},
                record_timing=False,
                coalesce_streams=True,
            ).execute()
        notebook.metadata.language_info = language
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.outputs = [one for one in cell.outputs if not one.get("text", "").startswith(ANNOUNCED)]
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main()

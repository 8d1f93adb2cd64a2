"""Runs the notebooks anew, in place: ``make notebooks``. Nothing is stored that changes from run to run."""

from __future__ import annotations

import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient


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
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main()

"""Output folders: written complete or not at all, and never in the place of what is not ours."""

from __future__ import annotations

import glob
import os
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import PumafuseError


class FolderError(PumafuseError):
    """An output folder cannot be written or read."""


def check_writable(folder: Path, force: bool, markers: Iterable[str], ours: Callable[[str], bool]) -> None:
    """Refuse early what :func:`replacing` would refuse late.

    Args:
        folder: Where the output is to go.
        force: Whether an earlier output may be replaced.
        markers: Files that every folder of this kind has.
        ours: Whether a file of this name may be in it; with any other it is never replaced.

    Raises:
        FolderError: The folder exists and is not to be replaced, or holds something else than our output.
    """
    if not folder.exists():
        above = next(parent for parent in folder.absolute().parents if parent.exists())
        if not above.is_dir() or not os.access(above, os.W_OK):
            raise FolderError(f"{folder}: cannot be written: {above} is no folder that may be written to")
        return
    if not folder.is_dir():
        raise FolderError(f"{folder}: exists and is not a folder")
    if not any(folder.iterdir()):
        return
    strange = sorted(path.name for path in folder.iterdir() if not ours(path.name) or not path.is_file())
    if strange or not all((folder / marker).exists() for marker in markers):
        what = f"holds '{strange[0]}'" if strange else "holds no output of pumafuse"
        raise FolderError(f"{folder}: exists and {what}, which is not ours to replace; choose another folder")
    if not force:
        raise FolderError(f"{folder}: exists; --force replaces it, or choose another folder")


@contextmanager
def replacing(folder: Path) -> Generator[Path]:
    """A new folder to write into, which takes the place of ``folder`` when all is written.

    Raises:
        FolderError: The disk refuses.
    """
    folder = folder.resolve()  # a link stays a link, its target is replaced
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as place:
            new = Path(place) / "new"
            new.mkdir()
            yield new
            _swap(new, folder, Path(place) / "old")
    except OSError as error:
        raise FolderError(f"{folder}: cannot be written: {error.strerror}") from None


def write_file(path: Path, text: str) -> None:
    """Write a file whole or not at all; what was there before stays until then.

    Raises:
        FolderError: The disk refuses.
    """
    path = path.resolve()
    new = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new.write_text(text, encoding="utf-8")
        new.replace(path)
    except OSError as error:
        raise FolderError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        with suppress(OSError):
            new.unlink()


def sweep(folders: Iterable[Path]) -> None:
    """Remove what killed processes left beside the folders that they were writing."""
    for folder in folders:
        for left in folder.parent.glob(f".{glob.escape(folder.name)}.*"):
            shutil.rmtree(left, ignore_errors=True)


def _swap(new: Path, folder: Path, aside: Path) -> None:
    """Put ``new`` in the folder's place; if that fails the old one is back where it was."""
    if folder.exists():
        folder.replace(aside)
    try:
        new.replace(folder)
    except BaseException:
        if aside.exists():
            aside.replace(folder)
        raise

"""Output folders: written complete or not at all, and never over other people's files."""

from __future__ import annotations

import glob
import os
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import PumafuseError

_MEANWHILE = "another process has written it meanwhile, and that stays; choose another name"


class FolderError(PumafuseError):
    """An output folder cannot be written or read."""


def check_writable(folder: Path, force: bool, markers: Iterable[str], ours: Callable[[str], bool]) -> None:
    """Refuse an output folder that must not be replaced or cannot be written, before any work is done.

    Args:
        folder: The output folder.
        force: Whether an earlier output may be replaced.
        markers: Files that every folder of this kind has.
        ours: Whether a file of this name may be in it; with any other it is never replaced.

    Raises:
        FolderError: It exists and is not to be replaced, holds something else than our output, or cannot be written.
    """
    with _refused(folder):
        exists = folder.exists()
    if not exists:
        above = next(parent for parent in folder.absolute().parents if parent.exists())
        if not above.is_dir() or not os.access(above, os.W_OK):
            raise FolderError(f"{folder}: cannot be written: {above} is no folder you may write to; choose another")
        return
    if not folder.is_dir():
        raise FolderError(f"{folder}: exists and is not a folder; choose another name")
    if not any(folder.iterdir()):
        return
    strange = sorted(path.name for path in folder.iterdir() if not ours(path.name) or not path.is_file())
    if strange or not all((folder / marker).exists() for marker in markers):
        what = f"holds '{strange[0]}'" if strange else "holds no output of pumafuse"
        raise FolderError(f"{folder}: exists and {what}, which is not ours to replace; choose another folder")
    if not force:
        raise FolderError(f"{folder}: exists; --force replaces it, or choose another folder")


def check_replaceable(path: Path, force: bool, ours: bool, what: str) -> None:
    """Refuse to replace a file that is not ours, no ``what``, also with --force: its name may be a slip."""
    if path.exists() and not ours:
        raise FolderError(f"{path}: exists and is no {what}, which is not ours to replace; choose another")
    if path.exists() and not force:
        raise FolderError(f"{path}: exists; --force replaces it")


@contextmanager
def replacing(folder: Path) -> Generator[Path]:
    """A new folder to write into, which replaces ``folder`` on leaving the block."""
    with _refused(folder):
        folder = folder.resolve()  # a link stays a link, its target is replaced
    with _beside(folder) as temporary:
        new, old, before = temporary / "new", temporary / "old", _identity(folder)
        new.mkdir()
        yield new
        if _identity(folder) != before:
            raise FolderError(f"{folder}: {_MEANWHILE}")
        if folder.exists():
            folder.replace(old)
        try:
            new.replace(folder)
        except BaseException:
            if old.exists():
                old.replace(folder)
            raise


def _identity(folder: Path) -> int | None:
    """Which folder is at this path now; None if none is."""
    return folder.stat().st_ino if folder.exists() else None


def write_file(path: Path, content: str | bytes, *, replace: bool = True) -> None:
    """Write a file whole or not at all; without ``replace`` there was none when the work began, and must be none."""
    with _refused(path):
        path = path.resolve()
    with _beside(path) as temporary:
        new = temporary / "new"
        new.write_bytes(content.encode() if isinstance(content, str) else content)
        if path.exists() and not replace:
            raise FolderError(f"{path}: {_MEANWHILE}")
        new.replace(path)


def sweep(folders: Iterable[Path]) -> None:
    """Remove the temporary folders that killed workers of this process left beside the folders they were writing.

    Each gets another name first, so that no worker still moves what is half removed to where a whole run is due.
    """
    for folder in folders:
        for left in list(folder.parent.glob(f"{glob.escape(_prefix(folder, os.getpid()))}*")):
            with suppress(FileNotFoundError):
                shutil.rmtree(left.rename(left.with_name(f"{left.name}-left")), ignore_errors=True)


def _prefix(path: Path, process: int) -> str:
    """What the names of temporary folders beside ``path`` begin with: names may have 255 bytes, letters up to four."""
    return f".{path.name[:50]}.{process}-"


@contextmanager
def _beside(path: Path) -> Generator[Path]:
    """A temporary folder beside ``path``, on the same disk; what the disk refuses is a FolderError.

    Its name has the number of the process above, by which that one can sweep up after its own workers, and no others.
    """
    with _refused(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=_prefix(path, os.getppid()), dir=path.parent) as temporary:
            yield Path(temporary)


@contextmanager
def _refused(path: Path) -> Generator[None]:
    """What the disk refuses is a FolderError that names ``path``."""
    if "\0" in str(path):
        raise FolderError(f"{path!r:.100}: cannot be written: no name has a NUL")
    try:
        yield
    except OSError as error:
        shown = path if len(str(path)) < 200 else f"{path!s:.100} …"
        why = os.strerror(error.errno) if error.errno else error  # pyarrow's own words say it twice
        raise FolderError(f"{shown}: cannot be written: {why}") from None

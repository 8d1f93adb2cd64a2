"""The thread that writes a record, and waits for the disk so that nobody else has to.

Whole lines go to the end of a file, so that whoever reads finds a run at any moment, with a torn last line at worst. A
disk that refuses is tried again every second; meanwhile rows wait, and when too many wait no more are taken.
"""

from __future__ import annotations

import os
import queue
import threading
from pathlib import Path
from typing import NamedTuple

from ..folders import FolderError, write_file

_TRIED_AGAIN = 1.0  # s after the disk refused
_MOST_WAITING = 64 << 20  # bytes that wait for a disk
_PATIENCE = 5.0  # s for the disk at the end
_MANIFEST = "run.toml"


class Job(NamedTuple):
    """What is to be written.

    Attributes:
        folder: Where; made if it is not there.
        rows: Whole lines for the end of each file, by its name; what is written goes out of it.
        manifest: The text of ``run.toml``, written if it has changed.
        number: How many rows these are.
    """

    folder: Path
    rows: dict[str, bytes]
    manifest: str
    number: int


class _File:
    """An open file, and whether its last line is whole."""

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        self.torn = False

    def is_at(self, path: Path) -> bool:
        """Whether it still has its name."""
        try:
            return os.path.samestat(os.fstat(self.descriptor), path.stat())
        except FileNotFoundError:
            return False


class Writer:
    """The thread that waits for the disk.

    Attributes:
        trouble: Why the disk refuses, or that the folder had gone; empty while all is well.
        rows: How many are written.
    """

    def __init__(self, header: bytes) -> None:
        """Start to wait for jobs; ``header`` is the first line of every file."""
        self.trouble, self.rows = "", 0
        self._header = header
        self._folder, self._manifest = Path(), ""
        self._files: dict[str, _File] = {}
        self._jobs = queue.SimpleQueue[Job | None]()
        self._given = self._done = 0  # bytes; each is counted by one thread alone
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="record", daemon=True)  # a dead disk may hold it
        self._thread.start()

    def hand_over(self, job: Job) -> bool:
        """Take a job in if there is room for it; whether there was."""
        size = sum(map(len, job.rows.values()))
        if self._given - self._done + size > _MOST_WAITING:
            return False
        self._given += size
        self._jobs.put(job)
        return True

    def close(self) -> None:
        """Write what waits and end; a disk that does not take it within five seconds does not get it."""
        self._ended.set()
        self._jobs.put(None)
        self._thread.join(_PATIENCE)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            size = sum(map(len, job.rows.values()))
            while not self._tried(job):
                if self._ended.wait(_TRIED_AGAIN) and not self._tried(job):
                    return
            self._done += size
            self.rows += job.number
        self._close_files()

    def _tried(self, job: Job) -> bool:
        """Write what is left of a job; whether all of it is written."""
        trouble = ""
        try:
            if job.folder != self._folder:
                self._close_files()
                self._folder, self._manifest = job.folder, ""
            elif not all(file.is_at(job.folder / name) for name, file in self._files.items()):
                trouble = f"{job.folder} or a file in it had gone, and is begun anew"
                for name in [name for name, file in self._files.items() if file.torn]:
                    job.rows[name] = job.rows[name].partition(b"\n")[2]
                self._close_files()
            job.folder.mkdir(exist_ok=True)
            for name in list(job.rows):
                self._append(job, name)
            if job.manifest != self._manifest or not (job.folder / _MANIFEST).exists():
                write_file(job.folder / _MANIFEST, job.manifest)
                self._manifest = job.manifest
        except OSError as error:
            self.trouble = f"{job.folder}: {error.strerror or error}"
            return False
        except FolderError as error:
            self.trouble = str(error)
            return False
        self.trouble = trouble
        return True

    def _append(self, job: Job, name: str) -> None:
        """Write a file's rows; what a full disk took of them is not written twice."""
        file = self._files.get(name)
        if file is None:
            file = self._files[name] = _File(job.folder / name)
            if not os.fstat(file.descriptor).st_size and not job.rows[name].startswith(self._header):
                job.rows[name] = self._header + job.rows[name]
        while rows := job.rows[name]:
            written = os.write(file.descriptor, rows)
            job.rows[name], file.torn = rows[written:], rows[written - 1 : written] != b"\n"
        del job.rows[name]

    def _close_files(self) -> None:
        for file in self._files.values():
            os.close(file.descriptor)
        self._files = {}

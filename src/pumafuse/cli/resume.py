"""`pumafuse fuse --resume`: which results are there already, and whether they were made as is asked for now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

import msgspec
import typer

from ..folders import FolderError
from ..fusion.config import ARM_FILE, FusionConfig
from ..fusion.results import SUMMARY
from ..fusion.segments import NOT_SELECTED
from ..fusion.summary import Summary, decode


@dataclass(frozen=True)
class Wanted:
    """How runs are to be fused: the options of ``pumafuse fuse``."""

    config: FusionConfig
    sensors: Sequence[str] | None
    rate: float | None
    mode: str
    engine: str
    part: tuple[float | None, float | None]
    extras: Sequence[str]  # files beside those that every result has

    @cached_property
    def files(self) -> dict[str, str]:
        """By name, the files of a result that hold the configuration."""
        return {"fusion.toml": self.config.to_toml(), ARM_FILE: self.config.arm.to_toml()}

    def result(self, path: Path, folder: Path) -> Summary | None:
        """The summary of the result of the run ``path`` in ``folder``; None where there is no result yet.

        Raises:
            FolderError: The result was made otherwise, or cannot be read.
        """
        if not (folder / SUMMARY).exists():
            return None
        try:
            summary = decode((folder / SUMMARY).read_bytes())
            others = self._differences(path, folder, summary)
        except (OSError, UnicodeDecodeError, msgspec.MsgspecError) as error:
            raise FolderError(f"{folder}: a damaged result ({error}); remove it, and it is fused anew") from None
        if others:
            raise FolderError(
                f"{folder}: made with another {' and another '.join(others)}: ask for what was asked for then, choose"
                " another folder, or fuse all anew with --force"
            )
        return summary

    def _differences(self, path: Path, folder: Path, summary: Summary) -> list[str]:
        """In words, in what a result is not as wanted."""
        wanted = [name for name in self.config.sensor_names(self.sensors) if summary.rows.get(name)]
        used = [name for name in self.config.sensors if summary.rows.get(name, {}).keys() - {NOT_SELECTED}]
        same = {
            "version of pumafuse": summary.pumafuse == version("pumafuse"),
            "run": summary.path == str(source_of(path)),
            **{name: (folder / name).read_text(encoding="utf-8") == text for name, text in self.files.items()},
            "choice of sensors": used == wanted,
            "--rate": summary.rate == self.rate,
            "mode": summary.mode == self.mode,
            "--engine": summary.engine == self.engine,
            "--from or --to": (summary.from_s, summary.to_s) == self.part,
            "choice of files": all((folder / name).exists() for name in self.extras),
        }
        return [what for what, is_same in same.items() if not is_same]


def results_there(places: Mapping[str, Path], wanted: Wanted) -> dict[str, Summary]:
    """The summaries of the runs that have a result already, by path; how many they are is printed.

    Args:
        places: The result folder of each run, by its path.
        wanted: How they are to be made.

    Raises:
        FolderError: A result was made otherwise, or cannot be read.
    """
    found = {path: wanted.result(Path(path), place) for path, place in places.items()}
    there = {path: summary for path, summary in found.items() if summary is not None}
    typer.echo(f"{len(there)} of {len(places)} done before, kept")
    return there


def source_of(path: Path) -> Path:
    """Where a run is, however its path was given: its folder, or its table."""
    whole = path.resolve()
    return whole.parent if whole.name == "run.toml" else whole

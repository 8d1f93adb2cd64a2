"""A survey of a log: what it holds, who is who in it, and how its motions follow each other."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import RunError
from ..logs.axes import in_axes
from ..logs.run import Run
from .contents import Part, parts_of
from .following import Following
from .roles import Roles, relations, roles_of


@dataclass(frozen=True)
class Survey:
    """What was found in a log.

    Attributes:
        log: The file or folder.
        run: The run in it, in the arm's axes.
        relations: How each sensor, and ``reference``, follows the commands, by its name and the axis.
        parts: Its tables or topics; none where it has a ``run.toml``.
        roles: Who is who; None where a ``run.toml`` says it.
        manifest: What that ``run.toml`` holds.
    """

    log: Path
    run: Run
    relations: Mapping[tuple[str, str], Following]
    parts: Sequence[Part] = ()
    roles: Roles | None = None
    manifest: Mapping[str, Any] | None = None

    @property
    def name(self) -> str:
        """The log's name without the endings of files."""
        log = self.log.resolve()
        log = log.parent if log.name == "run.toml" else log
        return re.sub(r"(\.(csv|parquet|mcap|bag|db3|rrd))?(\.gz)?$", "", log.name) or "log"


def survey(log: Path) -> Survey:
    """Look at a log of any kind that can be read.

    Raises:
        PumafuseError: Nothing can be read, or nothing in it can be commands.
    """
    described = log if log.name == "run.toml" else log / "run.toml"
    if os.path.isfile(described):  # noqa: PTH113 - Path.is_file raises on a name that is too long
        run, _ = in_axes(Run.read(described), None)
        return Survey(log, run, relations(run), manifest=tomllib.loads(described.read_text(encoding="utf-8")))
    parts = parts_of(log)
    roles = roles_of(parts, str(log))
    if not roles.sensors:
        raise RunError(f"{log}: commands, but nothing that measures where they lead: {_reasons(roles)}")
    return Survey(log, roles.run, relations(roles.run), parts, roles)


def _reasons(roles: Roles) -> str:
    return "; ".join(f"{stream.name}: {why}" for stream, why in roles.left_out) or "nothing else is in the log"

"""How a stream stands, for people: one screen while it goes on, and the summary at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rich import box
from rich.console import Console, Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from ..filter.outcome import Outcome
from ..live.health import Health
from ..live.stream import Stream
from ..units import MM, MS


class Part(Protocol):
    """What goes on beside a stream: the source, the recording, the way out."""

    def told(self) -> str:
        """What it has to say, in a sentence; empty for nothing."""
        ...


def status(stream: Stream, parts: Sequence[Part] = ()) -> Group:
    """One picture of the stream: where the tool is, and how each sensor does."""
    live, health = stream.live, stream.live.health()
    estimate = live.estimate()
    axes = Table(box=box.SIMPLE_HEAD)
    for heading in ("axis", "position, mm", "± sd, mm", "velocity, mm/s", ""):
        axes.add_column(heading, justify="left" if heading in ("axis", "") else "right")
    for name, axis in estimate.axes.items():
        stale = "[red]stale[/red]" if name in estimate.stale else ""
        axes.add_row(
            escape(name),
            f"{axis.position * MM:.3f}",
            f"{axis.position_sd * MM:.3f}",
            f"{axis.velocity * MM:.1f}",
            stale,
        )
    told = "no event yet" if live.newest is None else f"t = {estimate.time:.3f} s, {estimate.reason}"
    return Group(Text(told), axes, sensor_table(health), Text(counted(stream, health)), *map(Text, _told(parts)))


def sensor_table(health: Health) -> Table:
    """Rate, lateness, dropouts and NIS of each sensor, and its components by outcome."""
    caption = "outcomes count components: each axis of a row by itself"
    table = Table(box=box.SIMPLE_HEAD, caption=caption, caption_justify="left")
    words = [
        word for word in (o.word for o in Outcome) if any(sensor.outcomes[word] for sensor in health.sensors.values())
    ]
    table.add_column("sensor")
    for heading in ("rows", "rate, Hz", "late, ms", "at most", "dropouts", "NIS", "silent, s", *words):
        table.add_column(heading, justify="right")
    for name, sensor in health.sensors.items():
        silent = "never heard" if sensor.silent is None else f"{sensor.silent:.1f}"
        table.add_row(
            escape(name),
            str(sensor.rows),
            f"{sensor.rate:.1f}",
            f"{sensor.lateness * MS:.1f}",
            f"{sensor.lateness_max * MS:.1f}",
            str(sensor.dropouts),
            "" if sensor.nis is None else f"{sensor.nis:.2f}",
            f"[red]{silent}[/red]" if sensor.stale else silent,
            *(str(sensor.outcomes[word]) for word in words),
        )
    return table


def counted(stream: Stream, health: Health) -> str:
    """Lines, commands, restarts and estimates in one sentence."""
    parts = [f"{count} {word}" for word, count in health.commands.items() if count]
    said = [f"commands: {', '.join(parts) or 'none'}", f"{stream.estimates} estimates"]
    if stream.lines:
        said.insert(0, f"{stream.lines} lines, {stream.bad} of them bad")
    if health.unknown:
        said.append(f"{health.unknown} rows of unknown sensors")
    if health.segments > 1:
        said.append(f"{health.segments} segments")
    return "; ".join(said)


def summarise(stream: Stream, parts: Sequence[Part], errors: Console) -> None:
    """What there was, for people."""
    health = stream.live.health()
    for said in (counted(stream, health), *_told(parts)):
        errors.print(said, markup=False, soft_wrap=True)
    if any(sensor.rows for sensor in health.sensors.values()):
        errors.print(sensor_table(health))


def _told(parts: Sequence[Part]) -> list[str]:
    """What the source, the recording and the way out have to say."""
    return [said for said in (part.told() for part in parts) if said]

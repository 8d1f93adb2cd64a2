"""Status screen of a live stream, and the summary at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rich import box
from rich.console import Console, Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from ..filter.outcome import Outcome
from ..live.results import Health
from ..live.stream import Stream
from ..units import MM, MS


class Part(Protocol):
    """Part beside a stream: the source, the recorder, the sender of estimates."""

    def summary(self) -> str:
        """What there was, in a sentence; empty for nothing."""
        ...


def status(stream: Stream, parts: Sequence[Part] = ()) -> Group:
    """One screen: the position of each axis, and how each sensor does."""
    live, health = stream.live, stream.live.health()
    estimate = live.estimate()
    axes = Table(box=box.SIMPLE_HEAD)
    for heading in ("axis", "position, mm", "± sd, mm", "velocity, mm/s", ""):
        axes.add_column(heading, justify="left" if heading in ("axis", "") else "right")
    for name, axis in estimate.axes.items():
        axes.add_row(
            escape(name),
            f"{axis.position * MM:.3f}",
            f"{axis.position_sd * MM:.3f}",
            f"{axis.velocity * MM:.1f}",
            "[red]stale[/red]" if name in estimate.stale else "",
        )
    now = "no event yet" if live.newest is None else f"t = {estimate.time:.3f} s, {estimate.reason}"
    return Group(Text(now), axes, _sensor_table(health), *map(Text, _sentences(stream, health, parts)))


def summarise(stream: Stream, parts: Sequence[Part], errors: Console) -> None:
    """Print the counts of a stream and of the parts beside it, and how each sensor did."""
    health = stream.live.health()
    for sentence in _sentences(stream, health, parts):
        errors.print(sentence, markup=False, soft_wrap=True)
    if any(sensor.rows for sensor in health.sensors.values()):
        errors.print(_sensor_table(health))


def _sensor_table(health: Health) -> Table:
    """Rate, lateness, dropouts and NIS of each sensor, and its components by outcome."""
    caption = "outcomes count components: each axis of a row by itself"
    table = Table(box=box.SIMPLE_HEAD, caption=caption, caption_justify="left")
    words = [one.word for one in Outcome if any(sensor.outcomes[one.word] for sensor in health.sensors.values())]
    table.add_column("sensor")
    for heading in ("rows", "rate, Hz", "late, ms", "at most", "dropouts", "NIS", "silent, s", *words):
        table.add_column(heading, justify="right")
    for name, sensor in health.sensors.items():
        silent = "no row yet" if sensor.silent is None else f"{sensor.silent:.1f}"
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


def _sentences(stream: Stream, health: Health, parts: Sequence[Part]) -> list[str]:
    """The counts of lines, commands, estimates and restarts; then the summary of each part beside the stream."""
    commands = [f"{count} {word}" for word, count in health.commands.items() if count]
    counts = [f"{stream.lines} lines, {stream.bad} of them bad"] if stream.lines else []
    counts += [f"commands: {', '.join(commands) or 'none'}", f"{stream.estimates} estimates"]
    counts += [f"{health.unknown} rows of unknown sensors"] if health.unknown else []
    counts += [f"{health.segments} segments"] if health.segments > 1 else []
    return ["; ".join(counts), *filter(None, (part.summary() for part in parts))]

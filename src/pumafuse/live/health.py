"""How a stream does: rate, lateness, dropouts, NIS and outcomes of each sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..arrays import ALWAYS
from ..filter.outcome import Outcome
from .tally_kernels import CAME, DROPOUTS, LATENESS, MOST_LATE, NIS, ROWS, SCALARS, SECONDS, Tally


@dataclass(frozen=True)
class SensorHealth:
    """One sensor.

    Attributes:
        rows: How many have come.
        rate: Rows a second over the last minute of stream time [Hz].
        lateness: How far its stamps were behind the newest one of all when they came, mean of the last minute [s].
        lateness_max: The highest of that minute [s].
        silent: For how long nothing has come, in stream time [s]; None if nothing ever did.
        stale: Whether that is longer than the limit.
        dropouts: Intervals longer than one and a half times the usual one, once late rows are in.
        nis: Mean ν²/S of the last minute; 1 where the noise is as configured; None without a fused component.
        outcomes: Of all its components by the word.
    """

    rows: int
    rate: float
    lateness: float
    lateness_max: float
    silent: float | None
    stale: bool
    dropouts: int
    nis: float | None
    outcomes: Mapping[str, int]

    @property
    def reacquired(self) -> int:
        """How many components a reacquired gate has let in."""
        return self.outcomes[Outcome.REACQUIRED.word]


@dataclass(frozen=True)
class Health:
    """All that has come.

    Attributes:
        newest: The newest stamp (but not one that a sensor alone has run ahead to), int ns; None before any event.
        segments: How often the filter has started: 1, and once more each time the commands' clock was set anew.
        commands: Of all commands by the outcome's word.
        sensors: In the order of the configuration.
        unknown: Rows of sensors that the configuration does not know.
    """

    newest: int | None
    segments: int
    commands: Mapping[str, int]
    sensors: Mapping[str, SensorHealth]
    unknown: int


def health_of(
    tally: Tally,
    refused: Mapping[str, Mapping[Outcome, int]],
    commands: Mapping[Outcome, int],
    unknown: int,
    segment: int,
    newest: int | None,
    stale_ns: int,
) -> Health:
    """What a tally says, with the components that were refused before they were tallied."""
    sensors: dict[str, SensorHealth] = {}
    for number, (name, more) in enumerate(refused.items()):
        last = int(tally.last[number])
        silent = None if newest is None or last == ALWAYS else max((newest - last) / 1e9, 0.0)
        now = 0 if newest is None else newest // 1_000_000_000
        age = now - tally.second[number]
        recent = (age >= 0) & (age < SECONDS)
        minute = tally.minute[number][recent]
        rows, components = float(minute[:, ROWS].sum()), float(minute[:, SCALARS].sum())
        span = float(age[recent].max(initial=0)) + (0.0 if newest is None else newest / 1e9 - now)
        sensors[name] = SensorHealth(
            rows=int(tally.number[number, CAME]),
            rate=rows / max(span, 1.0),
            lateness=float(minute[:, LATENESS].sum()) / max(rows, 1.0),
            lateness_max=float(minute[:, MOST_LATE].max(initial=0.0)),
            silent=silent,
            stale=silent is None or silent > stale_ns / 1e9,
            dropouts=int(tally.number[number, DROPOUTS]),
            nis=float(minute[:, NIS].sum()) / components if components else None,
            outcomes={outcome.word: int(tally.number[number, outcome]) + more[outcome] for outcome in Outcome},
        )
    by_word = {outcome.word: count for outcome, count in commands.items()}
    return Health(newest, segment + 1, by_word, sensors, unknown)

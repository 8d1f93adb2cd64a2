"""The last seconds of a stream: events go in, estimates come out; a denser stream gets more room, up to a bound."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..arrays import ALWAYS, NEVER, FloatArray
from ..errors import ConfigError
from ..fusion import kernels as fusion
from ..fusion.config import FusionConfig
from . import kernels
from .command_kernels import COMMANDS, STAMP, STEP, U
from .kernels import DONE
from .memory import BEGIN, CHANGED, END, ORIGIN, SPREAD, VALUE, empty, with_commands, with_entries, with_rows
from .tally_kernels import Tally

MOST_ROWS = 65_536  # of measurements or of commands: some 70 MB for three axes; what is more shortens the window
_LONGEST_RECOVERY = 1e4  # periods


class Window:
    """The last seconds of a stream, and the filter at every one of their events.

    An event comes in through ``value`` and ``spread``, then :meth:`hear` or :meth:`command`, which say which of their
    axes it gives; what became of these is in ``told`` then.

    Attributes:
        memory: All arrays.
        value: Of the event that comes in [m], (A,).
        spread: By what the noise of each of its values is scaled, 1 if nobody says otherwise, (A,).
        told: What became of its axes: codes of Outcome, or ``ABSENT`` for an axis that it does not give, (A,).
        floor: What is stamped before it [ns] can no longer be taken, because the stream was too dense for the window.
    """

    def __init__(
        self, config: FusionConfig, axes: tuple[str, ...], start: Mapping[str, float], tally: Tally | None = None
    ) -> None:
        """Nothing heard yet.

        Args:
            config: Arm, noise and sensors.
            axes: Every axis in its order.
            start: The level u₀ [m] of axes that do not rest at their first command before it.
            tally: What was counted before.

        Raises:
            ConfigError: A gain's recovery is too slow to be followed.
        """
        period = config.arm.update_period
        for axis in axes:
            recovery = config.arm.axes[axis].gain_recovery
            if recovery is not None and recovery > _LONGEST_RECOVERY * period:
                raise ConfigError(
                    f"axes.{axis}.gain_recovery_ms: a live stream follows at most {_LONGEST_RECOVERY:g} update periods"
                )
        self.floor = ALWAYS
        self._latency = round(max([0.0, *(sensor.latency for sensor in config.sensors.values())]) * 1e9)
        self.memory = empty(config, axes, start)
        if tally is not None:
            self.memory.tally.number[:], self.memory.tally.usual[:] = tally.number, tally.usual
        heard = self.memory.heard
        self.value, self.spread, self.told = heard.new[:, VALUE], heard.new[:, SPREAD], heard.told
        self._flat = self.memory.flat()
        width = self.memory.state.x.shape[1]
        nothing = np.zeros((len(axes), 0))
        self._held = (np.zeros((len(axes), 0, width)), np.zeros((len(axes), 0, width, width)), nothing)
        self._outputs = np.zeros((len(fusion.Outputs._fields), len(axes), 1))
        self._places = tuple(self._outputs)

    @property
    def origin(self) -> int | None:
        """The first command's stamp, int ns; None before it."""
        origin = int(self.memory.heard.span[ORIGIN])
        return None if origin == NEVER else origin

    def hear(self, stamp: int, sensor: int, given: int, newest: int, oldest: int) -> bool:
        """Take in a row of measurements; see :func:`pumafuse.live.kernels.hear` and :meth:`command`."""
        attempt = 0
        while kernels.hear(self._flat, stamp, sensor, given, newest, oldest - self._latency) != DONE:
            self._make_room(attempt, oldest, event=True)
            if stamp < self.floor:
                return False
            attempt += 1
        return True

    def command(self, stamp: int, given: int, oldest: int) -> bool:
        """Take in a command; see :func:`pumafuse.live.kernels.command`.

        Args:
            stamp: Int ns.
            given: The axes it gives, as bits.
            oldest: No event stamped before will ever come [ns].

        Returns:
            False if to make room the window had to let go of its time.
        """
        attempt = 0
        while kernels.command(self._flat, stamp, given, oldest - self._latency) != DONE:
            self._make_room(attempt, oldest, event=True)
            if stamp < self.floor:
                return False
            attempt += 1
        self._resume(oldest)
        return True

    def estimate(self, time: int, oldest: int) -> list[tuple[list[float], int] | None]:
        """Every axis at an instant.

        Args:
            time: Int ns.
            oldest: No event stamped before will ever come [ns].

        Returns:
            For each axis what :class:`fusion.Outputs` has, in the stream's own coordinates and SI, and when the last
            component was valid that it knows of [ns]; None as long as the axis has no start level.
        """
        attempt = 0
        while kernels.ask(self._flat, self._held, self._places, time) != DONE:
            self._make_room(attempt, oldest, event=False)
            attempt += 1
        commands = self.memory.commands
        answers: list[tuple[list[float], int] | None] = []
        for found, commanded, (level, given), fused in zip(
            self._outputs[:, :, 0].T.tolist(),
            commands.number[:, COMMANDS].tolist(),
            commands.level.tolist(),
            self.memory.heard.fused.tolist(),
            strict=True,
        ):
            found[0] += level
            answers.append((found, fused) if commanded or given else None)
        return answers

    def commanded(self, axis: int, stamp: int) -> FloatArray:
        """The position [m] commanded on an axis at ``stamp`` [ns] or before it, as far as is known, (1,)."""
        commands = self.memory.commands
        count = int(commands.number[axis, COMMANDS])
        row = max(int(np.searchsorted(commands.time[axis, :count, STAMP], stamp, side="right")) - 1, 0)
        return commands.row[axis, row : row + 1, U] if count else np.zeros(1)

    def latest_command(self, axis: int) -> float | None:
        """The position [m] that was commanded last on an axis; None before any."""
        commands = self.memory.commands
        count = commands.number.item(axis, COMMANDS)
        return commands.row.item(axis, count - 1, U) if count else None

    def latest_step(self) -> tuple[int, float]:
        """The stamp [ns] of the latest command, and the largest step [m] that the latest ones of the axes made."""
        commands, stamp, step = self.memory.commands, ALWAYS, 0.0
        for axis, count in enumerate(commands.number[:, COMMANDS].tolist()):
            if count:
                stamp = max(stamp, commands.time.item(axis, count - 1, STAMP))
                step = max(step, abs(commands.row.item(axis, count - 1, STEP)))
        return stamp, step

    def forget(self, after: int, oldest: int) -> None:
        """Take back all that is stamped after ``after`` [ns]."""
        kernels.forget(self._flat, after)
        self._resume(oldest)

    def rehearse(self) -> None:
        """Have every kernel compiled and in memory; on a window that nobody needs."""
        self.forget(0, 0)
        self.tally()
        self._give_up(0)

    def tally(self) -> Tally:
        """What there was of each sensor until now, with what is still in the window."""
        now = self.memory.tally
        copied = Tally(
            now.number.copy(), now.last.copy(), now.left.copy(), now.usual.copy(), now.second.copy(), now.minute.copy()
        )
        kernels.count(self.memory._replace(tally=copied).flat())
        return copied

    def _resume(self, oldest: int) -> None:
        """Meet the rows again for which something has changed."""
        span, attempt = self.memory.heard.span, 0
        while span[CHANGED] < span[END] and kernels.hear(self._flat, 0, 0, 0, 0, 0) != DONE:
            self._make_room(attempt, oldest, event=False)
            attempt += 1

    def _make_room(self, attempt: int, oldest: int, event: bool) -> None:
        """First let go of old commands; if that was not enough, take more memory or give up the oldest part.

        Args:
            attempt: How often room was made for the same thing already.
            oldest: No command stamped before will ever come [ns].
            event: Whether it is for an event, and not only for the entries of commands that are there.
        """
        heard, commands = self.memory.heard, self.memory.commands
        rows, begin, room = len(heard.stamp), int(heard.span[BEGIN]), commands.time.shape[1]
        longest = int(commands.number[:, COMMANDS].argmax())
        if event and heard.span[END] - begin == rows:
            if rows < MOST_ROWS:
                self.memory = with_rows(self.memory, 2 * rows)
            else:
                self._give_up(int(self.memory.rows.valid[(begin + rows // 8) % rows]) + 1 + self._latency)
        elif attempt == 0:
            kernels.compact(self._flat, max(oldest, self.floor))
        elif not event or commands.number[longest, COMMANDS] < room:
            self.memory = with_entries(self.memory)
        elif room < MOST_ROWS:
            self.memory = with_commands(self.memory)
        else:
            self._give_up(int(commands.time[longest, room // 8, STAMP]) + 1)
        self._flat = self.memory.flat()

    def _give_up(self, floor: int) -> None:
        """Let go of everything stamped before ``floor`` [ns]."""
        self.floor = floor
        kernels.let_go(self._flat, floor - self._latency)
        kernels.compact(self._flat, floor)

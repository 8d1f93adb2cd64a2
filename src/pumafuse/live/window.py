"""The arrays behind a live estimator: made once, grown when a stream is denser than they are, never without bound."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..arrays import ALWAYS, NEVER, FloatArray, IntArray
from ..errors import ConfigError
from ..fusion import kernels as fusion
from ..fusion.config import FusionConfig
from ..fusion.engine import order_of, places, sensors_of, start_of
from ..model import closed
from . import kernels
from .command_kernels import COMMANDS, STAMP, STEP, Commands, U
from .kernels import (
    BEGIN,
    CHANGED,
    DONE,
    END,
    ORIGIN,
    SPREAD,
    VALUE,
    Heard,
    Memory,
    Nothing,
)
from .tally_kernels import IN_A_ROW, SECONDS, Tally

MOST_ROWS = 65_536  # of readings or of commands: some 70 MB for three axes; what is more shortens the window
_ROWS, _COMMANDS, _ENTRIES = 4096, 512, 1024  # at first
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
        self.memory = _empty(config, axes, start)
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
        """Take in a row of readings; see :func:`pumafuse.live.kernels.hear` and :meth:`command`."""
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
            scalar was valid that it knows of [ns]; None as long as the axis has no start level.
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
                self.memory = _with_rows(self.memory, 2 * rows)
            else:
                self._give_up(int(self.memory.rows.valid[(begin + rows // 8) % rows]) + 1 + self._latency)
        elif attempt == 0:
            kernels.compact(self._flat, max(oldest, self.floor))
        elif not event or commands.number[longest, COMMANDS] < room:
            self.memory = _with_entries(self.memory)
        elif room < MOST_ROWS:
            self.memory = _with_commands(self.memory)
        else:
            self._give_up(int(commands.time[longest, room // 8, STAMP]) + 1)
        self._flat = self.memory.flat()

    def _give_up(self, floor: int) -> None:
        """Let go of everything stamped before ``floor`` [ns]."""
        self.floor = floor
        kernels.let_go(self._flat, floor - self._latency)
        kernels.compact(self._flat, floor)


def _empty(config: FusionConfig, axes: tuple[str, ...], start: Mapping[str, float]) -> Memory:
    names, count = tuple(config.sensors), len(axes)
    level = {axis: start.get(axis, 0.0) for axis in axes}
    biases = [
        [name for name, sensor in config.sensors.items() if sensor.bias_sd > 0.0 and sensor.sd_of(axis) is not None]
        for axis in axes
    ]
    models, process = [config.arm.axes[axis] for axis in axes], [config.process[axis] for axis in axes]
    order = np.array([order_of(config, axis) for axis in axes])
    driven = fusion.Axes(
        order=order,
        constants=np.array([closed.constants(model.plant) for model in models]),
        states=order + 1 + np.array([len(biased) for biased in biases]),
        first=np.arange(count + 1) * _ENTRIES,
        acting=np.full(count * _ENTRIES, NEVER),
        value=np.zeros(count * _ENTRIES),
        noise=np.zeros(count * _ENTRIES),
        drift=np.zeros(count * _ENTRIES),
        resting=np.array([[part.input_noise**2, part.drift**2] for part in process]),
    )
    state = start_of(driven, len(names), NEVER, config, biases)
    scalars, width = _ROWS * count, state.x.shape[1]
    kept = places(state, _ROWS + 2)
    fusion.keep(state, kept, _ROWS + 1)
    table = (count, _COMMANDS)
    return Memory(
        driven,
        sensors_of(names, level, config, biases),
        fusion.Rows(
            np.zeros(_ROWS, np.int64),
            np.zeros(_ROWS, np.int16),
            np.zeros(_ROWS, np.int64),
            np.zeros(_ROWS, np.int64),
            np.zeros(scalars, np.int16),
            np.zeros(scalars),
            np.zeros(scalars),
        ),
        state,
        kept,
        fusion.Met(np.zeros(scalars), np.zeros(scalars), np.zeros(scalars, np.uint8)),
        Commands(
            time=np.zeros((*table, 2), np.int64),
            row=np.zeros((*table, 5)),
            number=np.array([[0, 0, 0, 0, 0, round(config.arm.delay_of(axis) * 1e9)] for axis in axes]),
            level=np.array([[u, float(axis in start)] for axis, u in level.items()]),
            gain=np.array(
                [
                    [
                        model.gain.slope,
                        model.gain.intercept,
                        np.inf if model.gain_recovery is None else model.gain_recovery,
                        config.arm.update_period,
                    ]
                    for model in models
                ]
            ),
            process=np.array(
                [[part.input_noise**2, part.drift**2, part.maneuver_noise, part.maneuver_drift] for part in process]
            ),
        ),
        Heard(
            span=np.array([0, 0, NEVER, 0]),
            stamp=np.zeros(_ROWS, np.int64),
            value=np.zeros((_ROWS, count, 2)),
            code=np.zeros((_ROWS, count, 2), np.uint8),
            latency=np.array([round(sensor.latency * 1e9) for sensor in config.sensors.values()], dtype=np.int64),
            new=np.tile([0.0, 1.0], (count, 1)),
            told=np.zeros(count, np.uint8),
            fused=np.zeros(count, np.int64),
        ),
        Tally(
            number=np.zeros((len(names), IN_A_ROW + 1), np.int64),
            last=np.full(len(names), ALWAYS),
            left=np.full(len(names), ALWAYS),
            usual=np.zeros(len(names)),
            second=np.full((len(names), SECONDS), ALWAYS),
            minute=np.zeros((len(names), SECONDS, 5)),
        ),
        Nothing(np.zeros(count + 1, np.int64), np.zeros(0), np.zeros((0, width))),
    )


def _with_rows(memory: Memory, rows: int) -> Memory:
    """The same with room for ``rows`` rows in the ring; what is in it keeps its positions."""
    held, axes = len(memory.heard.stamp), len(memory.heard.told)
    positions: IntArray = np.arange(int(memory.heard.span[BEGIN]), int(memory.heard.span[END]), dtype=np.int64)
    here, there = positions % held, positions % rows
    extra = np.array([held, held + 1])

    def of_rows(part: np.ndarray) -> np.ndarray:
        found = np.zeros((rows, *part.shape[1:]), dtype=part.dtype)
        found[there] = part[here]
        return found

    def of_scalars(part: np.ndarray) -> np.ndarray:
        return of_rows(part.reshape(held, axes)).reshape(-1)

    def of_places(part: np.ndarray) -> np.ndarray:
        found = np.zeros((rows + 2, *part.shape[1:]), dtype=part.dtype)
        found[there], found[rows:] = part[here], part[extra]
        return found

    scalars_begin = memory.rows.first - np.arange(held) * axes  # 0 for each row that was ever arranged
    first = of_rows(scalars_begin) + np.arange(rows) * axes
    return memory._replace(
        rows=fusion.Rows(
            of_rows(memory.rows.valid),
            of_rows(memory.rows.sensor),
            first,
            first + of_rows(memory.rows.end - memory.rows.first),
            of_scalars(memory.rows.axis),
            of_scalars(memory.rows.value),
            of_scalars(memory.rows.spread),
        ),
        kept=fusion.State(
            **{name: of_places(part) for name, part in memory.kept._asdict().items() if name != "work"},
            work=memory.kept.work,
        ),
        met=fusion.Met(*(of_scalars(part) for part in memory.met)),
        heard=memory.heard._replace(
            stamp=of_rows(memory.heard.stamp),
            value=of_rows(memory.heard.value),
            code=of_rows(memory.heard.code),
        ),
    )


def _with_commands(memory: Memory) -> Memory:
    """The same with twice the room for commands."""
    commands = memory.commands
    time, row = (np.concatenate((part, np.zeros_like(part)), axis=1) for part in (commands.time, commands.row))
    return memory._replace(commands=commands._replace(time=time, row=row))


def _with_entries(memory: Memory) -> Memory:
    """The same with twice the room for the entries that commands make."""
    count, axes = len(memory.heard.told), memory.axes

    def wider(part: np.ndarray, filled: float = 0) -> np.ndarray:
        table = part.reshape(count, -1)
        return np.concatenate((table, np.full_like(table, filled)), axis=1).reshape(-1)

    return memory._replace(
        axes=axes._replace(
            first=axes.first * 2,
            acting=wider(axes.acting, NEVER),
            value=wider(axes.value),
            noise=wider(axes.noise),
            drift=wider(axes.drift),
        )
    )

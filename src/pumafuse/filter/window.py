"""The last seconds of a stream, and the filter at every one of their events."""

from __future__ import annotations

import ctypes
import math
from typing import NamedTuple

import numpy as np

from ..arrays import NEVER, FloatArray, IntArray, TimeArray
from .core import Handle, Model, Output, at, checked, library, struct, struct_of

MOST_ROWS = 65_536  # events; what is more shortens the window
FIRST_ROWS = 4096  # at first
SECONDS = 60  # of the past that are counted
ROWS, LATENESS, MOST_LATE, NIS, SCALARS = range(5)  # of each of them
CAME, DROPOUTS = 8, 9  # of a sensor, after the outcomes
_COUNTS = 12


class Counters(NamedTuple):
    """What there was of each sensor.

    Attributes:
        number: Of components that have left the window by their outcome, rows that ``CAME``, ``DROPOUTS``: intervals
            over one and a half times the usual one, of how many intervals the usual one is a mean, and dropouts in a
            row, (S, 12).
        last: Latest stamp, int64 ns, ``ALWAYS`` without one, (S,).
        left: Stamp of the latest row that has left the window, int64 ns, ``ALWAYS`` without one, (S,).
        usual: Usual interval [s], (S,).
        second: Which second of stream time each entry of ``minute`` is, (S, 60).
        minute: For each second: rows, sum and maximum of how late they came [s], sum of NIS, fused components, (S, 60,
            5).
    """

    number: IntArray
    last: TimeArray
    left: TimeArray
    usual: FloatArray
    second: TimeArray
    minute: FloatArray


_Counters = struct([], Counters._fields)


class _Port(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.POINTER(ctypes.c_double)) for name in ("value", "spread")),
        ("outcome", ctypes.POINTER(ctypes.c_uint8)),
        ("innovation", ctypes.POINTER(ctypes.c_double)),
        *((name, ctypes.c_int64) for name in ("contradicts", "origin", "floor", "room", "held")),
    )
    contradicts: int
    origin: int
    floor: int


class Window(Handle):
    """Takes events in any order; a new one is put where its time says, and the filter runs on from there.

    An event comes in through ``value`` and ``spread``, then :meth:`add_measurement` or :meth:`add_command`, which say
    which of their axes it gives; what became of these is in ``outcome`` then.

    Attributes:
        value: Of the event that comes in [m], (A,).
        spread: By what the noise of each of its values is scaled, 1 if nobody says otherwise, (A,).
        outcome: What became of its axes: codes of Outcome, or ``ABSENT`` for an axis that it does not give, (A,).
        innovation: ν of each value of a measurement [m], (A,).
        port: The core's own view of these: the sensor that the last measurement ``contradicts`` (−1 for none), the
            ``origin`` (the first command's stamp, int ns), the ``floor`` (what is stamped before is taken no more, as
            the stream was too dense), for how many events there is ``room``, and how many are ``held``.
    """

    value: ctypes.Array[ctypes.c_double]
    spread: ctypes.Array[ctypes.c_double]
    _free = library.pf_live_free

    def __init__(self, model: Model, carried: Counters | None = None) -> None:
        """Empty; ``carried`` is what was counted before."""
        before = None if carried is None else ctypes.byref(_Counters(*map(at, carried)))
        super().__init__(library.pf_live_new(ctypes.byref(struct_of(model)), FIRST_ROWS, MOST_ROWS, before))
        self._axes, self._sensors = len(model.axis), len(model.sensor)
        self.port = port = _Port.from_address(library.pf_live_port(self._core))
        numbers = ctypes.c_double * self._axes
        self.value, self.spread = (
            numbers.from_address(ctypes.addressof(one.contents)) for one in (port.value, port.spread)
        )
        self.outcome = (ctypes.c_uint8 * self._axes).from_address(ctypes.addressof(port.outcome.contents))
        self.innovation = numbers.from_address(ctypes.addressof(port.innovation.contents))
        self._outputs, self._fused = np.zeros((len(Output), self._axes)), np.zeros(self._axes, dtype=np.int64)
        self._found = at(self._outputs), at(self._fused)
        self._commands = (ctypes.c_int64 * self._axes)(), numbers(), numbers()

    @property
    def origin(self) -> int | None:
        """The first command's stamp, int ns; None before it."""
        origin = self.port.origin
        return None if origin == NEVER else origin

    def add_measurement(self, stamp: int, sensor: int, given: int, newest: int, oldest: int) -> bool:
        """Take in a measurement; ``newest`` [ns] is the newest stamp of all. See :meth:`add_command`."""
        taken = library.pf_live_measurement(self._core, stamp, sensor, given, newest, oldest)
        return taken > 0 if taken >= 0 else checked(taken)

    def add_command(self, stamp: int, given: int, oldest: int) -> bool:
        """Take in a command.

        Args:
            stamp: Int ns.
            given: The axes that it gives, as bits.
            oldest: No event stamped before will ever come [ns].

        Returns:
            False if to make room the window had to let go of its time.
        """
        taken = library.pf_live_command(self._core, stamp, given, oldest)
        return taken > 0 if taken >= 0 else checked(taken)

    def estimate(self, time: int, after: int = NEVER) -> list[tuple[list[float], int] | None]:
        """Every axis at an instant [ns] by all measurements valid until then; nothing changes.

        Args:
            time: The instant.
            after: What is stamped later [ns] is as if it had not come.

        Returns:
            For each axis what :class:`.core.Output` has, in the stream's own coordinates and SI, and when the last
            measurement was valid that it knows of [ns]; None as long as the axis has no start level.
        """
        library.pf_live_estimate(self._core, time, after, *self._found)
        rows = zip(self._outputs.T.tolist(), self._fused.tolist(), strict=True)
        return [None if math.isnan(outputs[0]) else (outputs, fused) for outputs, fused in rows]

    def commands(self, until: int = NEVER) -> list[tuple[int, float, float] | None]:
        """Of each axis stamp [ns], value and step [m] of its last command stamped by ``until`` [ns]; None for none."""
        library.pf_live_commands(self._core, until, *self._commands)
        return [None if one[0] == NEVER else one for one in zip(*self._commands, strict=True)]

    def forget(self, after: int) -> None:
        """Take back all that is stamped after ``after`` [ns]: it was of another clock. The rest is added again."""
        checked(library.pf_live_forget(self._core, after))

    def count_late(self, sensor: int, stamp: int, newest: int) -> None:
        """Count a measurement that has come too late for the window; ``newest`` [ns] is the latest stamp of all."""
        library.pf_live_count_late(self._core, sensor, stamp, newest, 1)

    def uncount_late(self, sensor: int) -> None:
        """Take one back that is fed again."""
        library.pf_live_count_late(self._core, sensor, 0, 0, -1)

    def counters(self) -> Counters:
        """What there was of each sensor until now, with what is still in the window."""
        sensors, integer = self._sensors, np.int64
        now = Counters(
            np.empty((sensors, _COUNTS), integer),
            np.empty(sensors, integer),
            np.empty(sensors, integer),
            np.empty(sensors),
            np.empty((sensors, SECONDS), integer),
            np.empty((sensors, SECONDS, SCALARS + 1)),
        )
        checked(library.pf_live_counters(self._core, ctypes.byref(_Counters(*map(at, now)))))
        return now

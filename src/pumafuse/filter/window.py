"""The last seconds of a stream, and the filter at every one of their events."""

from __future__ import annotations

import ctypes
import math

import numpy as np

from ..arrays import NEVER, FloatArray, IndexArray, TimeArray
from .core import Handle, Model, Output, check, library, ptr, struct_of, struct_of_results
from .events import Results

MOST_ROWS = 65_536  # places for events
MOST_EVENTS = MOST_ROWS * 15 // 16  # what is more shortens the window: the rest is for what has left and may be read
FIRST_ROWS = 4096  # at first


class _Port(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("value", "spread", "outcome", "innovation", "innovation_sd")),
        *((name, ctypes.c_int64) for name in ("contradicts", "origin", "floor", "room", "begin", "end")),
    )
    value: int
    spread: int
    outcome: int
    innovation: int
    contradicts: int
    origin: int
    floor: int
    room: int
    begin: int
    end: int


class Window(Handle):
    """Takes events in any order; a new one is put where its time says, and the filter runs on from there.

    An event comes in through ``value`` and ``spread``, then :meth:`add`, which says which of their axes it
    gives; what became of these is in ``outcome`` then.

    Attributes:
        value: Of the event that comes in [m], (A,).
        spread: By what the noise of each of its values is scaled, 1 if nobody says otherwise, (A,).
        outcome: What became of its axes: codes of Outcome, or ``ABSENT`` for an axis that it does not give, (A,).
        innovation: ν of each value of a measurement [m], (A,).
        port: The core's own view of these: the sensor that the last measurement ``contradicts`` (−1 for none), the
            ``origin`` (the first command's stamp, int ns), the ``floor`` (what is stamped before is taken no more, as
            the stream was too dense), for how many rows there is ``room``, and which ones are there, ``begin`` to
            ``end``, counted from the first that ever came.
    """

    _free = library.pf_live_free

    def __init__(self, model: Model) -> None:
        """Empty."""
        super().__init__(library.pf_live_new(ctypes.byref(struct_of(model)), FIRST_ROWS, MOST_ROWS))
        self.port = port = _Port.from_address(library.pf_live_port(self._core))
        numbers, codes = ctypes.c_double * len(model.axis), ctypes.c_uint8 * len(model.axis)
        self.value, self.spread = numbers.from_address(port.value), numbers.from_address(port.spread)
        self.outcome = codes.from_address(port.outcome)
        self.innovation = numbers.from_address(port.innovation)
        self._outputs, self._fused = np.zeros((len(Output), len(model.axis))), np.zeros(len(model.axis), dtype=np.int64)
        self._answer = ptr(self._outputs), ptr(self._fused)

    @property
    def origin(self) -> int | None:
        """The first command's stamp, int ns; None before it."""
        origin = self.port.origin
        return None if origin == NEVER else origin

    def add(self, stamp: int, source: int, bits: int, oldest: int) -> bool:
        """Add an event whose axes are ``bits`` as bits; no event stamped before ``oldest`` will ever come [ns].

        Returns:
            False if to make room the window had to let go of its time.
        """
        taken = library.pf_live_add(self._core, stamp, source, bits, oldest)
        return taken > 0 if taken >= 0 else check(taken)

    def estimate(self, time: int, after: int = NEVER) -> list[tuple[list[float], int] | None]:
        """Every axis at an instant [ns] by all measurements valid until then; nothing changes.

        What is stamped ``after`` [ns] is as if it had not come. For each axis what :class:`.core.Output` has, in the
        stream's own coordinates and SI, and when the last measurement was valid that it knows of [ns]; None as long as
        the axis has no start level.
        """
        library.pf_live_estimate(self._core, time, after, *self._answer)
        rows = zip(self._outputs.T.tolist(), self._fused.tolist(), strict=True)
        return [None if math.isnan(outputs[0]) else (outputs, fused) for outputs, fused in rows]

    def read(self, begin: int, end: int) -> tuple[TimeArray, IndexArray, Results]:
        """Stamps [ns], sources and what became of some rows; those before the window's stay for ``room`` / 16 more."""
        stamp, source = np.empty(end - begin, dtype=np.int64), np.empty(end - begin, dtype=np.int16)
        results = Results.room(end - begin, len(self.value))
        library.pf_live_read(self._core, begin, end, ptr(stamp), ptr(source), struct_of_results(results))
        return stamp, source, results

    def forget(self, after: int) -> None:
        """Take back all that is stamped after ``after`` [ns]: it was of another clock."""
        library.pf_live_forget(self._core, after)

    def amend(self, sensor: int, stamp: TimeArray, before: FloatArray, now: FloatArray) -> None:
        """Change measurements of a sensor, stamped int64 ns, (n,), that are known better now.

        Their values and spreads as put in and as they are ``now`` are (n, 2 A); what had others stays as it is.
        """
        library.pf_live_amend(self._core, sensor, len(stamp), ptr(stamp), ptr(before), ptr(now))

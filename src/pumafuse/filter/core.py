"""The filter's core, a library in C++: its interface is ``core/include/pumafuse.h``, its algebra ``core/``.

Arrays go in and come out; they are the caller's. The interpreter is free while the core runs over a recording. Over a
live event it is not: beside a busy thread it would come back after milliseconds, for a call of microseconds.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import BoolArray, CodeArray, FloatArray, TimeArray
from ..errors import PumafuseError
from .events import Events, Results

VERSION = 13  # of the interface
FINEST = 1e-9  # PF_FINEST
LIBRARY = Path(__file__).with_name("_core" + {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so"))
Record = npt.NDArray[np.void]  # an array of structs


def _numbers(*names: str) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64) for name in names])


AXIS = _numbers(
    *("period", "delay", "time_constant", "natural_frequency", "damping", "slope", "intercept", "recovery"),
    *("max_speed", "play", "sag_offset", "sag_slope", "sag_knee", "sag_slope_beyond"),
    *("sag_knee_below", "sag_slope_below"),
    *("input_noise", "drift", "maneuver_noise", "maneuver_drift"),
    *("disturbance_sd", "disturbance_time", "smoothness", "adaptation", "offset_sd", "lag_sd", "gain_sd"),
    *("unseen_lag_sd", "start"),
)
SENSOR = _numbers("scale", "latency", "latency_sd", "gate", "gate_rows")
VIEW = _numbers("sd", "bias_sd", "bias_drift_sd", "bias_time", "turn")

MOTION = np.dtype([("time", np.int64), *_numbers("command", "step", "error", "position", "rate", "slack").descr])


class Output(IntEnum):
    """What an estimate says of an axis, relative to its start level; first index of outputs, (8, A, n)."""

    POSITION = 0  # p [m]
    POSITION_SD = 1
    VELOCITY = 2  # mean over the coming update period [m/s]
    VELOCITY_SD = 3
    OFFSET = 4  # o [m]
    OFFSET_SD = 5
    DISTURBANCE = 6  # d [m]; 0 where the model has none
    DISTURBANCE_SD = 7


class Model(NamedTuple):
    """What the filter knows of A axes and S sensors: records of ``pf_axis``, ``pf_sensor`` and ``pf_view``."""

    axis: Record  # (A,)
    sensor: Record  # (S,)
    view: Record  # what each sensor sees of each axis, (S, A)


def struct(counts: Sequence[str], arrays: Sequence[str]) -> type[ctypes.Structure]:
    """A struct of the interface: some counts, then some arrays."""
    integers, pointers = ([(name, kind) for name in names] for names, kind in ((counts, _INT64), (arrays, _POINTER)))
    return type("Struct", (ctypes.Structure,), {"_fields_": [*integers, *pointers]})


_INT64, _POINTER = ctypes.c_int64, ctypes.c_void_p
_Model = struct(["axes", "sensors"], Model._fields)
_Events = struct(["count"], Events._fields)
_Results = struct([], Results._fields)
_MODES = "filtered", "repeated", "as-live", "smoothed"
_KINDS = {"p": _POINTER, "n": _INT64, "d": ctypes.c_double, "i": ctypes.c_int, "u": ctypes.c_uint64}
_FUNCTIONS = {  # what each returns, then what it takes: pointers, int64, double, int, uint64; v: nothing
    "transition": "vpdp",
    "response": "inpnppnpp",
    "follow": "vppnppnpp",
    "whiten": "ipnppnppp",
    "weigh": "ipnppnpnppnpp",
    "classify": "ippnpp",
    "constant_velocity": "vnppnppp",
    "filter_new": "ppn",
    "filter_free": "vp",
    "filter_run": "ipipnnpnppp",
    "filter_bias": "ipnnp",
    "linearise": "ippnnpppp",
    "live_new": "ppnn",
    "live_free": "vp",
    "live_port": "pp",
    "live_add": "ipnnun",
    "live_estimate": "vpnnpp",
    "live_amend": "vpnnppp",
    "live_read": "vpnnppp",
    "live_forget": "vpn",
}


def _load() -> ctypes.CDLL:
    """The library, if it is of this version."""
    fix = "install pumafuse again (in a checkout: make .venv/.ready)"
    try:
        library, with_interpreter = ctypes.CDLL(str(LIBRARY)), ctypes.PyDLL(str(LIBRARY))
        if (version := library.pf_version()) != VERSION:
            raise PumafuseError(f"{LIBRARY}: the filter's core has interface {version}, this is for {VERSION}: {fix}")
        library.pf_error.restype = ctypes.c_char_p
        for name, (result, *arguments) in _FUNCTIONS.items():
            function = getattr(with_interpreter if name.startswith("live_") else library, f"pf_{name}")
            function.restype, function.argtypes = _KINDS.get(result), [_KINDS[argument] for argument in arguments]
            setattr(library, f"pf_{name}", function)
    except (OSError, AttributeError) as error:
        raise PumafuseError(f"{LIBRARY}: the filter's core does not load ({error}): {fix}") from None
    return library


library = _load()


def ptr(array: np.ndarray) -> int:
    """Where a contiguous array is in memory; the array must have a name for as long as the core uses it."""
    assert array.flags.c_contiguous
    return array.ctypes.data


def check(result: Any) -> Any:
    """What a call returned; an error if it failed."""
    if result is None or result < 0:
        raise PumafuseError(f"the filter stops: {library.pf_error().decode()}")
    return result


def struct_of(model: Model) -> ctypes.Structure:
    """A model as the core takes it; its arrays must live as long."""
    return _Model(len(model.axis), len(model.sensor), *map(ptr, model))


def struct_of_results(results: Results) -> Any:
    """Results as the core fills them; their arrays must live as long."""
    return ctypes.byref(_Results(*map(ptr, results)))


def _tables(events: Events, results: Results) -> tuple[Any, Any]:
    return ctypes.byref(_struct_of_events(events)), struct_of_results(results)


def _struct_of_events(events: Events) -> ctypes.Structure:
    return _Events(len(events.time), *(ptr(part) * (len(part) > 0) for part in events))


class Handle:
    """Owner of an object of the core, which is freed with it; it cannot be copied."""

    _free: Any

    def __init__(self, core: int | None) -> None:
        self._core: int | None = check(core)

    def __del__(self) -> None:
        if (core := getattr(self, "_core", None)) is not None:
            self._free(core)

    def __reduce__(self) -> Any:
        raise TypeError("a filter cannot be copied or pickled")


class Filter(Handle):
    """A filter over recorded events, whose state goes on from one call to the next."""

    _free = library.pf_filter_free

    def __init__(self, model: Model, origin: int) -> None:
        """At rest at the instant ``origin`` [ns]."""
        super().__init__(library.pf_filter_new(ctypes.byref(struct_of(model)), origin))
        self._axes = len(model.axis)

    def run(
        self,
        events: Events,
        results: Results,
        times: TimeArray,
        mode: Literal["filtered", "repeated", "as-live", "smoothed"] = "filtered",
        span: tuple[int, int] | None = None,
        asked: TimeArray | None = None,
    ) -> FloatArray:
        """Events in their order, and an estimate at each of ``times``, int64 ns, ascending, (n,).

        An estimate knows the events until then (``repeated``: by the outcomes in ``results``, whatever a gate would
        say), those that had arrived by then (or when it is ``asked`` for, int64 ns, (n,)), or all of them. Of a
        ``span`` from the first event to behind the last it knows commands behind it, too. ``results`` gets what became
        of each measurement.

        Returns:
            Outputs by :class:`Output`, axis and time, (8, A, n).
        """
        outputs, (table, rows) = np.zeros((len(Output), self._axes, len(times))), _tables(events, results)
        ends, when = span or (0, len(events.time)), None if asked is None else ptr(asked)
        wanted = len(times), ptr(times), when, ptr(outputs)
        check(library.pf_filter_run(self._core, _MODES.index(mode), table, *ends, rows, *wanted))
        return outputs

    def bias(self, sensor: int, axis: int) -> tuple[float, float] | None:
        """Mean and sd [m] of the constant bias of a sensor on an axis; None where none is in the state."""
        state = (ctypes.c_double * 2)()
        return (state[0], state[1]) if library.pf_filter_bias(self._core, sensor, axis, state) else None


def linearise(
    model: Model, tangents: Sequence[Model], origin: int, events: Events, results: Results
) -> tuple[FloatArray, FloatArray]:
    """Innovations while the outcomes in ``results`` are repeated, and how they change with k parameters.

    ``tangents`` are the derivatives of all numbers of the model by each parameter; ``origin`` is the first command's
    stamp [ns].

    Returns:
        Derivatives of ν and of S, (k, n, A) each.
    """
    d_nu, d_s = np.zeros((2, len(tangents), *events.codes.shape))
    models = struct_of(model), (_Model * len(tangents))(*map(struct_of, tangents))
    tables = *_tables(events, results), ptr(d_nu), ptr(d_s)
    check(library.pf_linearise(*map(ctypes.byref, models), len(tangents), origin, *tables))
    return d_nu, d_s


def classify(model: Model, events: Events, origin: int, too_late: BoolArray) -> CodeArray:
    """What each value of a table is before the filter sees it, (n, A).

    ``origin`` is the first command's stamp [ns]; rows that are ``too_late``, (n,), come far behind earlier ones.
    """
    codes = np.empty_like(events.codes)
    structs = ctypes.byref(struct_of(model)), ctypes.byref(_struct_of_events(events))
    check(library.pf_classify(*structs, origin, ptr(too_late), ptr(codes)))
    return codes


def transition(axis: Record, dt: float) -> FloatArray:
    """What an axis (1,) does over ``dt`` [s]: see ``pf_transition``, (17,)."""
    numbers = np.empty(17)
    library.pf_transition(ptr(axis), dt, ptr(numbers))
    return numbers


def constant_velocity(
    time: FloatArray, value: FloatArray, density: FloatArray, square: FloatArray, innovation: FloatArray | None = None
) -> None:
    """Constant-velocity filters with R = 1 on measurements (n,): see ``pf_constant_velocity``."""
    kept = None if innovation is None else ptr(innovation)
    library.pf_constant_velocity(len(time), ptr(time), ptr(value), len(density), ptr(density), ptr(square), kept)

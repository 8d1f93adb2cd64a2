"""How kernels are compiled: by numba, kept on disk, without fast-math, and announced to who waits the first time."""

from __future__ import annotations

from typing import TYPE_CHECKING, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    P = ParamSpec("P")
    R = TypeVar("R")

    def compiled(function: Callable[P, R]) -> Callable[P, R]:
        """A function compiled to machine code, a part of each kernel that calls it. Not to be called from Python."""
        ...

    def compiled_apart(function: Callable[P, R]) -> Callable[P, R]:
        """A function compiled to machine code once, for all kernels that call it. Not to be called from Python."""
        ...

    def inlined(function: Callable[P, R]) -> Callable[P, R]:
        """A function that stands, before anything is compiled, in the place of its only call. Not for Python."""
        ...

    def kernel(function: Callable[P, R]) -> Callable[P, R]:
        """A function compiled to machine code that is called from Python."""
        ...

else:
    import sys

    import numba
    from numba.core import event

    # Kernels own no arrays, so nothing in them is counted (`_nrt`), and calls within the algebra vanish
    # (`forceinline`): together that is a factor of twenty. What is called less often is compiled apart, once: a copy in
    # each caller would cost more time than it saves. Only kernels can be called from Python (`no_cpython_wrapper`):
    # to take so many arrays out of Python's objects takes longer to compile than most of them. A division by zero gives
    # an infinity, as in numpy.
    # A product and a sum stay two roundings: contracted to one, variances of extreme priors fall below 0.
    def _kept() -> bool:
        """Whether there is a place on disk for what is compiled: a service without a home may have none."""
        try:
            numba.njit(cache=True)(_kept)
        except RuntimeError:
            return False
        return True

    _KEPT = _kept()
    _OPTIONS = {"cache": _KEPT, "nogil": True, "error_model": "numpy", "_nrt": False, "no_cfunc_wrapper": True}
    compiled = numba.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)
    compiled_apart = numba.njit(no_cpython_wrapper=True, **_OPTIONS)
    inlined = numba.njit(inline="always", no_cpython_wrapper=True, **_OPTIONS)
    kernel = numba.njit(**_OPTIONS)
    _HOW_OFTEN = (
        "once for each part of it (some 10 s)"
        if _KEPT
        else "at each start (some 10 s), as there is no place to keep it: set NUMBA_CACHE_DIR to a folder"
    )

    class _Announcer(event.Listener):
        """Says once in a process that kernels are compiled; those found on disk are no event."""

        announced = False

        def on_start(self, event: event.Event) -> None:
            ours = event.data["dispatcher"].py_func.__module__.startswith(__package__)
            if ours and not self.announced:
                self.announced = True
                print(f"compiling the filter for this machine, {_HOW_OFTEN} ...", file=sys.stderr, flush=True)

        def on_end(self, event: event.Event) -> None:
            """Nothing to say."""

    event.register("numba:compile", _Announcer())

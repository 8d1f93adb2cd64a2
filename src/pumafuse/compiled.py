"""How kernels are compiled: by numba, kept on disk, without fast-math, and with a word to who waits the first time."""

from __future__ import annotations

from typing import TYPE_CHECKING, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    P = ParamSpec("P")
    R = TypeVar("R")

    def compiled(function: Callable[P, R]) -> Callable[P, R]:
        """A function compiled to machine code; called from Python or from another one."""
        ...

else:
    import sys

    import numba
    from numba.core import event

    # Kernels own no arrays, so nothing in them is counted (`_nrt`), and all calls between them vanish (`forceinline`):
    # together that is a factor of twenty. A division by zero gives an infinity, as in numpy.
    # A product and a sum stay two roundings: contracted to one, variances of extreme priors fall below 0.
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True, _nrt=False)

    class _Announcer(event.Listener):
        """Says once in a process that kernels are compiled; those found on disk are no event."""

        said = False

        def on_start(self, event: event.Event) -> None:
            ours = event.data["dispatcher"].py_func.__module__.startswith(__package__)
            if ours and not self.said:
                self.said = True
                print(
                    "compiling the filter for this machine, only this once (some 10 s) ...", file=sys.stderr, flush=True
                )

        def on_end(self, event: event.Event) -> None:
            """Nothing to say."""

    event.register("numba:compile", _Announcer())

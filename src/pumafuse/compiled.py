"""How kernels are compiled: by numba, kept on disk, without fast-math, and with a word to who waits the first time."""

from __future__ import annotations

import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    P = ParamSpec("P")
    R = TypeVar("R")

    def compiled(function: Callable[P, R]) -> Callable[P, R]:
        """A function compiled to machine code; called from Python or from another one."""
        ...

else:
    import numba

    # Kernels own no arrays, so nothing in them is counted (`_nrt`), and all calls between them vanish (`forceinline`):
    # together that is a factor of twenty. A division by zero gives an infinity, as in numpy.
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True, _nrt=False)

_PATIENCE = 1.5  # s; what is on disk loads in less


@contextmanager
def maybe_compiling(*kernels: object) -> Generator[None]:
    """Say on stderr that the kernels are being compiled, when one of them still is after more than a moment."""

    def tell() -> None:
        if any(not getattr(kernel, "signatures", True) for kernel in kernels):
            print("compiling the filter, once for this machine (about 20 s) ...", file=sys.stderr)

    timer = threading.Timer(_PATIENCE, tell)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()

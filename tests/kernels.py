"""Functions that are a part of kernels, made callable from Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def callable_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """A compiled function behind a kernel of its own."""

    @numba.njit(error_model="numpy")
    def called(*arguments: Any) -> Any:
        return function(*arguments)

    return called

"""How kernels are compiled: by numba, kept on disk, without fast-math; all at the first use, which is said."""

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
    import os
    import subprocess
    import sys
    from contextlib import suppress
    from pathlib import Path
    from typing import Any

    import numba
    from numba.core.caching import FunctionCache, NullCache

    # Kernels own no arrays, so nothing in them is counted (`_nrt`), and calls within the algebra vanish
    # (`forceinline`): together that is a factor of twenty. What is called less often is compiled apart, once: a copy in
    # each caller would cost more time than it saves. numba compiles each function for itself and again in each that
    # calls it; what it puts in the place of a call before (`inline`) it compiles once, but many of these at one place
    # make slower code. Only kernels can be called from Python (`no_cpython_wrapper`), and only they are kept on disk:
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

    class _Kept(FunctionCache):
        """What is kept of a kernel on disk. Where that is damaged, or the disk refuses, it is compiled anew."""

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            """The compiled kernel, or None where it is to be compiled here."""
            found = self._found(sig, target_context)
            if found is None and _first_use(self._py_func):
                _compile_all()
                found = self._found(sig, target_context)
            return found

        def _found(self, sig: Any, target_context: Any) -> Any:
            try:
                return super().load_overload(sig, target_context)
            except Exception as error:  # whatever a damaged pickle raises
                self._say("damaged", error)
                with suppress(OSError):
                    self.flush()
            return None

        def save_overload(self, sig: Any, data: Any) -> None:
            """Keep a kernel, where the disk takes it."""
            try:
                super().save_overload(sig, data)
            except Exception as error:
                self._say("not kept", error)

        def _say(self, what: str, error: Exception) -> None:
            print(f"{self.cache_path}: a compiled kernel is {what} ({error})", file=sys.stderr, flush=True)

    class _NotKept(NullCache):
        """Where there is no place on disk, each process compiles what it needs."""

        def __init__(self, function: Any) -> None:
            self.function = function

        def load_overload(self, *_: Any) -> None:
            """Nothing is ever found."""
            _first_use(self.function)

    _said: list[bool] = []

    def _first_use(function: Any) -> bool:
        """Whether this is the first kernel of ours that is not found. It says so."""
        if _said or _BESIDE in os.environ or not function.__module__.startswith(f"{__package__}."):
            return False
        _said.append(True)
        print(f"compiling the filter for this machine, {_HOW_OFTEN} ...", file=sys.stderr, flush=True)
        return True

    def _compile_all() -> None:
        """Compile every kernel in two processes, so that no other command has to wait when it is first used."""
        if not Path(sys.executable).stem.startswith("python"):  # within another program
            return
        environment = os.environ | {_BESIDE: "1", "PYTHONPATH": os.pathsep.join(sys.path)}
        nothing = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        words = [sys.executable, "-m", f"{__package__}.live.first_use"]
        halves = [subprocess.Popen([*words, half], env=environment, **nothing) for half in ("forward", "rest")]
        for half in halves:
            half.wait()

    def kernel(function):
        """A kernel whose compiled form is kept on disk, where there is a place."""
        dispatcher = numba.njit(**_OPTIONS)(function)
        dispatcher._cache = (_Kept if _KEPT else _NotKept)(function)
        return dispatcher

    _KEPT = _kept()
    _OPTIONS = {"nogil": True, "error_model": "numpy", "_nrt": False, "no_cfunc_wrapper": True}
    compiled = numba.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)
    compiled_apart = numba.njit(no_cpython_wrapper=True, **_OPTIONS)
    inlined = numba.njit(inline="always", no_cpython_wrapper=True, **_OPTIONS)
    _HOW_OFTEN = (
        "once (some 15 s)"
        if _KEPT
        else "at each start (some 15 s), as there is no place to keep it: set NUMBA_CACHE_DIR to a folder"
    )
    _BESIDE = "PUMAFUSE_COMPILES_BESIDE"  # set in the environment of processes that compile for another one

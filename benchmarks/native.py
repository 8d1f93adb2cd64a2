"""Builds and calls loop.cpp."""

from __future__ import annotations

import ctypes
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from model import PLANT, Array, Filtered, Model, Problem, Smoothed

SOURCE = Path(__file__).with_name("loop.cpp")
BUILT = SOURCE.parent / ".build" / "loop.so"
FLAGS = ("-O3", "-march=native", "-shared", "-fPIC", "-pthread")


@cache
def library() -> ctypes.CDLL:
    """The loop, built anew when its source is younger."""
    if not BUILT.exists() or BUILT.stat().st_mtime < SOURCE.stat().st_mtime:
        BUILT.parent.mkdir(exist_ok=True)
        subprocess.run(["g++", *FLAGS, str(SOURCE), "-o", str(BUILT)], check=True)
    return ctypes.CDLL(str(BUILT))


def _pointer(array: npt.NDArray[np.float64]) -> ctypes.c_void_p:
    assert array.flags.c_contiguous and array.dtype == np.float64
    return ctypes.c_void_p(array.ctypes.data)


def pack(*models: Model) -> Array:
    """The models as the loop's structs, one a row."""
    return np.array([np.concatenate([m.F.ravel(), m.B, m.H, m.Q.ravel(), [m.R], m.start.ravel()]) for m in models])


def empty_filtered(problem: Problem, size: int) -> Filtered:
    """Arrays for `filter_into`, with covariances of ``size`` states; 1 is for the position alone."""
    shape = problem.z.shape
    return Filtered(
        np.empty((*shape, len(problem.model.F) if size > 1 else 1)),
        np.empty((*shape, size, size)),
        np.empty(shape),
        np.empty(shape),
        np.empty(shape[:-1]),
    )


def filter_into(out: Filtered, model: Array, problem: Problem, threads: int = 1) -> Filtered:
    """Filters into ``out`` and returns it; its covariances say which of the loops runs."""
    names = {len(problem.model.F): "filter_dense", PLANT: "filter_block", 1: "filter_position"}
    run = library()[names[out.cov.shape[-1]]]
    steps = problem.z.shape[-1]
    arrays = (out.mean, out.cov, out.innovation, out.innovation_variance, out.log_likelihood)
    run(
        _pointer(model),
        ctypes.c_long(problem.z.size // steps),
        ctypes.c_long(steps),
        *map(_pointer, (problem.u, problem.z, *arrays)),
        threads,
    )
    return out


def likelihoods(models: Array, problem: Problem, block: bool, threads: int = 1) -> Array:
    """Log-likelihood per row of ``models``, (rows,)."""
    run = library().likelihood_block if block else library().likelihood_dense
    out = np.empty(len(models))
    count, steps = ctypes.c_long(len(models)), ctypes.c_long(len(problem.z))
    run(_pointer(models), count, steps, *map(_pointer, (problem.u, problem.z, out)), threads)
    return out


def smooth(model: Array, problem: Problem) -> Smoothed:
    """Bryson-Frazier smoothing of one run."""
    steps, n = len(problem.z), len(problem.model.F)
    out = Smoothed(np.empty((steps, n)), np.empty((steps, n, n)))
    arrays = (problem.u, problem.z, out.mean, out.cov)
    library().smooth_dense(_pointer(model), ctypes.c_long(steps), *map(_pointer, arrays))
    return out

from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt

class OptimizeResult:
    x: npt.NDArray[np.float64]
    cost: float
    fun: float

def least_squares(
    fun: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]],
    x0: npt.ArrayLike,
    *,
    bounds: tuple[npt.ArrayLike, npt.ArrayLike] = ...,
    x_scale: Literal["jac"] | npt.NDArray[np.float64],
    xtol: float,
    ftol: float,
    gtol: float,
    max_nfev: int,
) -> OptimizeResult: ...
def brentq(f: Callable[[float], float], a: float, b: float, *, rtol: float = ...) -> float: ...
def lsq_linear(
    A: npt.NDArray[np.float64],
    b: npt.NDArray[np.float64],
    bounds: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]],
    *,
    method: Literal["bvls", "trf"],
) -> OptimizeResult: ...
def minimize(
    fun: Callable[[npt.NDArray[np.float64]], float],
    x0: npt.NDArray[np.float64],
    *,
    method: Literal["SLSQP"],
    bounds: npt.NDArray[np.float64],
    options: dict[str, float],
) -> OptimizeResult: ...

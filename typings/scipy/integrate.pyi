from collections.abc import Callable, Sequence
from typing import Any, Literal

from pumafuse.arrays import FloatArray

class OdeResult:
    y: FloatArray
    y_events: list[FloatArray]

def solve_ivp(
    fun: Callable[[float, FloatArray], Sequence[float]],
    t_span: tuple[float, float],
    y0: FloatArray,
    method: Literal["LSODA"],
    *,
    events: Callable[[float, FloatArray], float],
    rtol: float,
    atol: float,
) -> OdeResult: ...
def odeint(
    func: Callable[..., Sequence[float]],
    y0: FloatArray,
    t: FloatArray,
    args: tuple[Any, ...],
    *,
    rtol: float,
    atol: float,
) -> FloatArray: ...

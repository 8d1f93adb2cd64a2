"""The parts of scipy.interpolate that pumafuse uses."""

from typing import Literal

from numpy import float64
from numpy.typing import NDArray

type _Floats = NDArray[float64]

class BSpline:
    def __call__(self, x: _Floats) -> _Floats: ...

class PPoly:
    def __init__(self, c: _Floats, x: _Floats) -> None: ...
    def __call__(self, x: _Floats) -> _Floats: ...
    def antiderivative(self, nu: int = 1) -> PPoly: ...

def make_lsq_spline(x: _Floats, y: _Floats, t: _Floats, *, method: Literal["qr", "norm-eq"] = "qr") -> BSpline: ...

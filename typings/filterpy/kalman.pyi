import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

class KalmanFilter:
    x: _Floats
    P: _Floats
    Q: _Floats
    R: _Floats
    F: _Floats
    H: _Floats
    B: _Floats | None
    K: _Floats
    y: _Floats
    S: _Floats
    def __init__(self, dim_x: int, dim_z: int, dim_u: int = ...) -> None: ...
    def predict(
        self,
        u: _Floats | float | None = ...,
        B: _Floats | None = ...,
        F: _Floats | None = ...,
        Q: _Floats | None = ...,
    ) -> None: ...
    def update(self, z: _Floats | float | None, R: _Floats | float | None = ..., H: _Floats | None = ...) -> None: ...

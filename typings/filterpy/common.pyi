import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

def van_loan_discretization(F: _Floats, G: _Floats, dt: float) -> tuple[_Floats, _Floats]: ...

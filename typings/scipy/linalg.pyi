import numpy as np
import numpy.typing as npt

def expm(A: npt.ArrayLike) -> npt.NDArray[np.float64]: ...
def solve_triangular(
    a: npt.NDArray[np.float64], b: npt.NDArray[np.float64], *, lower: bool
) -> npt.NDArray[np.float64]: ...

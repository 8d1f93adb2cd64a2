import numpy as np
import numpy.typing as npt

def expm(A: npt.ArrayLike) -> npt.NDArray[np.float64]: ...

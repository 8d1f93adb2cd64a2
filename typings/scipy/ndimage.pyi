import numpy as np
import numpy.typing as npt

def median_filter(
    input: npt.NDArray[np.float64], *, size: int | tuple[int, ...], mode: str
) -> npt.NDArray[np.float64]: ...

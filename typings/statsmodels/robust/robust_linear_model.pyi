import numpy as np
import numpy.typing as npt

class RLMResults:
    params: npt.NDArray[np.float64]
    bse: npt.NDArray[np.float64]

class RLM:
    def __init__(self, endog: npt.NDArray[np.float64], exog: npt.NDArray[np.float64]) -> None: ...
    def fit(self, maxiter: int = ...) -> RLMResults: ...

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

class RegressionModel:
    endog: Array
    weights: Array

class RegressionResults:
    model: RegressionModel
    params: Array
    ssr: float
    df_resid: float
    df_model: float
    def conf_int(self) -> Array: ...
    def compare_f_test(self, restricted: RegressionResults) -> tuple[float, float, float]: ...

class OLS:
    def __init__(self, endog: Array, exog: Array) -> None: ...
    def fit(self) -> RegressionResults: ...

class WLS:
    def __init__(self, endog: Array, exog: Array, weights: Array) -> None: ...
    def fit(self) -> RegressionResults: ...

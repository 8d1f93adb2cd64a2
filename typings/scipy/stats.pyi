from typing import Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

class TestResult:
    statistic: float
    pvalue: float

class Continuous:
    def sf(self, x: float, dfn: float, dfd: float) -> float: ...
    def ppf(self, q: float, dfn: float, dfd: float) -> float: ...

f: Continuous

def f_oneway(*samples: Array, equal_var: bool = True) -> TestResult: ...
def shapiro(x: Array) -> TestResult: ...
def median_abs_deviation(x: Array, *, scale: Literal["normal"]) -> float: ...

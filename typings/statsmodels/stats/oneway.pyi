from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

class AnovaResult:
    pvalue: float

def anova_oneway(data: Sequence[npt.NDArray[np.float64]], use_var: Literal["unequal"]) -> AnovaResult: ...

from typing import Any

class StateSpace:
    A: Any
    B: Any
    C: Any
    D: Any
    dt: float

class TransferFunction:
    num: Any
    den: Any

def ss(*args: Any, **kwargs: Any) -> StateSpace: ...
def tf(*args: Any, **kwargs: Any) -> TransferFunction: ...

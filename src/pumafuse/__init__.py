"""Kalman-filter fusion of a robot arm's commands with the readings of an external sensor.

The public names, imported only when used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .errors import ConfigError, PumafuseError, PumafuseWarning, RunError, UnknownNameError
    from .fusion.config import FusionConfig, Process, Sensor, Start
    from .fusion.estimates import Estimates, Readings
    from .fusion.offline import fuse
    from .fusion.score import Score, score
    from .fusion.timeline import Outcome
    from .fusion.track import AxisEstimate
    from .model.arm import ArmModel, AxisModel, Gain, Validity
    from .model.discrete import DiscreteModel, discretize
    from .model.plants import FirstOrder, SecondOrder
    from .runs.run import Run
    from .views.rerun import to_rerun

_HOME = {
    "ArmModel": "model.arm",
    "AxisEstimate": "fusion.track",
    "AxisModel": "model.arm",
    "ConfigError": "errors",
    "DiscreteModel": "model.discrete",
    "Estimates": "fusion.estimates",
    "FirstOrder": "model.plants",
    "FusionConfig": "fusion.config",
    "Gain": "model.arm",
    "Outcome": "fusion.timeline",
    "Process": "fusion.config",
    "PumafuseError": "errors",
    "PumafuseWarning": "errors",
    "Readings": "fusion.estimates",
    "Run": "runs.run",
    "RunError": "errors",
    "Score": "fusion.score",
    "SecondOrder": "model.plants",
    "Sensor": "fusion.config",
    "Start": "fusion.config",
    "UnknownNameError": "errors",
    "Validity": "model.arm",
    "discretize": "model.discrete",
    "fuse": "fusion.offline",
    "score": "fusion.score",
    "to_rerun": "views.rerun",
}

__all__ = [
    "ArmModel",
    "AxisEstimate",
    "AxisModel",
    "ConfigError",
    "DiscreteModel",
    "Estimates",
    "FirstOrder",
    "FusionConfig",
    "Gain",
    "Outcome",
    "Process",
    "PumafuseError",
    "PumafuseWarning",
    "Readings",
    "Run",
    "RunError",
    "Score",
    "SecondOrder",
    "Sensor",
    "Start",
    "UnknownNameError",
    "Validity",
    "discretize",
    "fuse",
    "score",
    "to_rerun",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'pumafuse' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__

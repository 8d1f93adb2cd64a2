"""Kalman-filter fusion of a robot arm's commands with the measurements of an external sensor.

The public names, imported only when used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .errors import ConfigError, PumafuseError, PumafuseWarning, RunError, UnknownNameError
    from .filter.outcome import Outcome
    from .fusion.config import FusionConfig, Process, Sensor, Start
    from .fusion.estimates import AxisEstimate, Estimates, Measurements
    from .fusion.offline import fuse
    from .fusion.score import Score, score
    from .fusion.summary import Summary, summarise
    from .identification.identify import Identification, identify
    from .identification.trials import StepTrials, TrialsError
    from .identification.verify import AxisVerification, verify
    from .live.estimator import LiveEstimator
    from .live.results import AxisNow, Health, LiveEstimate, SensorHealth, UpdateResult
    from .logs.run import Run
    from .model.arm import ArmModel, AxisModel, Gain, Validity
    from .model.discrete import DiscreteModel, discretize
    from .model.plants import FirstOrder, SecondOrder
    from .simulation.scenario import Scenario
    from .simulation.simulate import Simulated, simulate
    from .tuning.identifiability import TuneError
    from .tuning.tune import Tuning, tune
    from .views.rerun import to_rerun

_HOME = {
    "ArmModel": "model.arm",
    "AxisEstimate": "fusion.estimates",
    "AxisModel": "model.arm",
    "AxisNow": "live.results",
    "AxisVerification": "identification.verify",
    "ConfigError": "errors",
    "DiscreteModel": "model.discrete",
    "Estimates": "fusion.estimates",
    "FirstOrder": "model.plants",
    "FusionConfig": "fusion.config",
    "Gain": "model.arm",
    "Health": "live.results",
    "Identification": "identification.identify",
    "LiveEstimate": "live.results",
    "LiveEstimator": "live.estimator",
    "Outcome": "filter.outcome",
    "Process": "fusion.config",
    "PumafuseError": "errors",
    "PumafuseWarning": "errors",
    "Measurements": "fusion.estimates",
    "Run": "logs.run",
    "RunError": "errors",
    "Scenario": "simulation.scenario",
    "Score": "fusion.score",
    "SecondOrder": "model.plants",
    "Sensor": "fusion.config",
    "SensorHealth": "live.results",
    "Simulated": "simulation.simulate",
    "Start": "fusion.config",
    "StepTrials": "identification.trials",
    "Summary": "fusion.summary",
    "UpdateResult": "live.results",
    "TrialsError": "identification.trials",
    "TuneError": "tuning.identifiability",
    "Tuning": "tuning.tune",
    "UnknownNameError": "errors",
    "Validity": "model.arm",
    "discretize": "model.discrete",
    "fuse": "fusion.offline",
    "identify": "identification.identify",
    "score": "fusion.score",
    "simulate": "simulation.simulate",
    "summarise": "fusion.summary",
    "to_rerun": "views.rerun",
    "tune": "tuning.tune",
    "verify": "identification.verify",
}

__all__ = [
    "ArmModel",
    "AxisEstimate",
    "AxisModel",
    "AxisNow",
    "AxisVerification",
    "ConfigError",
    "DiscreteModel",
    "Estimates",
    "FirstOrder",
    "FusionConfig",
    "Gain",
    "Health",
    "Identification",
    "LiveEstimate",
    "LiveEstimator",
    "Measurements",
    "Outcome",
    "Process",
    "PumafuseError",
    "PumafuseWarning",
    "Run",
    "RunError",
    "Scenario",
    "Score",
    "SecondOrder",
    "Sensor",
    "SensorHealth",
    "Simulated",
    "Start",
    "StepTrials",
    "Summary",
    "TrialsError",
    "TuneError",
    "Tuning",
    "UnknownNameError",
    "UpdateResult",
    "Validity",
    "discretize",
    "fuse",
    "identify",
    "score",
    "simulate",
    "summarise",
    "to_rerun",
    "tune",
    "verify",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'pumafuse' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__

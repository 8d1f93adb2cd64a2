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
    from .tuning.latency import Latency, latency
    from .tuning.tune import Tuning, tune
    from .views.rerun import to_rerun

_NAMES = {
    "errors": ["ConfigError", "PumafuseError", "PumafuseWarning", "RunError", "UnknownNameError"],
    "filter.outcome": ["Outcome"],
    "fusion.config": ["FusionConfig", "Process", "Sensor", "Start"],
    "fusion.estimates": ["AxisEstimate", "Estimates", "Measurements"],
    "fusion.offline": ["fuse"],
    "fusion.score": ["Score", "score"],
    "fusion.summary": ["Summary", "summarise"],
    "identification.identify": ["Identification", "identify"],
    "identification.trials": ["StepTrials", "TrialsError"],
    "identification.verify": ["AxisVerification", "verify"],
    "live.estimator": ["LiveEstimator"],
    "live.results": ["AxisNow", "Health", "LiveEstimate", "SensorHealth", "UpdateResult"],
    "logs.run": ["Run"],
    "model.arm": ["ArmModel", "AxisModel", "Gain", "Validity"],
    "model.discrete": ["DiscreteModel", "discretize"],
    "model.plants": ["FirstOrder", "SecondOrder"],
    "simulation.scenario": ["Scenario"],
    "simulation.simulate": ["Simulated", "simulate"],
    "tuning.identifiability": ["TuneError"],
    "tuning.latency": ["Latency", "latency"],
    "tuning.tune": ["Tuning", "tune"],
    "views.rerun": ["to_rerun"],
}
_HOME = {name: home for home, names in _NAMES.items() for name in names}

__all__ = [
    "ArmModel", "AxisEstimate", "AxisModel", "AxisNow", "AxisVerification", "ConfigError", "DiscreteModel",
    "Estimates", "FirstOrder", "FusionConfig", "Gain", "Health", "Identification", "Latency", "LiveEstimate",
    "LiveEstimator", "Measurements", "Outcome", "Process", "PumafuseError", "PumafuseWarning", "Run", "RunError",
    "Scenario", "Score", "SecondOrder", "Sensor", "SensorHealth", "Simulated", "Start", "StepTrials", "Summary",
    "TrialsError", "TuneError", "Tuning", "UnknownNameError", "UpdateResult", "Validity", "discretize", "fuse",
    "identify", "latency", "score", "simulate", "summarise", "to_rerun", "tune", "verify",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'pumafuse' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__

"""Kalman-filter fusion of a robot arm's commands with the measurements of an external sensor.

The public names, imported only when used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .errors import ConfigError, PumafuseError, PumafuseWarning, RunError, UnknownNameError
    from .fusion.config import FusionConfig, Process, Sensor, Start
    from .fusion.estimates import Estimates, Measurements
    from .fusion.offline import fuse
    from .fusion.outcome import Outcome
    from .fusion.score import Score, score
    from .fusion.summary import Summary, summarise
    from .fusion.ticks import TickEstimates, filter_ticks, smooth_ticks, tick_likelihood
    from .fusion.track import AxisEstimate
    from .identification.identify import Identification, identify
    from .identification.trials import StepTrials, TrialsError
    from .identification.verify import AxisVerification, verify
    from .live.answers import AxisNow, LiveEstimate, UpdateResult
    from .live.estimator import LiveEstimator
    from .live.health import Health, SensorHealth
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
    "AxisEstimate": "fusion.track",
    "AxisModel": "model.arm",
    "AxisNow": "live.answers",
    "AxisVerification": "identification.verify",
    "ConfigError": "errors",
    "DiscreteModel": "model.discrete",
    "Estimates": "fusion.estimates",
    "FirstOrder": "model.plants",
    "FusionConfig": "fusion.config",
    "Gain": "model.arm",
    "Health": "live.health",
    "Identification": "identification.identify",
    "LiveEstimate": "live.answers",
    "LiveEstimator": "live.estimator",
    "Outcome": "fusion.outcome",
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
    "SensorHealth": "live.health",
    "Simulated": "simulation.simulate",
    "Start": "fusion.config",
    "StepTrials": "identification.trials",
    "Summary": "fusion.summary",
    "TickEstimates": "fusion.ticks",
    "UpdateResult": "live.answers",
    "TrialsError": "identification.trials",
    "TuneError": "tuning.identifiability",
    "Tuning": "tuning.tune",
    "UnknownNameError": "errors",
    "Validity": "model.arm",
    "discretize": "model.discrete",
    "filter_ticks": "fusion.ticks",
    "fuse": "fusion.offline",
    "identify": "identification.identify",
    "score": "fusion.score",
    "simulate": "simulation.simulate",
    "smooth_ticks": "fusion.ticks",
    "summarise": "fusion.summary",
    "tick_likelihood": "fusion.ticks",
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
    "TickEstimates",
    "TrialsError",
    "TuneError",
    "Tuning",
    "UnknownNameError",
    "UpdateResult",
    "Validity",
    "discretize",
    "filter_ticks",
    "fuse",
    "identify",
    "score",
    "simulate",
    "smooth_ticks",
    "summarise",
    "tick_likelihood",
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

"""Kalman-filter fusion of a robot arm's commands with the readings of an external sensor.

The public names, imported only when used.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .errors import ConfigError, PumafuseError, PumafuseWarning, RunError, UnknownNameError
    from .fusion.config import FusionConfig, Process, Sensor, Start
    from .fusion.estimates import Estimates, Readings
    from .fusion.offline import fuse
    from .fusion.outcome import Outcome
    from .fusion.score import Score, score
    from .fusion.summary import Summary, summarise
    from .fusion.ticks import TickEstimates, filter_ticks, smooth_ticks, tick_likelihood
    from .fusion.track import AxisEstimate
    from .identify.identify import Identification, identify
    from .identify.trials import StepTrials, TrialsError
    from .identify.verify import AxisVerification, verify
    from .live.answers import AxisNow, LiveEstimate, Told
    from .live.estimator import LiveEstimator
    from .live.health import Health, SensorHealth
    from .model.arm import ArmModel, AxisModel, Gain, Validity
    from .model.discrete import DiscreteModel, discretize
    from .model.plants import FirstOrder, SecondOrder
    from .runs.run import Run
    from .simulate.scenario import Scenario
    from .simulate.simulate import Simulated, simulate
    from .tune.learnable import TuneError
    from .tune.tune import Tuning, tune
    from .views.rerun import to_rerun

_HOME = {
    "ArmModel": "model.arm",
    "AxisEstimate": "fusion.track",
    "AxisModel": "model.arm",
    "AxisNow": "live.answers",
    "AxisVerification": "identify.verify",
    "ConfigError": "errors",
    "DiscreteModel": "model.discrete",
    "Estimates": "fusion.estimates",
    "FirstOrder": "model.plants",
    "FusionConfig": "fusion.config",
    "Gain": "model.arm",
    "Health": "live.health",
    "Identification": "identify.identify",
    "LiveEstimate": "live.answers",
    "LiveEstimator": "live.estimator",
    "Outcome": "fusion.outcome",
    "Process": "fusion.config",
    "PumafuseError": "errors",
    "PumafuseWarning": "errors",
    "Readings": "fusion.estimates",
    "Run": "runs.run",
    "RunError": "errors",
    "Scenario": "simulate.scenario",
    "Score": "fusion.score",
    "SecondOrder": "model.plants",
    "Sensor": "fusion.config",
    "SensorHealth": "live.health",
    "Simulated": "simulate.simulate",
    "Start": "fusion.config",
    "StepTrials": "identify.trials",
    "Summary": "fusion.summary",
    "TickEstimates": "fusion.ticks",
    "Told": "live.answers",
    "TrialsError": "identify.trials",
    "TuneError": "tune.learnable",
    "Tuning": "tune.tune",
    "UnknownNameError": "errors",
    "Validity": "model.arm",
    "discretize": "model.discrete",
    "filter_ticks": "fusion.ticks",
    "fuse": "fusion.offline",
    "identify": "identify.identify",
    "score": "fusion.score",
    "simulate": "simulate.simulate",
    "smooth_ticks": "fusion.ticks",
    "summarise": "fusion.summary",
    "tick_likelihood": "fusion.ticks",
    "to_rerun": "views.rerun",
    "tune": "tune.tune",
    "verify": "identify.verify",
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
    "Outcome",
    "Process",
    "PumafuseError",
    "PumafuseWarning",
    "Readings",
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
    "Told",
    "TrialsError",
    "TuneError",
    "Tuning",
    "UnknownNameError",
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


class _Package(ModuleType):
    """Keeps a room from hiding the function of its name: importing `pumafuse.simulate` would make `pf.simulate` it."""

    def __setattr__(self, name: str, value: object) -> None:
        if name not in _HOME or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'pumafuse' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__

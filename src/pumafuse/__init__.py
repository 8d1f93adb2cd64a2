"""Kalman-filter fusion of a robot arm's commands with the measurements of an external sensor.

The public names, imported only when used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .errors import ConfigError, PumafuseError, PumafuseWarning, RunError, UnknownNameError
    from .filter.events import Events
    from .filter.outcome import Outcome
    from .fusion.config import FusionConfig, Placement, Process, Sensor, Start, Tool
    from .fusion.estimates import AxisEstimate, Bias, Estimates, Measurements
    from .fusion.offline import fuse
    from .fusion.pose import Pose
    from .fusion.score import OrientationScore, ReferenceTrack, Score, score
    from .fusion.segments import Segment
    from .fusion.skill import Skill
    from .fusion.summary import (
        AxisSummary,
        FoundCause,
        ScoreSummary,
        SensorSummary,
        Summary,
        ValiditySummary,
        summarise,
    )
    from .identification.identify import CombinedAxis, Identification, TrialResult, identify
    from .identification.trials import StepTrials, Trial, TrialsError
    from .identification.verify import AxisVerification, BestInClass, ModelFit, Trace, verify
    from .live.estimator import EventLog, LiveEstimator
    from .live.health import Health, SensorHealth
    from .live.results import AxisNow, LiveEstimate, UpdateResult
    from .logs.frames import Cylindrical, Placed, Rotated
    from .logs.manifest import Robot
    from .logs.run import Run, Source
    from .model.arm import ArmModel, AxisModel, Gain, Joint, Sag, Validity
    from .model.discrete import DiscreteModel, discretize
    from .model.plants import FirstOrder, Plant, SecondOrder
    from .registration.register import Registered
    from .registration.runs import RegisteredSensor, Registrations, RegistrationSummary, register
    from .simulation.scenario import Scenario
    from .simulation.simulate import Simulated, simulate
    from .simulation.true_arm import TrueAxis
    from .space.kinematics import Joints
    from .tuning.identifiability import TuneError
    from .tuning.intervals import Profile
    from .tuning.latency import AxisLag, Latency, LatencySummary, PartLag, SensorLag, latency
    from .tuning.summary import Fitted, FittedLag, TuningSummary
    from .tuning.tune import Tuning, tune
    from .units import Screen
    from .views.figures import error_figure, fused_figure, validation_figure
    from .views.rerun import to_rerun

_NAMES = {  # by module
    "errors": "ConfigError PumafuseError PumafuseWarning RunError UnknownNameError",
    "filter.events": "Events",
    "filter.outcome": "Outcome",
    "fusion.config": "FusionConfig Placement Process Sensor Start Tool",
    "fusion.estimates": "AxisEstimate Bias Estimates Measurements",
    "fusion.offline": "fuse",
    "fusion.pose": "Pose",
    "fusion.score": "OrientationScore ReferenceTrack Score score",
    "fusion.segments": "Segment",
    "fusion.skill": "Skill",
    "fusion.summary": "AxisSummary FoundCause ScoreSummary SensorSummary Summary ValiditySummary summarise",
    "identification.identify": "CombinedAxis Identification TrialResult identify",
    "identification.trials": "StepTrials Trial TrialsError",
    "identification.verify": "AxisVerification BestInClass ModelFit Trace verify",
    "live.estimator": "EventLog LiveEstimator",
    "live.health": "Health SensorHealth",
    "live.results": "AxisNow LiveEstimate UpdateResult",
    "logs.frames": "Cylindrical Placed Rotated",
    "logs.manifest": "Robot",
    "logs.run": "Run",
    "logs.source": "Source",
    "model.arm": "ArmModel AxisModel Gain Joint Sag Validity",
    "model.discrete": "DiscreteModel discretize",
    "model.plants": "FirstOrder Plant SecondOrder",
    "registration.register": "Registered",
    "registration.runs": "RegisteredSensor RegistrationSummary Registrations register",
    "simulation.scenario": "Scenario",
    "simulation.simulate": "Simulated simulate",
    "simulation.true_arm": "TrueAxis",
    "space.kinematics": "Joints",
    "tuning.identifiability": "TuneError",
    "tuning.intervals": "Profile",
    "tuning.latency": "AxisLag Latency LatencySummary PartLag SensorLag latency",
    "tuning.summary": "Fitted FittedLag TuningSummary",
    "tuning.tune": "Tuning tune",
    "units": "Screen",
    "views.figures": "error_figure fused_figure validation_figure",
    "views.rerun": "to_rerun",
}
_HOME = {name: home for home, names in _NAMES.items() for name in names.split()}

__all__ = [
    "ArmModel", "AxisEstimate", "AxisLag", "AxisModel", "AxisNow", "AxisSummary", "AxisVerification", "BestInClass",
    "Bias", "CombinedAxis", "ConfigError", "Cylindrical", "DiscreteModel", "Estimates", "EventLog",
    "Events", "FirstOrder", "Fitted", "FittedLag", "FoundCause", "FusionConfig", "Gain", "Health", "Identification",
    "Joint", "Joints", "Latency", "LatencySummary", "LiveEstimate", "LiveEstimator", "Measurements", "ModelFit",
    "OrientationScore", "Outcome", "PartLag", "Placed", "Placement", "Plant", "Pose",
    "Process", "Profile", "PumafuseError", "PumafuseWarning", "ReferenceTrack", "Registered", "RegisteredSensor",
    "RegistrationSummary", "Registrations", "Robot", "Rotated", "Run", "RunError", "Sag", "Scenario", "Score",
    "ScoreSummary", "Screen", "SecondOrder", "Segment", "Sensor", "SensorHealth", "SensorLag", "SensorSummary",
    "Simulated", "Skill", "Source", "Start", "StepTrials", "Summary", "Tool", "Trace", "Trial", "TrialResult",
    "TrialsError", "TrueAxis", "TuneError", "Tuning", "TuningSummary", "UnknownNameError", "UpdateResult",
    "Validity", "ValiditySummary", "discretize", "error_figure", "fuse", "fused_figure", "identify", "latency",
    "register", "score", "simulate", "summarise", "to_rerun", "tune", "validation_figure", "verify",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'pumafuse' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__

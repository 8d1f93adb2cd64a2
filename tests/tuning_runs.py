"""Shared by the tests of tuning: short simulated runs, and configurations that are wrong about them."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec
import pytest

import pumafuse as pf
from pumafuse.simulation.true_sensor import Outliers
from pumafuse.tuning.intervals import ConfidenceInterval, confidence_intervals
from pumafuse.tuning.likelihood import Likelihood
from pumafuse.tuning.parameters import Fit, Parameter, changed, parameters
from pumafuse.tuning.stage import Plan, Stage, run_stage
from pumafuse.tuning.summary import Fitted

LONG = pytest.mark.long
SCENARIOS = Path(__file__).parent.parent / "scenarios"
ALL: tuple[Fit, ...] = ("noise", "delay", "plant", "gain", "latency")
T = TypeVar("T")
replaced = msgspec.structs.replace


def scenario(name: str, width: float | None = None, height: float | None = None, **changes: object) -> pf.Scenario:
    """A shipped scenario, on a panel of another size [m], and with other changes."""
    found = pf.Scenario.load(SCENARIOS / f"{name}.toml")
    sizes = {"width": width, "height": height}
    trajectory = replaced(found.trajectory, **{key: size for key, size in sizes.items() if size is not None})
    return replaced(found, trajectory=trajectory, **changes)


def with_outliers(seed: int, share: float = 0.03) -> pf.Simulated:
    """A camera on two axes for 4 seconds: some 105 rows, a few of them 5 to 20 mm off."""
    found = scenario("panel-vision", 0.1, 0.02)
    wild = Outliers(share=share, smallest=0.005, largest=0.02)
    camera = replaced(found.sensors["vision"], outliers=wild, dropouts=0.0)
    return pf.simulate(replaced(found, sensors={"vision": camera}), seed)


def outage(seed: int) -> pf.Simulated:
    """Tracker and camera on two axes for 4 seconds."""
    return pf.simulate(scenario("panel-tracker-outage", 0.1, 0.02), seed)


def with_sensors(config: pf.FusionConfig, *names: str, **changes: object) -> pf.FusionConfig:
    """The configuration with the same changes of these sensors, of all for none."""
    chosen = names or tuple(config.sensors)
    each = {name: replaced(one, **changes) if name in chosen else one for name, one in config.sensors.items()}
    return replaced(config, sensors=each)


def with_order(config: pf.FusionConfig, axis: str, order: int) -> pf.FusionConfig:
    """The configuration with an axis's plant of this order and of the same lag."""
    plant = config.arm.axes[axis].plant
    if (1 if isinstance(plant, pf.FirstOrder) else 2) == order:
        return config
    lag = plant.lag
    plant = pf.FirstOrder(time_constant=lag) if order == 1 else pf.SecondOrder(natural_frequency=2.0 / lag, damping=1.0)
    return changed(config, ("arm", "axes", axis, "plant"), plant)


def with_process(config: pf.FusionConfig, **changes: float) -> pf.FusionConfig:
    """The configuration with the same changes of every axis's noise."""
    return replaced(config, process={axis: replaced(one, **changes) for axis, one in config.process.items()})


def spoiled(config: pf.FusionConfig) -> pf.FusionConfig:
    """Sensors half as good as they are, a process three times as noisy that drifts a third as much."""

    def noisy(one: pf.Process) -> pf.Process:
        return replaced(
            one, input_noise=3.0 * one.input_noise, drift=0.3 * one.drift, maneuver_noise=2e-4, maneuver_drift=1e-3
        )

    process = {axis: noisy(one) for axis, one in config.process.items()}
    sensors = {name: replaced(one, sd=2.0 * one.sd) for name, one in config.sensors.items()}
    return replaced(config, process=process, sensors=sensors)


def spoiled_arm(config: pf.FusionConfig) -> pf.FusionConfig:
    """Likewise, and delays 8 ms too long and plants too slow."""
    config, arm = spoiled(config), config.arm
    axes: dict[str, pf.AxisModel] = {}
    for axis, model in arm.axes.items():
        plant = model.plant
        if isinstance(plant, pf.FirstOrder):
            plant = pf.FirstOrder(time_constant=1.3 * plant.time_constant)
        else:
            plant = pf.SecondOrder(natural_frequency=0.8 * plant.natural_frequency, damping=1.2 * plant.damping)
        axes[axis] = replaced(model, plant=plant, delay=arm.delay_of(axis) + 0.008)
    return replaced(config, arm=replaced(arm, axes=axes))


def free_of(
    likelihood: Likelihood,
    config: pf.FusionConfig,
    fit: Sequence[Fit],
    *fixed: str,
    believed: Mapping[tuple[str, str], float] | None = None,
) -> list[Parameter]:
    """The free parameters of a configuration."""
    return parameters(config, likelihood.config, likelihood.sensors, fit, fixed, believed=believed or {})


def fit_stage(
    run: pf.Run | Sequence[pf.Run],
    config: pf.FusionConfig,
    fit: Sequence[Fit] = ("noise",),
    *fixed: str,
    sd_prior: bool = True,
) -> Stage:
    """The result of one stage on whole runs."""
    return run_stage([run] if isinstance(run, pf.Run) else run, config, Plan(fit, fixed, sd_prior=sd_prior))


def intervals_of(stage: Stage) -> dict[str, ConfidenceInterval]:
    """The intervals of a stage."""
    return confidence_intervals(stage.likelihood, stage.best, stage.free)


def contains(found: ConfidenceInterval, one: Parameter, truth: pf.FusionConfig) -> bool:
    """Whether an interval contains the truth; one that is open below contains 0."""
    low, high = found.ci95
    return (0.0 if found.open[0] and one.vanishes else low) <= one.number(truth) <= high


def quietly(work: Callable[[], T]) -> T:
    """The result of some work, without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)
        return work()


def later(*values: object) -> object:
    """A case of a test that only `make test-long` runs."""
    return pytest.param(*values, marks=LONG)


def fitted(found: pf.Tuning) -> dict[str, Fitted]:
    """The fitted parameters by key."""
    return {one.key: one for one in found.details.parameters}

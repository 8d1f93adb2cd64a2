"""The likelihood of readings is that of the filter and of the joint Gaussian; its slopes are its slopes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

import pumafuse as pf
from fusion.test_oracle import CASES, MS, THREE, VISION, Case, Heard, every, sensor
from fusion_oracle import AxisOracle
from pumafuse.fusion.consistency import densities_of, log_likelihood
from pumafuse.tune.likelihood import Evidence
from pumafuse.tune.parameters import Parameter, parameters, with_order
from pumafuse.tune.search import moved, point, slopes
from tuning import ALL, free_of, quietly, replaced, scenario, spoiled, spoiled_arm, with_process, with_sensors

DATA = Path(pf.__file__).parent / "data"


@cache
def outage(seed: int = 1) -> pf.Simulated:
    """Tracker and camera on two axes for 4 seconds, the camera with outliers."""
    found = scenario("panel-tracker-outage", 0.1, 0.02)
    camera = replaced(found.sensors["vision"], outliers=pf.simulate.__globals__["Scenario"] and None)
    return pf.simulate(replaced(found, sensors={**found.sensors, "vision": camera}), seed)


def of_the_filter(run: pf.Run, config: pf.FusionConfig) -> dict[str, float]:
    """By axis, from what `fuse` says of each reading."""
    est = quietly(lambda: pf.fuse(run, config))
    mine = {axis: est.readings.where(est.readings.axis == number) for number, axis in enumerate(est.readings.axes)}
    return {axis: log_likelihood(readings, config.sensors) for axis, readings in mine.items()}

"""`pumafuse discretize`."""

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray
from ..errors import warn
from ..model.arm import ArmModel
from ..model.discrete import DiscreteModel, discretize
from ..units import MS, Screen, in_unit, si
from .screen import say, say_json

_MOST_TICKS = 200  # of a step response
_MATRICES = ("F", "B", "H", "Q")


def run(source: str, axis: str | None, period_ms: float | None, json: bool) -> None:
    """Print the discrete model of an arm's axes."""
    arm = ArmModel.load(source)
    warn(arm.doubts())
    period = arm.update_period if period_ms is None else si(period_ms, "_ms")
    # 1 m/√Hz and states in m give the same numbers as 1 mm/√Hz and states in mm, or as degrees.
    models = {
        name: discretize(arm.axis(name), period, arm.delay_of(name), input_noise=1.0)
        for name in (arm.axes if axis is None else [axis])
    }
    if json:
        say_json({"arm": arm.name, "axes": {name: _tree(model, arm.screen_of(name)) for name, model in models.items()}})
        return
    for name, model in models.items():
        _print(f"{arm.name}, {name}", model, arm.screen_of(name))


def _tree(model: DiscreteModel, screen: Screen) -> dict[str, object]:
    return {
        "period_ms": in_unit(model.period, "_ms"),
        "delay_ms": in_unit(model.delay, "_ms"),
        "states": model.states,
        **{name: getattr(model, name).tolist() for name in _MATRICES},
        "poles": [(pole.real, pole.imag) for pole in model.poles.tolist()],
        f"step_response_{screen.unit}": _step_response(model).tolist(),
    }


def _print(title: str, model: DiscreteModel, screen: Screen) -> None:
    say(f"{title}: period {model.period * MS:g} ms, delay {model.delay * MS:g} ms")
    say(f"states: {', '.join(model.states)} ({screen.unit}, {screen.unit}/s)")
    with np.printoptions(precision=6, suppress=False, linewidth=120):
        for name in _MATRICES:
            unit = f" [{screen.unit}²] for input noise of 1 {screen.unit}/√Hz" if name == "Q" else ""
            say(f"{name}{unit} =\n{getattr(model, name)}")
        poles = (f"{pole.real:.6g}" + (f"{pole.imag:+.6g}j" if pole.imag else "") for pole in model.poles.tolist())
        say(f"poles: {', '.join(poles)}")
        say(f"step response, p[0], p[1], …:\n{_step_response(model)}\n")


def _step_response(model: DiscreteModel) -> FloatArray:
    """Positions at the ticks until the slowest pole has settled to 1e-3."""
    slowest = float(np.abs(model.poles).max())
    settling = math.ceil(math.log(1e-3) / math.log(slowest)) if 1e-9 < slowest < 1.0 else 1
    return model.step_response(min(math.ceil(model.delay / model.period) + settling + 2, _MOST_TICKS))

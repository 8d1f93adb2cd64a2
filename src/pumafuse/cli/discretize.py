"""`pumafuse discretize`."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.arm import ArmModel
from ..model.discrete import DiscreteModel, discretize
from ..units import shifted
from .tables import console

_MOST_TICKS = 200  # of a step response


def run(source: str, axis: str | None, period_ms: float | None, json: bool) -> None:
    """Print the discrete model of an arm's axes.

    Raises:
        PumafuseError: No such arm or axis.
    """
    arm = ArmModel.load(source)
    period = arm.update_period if period_ms is None else shifted(period_ms, -3)
    # 1 m/√Hz and states in m give the same numbers as 1 mm/√Hz and states in mm.
    models = {
        name: discretize(arm.axis(name), period, arm.delay_of(name), input_noise=1.0)
        for name in (arm.axes if axis is None else [axis])
    }
    if json:
        axes = {name: _as_json(model) for name, model in models.items()}
        print(msgspec.json.format(msgspec.json.encode({"arm": arm.name, "axes": axes}), indent=2).decode())
        return
    for name, model in models.items():
        _print(f"{arm.name}, {name}", model)


def _as_json(model: DiscreteModel) -> dict[str, Any]:
    return {
        "period_ms": shifted(model.period, 3),
        "delay_ms": shifted(model.delay, 3),
        "states": model.states,
        "F": model.F.tolist(),
        "B": model.B.tolist(),
        "H": model.H.tolist(),
        "Q": model.Q.tolist(),
        "poles": [(pole.real, pole.imag) for pole in model.poles.tolist()],
        "step_response_mm": _step_response(model).tolist(),
    }


def _print(title: str, model: DiscreteModel) -> None:
    out = console(soft_wrap=True)
    out.print(title, style="bold", markup=False, end="")
    out.print(f": period {shifted(model.period, 3):g} ms, delay {shifted(model.delay, 3):g} ms", markup=False)
    out.print(f"states: {', '.join(model.states)} (mm, mm/s)", markup=False)
    with np.printoptions(precision=6, suppress=False, linewidth=120):
        for name in ("F", "B", "H", "Q"):
            unit = " [mm²] for input noise of 1 mm/√Hz" if name == "Q" else ""
            out.print(f"{name}{unit} =\n{getattr(model, name)}", markup=False)
        poles = ", ".join(
            f"{pole.real:.6g}" if pole.imag == 0.0 else f"{pole.real:.6g}{pole.imag:+.6g}j"
            for pole in model.poles.tolist()
        )
        out.print(f"poles: {poles}", markup=False)
        out.print(f"step response, p[0], p[1], …:\n{_step_response(model)}\n", markup=False)


def _step_response(model: DiscreteModel) -> FloatArray:
    """Positions at the ticks until the slowest pole has settled to 1e-3."""
    plant = [abs(pole) for pole in model.poles if abs(pole) > 1e-9]
    slowest = max(plant, default=0.0)
    settling = math.ceil(math.log(1e-3) / math.log(slowest)) if 0.0 < slowest < 1.0 else 1
    return model.step_response(min(math.ceil(model.delay / model.period) + settling + 2, _MOST_TICKS))

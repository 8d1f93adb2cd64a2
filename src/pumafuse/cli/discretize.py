"""`pumafuse discretize`."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from ..model.arm import ArmModel
from ..model.discrete import DiscreteModel, discretize
from ..units import shifted
from .tables import console

_MOST_TICKS = 200  # of a step response


class Discretized(msgspec.Struct, frozen=True, kw_only=True):
    """One axis in the output of ``discretize --json``. States are in mm and mm/s, v and p in mm.

    Attributes:
        period_ms: T.
        delay_ms: Td.
        states: Names of the states.
        F: x[n+1] = F x[n] + B v[n].
        B: One column.
        H: p[n] = H x[n].
        Q: Covariance a tick [mm²] from an input noise of 1 mm/√Hz; it grows with the square of that.
        poles: Eigenvalues of F as [real, imaginary].
        step_response_mm: p[0], p[1], … after v stepped to 1 mm at tick 0.
    """

    period_ms: float
    delay_ms: float
    states: list[str]
    F: list[list[float]]
    B: list[list[float]]
    H: list[list[float]]
    Q: list[list[float]]
    poles: list[tuple[float, float]]
    step_response_mm: list[float]


def run(source: str, axis: str | None, period_ms: float | None, json: bool) -> None:
    """Print the discrete model of an arm's axes.

    Raises:
        PumafuseError: No such arm or axis.
    """
    arm = ArmModel.load(source)
    period = arm.update_period if period_ms is None else shifted(period_ms, -3)
    models: dict[str, Discretized] = {}
    for name in arm.axes if axis is None else [axis]:
        # 1 m/√Hz and states in m give the same numbers as 1 mm/√Hz and states in mm.
        model = discretize(arm.axis(name), period, arm.delay_of(name), input_noise=1.0)
        models[name] = _shown(model)
    if json:
        print(msgspec.json.format(msgspec.json.encode({"arm": arm.name, "axes": models}), indent=2).decode())
        return
    for name, shown in models.items():
        _print(arm.name, name, shown)


def _shown(model: DiscreteModel) -> Discretized:
    plant = [pole for pole in model.poles if abs(pole) > 1e-9]
    slowest = max((abs(pole) for pole in plant), default=0.0)
    settling = math.ceil(math.log(1e-3) / math.log(slowest)) if 0.0 < slowest < 1.0 else 1
    ticks = min(math.ceil(model.delay / model.period) + settling + 2, _MOST_TICKS)
    return Discretized(
        period_ms=shifted(model.period, 3),
        delay_ms=shifted(model.delay, 3),
        states=list(model.states),
        F=model.F.tolist(),
        B=model.B.tolist(),
        H=model.H.tolist(),
        Q=model.Q.tolist(),
        poles=[(pole.real, pole.imag) for pole in model.poles.tolist()],
        step_response_mm=model.step_response(ticks).tolist(),
    )


def _print(arm: str, axis: str, shown: Discretized) -> None:
    out = console(soft_wrap=True)
    out.print(f"[bold]{arm}, {axis}[/bold]: period {shown.period_ms:g} ms, delay {shown.delay_ms:g} ms")
    out.print(f"states: {', '.join(shown.states)} (mm, mm/s)", markup=False)
    with np.printoptions(precision=6, suppress=False, linewidth=120):
        for letter, matrix in (("F", shown.F), ("B", shown.B), ("H", shown.H), ("Q", shown.Q)):
            unit = " [mm²] for input noise of 1 mm/√Hz" if letter == "Q" else ""
            out.print(f"{letter}{unit} =\n{np.array(matrix)}", markup=False)
        poles = ", ".join(f"{re:.6g}" if im == 0.0 else f"{re:.6g}{im:+.6g}j" for re, im in shown.poles)
        out.print(f"poles: {poles}", markup=False)
        out.print(f"step response, p[0], p[1], …:\n{np.array(shown.step_response_mm)}\n", markup=False)

"""First or second order? An F-test and Akaike's criterion over all trials, and whether the trials agree."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np

from .estimate import Estimate
from .rows import Order


class OrderChoice(msgspec.Struct, frozen=True, kw_only=True):
    """First or second order.

    Attributes:
        order: The choice.
        first_rms_mm: Root mean square of what first order leaves of all trials.
        second_rms_mm: Of second order.
        f: Of the test of the parameters that second order has more.
        p: Of that F.
        aicc_gain: By how much second order lowers AICc; negative: it does not. Null: too few samples.
        inverse_square_s2: 1/ω² [s²] with its interval by trials; 0 is first order.
        why: In words.
    """

    order: Order
    first_rms: float = msgspec.field(name="first_rms_mm")
    second_rms: float = msgspec.field(name="second_rms_mm")
    f: float
    p: float
    aicc_gain: float | None
    inverse_square: Estimate = msgspec.field(name="inverse_square_s2")
    why: str


def choose(
    squares: Mapping[Order, float],
    parameters: Mapping[Order, int],
    samples: int,
    rms: Mapping[Order, float],
    inverse_square: Estimate,
) -> OrderChoice:
    """Choose by what both orders leave.

    Second order is chosen if the F-test (5 %) and AICc want it and the interval of 1/ω² by trials lies above 0: samples
    of one trial are not independent, trials are.

    Args:
        squares: Sum of squares that each leaves, in units of noise or not.
        parameters: How many each has fitted.
        samples: In all trials.
        rms: What each leaves [m].
        inverse_square: 1/ω² [s²].
    """
    from scipy.stats import f as fisher

    more, freedom = parameters[2] - parameters[1], max(samples - parameters[2], 1)
    F = (squares[1] - squares[2]) / more / (squares[2] / freedom) if squares[2] > 0.0 else 0.0
    p = float(fisher.sf(F, more, freedom))
    aicc = {order: _aicc(squares[order], samples, parameters[order] + 1) for order in squares}
    gain = aicc[1] - aicc[2] if np.isfinite(aicc[2]) else None
    agreed = inverse_square.ci95[0] > 0.0
    wanted = p < 0.05 and gain is not None and gain > 0.0
    said = (
        f"first order leaves {1e3 * rms[1]:.3g} mm, second {1e3 * rms[2]:.3g} (each trial weighed by its noise:"
        f" F({more}, {freedom}) = {F:.3g}, p {'< 0.001' if p < 1e-3 else f'= {p:.2g}'}; "
        + (
            "too few samples for AICc"
            if gain is None
            else f"AICc {abs(gain):.3g} {'lower' if gain > 0.0 else 'higher'}"
        )
        + ")"
    )
    if wanted and agreed:
        why = f"second order: {said}, and the trials agree that 1/ω² is above 0"
    elif wanted:
        why = f"first order: {said}, but as the trials scatter 1/ω² may be 0"
    else:
        why = f"first order: {said}"
    return OrderChoice(
        order=2 if wanted and agreed else 1,
        first_rms=rms[1],
        second_rms=rms[2],
        f=F,
        p=p,
        aicc_gain=gain,
        inverse_square=inverse_square,
        why=why,
    )


def _aicc(squares: float, samples: int, parameters: int) -> float:
    """Akaike's criterion, corrected for few samples (infinite where there are too few)."""
    room = samples - parameters - 1
    if room <= 0:
        return np.inf
    return samples * float(np.log(max(squares, 1e-300))) + 2.0 * parameters * (1.0 + (parameters + 1) / room)

"""Exact discretisation: a plant's transition over any interval, and the delay-augmented model at one period.

Åström & Wittenmark, Computer-Controlled Systems, 3rd ed., pp. 38-41, for the delay; Van Loan, "Computing integrals
involving the matrix exponential", IEEE Trans. AC 23(3), 1978, for the noise. No Padé approximation anywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray
from .arm import AxisModel
from .plants import Plant

if TYPE_CHECKING:
    import control
    from filterpy.kalman import KalmanFilter


class Transition(NamedTuple):
    """A plant's transition over an interval h with constant input; leading axes are those of the intervals."""

    Phi: FloatArray  # e^(Ah), (..., n, n)
    Gamma: FloatArray  # ∫₀ʰ e^(As) ds B, (..., n, 1)
    Q: FloatArray  # ∫₀ʰ e^(As) B Bᵀ e^(Aᵀs) ds, (..., n, n): covariance from input noise of density 1 m/√Hz


def transition(plant: Plant, interval: npt.ArrayLike) -> Transition:
    """Exact transition of ``plant`` over each of ``interval`` [s] ≥ 0, of any shape.

    Both integrals come from matrix exponentials over h = interval / 2^k, short enough that nothing in them grows, and
    are doubled k times: Γ(2h) = Φ Γ + Γ, Q(2h) = Φ Q Φᵀ + Q. Each doubling adds positive terms, so long intervals lose
    nothing but to the plant's stiffness: relative errors are about 1e-16 times the ratio of its fastest to its slowest
    pole (under 1e-9 up to ζ = 1000).
    """
    from scipy.linalg import expm

    A, B, _ = plant.state_space()
    n = len(A)
    dt = np.asarray(interval, dtype=np.float64)
    fastest = np.abs(np.linalg.eigvals(A)).max()
    doublings = np.ceil(np.log2(np.maximum(dt * fastest, 1.0))).astype(np.int64)
    h = (dt / np.exp2(doublings))[..., None, None]
    constant_input = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * h)
    van_loan = expm(np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]]) * h)
    Phi, Gamma = constant_input[..., :n, :n].copy(), constant_input[..., :n, n:].copy()
    Q = Phi @ van_loan[..., :n, n:]
    for k in range(int(doublings.max(initial=0))):
        more = doublings > k
        phi = Phi[more]
        Gamma[more] += phi @ Gamma[more]
        Q[more] += phi @ Q[more] @ phi.swapaxes(-1, -2)
        Phi[more] = phi @ phi
    return Transition(Phi, Gamma, 0.5 * (Q + Q.swapaxes(-1, -2)))


@dataclass(frozen=True, repr=False)
class DiscreteModel:
    """x[n+1] = F x[n] + B v[n] + w, p[n] = H x[n], w of covariance Q, at one update period.

    Attributes:
        F: (m, m).
        B: (m, 1).
        H: (1, m).
        Q: (m, m) [SI].
        period: T [s].
        delay: Td [s].
        states: The m state names: the plant's, ``offset`` if asked for, and the past inputs ``v[n-1]`` … ``v[n-r]``.
    """

    F: FloatArray
    B: FloatArray
    H: FloatArray
    Q: FloatArray
    period: float
    delay: float
    states: tuple[str, ...]

    def __repr__(self) -> str:
        return f"DiscreteModel(T {self.period:g} s, delay {self.delay:g} s: {', '.join(self.states)})"

    @property
    def poles(self) -> npt.NDArray[np.complex128]:
        """Eigenvalues of F, (m,)."""
        return np.linalg.eigvals(self.F).astype(np.complex128)

    def step_response(self, ticks: int) -> FloatArray:
        """Position [m] at ticks 0 … ticks − 1 after v stepped to 1 m at tick 0, (ticks,)."""
        x = np.zeros((len(self.F), 1))
        response = np.empty(ticks)
        for n in range(ticks):
            response[n] = (self.H @ x).item()
            x = self.F @ x + self.B
        return response

    def to_control(self) -> control.StateSpace:
        """The part from v to p as a discrete `control` state space (an offset has no input and is left out)."""
        import control

        kept = [index for index, name in enumerate(self.states) if name != "offset"]
        F, B, H = self.F[np.ix_(kept, kept)], self.B[kept], self.H[:, kept]
        return control.ss(F, B, H, 0.0, self.period, inputs=["v"], outputs=["p"])

    def to_filterpy(self) -> KalmanFilter:
        """A `filterpy` filter with F, B, H and Q set, at rest without uncertainty (x = 0, P = 0); R is the user's."""
        from filterpy.kalman import KalmanFilter

        kf = KalmanFilter(dim_x=len(self.F), dim_z=1, dim_u=1)
        kf.F, kf.B, kf.H, kf.Q = self.F.copy(), self.B.copy(), self.H.copy(), self.Q.copy()
        kf.P = np.zeros_like(self.F)
        return kf


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Td = d·T + τ′ with 0 ≤ τ′ < T; τ′ within 1e-9·T of 0 or T is taken as exactly there."""
    d = math.floor(delay / period)
    fraction = delay - d * period
    if fraction > period * (1.0 - 1e-9):
        return d + 1, 0.0
    return d, 0.0 if fraction < period * 1e-9 else fraction


def discretize(
    axis: AxisModel | Plant, period: float, delay: float = 0.0, *, input_noise: float = 0.0, drift: float | None = None
) -> DiscreteModel:
    """The exact delay-augmented model from v to p at one period; the gain is not part of it.

    x[n+1] = Φ x[n] + Γ1 v[n−d−1] + Γ0 v[n−d] with Γ0 = Γ(T − τ′) and Γ1 = Φ(T − τ′) Γ(τ′).

    Args:
        axis: The plant, or an axis for its plant.
        period: T [s] > 0.
        delay: Td [s] ≥ 0, of any length against T.
        input_noise: Density of the white noise on v [m/√Hz ≡ m·√s], two-sided.
        drift: Density of the offset's random walk [m/√s]; None leaves the offset out of the state.

    Raises:
        ValueError: ``period`` or ``delay`` is out of range.
    """
    if not (0.0 < period < math.inf and 0.0 <= delay < math.inf):
        raise ValueError(f"period must be > 0 and delay ≥ 0, both finite; got {period} s and {delay} s")
    plant = axis.plant if isinstance(axis, AxisModel) else axis
    d, tau = split_delay(delay, period)
    Phi, Gamma, Q1 = transition(plant, [period, tau, period - tau])
    past = d + 1 if tau > 0.0 else d

    n = Phi.shape[-1]
    register = n if drift is None else n + 1
    size = register + past
    F, B, H, Q = np.zeros((size, size)), np.zeros((size, 1)), np.zeros((1, size)), np.zeros((size, size))
    F[:n, :n], Q[:n, :n], H[:, :n] = Phi[0], input_noise**2 * Q1[0], plant.state_space()[2]
    if drift is not None:
        F[n, n], Q[n, n], H[0, n] = 1.0, drift**2 * period, 1.0
    for age, gamma in ((d, Gamma[2]), (d + 1, Phi[2] @ Gamma[1])):  # v[n−d] acts after τ′, v[n−d−1] until then
        if age == 0:
            B[:n] = gamma
        elif age <= past:
            F[:n, register + age - 1] = gamma[:, 0]
    if past:
        B[register] = 1.0
        F[register + 1 :, register:-1] = np.eye(past - 1)
    names = [f"x{index}" for index in range(n)] if n > 2 else ["position", "rate"][:n]
    offset = [] if drift is None else ["offset"]
    states = (*names, *offset, *(f"v[n-{age}]" for age in range(1, past + 1)))
    return DiscreteModel(F, B, H, Q, period, delay, states)

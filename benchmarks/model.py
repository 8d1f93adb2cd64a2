"""The model and the data every peer is given: a second-order plant behind a delay, five states, one measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]

PERIOD = 0.028  # s
DELAY = 0.06045  # s
OMEGA = 53.9  # rad/s
ZETA = 0.864
INPUT_NOISE = 3e-5  # m/√Hz
R = 0.5e-3**2  # m²
SPEED = 0.060  # m/s, of the raster scan
STROKE = 0.120  # m, of one line of it
MISSING = 0.05  # share of the samples
PLANT = 2  # states with a variance of their own; the others are past commands, known exactly


@dataclass(frozen=True)
class Model:
    """x[n+1] = F x[n] + B u[n] + w, z[n] = H x[n] + e; w of covariance Q, e of variance R.

    Attributes:
        F: (5, 5).
        B: (5,).
        H: (5,).
        Q: (5, 5) [SI].
        R: [m²].
        input_noise: Density of the noise on the plant's input that Q is made of [m/√Hz].
    """

    F: Array
    B: Array
    H: Array
    Q: Array
    R: float
    input_noise: float

    @property
    def start(self) -> Array:
        """(5, 5), covariance at the first sample before its update; the mean there is 0.

        One period before it the plant was at rest, and known to be.
        """
        return self.Q


@dataclass(frozen=True)
class Problem:
    """What a job gives a peer.

    Attributes:
        model: The model.
        u: Commands [m], (steps,) or (runs, steps).
        z: Measurements [m], of the same shape, NaN where missing.
        grid: The models to take the likelihood of; empty in the other jobs.
    """

    model: Model
    u: Array
    z: Array
    grid: tuple[Model, ...] = ()


@dataclass(frozen=True)
class Filtered:
    """All a filter knows; leading axes are those of the problem's ``z``.

    Attributes:
        mean: After each update, (..., steps, k), of all states or of the position alone.
        cov: After each update, (..., steps, m, m), of all states, of the leading two or of the position alone.
        innovation: (..., steps), NaN where missing.
        innovation_variance: (..., steps), also where missing.
        log_likelihood: (...).
    """

    mean: Array
    cov: Array
    innovation: Array
    innovation_variance: Array
    log_likelihood: Array


@dataclass(frozen=True)
class Smoothed:
    """Means (steps, 5) and covariances (steps, 5, 5) given all samples, or those of the position alone."""

    mean: Array
    cov: Array


def make_model(input_noise: float = INPUT_NOISE, r: float = R) -> Model:
    """The exact discrete model: held inputs by the augmented exponential, noise by Van Loan's."""
    A = np.array([[0.0, 1.0], [-(OMEGA**2), -2.0 * ZETA * OMEGA]])
    b = np.array([[0.0], [OMEGA**2]])
    zero = np.zeros((PLANT, PLANT))

    def held(interval: float) -> tuple[Array, Array]:
        whole = np.asarray(expm(np.block([[A, b], [np.zeros((1, PLANT + 1))]]) * interval), dtype=np.float64)
        return whole[:PLANT, :PLANT], whole[:PLANT, PLANT]

    d = math.floor(DELAY / PERIOD)
    late = DELAY - d * PERIOD
    Phi, _ = held(PERIOD)
    after, Gamma0 = held(PERIOD - late)
    Gamma1 = after @ held(late)[1]
    noise = Phi @ expm(np.block([[-A, b @ b.T], [zero, A.T]]) * PERIOD)[:PLANT, PLANT:]

    size = PLANT + d + 1
    F, Q = np.zeros((size, size)), np.zeros((size, size))
    F[:PLANT, :PLANT], F[:PLANT, -2], F[:PLANT, -1] = Phi, Gamma0, Gamma1
    F[PLANT + 1 :, PLANT:-1] = np.eye(d)
    Q[:PLANT, :PLANT] = input_noise**2 * 0.5 * (noise + noise.T)
    return Model(F, B=np.eye(size)[PLANT], H=np.eye(size)[0], Q=Q, R=r, input_noise=input_noise)


def response(model: Model, u: Array, w: Array | None = None) -> Array:
    """States (..., steps, 5) from rest under commands ``u`` (..., steps) and plant noise ``w`` (..., steps, 2).

    The filter is linear, so a peer without a control input can be given z less this response and have it added back
    to its means; nothing is lost.
    """
    states = np.zeros((*u.shape, len(model.F)))
    for lag in range(1, len(model.F) - PLANT + 1):
        states[..., lag:, PLANT + lag - 1] = u[..., :-lag]
    drive = states[..., PLANT:] @ model.F[:PLANT, PLANT:].T
    if w is not None:
        drive = drive + w
    poles, vectors = np.linalg.eig(model.F[:PLANT, :PLANT])
    modes = drive @ np.linalg.inv(vectors).T
    for index, pole in enumerate(poles):
        modes[..., index] = lfilter([0.0, 1.0], [1.0, -pole], modes[..., index], axis=-1)
    states[..., :PLANT] = (modes @ vectors.T).real
    return states


def make_problem(
    shape: tuple[int] | tuple[int, int], grid: int = 0, gaps: bool = True, seed: int = 20240501
) -> Problem:
    """A raster scan, measured.

    Args:
        shape: (steps,) or (runs, steps). Each run starts elsewhere on the raster.
        grid: How many models the likelihood is wanted of.
        gaps: False keeps all samples, for peers that cannot do without one.
        seed: Of all that is drawn.
    """
    rng = np.random.default_rng(seed)
    model = make_model()
    phase = rng.uniform(0.0, 2.0 * STROKE, (*shape[:-1], 1)) if len(shape) > 1 else np.zeros(1)
    travelled = phase + SPEED * PERIOD * np.arange(shape[-1])
    u = STROKE - np.abs(travelled % (2.0 * STROKE) - STROKE)
    w = rng.standard_normal((*shape, PLANT)) @ np.linalg.cholesky(model.Q[:PLANT, :PLANT]).T
    z = response(model, u, w)[..., 0] + math.sqrt(model.R) * rng.standard_normal(shape)
    missing = rng.random(shape) < MISSING
    if gaps:
        z[missing] = np.nan
    factors = np.exp(rng.uniform(-1.0, 1.0, (grid, 2)))
    models = tuple(make_model(INPUT_NOISE * noise, R * r) for noise, r in factors)
    return Problem(model, u, z, models)

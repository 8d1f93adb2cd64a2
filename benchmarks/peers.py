"""One adapter per peer and job.

An adapter takes the problem, does what a user would do once (build a filter, compile), and returns the call that is
timed: it takes the commands and samples in and gives the whole result out in arrays of its own.

Peers are imported inside their adapters, so that each is timed in a process that has loaded no other.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import native
import numpy as np

from model import PLANT, Array, Filtered, Problem, Smoothed, response

Job = Literal["filter", "batch", "likelihood", "grid", "smooth"]
Result = Filtered | Smoothed | Array
Adapter = Callable[[Problem], Callable[[], Any]]


def as_it_is(result: Any) -> Any:
    """For peers whose call gives a `Result`."""
    return result


@dataclass(frozen=True)
class Peer:
    """An adapter and how to time it.

    Attributes:
        name: Shown in the table.
        job: What it does.
        adapter: How.
        note: What the reader of the table has to know.
        steps: Steps of the one run when the job's own number takes too long; the time is per step either way.
        gaps: False where the peer cannot miss a sample; it is then given all of them.
        result: Makes a `Result` of what the call gives, to be compared; not timed.
    """

    name: str
    job: Job
    adapter: Adapter
    note: str = ""
    steps: int | None = None
    gaps: bool = True
    result: Callable[[Any], Result] = as_it_is


def with_innovations(problem: Problem, mean: Array, cov: Array, log_likelihood: Array | None = None) -> Filtered:
    """The whole result from a peer's filtered means and covariances; the likelihood too where the peer has none."""
    m, z = problem.model, problem.z
    into = m.H @ m.F
    innovation, variance = z.copy(), np.full(z.shape, m.H @ m.start @ m.H + m.R)
    innovation[..., 1:] -= mean[..., :-1, :] @ into + (m.H @ m.B) * problem.u[..., :-1]
    variance[..., 1:] = cov[..., :-1, :, :] @ into @ into + (m.H @ m.Q @ m.H + m.R)
    if log_likelihood is None:
        terms = np.log(2.0 * np.pi * variance) + innovation**2 / variance
        log_likelihood = -0.5 * np.nansum(terms, axis=-1)
    return Filtered(mean, cov, innovation, variance, np.asarray(log_likelihood))


# C++


def cpp_fresh(size: int, threads: int = 1) -> Adapter:
    """The plain loop with covariances of ``size`` states, into new arrays."""

    def adapter(problem: Problem) -> Callable[[], Result]:
        model = native.pack(problem.model)
        return lambda: native.filter_into(native.empty_filtered(problem, size), model, problem, threads)

    return adapter


def cpp_reused(size: int) -> Adapter:
    """The same into the arrays of the call before."""

    def adapter(problem: Problem) -> Callable[[], Result]:
        model, out = native.pack(problem.model), native.empty_filtered(problem, size)
        return lambda: native.filter_into(out, model, problem)

    return adapter


def cpp_one_by_one(block: bool) -> Adapter:
    """One call per model."""

    def adapter(problem: Problem) -> Callable[[], Result]:
        models = [native.pack(m) for m in problem.grid]
        return lambda: np.concatenate([native.likelihoods(model, problem, block) for model in models])

    return adapter


def cpp_grid(block: bool, threads: int) -> Adapter:
    """One call for all models."""

    def adapter(problem: Problem) -> Callable[[], Result]:
        models = native.pack(*problem.grid)
        return lambda: native.likelihoods(models, problem, block, threads)

    return adapter


def cpp_smooth(problem: Problem) -> Callable[[], Result]:
    """Bryson-Frazier."""
    model = native.pack(problem.model)
    return lambda: native.smooth(model, problem)


# filterpy


def _filterpy(problem: Problem) -> Any:
    from filterpy.kalman import KalmanFilter

    m = problem.model
    kf: Any = KalmanFilter(dim_x=len(m.F), dim_z=1, dim_u=1)
    kf.P, kf.F, kf.B, kf.H, kf.Q, kf.R = m.start, m.F, m.B[:, None], m.H[None], m.Q, np.array([[m.R]])
    return kf


def _or_none(z: Array) -> list[float | None]:
    return [None if np.isnan(sample) else sample for sample in z]


def filterpy_filter(problem: Problem) -> Callable[[], Result]:
    """``batch_filter``; its own likelihood calls scipy at every step, so it is taken from the innovations instead."""

    def run() -> Result:
        kf = _filterpy(problem)
        mean, cov, _, _ = kf.batch_filter(_or_none(problem.z), us=problem.u, update_first=True)
        return with_innovations(problem, mean[..., 0], cov)

    return run


def filterpy_smooth(problem: Problem) -> Callable[[], Result]:
    """``rts_smoother``, which forgets the input.

    That does no harm here: the input acts on a state without variance, where the gain by ``pinv`` is 0.
    """

    def run() -> Result:
        kf = _filterpy(problem)
        mean, cov, _, _ = kf.batch_filter(_or_none(problem.z), us=problem.u, update_first=True)
        mean, cov, _, _ = kf.rts_smoother(mean, cov, inv=np.linalg.pinv)
        return Smoothed(mean[..., 0], cov)

    return run


# simdkalman


def simdkalman_filter(problem: Problem) -> Callable[[], Result]:
    """One run or many."""
    from simdkalman import KalmanFilter

    m = problem.model
    kf = KalmanFilter(m.F, m.Q, m.H[None], m.R)

    def run() -> Result:
        known = response(m, problem.u)
        out = kf.compute(
            problem.z - known @ m.H,
            n_test=0,
            initial_value=np.zeros(len(m.F)),
            initial_covariance=m.start,
            smoothed=False,
            filtered=True,
            observations=False,
            log_likelihood=True,
        )
        # Its likelihood leaves out the 2π.
        samples = np.count_nonzero(~np.isnan(problem.z), axis=-1)
        total = out.log_likelihood.reshape(samples.shape) - 0.5 * samples * np.log(2.0 * np.pi)
        return with_innovations(problem, out.filtered.states.mean + known, out.filtered.states.cov, total)

    return run


# kalman-py


def kalman_py_batch(backend: Literal["numpy", "jax"]) -> Adapter:
    """``filter``, which knows neither inputs nor missing samples."""

    def adapter(problem: Problem) -> Callable[[], Result]:
        import jax
        from kalman_py import KalmanFilter

        jax.config.update("jax_enable_x64", True)
        m = problem.model
        at_rest = np.zeros_like(m.F)  # one period before the first sample: it predicts before it updates
        kf = KalmanFilter(m.F, m.H[None], m.Q, [[m.R]], np.zeros(len(m.F)), at_rest)

        def run() -> Result:
            known = response(m, problem.u)
            out = kf.filter(problem.z - known @ m.H, backend=backend)
            mean = np.asarray(out.means) + known
            return with_innovations(problem, mean, np.asarray(out.covs), np.asarray(out.log_likelihood))

        return run

    return adapter


def kalman_py_steps(problem: Problem) -> Callable[[], Result]:
    """``predict`` and ``update`` in the user's own loop, which can leave an update out and add an input."""
    from kalman_py import KalmanFilter

    m = problem.model

    def run() -> Result:
        kf = KalmanFilter(m.F, m.H[None], m.Q, [[m.R]], np.zeros(len(m.F)), m.start)
        mean, cov = np.empty((len(problem.z), len(m.F))), np.empty((len(problem.z), *m.F.shape))
        for k, (u, z) in enumerate(zip(problem.u, problem.z, strict=True)):
            if not np.isnan(z):
                kf.update(z)
            mean[k], cov[k] = kf.x, kf.P
            kf.predict()
            kf.x = kf.x + m.B * u
        return with_innovations(problem, mean, cov)

    return run


# statsmodels


def _statsmodels(problem: Problem) -> Any:
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    m = problem.model
    ssm = KalmanSmoother(k_endog=1, k_states=len(m.F), k_posdef=PLANT)
    ssm.bind(problem.z[:, None])
    ssm["transition"], ssm["design"], ssm["selection"] = m.F, m.H[None], np.eye(len(m.F), PLANT)
    ssm["state_intercept"] = m.B[:, None] * problem.u
    ssm["state_cov"], ssm["obs_cov"] = m.Q[:PLANT, :PLANT], np.array([[m.R]])
    ssm.initialize_known(np.zeros(len(m.F)), m.start)
    return ssm


def statsmodels_filter(problem: Problem) -> Callable[[], Result]:
    """Results come with the time axis last; they are turned, not copied.

    Innovations are taken from the filtered states: its own would be mended in a loop of Python over all steps.
    """
    from statsmodels.tsa.statespace import kalman_filter as kf

    unwanted = kf.MEMORY_NO_PREDICTED | kf.MEMORY_NO_GAIN | kf.MEMORY_NO_SMOOTHING | kf.MEMORY_NO_STD_FORECAST

    def run() -> Result:
        out = _statsmodels(problem).filter(conserve_memory=unwanted)
        cov = out.filtered_state_cov.transpose(2, 0, 1)
        return with_innovations(problem, out.filtered_state.T, cov, out.llf)

    return run


def statsmodels_likelihood(problem: Problem) -> Callable[[], Result]:
    """One filter, its covariances exchanged, as in its own estimation."""
    ssm = _statsmodels(problem)

    def run() -> Result:
        out = np.empty(len(problem.grid))
        for index, m in enumerate(problem.grid):
            ssm["state_cov"], ssm["obs_cov"] = m.Q[:PLANT, :PLANT], np.array([[m.R]])
            ssm.initialize_known(np.zeros(len(m.F)), m.start)
            out[index] = ssm.loglike()
        return out

    return run


def statsmodels_smooth(problem: Problem) -> Callable[[], Result]:
    """States and their covariances only, by its default method, which inverts no covariance of a state.

    The filter's own results are not copied out: that takes a loop of Python over all steps.
    """
    from statsmodels.tsa.statespace.kalman_smoother import SMOOTHER_STATE, SMOOTHER_STATE_COV

    def run() -> Result:
        out = _statsmodels(problem).smooth(SMOOTHER_STATE | SMOOTHER_STATE_COV, update_filter=False)
        return Smoothed(out.smoothed_state.T, out.smoothed_state_cov.transpose(2, 0, 1))

    return run


# dynamax

# dynamax adds 1e-9 to the diagonal of what it inverts, 0.4 % of R in m². In µm² that is lost in rounding.
MICRO = 1e6


def _dynamax(m: Any, u: Any, z: Any) -> tuple[Any, Any, Any, Any]:
    """Parameters, samples and inputs for dynamax, and what its likelihood is short of; all traced.

    It knows no missing sample: one is given as a 0 measured through H = 0, which teaches it nothing and adds a
    constant to the likelihood. Its input n acts on the way into step n, not out of it.
    """
    import jax.numpy as jnp
    from dynamax.linear_gaussian_ssm.inference import make_lgssm_params

    F, B, H, Q, r, P0 = m
    missing = jnp.isnan(z)
    R = r[None, None] * MICRO**2
    params = make_lgssm_params(
        jnp.zeros(len(F)),
        P0 * MICRO**2,
        F,
        Q * MICRO**2,
        jnp.where(missing[:, None, None], 0.0, H),
        R,
        dynamics_input_weights=B[:, None],
        emissions_input_weights=jnp.zeros((1, 1)),
    )
    constant = 0.5 * missing.sum() * jnp.log(2.0 * jnp.pi * R[0, 0]) + (~missing).sum() * jnp.log(MICRO)
    inputs = jnp.concatenate([jnp.zeros(1), u[:-1]]) * MICRO
    return params, jnp.where(missing, 0.0, z * MICRO)[:, None], inputs[:, None], constant


def _dynamax_filter(m: Any, u: Any, z: Any) -> tuple[Any, ...]:
    import jax.numpy as jnp
    from dynamax.linear_gaussian_ssm.inference import lgssm_filter

    F, B, H, Q, r, P0 = m
    params, samples, inputs, constant = _dynamax(m, u, z)
    out: Any = lgssm_filter(params, samples, inputs)
    mean, cov = out.filtered_means / MICRO, out.filtered_covariances / MICRO**2
    into = H @ F
    innovation = z - jnp.concatenate([jnp.zeros(1), mean[:-1] @ into + (H @ B) * u[:-1]])
    variance = jnp.concatenate([(H @ P0 @ H)[None], cov[:-1] @ into @ into + H @ Q @ H]) + r
    return mean, cov, innovation, variance, out.marginal_loglik + constant


def _dynamax_likelihood(m: Any, u: Any, z: Any) -> Any:
    from dynamax.linear_gaussian_ssm.inference import lgssm_filter

    params, samples, inputs, constant = _dynamax(m, u, z)
    return lgssm_filter(params, samples, inputs).marginal_loglik + constant


def _dynamax_smooth(m: Any, u: Any, z: Any) -> tuple[Any, Any]:
    from dynamax.linear_gaussian_ssm.inference import lgssm_smoother

    params, samples, inputs, _ = _dynamax(m, u, z)
    out: Any = lgssm_smoother(params, samples, inputs)
    return out.smoothed_means / MICRO, out.smoothed_covariances / MICRO**2


def _jax() -> Any:
    import jax

    jax.config.update("jax_enable_x64", True)
    return jax


def _matrices(problem: Problem) -> list[tuple[Array, ...]]:
    models = problem.grid or (problem.model,)
    return [(m.F, m.B, m.H, m.Q, np.array(m.R), m.start) for m in models]


def dynamax_filter(problem: Problem) -> Callable[[], Result]:
    """One run, or many by ``vmap``."""
    jax = _jax()
    compiled = jax.jit(_dynamax_filter if problem.z.ndim == 1 else jax.vmap(_dynamax_filter, in_axes=(None, 0, 0)))
    (model,) = _matrices(problem)

    def run() -> Result:
        return Filtered(*map(np.asarray, jax.block_until_ready(compiled(model, problem.u, problem.z))))

    return run


def dynamax_one_by_one(problem: Problem) -> Callable[[], Result]:
    """One compiled call per model."""
    jax = _jax()
    compiled = jax.jit(_dynamax_likelihood)
    models = _matrices(problem)

    def run() -> Result:
        return np.array(jax.block_until_ready([compiled(model, problem.u, problem.z) for model in models]))

    return run


def dynamax_grid(problem: Problem) -> Callable[[], Result]:
    """All models in one call, by ``vmap``."""
    jax = _jax()
    compiled = jax.jit(jax.vmap(_dynamax_likelihood, in_axes=(0, None, None)))
    models = tuple(map(np.stack, zip(*_matrices(problem), strict=True)))
    return lambda: np.asarray(jax.block_until_ready(compiled(models, problem.u, problem.z)))


def dynamax_smooth(problem: Problem) -> Callable[[], Result]:
    """Its RTS smoother; what it adds to the diagonal is what lets it solve with a singular covariance."""
    jax = _jax()
    compiled = jax.jit(_dynamax_smooth)
    (model,) = _matrices(problem)
    return lambda: Smoothed(*map(np.asarray, jax.block_until_ready(compiled(model, problem.u, problem.z))))


# torch-kf


def torch_kf_batch(problem: Problem) -> Callable[[], Result]:
    """Many runs; it keeps time on the first axis, which is turned back, not copied."""
    import torch
    from torch_kf import GaussianState, KalmanFilter

    m, runs = problem.model, len(problem.z)
    kf = KalmanFilter(*map(torch.from_numpy, (m.F, m.H[None], m.Q, np.array([[m.R]]))))

    def run() -> Result:
        known = response(m, problem.u)
        start = GaussianState(torch.zeros(runs, len(m.F), 1).double(), torch.from_numpy(m.start).repeat(runs, 1, 1))
        out = kf.filter(start, torch.from_numpy((problem.z - known @ m.H).T[..., None, None]), return_all=True)
        mean = out.mean[..., 0].numpy().swapaxes(0, 1) + known
        return with_innovations(problem, mean, out.covariance.numpy().swapaxes(0, 1))

    return run


SUBTRACTED = "no input: on z less the known response"
MICRONS = "missing as H = 0; in µm"
DENSE, BLOCK, POSITION = 5, PLANT, 1
BLOCK_NOTE = "covariance of the 2 plant states only"
POSITION_NOTE = "the same, and gives out no more than pumafuse"
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

PEERS: tuple[Peer, ...] = (
    Peer("C++, fresh arrays", "filter", cpp_fresh(DENSE)),
    Peer("C++, reused arrays", "filter", cpp_reused(DENSE)),
    Peer("C++ 2x2, fresh arrays", "filter", cpp_fresh(BLOCK), BLOCK_NOTE),
    Peer("C++ 2x2, reused arrays", "filter", cpp_reused(BLOCK), BLOCK_NOTE),
    Peer("C++ position, fresh arrays", "filter", cpp_fresh(POSITION), POSITION_NOTE),
    Peer("statsmodels", "filter", statsmodels_filter, "input as state_intercept"),
    Peer("dynamax", "filter", dynamax_filter, MICRONS),
    Peer(
        "kalman-py, jax",
        "filter",
        kalman_py_batch("jax"),
        f"{SUBTRACTED}; cannot miss a sample: given all",
        gaps=False,
    ),
    Peer(
        "kalman-py, numpy",
        "filter",
        kalman_py_batch("numpy"),
        f"{SUBTRACTED}; cannot miss a sample: given all, and so may freeze its gain",
        steps=100_000,
        gaps=False,
    ),
    Peer("kalman-py, own loop", "filter", kalman_py_steps, "the user's loop of predict and update", steps=20_000),
    Peer("filterpy", "filter", filterpy_filter, "likelihood from its innovations", steps=20_000),
    Peer("simdkalman", "filter", simdkalman_filter, SUBTRACTED, steps=20_000),
    Peer("C++, all cores", "batch", cpp_fresh(DENSE, CORES)),
    Peer("C++ 2x2, all cores", "batch", cpp_fresh(BLOCK, CORES), BLOCK_NOTE),
    Peer("C++ position, all cores", "batch", cpp_fresh(POSITION, CORES), POSITION_NOTE),
    Peer("dynamax, vmap", "batch", dynamax_filter, MICRONS),
    Peer("simdkalman", "batch", simdkalman_filter, SUBTRACTED),
    Peer("torch-kf", "batch", torch_kf_batch, f"{SUBTRACTED}; likelihood from its innovations"),
    Peer("C++", "likelihood", cpp_one_by_one(block=False)),
    Peer("C++ 2x2", "likelihood", cpp_one_by_one(block=True), BLOCK_NOTE),
    Peer("statsmodels", "likelihood", statsmodels_likelihood, "input as state_intercept"),
    Peer("dynamax", "likelihood", dynamax_one_by_one, MICRONS),
    Peer("C++, all cores", "grid", cpp_grid(block=False, threads=CORES)),
    Peer("C++ 2x2, all cores", "grid", cpp_grid(block=True, threads=CORES), BLOCK_NOTE),
    Peer("dynamax, vmap", "grid", dynamax_grid, MICRONS),
    Peer("C++", "smooth", cpp_smooth, "Bryson-Frazier"),
    Peer("statsmodels", "smooth", statsmodels_smooth, "input as state_intercept"),
    Peer("dynamax", "smooth", dynamax_smooth, MICRONS),
    Peer("filterpy", "smooth", filterpy_smooth, "RTS with pinv", steps=10_000),
)

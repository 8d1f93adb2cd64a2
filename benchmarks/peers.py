"""The scan through other programs: general filters with matrices for each event, and pumafuse's own filter alone.

    python benchmarks/peers.py NAME REPEATS    prints the rows of one of PEERS as JSON; run.py calls it

Each first has to give the numbers of `pumafuse` on the shipped scan, to `TOLERANCE` of a standard deviation. What is
made once (tables, matrices, a compiled program) is made before the clock starts.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import project
from project import Row

import pumafuse as pf
from pumafuse.filter.core import transition
from pumafuse.filter.events import COMMAND, Events
from pumafuse.fusion.engine import Filtered, filter_segment, innovations, model_of
from pumafuse.fusion.estimates import Mode
from pumafuse.fusion.segments import Segment, build_segment

Array = npt.NDArray[np.float64]
Answer = Mapping[str, Array]  # outputs (axes, estimates), innovations (events, axes), or the log_likelihood
TOLERANCE = 1e-9  # of a standard deviation
FUSED = pf.Outcome.FUSED
FILTERED = ("position", "position_sd", "velocity", "velocity_sd", "offset", "offset_sd")
FIELDS = {"filter": FILTERED, "as live": FILTERED, "smooth": ("position", "position_sd", "offset", "offset_sd")}
MODES: dict[str, Mode] = {"filter": "filtered", "as live": "as-live", "smooth": "smoothed"}
POSITION, RATE, OFFSET, BIASES = range(4)  # of a state: what a plant of first order has not is left out in the end
MICRO = 1e6  # dynamax adds 1e-9 to the diagonal of what it inverts: too much in m², nothing in µm²


@dataclass(frozen=True)
class Problem:
    """A run, ready for any filter: its events, when estimates are wanted, and what pumafuse makes of it."""

    config: pf.FusionConfig
    segment: Segment
    events: Events
    times: npt.NDArray[np.int64]
    filtered: Filtered
    values: int

    @staticmethod
    def of(rows: int) -> Problem:
        """The scan repeated to so many rows; the shipped one for 0."""
        run = project.repeated(rows) if rows else pf.Run.read(project.SCAN)
        config = pf.FusionConfig.load(project.CONFIG)
        segment = build_segment(run, config)
        filtered = filter_segment(segment, config, segment.commands, "filtered")
        return Problem(config, segment, filtered.events, segment.commands, filtered, project.values_of(run))

    def answer(self, job: str) -> Answer:
        """What pumafuse gives."""
        if job == "likelihood":
            found = innovations(self.segment, self.config)
            fused = found.outcome == FUSED
            nu, S = found.innovation[fused], found.innovation_sd[fused] ** 2
            return {"log_likelihood": np.array(-0.5 * np.sum(np.log(2.0 * np.pi * S) + nu**2 / S))}
        filtered = filter_segment(self.segment, self.config, self.times, MODES[job])
        own = {name: np.array([getattr(axis, name) for axis in filtered.axes.values()]) for name in FIELDS[job]}
        return own | {name: getattr(filtered.results, name) for name in ("innovation", "innovation_sd")}


def error(found: Answer, wanted: Answer) -> float:
    """The largest difference in standard deviations; of a log-likelihood per unit of itself."""
    if "log_likelihood" in found:
        return float(np.max(np.abs(found["log_likelihood"] / wanted["log_likelihood"] - 1.0)))
    sizes = {name: wanted[name.removesuffix("_sd") + "_sd"] for name in found}
    return max(float(np.nanmax(np.abs(found[name] - wanted[name]) / sizes[name])) for name in found)


# pumafuse itself, the segment ready


def ours(job: str) -> Callable[[Problem], Callable[[], Any]]:
    """The filter alone, without classifying rows and listing what became of them."""
    return lambda problem: lambda: problem.answer(job)


# General filters: x[k] = F[k] x[k-1] + B[k] v[k] + w, z[k] = H[k] x[k] + e


class Steps(NamedTuple):
    """One axis as a linear model: a step for each command, fused measurement and estimate.

    Attributes:
        F: Into each step, (m, n, n).
        B: (m, n, 2).
        v: Input and gain error [m], (m, 2).
        Q: (m, n, n).
        H: (m, n).
        R: (m,).
        z: NaN where nothing was fused, (m,).
        P0: Before the first step, where the mean is 0, (n, n).
        start: The level that all is relative to [m].
        position: What of the state is the position, (n,).
        estimate: Which steps are estimates, (m,).
    """

    F: Array
    B: Array
    v: Array
    Q: Array
    H: Array
    R: Array
    z: Array
    P0: Array
    start: float
    position: Array
    estimate: npt.NDArray[np.bool_]

    def outputs(self, mean: Array, cov: Array) -> tuple[Array, Array]:
        """Position and its sd at the estimates, of means (m, n) and covariances (m, n, n)."""
        mean, cov = mean[self.estimate], cov[self.estimate]
        return self.start + mean @ self.position, np.sqrt(cov @ self.position @ self.position)


def steps_of(problem: Problem) -> list[Steps]:
    """Every axis as matrices, by the transitions of pumafuse: only the filters are compared."""
    events, model, found = problem.events, model_of(problem.segment, problem.config), list[Steps]()
    for number, axis in enumerate(model.axis):
        outcome, view = problem.filtered.results.outcome[:, number], model.view[:, number]
        command = (events.source == COMMAND) & (events.codes[:, number] == FUSED)
        rows = np.flatnonzero(command | ((events.source != COMMAND) & (outcome == FUSED)))
        time = np.concatenate((events.time[rows], problem.times))
        row = np.concatenate((rows, np.full(len(problem.times), -1)))
        order = np.argsort(time, kind="stable")  # at one instant the estimate is the last
        row, dt = row[order], np.diff(time[order], prepend=problem.segment.origin) / 1e9
        biased = np.flatnonzero(view["bias_sd"] > 0.0)
        prior = np.array([0.0, 0.0, axis["offset_sd"], *view["bias_sd"][biased]]) ** 2
        start, m, size = axis["start"], len(row), len(prior)
        F, Q, B = np.zeros((m, size, size)), np.zeros((m, size, size)), np.zeros((m, size, 2))
        v, H, R, z = np.zeros((m, 2)), np.zeros((m, size)), np.ones(m), np.full(m, np.nan)
        F[:] = np.eye(size)
        u, step, e, noise, drift = 0.0, 0.0, 0.0, axis["input_noise"] ** 2, axis["drift"] ** 2
        for k in range(m):
            over = transition(model.axis[number : number + 1], dt[k])
            f11, f12, f21, f22, q11, q12, q22, a, b, left = over[:10].tolist()
            F[k, :2, :2] = [[f11, f12], [f21, f22]]
            B[k, :2], v[k], e = [[1.0 - f11, a], [-f21, b]], [u, e], e * left
            Q[k, :2, :2], Q[k, OFFSET, OFFSET] = [[noise * q11, noise * q12], [noise * q12, noise * q22]], drift * dt[k]
            if row[k] < 0:
                continue
            value, sensor = events.value[row[k], number] - start, events.source[row[k]]
            if sensor != COMMAND:
                scale = model.sensor["scale"][sensor]
                z[k] = value + start * (1.0 - scale)
                H[k, [POSITION, OFFSET]], R[k] = scale, view["sd"][sensor] ** 2
                H[k, BIASES + np.flatnonzero(biased == sensor)] = 1.0
                continue
            maneuver = abs(value - u - step) / axis["period"]
            u, step = value, value - u
            e += (axis["slope"] * abs(step) / axis["period"] + axis["intercept"] - 1.0) * step
            noise = axis["input_noise"] ** 2 + (axis["maneuver_noise"] * maneuver) ** 2
            drift = axis["drift"] ** 2 + (axis["maneuver_drift"] * maneuver) ** 2
        used = [i for i in range(size) if i != RATE or axis["time_constant"] == 0.0]
        position = np.zeros(size)
        position[[POSITION, OFFSET]] = 1.0
        F, Q, P0 = F[:, used][:, :, used], Q[:, used][:, :, used], np.diag(prior[used])
        found.append(Steps(F, B[:, used], v, Q, H[:, used], R, z, P0, float(start), position[used], row < 0))
    return found


def joined(parts: Sequence[tuple[Array, Array]]) -> Answer:
    """Positions and sds of all axes."""
    return dict(zip(("position", "position_sd"), map(np.array, zip(*parts, strict=True)), strict=True))


def filterpy(problem: Problem) -> Callable[[], Answer]:
    """``batch_filter`` with lists of matrices; its own likelihood calls scipy at every step and is left off."""
    from filterpy.kalman import KalmanFilter

    axes = [(s, [None if np.isnan(z) else z for z in s.z], s.H[:, None], s.R[:, None, None]) for s in steps_of(problem)]

    def run() -> Answer:
        found: list[tuple[Array, Array]] = []
        for s, z, H, R in axes:
            kf: Any = KalmanFilter(dim_x=s.F.shape[1], dim_z=1, dim_u=2)
            kf.P = s.P0
            mean, cov, _, _ = kf.batch_filter(z, Fs=s.F, Qs=s.Q, Hs=H, Rs=R, Bs=s.B, us=s.v[..., None])
            found.append(s.outputs(mean[..., 0], cov))
        return joined(found)

    return run


def fast_kalman(problem: Problem) -> Callable[[], Answer]:
    """A loop in Python that sets F and Q and calls its compiled steps.

    It takes no input: what inputs alone do is calculated before, and the filter sees what is left of the measurements.
    """
    import kalman

    axes: list[tuple[Steps, int, Array, list[Any], list[float]]] = []
    for s in steps_of(problem):
        n, moved = s.F.shape[1], np.zeros(s.F.shape[:2])
        for k in range(len(moved)):
            moved[k] = s.F[k] @ moved[k - 1] + s.B[k] @ s.v[k]
        z = MICRO * (s.z - np.sum(s.H * moved, axis=1))
        flat = (part.reshape(len(z), -1).tolist() for part in (s.F, MICRO**2 * s.Q, s.H))
        steps = list(zip(*flat, z.tolist(), (MICRO**2 * s.R).tolist(), s.estimate.tolist(), strict=True))
        axes.append((s, n, moved, steps, (MICRO**2 * s.P0).ravel().tolist()))

    def run() -> Answer:
        found: list[tuple[Array, Array]] = []
        for s, n, moved, steps, prior in axes:
            kf, mean, cov = kalman.LinearKalmanFilter(n, 1), [], []
            kf.x, kf.P = [0.0] * n, prior
            for F, Q, H, z, R, estimate in steps:
                kf.F, kf.Q = F, Q
                kf.predict()
                if z == z:
                    kf.correct_scalar(z, H, R)
                if estimate:
                    mean.append(kf.x)
                    cov.append(kf.P)
            x, P = np.array(mean) / MICRO + moved[s.estimate], np.array(cov).reshape(-1, n, n) / MICRO**2
            found.append((s.start + x @ s.position, np.sqrt(P @ s.position @ s.position)))
        return joined(found)

    return run


def statsmodels(job: str) -> Callable[[Problem], Callable[[], Answer]]:
    """Its representation with all matrices time-varying; the input as ``state_intercept``."""

    def adapter(problem: Problem) -> Callable[[], Answer]:
        from statsmodels.tsa.statespace import kalman_filter as kf
        from statsmodels.tsa.statespace.kalman_smoother import SMOOTHER_STATE, SMOOTHER_STATE_COV, KalmanSmoother

        unwanted = kf.MEMORY_NO_PREDICTED | kf.MEMORY_NO_GAIN | kf.MEMORY_NO_SMOOTHING | kf.MEMORY_NO_STD_FORECAST
        axes = steps_of(problem)
        models: list[Any] = []
        for s in axes:
            n, moved = s.F.shape[1], (s.B @ s.v[..., None])[..., 0]
            ssm = KalmanSmoother(k_endog=1, k_states=n)
            ssm.bind(s.z[:, None])
            into = [np.append(part[1:], np.zeros_like(part[:1]), axis=0) for part in (s.F, s.Q, moved)]  # of the next
            ssm["transition"], ssm["state_cov"], ssm["state_intercept"] = (np.moveaxis(part, 0, -1) for part in into)
            ssm["design"], ssm["obs_cov"], ssm["selection"] = s.H.T[None], s.R[None, None], np.eye(n)
            ssm.initialize_known(moved[0], s.F[0] @ s.P0 @ s.F[0].T + s.Q[0])
            models.append(ssm)

        def one(s: Steps, ssm: Any) -> tuple[Array, Array]:
            if job == "smooth":
                out = ssm.smooth(SMOOTHER_STATE | SMOOTHER_STATE_COV, update_filter=False)
                return s.outputs(out.smoothed_state.T, np.moveaxis(out.smoothed_state_cov, -1, 0))
            out = ssm.filter(conserve_memory=unwanted)
            return s.outputs(out.filtered_state.T, np.moveaxis(out.filtered_state_cov, -1, 0))

        if job == "likelihood":
            return lambda: {"log_likelihood": np.array(sum(ssm.loglike() for ssm in models))}
        return lambda: joined([one(s, ssm) for s, ssm in zip(axes, models, strict=True)])

    return adapter


def dynamax(job: str) -> Callable[[Problem], Callable[[], Answer]]:
    """Time-varying matrices, compiled; a missing measurement is a 0 measured through H = 0."""

    def adapter(problem: Problem) -> Callable[[], Answer]:
        import jax

        jax.config.update("jax_enable_x64", True)
        import jax.numpy as jnp
        from dynamax.linear_gaussian_ssm import inference

        axes, given, short = steps_of(problem), [], 0.0
        for s in axes:
            missing, R = np.isnan(s.z), s.R * MICRO**2
            params = inference.make_lgssm_params(
                jnp.asarray(s.B[0] @ s.v[0] * MICRO),
                jnp.asarray((s.F[0] @ s.P0 @ s.F[0].T + s.Q[0]) * MICRO**2),
                jnp.asarray(s.F),
                jnp.asarray(s.Q * MICRO**2),
                jnp.asarray(s.H[:, None]),
                jnp.asarray(R[:, None, None]),
                dynamics_input_weights=jnp.asarray(s.B),
                emissions_input_weights=jnp.zeros((1, 2)),
            )
            z = jnp.asarray(np.nan_to_num(s.z * MICRO)[:, None])
            given.append((params, z, jnp.asarray(s.v * MICRO)))
            short += 0.5 * np.sum(np.log(2.0 * np.pi * R[missing])) + np.sum(~missing) * np.log(MICRO)
        call = inference.lgssm_smoother if job == "smooth" else inference.lgssm_filter
        names = {"likelihood": ("marginal_loglik",), "smooth": ("smoothed_means", "smoothed_covariances")}
        wanted = names.get(job, ("filtered_means", "filtered_covariances"))
        compiled = jax.jit(lambda *one: [getattr(call(*one), name) for name in wanted])

        def run() -> Answer:
            found = [[np.asarray(part) for part in jax.block_until_ready(compiled(*one))] for one in given]
            if job == "likelihood":
                return {"log_likelihood": np.array(sum(part for (part,) in found) + short)}
            return joined([s.outputs(x / MICRO, P / MICRO**2) for s, (x, P) in zip(axes, found, strict=True)])

        return run

    return adapter


# What is timed


class Peer(NamedTuple):
    """An adapter and how to time it: on the scan repeated to ``rows``, 0 for the shipped one."""

    job: str
    adapter: Callable[[Problem], Callable[[], Any]]
    rows: int
    note: str = ""


MATRICES = "position and sd alone, of what was fused; on one scan"
READY = "a table of rows in, arrays of numbers out: neither classifies rows nor lists outcomes"
PEERS: dict[str, Peer] = {
    "pumafuse, table ready": Peer("filter", ours("filter"), project.ROWS, READY),
    "statsmodels": Peer("filter", statsmodels("filter"), 0, MATRICES),
    "dynamax": Peer("filter", dynamax("filter"), 0, MATRICES),
    "fast-kalman": Peer("filter", fast_kalman, 0, MATRICES),
    "filterpy": Peer("filter", filterpy, 0, MATRICES),
    "pumafuse, as live, table ready": Peer("as live", ours("as live"), project.ROWS, READY),
    "pumafuse, smoother, table ready": Peer("smooth", ours("smooth"), project.ROWS, READY),
    "statsmodels, smoother": Peer("smooth", statsmodels("smooth"), 0, MATRICES),
    "dynamax, smoother": Peer("smooth", dynamax("smooth"), 0, MATRICES),
    "statsmodels, likelihood": Peer("likelihood", statsmodels("likelihood"), 0, "of what was fused; on one scan"),
    "dynamax, likelihood": Peer("likelihood", dynamax("likelihood"), 0, "of what was fused; on one scan"),
}


def measure(name: str, repeats: int) -> list[Row]:
    """The rows of one peer."""
    peer = PEERS[name]
    scan = Problem.of(0)
    apart = error(peer.adapter(scan)(), scan.answer(peer.job))
    if not apart <= TOLERANCE:
        sys.exit(f"disagrees by {apart:.0e}")
    problem = Problem.of(peer.rows) if peer.rows else scan
    seconds = project.timed(peer.adapter(problem), repeats)
    return [
        project.row(peer.job, name, "ns", [1e9 * s / problem.values for s in seconds], peer.note) | {"error": apart}
    ]


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], int(sys.argv[2]))))

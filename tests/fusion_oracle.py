"""An oracle for the filter that shares nothing with it: one axis of a run as one joint Gaussian, conditioned once.

Section 2 of the design says p(t) = ∫ g(t − s) (u(s − Td) + e(s − Td) + w(s)) ds + o(t) with g the plant's impulse
response, so

    mean       Σ Δu_k c(t − a_k) + Δe_k k(t − a_k), with c the response to a step, k = ∫ g(t − s) e^(−s/recovery) ds
               that to a gain error that decays, and a_k when the k-th command acts,
    covariance ∫ q(s) g(t − s) g(t' − s) ds + var(o₀) + ∫ drift²(s) ds over what lies before both t and t'.

The velocity is (p(t + T) − p(t)) / T, with g(t + T − s) − g(t − s) in the place of g, by commands given until t. No
state space and no recursion in time: closed-form responses, superposition, Gauss-Legendre quadrature. The priors are
added and the measurements conditioned on in 50-digit decimals, because a bias of 1 m against noise of 0.05 mm leaves a
double too few digits.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from statistics import NormalDist

import numpy as np

from pumafuse.fusion.config import FusionConfig
from pumafuse.fusion.estimates import AxisEstimate, Estimates, Measurements
from pumafuse.logs.run import Run
from pumafuse.model.arm import AxisModel
from pumafuse.model.plants import FirstOrder

DIGITS = 50
Z95 = NormalDist().inv_cdf(0.975)
FIELDS = ("position", "velocity", "offset", "disturbance")

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)  # 1e-18 of an integral over 1/fastest pole
_MANY, _OF_MANY = np.polynomial.legendre.leggauss(24)  # likewise, of one 16 times as long
_decimal = np.frompyfunc(Decimal, 1, 1)


def check_estimates(estimate: AxisEstimate, belief: AxisEstimate) -> None:
    """Estimates of an axis agree with the oracle's: means to 1e-9 sd + 1e-12 m, variances to 1e-9."""
    for field in FIELDS:
        (mean, sd), (wanted, wanted_sd) = (
            (getattr(of, field), getattr(of, f"{field}_sd")) for of in (estimate, belief)
        )
        if field == "velocity" and np.isnan(wanted).all():
            assert np.isnan(mean).all() and np.isnan(sd).all()
        else:
            _check(field, mean, wanted, wanted_sd)
            _check_sd(f"{field}_sd", sd, wanted_sd)


def check_innovations(measurements: Measurements, oracle: AxisOracle) -> None:
    """Innovations of one axis's fused components agree with the oracle's, to the same tolerances."""
    nu, sd = oracle.innovations()
    assert measurements.value.tolist() == [measurement.value for measurement in oracle.measurements]
    _check("innovation", measurements.innovation, nu, sd)
    _check_sd("innovation_sd", measurements.innovation_sd, sd)


def nanoseconds(estimates: Estimates) -> np.ndarray:
    """When the estimates are for, int ns since the run's first command."""
    return np.rint(estimates.time * 1e9).astype(np.int64)


def _check(name: str, got: np.ndarray, wanted: np.ndarray, sd: np.ndarray) -> None:
    np.testing.assert_array_less(np.abs(got - wanted) - 1e-9 * sd, 1e-12, err_msg=name)


def _check_sd(name: str, got: np.ndarray, wanted: np.ndarray) -> None:
    np.testing.assert_allclose(got**2, wanted**2, rtol=1e-9, atol=0.0, err_msg=name)


class Response:
    """Responses of a plant of unit gain: c to a step, g = c' to an impulse, g', and k to e^(−t/recovery); t ≥ 0 [s].

    With s̄ the mean of the two poles and ±δ what they differ from it, g = ω² e^(s̄t) sinh(δt)/δ: real, and the same
    formula, whether δ is real, imaginary or 0.
    """

    def __init__(self, axis: AxisModel) -> None:
        plant, self.recovery = axis.plant, axis.gain_recovery
        self.first_order = isinstance(plant, FirstOrder)
        if isinstance(plant, FirstOrder):
            self.fastest = 1.0 / plant.time_constant
        else:
            zeta, self.omega = plant.damping, plant.natural_frequency
            self.mean = -zeta * self.omega
            self.delta = self.omega * np.sqrt(complex((zeta - 1.0) * (zeta + 1.0)))
            self.fastest = abs(self.mean - self.delta)

    def step(self, t: np.ndarray) -> np.ndarray:
        """c(t)."""
        if self.first_order:
            return -np.expm1(-self.fastest * t)
        cosh, sinhc = self._hyperbolic(t)
        return 1.0 - cosh + self.mean * t * sinhc

    def impulse(self, t: np.ndarray) -> np.ndarray:
        """g(t) [1/s]."""
        if self.first_order:
            return self.fastest * np.exp(-self.fastest * t)
        return self.omega**2 * t * self._hyperbolic(t)[1]

    def impulse_rate(self, t: np.ndarray) -> np.ndarray:
        """g'(t) [1/s²]."""
        if self.first_order:
            return -(self.fastest**2) * np.exp(-self.fastest * t)
        cosh, sinhc = self._hyperbolic(t)
        return self.omega**2 * (cosh + self.mean * t * sinhc)

    def gain_error(self, t: np.ndarray) -> np.ndarray:
        """k(t), or c(t) without recovery."""
        if self.recovery is None:
            return self.step(t)
        found = np.zeros(len(t))
        panels = np.ceil(t * (self.fastest + 1.0 / self.recovery) / 16.0).astype(int)
        for count in np.unique(panels[t > 0.0]):
            chosen = panels == count
            half = t[chosen, None] / (2.0 * count)
            since = half * (2.0 * np.arange(count)[:, None] + 1.0 + _MANY).ravel()
            values = self.impulse(since) * np.exp((since - t[chosen, None]) / self.recovery)
            found[chosen] = (half * values) @ np.tile(_OF_MANY, count)
        return found

    def gain_error_rate(self, t: np.ndarray) -> np.ndarray:
        """k'(t) [1/s]."""
        return self.impulse(t) - (0.0 if self.recovery is None else self.gain_error(t) / self.recovery)

    def _hyperbolic(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """e^(s̄t) cosh δt and e^(s̄t) sinh(δt)/(δt), written so that nothing overflows."""
        slow, twice = np.exp((self.mean + self.delta) * t), 2.0 * self.delta * t
        some = np.where(twice == 0.0, 1.0, twice)
        ratio = np.where(twice == 0.0, 1.0, -np.expm1(-some) / some)
        return (slow * (1.0 + np.exp(-twice)) / 2.0).real, (slow * ratio).real


@dataclass(frozen=True)
class Commands:
    """The commands of one axis, ns since the run's first command; arrays are (commands,).

    Attributes:
        given: When each is given.
        acting: When each acts.
        step: Δu_n [m].
        error: Δe_n [m], by how much the gain error jumps.
        maneuver: |u_n − 2u_(n−1) + u_(n−2)| / T [m/s].
    """

    given: np.ndarray
    acting: np.ndarray
    step: np.ndarray
    error: np.ndarray
    maneuver: np.ndarray


def commands(run: Run, config: FusionConfig, axis: str) -> Commands:
    """Section 2's gain and maneuver; commands as given, stamps believed."""
    gain, period = config.arm.axes[axis].gain, config.arm.update_period
    kept = np.isfinite(run.command.values[axis])
    given = run.command.stamp[kept] - run.command.stamp.min()
    u = run.command.values[axis][kept]
    step = np.diff(u, prepend=run.start.get(axis, float(u[0])))
    error = (gain.slope * np.abs(step) / period + gain.intercept - 1.0) * step
    acting = given + round(config.arm.delay_of(axis) * 1e9)
    return Commands(given, acting, step, error, np.abs(np.diff(step, prepend=0.0)) / period)


@dataclass(frozen=True)
class Measurement:
    """One finite component, valid at or after the run's first command; ns since that command, SI."""

    sensor: str
    row: int
    valid: int
    stamp: int
    value: float


@dataclass(frozen=True)
class Rows:
    """Linear functions of the path: position·p(t) + speed·ṡ(t) + velocity·v(t) + offset·o(t) + disturbance·d(t).

    ṡ is the speed of the plant and of a smooth disturbance.

    All arrays are (rows,).
    """

    time: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    velocity: np.ndarray
    offset: np.ndarray
    disturbance: np.ndarray

    @staticmethod
    def at(time: Sequence[int] | np.ndarray, **weights: object) -> Rows:
        """Rows at ``time``, weights given once or one by one, 0 where not."""
        names = ("position", "speed", "velocity", "offset", "disturbance")
        each = [np.broadcast_to(np.asarray(weights.get(name, 0.0), float), np.shape(time)) for name in names]
        return Rows(np.asarray(time, dtype=np.int64), *each)

    def __add__(self, other: Rows) -> Rows:
        return Rows(*(np.concatenate([getattr(rows, name) for rows in (self, other)]) for name in self.__annotations__))

    def part(self, chosen: slice) -> Rows:
        """Some of the rows."""
        return Rows(*(getattr(self, name)[chosen] for name in self.__annotations__))

    @property
    def level(self) -> np.ndarray:
        """The share of a constant offset in each row."""
        return self.position + self.offset


class AxisOracle:
    """One axis of a run, gates off.

    Attributes:
        measurements: What there is to condition on, in the total order.
        jumps: Measurements just before which the offset jumps by N(0, variance [m²]): what re-acquisition adds.
    """

    def __init__(
        self,
        run: Run,
        config: FusionConfig,
        axis: str,
        *,
        leave_out: Collection[tuple[str, int]] = (),
        reacquired: Collection[tuple[str, int]] = (),
    ) -> None:
        """Collect the commands and measurements of ``axis``.

        Args:
            run: Commands and measurements.
            config: Arm, noise and sensors.
            axis: Which axis.
            leave_out: Measurements not to condition on: sensor and row.
            reacquired: Measurements that re-acquired: each adds its (ν/scale)² to the offset's variance before it is
                fused.
        """
        self.run, self.config, self.axis = run, config, axis
        self.process, self.response = config.process[axis], Response(config.arm.axes[axis])
        first = run.command.values[axis][np.isfinite(run.command.values[axis])][0]
        self.start = run.start.get(axis, float(first))
        self.commands, self.period = commands(run, config, axis), config.arm.update_period
        self.ahead = round(self.period * 1e9)
        self.measurements = self._collect(set(leave_out))
        self.jumps = dict[int, float]()
        for k, measurement in enumerate(self.measurements):
            if (measurement.sensor, measurement.row) in reacquired:
                self.jumps[k] = float((self.innovations()[0][k] / config.sensors[measurement.sensor].scale) ** 2)

    def innovations(self) -> tuple[np.ndarray, np.ndarray]:
        """ν and √S of each measurement, given all before it in the total order."""
        with localcontext(prec=DIGITS):
            L, w, _ = self._condition(self.measurements, self._measurements_as_rows(self.measurements))
            sd = np.diagonal(L)
            return (sd * w).astype(float), sd.astype(float)

    def jointly(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (m,) and covariance (m, m) of all measurements before any is known, with their noise; no latency_sd."""
        assert not self.jumps
        rows = self._measurements_as_rows(self.measurements)
        sensors = [self.config.sensors[measurement.sensor] for measurement in self.measurements]
        assert not any(sensor.latency_sd for sensor in sensors)
        joint = self._joint(self.measurements, rows)
        own = np.array([sensor.sd_of(self.axis) for sensor in sensors]) ** 2
        return rows.position * self.start + joint.mean.astype(float), joint.cross.astype(float) + np.diag(own)

    def undisturbed(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position [m] and speed [m/s] at ``times`` [ns since the first command] without noise and offset."""
        return self.start + self._mean(Rows.at(times, position=1)), self._mean(Rows.at(times, speed=1))

    def biases(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation [m] of the bias of each sensor, given every measurement there is."""
        found = dict[str, tuple[float, float]]()
        with localcontext(prec=DIGITS):
            L, w, _ = self._condition(self.measurements, self._measurements_as_rows(self.measurements))
            for name in {measurement.sensor for measurement in self.measurements}:
                prior = Decimal(self.config.sensors[name].bias_sd) ** 2
                shares = [[prior * (measurement.sensor == name) for measurement in self.measurements]]
                C = _substituted(np.array(shares), L)[0]
                if prior:
                    found[name] = float(_dot(C, w)), float((prior - _dot(C, C)).sqrt())
        return found

    def filtered(self, times: np.ndarray) -> AxisEstimate:
        """Given every measurement valid at or before each of ``times`` [ns since the first command]."""
        return self._believe(times, self.measurements, [measurement.valid for measurement in self.measurements])

    def as_live(self, times: np.ndarray) -> AxisEstimate:
        """Given every measurement whose stamp and valid time are at or before each of ``times``."""
        assert not any(self.config.sensors[measurement.sensor].latency_sd for measurement in self.measurements)
        assert not self.jumps
        arrived = sorted(self.measurements, key=lambda measurement: max(measurement.stamp, measurement.valid))
        return self._believe(times, arrived, [max(measurement.stamp, measurement.valid) for measurement in arrived])

    def smoothed(self, times: np.ndarray) -> AxisEstimate:
        """Given every measurement there is."""
        found = self._believe(times, self.measurements, [min(times)] * len(self.measurements))
        return replace(found, velocity=np.full(len(times), np.nan), velocity_sd=np.full(len(times), np.nan))

    def _collect(self, leave_out: set[tuple[str, int]]) -> list[Measurement]:
        origin, found = int(self.run.command.stamp.min()), []
        for rank, (name, sensor) in enumerate(self.config.sensors.items()):
            source = self.run.sensors.get(name)
            if source is None or self.axis not in source.values or sensor.sd_of(self.axis) is None:
                continue
            for row, value in enumerate(source.values[self.axis]):
                stamp = int(source.stamp[row]) - origin
                valid = stamp - round(sensor.latency * 1e9)
                if np.isfinite(value) and valid >= 0 and (name, row) not in leave_out:
                    found.append((valid, rank, stamp, row, Measurement(name, row, valid, stamp, float(value))))
        return [measurement for *_, measurement in sorted(found)]

    def _believe(self, times: np.ndarray, order: Sequence[Measurement], known_from: Sequence[int]) -> AxisEstimate:
        """Given, for each of ``times``, the measurements of ``order`` that are known by then: the first so many."""
        count = np.searchsorted(known_from, times, side="right")
        rows = self._measurements_as_rows(order)
        for field in FIELDS:
            rows = rows + Rows.at(times, **{field: 1})
        with localcontext(prec=DIGITS):
            n = len(order)
            L, w, joint = self._condition(order, rows)
            C = _substituted(joint.cross[n:], L)
            C[np.arange(n) >= np.tile(count, len(FIELDS))[:, None]] = Decimal(0)
            mean = joint.mean[n:] + C.dot(w) if n else joint.mean[n:]
            variance = joint.variance[n:] - (C * C).sum(axis=1) if n else joint.variance[n:]
            for doubt in self._doubts(rows):  # the weights of measurements are as if there were none
                left = doubt[n:] - (C.dot(_substituted(doubt[None, :n], L)[0]) if n else 0)
                variance = variance + left * left
            position, *others = mean.reshape(len(FIELDS), -1)
            sd = [_root(part) for part in variance.reshape(len(FIELDS), -1)]
            position = position + Decimal(self.start)
        means = [part.astype(float) for part in (position, *others)]
        has = self.process.disturbance_sd > 0.0
        for part, finest in zip(sd, (1e-9, 1e-9 / self.period, 1e-9, 1e-9 * has), strict=True):
            np.maximum(part, finest, out=part)  # no bar is 0, but of a disturbance that there is not
        return AxisEstimate(*(part for pair in zip(means, sd, strict=True) for part in pair))

    def _doubts(self, rows: Rows) -> list[np.ndarray]:
        """How far positions and velocities in rows are off where lag or gain is one standard deviation off, (rows,)."""
        axis, c = self.config.arm.axes[self.axis], self.response
        instant, place = np.unique(rows.time, return_inverse=True)
        now, later = (
            self._superposed(c.impulse, c.gain_error_rate, instant, ahead)[place] for ahead in (0, self.ahead)
        )
        speed = rows.position * now + rows.velocity * (later - now) / self.period
        gain = axis.gain.intercept if axis.gain_recovery is None else np.inf
        sds = [np.diff(ci95 or (0.0, 0.0)).item() / (2.0 * Z95) for ci95 in (axis.lag_ci95, axis.gain.intercept_ci95)]
        return [_decimal(sds[0] * speed), _decimal(sds[1] / gain * self._mean(rows))]

    def _condition(self, order: Sequence[Measurement], rows: Rows) -> tuple[np.ndarray, np.ndarray, _Joint]:
        """Cholesky factor of the measurements' covariance, and these whitened; the first of ``rows`` are theirs."""
        n = len(order)
        speeds = Rows.at([measurement.valid for measurement in order], speed=1)
        joint = self._joint(order, rows + speeds)
        L, w = np.full((n, n), Decimal(0)), np.full(n, Decimal(0))
        for k, measurement in enumerate(order):
            sensor = self.config.sensors[measurement.sensor]
            scale, sd = Decimal(sensor.scale), Decimal(sensor.sd_of(self.axis))
            here = [k, len(rows.time) + k]
            L[k, :k], speed = _substituted(joint.cross[here, :k], L[:k, :k])
            speed = joint.mean[here[1]] + _dot(speed, w[:k])
            noise = sd**2 + (scale * speed * Decimal(sensor.latency_sd)) ** 2
            L[k, k] = (joint.variance[k] + noise - _dot(L[k, :k], L[k, :k])).sqrt()
            predicted = scale * Decimal(self.start) + joint.mean[k] + _dot(L[k, :k], w[:k])
            w[k] = (Decimal(measurement.value) - predicted) / L[k, k]
        return L, w, joint.first(len(rows.time))

    def _joint(self, order: Sequence[Measurement], rows: Rows) -> _Joint:
        """Prior of ``rows``, the first of which are the measurements without their noise."""
        n = len(order)
        mean = self._mean(rows)
        noise, drift, from_noise, from_drift = self._driven(rows)
        cross = (from_noise * noise) @ from_noise[:n].T + (from_drift * drift) @ from_drift[:n].T
        variance = (from_noise**2) @ noise + (from_drift**2) @ drift + rows.velocity**2 * self._ahead(rows)
        level, prior = _decimal(rows.level), Decimal(self.config.start.offset_sd) ** 2
        exact_cross = _decimal(cross) + prior * np.multiply.outer(level, level[:n])
        exact_variance = _decimal(variance) + prior * level * level
        exact_cross += self._disturbed(rows, rows.part(slice(n)))
        alone = [rows.part(slice(k, k + 1)) for k in range(len(rows.time))]
        exact_variance += [self._disturbed(one, one)[0, 0] for one in alone]
        for k, one in enumerate(order):
            sensor = self.config.sensors[one.sensor]
            bias, drift = Decimal(sensor.bias_sd) ** 2, Decimal(sensor.bias_drift_sd) ** 2
            exact_variance[k] += bias + drift
            for j, other in enumerate(order):
                if one.sensor == other.sensor:
                    apart = Decimal(abs(one.valid - other.valid)) / 1_000_000_000
                    exact_cross[k, j] += bias + drift * (-apart / Decimal(sensor.bias_time)).exp()
        for k, variance in self.jumps.items():
            after = np.where(np.arange(len(level)) < n, np.arange(len(level)) >= k, rows.time >= order[k].valid)
            jumped = level * after
            exact_cross += Decimal(variance) * np.multiply.outer(jumped, jumped[:n])
            exact_variance += Decimal(variance) * jumped * jumped
        return _Joint(_decimal(mean), exact_variance, exact_cross)

    def _disturbed(self, rows: Rows, others: Rows) -> np.ndarray:
        """Covariance of rows by the disturbance, from its covariance function k and the derivatives of that."""
        process, found = self.process, np.full((len(rows.time), len(others.time)), Decimal(0))
        if process.disturbance_sd == 0.0:
            return found
        smooth = process.disturbance_kind == "matern"
        period, variance = Decimal(self.period), Decimal(process.disturbance_sd) ** 2
        rate = (
            Decimal(3).sqrt() / Decimal(process.disturbance_time) if smooth else 1 / Decimal(process.disturbance_time)
        )

        def covariance(lag: int, derived: int, other: int) -> Decimal:
            """Of d or its derivative at s + lag [ns], and d or its derivative at s."""
            s = Decimal(lag) / 1_000_000_000
            a = rate * abs(s)
            share = variance * (-a).exp()
            if not smooth:
                return share * (not derived and not other)
            if derived and other:
                return share * rate**2 * (1 - a)
            return share * rate**2 * s * (other - derived) if derived or other else share * (1 + a)

        def shares(part: Rows, k: int) -> list[tuple[Decimal, int, int]]:
            """A row as a sum of d and its derivative: weight, time, which derivative."""
            level, speed, velocity = part.position[k] + part.disturbance[k], part.speed[k], part.velocity[k]
            mean = Decimal(velocity) / period
            now, then = int(part.time[k]), int(part.time[k]) + self.ahead
            every = [(Decimal(level) - mean, now, 0), (mean, then, 0), (Decimal(speed), now, 1)]
            return [one for one in every if one[0]]

        known = [shares(others, j) for j in range(len(others.time))]
        for i in range(len(rows.time)):
            for j, parts in enumerate(known):
                for weight, time, derived in shares(rows, i):
                    for other_weight, other_time, other in parts:
                        found[i, j] += weight * other_weight * covariance(time - other_time, derived, other)
        return found

    def _mean(self, rows: Rows) -> np.ndarray:
        """Superposed responses [m or m/s]; a command that acts at an instant is already seen there."""
        instant, place = np.unique(rows.time, return_inverse=True)
        c = self.response
        position, later = self._superposed(c.step, c.gain_error, instant, 0), 0.0
        speed = self._superposed(c.impulse, c.gain_error_rate, instant, 0) if rows.speed.any() else position
        if rows.velocity.any():
            later = self._superposed(c.step, c.gain_error, instant, self.ahead)
        velocity = (later - position) / self.period
        return rows.position * position[place] + rows.speed * speed[place] + rows.velocity * velocity[place]

    def _superposed(
        self,
        to_step: Callable[[np.ndarray], np.ndarray],
        to_error: Callable[[np.ndarray], np.ndarray],
        times: np.ndarray,
        ahead: int,
    ) -> np.ndarray:
        """Responses ``ahead`` [ns] of ``times`` to the commands given until ``times``, (times,)."""
        fed = self.commands
        lag = times[:, None] + ahead - fed.acting
        seen = (lag >= 0) & (fed.given <= times[:, None])
        from_step, from_error = np.zeros(lag.shape), np.zeros(lag.shape)
        from_step[seen] = to_step(lag[seen] * 1e-9)
        if fed.error.any():
            from_error[seen] = to_error(lag[seen] * 1e-9)
        return from_step @ fed.step + from_error @ fed.error

    def _densities(self, first: np.ndarray, stamped: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Noise and drift density squared from ``first`` [ns] on, by commands given until ``stamped``; None: by all."""
        fed, process = self.commands, self.process
        known = len(fed.given) if stamped is None else np.searchsorted(fed.given, stamped, side="right")
        command = np.searchsorted(fed.acting[:known], first, side="right") - 1
        m = np.where(command >= 0, fed.maneuver[command], 0.0)
        return (
            process.input_noise**2 + (process.maneuver_noise * m) ** 2,
            process.drift**2 + (process.maneuver_drift * m) ** 2,
        )

    def _edges(self, begin: int, end: int, others: np.ndarray) -> np.ndarray:
        """Borders of the quadrature's intervals [ns]: where commands act, at ``others``, and 1/fastest pole apart."""
        stride = max(1, int(1e9 / self.response.fastest))
        edges = np.unique(np.concatenate(([begin, end], others, self.commands.acting, np.arange(begin, end, stride))))
        return edges[(edges >= begin) & (edges <= end)]

    def _driven(self, rows: Rows) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Quadrature weights times the two densities (nodes,), and each row's responses to them (rows, nodes)."""
        edges = self._edges(0, int(rows.time.max(initial=1)), rows.time)
        first, last = edges[:-1], edges[1:]
        half = (last - first)[:, None] / 2e9
        weights, to_last = (half * _WEIGHTS).ravel(), (half * (1.0 - _NODES)).ravel()
        noise, drift = (weights * np.repeat(density, len(_NODES)) for density in self._densities(first))
        instant, place = np.unique(rows.time, return_inverse=True)
        since_last = np.repeat(instant[:, None] - last, len(_NODES), axis=1)  # whole ns: no digits lost in short lags
        past, lag = since_last >= 0, since_last / 1e9 + to_last
        age = lag[past]
        impulse, rate, velocity = np.zeros((3, *lag.shape))
        impulse[past] = self.response.impulse(age)
        rate[past] = self.response.impulse_rate(age)
        velocity[past] = (self.response.impulse(age + self.ahead * 1e-9) - impulse[past]) / self.period
        seen = rows.position[:, None] * impulse[place] + rows.speed[:, None] * rate[place]
        return noise, drift, seen + rows.velocity[:, None] * velocity[place], rows.level[:, None] * past[place]

    def _ahead(self, rows: Rows) -> np.ndarray:
        """Variance [m²/s²] that the noise to come adds to each row's velocity, by commands given until its time."""
        found = np.zeros(len(rows.time))
        for k in np.flatnonzero(rows.velocity):
            now = int(rows.time[k])
            edges = self._edges(now, now + self.ahead, rows.time[:0])
            half = np.diff(edges)[:, None] / 2e9
            left = (now + self.ahead - edges[1:, None]) / 1e9 + half * (1.0 - _NODES)
            noise, drift = self._densities(edges[:-1], now)
            found[k] = (half * _WEIGHTS * self.response.impulse(left) ** 2).sum(axis=1) @ noise
            found[k] += 2.0 * half[:, 0] @ drift
        return found / self.period**2

    def _measurements_as_rows(self, order: Sequence[Measurement]) -> Rows:
        scale = [self.config.sensors[measurement.sensor].scale for measurement in order]
        return Rows.at([measurement.valid for measurement in order], position=scale)


@dataclass(frozen=True)
class _Joint:
    """Prior of rows in decimals: mean (rows,), variance (rows,), covariance with the measurements (rows, n)."""

    mean: np.ndarray
    variance: np.ndarray
    cross: np.ndarray

    def first(self, count: int) -> _Joint:
        return _Joint(self.mean[:count], self.variance[:count], self.cross[:count])


def _substituted(K: np.ndarray, L: np.ndarray) -> np.ndarray:
    """C with C Lᵀ = K, L lower triangular."""
    C = K.copy()
    for j in range(len(L)):
        C[:, j] = (K[:, j] - C[:, :j].dot(L[j, :j]) if j else K[:, j]) / L[j, j]
    return C


def _dot(a: np.ndarray, b: np.ndarray) -> Decimal:
    return sum(a * b, start=Decimal(0))


def _root(variance: np.ndarray) -> np.ndarray:
    """Standard deviations as floats; a variance that is negative beyond the quadrature's rounding is an error."""
    assert all(value > Decimal("-1e-30") for value in variance)
    return np.array([float(max(value, Decimal(0)).sqrt()) for value in variance])

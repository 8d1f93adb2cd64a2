"""The tight path against dense filters, a joint Gaussian conditioned once, and :func:`pumafuse.fuse`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from decimal import Decimal, localcontext

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pumafuse.fusion.outcome import Outcome

import pumafuse as pf
from pumafuse.fusion import ticks
from pumafuse.fusion.consistency import log_likelihood
from pumafuse.model.plants import Plant

DIGITS = 50
UNDER = pf.SecondOrder(natural_frequency=45.0, damping=0.4)
OVER = pf.SecondOrder(natural_frequency=45.0, damping=1.8)
LAG = pf.FirstOrder(time_constant=0.0425)
LL_OFFSET = 0.5 * math.log(2.0 * math.pi)

_decimal = np.frompyfunc(Decimal, 1, 1)


# ---- oracles --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Axis:
    """What :func:`pumafuse.discretize` is asked for, and the offset's prior."""

    plant: Plant
    delay: float = 0.06045
    period: float = 0.028
    input_noise: float = 0.3e-3
    drift: float | None = 0.8e-3
    offset_sd: float = 0.0

    @property
    def model(self) -> pf.DiscreteModel:
        return self._model(self.drift)

    @property
    def whole(self) -> pf.DiscreteModel:
        """The model with its offset in the state wherever there is one: without drift it stays what it was."""
        return self._model(0.0 if self.drift is None and self.offset_sd > 0.0 else self.drift)

    def _model(self, drift: float | None) -> pf.DiscreteModel:
        return pf.discretize(self.plant, self.period, self.delay, input_noise=self.input_noise, drift=drift)

    def start(self) -> tuple[pf.DiscreteModel, np.ndarray]:
        """The whole model, and P before the first command."""
        model = self.whole
        P = np.zeros_like(model.F)
        if "offset" in model.states:
            offset = model.states.index("offset")
            P[offset, offset] = self.offset_sd**2
        return model, P


@dataclass(frozen=True)
class Wanted:
    """As :class:`pumafuse.TickEstimates`, of one run, with variances; arrays are (steps,)."""

    position: np.ndarray
    variance: np.ndarray
    innovation: np.ndarray
    innovation_variance: np.ndarray
    log_likelihood: float


def dense(axis: Axis, command: np.ndarray, measurements: np.ndarray, sd: float, digits: int | None = None) -> Wanted:
    """A Kalman filter in Joseph form on the delay-augmented matrices, in doubles or in decimals."""
    number: type[float] | type[Decimal] = float if digits is None else Decimal
    model, P = axis.start()
    F, B, H, Q, P, eye = (_as(number, part) for part in (model.F, model.B, model.H, model.Q, P, np.eye(len(P))))
    x, R = _as(number, np.zeros_like(model.B)), number(float(sd)) ** 2
    rows, terms = list[tuple[float, ...]](), list[float]()
    with localcontext(prec=digits or DIGITS):
        for v, z in zip(command, measurements, strict=True):
            S = (H @ P @ H.T)[0, 0] + R
            nu = number(float(z)) - (H @ x)[0, 0]
            if not math.isnan(z):
                K = P @ H.T / S
                rest = eye - K @ H
                x, P = x + K * nu, rest @ P @ rest.T + K @ K.T * R
                terms.append(-LL_OFFSET - 0.5 * float(np.log(float(S))) - 0.5 * float(nu * nu / S))
            rows.append(tuple(map(float, ((H @ x)[0, 0], (H @ P @ H.T)[0, 0], nu, S))))
            x, P = F @ x + B * number(float(v)), F @ P @ F.T + Q
    return Wanted(*np.array(rows).reshape(-1, 4).T, math.fsum(terms))


def conditioned(axis: Axis, command: np.ndarray, measurements: np.ndarray, sd: float) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of p at all ticks given all measurements: their joint Gaussian, conditioned in decimals."""
    model, P = axis.start()
    steps = len(command)
    F, B, H, Q, P = (_as(Decimal, part) for part in (model.F, model.B, model.H, model.Q, P))
    x, R = _as(Decimal, np.zeros_like(model.B)), Decimal(float(sd)) ** 2
    mean, joint = _as(Decimal, np.zeros(steps)), _as(Decimal, np.zeros((steps, steps)))
    with localcontext(prec=DIGITS):
        for n in range(steps):
            mean[n], column = (H @ x)[0, 0], P @ H.T
            for later in range(n, steps):
                joint[n, later] = joint[later, n] = (H @ column)[0, 0]
                column = F @ column
            x, P = F @ x + B * Decimal(float(command[n])), F @ P @ F.T + Q
        for n in np.flatnonzero(~np.isnan(measurements)):
            toward = joint[:, n] / (joint[n, n] + R)
            mean = mean + toward * (Decimal(float(measurements[n])) - mean[n])
            joint = joint - np.outer(toward, joint[n])
        return mean.astype(float), np.diagonal(joint).astype(float)


def _as(number: type[float] | type[Decimal], values: np.ndarray) -> np.ndarray:
    return np.asarray(_decimal(values)) if number is Decimal else np.array(values)


def close(got: np.ndarray, wanted: np.ndarray, sd: np.ndarray, tolerance: float = 1e-9, text: str = "") -> None:
    """Means agree to ``tolerance`` sd + 1e-12 m and are missing together."""
    np.testing.assert_array_equal(np.isnan(got), np.isnan(wanted), err_msg=text)
    met = ~np.isnan(wanted)
    np.testing.assert_array_less(np.abs(got - wanted)[met] - tolerance * sd[met], 1e-12, err_msg=text)


def check(got: pf.TickEstimates, run: int | None, wanted: Wanted, tolerance: float = 1e-9) -> None:
    """Everything about one run (None: the only one) agrees with the dense filter."""
    position, sd, nu, nu_sd = (
        getattr(got, field.name) if run is None else getattr(got, field.name)[run] for field in fields(got)[:4]
    )
    close(position, wanted.position, np.sqrt(wanted.variance), tolerance, "position")
    np.testing.assert_allclose(sd**2, wanted.variance, rtol=tolerance, atol=0.0, err_msg="variance")
    close(nu, wanted.innovation, np.sqrt(wanted.innovation_variance), tolerance, "innovation")
    np.testing.assert_allclose(nu_sd**2, wanted.innovation_variance, rtol=tolerance, atol=0.0, err_msg="S")
    likelihood = got.log_likelihood[run or 0]
    assert abs(likelihood - wanted.log_likelihood) <= 1e-9 * abs(wanted.log_likelihood) + 1e-9


# ---- any runs -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """Runs side by side; what is each's own is drawn from ``seed``.

    Attributes:
        axis: Of the first run; the others' plants, noise and drift differ where ``own_model``.
        missing: Share of measurements that are NaN.
    """

    axis: Axis
    steps: int
    runs: int = 1
    sd: float = 0.3e-3
    missing: float = 0.2
    own_model: bool = False
    own_command: bool = True
    own_measurements: bool = True
    own_sd: bool = False
    seed: int = 1

    def axes(self) -> list[Axis]:
        if not self.own_model:
            return [self.axis] * self.runs
        rng = np.random.default_rng(self.seed + 1)
        plants = (self.axis.plant, UNDER, OVER, LAG)
        drifts = (self.axis.drift, None, 0.0, 1e-3)
        return [
            replace(
                self.axis,
                plant=plants[(run + self.seed) % 4 if run else 0],
                input_noise=self.axis.input_noise * rng.uniform(0.3, 1.0),
                drift=drifts[int(rng.integers(4)) if run else 0],
            )
            for run in range(self.runs)
        ]

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Commands, measurements (one or many) and sds (one or many), as the functions take them."""
        rng = np.random.default_rng(self.seed)
        command = rng.normal(0.0, 5e-3, (self.runs if self.own_command else 1, self.steps))
        measurements = rng.normal(0.0, 5e-3, (self.runs if self.own_measurements else 1, self.steps))
        measurements[rng.random(measurements.shape) < self.missing] = np.nan
        sd = self.sd * rng.uniform(0.5, 1.5, self.runs) if self.own_sd else np.array(self.sd)
        return (
            command if self.own_command else command[0],
            measurements if self.own_measurements else measurements[0],
            sd,
        )

    def asked(self) -> tuple[pf.DiscreteModel | list[pf.DiscreteModel], np.ndarray, np.ndarray, np.ndarray]:
        model = [axis.model for axis in self.axes()] if self.own_model else self.axis.model
        return model, *self.arrays()

    def one(self, run: int) -> tuple[Axis, np.ndarray, np.ndarray, float]:
        command, measurements, sd = self.arrays()
        index = (run if self.own_command else 0, run if self.own_measurements else 0)
        return (
            self.axes()[run],
            np.atleast_2d(command)[index[0]],
            np.atleast_2d(measurements)[index[1]],
            float(np.broadcast_to(sd, self.runs)[run]),
        )

    @property
    def count(self) -> int:
        """How many runs the arrays and models tell of."""
        own = self.own_model or self.own_command or self.own_measurements or self.own_sd
        return self.runs if own else 1


def plants() -> st.SearchStrategy[Plant]:
    damping = st.one_of(st.floats(0.1, 1.8), st.just(1.0))
    second = st.builds(pf.SecondOrder, natural_frequency=st.floats(8.0, 70.0), damping=damping)
    return st.one_of(st.builds(pf.FirstOrder, time_constant=st.floats(0.005, 0.1)), second)


@st.composite
def axes(draw: st.DrawFn, steps: int) -> Axis:
    delays = [st.integers(0, 4).map(float), st.floats(0.0, 5.0)]
    if steps <= 10:
        delays.append(st.floats(0.0, 3.0).map(lambda more: steps + more))
    period = draw(st.sampled_from([0.028, 0.002, 0.05]))
    return Axis(
        plant=draw(plants()),
        delay=period * draw(st.one_of(delays)),
        period=period,
        input_noise=draw(st.sampled_from([0.0, 0.05e-3, 1e-3])),
        drift=draw(st.sampled_from([None, 0.0, 0.8e-3, 5e-3])),
        offset_sd=draw(st.sampled_from([0.0, 0.5e-3, 5e-3])),
    )


@st.composite
def cases(draw: st.DrawFn, most_runs: int = 40, most_steps: int = 50) -> Case:
    steps, yes = draw(st.integers(1, most_steps)), st.booleans()
    return Case(
        axis=draw(axes(steps)),
        steps=steps,
        runs=draw(st.integers(1, most_runs)),
        sd=draw(st.floats(0.1e-3, 3e-3)),
        missing=draw(st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0])),
        own_model=draw(yes),
        own_command=draw(yes),
        own_measurements=draw(yes),
        own_sd=draw(yes),
        seed=draw(st.integers(0, 10_000)),
    )


CASES = {
    "one run": Case(Axis(UNDER), 50),
    "one run, first order": Case(Axis(LAG), 50),
    "no delay": Case(Axis(UNDER, delay=0.0), 20),
    "a delay of less than a tick": Case(Axis(OVER, delay=0.011), 20, runs=3),
    "a delay of two ticks": Case(Axis(LAG, delay=0.056), 20, runs=3),
    "a delay beyond the run": Case(Axis(UNDER, delay=0.3), 8, runs=3),
    "never an offset": Case(Axis(UNDER, drift=None), 50, runs=17),
    "a constant offset": Case(Axis(LAG, drift=None, offset_sd=5e-3), 50, runs=17),
    "an offset that walks": Case(Axis(OVER, offset_sd=5e-3), 50, runs=17),
    "all missing": Case(Axis(UNDER), 12, runs=2, missing=1.0),
    "nothing but offset": Case(Axis(UNDER, input_noise=0.0), 50, runs=2),
    "certain": Case(Axis(UNDER, input_noise=0.0, drift=None), 50, runs=2),
    "certain, one run": Case(Axis(LAG, input_noise=0.0, drift=None), 50),
    "parameter sets on one run": Case(Axis(UNDER), 33, 37, own_command=False, own_measurements=False, own_model=True),
    "all its own": Case(Axis(UNDER), 33, runs=37, own_model=True, own_sd=True),
    "sds on one run": Case(Axis(LAG), 9, runs=5, own_command=False, own_measurements=False, own_sd=True),
    "lanes full": Case(Axis(UNDER), 16, runs=32),
}


def check_filtered(case: Case) -> None:
    got = pf.filter_ticks(*case.asked(), offset_sd=case.axis.offset_sd)
    alone = case.count == 1 and np.ndim(case.arrays()[1]) == 1
    for field in fields(got)[:4]:
        shape = (case.steps,) if alone else (case.count, case.steps)
        assert getattr(got, field.name).shape == shape, field.name
    assert got.log_likelihood.shape == (case.count,)
    for run in range(case.count):
        check(got, None if alone else run, dense(*case.one(run)))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_estimates_are_those_of_a_dense_filter(case: Case) -> None:
    """Estimates, innovations and likelihoods are those of a Kalman filter on F, B, H and Q."""
    check_filtered(case)


@settings(derandomize=True, deadline=None, max_examples=40)
@given(cases(most_runs=20, most_steps=30))
def test_estimates_of_any_runs_are_those_of_a_dense_filter(case: Case) -> None:
    """Whatever plants, delays, offsets, gaps, and whatever is shared between the runs."""
    check_filtered(case)


@pytest.mark.long
@settings(derandomize=True, deadline=None, max_examples=400)
@given(cases())
def test_estimates_of_many_runs_are_those_of_a_dense_filter(case: Case) -> None:
    """As above, longer and wider."""
    check_filtered(case)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(cases())
def test_the_likelihood_alone_is_that_of_the_filter(case: Case) -> None:
    """`tick_likelihood` is the last part of `filter_ticks`, to the last bit."""
    wanted = pf.filter_ticks(*case.asked(), offset_sd=case.axis.offset_sd).log_likelihood
    np.testing.assert_array_equal(pf.tick_likelihood(*case.asked(), offset_sd=case.axis.offset_sd), wanted)


# ---- alone and among others -----------------------------------------------------------------------------------------

ROUNDING = 2e-12  # of one standard deviation, and of the variance and likelihood


@settings(derandomize=True, deadline=None, max_examples=30)
@given(cases())
def test_a_run_alone_and_among_others_agree_to_rounding(case: Case) -> None:
    """The kernels for one run and for many differ by less than 2e-12 of an error bar over 50 steps."""
    many = pf.filter_ticks(*case.asked(), offset_sd=case.axis.offset_sd)
    for run in range(case.count):
        axis, command, measurements, sd = case.one(run)
        one = pf.filter_ticks(axis.model, command, measurements, sd, offset_sd=axis.offset_sd)
        for mean, spread in (("position", "position_sd"), ("innovation", "innovation_sd")):
            wanted, got = getattr(one, mean), np.atleast_2d(getattr(many, mean))[run]
            wanted_sd, got_sd = getattr(one, spread), np.atleast_2d(getattr(many, spread))[run]
            np.testing.assert_array_equal(np.isnan(got), np.isnan(wanted))
            met = ~np.isnan(wanted)
            np.testing.assert_array_less((np.abs(got - wanted) - ROUNDING * wanted_sd)[met], 1e-16)
            np.testing.assert_allclose(got_sd, wanted_sd, rtol=ROUNDING, atol=0.0)
        np.testing.assert_allclose(many.log_likelihood[run], one.log_likelihood[0], rtol=ROUNDING, atol=ROUNDING)


@settings(derandomize=True, deadline=None, max_examples=30)
@given(cases(), st.integers(0, 100))
def test_a_run_among_others_does_not_depend_on_its_place(case: Case, seed: int) -> None:
    """Shuffled runs give the same numbers to the last bit, shuffled."""
    case = replace(case, runs=max(case.runs, 2), own_model=True, own_command=True, own_measurements=True, own_sd=True)
    models, command, measurements, sd = case.asked()
    order = np.random.default_rng(seed).permutation(case.runs)
    wanted = pf.filter_ticks(models, command, measurements, sd, offset_sd=case.axis.offset_sd)
    shuffled = [models[k] for k in order]
    got = pf.filter_ticks(shuffled, command[order], measurements[order], sd[order], offset_sd=case.axis.offset_sd)
    for field in fields(got):
        np.testing.assert_array_equal(getattr(got, field.name), getattr(wanted, field.name)[order])


@pytest.mark.parametrize("runs", [2, 16, 17, 40, 100])
def test_the_cores_do_not_change_the_numbers(monkeypatch: pytest.MonkeyPatch, runs: int) -> None:
    """One, two, three or many cores: the same to the last bit."""
    case = Case(Axis(UNDER), 21, runs=runs, own_model=True, own_sd=True)
    found = []
    for cores in (1, 2, 3, 9):
        monkeypatch.setattr(ticks, "usable_cores", lambda cores=cores: cores)
        found.append(pf.filter_ticks(*case.asked()))
        np.testing.assert_array_equal(pf.tick_likelihood(*case.asked()), found[0].log_likelihood)
    for other in found[1:]:
        for field in fields(other):
            np.testing.assert_array_equal(getattr(other, field.name), getattr(found[0], field.name))


# ---- fuse -----------------------------------------------------------------------------------------------------------


def fused(axis: Axis, command: np.ndarray, measurements: np.ndarray, sd: float, *, smooth: bool) -> pf.Estimates:
    """What :func:`pumafuse.fuse` makes of a run whose level at rest is 0.5 m."""
    level, stamps = 0.5, np.arange(len(command)) * round(axis.period * 1e9)
    plain = pf.Process(input_noise=axis.input_noise, drift=axis.drift or 0.0)
    arm = pf.ArmModel(
        name="an arm", update_period=axis.period, delay=axis.delay, axes={"radial": pf.AxisModel(plant=axis.plant)}
    )
    config = pf.FusionConfig(
        arm=arm,
        start=pf.Start(offset_sd=axis.offset_sd),
        process={"radial": plain},
        sensors={"tracker": pf.Sensor(sd=sd, gate=0.0)},
    )
    heard = {"tracker": (stamps, {"radial": measurements + level})}
    run = pf.Run.from_arrays(stamps, {"radial": command + level}, heard, start={"radial": level})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)  # missing values and noise that is not the model's
        return pf.fuse(run, config, smooth=smooth)


@st.composite
def fusible(draw: st.DrawFn) -> Case:
    """One run whose times are whole nanoseconds, as stamps are."""
    case = draw(cases(most_runs=1, most_steps=40))
    return replace(case, runs=1, own_model=False, axis=replace(case.axis, delay=round(case.axis.delay * 1e9) / 1e9))


@pytest.mark.parametrize("smooth", [False, True], ids=["filtered", "smoothed"])
@settings(derandomize=True, deadline=None, max_examples=40)
@example(case=Case(Axis(UNDER, offset_sd=5e-3), 40))
@example(case=Case(Axis(LAG, drift=None, offset_sd=5e-3), 40))
@example(case=Case(Axis(OVER, drift=None), 40))
@given(fusible())
def test_the_tight_path_gives_what_fuse_gives(smooth: bool, case: Case) -> None:
    """Positions, error bars, innovations and likelihood of a run on its ticks are those of `fuse`."""
    axis, command, measurements, sd = case.one(0)
    estimates = fused(axis, command, measurements, sd, smooth=smooth)
    function = pf.smooth_ticks if smooth else pf.filter_ticks
    got = function(axis.model, command, measurements, sd, offset_sd=axis.offset_sd)
    wanted, met = estimates["radial"], ~np.isnan(measurements)
    close(got.position + 0.5, wanted.position, wanted.position_sd)
    np.testing.assert_allclose(got.position_sd**2, wanted.position_sd**2, rtol=1e-9, atol=0.0)
    components = estimates.measurements.where(estimates.measurements.outcome == Outcome.FUSED)
    close(got.innovation[met], components.innovation, components.innovation_sd)
    np.testing.assert_allclose(got.innovation_sd[met] ** 2, components.innovation_sd**2, rtol=1e-9, atol=0.0)
    in_metres = log_likelihood(components, estimates.config.sensors) + met.sum() * math.log(1e3)
    np.testing.assert_allclose(got.log_likelihood[0], in_metres, rtol=1e-9, atol=1e-9)


# ---- smoothing ------------------------------------------------------------------------------------------------------


def check_smoothed(case: Case) -> None:
    axis, command, measurements, sd = case.one(0)
    smoothed = pf.smooth_ticks(axis.model, command, measurements, sd, offset_sd=axis.offset_sd)
    position, variance = conditioned(axis, command, measurements, sd)
    close(smoothed.position, position, np.sqrt(variance))
    np.testing.assert_allclose(smoothed.position_sd**2, variance, rtol=1e-9, atol=0.0)
    check(replace(smoothed, position=(filtered := dense(axis, command, measurements, sd)).position,
                  position_sd=np.sqrt(filtered.variance)), None, filtered)  # fmt: skip
    assert (smoothed.position_sd**2 <= filtered.variance * (1.0 + 1e-12)).all()


@pytest.mark.parametrize("case", [case for case in CASES.values() if case.runs == 1])
def test_smoothing_conditions_the_joint_gaussian(case: Case) -> None:
    """Smoothed positions and error bars are those of all positions given all measurements at once."""
    check_smoothed(case)


@settings(derandomize=True, deadline=None, max_examples=50)
@given(cases(most_runs=1, most_steps=25))
def test_smoothing_any_run_conditions_the_joint_gaussian(case: Case) -> None:
    """So it is whatever is missing; innovations and likelihood are the filter's, and no error bar is wider than its."""
    check_smoothed(case)


@pytest.mark.parametrize("gap", [0, 4])
@pytest.mark.parametrize("offset_sd", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("plant", [UNDER, LAG])
def test_smoothing_is_as_good_as_it_says(plant: Plant, offset_sd: float, gap: int) -> None:
    """Beside a wide offset prior a smoothed variance is off by no more than a few roundings of the prior's."""
    axis, command, measurements, sd = Case(Axis(plant, offset_sd=offset_sd), 25, sd=0.05e-3).one(0)
    measurements[:gap] = np.nan
    smoothed = pf.smooth_ticks(axis.model, command, measurements + offset_sd, sd, offset_sd=offset_sd)
    position, variance = conditioned(axis, command, measurements + offset_sd, sd)
    close(smoothed.position, position, np.sqrt(variance), 1e-6)
    np.testing.assert_allclose(smoothed.position_sd**2, variance, rtol=0.0, atol=1e-15 * offset_sd**2)


# ---- extremes -------------------------------------------------------------------------------------------------------

SDS = [10.0**power for power in range(-9, 4)]
OFFSETS = {
    "none": (None, 0.0),
    "constant": (None, 5e-3),
    "walk": (0.8e-3, 0.0),
    "walk from 5 mm": (0.8e-3, 5e-3),
    "unknown": (0.8e-3, 1.0),
}


@pytest.mark.parametrize("offset", OFFSETS.values(), ids=OFFSETS.keys())
@pytest.mark.parametrize("sd", SDS)
@pytest.mark.parametrize("plant", [UNDER, pytest.param(LAG, marks=pytest.mark.long)])
def test_any_noise_of_measurements_is_met(plant: Plant, sd: float, offset: tuple[float | None, float]) -> None:
    """Against 50 digits: 1e-9 while what was not known is under 1e5 sd, 1e-6 up to 1e6, beyond that still sound."""
    for noise in (0.0, 0.03e-3, 0.3e-3, 10e-3):
        axis = Axis(plant, input_noise=noise, drift=offset[0], offset_sd=offset[1])
        _, command, measurements, _ = Case(axis, 40, sd=sd).one(0)
        wanted = dense(axis, command, measurements, sd, DIGITS)
        ratio = math.sqrt(wanted.innovation_variance.max()) / sd
        one = pf.filter_ticks(axis.model, command, measurements, sd, offset_sd=offset[1])
        many = pf.filter_ticks(axis.model, command, [measurements, measurements], sd, offset_sd=offset[1])
        smooth = pf.smooth_ticks(axis.model, command, measurements, sd, offset_sd=offset[1])
        for got in (one, many, smooth):
            for values in (got.position, got.position_sd, got.innovation_sd, got.log_likelihood):
                assert np.isfinite(values).all()
            assert (got.position_sd >= 0.0).all()
        if ratio <= 1e6:
            check(one, None, wanted, 1e-9 if ratio <= 1e5 else 1e-6)
            check(many, 1, wanted, 1e-9 if ratio <= 1e5 else 1e-6)


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("axis", [Axis(UNDER), Axis(LAG, drift=None)])
def test_a_long_gap_is_bridged_by_the_model(axis: Axis, many: bool) -> None:
    """Ten thousand ticks without a measurement: positions follow the commands, variances grow to what the model says."""
    steps, model = 10_000, axis.model
    command = np.random.default_rng(3).normal(0.0, 5e-3, steps)
    measurements = np.full((1 + many, steps), np.nan)
    measurements[:, 0] = command[0]
    got = pf.filter_ticks(model, command, measurements, 0.1e-3)
    state, settled = np.zeros((len(model.F), 1)), np.empty(steps)
    for n in range(steps):
        settled[n] = (model.H @ state)[0, 0]
        state = model.F @ state + model.B * command[n]
    plant = axis.plant
    lag = isinstance(plant, pf.FirstOrder)
    ring = 0.5 / plant.time_constant if lag else 0.25 * plant.natural_frequency / plant.damping
    walked = (axis.drift or 0.0) ** 2 * axis.period * (steps - 1)
    for run in range(1 + many):
        np.testing.assert_allclose(got.position[run], settled, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(got.position_sd[run, -1] ** 2, axis.input_noise**2 * ring + walked, rtol=1e-9)
        assert got.innovation_sd[run, 0] == 0.1e-3
        assert np.isnan(got.innovation[run, 1:]).all()


@pytest.mark.parametrize("value", [np.inf, -np.inf])
@pytest.mark.parametrize("drift", [None, 0.8e-3])
@pytest.mark.parametrize("runs", [1, 3])
def test_an_infinite_measurement_is_not_fused(value: float, drift: float | None, runs: int) -> None:
    """It is as good as missing, as `fuse` has it (`invalid`), and poisons nothing."""
    model, command, missing, sd = Case(Axis(UNDER, drift=drift), 20, runs=runs, missing=0.0).asked()
    missing[:, 4] = np.nan
    infinite = np.where(np.isnan(missing), value, missing)
    wanted, got = (pf.filter_ticks(model, command, measurements, sd) for measurements in (missing, infinite))
    for field in ("position", "position_sd", "log_likelihood"):
        np.testing.assert_array_equal(getattr(got, field), getattr(wanted, field), err_msg=field)
    np.testing.assert_array_equal(pf.tick_likelihood(model, command, infinite, sd), wanted.log_likelihood)
    if runs == 1:
        smoothed = (pf.smooth_ticks(model, command, measurements, float(sd)) for measurements in (missing, infinite))
        np.testing.assert_array_equal(*(one.position for one in smoothed))


def test_a_masked_measurement_is_missing() -> None:
    """What lies under the mask is nothing that was measured."""
    model, command, measurements, sd = Case(Axis(UNDER), 20, runs=3, missing=0.3).asked()
    masked = np.ma.masked_array(np.nan_to_num(measurements, nan=7.0), mask=np.isnan(measurements))
    wanted, got = (pf.filter_ticks(model, command, one, sd) for one in (measurements, masked))
    np.testing.assert_array_equal(got.position, wanted.position)
    np.testing.assert_array_equal(got.log_likelihood, wanted.log_likelihood)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("function", [pf.filter_ticks, pf.smooth_ticks, pf.tick_likelihood])
def test_a_command_that_is_no_number_is_refused(function: Callable[..., object], value: float) -> None:
    """Else all later positions are NaN, later measurements look missing, and a likelihood of the rest looks sound."""
    model, command, measurements, sd = Case(Axis(UNDER), 20).asked()
    command[0, 3] = value
    with pytest.raises(ValueError, match=r"^[^\n]*command[^\n]*$"):
        function(model, command, measurements, float(sd))


def test_no_steps_are_no_estimates() -> None:
    """A run of no ticks has empty estimates and a likelihood of 1."""
    model = Axis(UNDER).model
    for function in (pf.filter_ticks, pf.smooth_ticks):
        got = function(model, [], [], 1e-3)
        assert got.position.shape == (0,)
        assert got.log_likelihood.tolist() == [0.0]
    assert pf.filter_ticks(model, np.empty((3, 0)), np.empty((3, 0)), 1e-3).position.shape == (3, 0)


# ---- what is refused ------------------------------------------------------------------------------------------------

MODEL = Axis(UNDER).model
OTHER = Axis(UNDER, delay=0.03).model
SLOWER = Axis(UNDER, period=0.03).model
ROW = np.zeros(5)
ROWS = np.zeros((3, 5))
REFUSED: dict[str, tuple[object, npt.ArrayLike, npt.ArrayLike, npt.ArrayLike, float]] = {
    "fewer commands": (MODEL, ROW[:4], ROW, 1e-3, 0.0),
    "more commands": (MODEL, np.zeros(6), ROWS, 1e-3, 0.0),
    "two commands for three": (MODEL, ROWS[:2], ROWS, 1e-3, 0.0),
    "two sds for three": (MODEL, ROW, ROWS, [1e-3, 1e-3], 0.0),
    "two models for three": ([MODEL, MODEL], ROW, ROWS, 1e-3, 0.0),
    "no models": ([], ROW, ROW, 1e-3, 0.0),
    "no runs": (MODEL, ROW, np.empty((0, 5)), 1e-3, 0.0),
    "no sd": (MODEL, ROW, ROW, [], 0.0),
    "three dimensions": (MODEL, np.zeros((1, 5, 1)), np.zeros((1, 5, 1)), 1e-3, 0.0),
    "measurements of three dimensions": (MODEL, ROW, np.zeros((2, 5, 2)), 1e-3, 0.0),
    "several delays": ([MODEL, OTHER], ROW, ROW, 1e-3, 0.0),
    "several periods": ([MODEL, SLOWER], ROW, ROW, 1e-3, 0.0),
    **{f"sd {sd}": (MODEL, ROW, ROW, sd, 0.0) for sd in (0.0, -1e-3, math.nan, math.inf)},
    "one sd 0": (MODEL, ROW, ROWS, [1e-3, 0.0, 1e-3], 0.0),
    "one sd NaN": (MODEL, ROW, ROWS, [1e-3, math.nan, 1e-3], 0.0),
    **{f"offset_sd {sd}": (MODEL, ROW, ROW, 1e-3, sd) for sd in (-1e-3, math.nan, math.inf)},
}


@pytest.mark.parametrize("function", [pf.filter_ticks, pf.smooth_ticks, pf.tick_likelihood])
@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_in_one_line(function: Callable[..., object], name: str) -> None:
    """Shapes, delays and noise that do not fit together are a ValueError of one line."""
    *arguments, offset_sd = REFUSED[name]
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        function(*arguments, offset_sd=offset_sd)


@pytest.mark.parametrize(
    "arguments",
    [(MODEL, ROW, ROWS, 1e-3), (MODEL, ROWS, ROW, 1e-3), ([MODEL] * 3, ROW, ROW, 1e-3), (MODEL, ROW, ROW, [1e-3] * 3)],
    ids=["measurements", "commands", "models", "sds"],
)
def test_only_one_run_is_smoothed(arguments: tuple[object, ...]) -> None:
    """More runs are a ValueError of one line."""
    with pytest.raises(ValueError, match=r"^smooth_ticks takes one run[^\n]*$"):
        pf.smooth_ticks(*arguments)


# ---- memory ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [Case(Axis(UNDER), 20), Case(Axis(UNDER, offset_sd=1e-3), 20, runs=18, own_sd=True)])
@pytest.mark.parametrize("flat", [False, True])
def test_arrays_given_are_neither_changed_nor_kept(case: Case, flat: bool) -> None:
    """Results share no memory with the caller's arrays or with each other, and nothing given is written to."""
    model, command, measurements, sd = case.asked()
    if flat:
        command, measurements = command[0], measurements[0]
    given = [command, measurements, sd, model.F, model.B, model.H, model.Q]
    kept = [array.copy() for array in given]
    results = [pf.filter_ticks(model, command, measurements, sd, offset_sd=case.axis.offset_sd)]
    results.append(pf.filter_ticks(model, command, measurements, sd, offset_sd=case.axis.offset_sd))
    if case.runs == 1:
        results.append(pf.smooth_ticks(model, command, measurements, float(sd), offset_sd=case.axis.offset_sd))
    pf.tick_likelihood(model, command, measurements, sd, offset_sd=case.axis.offset_sd)
    made = [getattr(result, field.name) for result in results for field in fields(result)]
    for array, copy in zip(given, kept, strict=True):
        np.testing.assert_array_equal(array, copy)
    for index, array in enumerate(made):
        assert not any(np.shares_memory(array, other) for other in (*given, *made[:index]))


@pytest.mark.parametrize("runs", [1, 5])
def test_any_layout_and_kind_of_number_is_taken(runs: int) -> None:
    """Lists, other strides, single precision and whole numbers give what contiguous doubles give."""
    rng = np.random.default_rng(5)
    command, measurements = (rng.integers(-9, 9, (runs, 11)).astype(float) for _ in range(2))
    wanted = pf.filter_ticks(MODEL, command, measurements, 0.5)
    layouts: list[Callable[[np.ndarray], npt.ArrayLike]] = [
        lambda a: a.tolist(),
        np.asfortranarray,
        lambda a: np.repeat(a, 2, axis=1)[:, ::2],
        lambda a: a[:, ::-1].copy()[:, ::-1],
        lambda a: a.astype(np.float32),
        lambda a: a.astype(np.int64),
    ]
    for layout in layouts:
        got = pf.filter_ticks(MODEL, layout(command), layout(measurements), 0.5)
        for field in fields(got):
            np.testing.assert_array_equal(getattr(got, field.name), getattr(wanted, field.name))

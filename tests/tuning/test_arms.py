"""Arms against a recorded motion: likelihoods are those of the dense joint Gaussian, fits are maxima."""

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replaced
from scipy.stats import multivariate_normal

from pumafuse.filter.response import response
from pumafuse.model.arm import Sag
from pumafuse.tuning.arms import Arm, Limits, Measured, NoiseModel, Recording, noise_models

T = 0.02
OFFSET = 30.0  # times the range of what is measured: where an offset may begin
FREE = Limits({"delay": (0.0, 1.0), "lag": (1e-3, 2.0), "damping": (0.2, 8.0), "gain": (0.5, 1.5)}, {})
NAMES = ["delay", "lag", "damping", "gain"]


def recording(seed: int, count: int = 60, sensors: int = 1) -> Recording:
    rng = np.random.default_rng(seed)
    given = np.arange(100) * round(T * 1e9)
    command = 0.3 + np.cumsum(rng.normal(0.0, 0.01, 100))
    time = np.sort(rng.integers(0, given[-1], count))
    value = rng.normal(0.0, 0.02, count).cumsum()
    return Recording(given, command, 0.3, time, value, rng.integers(0, sensors, count), np.ones(count))


def covariance(one: Recording, rest: NoiseModel, offset_sd: float) -> np.ndarray:
    """Of all that is measured: an offset that walks from its beginning, a disturbance and white noise."""
    t = (one.time - one.time[0]) / 1e9
    apart = np.abs(t[:, None] - t)
    smooth = np.sqrt(3.0) * apart / rest.disturbance_time
    alike = (1.0 + smooth) * np.exp(-smooth) if rest.smoothness > 1.0 else np.exp(-apart / rest.disturbance_time)
    walk = offset_sd**2 + rest.walk**2 * np.minimum(t[:, None], t)
    return walk + rest.disturbance_sd**2 * alike + np.diag(rest.sd[one.source] ** 2)


RESTS = [
    NoiseModel(np.array([0.01]), 0.0),
    NoiseModel(np.array([0.01]), 0.02),
    NoiseModel(np.array([0.003]), 0.01, 0.03, 0.1, 1.5),
    NoiseModel(np.array([0.003]), 0.0, 0.03, 0.05, 0.5),
]
ARMS = [
    Arm(0.05, 0.08, gain=0.9),
    Arm(0.0, 0.03, damping=0.7),
    Arm(0.11, 0.2, damping=1.3, recovery=0.2, gain=1.2),
    Arm(0.02, 0.05, recovery=0.1, gain=0.8, slope=0.05),
]


@pytest.mark.parametrize("arm", ARMS[1:3])
def test_what_bends_an_axis_is_part_of_its_response(arm: Arm) -> None:
    """Play and a fastest speed of the arm, the sag that is known of the axis; of parts of a recording, too."""
    bent = arm._replace(max_speed=0.4, play=0.01)
    axis = replaced(bent.model, sag=Sag(offset=0.01, slope=-0.05))
    assert Arm.of(axis, arm.delay) == pytest.approx(bent, rel=1e-12)
    one = recording(3)
    expected = response(axis, T, arm.delay, one.stamp, one.command, one.start, one.time)
    straight = response(arm.model, T, arm.delay, one.stamp, one.command, one.start, one.time)
    assert np.abs(expected - straight).max() > 0.005
    measured = Measured([one], T, ["a"], axis).of([one._replace(value=expected).of(slice(None, None, 2))])
    np.testing.assert_allclose(measured.responses(bent)[0], expected[::2], rtol=0.0, atol=1e-12)  # cut elsewhere
    assert np.abs(measured.residuals(bent)[0]).max() < 1e-12


@pytest.mark.parametrize("arm", [*ARMS, ARMS[1]._replace(max_speed=0.4, play=0.01)])
def test_arms_weigh_as_much_among_others_as_alone(arm: Arm) -> None:
    """Whether those before and after differ in their dead times alone, or in more."""
    others = [arm._replace(delay=delay) for delay in (0.3, 0.0, 0.01234, 0.3)] + [arm._replace(lag=0.07), arm]
    measured = Measured([recording(3), recording(4, 0), recording(5, 40)], T, ["a"])
    log, gain = measured.weighed(others, RESTS[3], FREE)
    alone = [measured.weighed([one], RESTS[3], FREE) for one in others]
    np.testing.assert_array_equal(log, np.concatenate([one for one, _ in alone]))
    np.testing.assert_array_equal(gain, np.concatenate([one for _, one in alone]))


@pytest.mark.parametrize(("arm", "rest"), list(zip(ARMS, RESTS, strict=True)))
def test_the_likelihood_of_an_arm_is_the_joint_gaussians(arm: Arm, rest: NoiseModel) -> None:
    """Of what the arm leaves, in two recordings that rest at two levels before their first command."""
    other = recording(2, 40)
    parts = [recording(1), other._replace(command=other.command + 0.4, start=other.start + 0.4)]
    measured, expected = Measured(parts, T, ["a"]), 0.0
    reach = max(np.ptp(one.value) for one in parts)
    for one in parts:
        moved = response(arm.model, T, arm.delay, one.stamp, one.command, one.start, one.time)
        cov = covariance(one, rest, OFFSET * reach)
        expected += multivariate_normal.logpdf(one.value - moved, cov=cov)
    assert measured.weighed([arm], rest)[0][0] == pytest.approx(expected, rel=1e-7)
    assert measured.fitted(arm, [], rest, FREE).log_posterior == pytest.approx(expected, rel=1e-7)


def test_the_best_gain_is_that_of_generalised_least_squares() -> None:
    """And the likelihood is that with this gain, beside a second sensor that is off by any constant."""
    one, rest, arm = recording(3, 80, sensors=2), NoiseModel(np.array([0.01, 0.02]), 0.02), Arm(0.05, 0.08)
    measured = Measured([one], T, ["a", "b"])
    log, gain = measured.weighed([arm], rest, Limits({}, {}))
    r = response(arm.model, T, arm.delay, one.stamp, one.command, one.start, one.time)
    X = np.column_stack([r, one.source == 1])
    inverse = np.linalg.inv(covariance(one, rest, OFFSET * np.ptp(one.value)))
    best = np.linalg.solve(X.T @ inverse @ X, X.T @ inverse @ one.value)
    assert gain[0] == pytest.approx(best[0], rel=1e-6)
    again, _ = measured.weighed([arm._replace(gain=float(gain[0]))], rest)
    assert log[0] == pytest.approx(again[0], rel=1e-9)


@pytest.mark.parametrize(("rows", "period"), [(30_000, 0.02), (10_000, 0.001)])
def test_a_long_recording_is_known_by_where_each_quarter_of_it_moves_most(rows: int, period: float) -> None:
    """What moved the arm before a part is not seen in it; the noise of neighbours is still that of neighbours."""
    rng, count, most = np.random.default_rng(6), 10_000, 6_000
    given = np.arange(count) * round(period * 1e9)
    lively = np.isin(np.arange(count) // 250, [3, 13, 24, 37])  # one stretch in each quarter
    command = np.cumsum(rng.normal(0.0, np.where(lively, 0.01, 0.001)))
    time = np.sort(rng.integers(0, given[-1], rows))
    one = Recording(given, command, 0.0, time, np.zeros(rows), np.zeros(rows, dtype=int), np.ones(rows))
    arm = Arm(0.05, 0.08)
    whole = Measured([one._replace(value=Measured([one], period, ["a"]).responses(arm)[0])], period, ["a"])
    parts = whole.liveliest(most)
    assert 0.2 * most < parts.count <= 1.05 * most  # times are random
    for part, stretch in zip(parts.recordings, [3, 13, 24, 37], strict=True):
        seen = part.time[:, None] == time
        assert seen.any(axis=1).all() and (np.diff(np.argmax(seen, axis=1)) == 1).all()
        assert part.time[0] < (stretch * 250 + 200) * period * 1e9
        assert part.time[-1] > (stretch * 250 + 50) * period * 1e9
    assert np.abs(np.concatenate(parts.residuals(arm))).max() < 1e-9
    assert whole.liveliest(rows + count).recordings == whole.recordings


def test_a_fit_is_a_maximum_and_its_information_the_curvature() -> None:
    """A simulated second-order arm: no neighbour is likelier, and the likelihood falls as the information says."""
    one, rest, true = recording(5, 400), NoiseModel(np.array([1e-3])), Arm(0.05, 0.1, damping=0.8, gain=0.95)
    moved = response(true.model, T, true.delay, one.stamp, one.command, one.start, one.time)
    value = moved + np.random.default_rng(5).normal(0.0, 1e-3, 400)
    measured = Measured([one._replace(value=value)], T, ["a"])
    found = measured.fitted(Arm(0.06, 0.08, damping=1.0), NAMES, rest, FREE)
    assert found.arm == pytest.approx(true, abs=0.03)
    sd = np.sqrt(np.diag(np.linalg.inv(found.information)))
    for place, name in enumerate(NAMES):
        at, lower = found.arm.coordinate(name), []
        for sign in (-1.0, 1.0):
            beside = found.arm.moved([name], [at + sign * sd[place]])
            lower.append(found.log_posterior - measured.fitted(beside, [], rest, FREE).log_posterior)
        expected = 0.5 * found.information[place, place] * sd[place] ** 2
        assert np.mean(lower) == pytest.approx(expected, rel=0.05), name


def test_a_fit_that_cannot_get_as_high_as_is_worth_it_ends_at_once() -> None:
    """Far below what is worth it an arm stays where it begins; a worth within reach changes no maximum."""
    one, rest, true = recording(5, 400), NoiseModel(np.array([1e-3])), Arm(0.05, 0.1, gain=0.95)
    moved = response(true.model, T, true.delay, one.stamp, one.command, one.start, one.time)
    value = moved + np.random.default_rng(7).normal(0.0, 1e-3, 400)
    measured, begin = Measured([one._replace(value=value)], T, ["a"]), Arm(0.06, 0.09)
    names = ["delay", "lag", "gain"]
    highest = measured.fitted(begin, names, rest, FREE)
    assert measured.fitted(begin, names, rest, FREE, math.inf).arm == pytest.approx(begin)
    within = measured.fitted(begin, names, rest, FREE, highest.log_posterior)
    assert within.arm == highest.arm


@pytest.mark.long
@pytest.mark.parametrize(("number", "smoothness"), [(1, 1.5), (2, 0.5)], ids=["smooth", "rough"])
def test_what_an_arm_leaves_is_found(number: int, smoothness: float) -> None:
    """A smooth and a rough disturbance with white noise: the right one is likelier."""
    rest = NoiseModel(np.array([2e-3]), 1e-6, 0.02, 0.3, smoothness)
    one = recording(6, 1500)._replace(time=np.arange(1500) * 20_000_000)
    value = np.random.default_rng(7).multivariate_normal(np.zeros(1500), covariance(one, rest, 1e-3))
    still = one._replace(value=value, command=np.full(100, 0.3))
    found = list(noise_models(Measured([still], T, ["a"]), Arm(0.0, 0.1), 0.04, [1e-6]))
    assert found[number][1] > found[3 - number][1]
    likely = found[number][0]
    assert likely.sd[0] == pytest.approx(2e-3, rel=0.15 if number < 2 else 0.4)  # a rough one is nearly as white
    assert (likely.disturbance_sd, likely.disturbance_time) == pytest.approx((0.02, 0.3), rel=0.35)


@pytest.mark.parametrize("believed", [False, True])
def test_noise_is_believed_to_be_what_second_differences_show_where_the_arm_is_calm(believed: bool) -> None:
    """Within a factor of 1.9: log-posteriors are the likelihood less half the square of that, at a maximum."""
    one, arm = recording(3), Arm(0.05, 0.08)
    measured = Measured([one], T, ["a"])
    path = response(arm.model, T, arm.delay, one.stamp, one.command, one.start, one.time)
    ways = np.ptp(np.lib.stride_tricks.sliding_window_view(path, 3), axis=1)
    calm = ways <= np.quantile(ways, 1.0 / 3.0)
    shown = np.median(np.abs(np.diff(one.value - path, 2))[calm]) / (0.6745 * np.sqrt(6.0))

    def posterior(rest: NoiseModel) -> float:
        x = np.log(rest.sd[0] / shown) / np.log(1.9)
        return float(measured.weighed([arm], rest)[0][0]) - 0.5 * x**2 * believed

    for rest, log in noise_models(measured, arm, 0.04, [1e-6], believed):
        assert log == pytest.approx(posterior(rest), abs=1e-3)
        beside = [posterior(replace(rest, sd=rest.sd * by)) for by in (0.7, 1.4)]
        assert max(beside) < log + 0.05


def test_jitter_is_told_where_the_arm_is_calm() -> None:
    """An arm that is off by 20 mm at random while it moves, half of the time, seen with 2 mm."""
    rng, one = np.random.default_rng(2), recording(3)
    time = np.arange(0, 20 * 10**9, 10**7)
    moving = np.sin(time / 2e9) > 0.0
    command = np.cumsum(np.where(moving, 1e-3, 0.0))
    swing = one._replace(stamp=time, command=command, start=0.0, time=time, source=np.zeros(len(time), np.int64))
    arm = Arm(0.0, 1e-3)
    path = response(arm.model, T, arm.delay, time, command, 0.0, time)
    value = path + rng.normal(0.0, np.where(moving, 0.02, 2e-3))
    seen = swing._replace(value=value, weight=np.ones(len(time)))
    assert Measured([seen], T, ["a"]).jitter(arm)[0] == pytest.approx(2e-3, rel=0.15)

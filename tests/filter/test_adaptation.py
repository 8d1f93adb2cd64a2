"""Noise that grows where innovations show it: by hand, in both engines, by its derivative, and what it is for."""

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_

import pumafuse as pf
from pumafuse.arrays import FloatArray
from pumafuse.filter.events import COMMAND
from pumafuse.filter.window import Window
from pumafuse.fusion.setup import filter_model

# that noise is too small, that a sensor jumped: it is
pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")

AXIS = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04))
ARM = pf.ArmModel(name="an arm", update_period=1.0 / 30.0, delay=0.03, axes={"x": AXIS})
SD = 0.3e-3
WALK = pf.Process(input_noise=0.0, drift=1e-3, adaptation=0.3)
EVERYTHING = pf.Process(
    input_noise=0.2e-3, drift=0.5e-3, maneuver_noise=0.4e-3, maneuver_drift=5e-3, disturbance_sd=1e-3,
    disturbance_time=0.1, adaptation=0.2,
)  # fmt: skip


def config_of(process: pf.Process, **sensor: float) -> pf.FusionConfig:
    return pf.FusionConfig(
        arm=ARM, start=pf.Start(offset_sd=2e-3), process={"x": process}, sensors={"camera": pf.Sensor(sd=SD, **sensor)}
    )


def run_of(moved: FloatArray, seed: int = 1) -> pf.Run:
    """A tool that follows a sine, off by what is ``moved`` from a command to the next, and a camera that sees it."""
    time = np.arange(len(moved)) * ARM.update_period
    command = {"x": 0.1 * np.sin(time)}
    led = pf.fuse(pf.Run.from_arrays(time, command, {}), config_of(WALK), sensors=[])
    truth = led["x"].position + moved
    seen = truth + SD * np.random.default_rng(seed).standard_normal(len(time))
    return pf.Run.from_arrays(time, command, {"camera": (time, {"x": seen})}, reference=(time, {"x": truth}))


def livelier(factor: float, seed: int = 0) -> FloatArray:
    """A random walk of 1 mm in √s, twenty seconds of it, so many times as large in the second half."""
    steps = 1e-3 * math.sqrt(1.0 / 30.0) * np.random.default_rng(seed).standard_normal(600)
    return np.cumsum(np.where(np.arange(600) < 300, steps, factor * steps))


def by_hand(innovation: FloatArray, gaps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """S of each innovation of a random walk, and how many times as large its noise is before each."""
    P, unrest, S, scales = 2e-3**2, 0.0, np.zeros(len(gaps)), np.zeros(len(gaps))
    for k, (nu, gap) in enumerate(zip(innovation.tolist(), gaps.tolist(), strict=True)):
        scales[k] = math.exp(unrest)
        P += scales[k] * WALK.drift**2 * gap
        S[k] = P + SD**2
        unrest = max(0.0, unrest + WALK.adaptation * min(P / S[k] * (nu**2 / S[k] - 1.0), 10.0))
        P *= SD**2 / S[k]
    return S, scales


def test_noise_takes_a_step_along_the_score_of_each_measurement() -> None:
    """Of a random walk that is measured: every S by hand, and what is smoothed by the equations of a dense Gaussian."""
    run = run_of(livelier(8.0))
    est = pf.fuse(run, config_of(WALK))
    rows = est.measurements
    gaps = np.diff(rows.time, prepend=0.0)
    S, scales = by_hand(rows.innovation, gaps)
    np.testing.assert_allclose(rows.innovation_sd, np.sqrt(S), rtol=1e-9)
    np.testing.assert_allclose(rows.noise_scale, scales, rtol=1e-9)
    assert scales.max() > 8.0
    walked = np.minimum.outer(*[np.cumsum(scales * WALK.drift**2 * gaps)] * 2) + 2e-3**2
    gain = np.linalg.solve(walked + SD**2 * np.eye(len(gaps)), walked)
    smoothed = pf.fuse(run, config_of(WALK), mode="smoothed")["x"]
    np.testing.assert_allclose(smoothed.position_sd**2, np.diag(walked - walked @ gain), rtol=1e-6)


@pytest.mark.parametrize("sensor", [{}, {"gate": 4.0}, {"bias_drift_sd": 2e-4, "bias_sd": 3e-4}])
def test_both_engines_adapt_alike(sensor: dict[str, float]) -> None:
    """With noise of every kind, which all grow together; a bias is the sensor's, and its noise does not."""
    run, config = run_of(livelier(9.0)[280:320]), config_of(EVERYTHING, **sensor)
    core, filterpy = (pf.fuse(run, config, engine=engine) for engine in ("compiled", "filterpy"))
    np.testing.assert_allclose(core["x"].position, filterpy["x"].position, rtol=0, atol=1e-10)
    np.testing.assert_allclose(core["x"].position_sd, filterpy["x"].position_sd, rtol=1e-7)
    np.testing.assert_allclose(core.measurements.noise_scale, filterpy.measurements.noise_scale, rtol=1e-7)
    steady = pf.fuse(run, config_of(with_(EVERYTHING, adaptation=0.0), **sensor))
    assert not np.allclose(core["x"].position_sd, steady["x"].position_sd, rtol=0.01)


def test_a_stream_tells_how_far_its_noise_has_grown() -> None:
    """To the bit as a recording does, and what it tells of each row is that row's."""
    run, config = run_of(livelier(8.0)), config_of(WALK)
    window = Window(filter_model(config, ("x",), ("camera",)))
    camera = run.sensors["camera"]
    for stamp, command, seen in zip(camera.stamp.tolist(), run.command.values["x"], camera.values["x"], strict=True):
        for source, value in ((COMMAND, command), (0, seen)):
            window.value[0] = value
            window.add(stamp, source, 1, int(camera.stamp[0]))
    _, source, results = window.read(window.port.begin, window.port.end)
    recorded = pf.fuse(run, config, mode="as-live").measurements
    for told, of_recording in ((results.noise_scale, recorded.noise_scale), (results.innovation, recorded.innovation)):
        np.testing.assert_array_equal(told[source >= 0, 0], of_recording)


def test_bars_hold_where_the_arm_is_livelier_than_was_learnt() -> None:
    """95 % bars of a random walk that grows eightfold: 90 to 98 % of 20 runs, where steady noise holds below 70 %."""
    runs = [run_of(livelier(8.0, seed), seed=100 + seed) for seed in range(20)]
    shares: dict[float, float] = {}
    for adaptation in (0.0, 0.1):
        config, held = config_of(with_(WALK, adaptation=adaptation)), []
        for run in runs:
            assert run.reference is not None
            est = pf.fuse(run, config)["x"]
            error = est.position - run.reference.values["x"]
            held.append(np.abs(error[300:]) < 1.96 * est.position_sd[300:])
        shares[adaptation] = float(np.mean(held))
    assert shares[0.0] < 0.7
    assert 0.90 < shares[0.1] < 0.98


def test_an_outlier_is_no_unrest() -> None:
    """A measurement that its gate rejects says nothing, and one that re-acquires is a jump."""
    still = run_of(np.zeros(600))
    camera = still.sensors["camera"]
    jumped = camera.values["x"].copy()
    jumped[200] += 0.05
    jumped[300:] += 0.05
    run = replace(still, sensors={"camera": replace(camera, values={"x": jumped})})
    config = config_of(with_(WALK, drift=0.3e-3, adaptation=0.5), gate=5.0)
    sd = pf.fuse(run, config)["x"].position_sd
    assert sd[[*range(205, 230), *range(310, 330)]].max() < 1.3 * sd[100:200].max()


def test_a_step_beyond_the_whole_score_is_refused() -> None:
    """A million of it would leave no number behind."""
    with pytest.raises(pf.ConfigError, match=r"process\.x\.adaptation: must be <= 1"):
        pf.fuse(run_of(np.zeros(60)), config_of(with_(WALK, adaptation=1e6)))


def test_how_far_a_lively_arm_may_move_between_rejected_rows_adapts() -> None:
    """A slip of 50 mm, then 5 mm more within two rows: eight times as lively as learnt that agrees, and re-acquires."""
    run = run_of(livelier(8.0))
    camera = run.sensors["camera"]
    slipped = camera.values["x"].copy()
    slipped[500:] += 0.05
    slipped[502:] += 0.005
    run = replace(run, sensors={"camera": replace(camera, values={"x": slipped})})
    outcome = pf.fuse(run, config_of(WALK, gate=5.0)).measurements.outcome
    assert outcome[499:503].tolist() == [
        pf.Outcome.FUSED, pf.Outcome.REJECTED, pf.Outcome.REJECTED, pf.Outcome.REACQUIRED,
    ]  # fmt: skip

"""The algebra of one axis against plain matrices: exponentials, textbook updates, the recursion of the commands."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from kernels import callable_kernel
from pumafuse.arrays import FloatArray
from pumafuse.filter import axis as algebra
from pumafuse.filter import forward
from pumafuse.filter.axis import (
    DRIFT,
    ERROR,
    NOISE,
    NONE,
    OFFSET,
    REST,
    STEP,
    Model,
    Sensors,
    State,
    U,
)
from pumafuse.fusion.config import FusionConfig, Process, Sensor
from pumafuse.fusion.setup import at_rest, columns_of, filter_model, filter_sensors
from pumafuse.model.arm import ArmModel, AxisModel, Gain
from pumafuse.model.plants import FirstOrder, SecondOrder

apply_command = callable_kernel(algebra.apply_command)
copy_rows = callable_kernel(algebra.copy_rows)
innovation = callable_kernel(algebra.innovation)
noise = callable_kernel(algebra.noise)
position_of = callable_kernel(algebra.position_of)
predict_plant, predict_rest = callable_kernel(algebra.predict_plant), callable_kernel(algebra.predict_rest)
update = callable_kernel(algebra.update)
checkpoint_of = callable_kernel(forward.checkpoint_of)


def predict(model: Model, state: State, axis: int, row: int, time: int) -> None:
    """Bring all of a row to a time."""
    predict_plant(model, state, axis, row, time)
    predict_rest(model, state, axis, row)


T, DECAY = 0.028, 1.0 / 0.15
AXES = ("lag", "turning", "slow")
PLANTS = [
    FirstOrder(time_constant=0.04),
    SecondOrder(natural_frequency=45.0, damping=0.4),
    SecondOrder(natural_frequency=30.0, damping=1.6),
]
GAIN = Gain(slope=0.08, intercept=0.93)
PROCESS = Process(input_noise=0.2e-3, drift=0.5e-3, maneuver_noise=0.4e-3, maneuver_drift=5e-3)
SENSORS = {
    "plain": Sensor(sd=1e-4, scale=-2.0),
    "biased": Sensor(sd=3e-4, bias_sd=5e-3, latency_sd=0.004),
    "other": Sensor(sd=3e-4, bias_sd=1e-3),
}
every_axis = pytest.mark.parametrize("axis", range(3), ids=AXES)


def arranged(places: int = 0) -> tuple[Model, Sensors, State]:
    """Three axes in any state, with the biases of two sensors."""
    axes = {
        name: AxisModel(plant=plant, gain=GAIN, gain_recovery=1.0 / DECAY)
        for name, plant in zip(AXES, PLANTS, strict=True)
    }
    arm = ArmModel(name="an arm", update_period=T, delay=0.06, axes=axes)
    config = FusionConfig(arm=arm, process=dict.fromkeys(AXES, PROCESS), sensors=SENSORS)
    columns = columns_of(config, AXES, [["biased", "other"]] * 3)
    state = at_rest(columns, 3, 0, dict.fromkeys(AXES, 0.5), places)
    rng = np.random.default_rng(1)
    for axis, plant in enumerate(PLANTS):
        root = rng.normal(0.0, 1e-3, state.P[axis].shape)
        state.x[axis] = rng.normal(0.0, 1e-3, len(root))
        if isinstance(plant, FirstOrder):
            root[1] = state.x[axis, 1] = 0.0
        state.P[axis] = root @ root.T
        state.drive[axis, U : DRIFT + 1] = rng.normal(0.0, 1e-2, 5) ** 2
    return filter_model(columns), filter_sensors(columns, list(SENSORS)), state


def plant_matrices(axis: int) -> tuple[FloatArray, FloatArray]:
    """A and B of position and rate; a lag has no rate."""
    plant = PLANTS[axis]
    if isinstance(plant, FirstOrder):
        return np.array([[-1.0 / plant.time_constant, 0.0], [0.0, -1.0]]), np.array([[1.0 / plant.time_constant], [0]])
    w = plant.natural_frequency
    return np.array([[0.0, 1.0], [-w * w, -2.0 * plant.damping * w]]), np.array([[0.0], [w * w]])


@every_axis
@pytest.mark.parametrize("ns", [1, 1_000_000, 28_000_000, 300_000_000])
def test_predict_is_a_matrix_exponential(axis: int, ns: int) -> None:
    """Means with an input that is held and one that decays, covariance with white noise on the input."""
    model, _, state = arranged()
    x, P, drive, dt = state.x[axis].copy(), state.P[axis].copy(), state.drive[axis].copy(), ns / 1e9
    A, B = plant_matrices(axis)
    driven = np.zeros((4, 4))
    driven[:2, :2], driven[:2, 2:3], driven[:2, 3:], driven[3, 3] = A, B, B, -DECAY
    moved = expm(driven * dt)
    F, Q = np.eye(len(x)), np.zeros_like(P)
    F[:2, :2] = moved[:2, :2]
    nodes, weights = np.polynomial.legendre.leggauss(12)  # ∫ e^(As) B Bᵀ e^(Aᵀs) ds, in short pieces
    pieces = int(dt * 200) + 1
    width = dt / pieces
    for s, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        for piece in range(pieces):
            g = expm(A * (piece + s) * width) @ B
            Q[:2, :2] += weight * width * drive[NOISE] * g @ g.T
    Q[OFFSET, OFFSET] = drive[DRIFT] * dt
    predict(model, state, axis, axis, ns)
    wanted = F @ x
    wanted[:2] += moved[:2, 2] * drive[U] + moved[:2, 3] * drive[ERROR]
    np.testing.assert_allclose(state.x[axis], wanted, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(state.P[axis], F @ P @ F.T + Q, rtol=1e-9, atol=1e-17)
    assert state.drive[axis, ERROR] == pytest.approx(drive[ERROR] * np.exp(-DECAY * dt), rel=1e-13)
    assert state.clock[axis] == ns


@every_axis
def test_p_may_stay_behind_commands(axis: int) -> None:
    """Brought on once at the end, P is what it is when it is brought on before each command, whose noise differs."""
    model, _, behind = arranged()
    _, _, along = arranged()
    for ns, command in ((5_000_000, 0.51), (33_000_000, 0.49), (34_000_000, 0.53), (80_000_000, 0.52)):
        predict_plant(model, behind, axis, axis, ns)
        predict(model, along, axis, axis, ns)
        for state in (behind, along):
            apply_command(model, state, axis, axis, command)
    assert behind.settled[axis] == 0 and not np.array_equal(behind.P[axis], along.P[axis])
    predict(model, behind, axis, axis, 100_000_000)
    predict(model, along, axis, axis, 100_000_000)
    for part, other in zip(behind.by_row, along.by_row, strict=True):
        np.testing.assert_allclose(part, other, rtol=1e-11, atol=1e-18)


@every_axis
def test_two_intervals_are_one(axis: int) -> None:
    """Stopping on the way changes nothing, and going back in time is no prediction."""
    model, _, state = arranged()
    _, _, whole = arranged()
    predict(model, state, axis, axis, 7_000_001)
    predict(model, state, axis, axis, 40_000_000)
    predict(model, whole, axis, axis, 40_000_000)
    for part, other in zip(state.by_row, whole.by_row, strict=True):
        np.testing.assert_allclose(part, other, rtol=1e-11, atol=1e-18)
    before = state.x.copy()
    predict(model, state, axis, axis, 30_000_000)
    np.testing.assert_array_equal(state.x, before)


def test_a_command_sets_input_gain_error_and_noise() -> None:
    """U is relative to the start, e jumps by (K − 1)·step, the densities follow |u_n − 2u_(n−1) + u_(n−2)| / T."""
    model, _, state = arranged()
    state.drive[0, 1:] = 0.0
    u, error = [0.0, 0.0], 0.0
    for command in (0.5, 0.502, 0.501, 0.501, 0.52):
        apply_command(model, state, 0, 0, command)
        u.append(command - 0.5)
        step, maneuver = u[-1] - u[-2], abs(u[-1] - 2 * u[-2] + u[-3]) / T
        error += (GAIN.slope * abs(step) / T + GAIN.intercept - 1.0) * step
        drive = state.drive[0]
        np.testing.assert_allclose(drive[[U, STEP, ERROR]], [u[-1], step, error], rtol=1e-12, atol=1e-15)
        input_noise = PROCESS.input_noise**2 + (PROCESS.maneuver_noise * maneuver) ** 2
        drift = PROCESS.drift**2 + (PROCESS.maneuver_drift * maneuver) ** 2
        np.testing.assert_allclose(drive[[NOISE, DRIFT]], [input_noise, drift], rtol=1e-9)


@every_axis
@pytest.mark.parametrize("sensor", range(3), ids=SENSORS.keys())
def test_an_update_is_the_textbook_s(axis: int, sensor: int) -> None:
    """ν, S, K, x⁺ and P⁺ in Joseph form, with R larger by the speed times the latency's spread."""
    model, sensors, state = arranged()
    x, P = state.x[axis].copy(), state.P[axis].copy()
    known = list(SENSORS.values())[sensor]
    H = np.zeros(len(x))
    H[[0, OFFSET]] = known.scale
    if sensor:
        H[REST + sensor - 1] = 1.0
    A, B = plant_matrices(axis)
    speed = (A @ x[:2] + B[:, 0] * (state.drive[axis, U] + state.drive[axis, ERROR]))[0]
    R = (1.5 * known.sd) ** 2 + (known.scale * speed * known.latency_sd) ** 2
    assert noise(model, sensors, state, axis, sensor, 1.5) == pytest.approx(R, rel=1e-12)
    z = known.scale * 0.5 + 3e-3
    nu, S = innovation(model, sensors, state, axis, sensor, z, R)
    assert nu == pytest.approx(3e-3 - H @ x, rel=1e-10)
    assert pytest.approx(H @ P @ H + R, rel=1e-12) == S
    K = P @ H / S
    left = np.eye(len(x)) - np.outer(K, H)
    update(model, state, axis, nu, R)
    np.testing.assert_allclose(state.x[axis], x + K * nu, rtol=1e-10, atol=1e-16)
    np.testing.assert_allclose(state.P[axis], left @ P @ left.T + R * np.outer(K, K), rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal(state.P[axis], state.P[axis].T)
    h = np.zeros(len(x))
    h[[0, OFFSET]] = 1.0
    assert position_of(NONE, state.x, state.P, axis) == pytest.approx(
        (h @ state.x[axis], h @ state.P[axis] @ h), rel=1e-12
    )


def test_what_a_measurement_does_not_see_keeps_its_bits() -> None:
    """A bias that shares nothing with the rest is as it was."""
    model, sensors, state = arranged()
    last = REST + 1
    state.P[1, last, :last] = state.P[1, :last, last] = 0.0
    x, P = state.x[1, last], state.P[1, last, last]
    innovation(model, sensors, state, 1, 0, 0.5, 1e-8)
    update(model, state, 1, 1e-3, 1e-8)
    assert (state.x[1, last], state.P[1, last, last]) == (x, P)
    assert not state.P[1, last, :last].any()


def test_a_checkpoint_brings_back_every_bit() -> None:
    """Whatever was done since; the other places stay as they are."""
    model, sensors, state = arranged(3)
    before = [part[:3].copy() for part in state.by_row]
    place = checkpoint_of(model, 4, 3)
    copy_rows(state, 0, place, 3)
    for axis in range(3):
        predict(model, state, axis, axis, 50_000_000)
        apply_command(model, state, axis, axis, 0.51)
        innovation(model, sensors, state, axis, 1, 0.5, 1e-8)
        update(model, state, axis, 1e-3, 1e-8)
    for part in (state.rejected, state.gate_time, state.gate_count, state.unsettled):
        part[:3] = 7
    copy_rows(state, place, 0, 3)
    for part, was in zip(state.by_row, before, strict=True):
        np.testing.assert_array_equal(part[:3], was)
    for other in (checkpoint_of(model, 3, 3), checkpoint_of(model, 5, 3)):
        assert not state.x[other : other + 3].any()

"""A filter that knows no commands is among ours: gain 0, and a disturbance that is wide and slow."""

from __future__ import annotations

import numpy as np

import pumafuse as pf

DENSITY, SD = 0.3, 1e-3  # m²/s³, m


def constant_velocity(time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and its sd after each measurement, by a Kalman filter with white noise on the acceleration, (n,)."""
    x, P = np.zeros(2), np.diag([1e4, 1e6])
    found: list[tuple[float, float]] = []
    for n, z in enumerate(value):
        dt = time[n] - time[n - 1] if n else 0.0
        F = np.array([[1.0, dt], [0.0, 1.0]])
        x = F @ x
        P = F @ P @ F.T + DENSITY * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        K = P[:, 0] / (P[0, 0] + SD**2)
        x, P = x + K * (z - x[0]), P - np.outer(K, P[0])
        found.append((x[0], np.sqrt(P[0, 0])))
    return np.array(found).T


def test_a_constant_velocity_filter_is_nested() -> None:
    """4 λ³ σ² as that filter's density and λ → 0: the same positions and sds, nearer the slower it reverts."""
    rate = 1e-2
    rng = np.random.default_rng(3)
    time = 0.02 * np.cumsum(rng.integers(1, 5, 300))
    value = 0.1 * np.sin(time) + SD * rng.standard_normal(len(time))
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05), gain=pf.Gain(slope=0.0, intercept=0.0))
    arm = pf.ArmModel(name="deaf", update_period=0.02, delay=0.03, axes={"x": axis})
    wide = pf.Process(disturbance_sd=np.sqrt(DENSITY / (4.0 * rate**3)), disturbance_time=np.sqrt(3.0) / rate)
    sensors = {"camera": pf.Sensor(sd=SD, gate=0.0)}
    config = pf.FusionConfig(arm=arm, start=pf.Start(offset_sd=0.0), process={"x": wide}, sensors=sensors)
    stamps = 0.02 * np.arange(round(time[-1] / 0.02) + 1)
    commands = rng.uniform(-0.2, 0.2, len(stamps))
    est = pf.fuse(pf.Run.from_arrays(stamps, {"x": commands}, {"camera": (time, {"x": value})}), config)
    position, sd = constant_velocity(time, value)
    here = np.searchsorted(est.time, time - 1e-9)[20:]
    np.testing.assert_allclose(est["x"].position[here], position[20:], rtol=0.0, atol=rate * SD)
    np.testing.assert_allclose(est["x"].position_sd[here], sd[20:], rtol=rate)

"""Simulated set-ups with known truth: an arm whose poses are worked out step by step, and a sensor somewhere."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from pumafuse.registration.motion import Motion


@dataclass
class Setup:
    """One set-up and one run of it; lengths in m, angles in rad, times in s.

    Attributes:
        seed: Of everything by chance.
        seconds: How long the run is.
        directions: Along which the tool moves, a row each.
        axes: About which the tool turns, in the base, a row each.
        orientation: Whether the sensor tells orientations.
        shared: Whether orientations answer as positions do.
        wrong: How much the arm's kinematics are wrong, as a share of 0.5 mm and 0.2 degrees: the same at a pose in each
            run.
    """

    seed: int
    seconds: float = 40.0
    directions: np.ndarray = field(default_factory=lambda: np.eye(3))
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    orientation: bool = True
    shared: bool = False
    wrong: float = 0.0
    outliers: float = 0.01
    sd: float = 0.3e-3
    sd_angle: float = 1.5e-3

    def __post_init__(self) -> None:
        chance = self.chance = np.random.default_rng(self.seed)
        self.frame = Rotation.random(rng=chance)
        self.at = chance.uniform(-4.0, 4.0, 3)
        self.marker = chance.uniform(-0.15, 0.15, 3)
        self.turn = Rotation.random(rng=chance)
        self.start = Rotation.random(rng=chance)
        self.rate, self.period = chance.uniform(30.0, 120.0), chance.uniform(0.008, 0.04)
        self.latency = chance.uniform(0.002, 0.06)
        self.plants = [(chance.uniform(0.02, 0.08), chance.uniform(0.02, 0.08)) for _ in range(2)]
        if self.shared:
            self.plants[1] = self.plants[0]

    @property
    def lags(self) -> list[float]:
        """Of positions and orientations, with the sensor's latency."""
        return [sum(plant) + self.latency for plant in self.plants]

    def run(self) -> tuple[Motion, Motion]:
        """What was told and what was seen."""
        chance = self.chance
        told = np.arange(0.0, self.seconds, self.period)
        place = self._wander(told, len(self.directions)) * 0.12 @ self.directions + [0.5, -0.2, 0.4]
        angle = self._wander(told, len(self.axes)) * 0.25 @ self.axes
        time = np.arange(0.0, self.seconds, 1.0 / self.rate) + chance.uniform(
            -1e-3, 1e-3, int(np.ceil(self.seconds * self.rate))
        )
        then = time - self.latency
        where = answer(told, place, then, *self.plants[0])
        turns = answer(told, angle, then, *self.plants[1])
        off = self._kinematics(np.hstack([(where - where.mean(axis=0)) / 0.15, turns / 0.3]))
        where = where + off[:, :3]
        turned = Rotation.from_rotvec(off[:, 3:]) * Rotation.from_rotvec(turns) * self.start
        seen = self.frame.inv().apply(where + turned.apply(self.marker) - self.at) + chance.normal(
            0.0, self.sd, where.shape
        )
        attitude = self.frame.inv() * turned * self.turn
        attitude = attitude * Rotation.from_rotvec(chance.normal(0.0, self.sd_angle, where.shape))
        wrong = chance.random(len(time)) < self.outliers
        seen[wrong] += chance.normal(0.0, 0.02, (wrong.sum(), 3))
        signs = chance.choice([-1.0, 1.0], (len(time), 1))
        command = Motion(told, place, (Rotation.from_rotvec(angle) * self.start).as_quat())
        return command, Motion(time, seen, signs * attitude.as_quat() if self.orientation else None)

    def _kinematics(self, pose: np.ndarray) -> np.ndarray:
        """By how much the arm is off at poses of about 1 [m, rad], (n, 6): waves as long as the motion is wide."""
        chance = np.random.default_rng(self.seed)
        phases = pose @ chance.normal(0.0, 1.0, (6, 6)) + chance.uniform(0.0, 2.0 * np.pi, 6)
        return self.wrong * np.sqrt(2.0 / 3.0) * np.repeat([0.5e-3, np.radians(0.2)], 3) * np.sin(phases)

    def _wander(self, time: np.ndarray, count: int) -> np.ndarray:
        """Sums of sines of about 1, (n, count)."""
        rates = self.chance.uniform(0.05, 0.6, (count, 5))
        phases = self.chance.uniform(0.0, 2.0 * np.pi, (count, 5))
        return np.sin(2.0 * np.pi * rates * time[:, None, None] + phases).sum(axis=2) / np.sqrt(2.5)


def answer(told: np.ndarray, levels: np.ndarray, time: np.ndarray, delay: float, constant: float) -> np.ndarray:
    """A first-order arm's answer to commands that are held: one exponential after another."""
    states = [levels[0]]
    for level, step in zip(levels[:-1], np.diff(told), strict=True):
        states.append(level + (states[-1] - level) * np.exp(-step / constant))
    last = np.clip(np.searchsorted(told, time - delay, side="right") - 1, 0, None)
    since = np.maximum(time - delay - told[last], 0.0)
    return levels[last] + (np.array(states)[last] - levels[last]) * np.exp(-since / constant)[:, None]

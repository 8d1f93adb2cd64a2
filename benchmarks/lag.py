"""Simulated runs of arms of all kinds: do the intervals of `pumafuse latency` hold, and how far off is correlation?

    python benchmarks/lag.py [--runs 200] [--first 1000] [--axes 5] [--drift MS] [--in-step] [--json FILE]

Motion (steps, scans, sweeps, joints), periods (4 to 50 ms), sensors (5 to 200 Hz), plants, gains, delays and noise are
drawn at random. The simulation knows nothing of pumafuse: it holds the commands on a grid of 0.1 ms.
"""

from __future__ import annotations

import argparse
import json
import os
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter, ss2tf

import pumafuse as pf
from pumafuse.errors import PumafuseError, PumafuseWarning

STEP = 1e-4  # s, of the simulation
MOTIONS = ("steps", "scan", "sweep", "joints")
RATES = (5.0, 10.0, 20.0, 30.0, 60.0, 100.0, 200.0)  # Hz
PERIODS = (0.004, 0.008, 0.010, 0.020, 0.028, 0.050)  # s
KINDS = ("lag", "delay", "gain", "gain_recovery", "time_constant", "natural_frequency", "damping", "latency")
Array = np.ndarray


@dataclass(frozen=True)
class Axis:
    """What is true of a simulated axis, SI."""

    delay: float
    order: int
    lag: float  # of the plant
    damping: float
    gain: float
    recovery: float | None

    @property
    def total(self) -> float:
        """Its total lag behind the held command."""
        return self.delay + self.lag + (1.0 - self.gain) * (self.recovery or 0.0)

    def truth(self, kind: str) -> float | None:
        """The true number of a kind; None where it has none."""
        second = self.order == 2
        return {
            "lag": self.total,
            "delay": self.delay,
            "gain": self.gain,
            "gain_recovery": self.recovery,
            "time_constant": None if second else self.lag,
            "natural_frequency": 2.0 * self.damping / self.lag if second else None,
            "damping": self.damping if second else None,
        }[kind]


class Case(NamedTuple):
    """A simulated run, its axes, and the latency of its second sensor, if it has one."""

    run: pf.Run
    axes: dict[str, Axis]
    latency: float | None


class Found(NamedTuple):
    """A number that was found, with its interval and the truth."""

    kind: str
    truth: float
    value: float
    low: float
    high: float


def simulated(seed: int, axes: int, drift: float = 0.0, in_step: bool = False) -> Case:
    """A run of so many axes; the lag grows by ``drift`` [s]. ``in_step``: seen at one instant of each period."""
    rng = np.random.default_rng(seed)
    motion, period, rate = (rng.choice(one) for one in (MOTIONS, PERIODS, RATES))
    duration = max(30.0, 300.0 / rate)
    time = np.arange(0.0, duration, period)
    sensor = _stamps(rng, float(rate), duration)
    if in_step:  # each command, or every n-th, at one instant of its period
        every = max(round(1.0 / (rate * period)), 1)
        sensor = time[int(0.5 / period) :: every][:-5] + rng.choice([0.0, 0.1, 0.5]) * period
    second = _stamps(rng, float(rng.choice(RATES)), duration) if rng.random() < 0.5 else None
    shares, shared = rng.random() < 0.6, rng.uniform(0.01, 0.2)
    latency = float(rng.uniform(0.0, 0.1))
    commands, first, other, truths = {}, {}, {}, {}
    for name in "abcde"[:axes]:
        recovers = rng.random()
        truths[name] = axis = Axis(
            delay=float(shared if shares else rng.uniform(0.01, 0.2)),
            order=int(rng.integers(1, 3)),
            lag=float(np.exp(rng.uniform(np.log(0.01), np.log(0.15)))),
            damping=float(rng.uniform(0.5, 1.5)),
            gain=1.0 if recovers < 0.34 else float(rng.uniform(0.88, 1.08)),
            recovery=float(rng.uniform(0.05, 0.3)) if recovers > 0.67 else None,
        )
        size = float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
        commands[name] = u = size * _motion(rng, str(motion), time)
        noise = size * float(np.exp(rng.uniform(np.log(2e-4), np.log(1e-2))))
        stray = noise * float(rng.choice([0.0, 0.3, 1.0]))
        wander = Wander(rng, stray, float(np.exp(rng.uniform(np.log(0.05), np.log(2.0)))), duration)
        at = _response(axis, time, u, duration)
        late = drift * (sensor / duration - 0.5)
        first[name] = at(sensor - late) + wander(sensor) + rng.normal(0.0, noise, len(sensor))
        if second is not None:
            valid = second - latency
            other[name] = at(valid) + wander(valid) + rng.normal(0.0, 2.0 * noise, len(second))
    sensors = {"tracker": (sensor, first)}
    if second is not None:
        sensors["camera"] = second, other
    run = pf.Run.from_arrays(time, commands, sensors, name=f"{motion}-{seed}")
    return Case(run, truths, latency if second is not None else None)


class Wander:
    """An Ornstein-Uhlenbeck process on a grid of 1 ms."""

    def __init__(self, rng: np.random.Generator, sd: float, lasting: float, duration: float) -> None:
        left = np.exp(-1e-3 / lasting)
        white = rng.normal(0.0, sd * np.sqrt(1.0 - left**2), int(duration / 1e-3) + 1000)
        self.value = lfilter([1.0], [1.0, -left], white)

    def __call__(self, time: Array) -> Array:
        """Its value at times [s], (n,)."""
        return np.interp(time, 1e-3 * np.arange(len(self.value)) - 0.5, self.value)


def _stamps(rng: np.random.Generator, rate: float, duration: float) -> Array:
    """Stamps of a sensor: a regular rate with a jitter of 5 %."""
    even = np.arange(0.5, duration - 0.1, 1.0 / rate)
    return even + rng.uniform(0.0, 1.0 / rate) + rng.uniform(-0.05, 0.05, len(even)) / rate


def _motion(rng: np.random.Generator, kind: str, time: Array) -> Array:
    """A commanded path of size 1 that starts at rest."""
    if kind == "steps":
        at = np.cumsum(rng.uniform(0.5, 2.0, int(time[-1]) * 2 + 4))
        level = rng.uniform(-1.0, 1.0, len(at) + 1)
        return level[np.searchsorted(at, time)]
    if kind == "scan":  # there and back at constant speed, with a rest at each end
        line, rest = rng.uniform(1.0, 4.0), rng.uniform(0.0, 0.5)
        points = np.cumsum(np.tile([rest, line], int(time[-1] / (line + rest)) + 2))
        return np.interp(time, np.append(0.0, points), np.append(0.0, np.resize([0.0, 1.0, 1.0, 0.0], len(points))))
    begin = np.minimum(time / 0.5, 1.0)
    if kind == "sweep":
        low, high = rng.uniform(0.05, 0.2), rng.uniform(0.5, 2.0)
        phase = 2.0 * np.pi * (low * time + 0.5 * (high - low) * time**2 / time[-1])
        return begin * np.sin(phase)
    parts = [(rng.uniform(0.05, 1.0), rng.uniform(0.0, 2.0 * np.pi)) for _ in range(4)]
    return begin * sum(np.sin(2.0 * np.pi * f * time + phase) / (1.0 + 2.0 * f) for f, phase in parts)


def _response(axis: Axis, time: Array, u: Array, duration: float):
    """The noiseless position as a function of the time."""
    grid = np.arange(0.0, duration + 0.5, STEP)
    acting = time + axis.delay
    change = np.diff(u, prepend=u[0])
    cells = np.minimum((acting / STEP).astype(np.int64), len(grid) - 1)
    share = np.clip(1.0 - (acting / STEP - cells), 0.0, 1.0)  # of its first cell that a command is in force
    jump = np.zeros(len(grid) + 1)
    np.add.at(jump, cells, change * share)
    np.add.at(jump, cells + 1, change * (1.0 - share))
    step = np.cumsum(jump[:-1])
    if axis.recovery is None:
        drive = axis.gain * step
    else:
        left = np.exp(-STEP / axis.recovery)
        mean = (1.0 - left) * axis.recovery / STEP  # over a step of the simulation, of an error that is 1 at its start
        drive = step + mean * lfilter([axis.gain - 1.0], [1.0, -left], jump[:-1])
    if axis.order == 1:
        left = np.exp(-STEP / axis.lag)
        moved = lfilter([0.0, 1.0 - left], [1.0, -left], drive)
    else:
        omega = 2.0 * axis.damping / axis.lag
        A = np.array([[0.0, 1.0, 0.0], [-(omega**2), -2.0 * axis.damping * omega, omega**2], [0.0, 0.0, 0.0]])
        F = expm(STEP * A)
        b, a = ss2tf(F[:2, :2], F[:2, 2:], np.array([[1.0, 0.0]]), np.zeros((1, 1)))
        moved = lfilter(b[0], a, drive)
    return lambda at: u[0] + np.interp(at, grid, moved)


def correlated(case: Case, axis: str) -> float:
    """The lag [s] at which the held command correlates best with the sensor, to below a sample: the rival."""
    time, u = case.run.command.stamp / 1e9, case.run.command.values[axis]
    stamp, z = case.run.sensors["tracker"].stamp / 1e9, case.run.sensors["tracker"].values[axis]
    lags = np.arange(0.0, 1.0, 1e-3)

    def correlation(lag: float) -> float:
        held = u[np.clip(np.searchsorted(time, stamp - lag, side="right") - 1, 0, None)]
        return float(np.corrcoef(held, z)[0, 1]) if np.ptp(held) > 0.0 else -1.0

    found = np.array([correlation(lag) for lag in lags])
    best = int(np.argmax(found))
    if not 0 < best < len(lags) - 1:
        return float(lags[best])
    below, here, above = found[best - 1 : best + 2]
    bend = below - 2.0 * here + above
    return float(lags[best] + (0.5e-3 * (below - above) / bend if bend < 0.0 else 0.0))


def examined(job: tuple[int, int, float, bool]) -> tuple[list[Found], list[tuple[float, float]], list[str]]:
    """What is found in a run: numbers with intervals, errors of the lag (ours, the rival's), and what is named."""
    seed, axes, drift, in_step = job
    case = simulated(seed, axes, drift, in_step)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)
        try:
            found = pf.latency(case.run, sensor="tracker").details
        except PumafuseError as error:
            return [], [], [f"refused: {error}"]
    numbers, errors, named = list[Found](), list[tuple[float, float]](), list[str]()
    for name, axis in found.axes.items():
        true = case.axes[name]
        for kind in KINDS[:-1]:
            truth, interval = true.truth(kind), getattr(axis, f"{kind}_ci95")
            if truth is not None and interval is not None:
                numbers.append(Found(kind, truth, getattr(axis, kind), *interval))
        errors.append((axis.lag - true.total, correlated(case, name) - true.total))
        named += [f"{name} drifts by {1e3 * axis.drift:.1f} ms"] if axis.drifts and axis.drift is not None else []
        named += [f"{name} wanders by {1e3 * axis.wander:.1f} ms"] if axis.wander else []
    if case.latency is not None and "camera" in found.sensors:
        camera = found.sensors["camera"]
        numbers.append(Found("latency", case.latency, camera.latency, *camera.latency_ci95))
    named += [f"clock drifts by {1e3 * found.clock_drift:.1f} ms"] if found.clock_drift is not None else []
    named += [f"clock wanders by {1e3 * found.clock_wander:.1f} ms"] if found.clock_wander is not None else []
    return numbers, errors, named


def main() -> None:
    """Examine the runs in processes, and print what holds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    parser.add_argument("--axes", type=int, default=5)
    parser.add_argument("--drift", type=float, default=0.0, help="of the lag over each run [ms]")
    parser.add_argument("--in-step", action="store_true", help="measure at one instant of each period")
    parser.add_argument("--json", type=Path, help="keep every number")
    asked = parser.parse_args()
    os.environ["LOKY_MAX_CPU_COUNT"] = "1"  # a process for each run, not for each axis of it
    seeds = range(asked.first, asked.first + asked.runs)
    jobs = [(seed, asked.axes, 1e-3 * asked.drift, asked.in_step) for seed in seeds]
    numbers, errors, named = list[tuple[int, Found]](), list[tuple[float, float]](), list[list[str]]()
    with ProcessPoolExecutor() as pool:
        for job, (mine, off, what) in zip(jobs, pool.map(examined, jobs), strict=True):
            numbers += [(job[0], one) for one in mine]
            errors += off
            named.append(what)
            for one in what:
                print(f"seed {job[0]}: {one}", flush=True)
    if asked.json:
        asked.json.write_text(json.dumps([[seed, *one] for seed, one in numbers]))
    print("\n".join(report(numbers, errors, named)))


def report(
    numbers: Iterable[tuple[int, Found]], errors: list[tuple[float, float]], named: list[list[str]]
) -> Iterator[str]:
    """What holds, by kind; how far the lag is off; in how many runs a drift or a wandering is named."""
    holds = defaultdict[str, list[bool]](list)
    for _, one in numbers:
        holds[one.kind].append(one.low <= one.truth <= one.high)
    for kind, inside in holds.items():
        yield f"{kind:18} {len(inside):5} intervals, {np.mean(inside):6.1%} hold"
    every = [one for inside in holds.values() for one in inside]
    yield f"{'all':18} {len(every):5} intervals, {np.mean(every):6.1%} hold"
    ours, rival = np.sqrt(np.mean(np.square(errors), axis=0)) * 1e3
    yield f"RMSE of the lag: {ours:.2f} ms, by correlation {rival:.2f} ms"
    middle = np.median(np.abs(errors), axis=0) * 1e3
    yield f"median error of the lag: {middle[0]:.2f} ms, by correlation {middle[1]:.2f} ms"
    yield f"something is named in {sum(map(bool, named))} of {len(named)} runs"


if __name__ == "__main__":
    main()

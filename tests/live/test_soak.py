"""Hours of stream."""

import resource
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

import pumafuse as pf

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")]
HOUR_NS = 3_600_000_000_000
HOURS = 3
PERIOD_NS = 112_000_000
CONFIG = pf.FusionConfig(
    arm=msgspec.structs.replace(pf.ArmModel.load("puma560-internal"), update_period=PERIOD_NS / 1e9),
    process={"radial": pf.Process(maneuver_noise=5e-4, maneuver_drift=1e-2)},
    sensors={"tracker": pf.Sensor(sd=5e-5, latency=0.008), "range": pf.Sensor(sd=3e-4, scale=-1.0, bias_sd=1.0)},
)
Column = tuple[np.ndarray, np.ndarray]


def hour(number: int) -> tuple[Column, Column, Column]:
    """Commands each 112 ms, a tracker at 10 Hz and a range finder at 2.5 Hz; up to 0.2 s late, 1 % wild."""
    rng = np.random.default_rng(number)

    def grid(interval: int) -> np.ndarray:
        return np.arange(-(-number * HOUR_NS // interval) * interval, (number + 1) * HOUR_NS, interval)

    def moved(t: np.ndarray) -> np.ndarray:
        return 0.56 + 0.05 * np.sin(t / 1e9 * 0.7)

    given, near, far = grid(PERIOD_NS), grid(100_111_111), grid(400_000_000)
    wild = np.where(rng.random(len(near)) < 0.01, 0.02, 0.0)
    return (
        (given, moved(given)),
        (near, moved(near - 120_000_000) + rng.normal(0.0, 5e-5, len(near)) + wild),
        (far, 0.9 - moved(far - 110_000_000) + rng.normal(0.0, 3e-4, len(far))),
    )


def arrivals(number: int) -> Iterator[tuple[int, int, float]]:
    """Stamp, kind and value in the order of arrival."""
    rng = np.random.default_rng(1000 + number)
    columns = hour(number)
    kind = np.repeat(np.arange(3), [len(stamp) for stamp, _ in columns])
    stamp = np.concatenate([stamp for stamp, _ in columns])
    value = np.concatenate([value for _, value in columns])
    late = np.where(kind == 0, 0, rng.integers(0, 200_000_000, len(stamp)) * (rng.random(len(stamp)) < 0.05))
    order = np.argsort(stamp + late, kind="stable")
    return zip(stamp[order].tolist(), kind[order].tolist(), value[order].tolist(), strict=True)


def test_a_shift_of_stamps() -> None:
    """3 h of stream, 5 % of it late: memory flat to 5 %, and each hour the offline bits."""
    live = pf.LiveEstimator(CONFIG)
    found: list[pf.LiveEstimate] = []
    peak: list[int] = []
    for number in range(HOURS):
        asked = False
        for stamp, kind, value in arrivals(number):
            if kind == 0:
                live.command(stamp, radial=value)
            else:
                live.measurement(stamp, "tracker" if kind == 1 else "range", radial=value)
            if number and not asked and stamp > number * HOUR_NS + 1_000_000_000:
                found.append(live.estimate(number * HOUR_NS))
                asked = True
        peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert peak[-1] <= 1.05 * peak[0]
    rows = [hour(number) for number in range(HOURS)]
    given, near, far = (
        tuple(np.concatenate([columns[kind][part] for columns in rows]) for part in range(2)) for kind in range(3)
    )
    run = pf.Run.from_arrays(
        given[0],
        {"radial": given[1]},
        {"tracker": (near[0], {"radial": near[1]}), "range": (far[0], {"radial": far[1]})},
    )
    offline = pf.fuse(run, CONFIG, rate=1.0 / 3600.0)
    assert len(found) == HOURS - 1
    for number, estimate in enumerate(found, start=1):
        assert offline.time[number] == number * 3600.0
        assert estimate["radial"].position == offline["radial"].position[number]
        assert estimate["radial"].position_sd == offline["radial"].position_sd[number]
    health = live.health()
    assert sum(health.sensors["tracker"].outcomes.values()) == len(near[0])
    assert health.sensors["tracker"].outcomes["rejected"] > 0.005 * len(near[0])

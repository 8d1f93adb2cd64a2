"""Commands against what the scenario's words say, by geometry and by counting."""

import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import binom

from pumafuse.errors import PumafuseError
from pumafuse.simulation.trajectory import PathFromFile, Raster, SineSweep, Steps, WhiteNoise, ticks

PERIOD = 0.028


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_a_raster_goes_to_and_fro_at_constant_speed() -> None:
    """Every command is as far along its way as speed and time say; within a tick of each corner in its turn."""
    width, height, pitch, speed = 0.300, 0.060, 0.020, 0.06
    found = Raster(width=width, height=height, pitch=pitch, speed=speed).offsets(PERIOD, rng())
    x, y = found["tangential"], found["vertical"]
    way = np.abs(np.diff(x)) + np.abs(np.diff(y))
    assert np.allclose(way[:-1], speed * PERIOD, rtol=1e-9, atol=0.0)  # around a corner too: the two legs add up
    corners = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 2), (1, 2), (1, 3), (0, 3)]
    length = 0.0
    for (a, b), before in zip(corners, [(0, 0), *corners], strict=False):
        length += abs(a - before[0]) * width + abs(b - before[1]) * pitch
        tick = round(length / speed / PERIOD)
        assert abs(x[tick] - a * width) + abs(y[tick] - b * pitch) <= speed * PERIOD
    assert (x[-1], y[-1]) == pytest.approx((0.0, height))
    assert len(x) == int(np.ceil(length / speed / PERIOD - 1e-9)) + 1


@settings(max_examples=60)
@given(st.integers(0, 30), st.integers(1, 300))
def test_a_raster_covers_its_height(lines: int, pitch_mm: int) -> None:
    """A height of k pitches has k + 1 lines, whatever binary fractions make of the millimetres."""
    height, pitch = lines * pitch_mm / 1e3, pitch_mm / 1e3
    raster = Raster(width=0.01, height=height, pitch=pitch, speed=0.1)
    assert raster.offsets(PERIOD, rng())["vertical"].max() == pytest.approx(height, abs=1e-9)


def campaign(**different: object) -> Steps:
    given = {"axes": ["a", "b"], "sizes": [0.002, 0.004, 0.008], "replicates": 3, "rest": 0.5, "scope": "s"}
    return Steps(**(given | different))  # pyright: ignore[reportArgumentType]


def test_a_campaign_has_every_combination_as_often_as_asked() -> None:
    """Each axis and size both up and down, and a step down follows its step up at once."""
    plan = campaign().plan(rng())
    assert Counter(plan) == {
        (axis, sign * size): 3 for axis in "ab" for size in (0.002, 0.004, 0.008) for sign in (1, -1)
    }
    for up, down in zip(plan[::2], plan[1::2], strict=True):
        assert up[1] > 0.0 and down == (up[0], -up[1])


def test_steps_are_one_command_each_after_a_rest() -> None:
    """Each trial's step happens in one tick, `rest` after the last; between trials nothing moves."""
    steps, pause = campaign(), round(0.5 / PERIOD)
    plan, found = steps.plan(rng()), steps.offsets(PERIOD, rng())
    changes = {axis: np.diff(command, prepend=0.0) for axis, command in found.items()}
    steps_made: list[tuple[str, float]] = []
    for tick in range(len(found["a"])):
        moved = [(axis, step[tick]) for axis, step in changes.items() if step[tick] != 0.0]
        assert not moved or (len(moved) == 1 and tick % pause == 0)
        steps_made.extend(moved)
    assert [axis for axis, _ in steps_made] == [axis for axis, _ in plan]
    assert [step for _, step in steps_made] == pytest.approx([step for _, step in plan], abs=1e-15)
    assert len(found["a"]) == (len(plan) + 1) * pause  # the last trial has its rest too


def test_white_noise_has_two_levels_and_changes_with_probability_one_half() -> None:
    """It begins at the start level; switches are binomial(n, ½) to 99.9 %, those of neighbours uncorrelated."""
    noise = WhiteNoise(axes=["a", "b"], amplitude=0.008, duration=140.0)
    for seed in range(12):
        assert [command[0] for command in noise.offsets(PERIOD, rng(seed)).values()] == [0.0, 0.0]
    found = noise.offsets(PERIOD, rng())
    switched: dict[str, NDArray[np.bool_]] = {}
    for axis, command in found.items():
        assert set(command.tolist()) == {0.0, 0.008}
        switched[axis] = np.diff(command) != 0.0
        count = len(switched[axis])
        assert count == 5000
        low, high = binom.interval(0.999, count, 0.5)
        assert low <= switched[axis].sum() <= high
        signs = np.where(switched[axis], 1.0, -1.0)
        assert abs(np.mean(signs[1:] * signs[:-1])) < 4.0 / count**0.5
    assert abs(np.mean(np.where(switched["a"] == switched["b"], 1.0, -1.0))) < 4.0 / 5000**0.5


@pytest.mark.parametrize(("start", "end"), [(3.0, 0.4), (2.0, 2.0)])
def test_a_sweep_has_the_frequency_it_says(start: float, end: float) -> None:
    """The phase's slope, from the analytic sine itself, is f0 (f1/f0)^(t/duration) to 1e-3."""
    sweep = SineSweep(axes=["a"], amplitude=0.005, start_frequency=start, end_frequency=end, duration=10.0)
    step = 0.0002
    found = sweep.offsets(step, rng())["a"]
    assert found[0] == 0.0 and np.diff(found)[0] > 0.0
    assert found.max() == pytest.approx(0.005, rel=1e-3) and found.min() == pytest.approx(-0.005, rel=1e-3)
    time = np.arange(len(found)) * step
    rises = np.flatnonzero((found[:-1] <= 0.0) & (found[1:] > 0.0))
    crossing = time[rises] - found[rises] * step / (found[rises + 1] - found[rises])
    # Between two rising zeros the phase grows by one turn: the mean of the frequency over that time is 1/Δ.
    for a, b in itertools.pairwise(crossing):
        at = np.linspace(a, b, 400)
        assert np.trapezoid(start * (end / start) ** (at / 10.0), at) == pytest.approx(1.0, rel=1e-3)


@settings(max_examples=50)
@given(st.integers(1, 400), st.sampled_from([0.004, 0.028, 0.001, 0.0125]))
def test_a_duration_of_whole_periods_ends_on_its_tick(count: int, period: float) -> None:
    """No tick more and none less, whatever binary fractions make of n · T."""
    assert len(ticks(count * period, period)) == count + 1


def table(folder: Path, text: str) -> PathFromFile:
    (folder / "path.csv").write_text(text)
    return PathFromFile(file=str(folder / "path.csv"), axes=["a", "b"])


def test_a_path_from_a_file_is_linear_between_its_rows_and_starts_at_zero(tmp_path: Path) -> None:
    """Relative to the first row, and time too: a log that starts at 5 s is played from its first row on."""
    path = table(tmp_path, "time_s,a_mm,b_mm,more\n5.0,100.0,7.0,x\n5.1,110.0,7.0,y\n5.3,90.0,8.0,z\n")
    found = path.offsets(0.02, rng())
    time = 5.0 + np.arange(16) * 0.02
    assert found["a"] == pytest.approx(np.interp(time, [5.0, 5.1, 5.3], [0.0, 0.010, -0.010]), abs=1e-12)
    assert found["b"] == pytest.approx(np.interp(time, [5.0, 5.1, 5.3], [0.0, 0.0, 0.001]), abs=1e-12)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("time_s,a_mm,b_mm\n0.0,1.0,1.0\n0.0,2.0,1.0\n", "time_s must ascend"),
        ("time_s,a_mm,b_mm\n0.0,1.0,1.0\n0.2,2.0,lost\n", "b_mm has a cell without a number"),
        ("time_s,a_mm,b_mm\n0.0,1.0,1.0\n0.2,2,50,1.0\n", "1 line left out"),
    ],
)
def test_a_path_with_holes_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    """Stamps that repeat, step back or are missing, cells that are words, or too many; the message names the file."""
    with pytest.raises(PumafuseError, match=expected) as refused:
        table(tmp_path, text).offsets(PERIOD, rng())
    assert "path.csv" in str(refused.value)

"""Commands that nobody sent, and values that a sensor repeats: left out, counted, named; nothing else is."""

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.arrays import FloatArray
from pumafuse.logs.screening import lost
from tuning_runs import quietly

PERIOD, LAG = 0.025, 0.075  # s
TIME = PERIOD * np.arange(2400)
PATH = 0.4 * np.sin(0.9 * TIME) + 0.15 * np.sin(2.3 * TIME)  # m
CONFIG = pf.FusionConfig(
    arm=pf.ArmModel(
        name="gantry",
        update_period=PERIOD,
        delay=LAG / 2,
        axes={"slide": pf.AxisModel(plant=pf.FirstOrder(time_constant=LAG / 2))},
    ),
    process={"slide": pf.Process(input_noise=1e-5, drift=1e-4)},
    start=pf.Start(offset_sd=1e-2),
    sensors={"rule": pf.Sensor(sd=1e-3, gate=6.0)},
)


def followed(command: FloatArray, step: float = 0.0, noise: float = 1e-3) -> FloatArray:
    """What a sensor gives, 4 ms after each command [m]: held commands through a delay and a lag, by finer steps."""
    fine = np.repeat(command, 50)  # 0.5 ms
    late, position = np.concatenate([np.full(75, fine[0]), fine[:-75]]), np.empty(len(fine))
    position[0] = fine[0]
    for k in range(1, len(fine)):
        position[k] = position[k - 1] + (late[k - 1] - position[k - 1]) * (1.0 - np.exp(-1.0 / 75.0))
    value = position[8::50] + noise * np.random.default_rng(3).standard_normal(len(command))
    return np.rint(value / step) * step if step else value


def fused(command: FloatArray, value: FloatArray, **more: object) -> tuple[pf.Estimates, str]:
    run = pf.Run.from_arrays(TIME, {"slide": command}, {"rule": (TIME + 0.004, {"slide": value})})
    est = quietly(lambda: pf.fuse(run, CONFIG, **more))  # type: ignore[arg-type]
    return est, " / ".join(est.notes)


VALUE = followed(PATH)
STRAY: dict[str, dict[int, float]] = {
    "one of another unit": {700: 1000.0 * PATH[700]},
    "zeros": {80: 0.0, 900: 0.0, 901: 0.0},
    "a sign": {1500: -PATH[1500]},
    "two that differ": {411: 3.0, 412: -7.0},
    "one good between two": {1200: 5.0, 1202: 5.0},
}


@pytest.mark.parametrize("name", STRAY)
def test_values_that_nobody_sent_are_not_used(name: str) -> None:
    """Counted and named with the first row; the run is fused as if their rows were not there, to the bit."""
    command = PATH.copy()
    rows = list(STRAY[name])
    command[rows] = list(STRAY[name].values())
    est, notes = fused(command, VALUE, rate=50.0, mode="as-live")
    assert est.command_counts == {"used": 2400 - len(rows), "stray": len(rows)}
    assert "slide that leaps away" in notes and f"first: row {rows[0] + 1}" in notes
    run = pf.Run.from_arrays(
        np.delete(TIME, rows), {"slide": np.delete(PATH, rows)}, {"rule": (TIME + 0.004, {"slide": VALUE})}
    )
    wanted = quietly(lambda: pf.fuse(run, CONFIG, rate=50.0, mode="as-live"))
    assert est["slide"].position.tolist() == wanted["slide"].position.tolist()


def pulse(length: int) -> FloatArray:
    return np.where((np.arange(2400) >= 800) & (np.arange(2400) < 800 + length), PATH[795] + 0.5, PATH)


RESTING = np.where(np.arange(2400) < 1000, 0.01 * np.sin(TIME), 0.01 * np.sin(TIME[1000]))
REAL: dict[str, FloatArray] = {
    "a jump that stays": np.where(TIME > 30.0, PATH + 0.8, PATH),
    "three values": pulse(3),
    "coarse": np.rint(PATH / 0.02) * 0.02,
    "dither": 1e-3 * np.rint(np.random.default_rng(0).standard_normal(2400)),
    "a pulse of two that the arm follows": RESTING + np.where(np.isin(np.arange(2400), [1500, 1501]), 0.2, 0.0),
}


@pytest.mark.parametrize("name", REAL)
def test_real_commands_are_used(name: str) -> None:
    """Steps, jumps, pulses that the arm follows, quanta: every command counts."""
    est, notes = fused(REAL[name], followed(REAL[name]))
    assert "stray" not in notes and "stray" not in est.command_counts


@pytest.mark.parametrize("stuck", [0.0, None])
def test_a_sensor_that_froze_is_held(stuck: float | None) -> None:
    """Its value until then counts once; one that it leaps to, never: errors stay within the bars, with when."""
    value = VALUE.copy()
    value[700:1100] = value[699] if stuck is None else stuck
    est, notes = fused(PATH, value)
    assert est.counts["rule"] == {"fused": 2000, "held": 400}
    assert "from 17.50 to 27.48 s" in notes
    right = fused(PATH, VALUE)[0]["slide"].position
    assert np.abs(est["slide"].position - right).max() < 4.0 * est["slide"].position_sd.max()


def test_of_a_sensor_that_froze_at_rest_what_it_says_before_the_commands_move_counts() -> None:
    """An axis that rests for long and is told to go back, beside a sensor without noise that stays where it was."""
    path = 0.3 * np.clip(np.minimum(TIME - 2.0, 53.0 - TIME), 0.0, 1.0)
    value = followed(path, 1e-3, noise=0.0)
    back = int(np.flatnonzero(np.diff(path) < 0.0)[0]) + 1
    value[back : back + 40] = value[back - 1]
    est, notes = fused(path, value)
    assert est.counts["rule"] == {"fused": 2360, "held": 40}, notes


def test_a_sensor_slower_than_its_rows_counts_at_its_own_rate() -> None:
    """Each value four times: the estimate is that of the values given once, to the bit."""
    slow = np.repeat(VALUE[::4], 4)
    est, notes = fused(PATH, slow)
    assert est.counts["rule"] == {"fused": 600, "held": 1800} and "gives each value 4 times" in notes
    run = pf.Run.from_arrays(TIME, {"slide": PATH}, {"rule": (TIME[::4] + 0.004, {"slide": VALUE[::4]})})
    assert est["slide"].position.tolist() == pf.fuse(run, CONFIG)["slide"].position.tolist()


def test_a_sensor_without_noise_at_rest_is_not_held() -> None:
    """Moves with rests between them, and a slow one, in steps of 0.01 to 50 mm: all count."""
    rests = np.clip(np.sin(0.4 * TIME) * 3.0, -1.0, 1.0) * 0.3
    for path in (rests, 1e-3 * TIME, np.repeat(rests[::300], 300)):
        est, notes = fused(path, followed(path, 2e-3, noise=0.0))
        assert "held" not in est.counts["rule"], notes


def live(command: FloatArray, value: FloatArray) -> tuple[FloatArray, pf.LiveEstimator, list[str]]:
    said = list[str]()
    found, estimator = np.empty(len(command)), pf.LiveEstimator(CONFIG, on_notice=said.append)
    for k, t in enumerate(TIME.tolist()):
        estimator.command(t, slide=float(command[k]))
        estimator.measurement(t + 0.004, "rule", slide=float(value[k]))
        found[k] = estimator.estimate().axes["slide"].position
    return found, estimator, said


def test_live_a_doubtful_command_waits_for_the_next() -> None:
    """Stray ones are never followed, and named; a jump that stays is, once the next ones are there, as recorded."""
    clean, _, _ = live(PATH, VALUE)
    command = PATH.copy()
    command[[700, 1300, 1301]] = 400.0, 0.9, -0.8
    found, estimator, said = live(command, VALUE)
    assert estimator.health().commands["stray"] == 3 and any("slide at 17.500 s leaps" in one for one in said)
    assert np.abs(found - clean).max() < 0.02  # one or two commands are missing
    jump = REAL["a jump that stays"]
    found, estimator, said = live(jump, followed(jump))
    assert estimator.health().commands["stray"] == 0 and not said
    est, _ = fused(jump, followed(jump))
    assert abs(estimator.estimate(float(TIME[-1])).axes["slide"].position - est["slide"].position[-1]) == 0.0


def test_live_a_sensor_that_froze_is_held() -> None:
    """The estimate goes on with the commands, and the axis is stale; said once, and counted."""
    value = VALUE.copy()
    value[700:1100] = value[699]
    found, estimator, said = live(PATH, value)
    clean, _, _ = live(PATH, VALUE)
    assert np.abs(found - clean).max() < 5e-3
    assert estimator.health().sensors["rule"].outcomes["held"] >= 398
    assert any("'rule' repeats its value of slide" in one for one in said)


def test_a_coordinate_that_is_zero_is_no_lost_target() -> None:
    """Only all three are, which a sensor does not measure of what is in front of it; nor is what has no value."""
    position = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1e-3], [0.0, -0.2, 0.3], [np.nan, 0.0, 0.0]])
    assert lost(position).tolist() == [True, False, False, False]


def test_zeros_that_nobody_had_set_yet_are_missing() -> None:
    """A sensor's before its first value, or those of commands: as if the rows had none, to the bit."""
    path, early = 0.9 + PATH, np.arange(len(TIME)) < 7
    value = followed(path)
    unset, unseen = np.where(early, 0.0, path), np.where(early, 0.0, value)
    for command, measured in ((path, unseen), (unset, value), (unset, unseen)):
        est, notes = fused(command, measured)
        missing = fused(np.where(command == 0.0, np.nan, command), np.where(measured == 0.0, np.nan, measured))[0]
        assert "7 rows have zeros before the first value" in notes
        assert est["slide"].position.tolist() == missing["slide"].position.tolist()
        assert est.counts == missing.counts


@pytest.mark.parametrize("first", [0.0, 0.9])
def test_zeros_of_an_arm_that_is_there_count(first: float) -> None:
    """One at rest in its middle, which begins to follow or is told at once to be elsewhere, as its sensor sees."""
    path = np.where(TIME < 3.0, 0.0, PATH - PATH[120]) + np.where(TIME < 2.0, 0.0, first)
    value = np.where(TIME < 2.0, 0.0, followed(path))
    assert fused(path, value)[0].counts["rule"] == {"fused": 2400}


def test_the_first_step_of_a_coarse_sensor_is_no_leap() -> None:
    """One of 2 mm that rounds down, of a slide at 1.5 mm: it says 0 until the slide has moved by 0.5 mm."""
    path = 1.5e-3 + 0.02 * np.sin(0.2 * TIME)
    value = 2e-3 * np.floor(followed(path, noise=0.0) / 2e-3)
    assert value[0] == 0.0
    est, notes = fused(path, value)
    assert est.counts["rule"] == {"fused": 2400} and "zeros" not in notes


def test_zeros_of_commands_and_measurements_of_one_stamp_are_missing() -> None:
    """As in a table with both in each row."""
    path, early = 0.9 + PATH, np.arange(len(TIME)) < 7
    unset, unseen = np.where(early, 0.0, path), np.where(early, 0.0, followed(path))
    run = pf.Run.from_arrays(TIME, {"slide": unset}, {"rule": (TIME, {"slide": unseen})})
    notes = quietly(lambda: pf.fuse(run, CONFIG)).notes
    assert sum("7 rows have zeros before the first value" in note for note in notes) == 2

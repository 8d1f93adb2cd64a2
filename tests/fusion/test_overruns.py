"""Commands beyond the fastest speed of an axis are named: how many of how many, when, and how fast the fastest."""

from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from executable import pumafuse

SCENARIOS = Path(__file__).parents[2] / "scenarios"
PERIOD, LIMIT = 0.02, 0.1  # s, m/s
TIME = PERIOD * np.arange(200)
STEP = np.where(np.arange(200) % 40 < 20, 0.8, -0.8) * LIMIT * PERIOD  # m from command to command: within the limit
STEP[0] = 0.0


def arm(**bends: float) -> pf.ArmModel:
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05), **bends)  # type: ignore[arg-type]
    return pf.ArmModel(name="slow", update_period=PERIOD, delay=0.03, axes={"x": axis})


def run_of(command: np.ndarray, time: np.ndarray = TIME) -> pf.Run:
    """Commands, and a camera that measures something near them."""
    camera = (time[::2] + 0.001, {"x": command[::2]})
    return pf.Run.from_arrays(time, {"x": command}, {"camera": camera}, name="r")


def config(model: pf.ArmModel) -> pf.FusionConfig:
    return pf.FusionConfig(
        arm=model,
        process={"x": pf.Process(input_noise=1e-2, drift=1e-3)},
        sensors={"camera": pf.Sensor(sd=1e-2)},
    )


def beyond(notes: list[str] | tuple[str, ...]) -> list[str]:
    return [note for note in notes if "ask for more" in note]


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
def test_commands_beyond_the_fastest_speed_are_named() -> None:
    """Three of 200, one way and the other; `fuse` and `verify` say the same, and nothing of an arm without a limit."""
    step = STEP.copy()
    step[[60, 61, 150]] = np.array([1.2, 2.5, -1.5]) * LIMIT * PERIOD
    run, slow = run_of(np.cumsum(step)), arm(max_speed=LIMIT)
    said = (
        "x: 3 of 200 commands ask for more than the 100 mm/s that it goes, the fastest for 250, from 1.20 s to 3.00 s"
    )
    assert beyond(pf.fuse(run, config(slow)).notes) == [said]
    ((verified, _),) = pf.verify(run, slow)
    assert beyond(verified.notes) == [said]
    assert not beyond(pf.fuse(run, config(arm())).notes)
    assert not beyond(pf.fuse(run_of(np.cumsum(STEP)), config(slow)).notes)


@pytest.mark.parametrize(
    ("scenario", "said"),
    [
        ("saturating-servo", "joint: fastest speed: about 365 deg/s, up to which its lag holds"),
        ("wrong-latency", ""),
    ],
)
def test_fuse_and_verify_say_what_is_not_linear_of_the_arm(scenario: str, said: str, tmp_path: Path) -> None:
    """In the same words; of a linear arm nothing."""
    run, sensor = tmp_path / "run", ("--sensors", "camera") if said else ()
    pumafuse("simulate", SCENARIOS / f"{scenario}.toml", "-o", run)
    fused = pumafuse("fuse", run, "-c", run / "fusion.toml", "-o", tmp_path / "out").stdout
    verified = pumafuse("verify", run, "--arm", run / "arm.toml", *sensor).stdout
    lines = [line for line in (fused + verified).splitlines() if "its lag" in line or "sag: " in line]
    assert len(lines) == (2 if said else 0) and len(set(lines)) <= 1
    assert all(said in line for line in lines)

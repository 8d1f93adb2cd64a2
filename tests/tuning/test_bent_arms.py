"""A play and a fastest speed that an axis is said to have are fitted."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

import pumafuse as pf
from tuning_runs import quietly

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def tuned(scenario: str, **changes: float) -> pf.Tuning:
    """A scenario's run, tuned from its own arm with ``changes`` of its axis."""
    made = pf.simulate(pf.Scenario.load(SCENARIOS / f"{scenario}.toml"))
    ((axis, model),) = made.config.arm.axes.items()
    arm = replace(made.config.arm, axes={axis: replace(model, **changes)})
    config = replace(made.config, arm=arm)
    return quietly(lambda: pf.tune([made.run], config, fit=["noise", "delay", "plant"]))


def test_play_is_found_from_a_value_of_its_size() -> None:
    """3.4 degrees, from 2 and from 5, the same one: within a tenth, as noise shakes the drive within its play."""
    found = [tuned("tool-with-play", play=degrees * 0.0174533) for degrees in (2.0, 5.0)]
    one, other = (each.params["axes.wrist.play_deg"] for each in found)
    assert one == pytest.approx(3.4, rel=0.1)
    assert one == pytest.approx(other, rel=1e-3)
    low, high = found[0].config.arm.axes["wrist"].play_ci95 or (0.0, 0.0)
    assert low < found[0].config.arm.axes["wrist"].play < high < 1.1 * low


@pytest.mark.long
def test_a_fastest_speed_is_found() -> None:
    """365 degrees a second, from 290: within a hundredth, and written with its interval."""
    found = tuned("saturating-servo", max_speed=290.0 * 0.0174533)
    assert found.params["axes.joint.max_speed_deg_s"] == pytest.approx(365.0, rel=0.01)
    assert "max_speed_deg_s_ci95" in found.config.arm.to_toml()


def test_an_arm_without_play_gets_none() -> None:
    """Neither is fitted where arm.toml does not have it."""
    found = tuned("tool-with-play", play=0.0)
    assert not [key for key in found.params if "play" in key or "max_speed" in key]

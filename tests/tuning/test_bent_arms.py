"""Play, a fastest speed and a sag of an axis are fitted, whether arm.toml has them or not."""

import math
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

import pumafuse as pf
from tuning_runs import quietly

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def tuned(
    scenario: str, fit: tuple[str, ...] = ("noise", "delay", "plant"), fix: tuple[str, ...] = (), **changes: Any
) -> pf.Tuning:
    """A scenario's run, tuned from its own arm with ``changes`` of its axis."""
    made = pf.simulate(pf.Scenario.load(SCENARIOS / f"{scenario}.toml"))
    ((axis, model),) = made.config.arm.axes.items()
    arm = replace(made.config.arm, axes={axis: replace(model, **changes)})
    config = replace(made.config, arm=arm)
    return quietly(lambda: pf.tune([made.run], config, fit=fit, fix=fix))


@pytest.mark.long
def test_play_is_found_from_any_value() -> None:
    """3.4 degrees, from none, 2 and 40, the same: within a tenth, as noise shakes the drive within its play."""
    found = [tuned("tool-with-play", play=degrees and degrees * 0.0174533) for degrees in (None, 2.0, 40.0)]
    first, *others = (each.params["axes.wrist.play_deg"] for each in found)
    assert first == pytest.approx(3.4, rel=0.1)
    assert others == pytest.approx([first, first], rel=1e-3)
    low, high = found[0].config.arm.axes["wrist"].play_ci95 or (0.0, 0.0)
    assert low < found[0].config.arm.axes["wrist"].play < high < 1.2 * low
    assert "play: about 3." in found[0].details.orders["wrist"]


@pytest.mark.long
def test_a_fastest_speed_is_found() -> None:
    """365 degrees a second, from none: within a hundredth, and written with its interval.

    What of the commands is beyond it is named.
    """
    found = tuned("saturating-servo", max_speed=None)
    assert found.params["axes.joint.max_speed_deg_s"] == pytest.approx(365.0, rel=0.01)
    assert "max_speed_deg_s_ci95" in found.config.arm.to_toml()
    assert any("of 3001 commands ask for more than the 36" in note for note in found.details.notes)


@pytest.mark.long
def test_a_sag_is_found() -> None:
    """The lever's knee at 40 degrees, where a line in two pieces through its true sag has it, and the slope beyond.

    Below the knee that line is the gain, 0.98, and beyond it goes 0.88 / 0.98 times as far.
    """
    found = tuned("sagging-lever", ("noise", "delay", "plant", "gain"), sag=None)
    (at, beyond) = (found.params[f"axes.lever.sag.{key}"] for key in ("knee_deg", "slope_beyond"))
    made = found.config.arm.axes["lever"].sag
    assert math.degrees(made.knee_ci95[0]) < 0.98 * 40.0 < at < math.degrees(made.knee_ci95[1]) < 45.0
    assert made.slope_beyond_ci95[0] < 0.88 / 0.98 - 1.0 < made.slope_beyond_ci95[1] < 0.8 * beyond
    assert "sag: above about" in found.details.orders["lever"]

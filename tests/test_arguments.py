"""What Python may be given by mistake: one line that says what is wrong, as the docstrings promise."""

import math
from collections.abc import Callable

import numpy as np
import pytest

import pumafuse as pf
from executable import DATA

TIME = np.arange(60) * 0.028
PLACE = {"x": 0.1 * np.sin(TIME)}


def arm(**wrong: object) -> pf.ArmModel:
    axis = {key: wrong.pop(key) for key in ("gain_recovery", "gain", "unseen_lag_sd") if key in wrong}
    plant = wrong.pop("plant", pf.FirstOrder(time_constant=0.05))
    return pf.ArmModel(
        **{"name": "a", "update_period": 0.028, "delay": 0.06, **wrong}, axes={"x": pf.AxisModel(plant=plant, **axis)}
    )


def run(**more: object) -> pf.Run:
    return pf.Run.from_arrays(TIME, PLACE, **{"sensors": {"cam": (TIME, PLACE)}, **more})


def trials() -> pf.StepTrials:
    return pf.StepTrials.read(DATA / "steps")


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "no period": (lambda: arm(update_period=0.0), "axes.x: period, plant, recovery and fastest speed must be > 0"),
    "negative delay": (lambda: arm(delay=-0.06), "delay, play and sds >= 0"),
    "a negative sd of a lag": (lambda: arm(unseen_lag_sd=-1e-3), "delay, play and sds >= 0"),
    "a delay that is none": (lambda: arm(delay=math.nan), "must be finite"),
    "a gain that is none": (lambda: arm(gain=pf.Gain(intercept=math.nan)), "must be finite"),
    "negative time constant": (lambda: arm(plant=pf.FirstOrder(time_constant=-1.0)), "must be > 0"),
    "negative damping": (lambda: arm(plant=pf.SecondOrder(natural_frequency=9.0, damping=-1.0)), "must be > 0"),
    "no recovery": (lambda: arm(gain_recovery=0.0), "must be > 0"),
    "no axes": (lambda: pf.ArmModel(name="a", update_period=0.028, delay=0.06, axes={}), "an arm has one at least"),
    "values without stamps": (lambda: run(sensors={"cam": TIME}), "cam: give (stamps, {axis: values})"),
    "an array for axes": (lambda: run(sensors={"cam": (TIME, TIME)}), "cam: give (stamps, {axis: values})"),
    "a reference without stamps": (lambda: run(reference=PLACE), "reference: give (stamps, {axis: values})"),
    "a start that is none": (lambda: run(start={"x": None}), "the start level of x is not finite"),
    "a start that is text": (lambda: pf.verify(run(), arm(), start={"x": "a"}), "the start level of x is not finite"),
    "a part that is text": (lambda: run().between("a"), "is no interval after the first command"),
    "an unknown sensor": (lambda: pf.verify(run(), arm(), sensors="lidar"), "has no sensor 'lidar'; it has cam"),
    "no samples": (lambda: pf.identify(trials(), samples=0), "samples: at least 8"),
    "negative samples": (lambda: pf.identify(trials(), samples=-5), "samples: at least 8"),
    "no tolerance": (lambda: pf.identify(trials(), tolerance=math.nan), "tolerance: must be positive"),
}


@pytest.mark.parametrize("case", WRONG)
def test_it_is_refused_in_a_line(case: str) -> None:
    """A PumafuseError, neither a traceback of numpy nor a number."""
    call, said = WRONG[case]
    with pytest.raises(pf.PumafuseError) as caught:
        call()
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_sensor_s_name_alone_is_one_sensor() -> None:
    """In ``verify`` as in ``fuse``."""
    (one,) = pf.verify(run(), arm(), sensors="cam")
    assert one[0].source == "cam"

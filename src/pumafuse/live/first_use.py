"""Compiles every kernel for this machine, in two processes for the one that needs the first of them.

``python -m pumafuse.live.first_use forward`` compiles the pass forward and what is small, ``… rest`` the smoother and
the live window: about as long.
"""

from __future__ import annotations

import sys

import numpy as np

from ..arrays import ALWAYS
from ..filter.events import classify_all
from ..filter.forward import ALL_THERE, NO_ESTIMATES, NO_TIMES, filter_events
from ..filter.smoother import smooth
from ..filter.window import Window, put_command, put_measurement
from ..fusion.config import FusionConfig, Sensor
from ..fusion.skill import constant_velocity
from ..logs.grid import assigned_ticks
from ..model.arm import ArmModel, AxisModel
from ..model.cylindrical import from_cylinder, to_cylinder
from ..model.plants import FirstOrder
from ..model.response import response
from .estimator import empty_window

_AXIS = AxisModel(plant=FirstOrder(time_constant=0.02))


def compile_forward(window: Window) -> None:
    """The forward pass over no event, a response and whatever is small, over nothing."""
    filter_events(window.memory.filter.flat(), False, 0, 0, 0, *ALL_THERE, 0, *NO_ESTIMATES)
    none = np.zeros(0)
    response(_AXIS, 0.028, 0.0, NO_TIMES, none, 0.0, NO_TIMES)
    constant_velocity(np.zeros(1), np.zeros(1), none, np.zeros((5, 0)), none, none)
    assigned_ticks(np.zeros(2))
    to_cylinder(none, none, 0.0, 0.0, 1.0, 0.0, 1.0, none, 0.0, none, none, none)
    from_cylinder(none, none, 0.0, 0.0, 1.0, 0.0, 1.0, none, none)


def compile_rest(window: Window) -> None:
    """The smoother, over no event, and what the live window needs."""
    (model, sensors, events, state, results, history), incoming = window.memory
    width = state.x.shape[1]
    room = np.empty((2, width)), np.empty((2, width, width)), np.empty((1, 4, width)), np.empty((width + 1, width))
    smooth(model, sensors, events, results, history, 0, NO_TIMES, room, NO_ESTIMATES[1])
    flat = window.memory.filter.flat(), tuple(incoming)
    put_command(*flat, 0, 0, ALWAYS)
    put_measurement(*flat, 0, 0, 0, ALWAYS)
    incoming.times[:] = 0
    window.command_at(0)
    window.counters()
    empty = events.rows(slice(0, 0))
    classify_all(model, sensors, empty, state, 0, np.zeros(0, dtype=np.bool_), empty.known)


def main(part: str) -> None:
    """Compile the part of that name."""
    arm = ArmModel(name="one axis", update_period=0.028, delay=0.0, axes={"x": _AXIS})
    config = FusionConfig(arm=arm, sensors={"sensor": Sensor(sd=1e-3)})
    {"forward": compile_forward, "rest": compile_rest}[part](empty_window(config, ("x",), {}, None))


if __name__ == "__main__":
    main(sys.argv[1])

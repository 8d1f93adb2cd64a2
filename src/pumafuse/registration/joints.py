"""By how much each joint of an arm answers later than the first: from a sensor of the tool alone.

Where joints lag apart, the tool leaves its path in fast motion, and no lag along its axes explains it. A joint that is
delayed moves each row as the kinematics say. Frame, marker and joints are one linear regression; the plant, of which
what all joints lag is a part, is found anew after it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import FloatArray
from .motion import Motion, Plant
from .register import Quantity, Registration, rows_of, thin, within
from .solve import CENTRE, MARKER, ROTATION, TURN, Rows, State, information_of, residual, slopes

Later = Mapping[str, float]  # of each joint [s]
Delay = Callable[[Later], Sequence[Motion]]  # the commands of each run, with joints delayed [s]
_STEP = 5e-3  # s, by which a joint is delayed for a slope
_ROUNDS = 3  # a path bends little within a lag: each round leaves a tenth of what the one before did
_ROWS = 4000  # that are looked at, evenly
_BESIDE = np.r_[ROTATION, CENTRE, MARKER, TURN]  # of a registration's step: what is free beside the joints
_SETTLED = 0.6  # s after the first command
_KNOWN = 0.03  # s, of half an interval: beyond it the motion does not tell how late a joint is
_HELD = 0.03  # of the interval of commands, which are held, but delayed on the line between: no lag is surer
_PAYS = 0.95  # of the noise that is left where all joints answer alike: what gains less than 5 % is no lag of joints


class _Step(NamedTuple):
    """A step of the regression."""

    later: FloatArray  # by how much more each joint is to be delayed [s], (J,)
    half: FloatArray  # half the 95 % intervals [s], (J,)
    noise: FloatArray  # what the registration left before it, of each block [m, rad]


def joint_lags(
    delay: Delay, joints: Sequence[str], sensor: Sequence[Motion], register: Callable[[Sequence[Motion]], Registration]
) -> dict[str, Quantity]:
    """How much later than the first each joint answers [s]; nothing where all answer alike, as far as is told.

    ``delay`` gives the commands, beside which ``register`` registers what the sensor saw in its own frame, one entry a
    run. A joint of which the motion does not tell is as late as the others are on average, its interval infinite.
    """
    later, steps = dict.fromkeys(joints, 0.0), list[_Step]()
    for _ in range(_ROUNDS + 1):
        registration = register(delay(later))
        if registration.frame is None:
            return {}
        steps.append(_step(delay, later, sensor, registration))
        by = zip(later.items(), steps[-1].later.tolist(), strict=True)
        later = {name: before + more for (name, before), more in by}
    period = float(np.median(np.diff(delay(later)[0].time)))
    half, late = np.hypot(steps[-1].half, _HELD * period), np.array(list(later.values()))
    is_known = half < _KNOWN
    if not is_known.any() or np.mean(np.log(steps[-1].noise / steps[0].noise)) > np.log(_PAYS):
        return {}
    late = np.where(is_known, late, late[is_known].mean())
    late, half = late - late.min(), np.where(is_known, half, np.inf)
    return dict(zip(joints, map(Quantity.around, late.tolist(), half.tolist()), strict=True))


def _step(delay: Delay, later: Later, sensor: Sequence[Motion], registration: Registration) -> _Step:
    """How much later each joint is beside a registration."""
    sensor = _drop_start(delay(later), sensor)
    attitude = registration.rms_rotation is not None
    mean = np.concatenate([motion.position for motion in sensor]).mean(axis=0)
    state = _state(registration, mean)

    def beside(commands: Later) -> Rows:
        return rows_of([motion.valid() for motion in delay(commands)], sensor, mean, attitude=attitude)

    rows = beside(later)
    off = residual(rows, state)
    moved = [residual(beside({**later, name: by + _STEP}), state).blocks for name, by in later.items()]
    by_joint = [
        (np.stack(moved_there, axis=-1) - here[:, :, None]) / _STEP
        for *moved_there, here in zip(*moved, off.blocks, strict=True)
    ]
    slope = [
        np.concatenate([slope[:, :, _BESIDE], by], axis=2)
        for slope, by in zip(slopes(rows, state, off.poses), by_joint, strict=True)
    ]
    before = information_of(slope, off.blocks, off.whitening(), expected=False)
    step = before.step()
    left = [block + by @ step for block, by in zip(off.blocks, slope, strict=True)]
    after = information_of(slope, left, off.whitening(), expected=True)
    of_joints = slice(-len(later), None)
    return _Step(step[of_joints], after.half_widths(np.eye(len(step))[of_joints]), off.noise())


def _drop_start(command: Sequence[Motion], sensor: Sequence[Motion]) -> list[Motion]:
    """What the sensor saw once it is forgotten how the arm moved before the first command."""
    both = zip(command, sensor, strict=True)
    return thin(
        [within(motion.valid(), command_motion.valid().time, _SETTLED) for command_motion, motion in both], _ROWS
    )


def _state(registration: Registration, mean: FloatArray) -> State:
    """What was registered, with the plant of positions for orientations, too: what these lag beyond it joints do."""
    assert registration.frame is not None and registration.marker is not None and registration.position is not None
    rotation, turn = (
        Rotation.from_rotvec(placement.rotation).as_matrix() for placement in (registration.frame, registration.marker)
    )
    plant = Plant(registration.position.delay.value, registration.position.time_constant.value)
    return State(
        rotation, registration.frame.at + rotation @ mean, np.array(registration.marker.at), turn, 1.0, plant, plant
    )

"""Registration: where a sensor stands, what it sees on the tool, and how late it is, from any motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ..arrays import FloatArray, median
from ..fusion.config import Placement
from ..space.rotations import cross_matrix, left_jacobian
from ..toml import Interval
from ..units import DEG
from .findings import AS_READ, Finding, Found, Reading, Vector
from .motion import Answer, Motion, Plant
from .solve import ANGLE, CENTRE, MARKER, POSITION, ROTATION, SCALE, SIZE, TURN, Fit, Rows, State, fit_poses
from .start import Rough, align_turns, despike, kabsch, ratio, read, rough, unit

_SETTLED = 6.0  # rough lags after the first command: how the arm moved before is forgotten
_AT_LEAST, _FEWEST = 5.0, 60  # s and rows of a sensor beside commands
_ROWS, _COARSE = 8000, 1000  # that are looked at, evenly, in the end and to begin with
_DEAD, _SMOOTH = 0.6, 0.02  # of the lag, to begin with; s: a shorter τ is stuck among the steps of held commands
_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the lag, of time constants of turning to begin with
_MANY_AT_REST = 0.25  # of the rows
_GAP = 5.0  # usual intervals of the commands, from which one is a gap
_AROUND_ROW, _RESTS, _AGAIN = 0.25, 0.02, 1.0  # s; of the speed of the motion; s, within which a rest counts once
_FOLLOWS, _MOVES = 0.3, 0.8  # correlation of speeds: it may follow; it surely moves with the tool
_LEFT = 0.5  # of what a sensor saw, which no frame explains: it does not move with the tool
_WELL = 0.03  # likewise: a frame explains it
_ODD = 0.025  # likewise, where lengths differ by what is no unit
_ANOTHER = 3.0  # times as far as commanded: another unit
_UNEXPLAINED = 0.05  # likewise, beyond its noise: arms leave 1 % of a motion, a tool that turns untold 10
_LOOSELY = 0.2  # likewise, where joints lag apart by as much as a whole lag
_SURE = 0.03  # s, of half the interval of the lag of turning: a marker's lever tells it, or it is that of positions
_AS_IT_IS = np.eye(3)
_AROUND = Rotation.create_group("T").as_matrix()  # all around, 60 degrees apart at most from the next
_TURNS = np.radians(0.5)  # of the tool, root mean square: arms err by as much in orientation
_NOTABLE = np.radians(2.0)  # root mean square of turns that are compared
_BESIDE = 2e-3  # m beside a line, root mean square: arms err by a quarter of that
_MIRROR, _EITHER = 0.5, 1.5  # times the noise that a mirrored sensor leaves: it is one, or may be one
_ALIKE = 0.3  # of two sets of directions that a rotation leaves: 17 degrees
_OTHERWISE = 0.05  # rad, about, between the frames of both, root mean square: 3 degrees
_HARDLY = 0.01  # weight of positions where orientations alone do not tell a rotation
_CLEARER = 0.5  # times as much is left by the right reading
_SURELY = 0.1  # likewise, of orientations that follow as they are
_LEVER = 0.15  # m: arms err by 0.5 mm and 0.2 degrees
_TILT = 0.05  # of a number per step in a direction that nothing tells: less is told
_OF_NORMAL = 0.6745  # median of the absolute value of a standard normal variable
_HERE, _AS_TURNED = 3e-3, np.radians(0.5)  # m and rad: an arm's own kinematics are wrong by as much
_UNIT = 0.05  # tolerance of the logarithm of a factor between units
_ROUGHLY = 0.4  # likewise where it is that of speeds, to which a marker adds some
_ANGLES = 1.4  # likewise of angles, which in another unit are about other axes
_OTHER = 0.02  # from which a scale is named: arms' own kinematics are wrong by a tenth of that
_UNITS = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "feet": 0.3048, "m": 1.0}  # in m


class Quantity(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    ci95: Interval

    @classmethod
    def around(cls, value: float, half: float = 0.0) -> Quantity:
        """A number with half its interval; without one it is taken, not found."""
        return cls(value, (value - half, value + half))

    @property
    def half(self) -> float:
        """Half the interval."""
        return 0.5 * (self.ci95[1] - self.ci95[0])


class Registered(msgspec.Struct, frozen=True, kw_only=True):
    """A place and an orientation with 95 % intervals, infinite where the motion does not tell the number.

    Attributes:
        at: Where [m].
        at_ci95: Intervals.
        rotation: As a rotation vector [rad].
        rotation_ci95: Intervals; of a marker of which no orientation is known: infinite.
    """

    at: Vector = msgspec.field(name="at_mm")
    at_ci95: tuple[Interval, Interval, Interval] = msgspec.field(name="at_mm_ci95")
    rotation: Vector = msgspec.field(name="rotation_vector_deg")
    rotation_ci95: tuple[Interval, Interval, Interval] = msgspec.field(name="rotation_vector_deg_ci95")


class Response(msgspec.Struct, frozen=True, kw_only=True):
    """How what a sensor tells answers to commands."""

    lag: Quantity  # the arm's and the sensor's latency together, at constant velocity [s]
    delay: Quantity  # the dead time in it [s]
    time_constant: Quantity  # τ of a first-order plant [s]; dead time and τ make up for each other


class Registration(msgspec.Struct, frozen=True, kw_only=True):
    """What :func:`register_sensor` finds."""

    frame: Registered | None = None  # base from sensor; None where a finding prevents it
    marker: Registered | None = None  # tool from marker; likewise
    position: Response | None = None  # the response of positions
    rotation: Response | None = None  # that of orientations; None where it was taken to be that of positions
    rms: float | None = None  # what is left of positions [m]
    noise: float = 0.0  # white noise of a coordinate, by second differences [m]
    rms_rotation: float | None = None  # what is left of orientations [rad]; None where they were not used
    rows: int = 0  # how many measurements were looked at
    findings: tuple[Found, ...] = ()  # what is wrong or not told

    @property
    def read_otherwise(self) -> bool:
        """Whether rows had to be read otherwise than run.toml says, which is to be mended first."""
        return any(finding.finding in AS_READ for finding in self.findings)

    @property
    def along_base(self) -> bool:
        """Whether the sensor measures along the base's axes, as far as the motion tells."""
        return any(finding.finding is Finding.ALONG_BASE for finding in self.findings)


def register_sensor(
    command: Sequence[Motion],
    sensor: Sequence[Motion],
    *,
    marker: Placement | None = None,
    fix_marker: bool = False,
    loosely: bool = False,
) -> Registration:
    """Frame, marker and lag of a sensor.

    Args:
        command: What the tool was commanded in the base's frame, one entry a run.
        sensor: What the sensor saw in its own frame and by the same clock, likewise.
        marker: Tool from marker as far as it is known: what motion does not tell stays so. None: zeros.
        fix_marker: Whether it stays as it is.
        loosely: Whether a fifth of what the sensor saw may be left, as where it is not known yet that joints lag apart.
    """
    both = [(a, within(b, a.time)) for a, b in ((a.valid(), b.valid()) for a, b in zip(command, sensor, strict=True))]
    both = [(a, b) for a, b in both if len(b.time) >= _FEWEST]
    seconds = sum(float(b.time[-1] - b.time[0]) for _, b in both)
    if seconds < _AT_LEAST:
        return Registration(findings=(Found(finding=Finding.SHORT, size=seconds),))
    commanded, seen = [a for a, _ in both], [b for _, b in both]
    about = rough(commanded, seen)
    if about.correlation < _FOLLOWS:
        return Registration(findings=(Found(finding=Finding.UNRELATED, size=about.correlation),))
    settling = _SETTLED * max(about.lag, 0.0)
    seen = [news(a, drop_gaps(a.time, within(b, a.time, settling), settling)) for a, b in both]
    begun = _begin(commanded, seen, about, marker or Placement(), fix_marker, loosely)
    return _fit(begun, fix_marker, loosely)


def within(sensor: Motion, span: FloatArray, settling: float = 0.0) -> Motion:
    """What a sensor saw while there were commands."""
    if not len(span):
        return sensor.only(np.zeros(0, np.int64))
    return sensor.only((sensor.time >= span[0] + settling) & (sensor.time <= span[-1]))


def drop_gaps(span: FloatArray, sensor: Motion, settling: float) -> Motion:
    """What a sensor saw, but for gaps of the commands, whose instants are ``span`` [s], (n,).

    Where the tool was commanded in a gap is not known; it may move as was commanded for ``settling`` [s] after it.
    """
    interval = np.diff(span)
    usual, lost = median(interval), np.zeros(len(sensor.time), dtype=np.bool_)
    for row in np.flatnonzero(interval > _GAP * usual).tolist():
        lost |= (sensor.time > span[row] + usual) & (sensor.time < span[row + 1] + settling)
    return sensor.only(~lost) if np.count_nonzero(~lost) >= _FEWEST else sensor


def news(command: Motion, sensor: Motion) -> Motion:
    """What a sensor saw; where much of it was at rest, that around a motion of the commands, and now and then at rest.

    Rows at rest say the same again. Where they are many, what one pose errs by would decide, and rows in motion, which
    alone tell a lag, would be the outliers.
    """
    ends = [sensor.time - _AROUND_ROW, sensor.time + _AROUND_ROW]
    before, after = (np.clip(np.searchsorted(command.time, end, side="right") - 1, 0, None) for end in ends)
    moved = np.linalg.norm(command.position[after] - command.position[before], axis=1)
    if command.quaternion is not None:
        turned = Rotation.from_quat(command.quaternion)
        moved += _LEVER * (turned[after] * turned[before].inv()).magnitude()
    moving = moved >= _RESTS * float(moved @ moved) / max(float(moved.sum()), 1e-300)  # the mean over the path
    kept = moving | (np.diff(sensor.time // _AGAIN, prepend=-np.inf) > 0.0)
    many = np.count_nonzero(~moving) > _MANY_AT_REST * len(moving)
    return sensor.only(kept) if many and np.count_nonzero(kept) >= _FEWEST else sensor


def thin(sensor: Sequence[Motion], rows: int) -> list[Motion]:
    """About so many rows at most."""
    step = -(-sum(len(motion.time) for motion in sensor) // rows)
    return [motion.only(np.arange(0, len(motion.time), step)) for motion in sensor]


def rows_of(command: Sequence[Motion], sensor: Sequence[Motion], mean: FloatArray, *, attitude: bool) -> Rows:
    """Measurements about a point beside the arm's answer."""
    turned = [Rotation.from_quat(motion.quaternion).as_matrix() for motion in sensor if motion.quaternion is not None]
    return Rows(
        Answer(command, [motion.time for motion in sensor]),
        np.concatenate([motion.position for motion in sensor]) - mean,
        np.concatenate(turned) if attitude else None,
    )


class _Begin(NamedTuple):
    """Where the least squares begin."""

    command: list[Motion]  # of all runs, read so that orientations follow
    sensor: list[Motion]  # likewise, in the base's units
    mean: FloatArray  # A point in the middle of what the sensor measures [m]
    attitude: bool  # whether its orientations are used
    either: bool  # whether a mirrored sensor would do as well
    state: State  # the start
    findings: list[Found]  # what was found on the way


def _begin(
    command: list[Motion], sensor: list[Motion], about: Rough, marker: Placement, fix_marker: bool, loosely: bool
) -> _Begin:
    """Unit, handedness and reading of orientations, from positions alone at first."""
    ahead = about.scale if np.isfinite(about.scale) and abs(np.log(about.scale)) > np.log(_ANOTHER) else 1.0
    sensor = [motion._replace(position=ahead * motion.position) for motion in sensor]
    about = about._replace(scale=about.scale / ahead)
    few, findings = thin(sensor, _COARSE), list[Found]()
    mean = np.concatenate([despike(motion.position) for motion in few]).mean(axis=0)
    seen = np.concatenate([despike(motion.position) for motion in few]) - mean
    spread = float(np.std(seen))
    begin = partial(_coarse, sensor=few, mean=mean, about=about, marker=marker, fix_marker=fix_marker)
    command, proper, otherwise = _choose_reading(command, begin, spread)
    findings += otherwise
    mirrored = begin(command, sign=-1.0)
    spread, left, other = spread * proper.state.scale, proper.left(), mirrored.left()
    state = proper.state
    none = _Begin(command, sensor, mean, False, other < _EITHER * left, state, findings)
    if min(left, other) > _LEFT * spread:
        moves = about.correlation > _MOVES
        if moves:
            by_speeds = (ratio(command, sensor, about.lag, turns=False), _ROUGHLY)
            named = _unit_finding(about.scale * ahead) if np.isfinite(about.scale) else _unit_finding(*by_speeds)
            findings += [*named, _unexplained_finding(command, sensor, about.lag, min(left, other) / spread)]
        else:
            findings.append(Found(finding=Finding.UNRELATED, size=about.correlation))
    elif other < _MIRROR * left:
        findings.append(Found(finding=Finding.MIRRORED))
    if any(finding.prevents for finding in findings):
        return none
    factor, unit_found = _unit_of(proper, ahead, loosely)
    findings += unit_found
    factor /= ahead
    sensor = [motion._replace(position=factor * motion.position) for motion in sensor]
    state = state._replace(scale=1.0)
    whole = none._replace(sensor=sensor, mean=factor * mean, state=state)
    if sensor[0].quaternion is None or not Answer(command, []).turns:
        return whole
    return _add_attitude(whole, about, marker, fix_marker)


def _choose_reading(
    command: list[Motion], begin: Callable[..., Fit], spread: float
) -> tuple[list[Motion], Fit, list[Found]]:
    """The commands as their orientations are to be read, a first fit, and that they are read otherwise.

    Where the path alone does not tell how the sensor is turned, its marker may: then it begins from turns all around.
    """

    def left(fit: Fit) -> float:
        return fit.left() / fit.state.scale

    fit = begin(command)
    if left(fit) < _WELL * spread:
        return command, fit, []
    fit = min((fit, *(begin(command, first=turn) for turn in _AROUND)), key=left)
    if command[0].quaternion is not None:
        readings = (Reading.INVERSE, Reading.W_FIRST, Reading.W_LAST)
        others = {reading: _read_as(command, [], "command", reading)[0] for reading in readings}
        fits = {read_as: begin(other) for read_as, other in others.items()}
        best = min(fits, key=lambda fit: left(fits[fit]))
        if left(fits[best]) < min(_CLEARER * left(fit), _LEFT * spread):
            return others[best], fits[best], [Found(finding=Finding.READING, source="command", reading=best)]
    return command, fit, []


def _coarse(
    command: list[Motion],
    sensor: list[Motion],
    mean: FloatArray,
    about: Rough,
    marker: Placement,
    fix_marker: bool,
    sign: float = 1.0,
    first: FloatArray = _AS_IT_IS,
) -> Fit:
    """A fit to the positions of a few rows about a ``mean`` [m], scale free.

    A sensor of ``sign`` −1 is mirrored; ``first`` turns the rotation that fits the path, to begin elsewhere.
    """
    plant = _plant(about.lag)
    rows = rows_of(command, sensor, mean, attitude=False)
    poses, rows = rows.answer.poses(plant, plant), rows._replace(centred=rows.centred * [1.0, 1.0, sign])
    at = np.array(marker.at)
    path = poses.position + poses.rotation @ at
    seen = np.concatenate([despike(motion.position) for motion in sensor]) - mean
    moves = bool(np.std(path, axis=0).max() > _BESIDE)  # else a scale is one of the marker
    scale = about.scale if moves and np.isfinite(about.scale) else 1.0
    rotation = kabsch(unit(path), unit(seen * [1.0, 1.0, sign]))[0]
    turn = Rotation.from_rotvec(marker.rotation).as_matrix()
    markers = np.zeros((3, 0)) if fix_marker else _split_directions(poses.rotation)[1]
    begin = State(first @ rotation, path.mean(axis=0), at, turn, scale, plant, plant)
    moves_marker = markers.size > 0
    held, free = (_free(np.eye(3), markers, turn=False, scale=of, own_lag=of and moves_marker) for of in (False, moves))
    nearer = fit_poses(rows, begin, held).state  # a free scale may make all small first, a held one be stuck far away
    again = _plant(nearer.position.lag)
    both = (fit_poses(rows, start, free) for start in (begin, nearer._replace(position=again, angle=again)))
    best = min(both, key=lambda fit: fit.left() / fit.state.scale)
    return best._replace(state=best.state._replace(angle=best.state.position))  # few rows may not tell that of turning


def _plant(lag: float) -> Plant:
    """A plant to begin with."""
    time_constant = max((1.0 - _DEAD) * lag, _SMOOTH)
    return Plant(lag - time_constant, time_constant)


def _split_directions(rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions on the tool along which a marker's place is not told, and is told, as columns."""
    moved = rotation - rotation.mean(axis=0)
    square, directions = np.linalg.eigh(np.einsum("nij,nik->jk", moved, moved) / len(moved))
    determined = square >= _TURNS**2
    if determined.sum() < 2:  # a rotation moves two directions or three
        determined[:] = False
    return directions[:, ~determined], directions[:, determined]


def _free(rotation: FloatArray, marker: FloatArray, *, turn: bool, scale: bool, own_lag: bool) -> FloatArray:
    """The steps that are allowed, as columns, (17, k).

    The frame turns about axes (3, r), the marker moves in directions (3, m), and orientations have a plant of their
    ``own_lag``, or that of positions.
    """
    plants = np.eye(4) if own_lag else np.tile(np.eye(2), (2, 1))
    of = rotation, np.eye(3), marker, np.eye(3)[:, : 3 * turn], np.eye(1)[:, : int(scale)], plants
    return block_diag(*of)  # in the order of the places in a step


def _unit_of(fit: Fit, ahead: float, loosely: bool) -> tuple[float, list[Found]]:
    """The factor on a sensor's lengths, and the finding that they need it; they are multiplied ``ahead`` already."""
    scale = fit.state.scale * ahead
    wide = float(fit.half_widths(np.eye(SIZE)[SCALE])[0])
    if abs(np.log(scale)) < max(_OTHER, wide):
        return 1.0, []
    findings = _unit_finding(scale) or ([] if loosely else [Found(finding=Finding.SCALE, size=scale)])
    return (findings[0].size or scale if findings else 1.0), findings


def _unit_finding(scale: float, within: float = _UNIT) -> list[Found]:
    """A finding that lengths are of another unit, where a scale is that of two units."""
    if not scale > 0.0:
        return []
    names = [(name, read_as) for name, read_as in product(_UNITS, repeat=2) if name != read_as]
    factors = np.array([_UNITS[name] / _UNITS[read_as] for name, read_as in names])
    apart = np.abs(np.log(scale / factors))
    best = int(apart.argmin())
    if apart[best] >= within:
        return []
    return [Found(finding=Finding.SCALE, size=float(factors[best]), unit="in {}, read as {}".format(*names[best]))]


def _add_attitude(begin: _Begin, about: Rough, marker: Placement, fix_marker: bool) -> _Begin:
    """With the sensor's orientations, where they follow; read otherwise where they follow then."""
    few = thin(begin.sensor, _COARSE)
    as_it_is = ("sensor", Reading.AS_IT_IS)
    ways = [as_it_is, *product(("sensor", "command"), tuple(Reading)[1:])]
    aligned = {way: _align(begin, few, *way) for way in ways}
    best = min(ways, key=lambda way: aligned[way].left)
    if aligned[as_it_is].left <= max(aligned[best].left / _CLEARER, _SURELY):
        best = as_it_is
    if aligned[best].left > _ALIKE or aligned[best].excess > _OTHERWISE:
        frame, left = aligned[as_it_is].attitude
        angle = float(Rotation.from_matrix(frame @ begin.state.rotation.T).magnitude())
        kind = Finding.ATTITUDE if left < _ALIKE else Finding.ATTITUDE_UNRELATED
        unit = (
            _angle_unit_finding(begin.command, begin.sensor, about.lag) if kind is Finding.ATTITUDE_UNRELATED else None
        )
        return begin._replace(findings=[*begin.findings, Found(finding=kind, size=angle, unit=unit)])
    frame = aligned[best].frame
    command, sensor = _read_as(begin.command, begin.sensor, *best)
    state, findings = begin.state, list(begin.findings)
    if best != as_it_is:
        findings.append(Found(finding=Finding.READING, source=best[0], reading=best[1]))
    few = thin(sensor, _COARSE)
    if best[0] == "command":
        state = _coarse(command, few, begin.mean, about, marker, fix_marker).state._replace(scale=1.0)
    rows = rows_of(command, few, begin.mean, attitude=True)
    assert rows.turned is not None
    if not fix_marker:
        arm = rows.answer.poses(state.position, state.angle).rotation
        state = state._replace(turn=Rotation.from_matrix(arm.swapaxes(1, 2) @ frame @ rows.turned).mean().as_matrix())
    state = state._replace(rotation=frame)
    return begin._replace(command=command, sensor=sensor, attitude=True, state=state, findings=findings)


def _read_as(
    command: list[Motion], sensor: list[Motion], source: str, reading: Reading
) -> tuple[list[Motion], list[Motion]]:
    """Commands and sensor, the orientations of one of them read otherwise."""

    def otherwise(motions: list[Motion]) -> list[Motion]:
        return [
            motion if motion.quaternion is None else motion._replace(quaternion=read(motion.quaternion, reading))
            for motion in motions
        ]

    return (otherwise(command), sensor) if source == "command" else (command, otherwise(sensor))


class _Aligned(NamedTuple):
    """One rotation for positions and orientations."""

    frame: FloatArray  # base from sensor, (3, 3)
    left: float  # what it leaves, of 1
    excess: float  # what it leaves beyond what two rotations would, one of each: 1 is a radian
    attitude: tuple[FloatArray, float]  # that of orientations, and what it leaves of them


def _align(begin: _Begin, few: list[Motion], source: str, reading: Reading) -> _Aligned:
    """One frame for both, orientations of a source read in some way."""
    command, sensor = _read_as(begin.command, few, source, reading)
    rows, state = rows_of(command, sensor, begin.mean, attitude=True), begin.state
    assert rows.turned is not None
    poses = rows.answer.poses(state.position, state.angle)
    path, seen = unit(poses.position + poses.rotation @ state.marker), unit(rows.centred)
    turns = align_turns(Rotation.from_matrix(poses.rotation), Rotation.from_matrix(rows.turned))
    size = max(float(np.linalg.norm(turns[0])) / np.sqrt(len(turns[0])), _NOTABLE) * np.sqrt(len(turns[0]) / len(path))
    commanded, measured = (turn / size for turn in turns)
    frame, left = kabsch(np.vstack([path, commanded]), np.vstack([seen, measured]))
    rotation = kabsch(np.vstack([_HARDLY * path, commanded]), np.vstack([_HARDLY * seen, measured]))[0]
    of_path, alone = kabsch(path, seen)[1], kabsch(commanded, measured)[1]
    half = float(len(path))  # the sum of squares of each
    beyond = max(left - of_path - alone, 0.0)
    share, excess = np.sqrt([0.5 * left / half, 0.5 * beyond / half]).tolist()
    return _Aligned(frame, share, excess, (rotation, float(np.sqrt(alone / half))))


def _fit(begin: _Begin, fix_marker: bool, loosely: bool) -> Registration:
    """The least squares over all, and what they do not tell."""
    findings = begin.findings
    if any(finding.prevents for finding in findings):
        return Registration(findings=tuple(findings))
    sensor = thin(begin.sensor, _ROWS)
    rows, state = rows_of(begin.command, sensor, begin.mean, attitude=begin.attitude), begin.state
    poses = rows.answer.poses(state.position, state.angle)
    blind, determined = _split_directions(poses.rotation)
    if fix_marker:
        blind = determined = np.zeros((3, 0))
    elif blind.shape[1] == 3:
        findings.append(Found(finding=Finding.STILL, source=None if rows.answer.turns else "command"))
    elif blind.shape[1] == 1:
        findings.append(Found(finding=Finding.ONE_AXIS, axis=_vector(blind[:, 0])))
    loose, held = _about(poses.position + poses.rotation @ state.marker, poses.rotation, begin.attitude)
    if loose.shape[1]:
        findings.append(Found(finding=Finding.LINE, axis=_vector(loose[:, 0])))
    elif begin.either and not (begin.attitude and determined.shape[1]):
        findings.append(Found(finding=Finding.PLANE))
    moves = bool(np.std(poses.position, axis=0).max() > _BESIDE)
    allowed = partial(_free, held, determined, turn=begin.attitude and not fix_marker, scale=False)
    own_lag = rows.answer.turns and len(determined.T) > 0 and moves  # else nothing tells the lag of positions
    if own_lag and not begin.attitude:
        state = _turning_anew(begin, allowed(own_lag=True))
    fit = fit_poses(rows, state, allowed(own_lag=own_lag))
    if own_lag and not begin.attitude and fit.half_widths(_numbers(fit.state, begin.mean)[1])[15] > _SURE:
        own_lag, fit = False, fit_poses(rows, state, allowed(own_lag=False))
    spread = float(np.std(rows.centred))
    odd = any(finding.finding is Finding.SCALE and not finding.unit for finding in findings)
    most = (_LOOSELY if loosely else _ODD if odd else _UNEXPLAINED) * spread
    if fit.left() ** 2 - _jitter(begin.sensor) ** 2 > most**2:
        said = [finding for finding in findings if finding.finding is Finding.SCALE and finding.unit]
        unexplained = _unexplained_finding(begin.command, begin.sensor, fit.state.angle.lag, fit.left() / spread)
        return Registration(findings=(*said, unexplained))
    return _add_intervals(fit, begin, loose, blind, own_lag)


def _turning_anew(begin: _Begin, free: FloatArray) -> State:
    """Where the plant of turning is near the best of all: a dead time that is off by a step of commands may look alike.

    The marker makes up for it, by a millimetre.
    """
    few = rows_of(begin.command, thin(begin.sensor, _COARSE), begin.mean, attitude=False)
    lag = begin.state.angle.lag
    constants = np.maximum(np.array(_SHARES) * lag, _SMOOTH).tolist()
    fits = [fit_poses(few, begin.state._replace(angle=Plant(lag - each, each)), free) for each in constants]
    whitening = fits[0].off.whitening()
    return min(fits, key=lambda fit: fit.off.cost(whitening)).state


def _unexplained_finding(command: Sequence[Motion], sensor: Sequence[Motion], lag: float, share: float) -> Found:
    """The finding that no frame explains a share of the motion, and whether commands without orientation may be why."""
    lacks_turns = command[0].quaternion is None and sensor[0].quaternion is not None
    unit = _angle_unit_finding(command, sensor, lag)
    return Found(finding=Finding.UNEXPLAINED, size=share, source="command" if lacks_turns else None, unit=unit)


def _angle_unit_finding(command: Sequence[Motion], sensor: Sequence[Motion], lag: float) -> str | None:
    """A question about the unit of angles, where the tool is told to turn as many times as far as deg are of rad."""
    turns = ratio(command, sensor, lag, turns=True)
    if turns > 0.0 and abs(abs(np.log(turns)) - np.log(DEG)) < _ANGLES:
        commanded, seen = ("deg read as rad", "rad read as deg")[:: 1 if turns > 1.0 else -1]
        asked = f"are its angles {seen}, or the commanded {commanded}?"
        return f"the tool is told to turn {turns:.2g} times as far as is seen: {asked}"
    return None


def _jitter(sensor: Sequence[Motion]) -> float:
    """The noise of positions from one row to the next [m], by the median of second differences, all axes together."""
    change = np.concatenate([np.diff(motion.position, 2, axis=0) for motion in sensor])
    return float(np.sqrt(np.mean(np.median(np.abs(change), axis=0) ** 2 / (6.0 * _OF_NORMAL**2))))


def _about(path: FloatArray, rotation: FloatArray, attitude: bool) -> tuple[FloatArray, FloatArray]:
    """Axes of the base about which the motion does not tell how the sensor is turned, and about which it does."""
    about = path - path.mean(axis=0)
    if attitude:
        turned = Rotation.from_matrix(rotation)
        about = np.vstack([about, _LEVER * (turned * turned.mean().inv()).as_rotvec()])
    square, axes = np.linalg.eigh(np.sum(about**2) * np.eye(3) - about.T @ about)
    determined = square >= _BESIDE**2 * len(path)
    return axes[:, ~determined], axes[:, determined]


def _vector(of: FloatArray) -> Vector:
    x, y, z = of.tolist()
    return x, y, z


def _add_intervals(fit: Fit, begin: _Begin, loose: FloatArray, blind: FloatArray, own_lag: bool) -> Registration:
    """The numbers with their intervals."""
    state = fit.state
    values, slopes = _numbers(state, begin.mean)
    half = fit.half_widths(slopes)
    lost = np.zeros((SIZE, loose.shape[1] + blind.shape[1]))
    lost[ROTATION, : loose.shape[1]], lost[MARKER, loose.shape[1] :] = loose, blind
    if blind.shape[1] == 1:  # along the one axis that the tool turns about the frame's place makes up for the marker
        lost[CENTRE, loose.shape[1] :] = fit.off.poses.rotation.mean(axis=0) @ blind
    half[(np.abs(slopes @ lost) > _TILT).any(axis=1)] = np.inf
    if not begin.attitude:
        half[9:12] = np.inf
    numbers = list(map(Quantity.around, values.tolist(), half.tolist()))
    position, rotation = (Response(lag=a, delay=b, time_constant=c) for a, b, c in (numbers[12:15], numbers[15:18]))
    noise = fit.off.rms()
    turned = values[3:6] - loose @ (loose.T @ values[3:6])
    along = is_here(state.centre - begin.mean, turned)
    ahead = [Found(finding=Finding.AHEAD, size=-position.lag.value)] if position.lag.ci95[1] < 0.0 else []
    return Registration(
        frame=_of_numbers(numbers[:6]),
        marker=_of_numbers(numbers[6:12]),
        position=position,
        rotation=rotation if own_lag else None,
        rms=noise[0],
        noise=_jitter(begin.sensor),
        rms_rotation=noise[1] if begin.attitude else None,
        rows=len(fit.off.blocks[0]),
        findings=(*begin.findings, *ahead, *([Found(finding=Finding.ALONG_BASE)] if along else [])),
    )


def is_here(at: Vector | FloatArray, rotation: Vector | FloatArray) -> bool:
    """Whether a place [m] and a rotation vector [rad] are zero, as nearly as an arm tells."""
    return bool(np.linalg.norm(at) < _HERE and np.linalg.norm(rotation) < _AS_TURNED)


def _of_numbers(numbers: Sequence[Quantity]) -> Registered:
    """A place and an orientation of six numbers."""
    x, y, z, a, b, c = numbers
    return Registered(
        at=(x.value, y.value, z.value),
        at_ci95=(x.ci95, y.ci95, z.ci95),
        rotation=(a.value, b.value, c.value),
        rotation_ci95=(a.ci95, b.ci95, c.ci95),
    )


def _numbers(state: State, mean: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frame, marker, and lag, delay, τ of both plants, (18,), and how a step changes them, (18, 17)."""
    middle = state.scale * state.rotation @ mean
    values, slopes = np.zeros(18), np.zeros((18, SIZE))
    values[0:3], values[6:9] = state.centre - middle, state.marker
    slopes[0:3, CENTRE], slopes[6:9, MARKER] = np.eye(3), np.eye(3)
    slopes[0:3, ROTATION] = cross_matrix(middle[None])[0]
    for first, matrix, where in ((3, state.rotation, ROTATION), (9, state.turn, TURN)):
        values[first : first + 3] = Rotation.from_matrix(matrix).as_rotvec()
        slopes[first : first + 3, where] = np.linalg.inv(left_jacobian(values[None, first : first + 3])[0])
    for first, plant, where in ((12, state.position, POSITION), (15, state.angle, ANGLE)):
        values[first : first + 3] = plant.lag, plant.delay, plant.time_constant
        slopes[first : first + 3, where] = [[1.0, plant.time_constant], [1.0, 0.0], [0.0, plant.time_constant]]
    return values, slopes

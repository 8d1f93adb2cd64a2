"""What names say: of columns, topics and files. Role, axis, unit, and which columns are no positions at all."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Container, Iterable
from typing import Literal, TypeAlias

from ..logs.columns import leaf
from ..units import ending, kind_of

Role: TypeAlias = Literal["command", "sensor", "reference"]


def words_in(text: str) -> frozenset[str]:
    """The words of a list that is easy to read here."""
    return frozenset(text.split())


# Of which there may be two:
_DEVICES = words_in("tracker camera cam vision sensor range laser mocap vicon optitrack qualisys gps")
# Where words of several roles meet, as in command_state, the first role wins.
_ROLES: dict[Role, frozenset[str]] = {
    "reference": words_in("truth reference ref ground gt groundtruth referencia referenz riferimento"),
    "command": words_in(
        "command commands commanded cmd goal goals target targets tgt tar desired des demand demanded setpoint"
        " setpoints set sp soll sol sollwert planned action actions control ctrl input inputs com wanted reqd requested"
        " leader master"
        " consigna consigne comando deseado desejado controle"
    ),
    "sensor": _DEVICES
    | words_in(
        "state states measured measurement measurements meas msr actual present real ist istwert pv process current"
        " cur curr encoder encoders feedback fbk fb readback rbv observed observation estimate estimated recorded"
        " reported odom medida medido mesure messwert misura follower slave puppet"
    ),
}
# In the name of a topic or file these are something else.
_OF_COLUMNS = words_in("set sp pv process fb current cur curr present real control ctrl input inputs")
_OF_ROLES = _ROLES["reference"] | _ROLES["command"] | _ROLES["sensor"]
SEEN = words_in("target targets tgt tar")  # commands, but of a sensor beside words of what cameras look at, and by
DRIVES = words_in("control ctrl input inputs controle")  # commands, or what a controller puts into motors or rotors
_PATHS = words_in("traj trajectory")  # of columns, commands where no other word says what they are
_MARKERS = words_in("marker markers fiducial fiducials tag tags aruco charuco apriltag apriltags checkerboard")
_OF_PLACES = _MARKERS | words_in("pose poses")  # of a sensor in the name of a topic or file, of nobody in a column's
FILTERED = words_in(
    "filt filter filtered lpf lowpass smooth smoothed kf ekf ukf kalman denoised est estimate estimated"
)  # of columns that are computed from raw ones
RAW = words_in("raw")
PARTS = words_in("nominal correction corrections")  # a command may be the sum of such
_SILENT = (
    _OF_ROLES
    | FILTERED
    | PARTS
    | _PATHS
    | RAW
    | words_in(
        "pose poses position positions pos point points data translation transform value values scalar scalars"
        " joint jnt dof qpos controller robot arm tool tcp ee flange coordinates axis posicion posicao posizione"
    )
)
_QUANTITIES = words_in(
    "velocity velocities vel speed speeds rate rates omega gyro dq qvel dot acceleration accelerations acc accel"
    " accelerometer ddq qdd qacc jerk effort efforts torque torques torq trq tor tq tau moment moments force forces"
    " tension tensions wrench thrust thrusts momentum current currents cur curr amp amps amperes voltage volt volts"
    " power pwm duty load pressure temperature temperatures temp covariance quaternion quat std sd sigma var variance"
    " error err errs yawspeed rollspeed pitchspeed rpm rps mps kmh kpa psi pct percent pixel pixels"
)
_NO_POSITIONS = _QUANTITIES | words_in(
    "kp ki kd mode scaling bits quality confidence orientation rotation twist index id seq sequence count status valid"
    " latency duration header stamp nanosec layout frame done reward task episode tick time timestamp reset lat lon"
    " latitude longitude good innov"
)
_OF_RUNS = words_in("load temp")  # in a long name of a file how it was made: with a load, or to be overwritten
_OF_QUANTITY = 2  # words: measured_load, load_cell
_FINGERS = words_in("index rotation")  # of a hand: beside words of roles, at the end, these are joints
_ERRORS = words_in("error err errs")
_SPREADS = _ERRORS | words_in("std sd sigma covariance")  # in the unit of a position, and none
_CHANGES = words_in("delta relative rel incremental increment diff")
# Words that are something else only without a number and without a unit: ax1 and az_deg are axes.
_WHOLE = {
    **dict.fromkeys(words_in("vx vy vz vrx vry vrz ax ay az"), "a rate"),
    **dict.fromkeys(words_in("qx qy qz qw"), "turning"),
}
_IN_IMAGES = words_in("u v x y")  # beside which px is a unit, and no place along x
_TRANSLATIONS = {"tx": "x", "ty": "y", "tz": "z"}
_NOW = words_in("current cur curr")  # of motors, but of the present beside
_MEASURED = _ROLES["sensor"] - _NOW  # what is measured is a motor's current: CurrentFeedback
_PLACES = words_in("position positions pos angle")  # beside which act is actual, and no action
_POSITIONS = _PLACES | words_in("pose theta x y z roll pitch yaw")
_TIME_UNITS = {
    **dict.fromkeys(words_in("seconds secs sec s"), "s"),
    **dict.fromkeys(words_in("milliseconds millis msecs msec ms"), "ms"),
    **dict.fromkeys(words_in("microseconds micros usecs usec us"), "us"),
    **dict.fromkeys(words_in("minutes mins min"), "min"),
    **dict.fromkeys(words_in("hours hour hrs hr"), "h"),
}
_TIMES = frozenset(word for word in _TIME_UNITS if len(word) > 3 or word == "sec") | words_in(
    "t time times stamp stamps timestamp timestamps date datetime clock ts arrival arrived zeit tempo tiempo"
)
COUNTERS = words_in("frame frames sample samples index idx count counter seq sequence step tick cycle nr no number")
WHOSE = words_in("id joint motor servo axis actuator device node channel marker body")  # a row may be of one of many
EPISODES = ("episode_index", "episode", "run_id", "run", "trial")  # columns that tell runs in one table apart
VALID = words_in("valid tracked visible detected")  # of columns that say whether a row of a sensor means anything
_TELLING = _TIMES | COUNTERS | WHOSE | VALID | words_in("episode run trial")
_DIGITS = "0123456789"
_ELEMENT = re.compile(r"(.*[^\W_])(?:\[(\d+)\]|[_. ](\d+))")  # p[0], tcp_0
_NAMELESS = re.compile(r"(?:column |Column|Var|Unnamed: )(\d+)")  # also as MATLAB and pandas call them
_DESIRED = re.compile(r"(.+)_d(|[\d_[].*)")  # q_d[0], q_d_0, q_d1, x_d_mm; of q[0], q_0, q1, x_mm
_DEGREES = re.compile(r"°(?! *[CF/])")  # neither of temperatures nor of rates
_PER = re.compile(r"([ _]per[ _]|[\[(][^\])]*/)(mm|cm|m|um|deg|rad|mrad)[\])]?$", re.IGNORECASE)  # K [Nm/rad]
_OTHER_UNIT = re.compile(
    r"[\[(] *([kM]?Pa|m?bar|psi|rpm|k?N|N[. *]?m|m[AV]|k?Hz|%|px|[^\W\d]*/(?:s|sec|min)(?:\^?2|²)?) *[\])]$",
    re.IGNORECASE,
)
_IN_BRACKETS = re.compile(r" [\[(] *([^\W\d][^\])]*?)\W*[\])]$")  # counts [counts?]; no label of a list
_BRACKETED = re.compile(rf"[\[(] *(mm|cm|m|um|in|deg|rad|mrad) *[\])]|{_DEGREES.pattern}")
_KEYS = words_in("file topic entity where time clock start")  # of a source in run.toml, beside its axes
# Joints in metres, where others turn.
SLIDING = words_in("slide slider prismatic linear rail gantry insertion telescope telescopic elevator")
JOINTS = words_in("joint joints jnt dof")
TOOLS = words_in("tool tcp ee eef effector flange")  # whose numbers are of space
_OF_SPACE = TOOLS | words_in("cartesian xyz")
# Beside these they are of joints, or angles alone.
_NOT_OF_SPACE = JOINTS | words_in("controller qpos q rpy ypr euler rotvec rot angle angles ori orient hand gripper")
_IN = "in"  # inches, or an input
_UNITS = {
    **dict.fromkeys(words_in("mm millimeter millimeters millimetre millimetres"), "mm"),
    **dict.fromkeys(words_in("cm centimeter centimeters centimetre centimetres"), "cm"),
    **dict.fromkeys(words_in("in inch inches"), "inch"),
    **dict.fromkeys(words_in("m meter meters metre metres"), "m"),
    **dict.fromkeys(words_in("um micrometer micrometers micrometre micrometres"), "um"),
    **dict.fromkeys(words_in("deg degs degree degrees"), "deg"),
    **dict.fromkeys(words_in("rad rads radian radians"), "rad"),
    "mrad": "mrad",
}
_TURNING = re.compile(
    r"joint|jnt|dof|shoulder|elbow|wrist|waist|hip|knee|ankle|neck|angle|theta|yaw|pitch|roll|heading|azimuth|motor"
    r"|angulo|angolo|winkel|servo|pan|tilt|lift|flex|gripper|^([amj](_?d)?_?\d+|q(_?d)?_?\d*)$|_(j\d+|q\d*)$",
    re.IGNORECASE,
)

_ACCENT = re.compile("[\u0300-\u036f]")
_HUMP = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[a-z]\d)(?=[A-Z])|(?<=[a-z]\d\d)(?=[A-Z])|(?<=[A-Z0-9])(?=[A-Z][a-z])")
_KNOWN = _OF_ROLES | _SILENT | _NO_POSITIONS | _TELLING
# Words of roles without a separator before or behind an axis or what is no position; com is a centre of mass, too.
_ROLE = "|".join(sorted({word for word in _OF_ROLES if len(word) > 2} - {"com"} | {"act"}))
_WHAT = rf"(?:[xyzqj]|{'|'.join(sorted((_POSITIONS | _NO_POSITIONS | {'joint'}) - _TIMES))})\d*"
_GLUED = re.compile(rf"({_ROLE})({_WHAT})|({_WHAT})({_ROLE})")


def words(name: str) -> list[str]:
    """The words of a name in lower case: ``goalPose_x`` is goal, pose, x; ``QTarget2`` is q, target, 2.

    Numbers of devices stay with them: ``camera2`` is one word. ``refx`` is ref, x, and ``velcmd`` is vel, cmd. ``H2C``
    is one, too. ``PosAct`` is pos, actual. Accents are left out, and µ is u.
    """
    apart = _HUMP.sub("_", _ACCENT.sub("", unicodedata.normalize("NFKD", name).replace("μ", "u")))
    whole = [word.lower() for word in re.split(r"[^A-Za-z0-9]+", apart) if word]
    glued = [None if word in _KNOWN else _GLUED.fullmatch(word) for word in whole]
    parts = [
        part
        for word, match in zip(whole, glued, strict=True)
        for part in (filter(None, match.groups()) if match else [word])
    ]
    if not _PLACES.isdisjoint(parts):
        parts = ["actual" if word == "act" else word for word in parts]
    numbered = [re.fullmatch(r"([a-z]+)(\d+)", word) for word in parts]
    return [
        part
        for word, match in zip(parts, numbered, strict=True)
        for part in (match.groups() if match and match[1] in _OF_ROLES - _DEVICES else (word,))
    ]


def role_of(name: str) -> Role | None:
    """What the name of a topic or a file says its numbers are."""
    return _role([word for word in words(name) if word not in _OF_COLUMNS], _OF_PLACES)


def says_only(vocabulary: frozenset[str], columns: Iterable[str]) -> bool:
    """Whether names call their numbers commands by nothing but words of ``SEEN`` or of ``DRIVES``."""
    stems = {word.rstrip(_DIGITS) for column in columns for word in words(column)} & _ROLES["command"]
    return bool(stems) and stems <= vocabulary


def role_words(column: str) -> list[str]:
    """The words of a column's name that say whose it is, and whether it is filtered."""
    return [word for word in words(leaf(column)) if word.rstrip(_DIGITS) in _OF_ROLES | FILTERED | _PATHS]


def bare(name: str) -> list[str]:
    """The words of a column's name without those of roles: the same of ``q_cmd[0]``, ``q_d[0]`` and ``q[0]``."""
    match = _DESIRED.fullmatch(name)
    name = f"{match[1]}{match[2]}" if match else name
    return [word for word in words(name) if word not in role_words(name)]


def column_role(column: str) -> Role | None:
    """What the name of a column says its numbers are."""
    parts = words(leaf(column))
    return _role(parts, frozenset()) or (None if _PATHS.isdisjoint(parts) else "command")


def quantity(label: str, column: str) -> set[str]:
    """The words of a place, and the devices of a column there, that are the same of raw and filtered numbers."""
    return {*words(label), *_DEVICES.intersection(words(column))} - FILTERED - RAW


def has_word(name: str, vocabulary: frozenset[str]) -> bool:
    """Whether one of these words is in a name."""
    return not vocabulary.isdisjoint(words(name))


def number_of_nameless(column: str) -> str:
    """The number of a column that has no name, as readers and programs call it; empty for any other."""
    match = _NAMELESS.fullmatch(column)
    return match[1] if match else ""


def is_time(column: str) -> bool:
    """Whether a column is called as stamps are; ``t_deg`` is an axis, and ``O_T_EE`` a matrix."""
    parts, named = words(column), words(leaf(column))
    t = "t" in (*named[:1], *named[-1:])
    return (t or not (_TIMES - {"t"}).isdisjoint(parts)) and not unit_of(column)


def time_unit_of(column: str) -> str:
    """The unit of stamps that a name says otherwise than by its ending, ``micros`` or ``t [ms]``; empty without one."""
    *before, last = words(column) or [""]
    return _TIME_UNITS.get(last, "") if before or len(last) > 2 else ""


def likeliest_first(columns: Iterable[str]) -> list[str]:
    """Columns in the order in which their names tell something: who, as many of each role, or when; then the others."""
    count = Counter[str]()

    def rank(column: str) -> tuple[bool, int]:
        parts = words(leaf(column))
        about = "when" if not _TELLING.isdisjoint(parts) else _role(parts, frozenset()) or ""
        count[about] += 1
        return not about, count[about]

    return sorted(columns, key=rank)


def no_position(column: str) -> str | None:
    """What a column is by its name, if that is no position; a unit of positions wins over words."""
    kind, unit, parts = kind_of(leaf(column)), ending(leaf(column)), words(leaf(column))
    if number_of_nameless(column):
        return None
    if not _CHANGES.isdisjoint(parts):
        return "relative: a change, no position"
    if _PER.search(column):
        return "a ratio"
    if other := _OTHER_UNIT.search(column):
        return f"in {other[1]}"
    is_told = kind is not None or _BRACKETED.search(column) is not None
    if not is_told and role_words(column) and any(word.rstrip(_DIGITS) == "qd" for word in parts):
        return "velocity"  # as UR calls it: target_qd_0 beside target_q_0
    if parts[-1:] == ["px"] and not _IN_IMAGES.isdisjoint(parts):
        return "in px"
    if whole := None if is_told else next((_WHOLE[word] for word in parts if word in _WHOLE), None):
        return whole
    parts = [word.rstrip(_DIGITS) for word in parts]
    whats = [word for word in parts if word in (_SPREADS if is_told else _NO_POSITIONS)]
    if len(whats) == 1 and whats[0] in _NOW and not _POSITIONS.isdisjoint(parts) and _MEASURED.isdisjoint(parts):
        return None
    if len(whats) == 1 and parts[-1] in _FINGERS and role_words(column):
        return None
    of_unit = f"in {unit.strip('_').replace('_', '/')}" if unit is not None and kind is None else None
    return next(iter(whats), "in °C or °/s" if "°" in column and not is_told else of_unit)


def no_position_by_place(label: str, columns: Iterable[str]) -> str | None:
    """What the columns of a file or topic are by its name, if they have no words of their own and are no positions.

    That is a quantity alone: runs are called after gains, tasks, robots and loads, ``kp12``, ``no-load-sine-2``.
    """
    silent = all(axis_of(column, []) == "position" and not role_words(column) for column in columns)
    why = no_position(label) if silent else None
    is_run = why in _OF_RUNS and len(words(label)) > _OF_QUANTITY
    return why if why in _QUANTITIES and not is_run and not has_word(label, _POSITIONS) else None


def family(column: str, columns: Container[str]) -> tuple[str, str, str]:
    """What columns of one source share, whose names have no words of roles: list, copy of a header, desired values.

    The list that it is an element of (``state.q``); the number of the copy (``.1``); for desired values beside measured
    ones, as ``q_d[0]`` beside ``q[0]`` or ``q_d1`` beside ``q1``, the name of these. Each may be empty. ``columns`` are
    the names beside it, without what is before their last point.
    """
    base, _, number = column.rpartition(".")
    copy = f".{number}" if number.isdigit() and last(base) in columns else ""
    base = base if copy else column
    match = _DESIRED.fullmatch(last(base))
    measured = f"{match[1]}{match[2]}" if match else ""
    return leaf(base) if re.search(r"\w\[\d+\]$", base) else "", copy, measured if measured in columns else ""


def last(column: str) -> str:
    """What is behind the last point of a field path that is before a letter."""
    return re.sub(r"^.*\.(?=[A-Za-z_])", "", column)


def unit_of(column: str) -> str:
    """The unit of a position that a name says, ``mm``; empty without one."""
    unit = ending(leaf(column))
    if unit is not None and kind_of(leaf(column)) is not None:
        return unit[1:]
    if _DEGREES.search(column):
        return "deg"
    *before, last = words(column) or [""]  # also that of `x [mm]`
    return _UNITS.get(last, "") if before and (last != _IN or _BRACKETED.search(column)) else ""


def other_unit_of(column: str) -> str:
    """What a name says in brackets, if that is no unit of a position, ``counts``; empty without one."""
    match = None if unit_of(column) else _IN_BRACKETS.search(column)
    return match[1] if match else ""


def inches_in(columns: Iterable[str]) -> dict[str, str]:
    """Columns of which ``in`` at the end is a unit, under names that say so: ``x_cmd_in``, and ``x_in`` beside that.

    Alone, or beside ``x_out``, this may be an input.
    """
    ends_so = [column for column in columns if words(column)[-1:] == [_IN]]
    is_unit = any(role_words(column) for column in ends_so)
    return {column: re.sub(rf"{_IN}$", "inch", column) for column in ends_so} if is_unit else {}


def is_turning(axis: str) -> bool:
    """Whether an axis is called as joints are."""
    return _TURNING.search(axis) is not None


def turns(column: str, axis: str) -> bool:
    """Whether a column is of a joint that turns, by its axis or, as ``joint_pos_FL``, by a word before that."""
    stems = {word.rstrip(_DIGITS) for word in words(leaf(column))}
    return is_turning(axis) or (not JOINTS.isdisjoint(stems) and SLIDING.isdisjoint(stems))


def axis_of(column: str, labels: list[str]) -> str:
    """What a column's axis is called: the words of its name that say nothing else; ``labels`` are of lists."""
    column = re.sub(r"(?<=\])\.\d+$", "", column)  # a copy of a header
    label = None if unit_of(column) else re.search(r"\[([^\]]*)\]$", column)
    if label and label[1].isdigit():
        if (told := label_of(column, labels)) is not None:
            return identifier(re.sub(r"\.pos$", "", told))
        number = int(label[1])
        spatial = number < 3 and not {"translation", "translations"}.isdisjoint(words(column))
        return "xyz"[number] if spatial else f"joint{number}"
    if label:
        return identifier(label[1]) or "position"
    unit = unit_of(column)
    kept = [word for word in words(column) if word not in _SILENT and word.rstrip(_DIGITS) not in _DEVICES]
    if unit and kept and _UNITS.get(kept[-1]) == unit:
        kept = kept[:-1]
    kept = [_TRANSLATIONS.get(word, word) for word in kept]
    if kept and all(word.isdigit() for word in kept):
        kept = ["joint", *kept]
    named = leaf(column).rpartition(".")[2] if unit and "." in column else ""  # command.arm_deg is of the axis arm
    return identifier("_".join(kept)) or identifier(named) or "position"


def lists(columns: Iterable[str]) -> dict[str, list[str]]:
    """Columns that are the elements of one list, ``p[0]`` and ``p[1]`` or ``tcp_1`` and ``tcp_2``, by what they share.

    They are counted from 0 or 1, without a gap; a unit may end each.
    """
    elements: dict[str, dict[int, str]] = {}
    for column in columns:
        if (match := _ELEMENT.fullmatch(column.removesuffix(ending(column) or ""))) is not None:
            elements.setdefault(match[1], {})[int(match[2] or match[3])] = column
    ordered = {name: sorted(numbered.items()) for name, numbered in elements.items()}
    return {
        name: [column for _, column in items]
        for name, items in ordered.items()
        if items[0][0] in (0, 1) and items[-1][0] - items[0][0] == len(items) - 1
    }


def is_of_space(name: str) -> bool:
    """Whether the name of a list says that its numbers are places, or poses, of a tool in space."""
    parts = {word.rstrip(_DIGITS) for word in words(name)}
    return not _OF_SPACE.isdisjoint(parts) and _NOT_OF_SPACE.isdisjoint(parts)


def label_of(column: str, labels: list[str]) -> str | None:
    """What the element of a list is called, where the log says so."""
    index = re.search(r"\[(\d+)\]$", column)
    return labels[int(index[1])] if index and int(index[1]) < len(labels) else None


def identifier(name: str) -> str:
    """A name that can be an axis or a sensor: letters, digits, no unit at its end."""
    made = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")[:60]
    while (unit := ending(made)) is not None:
        made = made.removesuffix(unit)
    return f"{made}_axis" if made in _KEYS else made


def _role(parts: list[str], more: frozenset[str]) -> Role | None:
    plainly = {word.rstrip(_DIGITS) for word in parts}
    if not plainly.isdisjoint(_MARKERS | _DEVICES):  # camera_target is what a camera looks at
        plainly -= SEEN
    for role, vocabulary in _ROLES.items():
        if not vocabulary.isdisjoint(plainly):
            return role
    return None if more.isdisjoint(parts) else "sensor"

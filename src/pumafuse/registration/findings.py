"""What a registration does not guess: findings, and the one sentence of each."""

from __future__ import annotations

import enum
from typing import TypeAlias

import msgspec

from ..units import DEG, MS

Vector: TypeAlias = tuple[float, float, float]


class Finding(enum.Enum):
    """What is wrong or not told."""

    SHORT = "short"  # too few rows, or too little time
    UNRELATED = "unrelated"  # the sensor does not move as the tool does
    UNEXPLAINED = "unexplained"  # it moves with the tool, and no frame explains how
    MIRRORED = "mirrored"  # the sensor's axes are left-handed
    LINE = "line"  # the motion does not tell how the sensor is turned about an axis of the base
    PLANE = "plane"  # the motion does not tell whether the sensor's axes are right-handed
    SCALE = "scale"  # lengths of the sensor are not those of the commands
    STILL = "still"  # the tool does not turn
    ONE_AXIS = "one-axis"  # the tool turns about one axis of its own only
    READING = "reading"  # an orientation follows if it is read in another way
    ATTITUDE = "attitude"  # orientations are told in another frame than positions
    ATTITUDE_UNRELATED = "attitude-unrelated"  # orientations follow in no way
    AHEAD = "ahead"  # it moves before an arm can that holds each command
    ALONG_BASE = "along-base"  # the frame is the base's, as nearly as an arm tells


AS_READ = (Finding.SCALE, Finding.READING, Finding.ATTITUDE)  # rows were read otherwise than run.toml says


class Reading(enum.Enum):
    """How the four numbers of an orientation are to be read."""

    AS_IT_IS = "as they are"
    INVERSE = "as turning the other way"
    W_FIRST = "with w first (order = 'wxyz')"
    W_LAST = "with w last (order = 'xyzw')"


_UNTOLD = "the commands tell no orientation (run.toml), by which alone one knows where its marker is"
_UNTRUE = (
    "are units, the order and the unit of orientations right, of the commands, too (run.toml)? A path that drifts, or"
    " poses that no arm commands, leave as much"
)
_WORDS = {
    Finding.SHORT: "has {size:.1f} s of measurements beside commands: too little to register it; record 10 s or more",
    Finding.UNRELATED: (
        "does not move with the tool (correlation of speeds {size:+.2f}): is it of this run and clock?"
    ),
    Finding.UNEXPLAINED: "moves with the tool, and no frame explains how: {percent:.0f} % are left; {why}",
    Finding.MIRRORED: (
        "has left-handed axes beside the commands': is a sign wrong, or are two axes exchanged (run.toml)?"
    ),
    Finding.LINE: "saw motion along ({axis}) of the base only: how it is turned about that is not known",
    Finding.PLANE: "saw motion in a plane only: its axes are taken to be right-handed, which nothing tells",
    Finding.SCALE: (
        "measures lengths that are to be multiplied by {size:.4g}{scale_of}: mend unit or scale (run.toml)"
    ),
    Finding.STILL: "saw a tool that does not turn: its marker stays as given, and the frame's place makes up for it",
    Finding.ONE_AXIS: "saw the tool turn about ({axis}) of its own only: along that the marker stays as given",
    Finding.READING: "and the commands turn alike if the orientations of the {source} are read {reading}",
    Finding.ATTITUDE: (
        "tells orientations in another frame than positions, turned by {degrees:.1f}°: its orientations are not used"
    ),
    Finding.ATTITUDE_UNRELATED: (
        "tells orientations that do not follow the commanded ones: they are not used{angles_of}"
    ),
    Finding.AHEAD: (
        "moves {ms:.1f} ms before an arm can that holds each command: are these samples of a path (interpolation_ms in"
        " run.toml), or is a clock off (shift_s)?"
    ),
    Finding.ALONG_BASE: "measures along the base's axes, as far as the motion tells: no frame is written",
}


class Found(msgspec.Struct, frozen=True, kw_only=True):
    """A finding with its numbers."""

    finding: Finding  # what it is
    # SHORT: how long [s]; AHEAD: by how much [s]; UNRELATED: correlation of speeds; UNEXPLAINED: share of the motion;
    # SCALE: the base's lengths over the sensor's; ATTITUDE: the angle between the frames [rad]
    size: float | None = None
    axis: Vector | None = None  # LINE: in the base; ONE_AXIS: on the tool
    source: str | None = None  # READING: whose, command or sensor
    reading: Reading | None = None  # READING: how it follows
    # SCALE: the units of sensor and base that it looks like; UNEXPLAINED, ATTITUDE_UNRELATED: those of angles
    unit: str | None = None

    @property
    def prevents(self) -> bool:
        """Whether nothing is registered then."""
        return self.finding in (Finding.SHORT, Finding.UNRELATED, Finding.UNEXPLAINED, Finding.MIRRORED)

    def sentence(self, sensor: str) -> str:
        """What to know of a sensor, and what to do."""
        size, unit = self.size or 0.0, f"{self.unit} (run.toml)" if self.unit else ""
        words = _WORDS[self.finding].format(
            size=size,
            percent=100.0 * size,
            degrees=size * DEG,
            ms=size * MS,
            axis=", ".join(f"{number:.3f}" for number in self.axis or ()),
            source=self.source,
            reading=self.reading and self.reading.value,
            why=_UNTOLD if self.source == "command" else unit or _UNTRUE,
            scale_of=f", as if it were {self.unit}, or the commands the other way round" if self.unit else "",
            angles_of=f"; {unit}" if unit else "",
        )
        return f"{sensor} {words}"

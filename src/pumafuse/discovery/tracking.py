"""Whether what a sensor measures on an axis is where the commands lead: motion, zero, and motion of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import FloatArray, median
from .matching import slope_of_pieces

FOLLOWS = 0.95  # correlation from which there is nothing to ask
GAIN = 3.0  # factor on a motion up to which it may be a gain
_NOISY = 3.0  # times the noise, up to which a distance is noise
_FAR = 5.0  # sds beyond which chance is no explanation
_UNLIKELY = 3.5  # sds of priors beyond which they are none
_MODEL = 0.01  # share of a motion that a wrong model makes look like another zero
_PIECES = 20  # of a run; where their means scatter, the zero wanders and is not another one
_SMOOTH = 0.0  # correlation of one step and the next from which they are a motion; that of noise is −0.5


@dataclass(frozen=True)
class Tracking:
    """Up to 500 positions that a sensor measures on an axis, and where the commands lead, relative to the start.

    Attributes:
        time: Since the first [s], (n,).
        measured: [m or rad], (n,).
        led: [m or rad], (n,).
        before: Where the commands had led shortly before each [m or rad], (n,).
        noise: Standard deviation of what varies [m or rad].
        zero_sd: That of the difference of both zeros, by the priors [m or rad].
        drift: Density of the random walk [m/√s or rad/√s].
    """

    time: FloatArray
    measured: FloatArray
    led: FloatArray
    before: FloatArray
    noise: float
    zero_sd: float
    drift: float

    @cached_property
    def _near(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Time, measured and commanded motion without outliers, and that shortly before, (k,) each.

        At rest all is near: what is off by no more than the motion, as a wrong delay makes it, is no outlier.
        """
        distance = self.measured - self.led
        distance = np.abs(distance - median(distance))
        near = distance <= max(10.0 * median(distance), float(np.ptp(self.led))) + 1e-12
        kept = slice(None) if near.all() else near
        return self.time[kept], self.measured[kept], self.led[kept], self.before[kept]

    @cached_property
    def _moved(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The same about zero, without time."""
        _, measured, led, before = (part - part.mean() for part in self._near)
        return measured, led, before

    @property
    def rests(self) -> bool:
        """Whether all values are one."""
        return float(np.ptp(self.measured)) == 0.0

    @cached_property
    def correlation(self) -> float:
        """Of measured and commanded motion; 0 where one of them rests."""
        measured, led, _ = self._moved
        power = math.sqrt(float(measured @ measured) * float(led @ led))
        return float(measured @ led) / power if power > 0.0 else 0.0

    @property
    def follows(self) -> bool:
        """Whether there is nothing to ask: it moves about as far as commanded, about then, or is off by its noise."""
        measured, led, before = self._moved
        if _spread(measured - led) <= _NOISY * self.noise or not led.any():
            return True
        if self.correlation < FOLLOWS:
            return False
        slope = float(measured @ led) / float(led @ led)
        left, step = measured - slope * led, led - before
        along, power = float(left @ step), max(float(step @ step), 1e-30)
        is_late = abs(along) > 0.5 * slope * power and along**2 > 0.5 * power * float(left @ left)
        return 1.0 / GAIN < slope < GAIN and not is_late

    @property
    def lacks_motion(self) -> bool:
        """Whether less than half of the commanded motion is there, by three standard errors."""
        measured, led, _ = self._moved
        slope, error = slope_of_pieces(measured, led)
        return slope + 3.0 * error < 0.5 and _spread(led) > self.noise

    @cached_property
    def own_motion(self) -> float:
        """How far it moves while the commands rest [m or rad]; 0 if they do not, or if it is noise or drift."""
        time, measured, led, _ = self._near
        if np.ptp(led) > 0.0 or len(measured) < 3:
            return 0.0
        steps = np.diff(measured)
        expected = math.hypot(math.sqrt(2.0) * self.noise, self.drift * math.sqrt(float(np.median(np.diff(time)))))
        power = float(steps @ steps)
        is_smooth = float(steps[1:] @ steps[:-1]) > _SMOOTH * power
        far = math.sqrt(power / len(steps)) > _FAR * expected
        return float(np.ptp(measured)) if is_smooth and far else 0.0

    @cached_property
    def zero(self) -> float:
        """How far its zero is from the commands' [m or rad]; 0 if chance and priors explain it.

        The constant of a regression on where the commands lead and on how that changes, so that a wrong gain or lag
        does not count. Where the zero wanders, its scatter is its error.
        """
        _, measured, led, before = self._near
        _, moved, moved_before = self._moved
        motions = (led, moved), (led - before, moved - moved_before)
        columns = [one for one, about_zero in motions if _spread(about_zero) > self.noise]
        known, off = np.array([np.ones(len(led)), *columns]), measured - led
        gram = known @ known.T
        found = np.linalg.lstsq(gram, known @ off)[0]
        if not self.excludes(float(found[0])):
            return 0.0
        left = off - found @ known
        wanders = float(np.std([piece.mean() for piece in np.array_split(left, _PIECES)]))
        # at a distance from the start that hardly changes, the constant is as uncertain as the slope
        chance = wanders * math.sqrt(len(left) * float(np.linalg.pinv(gram, hermitian=True)[0, 0]))
        error = max(chance, _MODEL * float(np.ptp(led)))
        return float(found[0]) if abs(found[0]) > _FAR * error else 0.0

    def excludes(self, zero: float) -> bool:
        """Whether the priors do not expect such a difference of the zeros [m or rad]."""
        return abs(zero) > _UNLIKELY * self.zero_sd


def _spread(about_zero: FloatArray) -> float:
    """Standard deviation of values whose mean is 0."""
    return math.sqrt(float(about_zero @ about_zero) / len(about_zero))

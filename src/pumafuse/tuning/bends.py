"""Whether an axis has play, a fastest speed or a sag: tried on its motion, judged where it was not fitted.

What turns with the direction looks like a resonance in one motion, and what clips with the speed like a longer lag. The
likelihood of that motion cannot tell them apart; another part of it can.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from functools import partial
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..model.arm import AxisModel
from ..units import SCREEN
from .arms import BENDS, BEYOND, SAG, Arm, Fit, Limits, Measured, Recording, lonely
from .plain import FOLLOWS, PlainArm, independent

_ANY = {"delay": (0.0, 10.0), "lag": (1e-4, 4.0), "damping": (0.2, 8.0), "gain": (0.3, 3.0)}
_PARTS = 24  # of the time, every second of which arms are fitted to; they are judged on the others
_SEEMS, _PAYS = 0.98, 0.9  # of the squares: what a bend may leave anywhere, and of both halves where it was not fitted
_SOONER = np.linspace(0.0, 1.0, 5)  # of the linear arm's dead time and lag: what of it is play, or the limit
_WIDTHS, _SPEEDS = (0.7, 1.5, 3.0), (0.95, 0.8, 0.6)  # of what that arm leaves, as sd; of the fastest that it goes
_EARLIER = (0.0, 0.6)  # starts: of a first-order arm's dead time, what is lag of a second-order plant
_FEWEST = 20  # measurements of each half: four for each number that is fitted
_FASTEST = 0.98  # of the time it goes no faster
_KNEES = np.linspace(0.05, 0.95, 25)  # of the time the axis is lower
# Of the squares, what knees may leave where they were not fitted: sags of a simulated lever left 10 to 25 %, of a slope
# of -0.07, too; motion whose gain was not free, or up and down otherwise, 80 to 90 %.
_KNEED = 0.6
_SLIGHT = 0.01  # of a slope that is no sag: of exact data any other slope explains something
_MANY = 1.02  # times those that are near the linear arm
_KINDS = (("play", "max_speed", "sag"), ("stops",))  # of bends; sags have one knee, stops one on each side
_SAGS = ("sag", "stops")
_SLOPES = {"beyond": "slope_beyond", "below": "slope_below"}  # as a sag has them


class Bent(NamedTuple):
    """An arm with play, a fastest speed, a sag, or several of these."""

    arm: Arm  # the arm, fitted to all of the motion
    off: float  # how far it is off where it was not fitted [m]
    linear_off: float  # how far the linear arm is off there [m]
    sag_half: dict[str, float]  # half the 95 % interval of each number of its sag, by its name in a :class:`Sag`

    def sentences(self, model: AxisModel) -> list[str]:
        """What the model of its axis has, and what that is worth."""
        screen = SCREEN[model.kind]
        off, linear = self.off * screen.scale, self.linear_off * screen.scale
        return [*model.bends, f"with it {off:.3g} {screen.unit} off where it was not fitted, without it {linear:.3g}"]


def bent_arm(plain: PlainArm, arm: Arm, free: Collection[str]) -> Bent | None:
    """The least-squares arm with what pays of play, a fastest speed and a sag; None for a linear axis.

    What is known of it and not ``free`` stays as ``arm``; dead time and lag are free.
    """
    search = _Search(plain, arm, free)
    if min(half.count for half in search.halves) < _FEWEST:
        return None
    chosen: list[str] = []
    squares: list[FloatArray] = []  # that are left without a bend, with one, with two, …
    for kinds in _KINDS:
        while tried := {kind: search.off(_beside(chosen, kind)) for kind in kinds if search.seems(kind, chosen)}:
            squares = squares or [search.off([])]
            paying = {kind: left for kind, left in tried.items() if _pays(kind, left, squares[-1])}
            best = min(paying, key=lambda kind: float(tried[kind].sum()), default=None)
            if best is None:
                break
            left = search.measured.left(search.whole(_beside(chosen, best)))
            if squares[-1].sum() - tried[best].sum() < FOLLOWS / independent(left) * tried[best].sum():
                break  # an error that goes on for long is alike in both halves, and by chance like play
            chosen = _beside(chosen, best)
            squares.append(tried[best])
    if not chosen:
        return None
    linear, bent = (float(np.sqrt(mean_squares.mean())) for mean_squares in (squares[0], squares[-1]))
    return Bent(search.whole(chosen), bent, linear, search.sag_half(chosen))


def _pays(kind: str, left: FloatArray, before: FloatArray) -> bool:
    """Whether the squares that are left in both halves, (2,), fell enough."""
    share = _KNEED if kind in _SAGS else _PAYS
    return bool(left.sum() < share * before.sum() and np.all(left < _SEEMS * before))


def _beside(chosen: Sequence[str], kind: str) -> list[str]:
    """One bend more; of sags there is one."""
    return [*(bend for bend in chosen if bend not in _SAGS or kind not in _SAGS), kind]


class _Search:
    """Arms of least squares with and without bends, of all of the motion and of its halves."""

    def __init__(self, plain: PlainArm, arm: Arm, free: Collection[str]) -> None:
        self.measured, self._names = _looked_at(plain), [name for name in _ANY if name in free]
        commanded = np.concatenate([recording.command for recording in self.measured.recordings])
        self._low, self._high = float(commanded.min()), float(commanded.max())
        self._middle = 0.5 * (self._low + self._high)
        sag = {name: (self._low, self._high) if name.startswith("knee") else BEYOND for name in SAG}
        self._limits = Limits({**_ANY, **BENDS, **sag}, {})
        self._noise = self.measured.white(plain.arm)
        self._start = arm._replace(delay=plain.arm.delay, lag=plain.arm.lag, play=0.0, max_speed=0.0)
        if "gain" in free:
            self._start = self._start._replace(gain=plain.arm.gain, recovery=0.0, slope=0.0)
        self._wholes: dict[tuple[str, ...], Arm] = {}
        self._starts: dict[str, dict[str, float]] = {}
        self._free = free
        self.halves = _halves(self.measured)
        first, parts = self.halves[0].recordings, self.measured.recordings
        counts = [half.weight[part.weight > 0.0] > 0.0 for half, part in zip(first, parts, strict=True)]
        self._rows = np.concatenate(counts)  # of the first half, among those that count

    def seems(self, kind: str, chosen: Sequence[str]) -> bool:
        """Whether a bend that is free leaves less of all of the motion; fits begin from the best of a rough grid."""
        is_sag = kind in _SAGS
        if kind in chosen or (is_sag and self.measured.sags) or ("sag" if is_sag else kind) not in self._free:
            return False
        beside = _beside(chosen, kind)
        arm = self.whole(beside[:-1])
        start = self._knees(arm, 1 if kind == "sag" else 2) if is_sag else self._size(kind, arm)
        if not start:
            return False
        self._starts[kind] = start
        bent, square = self.whole(beside), self.measured.squares(self.whole(chosen))
        slopes = bent.beyond, bent.below
        most = BEYOND[1] if kind == "sag" else 0.0  # a stop holds an axis off
        if is_sag and (max(map(abs, slopes)) < _SLIGHT or max(slopes) >= most):
            return False
        return self.measured.squares(bent) < _SEEMS * square

    def _size(self, kind: str, arm: Arm) -> dict[str, float]:
        """The likeliest play or fastest speed on a rough grid; none where all that may be is too small."""
        sd, fastest = float(np.std(self.measured.left(arm))), _fastest(self.measured, arm)
        sizes = [sd * width for width in _WIDTHS] if kind == "play" else [fastest * share for share in _SPEEDS]
        if min(sizes) <= BENDS[kind][0]:
            return {}
        shares = product((arm.lag * _SOONER[1:]).tolist(), sizes, (arm.delay * _SOONER).tolist())
        arms = [arm._replace(delay=delay, lag=lag, **{kind: size}) for lag, size, delay in shares]
        log, _ = self.measured.weighed(arms, self._noise, self._limits)
        return {kind: getattr(arms[int(np.argmax(log))], kind)}

    def _knees(self, arm: Arm, count: int) -> dict[str, float]:
        """The line with so many knees that explains most of what an arm leaves; none where that is little.

        One of its pieces is the gain: the middle one, or of two that whose gain is nearer to 1.
        """
        level, left = _levels(self.measured, arm), self.measured.left(arm)
        knees = _best_knees(level, left, count, self._middle)
        columns = np.column_stack([np.ones(len(level)), level, *(np.maximum(level - knee, 0.0) for knee in knees)])
        if not knees or not self._predicts(columns, left):
            return {}
        line: list[float] = np.linalg.lstsq(columns, left, rcond=None)[0].tolist()
        gains = [arm.gain * max(1.0 + slope, 1e-3) for slope in np.cumsum(line[1:]).tolist()]
        middle = 1 if count == 2 or abs(math.log(gains[1])) < abs(math.log(gains[0])) else 0
        gain, start = gains[middle] if "gain" in self._names else arm.gain, self.measured.recordings[0].start
        made = {"gain": gain} if "gain" in self._names else {}
        for number, knee in enumerate(knees):
            at, slope, piece = (*SAG[2:], number) if number < middle else (*SAG[:2], number + 1)
            made[at] = start + (knee - start) * gain / arm.gain
            made[slope] = min(max(gains[piece] / gains[middle] - 1.0, BEYOND[0]), BEYOND[1])
        return made

    def _predicts(self, columns: FloatArray, left: FloatArray) -> bool:
        """Whether columns (n, c) explain much more than a straight line of the half to which they were not fitted."""

        def apart(some: FloatArray, here: BoolArray) -> float:
            line = np.linalg.lstsq(some[here], left[here], rcond=None)[0]
            return float(np.sum((left[~here] - some[~here] @ line) ** 2))

        return all(apart(columns, here) < _KNEED * apart(columns[:, :2], here) for here in (self._rows, ~self._rows))

    def whole(self, kinds: Sequence[str]) -> Arm:
        """The arm of least squares with these bends of all of the motion, of first or second order."""
        if (key := tuple(kinds)) not in self._wholes:
            start = self._start._replace(**{name: size for kind in kinds for name, size in self._starts[kind].items()})
            fits = [self._fitted(self.measured, start._replace(damping=0.0), kinds)]
            first = fits[0].arm
            for earlier in _EARLIER if "damping" in self._names else ():  # dead time and plant make up for each other
                by = earlier * first.delay
                second = first._replace(delay=first.delay - by, lag=first.lag + by, damping=1.0)
                fits.append(self._fitted(self.measured, second, kinds))
            self._wholes[key] = max(fits, key=lambda fit: fit.log_posterior).arm
        return self._wholes[key]

    def sag_half(self, kinds: Sequence[str]) -> dict[str, float]:
        """Half the 95 % interval of each number of the sag of the whole arm."""
        arm = self.whole(kinds)
        (names, limits), noise = self._coordinates(arm, kinds), self.measured.white(arm)
        return {
            _SLOPES.get(name, name): self.measured.half_width(
                arm, names, noise, limits, partial(Arm.coordinate, name=name)
            )
            for name in SAG
            if name in names
        }

    def off(self, kinds: Sequence[str]) -> FloatArray:
        """The mean square [m²] that each half leaves of an arm that was fitted to the other, (2,)."""
        first, second = self.halves
        pairs = (first, second), (second, first)
        fitted = [(self._fitted(here, self.whole(kinds), kinds).arm, that) for here, that in pairs]
        return np.array([that.squares(arm) / that.count for arm, that in fitted])

    def _fitted(self, measured: Measured, near: Arm, kinds: Sequence[str]) -> Fit:
        """The arm of least squares with these bends near one of the same order."""
        names, limits = self._coordinates(near, kinds)
        return measured.fitted(near, names, self._noise, limits)

    def _coordinates(self, arm: Arm, kinds: Sequence[str]) -> tuple[list[str], Limits]:
        """What is free of an arm of its order with these bends, and within which limits."""
        bends = [name for kind in kinds for name in self._starts[kind] if name != "gain"]
        limits, names = self._limits, [name for name in self._names if name != "damping" or arm.damping]
        if "stops" in kinds:  # between them is the middle of what is commanded
            sides = {"knee": (self._middle, self._high), "knee_below": (self._low, self._middle)}
            limits = limits._replace(bounds={**limits.bounds, **sides})
        return [*names, *bends], limits


def _best_knees(level: FloatArray, left: FloatArray, count: int, middle: float) -> list[float]:
    """The knees of the line over levels that explains most of what is left, two on both sides of a level; or none."""
    places: list[float] = np.quantile(level, _KNEES).tolist()
    pairs = combinations(range(len(places)), count)
    every = np.array(
        [pair for pair in pairs if count == 1 or places[pair[0]] <= middle < places[pair[1]]], dtype=np.intp
    )
    if not len(every):
        return []
    straight = np.linalg.qr(np.column_stack([np.ones(len(level)), level]))[0]
    bent = np.column_stack([np.maximum(level - knee, 0.0) for knee in places])
    residual, bent = left - straight @ (straight.T @ left), bent - straight @ (straight.T @ bent)
    products, with_residual = bent.T @ bent, (bent.T @ residual)[every]
    products += 1e-12 * np.diag(products).max() * np.eye(len(places))
    shares = np.asarray(
        np.linalg.solve(products[every[:, :, None], every[:, None, :]], with_residual[:, :, None]), dtype=np.float64
    )
    explained = np.einsum("ij,ij->i", shares[:, :, 0], with_residual)
    return [places[number] for number in every[int(np.argmax(explained))].tolist()]


def _looked_at(plain: PlainArm) -> Measured:
    """What least squares look at, with what is far from a linear arm for many rows: it may be where a load holds it."""
    parts = list[Recording]()
    for recording, near in zip(plain.whole.recordings, plain.measured.recordings, strict=True):
        far = (recording.weight > 0.0) & (near.weight == 0.0)
        parts.append(recording._replace(weight=np.where(lonely(far), 0.0, recording.weight)))
    counted = plain.whole.of(parts)
    return counted if counted.count > _MANY * plain.measured.count else plain.measured


def _fastest(measured: Measured, arm: Arm) -> float:
    """The speed that an arm hardly ever exceeds between two measurements [m/s]."""
    parts = [
        np.abs(np.diff(moved)) / np.maximum(np.diff(recording.time), 1) * 1e9
        for moved, recording in zip(measured.responses(arm), measured.recordings, strict=True)
    ]
    return float(np.quantile(np.concatenate(parts), _FASTEST))


def _levels(measured: Measured, arm: Arm) -> FloatArray:
    """Where an arm without a sag is, as logged, at the measurements that count [m]."""
    parts = zip(measured.recordings, measured.responses(arm), strict=True)
    return np.concatenate([(recording.start + moved)[recording.weight > 0.0] for recording, moved in parts])


def _halves(measured: Measured) -> tuple[Measured, Measured]:
    """The measurements of every second part of the time, and the others."""

    def half(recording: Recording, which: int) -> Recording:
        since = recording.time - recording.time[:1]
        part = since * _PARTS // (since[-1:] + 1)
        return recording._replace(weight=np.where(part % 2 == which, recording.weight, 0.0))

    first, second = (measured.of([half(recording, which) for recording in measured.recordings]) for which in (0, 1))
    return first, second

"""Kernels of the tight path: see :mod:`pumafuse.fusion.ticks`.

A model is a row of numbers: Φ (4), Γ0 (2), Γ1 (2), Q11, Q12, Q22, the offset's variance a tick, R.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math

from ..arrays import FloatArray
from ..compiled import compiled
from .kernels import joseph_three

NUMBERS = 13
LANES = 16  # runs side by side: two vectors of the widest instructions, so that one hides the other's latency
TILE = 8  # steps in a line of memory; and whose S are multiplied before a logarithm is taken: 1e-38 to 1e38 m² fit
_MODEL = 13  # quantities of a lane before the numbers of its model
_TILE = _MODEL + NUMBERS  # … and before its tile
ROOM = LANES * (_TILE + 6 * TILE)
_LOG_2PI = math.log(2.0 * math.pi)


@compiled
def filter_one(
    model: FloatArray,
    prior: float | None,
    delay: int,
    command: FloatArray,
    measurements: FloatArray,
    likelihood: FloatArray,
    position: FloatArray,
    position_sd: FloatArray,
    innovation: FloatArray,
    innovation_sd: FloatArray,
    before: FloatArray,
) -> None:
    """One run, everything in registers.

    ``prior`` is the offset's variance at the start; None: there is no offset, and the kernel is compiled without one.
    Outputs are (1, steps); with no columns they are not wanted. ``before`` (steps, 4) gets the predicted position and
    P Hᵀ of each step for the smoother, which then fills the first two outputs; with no rows it is not wanted.
    """
    f11, f12, f21, f22, g01, g02, g11, g12 = (
        model[0], model[1], model[2], model[3], model[4], model[5], model[6], model[7]
    )  # fmt: skip
    q11, q12, q22, qo, R = model[8], model[9], model[10], model[11], model[12]
    x, rate, offset, recent, earlier = 0.0, 0.0, 0.0, 0.0, 0.0
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 if prior is None else prior
    product, total, since, wanted = 1.0, 0.0, 0, position.shape[1] > 0
    for n in range(len(measurements)):
        if prior is None:
            h0, h1, h2, mean = a, b, 0.0, x
            S = a + R
        else:
            h0, h1, h2, mean = a + d, b + e, d + f, x + offset
            S = h0 + h2 + R
        nu = measurements[n] - mean if abs(measurements[n]) < math.inf else math.nan
        there, weight = nu == nu, 1.0 / S
        told, kept = (nu * weight, R * weight) if there else (0.0, 1.0)
        if there:
            product *= S
            total += nu * told + _LOG_2PI
            since += 1
            if since == TILE:
                total += math.log(product)
                product, since = 1.0, 0
        if wanted:
            innovation[0, n], innovation_sd[0, n] = nu, math.sqrt(S)
        if len(before):
            before[n, 0], before[n, 1], before[n, 2], before[n, 3] = mean, h0, h1, h2
        elif wanted:  # H P Hᵀ after the measurement is as written: a + 2 d + f would cancel
            position[0, n], position_sd[0, n] = mean + (h0 + h2) * told, math.sqrt((h0 + h2) * kept)
        earlier, recent = recent, command[n - delay] if n >= delay else 0.0
        x, rate = (
            f11 * x + f12 * rate + g01 * recent + g11 * earlier + (f11 * h0 + f12 * h1) * told,
            f21 * x + f22 * rate + g02 * recent + g12 * earlier + (f21 * h0 + f22 * h1) * told,
        )
        if prior is None:
            # Φ P Φᵀ + Q with P = [a R, b R; b R, c S − b²] / S: one product alone waits for the division
            over, noise, square = (weight, R, b * b) if there else (1.0, 1.0, 0.0)
            a, b, c = (
                f12 * f12 * c + q11 + (f11 * (f11 * a + 2.0 * f12 * b) * noise - f12 * f12 * square) * over,
                f12 * f22 * c
                + q12
                + ((f11 * f21 * a + (f11 * f22 + f12 * f21) * b) * noise - f12 * f22 * square) * over,
                f22 * f22 * c + q22 + (f21 * (f21 * a + 2.0 * f22 * b) * noise - f22 * f22 * square) * over,
            )
        else:
            if there:
                offset += h2 * told
                a, b, c, d, e, f = joseph_three(a, b, c, d, e, f, 1.0, 0.0, 1.0, R, S)
            u, w = f11 * a + f12 * b, f11 * b + f12 * c
            y, z = f21 * a + f22 * b, f21 * b + f22 * c
            a, b, c = u * f11 + w * f12 + q11, u * f21 + w * f22 + q12, y * f21 + z * f22 + q22
            d, e, f = f11 * d + f12 * e, f21 * d + f22 * e, f + qo
    likelihood[0] = -0.5 * (total + math.log(product))


@compiled
def smooth_one(
    model: FloatArray,
    prior: float | None,
    innovation: FloatArray,
    before: FloatArray,
    position: FloatArray,
    position_sd: FloatArray,
) -> None:
    """Modified Bryson-Frazier, backward: λ and Λ say what later innovations ask of the prediction at each step.

    Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18(1), 1973. It inverts nothing;
    each estimate is corrected after its own measurement, where a wide prior is gone.
    """
    f11, f12, f21, f22, R = model[0], model[1], model[2], model[3], model[12]
    l0, l1, l2 = 0.0, 0.0, 0.0
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(len(before) - 1, -1, -1):
        h0, h1, h2 = before[n, 1], before[n, 2], 0.0 if prior is None else before[n, 3]
        weight = 1.0 / (h0 + h2 + R)
        if abs(innovation[0, n]) < math.inf:
            told, kept = innovation[0, n] * weight, R * weight  # P Hᵀ after the measurement is P Hᵀ R / S
        else:
            told, kept, weight = 0.0, 1.0, 0.0
        g0, g1, g2 = h0 * kept, h1 * kept, h2 * kept
        mean = before[n, 0] + (h0 + h2) * told - (g0 * l0 + g1 * l1)
        spread = (h0 + h2) * kept - (g0 * (a * g0 + b * g1) + g1 * (b * g0 + c * g1))
        if prior is not None:
            mean -= g2 * l2
            spread -= g2 * (2.0 * (d * g0 + e * g1) + f * g2)
        position[0, n], position_sd[0, n] = mean, math.sqrt(max(spread, 0.0))
        # Λ ← Aᵀ Λ A + (H F)ᵀ H F / S with A = (I − K H) F, whose 1 − K are written as what is left of S
        k0, k1, k2 = h0 * weight, h1 * weight, h2 * weight
        m0 = kept if prior is None else kept + k2
        A00, A01, A10, A11 = m0 * f11, m0 * f12, f21 - k1 * f11, f22 - k1 * f12
        u0, u1, w0, w1 = a * A00 + b * A10, b * A00 + c * A10, a * A01 + b * A11, b * A01 + c * A11
        if prior is None:
            l0, l1 = A00 * l0 + A10 * l1 - f11 * told, A01 * l0 + A11 * l1 - f12 * told
            a, b, c = A00 * u0 + A10 * u1, A00 * w0 + A10 * w1, A01 * w0 + A11 * w1
        else:
            A20, A21, m2 = -k2 * f11, -k2 * f12, kept + k0
            l0, l1, l2 = (
                A00 * l0 + A10 * l1 + A20 * l2 - f11 * told,
                A01 * l0 + A11 * l1 + A21 * l2 - f12 * told,
                m2 * l2 - k0 * l0 - k1 * l1 - told,
            )
            u0, u1, u2 = u0 + d * A20, u1 + e * A20, d * A00 + e * A10 + f * A20
            w0, w1, w2 = w0 + d * A21, w1 + e * A21, d * A01 + e * A11 + f * A21
            y0, y1, y2 = d * m2 - a * k0 - b * k1, e * m2 - b * k0 - c * k1, f * m2 - d * k0 - e * k1
            a, b, c = A00 * u0 + A10 * u1 + A20 * u2, A00 * w0 + A10 * w1 + A20 * w2, A01 * w0 + A11 * w1 + A21 * w2
            d, e = A00 * y0 + A10 * y1 + A20 * y2 + f11 * weight, A01 * y0 + A11 * y1 + A21 * y2 + f12 * weight
            f = m2 * y2 - k0 * y0 - k1 * y1 + weight
        a, b, c = a + f11 * f11 * weight, b + f11 * f12 * weight, c + f12 * f12 * weight


@compiled
def filter_many(
    models: FloatArray,
    prior: float | None,
    delay: int,
    command: FloatArray,
    measurements: FloatArray,
    likelihood: FloatArray,
    position: FloatArray,
    position_sd: FloatArray,
    innovation: FloatArray,
    innovation_sd: FloatArray,
    first: int,
    end: int,
    room: FloatArray,
) -> None:
    """Runs ``first`` to ``end``, LANES at a time; outputs of no columns are not wanted, ``prior`` as for one.

    ``command`` and ``measurements`` have a row for each run, or one for all. ``room`` holds what each lane is at, one
    quantity after the other: x, rate, offset, P (a b c d e f), v[n−d], Σ ν²/S + ln 2π, Π S, Σ ln Π S; then its model;
    then a tile of TILE steps of measurements, commands and the four outputs, so that memory is met in whole lines.
    """
    steps, wanted = measurements.shape[1], position.shape[1] > 0
    for block in range(first, end, LANES):
        for lane in range(LANES):
            run = min(block + lane, end - 1)
            for k in range(_MODEL):
                room[k * LANES + lane] = 0.0
            room[8 * LANES + lane] = 0.0 if prior is None else prior
            room[11 * LANES + lane] = 1.0
            for k in range(NUMBERS):
                room[(_MODEL + k) * LANES + lane] = models[run, k]
        for start in range(0, steps, TILE):
            length = min(TILE, steps - start)
            for lane in range(LANES):
                run = min(block + lane, end - 1)
                heard, told = min(run, measurements.shape[0] - 1), min(run, command.shape[0] - 1)
                for k in range(length):
                    n = start + k
                    room[(_TILE + k) * LANES + lane] = measurements[heard, n]
                    room[(_TILE + TILE + k) * LANES + lane] = command[told, n - delay] if n >= delay else 0.0
            for k in range(length):
                step = k & (TILE - 1)  # k itself, but seen not to be negative, without which no loop is a vector's
                update_lanes(room, step, prior)
                predict_lanes(room, step, prior)
            for lane in range(LANES):
                room[12 * LANES + lane] += math.log(room[11 * LANES + lane])
                room[11 * LANES + lane] = 1.0
            if wanted:
                for lane in range(min(LANES, end - block)):
                    for k in range(length):
                        n = start + k
                        position[block + lane, n] = room[(_TILE + 2 * TILE + k) * LANES + lane]
                        position_sd[block + lane, n] = room[(_TILE + 3 * TILE + k) * LANES + lane]
                        innovation[block + lane, n] = room[(_TILE + 4 * TILE + k) * LANES + lane]
                        innovation_sd[block + lane, n] = room[(_TILE + 5 * TILE + k) * LANES + lane]
        for lane in range(min(LANES, end - block)):
            likelihood[block + lane] = -0.5 * (room[10 * LANES + lane] + room[12 * LANES + lane])


@compiled
def update_lanes(room: FloatArray, k: int, prior: float | None) -> None:
    """Meet step ``k`` of the tile in all lanes."""
    for lane in range(LANES):
        x, rate, offset = room[lane], room[LANES + lane], room[2 * LANES + lane]
        a, b, c = room[3 * LANES + lane], room[4 * LANES + lane], room[5 * LANES + lane]
        d, e, f = room[6 * LANES + lane], room[7 * LANES + lane], room[8 * LANES + lane]
        R = room[(_MODEL + 12) * LANES + lane]
        S = a + R if prior is None else (a + d) + (d + f) + R
        nu = room[(_TILE + k) * LANES + lane] - (x if prior is None else x + offset)
        there = abs(nu) < math.inf
        nu = nu if there else math.nan
        weight = 1.0 / S if there else 0.0
        kept = R * weight if there else 1.0  # 1 − K
        told = nu * weight if there else 0.0
        if prior is None:
            mean, spread = x + a * told, a * kept
            room[lane] = mean
            room[LANES + lane] = rate + b * told
            room[3 * LANES + lane] = spread
            room[4 * LANES + lane] = b * kept
            room[5 * LANES + lane] = c - b * b * weight
        else:
            spread = ((a + d) + (d + f)) * kept
            x, offset = x + (a + d) * told, offset + (d + f) * told
            room[lane] = x
            room[LANES + lane] = rate + (b + e) * told
            room[2 * LANES + lane] = offset
            a, b, c, d, e, f = joseph_three(a, b, c, d, e, f, 1.0, 0.0, 1.0, R, S if there else math.inf)
            room[3 * LANES + lane] = a
            room[4 * LANES + lane] = b
            room[5 * LANES + lane] = c
            room[6 * LANES + lane] = d
            room[7 * LANES + lane] = e
            room[8 * LANES + lane] = f
            mean = x + offset
        room[10 * LANES + lane] += nu * told + _LOG_2PI if there else 0.0
        room[11 * LANES + lane] *= S if there else 1.0
        room[(_TILE + 2 * TILE + k) * LANES + lane] = mean
        room[(_TILE + 3 * TILE + k) * LANES + lane] = math.sqrt(spread)
        room[(_TILE + 4 * TILE + k) * LANES + lane] = nu
        room[(_TILE + 5 * TILE + k) * LANES + lane] = math.sqrt(S)


@compiled
def predict_lanes(room: FloatArray, k: int, prior: float | None) -> None:
    """Bring all lanes from step ``k`` of the tile to the next tick."""
    for lane in range(LANES):
        f11, f12 = room[_MODEL * LANES + lane], room[(_MODEL + 1) * LANES + lane]
        f21, f22 = room[(_MODEL + 2) * LANES + lane], room[(_MODEL + 3) * LANES + lane]
        g01, g02 = room[(_MODEL + 4) * LANES + lane], room[(_MODEL + 5) * LANES + lane]
        g11, g12 = room[(_MODEL + 6) * LANES + lane], room[(_MODEL + 7) * LANES + lane]
        recent, earlier = room[(_TILE + TILE + k) * LANES + lane], room[9 * LANES + lane]
        room[9 * LANES + lane] = recent
        x, rate = room[lane], room[LANES + lane]
        a, b, c = room[3 * LANES + lane], room[4 * LANES + lane], room[5 * LANES + lane]
        u, w = f11 * a + f12 * b, f11 * b + f12 * c
        y, z = f21 * a + f22 * b, f21 * b + f22 * c
        room[lane] = f11 * x + f12 * rate + g01 * recent + g11 * earlier
        room[LANES + lane] = f21 * x + f22 * rate + g02 * recent + g12 * earlier
        room[3 * LANES + lane] = u * f11 + w * f12 + room[(_MODEL + 8) * LANES + lane]
        room[4 * LANES + lane] = u * f21 + w * f22 + room[(_MODEL + 9) * LANES + lane]
        room[5 * LANES + lane] = y * f21 + z * f22 + room[(_MODEL + 10) * LANES + lane]
        if prior is not None:
            d, e = room[6 * LANES + lane], room[7 * LANES + lane]
            room[6 * LANES + lane] = f11 * d + f12 * e
            room[7 * LANES + lane] = f21 * d + f22 * e
            room[8 * LANES + lane] += room[(_MODEL + 11) * LANES + lane]

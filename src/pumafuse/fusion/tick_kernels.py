"""Kernels of the tight path: see :mod:`pumafuse.fusion.ticks`.

A model is a row of numbers: Φ (4), Γ0 (2), Γ1 (2), Q11, Q12, Q22, the offset's variance a tick, R.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math

from ..arrays import FloatArray
from ..compiled import compiled

NUMBERS = 13
LANES = 16  # runs side by side: two vectors of the widest instructions, so that one hides the other's latency
TILE = 8  # steps in a line of memory; and whose S are multiplied before a logarithm is taken: 1e-38 to 1e38 m² fit
_MODEL = 13  # quantities of a lane before the numbers of its model
_TILE = _MODEL + NUMBERS  # … and before its tile
ROOM = LANES * (_TILE + 6 * TILE)
_LOG_2PI = math.log(2.0 * math.pi)


@compiled
def joseph_three(
    a: float, b: float, c: float, d: float, e: float, f: float, R: float, weight: float
) -> tuple[float, float, float, float, float, float]:
    """(I − K H) P (I − K H)ᵀ + K R Kᵀ with H = (1, 0, 1) and P = [a b d; b c e; d e f].

    ``weight`` is 1/S, or 0 where there is no reading.
    """
    h0, h1, h2 = a + d, b + e, d + f
    k0, k1, k2 = h0 * weight, h1 * weight, h2 * weight
    w00, w01, w02 = a - k0 * h0, b - k0 * h1, d - k0 * h2
    w10, w11, w12 = b - k1 * h0, c - k1 * h1, e - k1 * h2
    w20, w21, w22 = d - k2 * h0, e - k2 * h1, f - k2 * h2
    r0, r1, r2 = w00 + w02 - R * k0, w10 + w12 - R * k1, w20 + w22 - R * k2
    return (
        w00 - r0 * k0,
        0.5 * (w01 - r0 * k1 + w10 - r1 * k0),
        w11 - r1 * k1,
        0.5 * (w02 - r0 * k2 + w20 - r2 * k0),
        0.5 * (w12 - r1 * k2 + w21 - r2 * k1),
        w22 - r2 * k2,
    )


@compiled
def filter_one(
    model: FloatArray,
    prior: float | None,
    delay: int,
    command: FloatArray,
    readings: FloatArray,
    likelihood: FloatArray,
    position: FloatArray,
    position_sd: FloatArray,
    innovation: FloatArray,
    innovation_sd: FloatArray,
    before: FloatArray,
) -> None:
    """One run, everything in registers.

    ``prior`` is the offset's variance at the start; None: there is no offset, and the kernel is compiled without one.
    Outputs are (1, steps), and ``before`` (steps, 4) gets the predicted position and P Hᵀ of each step for the
    smoother; with no columns or rows they are not wanted.
    """
    f11, f12, f21, f22, g01, g02, g11, g12 = (
        model[0], model[1], model[2], model[3], model[4], model[5], model[6], model[7]
    )  # fmt: skip
    q11, q12, q22, qo, R = model[8], model[9], model[10], model[11], model[12]
    x, rate, offset, recent, earlier = 0.0, 0.0, 0.0, 0.0, 0.0
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 if prior is None else prior
    product, total, since, wanted = 1.0, 0.0, 0, position.shape[1] > 0
    for n in range(len(readings)):
        if prior is None:
            h0, h1, h2, mean = a, b, 0.0, x
            S = a + R
        else:
            h0, h1, h2, mean = a + d, b + e, d + f, x + offset
            S = h0 + h2 + R
        nu = readings[n] - mean if abs(readings[n]) < math.inf else math.nan
        if wanted:
            innovation[0, n], innovation_sd[0, n] = nu, math.sqrt(S)
        if len(before):
            before[n, 0], before[n, 1], before[n, 2], before[n, 3] = mean, h0, h1, h2
        if nu == nu:
            weight = 1.0 / S
            x += h0 * weight * nu
            rate += h1 * weight * nu
            if prior is None:
                kept = R * weight  # 1 − K
                a, b, c = a * kept, b * kept, c - b * b * weight
            else:
                offset += h2 * weight * nu
                a, b, c, d, e, f = joseph_three(a, b, c, d, e, f, R, weight)
            product *= S
            total += nu * nu * weight + _LOG_2PI
            since += 1
            if since == TILE:
                total += math.log(product)
                product, since = 1.0, 0
        if wanted:
            if prior is None:
                position[0, n], position_sd[0, n] = x, math.sqrt(a)
            else:
                spread = (h0 + h2) * (R / S if nu == nu else 1.0)  # H P Hᵀ after the reading: a + 2 d + f would cancel
                position[0, n], position_sd[0, n] = x + offset, math.sqrt(spread)
        earlier, recent = recent, command[n - delay] if n >= delay else 0.0
        x, rate = (
            f11 * x + f12 * rate + g01 * recent + g11 * earlier,
            f21 * x + f22 * rate + g02 * recent + g12 * earlier,
        )
        u, w = f11 * a + f12 * b, f11 * b + f12 * c
        y, z = f21 * a + f22 * b, f21 * b + f22 * c
        a, b, c = u * f11 + w * f12 + q11, u * f21 + w * f22 + q12, y * f21 + z * f22 + q22
        if prior is not None:
            d, e = f11 * d + f12 * e, f21 * d + f22 * e
            f += qo
    likelihood[0] = -0.5 * (total + math.log(product))


@compiled
def smooth_one(
    model: FloatArray, innovation: FloatArray, before: FloatArray, position: FloatArray, position_sd: FloatArray
) -> None:
    """Modified Bryson-Frazier, backward: λ and Λ say what later innovations ask of the prediction at each step.

    Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18(1), 1973. It inverts nothing;
    each estimate is corrected after its own reading, where a wide prior is gone.
    """
    f11, f12, f21, f22, R = model[0], model[1], model[2], model[3], model[12]
    l0, l1, l2 = 0.0, 0.0, 0.0
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(len(before) - 1, -1, -1):
        h0, h1, h2 = before[n, 1], before[n, 2], before[n, 3]
        nu, weight = innovation[0, n], 1.0 / (h0 + h2 + R)
        there = abs(nu) < math.inf
        kept = R * weight if there else 1.0  # P Hᵀ after the reading is P Hᵀ R / S
        g0, g1, g2 = h0 * kept, h1 * kept, h2 * kept
        told = g0 * (a * g0 + b * g1 + d * g2) + g1 * (b * g0 + c * g1 + e * g2) + g2 * (d * g0 + e * g1 + f * g2)
        position_sd[0, n] = math.sqrt(max((h0 + h2) * kept - told, 0.0))
        position[0, n] = before[n, 0] - (g0 * l0 + g1 * l1 + g2 * l2)
        if there:
            position[0, n] += (h0 + h2) * weight * nu
            # Λ ← Mᵀ Λ M + Hᵀ H / S with M = I − K H, whose 1 − K are written as what is left of S
            k0, k1, k2 = h0 * weight, h1 * weight, h2 * weight
            m0, m2 = (h2 + R) * weight, (h0 + R) * weight
            u0, u1, u2 = a * m0 - b * k1 - d * k2, b * m0 - c * k1 - e * k2, d * m0 - e * k1 - f * k2
            w0, w1, w2 = d * m2 - a * k0 - b * k1, e * m2 - b * k0 - c * k1, f * m2 - d * k0 - e * k1
            a = m0 * u0 - k1 * u1 - k2 * u2 + weight
            d = m0 * w0 - k1 * w1 - k2 * w2 + weight
            f = m2 * w2 - k0 * w0 - k1 * w1 + weight
            b, e = u1, w1
            l0, l2 = m0 * l0 - k1 * l1 - k2 * l2 - nu * weight, m2 * l2 - k0 * l0 - k1 * l1 - nu * weight
        l0, l1 = f11 * l0 + f21 * l1, f12 * l0 + f22 * l1
        u, w = f11 * a + f21 * b, f11 * b + f21 * c
        y, z = f12 * a + f22 * b, f12 * b + f22 * c
        a, b, c = u * f11 + w * f21, u * f12 + w * f22, y * f12 + z * f22
        d, e = f11 * d + f21 * e, f12 * d + f22 * e


@compiled
def filter_many(
    models: FloatArray,
    prior: float | None,
    delay: int,
    command: FloatArray,
    readings: FloatArray,
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

    ``command`` and ``readings`` have a row for each run, or one for all. ``room`` holds what each lane is at, one
    quantity after the other: x, rate, offset, P (a b c d e f), v[n−d], Σ ν²/S + ln 2π, Π S, Σ ln Π S; then its model;
    then a tile of TILE steps of readings, commands and the four outputs, so that memory is met in whole lines.
    """
    steps, wanted = readings.shape[1], position.shape[1] > 0
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
                heard, told = min(run, readings.shape[0] - 1), min(run, command.shape[0] - 1)
                for k in range(length):
                    n = start + k
                    room[(_TILE + k) * LANES + lane] = readings[heard, n]
                    room[(_TILE + TILE + k) * LANES + lane] = command[told, n - delay] if n >= delay else 0.0
            for k in range(length):
                update_lanes(room, k, prior)
                predict_lanes(room, k, prior)
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
            a, b, c, d, e, f = joseph_three(a, b, c, d, e, f, R, weight)
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

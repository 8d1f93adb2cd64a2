"""Kernels of the tight path: see :mod:`pumafuse.fusion.ticks`.

A model is a row of numbers: Φ (4), Γ0 (2), Γ1 (2), Q11, Q12, Q22, the offset's variance a tick, R, the offset's prior.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math

from ..arrays import FloatArray
from ..compiled import compiled

NUMBERS = 14
LANES = 16  # runs side by side: two vectors of the widest instructions, so that one hides the other's latency
ROOM = LANES * 32
_LOG_EVERY = 8  # steps whose S are multiplied before a logarithm is taken: S of 1e-38 to 1e38 m² fit
_LOG_2PI = math.log(2.0 * math.pi)


@compiled
def filter_one(
    model: FloatArray,
    delay: int,
    command: FloatArray,
    readings: FloatArray,
    likelihood: FloatArray,
    position: FloatArray,
    position_sd: FloatArray,
    velocity: FloatArray,
    velocity_sd: FloatArray,
    innovation: FloatArray,
    innovation_sd: FloatArray,
) -> None:
    """One run, everything in registers; outputs are (1, steps)."""
    f11, f12, f21, f22, g01, g02, g11, g12 = (
        model[0], model[1], model[2], model[3], model[4], model[5], model[6], model[7]
    )  # fmt: skip
    q11, q12, q22, qo, R = model[8], model[9], model[10], model[11], model[12]
    x, rate, offset, recent, before = 0.0, 0.0, 0.0, 0.0, 0.0
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, model[13]  # P: xx, x rate, rate rate, x o, rate o, o o
    product, total, since = 1.0, 0.0, 0
    for n in range(len(readings)):
        h0, h1, h2 = a + d, b + e, d + f
        S = h0 + h2 + R
        nu = readings[n] - x - offset
        innovation[0, n], innovation_sd[0, n] = nu, math.sqrt(S)
        if nu == nu:
            weight = 1.0 / S
            k0, k1, k2 = h0 * weight, h1 * weight, h2 * weight
            x += k0 * nu
            rate += k1 * nu
            offset += k2 * nu
            # W = (I − K H) P, then W − W Hᵀ Kᵀ + K R Kᵀ; only what is not symmetric is written twice
            w00, w01, w02 = a - k0 * h0, b - k0 * h1, d - k0 * h2
            w11, w12 = c - k1 * h1, e - k1 * h2
            w20, w21, w22 = d - k2 * h0, e - k2 * h1, f - k2 * h2
            w10 = b - k1 * h0
            r0, r1, r2 = w00 + w02 - R * k0, w10 + w12 - R * k1, w20 + w22 - R * k2
            a, b, d = w00 - r0 * k0, 0.5 * (w01 - r0 * k1 + w10 - r1 * k0), 0.5 * (w02 - r0 * k2 + w20 - r2 * k0)
            c, e, f = w11 - r1 * k1, 0.5 * (w12 - r1 * k2 + w21 - r2 * k1), w22 - r2 * k2
            product *= S
            total += nu * nu * weight + _LOG_2PI
            since += 1
            if since == _LOG_EVERY:
                total += math.log(product)
                product, since = 1.0, 0
        position[0, n] = x + offset
        position_sd[0, n] = math.sqrt(max(a + 2.0 * d + f, 0.0))
        velocity[0, n] = rate
        velocity_sd[0, n] = math.sqrt(max(c, 0.0))
        before, recent = recent, command[n - delay] if n >= delay else 0.0
        x, rate = f11 * x + f12 * rate + g01 * recent + g11 * before, f21 * x + f22 * rate + g02 * recent + g12 * before
        u, w = f11 * a + f12 * b, f11 * b + f12 * c
        y, z = f21 * a + f22 * b, f21 * b + f22 * c
        a, b, c = u * f11 + w * f12 + q11, u * f21 + w * f22 + q12, y * f21 + z * f22 + q22
        d, e = f11 * d + f12 * e, f21 * d + f22 * e
        f += qo
    likelihood[0] = -0.5 * (total + math.log(product))


@compiled
def filter_many(
    models: FloatArray,
    delay: int,
    command: FloatArray,
    readings: FloatArray,
    first: int,
    end: int,
    room: FloatArray,
    likelihood: FloatArray,
    position: FloatArray,
    position_sd: FloatArray,
    velocity: FloatArray,
    velocity_sd: FloatArray,
    innovation: FloatArray,
    innovation_sd: FloatArray,
) -> None:
    """Runs ``first`` to ``end``, LANES at a time; outputs of no columns are not wanted.

    ``command`` and ``readings`` have a row for each run, or one for all. ``room`` holds what each lane is at, one
    quantity after the other (the order of names below), and then the numbers of its model.
    """
    steps, wanted = readings.shape[1], position.shape[1] > 0
    for block in range(first, end, LANES):
        for lane in range(LANES):
            run = min(block + lane, end - 1)
            for k in range(15):
                room[k * LANES + lane] = 0.0
            room[8 * LANES + lane] = models[run, 13]
            room[13 * LANES + lane] = 1.0
            for k in range(NUMBERS - 1):
                room[(19 + k) * LANES + lane] = models[run, k]
        for n in range(steps):
            for lane in range(LANES):
                run = min(block + lane, end - 1)
                room[9 * LANES + lane] = readings[min(run, readings.shape[0] - 1), n]
                room[11 * LANES + lane] = room[10 * LANES + lane]
                recent = command[min(run, command.shape[0] - 1), n - delay] if n >= delay else 0.0
                room[10 * LANES + lane] = recent
            _update(room)
            if wanted:
                for lane in range(min(LANES, end - block)):
                    run = block + lane
                    position[run, n] = room[0 * LANES + lane] + room[2 * LANES + lane]
                    spread = room[3 * LANES + lane] + 2.0 * room[6 * LANES + lane] + room[8 * LANES + lane]
                    position_sd[run, n] = math.sqrt(max(spread, 0.0))
                    velocity[run, n] = room[1 * LANES + lane]
                    velocity_sd[run, n] = math.sqrt(max(room[5 * LANES + lane], 0.0))
                    innovation[run, n] = room[15 * LANES + lane]
                    innovation_sd[run, n] = math.sqrt(room[16 * LANES + lane])
            _predict(room)
            if n % _LOG_EVERY == _LOG_EVERY - 1 or n == steps - 1:
                for lane in range(LANES):
                    room[14 * LANES + lane] += math.log(room[13 * LANES + lane])
                    room[13 * LANES + lane] = 1.0
        for lane in range(min(LANES, end - block)):
            likelihood[block + lane] = -0.5 * (room[12 * LANES + lane] + room[14 * LANES + lane])


@compiled
def _update(room: FloatArray) -> None:
    """Meet the readings of all lanes: 0 x, 1 rate, 2 offset, 3 to 8 P, 9 z, 12 Σ ν²/S + ln 2π, 13 Π S, 15 ν, 16 S."""
    for lane in range(LANES):
        x, rate, offset = room[lane], room[LANES + lane], room[2 * LANES + lane]
        a, b, d = room[3 * LANES + lane], room[4 * LANES + lane], room[6 * LANES + lane]
        c, e, f = room[5 * LANES + lane], room[7 * LANES + lane], room[8 * LANES + lane]
        R = room[(19 + 12) * LANES + lane]
        h0, h1, h2 = a + d, b + e, d + f
        S = h0 + h2 + R
        nu = room[9 * LANES + lane] - x - offset
        there = nu == nu
        weight = 1.0 / S if there else 0.0
        told = nu if there else 0.0
        k0, k1, k2 = h0 * weight, h1 * weight, h2 * weight
        w00, w01, w02 = a - k0 * h0, b - k0 * h1, d - k0 * h2
        w10, w11, w12 = b - k1 * h0, c - k1 * h1, e - k1 * h2
        w20, w21, w22 = d - k2 * h0, e - k2 * h1, f - k2 * h2
        r0, r1, r2 = w00 + w02 - R * k0, w10 + w12 - R * k1, w20 + w22 - R * k2
        room[lane] = x + k0 * told
        room[LANES + lane] = rate + k1 * told
        room[2 * LANES + lane] = offset + k2 * told
        room[3 * LANES + lane] = w00 - r0 * k0
        room[4 * LANES + lane] = 0.5 * (w01 - r0 * k1 + w10 - r1 * k0)
        room[5 * LANES + lane] = w11 - r1 * k1
        room[6 * LANES + lane] = 0.5 * (w02 - r0 * k2 + w20 - r2 * k0)
        room[7 * LANES + lane] = 0.5 * (w12 - r1 * k2 + w21 - r2 * k1)
        room[8 * LANES + lane] = w22 - r2 * k2
        room[12 * LANES + lane] += told * told * weight + (_LOG_2PI if there else 0.0)
        room[13 * LANES + lane] *= S if there else 1.0
        room[15 * LANES + lane] = nu
        room[16 * LANES + lane] = S


@compiled
def _predict(room: FloatArray) -> None:
    """Bring all lanes to the next tick: 10 and 11 are v[n−d] and v[n−d−1], from 19 on the model."""
    for lane in range(LANES):
        f11, f12 = room[19 * LANES + lane], room[20 * LANES + lane]
        f21, f22 = room[21 * LANES + lane], room[22 * LANES + lane]
        recent, before = room[10 * LANES + lane], room[11 * LANES + lane]
        x, rate = room[lane], room[LANES + lane]
        a, b, c = room[3 * LANES + lane], room[4 * LANES + lane], room[5 * LANES + lane]
        d, e = room[6 * LANES + lane], room[7 * LANES + lane]
        g01, g02, g11, g12 = (
            room[23 * LANES + lane], room[24 * LANES + lane], room[25 * LANES + lane], room[26 * LANES + lane]
        )  # fmt: skip
        u, w = f11 * a + f12 * b, f11 * b + f12 * c
        y, z = f21 * a + f22 * b, f21 * b + f22 * c
        room[lane] = f11 * x + f12 * rate + g01 * recent + g11 * before
        room[LANES + lane] = f21 * x + f22 * rate + g02 * recent + g12 * before
        room[3 * LANES + lane] = u * f11 + w * f12 + room[27 * LANES + lane]
        room[4 * LANES + lane] = u * f21 + w * f22 + room[28 * LANES + lane]
        room[5 * LANES + lane] = y * f21 + z * f22 + room[29 * LANES + lane]
        room[6 * LANES + lane] = f11 * d + f12 * e
        room[7 * LANES + lane] = f21 * d + f22 * e
        room[8 * LANES + lane] += room[30 * LANES + lane]

"""Compiled functions of `railfix.integrity.protection`: the level that the tails of all hypotheses leave."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Codes, Floats, Indices
from railfix.kernels.compiling import kernel

#: Of `railfix.integrity.protection.tails`.
_STEPS, _ROUNDS, _CLOSE, _AIM = 4, 4, 1e-3, 0.002
_TINY = float(np.finfo(np.float64).tiny)
_ROOT_TWO_PI = math.sqrt(2.0 * math.pi)
#: Tails further out than this many sigmas are nothing beside the risk: 2e-20.
_FAR = 9.2
#: erfc(x) = exp(-x^2) P(x) / Q(x) from 0 to 8, within 2e-8 of itself (Cephes; made for 1 to 8, where it is exact).
_P = (
    2.46196981473530512524e-10, 5.64189564831068821977e-1, 7.46321056442269912687, 4.86371970985681366614e1,
    1.96520832956077098242e2, 5.26445194995477358631e2, 9.34528527171957607540e2, 1.02755188689515710272e3,
    5.57535335369399327526e2,
)  # fmt: skip
_Q = (
    1.0, 1.32281951154744992508e1, 8.67072140885989742329e1, 3.54937778887819891062e2, 9.75708501743205489753e2,
    1.82390916687909736289e3, 2.24633760818710981792e3, 1.65666309194161350182e3, 5.57535340817727675546e2,
)  # fmt: skip


@kernel
def lowered(
    above_m: Floats, offset_m: Floats, inverse: Floats, weight: Floats, bounds: Indices, allowed: Floats
) -> tuple[Floats, Codes]:
    """Lower levels as far as the risk allows, epoch by epoch."""
    epochs, kinds = len(above_m), len(bounds) - 1
    level, spender = above_m.copy(), np.zeros(epochs, dtype=np.int8)
    root_half = math.sqrt(0.5)
    for t in range(epochs):
        limit = allowed[t]
        if not (math.isfinite(above_m[t]) and limit > 0.0):
            continue
        aim, here, below = limit * (1.0 - _AIM), above_m[t], 0.0
        for _ in range(_ROUNDS):
            for _ in range(_STEPS):
                total, density, most, largest = 0.0, 0.0, 0, -1.0
                for k in range(kinds):
                    part = 0.0
                    for m in range(bounds[k], bounds[k + 1]):
                        w = weight[t, m]
                        z = (offset_m[t, m] - here) * inverse[t, m]
                        if w == 0.0 or z < -_FAR:
                            continue
                        bell = math.exp(-0.5 * z * z)
                        x = abs(z) * root_half
                        if x < 1.0:
                            tail = 0.5 * math.erfc(x)
                        elif x < 8.0:
                            p, q = _P[0], _Q[0]
                            for i in range(1, 9):
                                p, q = p * x + _P[i], q * x + _Q[i]
                            tail = 0.5 * bell * p / q
                        else:
                            tail = 0.0
                        if z > 0.0:
                            tail = 1.0 - tail
                        part += w * tail
                        density += w * inverse[t, m] * bell
                    total += part
                    if part > largest:
                        largest, most = part, k
                total = max(total, _TINY)
                density /= _ROOT_TWO_PI
                within = total <= limit
                if within and here <= level[t]:
                    level[t], spender[t] = here, most
                if not within:
                    below = max(below, here)
                here = here + math.log(total / aim) * total / max(density, _TINY)
                if not (here >= below and here <= level[t]):
                    here = (below + level[t]) / 2.0
            if not abs(here - level[t]) > _CLOSE * level[t]:
                break
    return level, spender

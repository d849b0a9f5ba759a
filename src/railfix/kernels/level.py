"""Protection level at which the Gaussian tails of all fault hypotheses sum to the allowed risk."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Codes, Floats, Indices
from railfix.kernels.compiling import inner, kernel

#: The iteration ends if the next step is at most this fraction of the level, which is then exact to 1e-6.
_CLOSE = 5e-4
#: Largest number of steps; without convergence, the lowest level found at which the tails are within the risk is used.
_STEPS = 60
#: From this step on, every second step bisects the bracket, because steps can alternate between two levels.
_HALVING = 8
#: Fraction of the risk that is not used.
_AIM = 0.002
#: Relative difference up to which required levels count as equal; of these, the first hypothesis is reported as worst.
_ALIKE = 1e-9
#: a and b: for x >= 0, the Mills ratio is ``1 / ((1 - a) x + a sqrt(x^2 + b))`` to 0.3 % (Borjesson, Sundberg 1979).
_MILLS = (0.339, 5.510)
_TINY = float(np.finfo(np.float64).tiny)
_ROOT_TWO_PI = math.sqrt(2.0 * math.pi)
_ROOT_HALF = math.sqrt(0.5)
#: erfc(x) = exp(-x^2) P(x) / Q(x) for x >= 0, with a relative error below 2e-8 (Cephes; designed for 1 <= x <= 8).
_P = (
    2.46196981473530512524e-10, 5.64189564831068821977e-1, 7.46321056442269912687, 4.86371970985681366614e1,
    1.96520832956077098242e2, 5.26445194995477358631e2, 9.34528527171957607540e2, 1.02755188689515710272e3,
    5.57535335369399327526e2,
)  # fmt: skip
_Q = (
    1.0, 1.32281951154744992508e1, 8.67072140885989742329e1, 3.54937778887819891062e2, 9.75708501743205489753e2,
    1.82390916687909736289e3, 2.24633760818710981792e3, 1.65666309194161350182e3, 5.57535340817727675546e2,
)  # fmt: skip
#: Constants of exp(x) = 2^k exp(r) with |r| <= ln 2 / 2: log2(e), ln 2 in two parts, and the constant that shifts k +
#: 1023 into the lowest bits.
_LOG2_E, _LN2_HIGH, _LN2_LOW = 1.4426950408889634, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_SHIFT = 6755399441055744.0 + 1023.0
_E = tuple(1.0 / math.factorial(k) for k in range(12))


@inner
def _mills(x: float) -> float:
    """Return the Mills ratio (Gaussian tail divided by density) at x >= 0."""
    y = x * _ROOT_HALF
    p = (((((((_P[0] * y + _P[1]) * y + _P[2]) * y + _P[3]) * y + _P[4]) * y + _P[5]) * y + _P[6]) * y + _P[7]) * y
    q = (((((((_Q[0] * y + _Q[1]) * y + _Q[2]) * y + _Q[3]) * y + _Q[4]) * y + _Q[5]) * y + _Q[6]) * y + _Q[7]) * y
    return 0.5 * _ROOT_TWO_PI * (p + _P[8]) / (q + _Q[8])


@inner
def _bells(z: Floats, bits: Indices, out: Floats) -> None:
    """Write exp(-z^2/2) into `out` by vectorised loops; `bits` is work space of the same length."""
    scratch = bits.view(np.float64)
    for m in range(len(z)):
        u = max(-0.5 * z[m] * z[m], -700.0)
        shifted = u * _LOG2_E + _SHIFT
        scratch[m] = shifted
        whole = shifted - _SHIFT
        r = (u - whole * _LN2_HIGH) - whole * _LN2_LOW
        value = ((((_E[11] * r + _E[10]) * r + _E[9]) * r + _E[8]) * r + _E[7]) * r + _E[6]
        out[m] = (((((value * r + _E[5]) * r + _E[4]) * r + _E[3]) * r + 0.5) * r + 1.0) * r + 1.0
    for m in range(len(z)):
        bits[m] = bits[m] << 52
    for m in range(len(z)):
        out[m] *= scratch[m]


@inner
def _quantile(probability: float) -> float:
    """Return the value that a standard normal variable exceeds with a given probability (`one_sided_k`)."""
    if probability >= 1.0:
        return -np.inf
    if not probability > 0.0:
        return np.inf
    small = min(probability, 1.0 - probability)
    if small >= 0.5:
        return 0.0
    aim, x = math.log(small), math.sqrt(-2.0 * math.log(small))
    for _ in range(8):
        mills = _mills(x)
        step = (math.log(mills / _ROOT_TWO_PI) - 0.5 * x * x - aim) * mills
        x += step
        if abs(step) < 1e-13 * x:
            break
    return x if probability < 0.5 else -x


class _Room(NamedTuple):
    """Work space of an epoch. With a value per hypothesis, shape (K,): inverse sigma, weight (0 if undetectable),
    required level, distance z to the level in sigmas, exp(-z^2/2) and tail. `of_kind` is the sum of tails per kind.
    """

    inverse: Floats
    checked: Floats
    required: Floats
    z: Floats
    bell: Floats
    bits: Indices
    tail: Floats
    of_kind: Floats


@kernel
def solve_level(
    offset_m: Floats, sigma_m: Floats, weight: Floats, bounds: Indices, share: Floats, reserved: Floats
) -> tuple[Floats, Codes, Floats, Floats, Indices]:
    """Find the level L at which the sum of ``weight Q((L - offset)/sigma)`` over all hypotheses is within the risk.

    The weights of undetectable faults are subtracted from the risk; detectable faults use the remaining risk. For each
    kind of hypothesis, the level is computed at which the kind uses its `share`. The largest of these levels is lowered
    until the sum of the tails reaches 0.998 of the remaining risk.

    Parameters
    ----------
    offset_m, sigma_m, weight : ndarray, shape (T, K)
        Hypotheses, grouped by kind; `sigma_m` is infinite for undetectable faults, `weight` is 0 for unused entries.
    bounds : ndarray of int, shape (kinds + 1,)
        Index of the first hypothesis of each kind, and K at the end.
    share : ndarray, shape (T, kinds)
        Risk that each kind may use.
    reserved : ndarray, shape (T,)
        Risk that is subtracted from the sum of `share`.

    Returns
    -------
    level_m : ndarray, shape (T,) [m]
    spender : ndarray of int8, shape (T,)
        Kind of hypothesis that uses most of the risk at `level_m`.
    part_m, k : ndarray, shape (T, kinds)
        Level ``offset + k sigma`` that each kind requires. If the total weight of a kind is within its `share`, the
        level is 0, and k is -inf.
    worst : ndarray of int, shape (T, kinds)
        Index, within its kind, of the hypothesis that requires `part_m`; -1 if there is none.
    """
    (epochs, width), kinds = weight.shape, len(bounds) - 1
    level, spender = np.zeros(epochs), np.zeros(epochs, dtype=np.int8)
    part, k_of = np.zeros((epochs, kinds)), np.full((epochs, kinds), -np.inf)
    worst = np.full((epochs, kinds), -1, dtype=np.intp)
    of_each = np.empty((6, width))
    room = _Room(
        of_each[0], of_each[1], of_each[2], of_each[3], of_each[4], np.empty(width, dtype=np.int64), of_each[5],
        np.empty(kinds),
    )  # fmt: skip
    for t in range(epochs):
        allowed = -reserved[t]
        for m in range(width):
            room.inverse[m] = 1.0 / sigma_m[t, m]
            room.checked[m] = weight[t, m] if room.inverse[m] > 0.0 else 0.0
        for kind in range(kinds):
            of_kind = slice(bounds[kind], bounds[kind + 1])
            left, k_of[t, kind], largest, worst[t, kind] = _require(
                offset_m[t, of_kind], sigma_m[t, of_kind], weight[t, of_kind], room.checked[of_kind], share[t, kind],
                room.required[of_kind],
            )  # fmt: skip
            allowed += left
            part[t, kind] = max(largest, 0.0)
            level[t] = max(level[t], part[t, kind])
        if math.isfinite(level[t]) and allowed > 0.0:
            level[t], spender[t] = _lower(offset_m[t], bounds, level[t], allowed * (1.0 - _AIM), room)
    return level, spender, part, k_of, worst


@inner
def _require(
    offset: Floats, sigma: Floats, prior: Floats, checked: Floats, share: float, required: Floats
) -> tuple[float, float, float, int]:
    """For one kind, return the remaining risk, k, the largest required level, and the hypothesis that requires it."""
    total, whole = 0.0, 0.0
    for m in range(len(prior)):
        total += checked[m]
        whole += prior[m]
    left, needed = share - (whole - total), whole > share
    spent = needed and left <= 0.0
    k, largest, worst = -np.inf, -np.inf, -1
    if needed and not (left > 0.0 and total == 0.0):
        k = _quantile(left / total if total > 0.0 else 0.0)
    for m in range(len(prior)):
        if prior[m] > 0.0:
            required[m] = -np.inf
            if spent and (total == whole or checked[m] == 0.0):
                required[m] = np.inf
            elif checked[m] > 0.0 and math.isfinite(k):
                required[m] = offset[m] + k * sigma[m]
            largest = max(largest, required[m])
    alike = largest - _ALIKE * abs(largest) if math.isfinite(largest) else largest
    for m in range(len(prior) - 1, -1, -1):
        if prior[m] > 0.0 and required[m] >= alike > -np.inf:
            worst = m
    return left, k, largest, worst


@inner
def _lower(offset: Floats, bounds: Indices, highest: float, aim: float, room: _Room) -> tuple[float, int]:
    """Find, below `highest`, the level at which the tails sum to `aim`, and the kind that has the largest sum."""
    level, spender, here, below, above = highest, 0, highest, 0.0, highest
    for number in range(_STEPS):
        _write_tails(offset, here, number == 0, room)
        excess, following = _step(bounds, here, highest, aim, room)
        if number > 0:
            spender = int(np.argmax(room.of_kind))
            if excess > 0.0:
                below = here
            else:
                above = here
        close = number > 0 and abs(following - here) <= _CLOSE * here
        halved = number >= _HALVING and number % 2 == 1
        if halved or not below <= following <= above:
            following = min(max(following, below), above) if close else (below + above) / 2.0
        level = following if close else above
        if close:
            break
        here = following
    return level, spender


@inner
def _write_tails(offset: Floats, level: float, roughly: bool, room: _Room) -> None:
    """Write the tail (weight times Q) of each hypothesis beyond a level; if `roughly`, Q is exact to 0.3 % only."""
    for m in range(len(offset)):
        room.z[m] = (offset[m] - level) * room.inverse[m]
    _bells(room.z, room.bits, room.bell)
    if roughly:
        for m in range(len(offset)):
            x = max(-room.z[m], 0.0)
            near = (1.0 - _MILLS[0]) * x + _MILLS[0] * math.sqrt(x * x + _MILLS[1])
            room.tail[m] = room.checked[m] * room.bell[m] / (_ROOT_TWO_PI * near)
    else:
        for m in range(len(offset)):
            beyond = _mills(abs(room.z[m])) * room.bell[m] / _ROOT_TWO_PI
            room.tail[m] = room.checked[m] * (1.0 - beyond if room.z[m] > 0.0 else beyond)


@inner
def _step(bounds: Indices, here: float, highest: float, aim: float, room: _Room) -> tuple[float, float]:
    """Return the logarithm of (sum of tails / `aim`), and the next level, computed from its derivatives."""
    total, slope, bend = 0.0, 0.0, 0.0
    for kind in range(len(room.of_kind)):
        room.of_kind[kind] = 0.0
        for m in range(bounds[kind], bounds[kind + 1]):
            room.of_kind[kind] += room.tail[m]
        total += room.of_kind[kind]
    for m in range(len(room.tail)):
        density = room.checked[m] * room.bell[m] * room.inverse[m]
        slope += density
        bend -= density * room.inverse[m] * room.z[m]
    total = max(total, _TINY)
    slope /= _ROOT_TWO_PI * total
    bend = bend / (_ROOT_TWO_PI * total) - slope * slope
    excess = math.log(total / aim)
    steepest = slope + math.sqrt(max(slope * slope - 2.0 * bend * excess, 0.0))
    return excess, min(here + 2.0 * excess / max(steepest, _TINY), highest)

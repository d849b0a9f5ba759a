"""Robust weights of ranges by the IGG-III scheme."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.sight import sight

#: Lower limit of the scale of whitened residuals; smaller scales occur only by coincidence.
_LEAST_SCALE = 0.05


class _Room(NamedTuple):
    """Work space of one epoch: the used channels are contiguous, and the channels of clock g begin at ``begin[g]``.

    Fields of shape (M,) are the index `channel` in the ranges, the `base` weight and its `root`, the `misfit`, the
    robust `factor`, the `weight`, the whitened residual `white`, and the `order` of these residuals. `sight`, shape (3,
    M), are unit vectors to the satellites. `row`, shape (4, M), are sights and misfits minus their mean over the clock.
    `total`, shape (G,), and `mean`, shape (4, G), are weights and mean rows of the clocks. With known clock offsets,
    `mass`, shape (G,), are the weights of the clocks, and `apart`, shape (4, G), their mean rows minus the common mean.
    """

    begin: Indices
    channel: Indices
    order: Indices
    base: Floats
    root: Floats
    misfit: Floats
    factor: Floats
    weight: Floats
    white: Floats
    sight: Floats
    row: Floats
    total: Floats
    mass: Floats
    mean: Floats
    apart: Floats


@kernel
def reweight_ranges(
    ranges: Any,
    place_ecef_m: Floats,
    information: Floats,
    correction: Floats,
    keep: float,
    reject: float,
    iterations: int,
) -> tuple[Masks, Floats, Masks]:
    """Reweight ranges iteratively by their residuals at linearisation points.

    Parameters
    ----------
    ranges : RangeArrays
    place_ecef_m : ndarray, shape (T, 3) [m]
        Linearisation points, in C order.
    information : ndarray, shape (T, 3, 3) [1/m^2], or (0, 3, 3)
    correction : ndarray, shape (T,)
        Ratio of the scale to the median of the absolute residuals.
    keep, reject : float
    iterations : int

    Returns
    -------
    kept : ndarray of bool, shape (T, M)
    wsse : ndarray, shape (T,)
        Weighted sum of the squared residuals of kept ranges.
    solved : ndarray of bool, shape (T,)
        False where the equations of the last step were singular.
    """
    epochs, channels = ranges.weight.shape
    tied, informed = len(ranges.offset_m) == epochs, len(information) == epochs
    kept, wsse = np.zeros((epochs, channels), dtype=np.bool_), np.zeros(epochs)
    solved = np.zeros(epochs, dtype=np.bool_)
    room = _new_room(channels, len(ranges.starts))
    normal, vector, step = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for t in range(epochs):
        count = _choose_channels(ranges, t, place_ecef_m[t], room)
        scale = 1.0
        for _ in range(iterations):
            _sum_clocks(room)
            _sum_normal(count, room, normal, vector)
            if tied:
                _add_ties(ranges.offset_m[t], ranges.sigma_m[t], room, normal, vector)
            if informed:
                normal += information[t]
            solved[t] = _solve(normal, vector, step)
            _write_residuals(step, solved[t], room)
            scale = max(_median(count, room) * correction[t], _LEAST_SCALE)
            if not _reweight(count, scale, keep, reject, room):
                break  # the weights have converged
        for k in range(count):
            if room.white[k] / scale < reject:
                kept[t, room.channel[k]] = True
                wsse[t] += room.white[k] * room.white[k]
    return kept, wsse, solved


@inner
def _new_room(channels: int, clocks: int) -> _Room:
    """Allocate the work space of an epoch."""
    numbers, of_channel = np.zeros((2, channels), dtype=np.int64), np.empty((6, channels))
    return _Room(
        np.zeros(clocks + 1, dtype=np.int64), numbers[0], numbers[1], of_channel[0], of_channel[1], of_channel[2],
        of_channel[3], of_channel[4], of_channel[5], np.empty((3, channels)), np.empty((4, channels)),
        np.empty(clocks), np.empty(clocks), np.empty((4, clocks)), np.empty((4, clocks)),
    )  # fmt: skip


@inner
def _choose_channels(ranges: Any, t: int, place: Floats, room: _Room) -> int:
    """Write the used channels, their sights and misfits to contiguous arrays; return the number of used channels."""
    channels, clocks, count = ranges.weight.shape[1], len(ranges.starts), 0
    for g in range(clocks):
        room.begin[g], stop = count, ranges.starts[g + 1] if g + 1 < clocks else channels
        for m in range(ranges.starts[g], stop):
            if not ranges.weight[t, m] > 0.0:
                continue
            satellite = ranges.sat_ecef_m[t, m]
            distance, room.sight[0, count], room.sight[1, count], room.sight[2, count] = sight(
                satellite[0], satellite[1], satellite[2], place[0], place[1], place[2]
            )
            room.base[count], room.root[count] = ranges.weight[t, m], math.sqrt(ranges.weight[t, m])
            room.misfit[count], room.factor[count] = ranges.code_m[t, m] - distance, 1.0
            room.channel[count], room.order[count] = m, count
            count += 1
    room.begin[clocks] = count
    return count


@inner
def _sum_clocks(room: _Room) -> None:
    """Write the weights and each clock's total weight and mean row; subtract the mean rows from the rows."""
    for g in range(len(room.total)):
        total = x = y = z = misfit = 0.0
        for k in range(room.begin[g], room.begin[g + 1]):
            weight = room.base[k] * room.factor[k]
            room.weight[k] = weight
            total += weight
            x += weight * room.sight[0, k]
            y += weight * room.sight[1, k]
            z += weight * room.sight[2, k]
            misfit += weight * room.misfit[k]
        if total > 0.0:
            x, y, z, misfit = x / total, y / total, z / total, misfit / total
        room.total[g] = total
        room.mean[0, g], room.mean[1, g], room.mean[2, g], room.mean[3, g] = -x, -y, -z, misfit
        for k in range(room.begin[g], room.begin[g + 1]):
            room.row[0, k], room.row[1, k] = x - room.sight[0, k], y - room.sight[1, k]
            room.row[2, k], room.row[3, k] = z - room.sight[2, k], room.misfit[k] - misfit


@inner
def _sum_normal(count: int, room: _Room, normal: Floats, vector: Floats) -> None:
    """Write the normal equations of the position with the clocks eliminated."""
    for a in range(3):
        for b in range(a, 3):
            total = 0.0
            for k in range(count):
                total += room.weight[k] * room.row[a, k] * room.row[b, k]
            normal[a, b] = normal[b, a] = total
        total = 0.0
        for k in range(count):
            total += room.weight[k] * room.row[a, k] * room.row[3, k]
        vector[a] = total


@inner
def _add_ties(offset_m: Floats, sigma_m: Floats, room: _Room, normal: Floats, vector: Floats) -> None:
    """Add the information of the known clock offsets to the normal equations of the position."""
    clocks, whole = len(room.total), 0.0
    for g in range(clocks):
        room.mass[g] = 1.0 / (1.0 / room.total[g] + sigma_m[g] ** 2) if room.total[g] > 0.0 else 0.0
        whole += room.mass[g]
    for i in range(4):
        common = 0.0
        for g in range(clocks):
            room.apart[i, g] = room.mean[i, g] - (offset_m[g] if i == 3 else 0.0)
            common += room.mass[g] * room.apart[i, g]
        for g in range(clocks):
            room.apart[i, g] -= common / whole if whole > 0.0 else 0.0
    for g in range(clocks):
        if not room.total[g] > 0.0:
            continue
        for a in range(3):
            for b in range(3):
                normal[a, b] += room.mass[g] * room.apart[a, g] * room.apart[b, g]
            vector[a] += room.mass[g] * room.apart[a, g] * room.apart[3, g]
        own = 1.0 / (room.total[g] * sigma_m[g] ** 2 + 1.0)
        for i in range(4):
            room.mean[i, g] -= room.apart[i, g] * own


@inner
def _solve(normal: Floats, vector: Floats, step: Floats) -> bool:
    """Solve three symmetric equations; return True if their matrix is regular, otherwise set the step to zero."""
    a, b, c, d, e, f = normal[0, 0], normal[0, 1], normal[0, 2], normal[1, 1], normal[1, 2], normal[2, 2]
    of_x, of_y, of_z = d * f - e * e, c * e - b * f, b * e - c * d
    determinant, mean = a * of_x + b * of_y + c * of_z, (a + d + f) / 3.0
    step[:] = 0.0
    if not determinant > 1e-12 * mean * mean * mean:
        return False
    x, y, z = vector[0], vector[1], vector[2]
    step[0] = (of_x * x + of_y * y + of_z * z) / determinant
    step[1] = (of_y * x + (a * f - c * c) * y + (b * c - a * e) * z) / determinant
    step[2] = (of_z * x + (b * c - a * e) * y + (a * d - b * b) * z) / determinant
    return True


@inner
def _write_residuals(step: Floats, solved: bool, room: _Room) -> None:
    """Write the absolute whitened residuals after the step; they are zero if `solved` is False."""
    for g in range(len(room.total)):
        known = 1.0 if solved and room.total[g] > 0.0 else 0.0
        clock = room.mean[3, g]
        clock -= step[0] * room.mean[0, g] + step[1] * room.mean[1, g] + step[2] * room.mean[2, g]
        for k in range(room.begin[g], room.begin[g + 1]):
            moved = room.sight[0, k] * step[0] + room.sight[1, k] * step[1] + room.sight[2, k] * step[2]
            room.white[k] = known * room.root[k] * abs(room.misfit[k] + moved - clock)


@inner
def _median(count: int, room: _Room) -> float:
    """Return the median of the whitened residuals; `room.order` is reused in the next call, where it changes little."""
    for k in range(count):
        at, number = k, room.order[k]
        while at > 0 and room.white[room.order[at - 1]] > room.white[number]:
            room.order[at] = room.order[at - 1]
            at -= 1
        room.order[at] = number
    return float(room.white[room.order[count // 2]]) if count > 0 else 0.0


@inner
def _reweight(count: int, scale: float, keep: float, reject: float, room: _Room) -> bool:
    """Write the robust factors from the scaled residuals; return True if a factor has changed."""
    changed = False
    for k in range(count):
        size, before = room.white[k] / scale, room.factor[k]
        if not size < reject:
            room.factor[k] = 0.0
        elif size <= keep:
            room.factor[k] = 1.0
        else:
            room.factor[k] = ((reject - size) / (reject - keep)) ** 2 * keep / max(size, 1e-9)
        changed |= room.factor[k] != before
    return changed

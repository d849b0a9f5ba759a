"""What each fault hypothesis does to the position."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.constants import LEAST_REDUNDANCY
from railfix.kernels.compiling import inner, kernel

#: Effect on the position, in its own sigmas, below which a satellite has none.
_NO_EFFECT = 1e-6
#: Separations below this share of sigma are none.
_SAME = 1e-9


class _RangeErrors(NamedTuple):
    """Errors of single ranges beyond the noise, where there are `any`: `bias`, and variance `beyond` it.

    `gain` is that of the ranges before any is left out, `own` work space for others.
    """

    any: bool
    gain: Floats
    bias: Floats
    beyond: Floats
    own: Floats


class _Sets(NamedTuple):
    """Offset, sigma and separation over its threshold of sets of channels left out, written one after the other."""

    offset: Floats
    sigma: Floats
    ratio: Floats


@inner
def _of_ranges(left: Floats, ranges: _RangeErrors) -> tuple[float, float, float]:
    """Return what the gains of single ranges add to bias, variance of the distance, and variance."""
    bias, apart, total = 0.0, 0.0, 0.0
    for m in range(len(left)):
        bias += abs(left[m]) * ranges.bias[m]
        apart += (left[m] - ranges.gain[m]) ** 2 * ranges.beyond[m]
        total += left[m] ** 2 * ranges.beyond[m]
    return bias, apart, total


@inner
def _separate(
    square: float, distance: float, across: float, up: float, more: tuple[float, float, float], common: Floats
) -> tuple[float, float, float]:
    """Return offset, sigma, and the distance over its threshold, of what a set takes with it."""
    noise, variance, map_across, map_up = common[0], common[1], common[2], common[3]
    whole_across, whole_up = across + map_across, up + map_up
    apart = noise * square + (1.0 - noise) * (across * across + up * up)
    total = noise * (square + variance) + (1.0 - noise) * (whole_across * whole_across + whole_up * whole_up)
    threshold = common[6] * math.sqrt(max(apart, 0.0) + more[1])
    bias = abs(whole_across * common[4] + whole_up * common[5]) + more[0] + common[8] * abs(common[9] - distance)
    ratio = abs(distance) / threshold if threshold > common[7] else 0.0
    return threshold + bias, math.sqrt(max(total, 0.0) + more[2]), ratio


@inner
def _leave_out(rows: Floats, member: Masks, every: bool, limit: float, work: Floats, gone: Floats) -> bool:
    """Leave out channels one after the other; return whether nothing bounds a fault of them.

    `gone` becomes what they take with them; `work` the rows of what is left, for all channels where `every` says so.
    """
    n, blind = rows.shape[1], False
    for i in range(n + 4):
        for k in range(n):
            work[i, k] = rows[i, k]
    for c in range(4):
        gone[c] = 0.0
    for k in range(n):
        if not member[k]:
            continue
        share = work[k, k]
        if share > LEAST_REDUNDANCY:
            for c in range(4):
                gone[c] += work[n, k] * work[n + c, k] / share
            for i in range(n + 4):
                if i != k and (every or i >= n or (i > k and member[i])):
                    ratio = work[i, k] / share
                    for j in range(n):
                        work[i, j] -= ratio * work[k, j]
            for j in range(n):
                work[k, j] = 0.0
        elif abs(work[n, k]) > limit:
            blind = True
    return blind


@inner
def _with_each_later(
    rows: Floats,
    i: int,
    gone: Floats,
    blind: bool,
    limit: float,
    common: Floats,
    ranges: _RangeErrors,
    sets: _Sets,
) -> None:
    """Write the sets of channel i and one after it, left out together from the system `rows`.

    `gone` and `blind` are of what has been left out of it before.
    """
    n, own = rows.shape[1], ranges.own
    offset, sigma, ratio = sets.offset, sets.sigma, sets.ratio
    share, of_first = rows[i, i], rows[n, i]
    inverse = 1.0 / share if share > LEAST_REDUNDANCY else 0.0
    weight = inverse * of_first
    blind = blind or (inverse == 0.0 and abs(of_first) > limit)
    square, distance = gone[0] + weight * of_first, gone[1] + weight * rows[n + 1, i]
    across, up = gone[2] + weight * rows[n + 2, i], gone[3] + weight * rows[n + 3, i]
    residual, map_across, map_up = rows[n + 1, i], rows[n + 2, i], rows[n + 3, i]
    first, gains, residuals = rows[i, i + 1 :], rows[n, i + 1 :], rows[n + 1, i + 1 :]
    of_across, of_up = rows[n + 2, i + 1 :], rows[n + 3, i + 1 :]
    rests = own[: n - 1 - i]
    for at in range(n - 1 - i):
        rests[at] = rows[i + 1 + at, i + 1 + at]
    lost = False
    for at in range(n - 1 - i):
        coupling = inverse * first[at]
        of_gain = gains[at] - coupling * of_first
        rest = rests[at] - coupling * first[at]
        last = of_gain / rest if rest > LEAST_REDUNDANCY else 0.0
        lost |= not rest > LEAST_REDUNDANCY
        offset[at], sigma[at], ratio[at] = _separate(
            square + last * of_gain,
            distance + last * (residuals[at] - coupling * residual),
            across + last * (of_across[at] - coupling * map_across),
            up + last * (of_up[at] - coupling * map_up),
            (0.0, 0.0, 0.0),
            common,
        )
    if not (ranges.any or blind or lost):
        return
    for at in range(n - 1 - i):
        j = i + 1 + at
        coupling = inverse * rows[i, j]
        of_gain = rows[n, j] - coupling * of_first
        rest = rows[j, j] - coupling * rows[i, j]
        last = of_gain / rest if rest > LEAST_REDUNDANCY else 0.0
        if ranges.any:
            for m in range(n):
                own[m] = rows[n, m] - weight * rows[i, m] - last * (rows[j, m] - coupling * rows[i, m])
            offset[at], sigma[at], ratio[at] = _separate(
                square + last * of_gain,
                distance + last * (rows[n + 1, j] - coupling * residual),
                across + last * (rows[n + 2, j] - coupling * map_across),
                up + last * (rows[n + 3, j] - coupling * map_up),
                _of_ranges(own, ranges),
                common,
            )
        if blind or (not rest > LEAST_REDUNDANCY and abs(of_gain) > limit):
            offset[at], sigma[at], ratio[at] = 0.0, np.inf, 0.0


@kernel
def tails_of_hypotheses(model: Any, errors: Any, asked: Any) -> tuple[Indices, Floats, Floats, Floats, Floats]:
    """Return the tails of all hypotheses of a block of epochs.

    Returns
    -------
    channel : ndarray of int, shape (T, n)
        Channels in use, side by side.
    offset_m, sigma_m, weight : ndarray, shape (T, K)
        As `tails.solve_level` takes them: threshold and bias, sigma (infinite where nothing bounds a fault), prior.
    separation : ndarray, shape (T,)
        `ProtectionLevel.separation`.
    """
    root_weight, clock, clock_covariance_m2 = model.root_weight, model.clock, model.clock_covariance_m2
    design, map_prior, scale = model.design, model.prior, errors.scale
    least_sigma_m, bias_m, information = errors.least_sigma_m, errors.bias_m, errors.map_information
    epochs, channels = root_weight.shape
    n, some_mapped = 0, False
    for mapped in asked.wrong_map:
        some_mapped |= mapped
    for t in range(epochs):
        count = 0
        for m in range(channels):
            count += root_weight[t, m] > 0.0
        n = max(n, count)
    clocks, width = clock_covariance_m2.shape[1], asked.bounds[-1]
    by_range = bias_m.shape[1] > 0 or least_sigma_m.shape[1] > 0
    channel, separation = np.empty((epochs, n), dtype=np.intp), np.zeros(epochs)
    offset, sigma, weight = np.empty((epochs, width)), np.empty((epochs, width)), np.zeros((epochs, width))
    ratio = np.zeros(width)
    # Projector of the channels, and below it their gains, residuals, responses to the map across and up; the same
    # without the map; without a shared fault; without one more satellite and without two more.
    rows, free_rows, work = np.empty((n + 4, n)), np.zeros((n + 4, n)), np.empty((n + 4, n))
    reduced, taken, blinds = np.empty((2, n + 4, n)), np.zeros((3, 4)), np.zeros(3, dtype=np.bool_)
    start, place, product = np.zeros(3, dtype=np.intp), np.zeros(3, dtype=np.intp), np.zeros(3)
    member, single, gone = np.empty(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_), np.zeros(4)
    own, likely, others, spread = np.empty(n), np.empty(n), np.empty(n), np.empty(3)
    # Of the channels in use, side by side: root of the weight, design, clock, and what they share by their clocks.
    roots, along, across, up = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    group, shared = np.zeros(n, dtype=np.intp), np.empty((n, n))
    range_bias, beyond, common, free = np.zeros(n), np.zeros(n), np.zeros(10), np.zeros(10)
    requested, of_clocks, pull, step, shift = np.empty(clocks), np.empty(clocks), np.empty(3), np.empty(3), np.empty(3)
    root_across, root_up = math.sqrt(map_prior[1, 1]), math.sqrt(map_prior[2, 2])
    for t in range(epochs):
        root, y, q, used = root_weight[t], model.misfit[t], model.covariance_m2[t], channel[t]
        count = 0
        for m in range(channels):
            if root[m] > 0.0:
                used[count] = m
                count += 1
        other = count
        for m in range(channels):
            if other < n and not root[m] > 0.0:
                used[other] = m
                other += 1
        # Misfits summed by clock, and the place that they imply.
        for g in range(clocks):
            requested[g] = 0.0
        for a in range(3):
            pull[a] = 0.0
        for i in range(count):
            m = used[i]
            requested[clock[m]] += root[m] * y[m]
            for a in range(3):
                pull[a] += y[m] * design[t, m, a]
        for a in range(3):
            step[a] = pull[0] * q[0, a] + pull[1] * q[1, a] + pull[2] * q[2, a]
        for g in range(clocks):
            of_clocks[g] = 0.0
            for k in range(clocks):
                of_clocks[g] += clock_covariance_m2[t, g, k] * requested[k]
        for i in range(n):
            m = used[i]
            roots[i], group[i] = (root[m], clock[m]) if i < count else (0.0, 0)
            along[i], across[i], up[i] = design[t, m, 0], design[t, m, 1], design[t, m, 2]
            if not i < count:
                along[i] = across[i] = up[i] = 0.0
        for i in range(n):
            of_clock, own_root = clock_covariance_m2[t, group[i]], roots[i]
            for j in range(n):
                shared[i, j] = own_root * roots[j] * of_clock[group[j]]
            for a in range(3):
                spread[a] = along[i] * q[0, a] + across[i] * q[1, a] + up[i] * q[2, a]
            for j in range(n):
                rows[i, j] = -shared[i, j] - (spread[0] * along[j] + spread[1] * across[j] + spread[2] * up[j])
            rows[i, i] += 1.0 if i < count else 0.0
            rows[n, i], rows[n + 2, i], rows[n + 3, i] = spread[0], -spread[1] * root_across, -spread[2] * root_up
            of_place = along[i] * step[0] + across[i] * step[1] + up[i] * step[2]
            rows[n + 1, i] = (y[used[i]] if i < count else 0.0) - own_root * of_clocks[group[i]] - of_place
        for i in range(n):
            m = used[i]
            likely[i] = asked.prior[t, m] if i < count else 0.0
            if bias_m.shape[1] > 0:
                range_bias[i] = abs(bias_m[t, m]) * root[m]
            if least_sigma_m.shape[1] > 0:
                least = (least_sigma_m[t, m] * root[m]) ** 2 if root[m] > 0.0 else 0.0
                beyond[i] = max(least - scale[t] ** 2, 0.0) if i < count else 0.0
        limit, lost = _NO_EFFECT * math.sqrt(q[0, 0]), 0.0
        common[0], common[1] = scale[t] ** 2, q[0, 0]
        common[2], common[3] = -q[0, 1] * root_across, -q[0, 2] * root_up
        common[4], common[5] = errors.map_bias_m[t, 0] * root_across, errors.map_bias_m[t, 1] * root_up
        common[6] = asked.k_false_alarm[t]
        more = _of_ranges(rows[n], _RangeErrors(by_range, rows[n], range_bias, beyond, own))
        common[7] = common[6] * _SAME * _separate(0.0, 0.0, 0.0, 0.0, more, common)[1]

        # The place without the map: its distance counts whole, and nothing is tested.
        determined = False
        if some_mapped:
            covariance, determined = _without_map(q, map_prior, information[t], scale[t])
            for a in range(1, 3):
                for b in range(1, 3):
                    pull[a] += scale[t] ** 2 * information[t, a - 1, b - 1] * errors.map_seen_m[t, b - 1]
            for a in range(3):
                shift[a] = -step[a]
                for b in range(3):
                    shift[a] += covariance[a, b] * pull[b]
            free[0], free[1], free[7], free[8], free[9] = common[0], covariance[0, 0], np.inf, 1.0, shift[0]
            lost = _NO_EFFECT * math.sqrt(covariance[0, 0])
            for i in range(n):
                for a in range(3):
                    spread[a] = along[i] * covariance[0, a] + across[i] * covariance[1, a] + up[i] * covariance[2, a]
                for j in range(n):
                    free_rows[i, j] = -shared[i, j] - (spread[0] * along[j] + spread[1] * across[j] + spread[2] * up[j])
                free_rows[i, i] += 1.0 if i < count else 0.0
                of_shift = along[i] * shift[0] + across[i] * shift[1] + up[i] * shift[2]
                free_rows[n, i], free_rows[n + 1, i] = spread[0], rows[n + 1, i] - of_shift

        for base in range(len(asked.first)):
            order, first = asked.order[t, base], asked.first[base]
            if order < 0:
                continue
            mapped, of_base = asked.wrong_map[base], asked.shared_prior[t, base]
            system, known, nil = (free_rows, free, lost) if mapped else (rows, common, limit)
            ranges, some = _RangeErrors(by_range, system[n], range_bias, beyond, own), False
            for i in range(n):
                member[i] = i < count and asked.members[t, base, used[i]]
                others[i] = 0.0 if member[i] else likely[i]
                some |= member[i]
            blind = mapped and not determined
            for c in range(4):
                gone[c] = 0.0
            if some:
                blind |= _leave_out(system, member, by_range or order > 0, nil, work, gone)
                system = work
            left = system[n]
            more = _of_ranges(left, ranges) if by_range else (0.0, 0.0, 0.0)
            at = first[0]
            offset[t, at], sigma[t, at], ratio[at] = _separate(gone[0], gone[1], gone[2], gone[3], more, known)
            if blind:
                offset[t, at], sigma[t, at], ratio[at] = 0.0, np.inf, 0.0
            # Noise passes on either side.
            weight[t, at] = of_base * (2.0 if at == 0 else 1.0)
            at = first[1]
            for i in range(n if order > 0 else 0):
                checked = system[i, i] > LEAST_REDUNDANCY
                w = system[n, i] / system[i, i] if checked else 0.0
                if by_range:
                    for m in range(n):
                        own[m] = left[m] - w * system[i, m]
                    more = _of_ranges(own, ranges)
                offset[t, at], sigma[t, at], ratio[at] = _separate(
                    gone[0] + w * system[n, i], gone[1] + w * system[n + 1, i],
                    gone[2] + w * system[n + 2, i], gone[3] + w * system[n + 3, i], more, known,
                )  # fmt: skip
                if blind or (not checked and abs(system[n, i]) > nil):
                    offset[t, at], sigma[t, at], ratio[at] = 0.0, np.inf, 0.0
                weight[t, at] = of_base * others[i]
                at += 1
            # Sets of two and more: all but the last channel left out of the system one after the other, `depth` so far.
            depth = 0 if order > 1 else -1
            start[0], product[0], blinds[0] = 0, of_base, blind
            for c in range(4):
                taken[0, c] = gone[c]
            for k in range(3):
                place[k] = first[2 + k]
            while depth >= 0:
                i = start[depth]
                if i == n:
                    depth -= 1
                    continue
                start[depth] += 1
                rest = system if depth == 0 else reduced[depth - 1]
                begin, end = place[depth], place[depth] + n - 1 - i
                sets = _Sets(offset[t, begin:end], sigma[t, begin:end], ratio[begin:end])
                _with_each_later(rest, i, taken[depth], blinds[depth], nil, known, ranges, sets)
                with_first = product[depth] * others[i]
                for j in range(i + 1, n):
                    weight[t, begin + j - i - 1] = with_first * others[j]
                place[depth] = end
                if order > depth + 2:
                    single[i] = True
                    lost_now = _leave_out(rest, single, True, nil, reduced[depth], taken[depth + 1])
                    single[i] = False
                    for c in range(4):
                        taken[depth + 1, c] += taken[depth, c]
                    start[depth + 1], product[depth + 1] = i + 1, with_first
                    blinds[depth + 1] = lost_now or blinds[depth]
                    depth += 1
        for m in range(width):
            if not weight[t, m] > 0.0:
                offset[t, m], sigma[t, m] = 0.0, 1.0
            elif ratio[m] > separation[t]:
                separation[t] = ratio[m]
    return channel, offset, sigma, weight, separation


@inner
def _without_map(covariance: Floats, prior: Floats, information: Floats, scale: float) -> tuple[Floats, bool]:
    """Return the covariance of the place with other information in place of the map, and whether there is one."""
    normal, regular = _inverse(covariance)
    for a in range(3):
        for b in range(3):
            normal[a, b] -= prior[a, b]
    for a in range(2):
        for b in range(2):
            normal[a + 1, b + 1] += scale**2 * information[a, b]
    inverse, determined = _inverse(normal)
    if regular and determined:
        return inverse, True
    for a in range(3):
        for b in range(3):
            inverse[a, b] = 1.0 if a == b else 0.0
    return inverse, False


@inner
def _inverse(matrix: Floats) -> tuple[Floats, bool]:
    """Return the inverse of a symmetric 3 x 3 matrix scaled to a unit diagonal, and whether it is regular."""
    inverse, unit = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        if not matrix[a, a] > 0.0:
            return inverse, False
        unit[a] = 1.0 / math.sqrt(matrix[a, a])
    b, c, e = matrix[0, 1] * unit[0] * unit[1], matrix[0, 2] * unit[0] * unit[2], matrix[1, 2] * unit[1] * unit[2]
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = 1.0 - e * e, 1.0 - c * c, 1.0 - b * b
    inverse[0, 1] = inverse[1, 0] = c * e - b
    inverse[0, 2] = inverse[2, 0] = b * e - c
    inverse[1, 2] = inverse[2, 1] = b * c - e
    determinant = inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]
    for a in range(3):
        for d in range(3):
            inverse[a, d] *= unit[a] * unit[d] / determinant
    return inverse, determinant > 1e-12

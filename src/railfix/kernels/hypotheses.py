"""Compiled function of `railfix.integrity.protection`: what each fault hypothesis does to the position."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.kernels.compiling import inner, kernel

#: `LEAST_REDUNDANCY` of `railfix.integrity.raim.exclusion`, `NO_EFFECT` of `separation`, `_SAME` of `level`.
_LEAST_REDUNDANCY, _NO_EFFECT, _SAME = 1e-9, 1e-6, 1e-9


@inner
def _of_ranges(left: Floats, gain: Floats, range_bias: Floats, beyond: Floats) -> tuple[float, float, float]:
    """Return what the gains of single ranges add to bias, variance of the distance, and variance."""
    bias, apart, total = 0.0, 0.0, 0.0
    for m in range(len(left)):
        bias += abs(left[m]) * range_bias[m]
        apart += (left[m] - gain[m]) ** 2 * beyond[m]
        total += left[m] ** 2 * beyond[m]
    return bias, apart, total


@inner
def _separated(
    square: float, distance: float, across: float, up: float, more: tuple[float, float, float], common: Floats
) -> tuple[float, float, float]:
    """Return offset, sigma, and the distance over its threshold, of what a set takes with it."""
    noise, variance, map_across, map_up = common[0], common[1], common[2], common[3]
    whole_across, whole_up = across + map_across, up + map_up
    apart = noise * square + (1.0 - noise) * (across * across + up * up)
    total = noise * (square + variance) + (1.0 - noise) * (whole_across * whole_across + whole_up * whole_up)
    threshold = common[6] * math.sqrt(max(apart, 0.0) + more[1])
    bias = abs(whole_across * common[4] + whole_up * common[5]) + more[0]
    ratio = abs(distance) / threshold if threshold > common[7] else 0.0
    return threshold + bias, math.sqrt(max(total, 0.0) + more[2]), ratio


@inner
def _leave_out(rows: Floats, member: Masks, every: bool, limit: float, work: Floats, gone: Floats) -> bool:
    """Leave out channels one after the other; return whether nothing bounds a fault of them.

    `gone` becomes what they take with them; `work` the rows of what is left, for all channels where `every` says so.
    """
    n, blind = rows.shape[1], False
    work[:] = rows
    gone[:] = 0.0
    for k in range(n):
        if not member[k]:
            continue
        share = work[k, k]
        if share > _LEAST_REDUNDANCY:
            for c in range(4):
                gone[c] += work[n, k] * work[n + c, k] / share
            for i in range(n + 4):
                if i != k and (every or i >= n or (i > k and member[i])):
                    ratio = work[i, k] / share
                    for j in range(n):
                        work[i, j] -= ratio * work[k, j]
            work[k] = 0.0
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
    by_range: bool,
    gain: Floats,
    left: Floats,
    own: Floats,
    range_bias: Floats,
    beyond: Floats,
    offset: Floats,
    sigma: Floats,
    ratio: Floats,
) -> None:
    """Write offset, sigma and separation of the channels after i, left out with it from the system `rows`.

    `gone` and `blind` are of what has been left out of it before, `left` the gains of the ranges then.
    """  # fmt: skip
    n = rows.shape[1]
    share, of_first = rows[i, i], rows[n, i]
    inverse = 1.0 / share if share > _LEAST_REDUNDANCY else 0.0
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
        last = of_gain / rest if rest > _LEAST_REDUNDANCY else 0.0
        lost |= not rest > _LEAST_REDUNDANCY
        offset[at], sigma[at], ratio[at] = _separated(
            square + last * of_gain,
            distance + last * (residuals[at] - coupling * residual),
            across + last * (of_across[at] - coupling * map_across),
            up + last * (of_up[at] - coupling * map_up),
            (0.0, 0.0, 0.0),
            common,
        )
    if not (by_range or blind or lost):
        return
    for at in range(n - 1 - i):
        j = i + 1 + at
        coupling = inverse * rows[i, j]
        of_gain = rows[n, j] - coupling * of_first
        rest = rows[j, j] - coupling * rows[i, j]
        last = of_gain / rest if rest > _LEAST_REDUNDANCY else 0.0
        if by_range:
            for m in range(n):
                own[m] = left[m] - weight * rows[i, m] - last * (rows[j, m] - coupling * rows[i, m])
            offset[at], sigma[at], ratio[at] = _separated(
                square + last * of_gain,
                distance + last * (rows[n + 1, j] - coupling * residual),
                across + last * (rows[n + 2, j] - coupling * map_across),
                up + last * (rows[n + 3, j] - coupling * map_up),
                _of_ranges(own, gain, range_bias, beyond),
                common,
            )
        if blind or (not rest > _LEAST_REDUNDANCY and abs(of_gain) > limit):
            offset[at], sigma[at], ratio[at] = 0.0, np.inf, 0.0


@kernel
def hypotheses(
    root_weight: Floats,
    clock: Indices,
    clock_covariance_m2: Floats,
    design: Floats,
    covariance_m2: Floats,
    map_prior: Floats,
    misfit: Floats,
    scale: Floats,
    least_sigma_m: Floats,
    bias_m: Floats,
    map_bias_m: Floats,
    map_seen_m: Floats,
    map_information: Floats,
    sides: Masks,
    prior: Floats,
    groups: Masks,
    group_prior: Floats,
    side_prior: Floats,
    sides_with_one: Masks,
    pairs: Masks,
    triples: Masks,
    k_false_alarm: Floats,
    wrong_map: float,
) -> tuple[Indices, Floats, Floats, Floats, Indices, Floats]:
    """Return the used channels, offset, sigma and weight of all hypotheses, their bounds, and the separation."""
    epochs, channels = root_weight.shape
    n, any_pairs, any_triples = 0, False, False
    for t in range(epochs):
        n = max(n, int(np.count_nonzero(root_weight[t] > 0.0)))
        any_pairs, any_triples = any_pairs or pairs[t], any_triples or triples[t]
    clocks, c_groups, c_sides = clock_covariance_m2.shape[1], len(groups), sides.shape[1]
    by_map = 1 if wrong_map > 0.0 else 0
    by_range = bias_m.shape[1] > 0 or least_sigma_m.shape[1] > 0
    sided = np.zeros(c_sides, dtype=np.bool_)
    for c in range(c_sides):
        sided[c] = np.any(sides_with_one[:, c])
    some_sided = int(np.count_nonzero(sided))
    bounds = np.zeros(5, dtype=np.intp)
    bounds[1] = 1
    bounds[2] = bounds[1] + n + c_groups + c_sides + by_map
    bounds[3] = bounds[2] + (n * (n - 1) // 2 if any_pairs else 0) + (c_groups + by_map) * n
    bounds[3] += some_sided * (n + by_map)
    bounds[4] = bounds[3] + (n * (n - 1) * (n - 2) // 6 if any_triples else 0)
    channel, width = np.empty((epochs, n), dtype=np.intp), bounds[4]
    offset, sigma, weight = np.empty((epochs, width)), np.empty((epochs, width)), np.empty((epochs, width))
    separation, ratio = np.zeros(epochs), np.zeros(width)
    # Projector of the channels, and below it their gains, residuals, responses to the map across and up.
    rows, work, second = np.empty((n + 4, n)), np.empty((n + 4, n)), np.empty((n + 4, n))
    member, gone, zero = np.empty(n, dtype=np.bool_), np.empty(4), np.zeros(4)
    left, own, gain, likely, spread = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty((n, 3))
    range_bias, beyond, common, free = np.zeros(n), np.zeros(n), np.zeros(8), np.zeros(8)
    asked, pull, step, shift = np.empty(clocks), np.empty(3), np.empty(3), np.empty(3)
    root_across, root_up = math.sqrt(map_prior[1, 1]), math.sqrt(map_prior[2, 2])
    for t in range(epochs):
        root, y, q, used = root_weight[t], misfit[t], covariance_m2[t], channel[t]
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
        # Misfits summed by clock, and the place that they ask for.
        asked[:] = 0.0
        pull[:] = 0.0
        for i in range(count):
            m = used[i]
            asked[clock[m]] += root[m] * y[m]
            for a in range(3):
                pull[a] += y[m] * design[t, m, a]
        for a in range(3):
            step[a] = pull[0] * q[0, a] + pull[1] * q[1, a] + pull[2] * q[2, a]
        rows[:] = 0.0
        for i in range(count):
            m = used[i]
            b = design[t, m]
            for a in range(3):
                spread[i, a] = b[0] * q[0, a] + b[1] * q[1, a] + b[2] * q[2, a]
            of_clock = 0.0
            for g in range(clocks):
                of_clock += clock_covariance_m2[t, clock[m], g] * asked[g]
            rows[n, i] = spread[i, 0]
            rows[n + 1, i] = y[m] - root[m] * of_clock - (b[0] * step[0] + b[1] * step[1] + b[2] * step[2])
            rows[n + 2, i], rows[n + 3, i] = -spread[i, 1] * root_across, -spread[i, 2] * root_up
            for j in range(i + 1):
                k = used[j]
                value = -root[m] * root[k] * clock_covariance_m2[t, clock[m], clock[k]]
                value -= (
                    spread[i, 0] * design[t, k, 0] + spread[i, 1] * design[t, k, 1] + spread[i, 2] * design[t, k, 2]
                )
                rows[i, j], rows[j, i] = value, value
            rows[i, i] += 1.0
        for i in range(n):
            m = used[i]
            gain[i], likely[i] = rows[n, i], prior[t, m] if i < count else 0.0
            if bias_m.shape[1] > 0:
                range_bias[i] = abs(bias_m[t, m]) * root[m]
            if least_sigma_m.shape[1] > 0:
                least = (least_sigma_m[t, m] * root[m]) ** 2 if root[m] > 0.0 else 0.0
                beyond[i] = max(least - scale[t] ** 2, 0.0) if i < count else 0.0
        limit, k_alarm = _NO_EFFECT * math.sqrt(q[0, 0]), k_false_alarm[t]
        common[0], common[1] = scale[t] ** 2, q[0, 0]
        common[2], common[3] = -q[0, 1] * root_across, -q[0, 2] * root_up
        common[4], common[5] = map_bias_m[t, 0] * root_across, map_bias_m[t, 1] * root_up
        common[6] = k_alarm

        # No fault; noise passes on either side.
        more = _of_ranges(gain, gain, range_bias, beyond)
        offset[t, 0], sigma[t, 0], ratio[0] = _separated(0.0, 0.0, 0.0, 0.0, more, common)
        weight[t, 0] = 2.0
        common[7] = k_alarm * _SAME * sigma[t, 0]

        # One satellite, a constellation, a side.
        at = 1
        for i in range(n):
            checked = rows[i, i] > _LEAST_REDUNDANCY
            w = gain[i] / rows[i, i] if checked else 0.0
            if by_range:
                for m in range(n):
                    own[m] = gain[m] - w * rows[i, m]
                more = _of_ranges(own, gain, range_bias, beyond)
            offset[t, at], sigma[t, at], ratio[at] = _separated(
                w * gain[i], w * rows[n + 1, i], w * rows[n + 2, i], w * rows[n + 3, i], more, common
            )
            if not checked and abs(gain[i]) > limit:
                offset[t, at], sigma[t, at], ratio[at] = 0.0, np.inf, 0.0
            weight[t, at] = likely[i]
            at += 1
        two = bounds[2] + (n * (n - 1) // 2 if any_pairs else 0)
        for c in range(c_groups + c_sides):
            whole = c < c_groups
            with_one = whole or sided[c - c_groups]
            of_all = group_prior[t, c] if whole else side_prior[t, c - c_groups]
            for i in range(n):
                member[i] = i < count and (groups[c, used[i]] if whole else sides[t, c - c_groups, used[i]])
            blind = _leave_out(rows, member, with_one or by_range, limit, work, gone)
            more = (0.0, 0.0, 0.0)
            if by_range:
                for m in range(n):
                    left[m] = work[n, m]
                more = _of_ranges(left, gain, range_bias, beyond)
            offset[t, at], sigma[t, at], ratio[at] = _separated(gone[0], gone[1], gone[2], gone[3], more, common)
            if blind:
                offset[t, at], sigma[t, at], ratio[at] = 0.0, np.inf, 0.0
            weight[t, at] = of_all
            of_all = of_all if whole or sides_with_one[t, c - c_groups] else 0.0
            at += 1
            for i in range(n if with_one else 0):
                rest = i < count and not member[i]
                checked = rest and work[i, i] > _LEAST_REDUNDANCY
                w = work[n, i] / work[i, i] if checked else 0.0
                if by_range:
                    for m in range(n):
                        own[m] = left[m] - w * work[i, m]
                    more = _of_ranges(own, gain, range_bias, beyond)
                offset[t, two], sigma[t, two], ratio[two] = _separated(
                    gone[0] + w * work[n, i], gone[1] + w * work[n + 1, i],
                    gone[2] + w * work[n + 2, i], gone[3] + w * work[n + 3, i], more, common,
                )  # fmt: skip
                if rest and (blind or (not checked and abs(work[n, i]) > limit)):
                    offset[t, two], sigma[t, two], ratio[two] = 0.0, np.inf, 0.0
                weight[t, two] = 0.0 if member[i] else of_all * likely[i]
                two += 1

        # A wrong map, alone, with one satellite, with a side.
        if by_map:
            covariance, determined = _without_map(q, map_prior, map_information[t], scale[t])
            for a in range(1, 3):
                for b in range(1, 3):
                    pull[a] += scale[t] ** 2 * map_information[t, a - 1, b - 1] * map_seen_m[t, b - 1]
            for a in range(3):
                shift[a] = -step[a]
                for b in range(3):
                    shift[a] += covariance[a, b] * pull[b]
            free[0], free[1] = common[0], covariance[0, 0]
            lost = _NO_EFFECT * math.sqrt(covariance[0, 0])
            for i in range(n):
                m = used[i]
                for a in range(3):
                    spread[i, a] = 0.0
                    for b in range(3 if i < count else 0):
                        spread[i, a] += design[t, m, b] * covariance[b, a]
                left[i] = spread[i, 0]
            more = _of_ranges(left, left, range_bias, beyond)
            _, sigma[t, at], _ = _separated(0.0, 0.0, 0.0, 0.0, more, free)
            offset[t, at], ratio[at], weight[t, at] = abs(shift[0]) + more[0], 0.0, wrong_map
            if not determined:
                offset[t, at], sigma[t, at] = 0.0, np.inf
            for i in range(n):
                m = used[i]
                share, residual = 0.0, 0.0
                if i < count:
                    share = 1.0 - root[m] ** 2 * clock_covariance_m2[t, clock[m], clock[m]]
                    residual = rows[n + 1, i]
                    for a in range(3):
                        share -= spread[i, a] * design[t, m, a]
                        residual -= design[t, m, a] * shift[a]
                checked = share > _LEAST_REDUNDANCY
                w = left[i] / share if checked else 0.0
                second[n, i], second[n + 1, i], second[n + 2 :, i] = left[i], residual, 0.0
                for j in range(n if by_range or some_sided > 0 else 0):
                    k = used[j]
                    value = 1.0 if i == j and i < count else 0.0
                    if i < count and j < count:
                        value -= root[m] * root[k] * clock_covariance_m2[t, clock[m], clock[k]]
                        for a in range(3):
                            value -= spread[i, a] * design[t, k, a]
                    second[i, j] = value
                if by_range:
                    for j in range(n):
                        own[j] = left[j] - w * second[i, j]
                    more = _of_ranges(own, left, range_bias, beyond)
                _, sigma[t, two], _ = _separated(w * left[i], 0.0, 0.0, 0.0, more, free)
                offset[t, two], ratio[two], weight[t, two] = (
                    abs(shift[0] - w * residual) + more[0],
                    0.0,
                    wrong_map * likely[i],
                )
                if not determined or (not checked and abs(left[i]) > lost):
                    offset[t, two], sigma[t, two] = 0.0, np.inf
                two += 1
            for c in range(c_sides):
                if not sided[c]:
                    continue
                for i in range(n):
                    member[i] = i < count and sides[t, c, used[i]]
                blind = _leave_out(second, member, by_range, lost, work, gone)
                if by_range:
                    more = _of_ranges(work[n], left, range_bias, beyond)
                _, sigma[t, two], _ = _separated(gone[0], 0.0, 0.0, 0.0, more, free)
                offset[t, two], ratio[two] = abs(shift[0] - gone[1]) + more[0], 0.0
                weight[t, two] = wrong_map * side_prior[t, c] if sides_with_one[t, c] else 0.0
                if blind or not determined:
                    offset[t, two], sigma[t, two] = 0.0, np.inf
                two += 1

        # Two and three satellites.
        at = bounds[2]
        for i in range(n if any_pairs else 0):
            end = at + n - 1 - i
            _with_each_later(
                rows, i, zero, False, limit, common, by_range, gain, gain, own, range_bias, beyond,
                offset[t, at:end], sigma[t, at:end], ratio[at:end],
            )  # fmt: skip
            for j in range(i + 1, n):
                weight[t, at] = likely[i] * likely[j] if pairs[t] else 0.0
                at += 1
        at = bounds[3]
        for i in range(n if any_triples else 0):
            member[:] = False
            member[i] = True
            blind = _leave_out(rows, member, True, limit, second, gone)
            for m in range(n):
                left[m] = second[n, m]
            for j in range(i + 1, n):
                end = at + n - 1 - j
                _with_each_later(
                    second, j, gone, blind, limit, common, by_range, gain, left, own, range_bias, beyond,
                    offset[t, at:end], sigma[t, at:end], ratio[at:end],
                )  # fmt: skip
                for k in range(j + 1, n):
                    weight[t, at] = likely[i] * likely[j] * likely[k] if triples[t] else 0.0
                    at += 1
        for m in range(width):
            if weight[t, m] > 0.0 and ratio[m] > separation[t]:
                separation[t] = ratio[m]
    return channel, offset, sigma, weight, bounds, separation


@inner
def _without_map(covariance: Floats, prior: Floats, information: Floats, scale: float) -> tuple[Floats, bool]:
    """Return the covariance of the place with other information in place of the map, and whether there is one."""
    normal, regular = _inverse(covariance)
    normal -= prior
    for a in range(2):
        for b in range(2):
            normal[a + 1, b + 1] += scale**2 * information[a, b]
    inverse, determined = _inverse(normal)
    if not (regular and determined):
        return np.eye(3), False
    return inverse, True


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

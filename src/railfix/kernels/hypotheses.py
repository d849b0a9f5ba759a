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


#: Entries of `_System.common`: squared noise scale, variance of the distance, response of the position to the map
#: across and up, mean error of the map across and up, sigmas of the threshold, least threshold, 1 without the map,
#: distance without the map, and the gain below which a channel has no effect.
_NOISE, _VARIANCE, _MAP_ACROSS, _MAP_UP, _BIAS_ACROSS, _BIAS_UP, _K, _LEAST, _FREE, _SHIFT, _LIMIT = range(11)


class _Channels(NamedTuple):
    """The channels of an epoch side by side, those in use first; zero for others. Shape (n,) each."""

    number: Indices  #: Of the channel in the model.
    root: Floats  #: Root of its weight [1/m].
    clock: Indices
    along: Floats  #: Whitened design.
    across: Floats
    up: Floats
    prior: Floats  #: Of a fault.
    bias: Floats  #: Mean error, whitened.
    beyond: Floats  #: Variance beyond the noise, whitened.
    shared: Floats  #: What two channels share by their clocks; shape (n, n).


class _System(NamedTuple):
    """The equations of an epoch.

    `rows`: the projector of the channels, and below it their gains, residuals, and responses to the map across and up;
    shape (n + 4, n). `common`: what holds for all of them; shape (11,).
    """

    rows: Floats
    common: Floats


class _Fit(NamedTuple):
    """The misfits summed by clock (C,), by axis (3,), the step of the position and of each clock that they imply."""

    by_clock: Floats
    by_axis: Floats
    step: Floats
    of_clocks: Floats


class _RangeErrors(NamedTuple):
    """Errors of single ranges beyond the noise, where there are `any`: `bias`, and variance `beyond` it.

    `gain` is that of the ranges before any is left out, `own` work space for others.
    """

    any: bool
    gain: Floats
    bias: Floats
    beyond: Floats
    own: Floats


class _Tails(NamedTuple):
    """Offset and sigma of the error, and weight, of all hypotheses (T, K); separations over the threshold (K,)."""

    offset: Floats
    sigma: Floats
    weight: Floats
    ratio: Floats


class _Work(NamedTuple):
    """What one base of hypotheses needs: whether each channel belongs to it, and what is left without it.

    `others` has priors of the rest (n,), `removed` what the base takes with it (4,), `own` work space (n,).
    By depth, for sets of channels left out one after the other: the system `reduced` (2, n + 4, n), what has been
    `taken` (3, 4), whether nothing bounds a fault (`undetectable`), the next channel (`start`), where its sets are
    written (`place`), and the product of the priors; shape (3,).
    """

    member: Masks
    single: Masks
    others: Floats
    removed: Floats
    own: Floats
    rows: Floats
    reduced: Floats
    taken: Floats
    undetectable: Masks
    start: Indices
    place: Indices
    product: Floats


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
    noise, whole_across, whole_up = common[_NOISE], across + common[_MAP_ACROSS], up + common[_MAP_UP]
    apart = noise * square + (1.0 - noise) * (across * across + up * up)
    whole = whole_across * whole_across + whole_up * whole_up
    total = noise * (square + common[_VARIANCE]) + (1.0 - noise) * whole
    threshold = common[_K] * math.sqrt(max(apart, 0.0) + more[1])
    of_map = abs(whole_across * common[_BIAS_ACROSS] + whole_up * common[_BIAS_UP])
    bias = of_map + more[0] + common[_FREE] * abs(common[_SHIFT] - distance)
    ratio = abs(distance) / threshold if threshold > common[_LEAST] else 0.0
    return threshold + bias, math.sqrt(max(total, 0.0) + more[2]), ratio


@inner
def _downdate(rows: Floats, member: Masks, every: bool, limit: float, work: Floats, removed: Floats) -> bool:
    """Leave out channels one after the other; return whether nothing bounds a fault of them.

    `removed` becomes what they take with them; `work` the rows of what is left, for all channels where `every` says so.
    """
    n, undetectable = rows.shape[1], False
    for i in range(n + 4):
        for k in range(n):
            work[i, k] = rows[i, k]
    for c in range(4):
        removed[c] = 0.0
    for k in range(n):
        if not member[k]:
            continue
        share = work[k, k]
        if share > LEAST_REDUNDANCY:
            for c in range(4):
                removed[c] += work[n, k] * work[n + c, k] / share
            for i in range(n + 4):
                if i != k and (every or i >= n or (i > k and member[i])):
                    ratio = work[i, k] / share
                    for j in range(n):
                        work[i, j] -= ratio * work[k, j]
            for j in range(n):
                work[k, j] = 0.0
        elif abs(work[n, k]) > limit:
            undetectable = True
    return undetectable


@inner
def _with_each_later(
    rows: Floats,
    i: int,
    removed: Floats,
    undetectable: bool,
    common: Floats,
    ranges: _RangeErrors,
    sets: _Sets,
) -> None:
    """Write the sets of channel i and one after it, left out together from the system `rows`.

    `removed` and `undetectable` are of what has been left out of it before.
    """
    n, own, limit = rows.shape[1], ranges.own, common[_LIMIT]
    offset, sigma, ratio = sets.offset, sets.sigma, sets.ratio
    share, of_first = rows[i, i], rows[n, i]
    inverse = 1.0 / share if share > LEAST_REDUNDANCY else 0.0
    weight = inverse * of_first
    undetectable = undetectable or (inverse == 0.0 and abs(of_first) > limit)
    square, distance = removed[0] + weight * of_first, removed[1] + weight * rows[n + 1, i]
    across, up = removed[2] + weight * rows[n + 2, i], removed[3] + weight * rows[n + 3, i]
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
    if not (ranges.any or undetectable or lost):
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
        if undetectable or (not rest > LEAST_REDUNDANCY and abs(of_gain) > limit):
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
    epochs, n = len(model.root_weight), 0
    for t in range(epochs):
        n = max(n, np.count_nonzero(model.root_weight[t] > 0.0))
    width, by_range = asked.bounds[-1], errors.bias_m.shape[1] > 0 or errors.least_sigma_m.shape[1] > 0
    channel, separation = np.empty((epochs, n), dtype=np.intp), np.zeros(epochs)
    tails = _Tails(np.empty((epochs, width)), np.empty((epochs, width)), np.zeros((epochs, width)), np.zeros(width))
    side_by_side, fit, work = _new_channels(n), _new_fit(model.clock_covariance_m2.shape[1]), _new_work(n)
    with_map = _System(np.empty((n + 4, n)), np.zeros(11))
    without_map = _System(np.zeros((n + 4, n)), np.zeros(11))
    for t in range(epochs):
        _choose_channels(model.root_weight[t], side_by_side.number)
        channel[t] = side_by_side.number
        _write_channels(model, errors, asked.prior[t], t, side_by_side)
        _fit_misfits(model, t, side_by_side, fit)
        _write_with_map(model, errors, asked.k_false_alarm[t], t, side_by_side, fit, with_map)
        determined = False
        if np.any(asked.wrong_map):
            determined = _write_without_map(model, errors, t, side_by_side, fit, with_map, without_map)
        for base in range(len(asked.first)):
            if asked.order[t, base] < 0:
                continue
            mapped = asked.wrong_map[base]
            system, undetectable = without_map if mapped else with_map, mapped and not determined
            ranges = _RangeErrors(by_range, system.rows[n], side_by_side.bias, side_by_side.beyond, work.own)
            _write_base(asked, (t, base), side_by_side, system, ranges, undetectable, work, tails)
        for m in range(width):
            if not tails.weight[t, m] > 0.0:
                tails.offset[t, m], tails.sigma[t, m] = 0.0, 1.0
            elif tails.ratio[m] > separation[t]:
                separation[t] = tails.ratio[m]
    return channel, tails.offset, tails.sigma, tails.weight, separation


@inner
def _new_channels(n: int) -> _Channels:
    """Return room for the channels of an epoch."""
    number, clock, of_each = np.zeros(n, dtype=np.intp), np.zeros(n, dtype=np.intp), np.zeros((7, n))
    return _Channels(
        number, of_each[0], clock, of_each[1], of_each[2], of_each[3], of_each[4], of_each[5], of_each[6],
        np.empty((n, n)),
    )  # fmt: skip


@inner
def _new_fit(clocks: int) -> _Fit:
    """Return room for the sums of the misfits."""
    return _Fit(np.empty(clocks), np.empty(3), np.empty(3), np.empty(clocks))


@inner
def _new_work(n: int) -> _Work:
    """Return room for the hypotheses of a base."""
    return _Work(
        np.empty(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_), np.empty(n), np.zeros(4), np.empty(n),
        np.empty((n + 4, n)), np.empty((2, n + 4, n)), np.zeros((3, 4)), np.zeros(3, dtype=np.bool_),
        np.zeros(3, dtype=np.intp), np.zeros(3, dtype=np.intp), np.zeros(3),
    )  # fmt: skip


@inner
def _choose_channels(root: Floats, number: Indices) -> None:
    """Write the numbers of the channels in use, then those of others."""
    at = 0
    for m in range(len(root)):
        if root[m] > 0.0:
            number[at] = m
            at += 1
    for m in range(len(root)):
        if at < len(number) and not root[m] > 0.0:
            number[at] = m
            at += 1


@inner
def _write_channels(model: Any, errors: Any, prior: Floats, t: int, channels: _Channels) -> None:
    """Write the channels of an epoch side by side."""
    n = len(channels.number)
    for i in range(n):
        m = channels.number[i]
        used = model.root_weight[t, m] > 0.0
        channels.root[i] = model.root_weight[t, m] if used else 0.0
        channels.clock[i] = model.clock[m] if used else 0
        channels.along[i] = model.design[t, m, 0] if used else 0.0
        channels.across[i] = model.design[t, m, 1] if used else 0.0
        channels.up[i] = model.design[t, m, 2] if used else 0.0
        channels.prior[i] = prior[m] if used else 0.0
        if errors.bias_m.shape[1] > 0:
            channels.bias[i] = abs(errors.bias_m[t, m]) * channels.root[i]
        if errors.least_sigma_m.shape[1] > 0:
            least = (errors.least_sigma_m[t, m] * channels.root[i]) ** 2
            channels.beyond[i] = max(least - errors.scale[t] ** 2, 0.0) if used else 0.0
    for i in range(n):
        for j in range(n):
            of_clocks = model.clock_covariance_m2[t, channels.clock[i], channels.clock[j]]
            channels.shared[i, j] = channels.root[i] * channels.root[j] * of_clocks


@inner
def _fit_misfits(model: Any, t: int, channels: _Channels, fit: _Fit) -> None:
    """Sum the misfits by clock and axis, and write the step of position and clocks that they imply."""
    fit.by_clock[:] = 0.0
    fit.by_axis[:] = 0.0
    for i in range(len(channels.root)):
        if channels.root[i] > 0.0:
            misfit = model.misfit[t, channels.number[i]]
            fit.by_clock[channels.clock[i]] += channels.root[i] * misfit
            fit.by_axis[0] += misfit * channels.along[i]
            fit.by_axis[1] += misfit * channels.across[i]
            fit.by_axis[2] += misfit * channels.up[i]
    for a in range(3):
        fit.step[a] = 0.0
        for b in range(3):
            fit.step[a] += fit.by_axis[b] * model.covariance_m2[t, b, a]
    for g in range(len(fit.by_clock)):
        fit.of_clocks[g] = 0.0
        for k in range(len(fit.by_clock)):
            fit.of_clocks[g] += model.clock_covariance_m2[t, g, k] * fit.by_clock[k]


@inner
def _spread(channels: _Channels, i: int, covariance: Floats) -> tuple[float, float, float]:
    """Return the covariance of the position times the design of a channel."""
    x, y, z = channels.along[i], channels.across[i], channels.up[i]
    return (
        x * covariance[0, 0] + y * covariance[1, 0] + z * covariance[2, 0],
        x * covariance[0, 1] + y * covariance[1, 1] + z * covariance[2, 1],
        x * covariance[0, 2] + y * covariance[1, 2] + z * covariance[2, 2],
    )


@inner
def _write_projector(channels: _Channels, covariance: Floats, rows: Floats) -> None:
    """Write the projector of the channels by the covariance of the position, and below it their gains."""
    n = len(channels.root)
    for i in range(n):
        along, across, up = _spread(channels, i, covariance)
        for j in range(n):
            by_place = along * channels.along[j] + across * channels.across[j] + up * channels.up[j]
            rows[i, j] = -channels.shared[i, j] - by_place
        rows[i, i] += 1.0 if channels.root[i] > 0.0 else 0.0
        rows[n, i] = along


@inner
def _write_with_map(model: Any, errors: Any, k: float, t: int, channels: _Channels, fit: _Fit, system: _System) -> None:
    """Write the equations of an epoch whose map is right, `k` false alarms' sigmas."""
    n, rows, common, covariance = len(channels.root), system.rows, system.common, model.covariance_m2[t]
    root_across, root_up = math.sqrt(model.prior[1, 1]), math.sqrt(model.prior[2, 2])
    _write_projector(channels, covariance, rows)
    for i in range(n):
        _, across, up = _spread(channels, i, covariance)
        rows[n + 2, i], rows[n + 3, i] = -across * root_across, -up * root_up
        moved = channels.along[i] * fit.step[0] + channels.across[i] * fit.step[1] + channels.up[i] * fit.step[2]
        misfit = model.misfit[t, channels.number[i]] if channels.root[i] > 0.0 else 0.0
        rows[n + 1, i] = misfit - channels.root[i] * fit.of_clocks[channels.clock[i]] - moved
    common[_NOISE], common[_VARIANCE], common[_K] = errors.scale[t] ** 2, covariance[0, 0], k
    common[_MAP_ACROSS], common[_MAP_UP] = -covariance[0, 1] * root_across, -covariance[0, 2] * root_up
    common[_BIAS_ACROSS] = errors.map_bias_m[t, 0] * root_across
    common[_BIAS_UP] = errors.map_bias_m[t, 1] * root_up
    common[_LIMIT] = _NO_EFFECT * math.sqrt(covariance[0, 0])
    of_ranges = _of_ranges(rows[n], _RangeErrors(True, rows[n], channels.bias, channels.beyond, rows[n]))
    common[_LEAST] = k * _SAME * _separate(0.0, 0.0, 0.0, 0.0, of_ranges, common)[1]


@inner
def _write_without_map(
    model: Any, errors: Any, t: int, channels: _Channels, fit: _Fit, with_map: _System, system: _System
) -> bool:
    """Write the equations without the map, and return whether they determine a position.

    Its distance from the position with the map counts whole, and nothing is tested.
    """
    n, rows, common = len(channels.root), system.rows, system.common
    information, variance = errors.map_information[t], errors.scale[t] ** 2
    covariance, determined = _without_map(model.covariance_m2[t], model.prior, information, errors.scale[t])
    for a in range(2):
        for b in range(2):
            fit.by_axis[a + 1] += variance * information[a, b] * errors.map_seen_m[t, b]
    for a in range(3):
        fit.step[a] = -fit.step[a]
        for b in range(3):
            fit.step[a] += covariance[a, b] * fit.by_axis[b]
    shift = fit.step
    _write_projector(channels, covariance, rows)
    for i in range(n):
        moved = channels.along[i] * shift[0] + channels.across[i] * shift[1] + channels.up[i] * shift[2]
        rows[n + 1, i] = with_map.rows[n + 1, i] - moved
    common[_NOISE], common[_VARIANCE], common[_LEAST] = variance, covariance[0, 0], np.inf
    common[_FREE], common[_SHIFT], common[_LIMIT] = 1.0, shift[0], _NO_EFFECT * math.sqrt(covariance[0, 0])
    return determined


@inner
def _write_base(
    asked: Any,
    at: tuple[int, int],
    channels: _Channels,
    system: _System,
    ranges: _RangeErrors,
    undetectable: bool,
    work: _Work,
    tails: _Tails,
) -> None:
    """Write the hypotheses of a base at epoch and base `at`: its shared fault alone, and with channels in addition."""
    (t, base), n, rows = at, len(channels.root), system.rows
    order, first, prior = asked.order[t, base], asked.first[base], asked.shared_prior[t, base]
    some = False
    for i in range(n):
        work.member[i] = channels.root[i] > 0.0 and asked.members[t, base, channels.number[i]]
        work.others[i] = 0.0 if work.member[i] else channels.prior[i]
        some |= work.member[i]
    work.removed[:] = 0.0
    if some:
        undetectable |= _downdate(
            rows, work.member, ranges.any or order > 0, system.common[_LIMIT], work.rows, work.removed
        )
        rows = work.rows
    more = _of_ranges(rows[n], ranges) if ranges.any else (0.0, 0.0, 0.0)
    _write_one(t, first[0], work.removed, more, undetectable, system.common, tails)
    tails.weight[t, first[0]] = prior * (2.0 if first[0] == 0 else 1.0)  # noise passes on either side
    if order > 0:
        _write_singles(t, first[1], _System(rows, system.common), ranges, undetectable, work, tails)
        for i in range(n):
            tails.weight[t, first[1] + i] = prior * work.others[i]
    if order > 1:
        work.start[0], work.product[0], work.undetectable[0] = 0, prior, undetectable
        work.taken[0], work.place[:] = work.removed, first[2:5]
        _write_together(t, order, _System(rows, system.common), ranges, work, tails)


@inner
def _write_one(
    t: int,
    at: int,
    removed: Floats,
    more: tuple[float, float, float],
    undetectable: bool,
    common: Floats,
    tails: _Tails,
) -> None:
    """Write a hypothesis by what it takes with it; without a bound where nothing shows it."""
    tails.offset[t, at], tails.sigma[t, at], tails.ratio[at] = _separate(
        removed[0], removed[1], removed[2], removed[3], more, common
    )
    if undetectable:
        tails.offset[t, at], tails.sigma[t, at], tails.ratio[at] = 0.0, np.inf, 0.0


@inner
def _write_singles(
    t: int, at: int, system: _System, ranges: _RangeErrors, undetectable: bool, work: _Work, tails: _Tails
) -> None:
    """Write the hypotheses of each channel left out of the system, from `at` on."""
    rows, n, limit, removed, whole = system.rows, len(work.own), system.common[_LIMIT], np.empty(4), (0.0, 0.0, 0.0)
    if ranges.any:
        whole = _of_ranges(rows[n], ranges)
    for i in range(n):
        checked, more = rows[i, i] > LEAST_REDUNDANCY, whole
        gain = rows[n, i] / rows[i, i] if checked else 0.0
        if ranges.any:
            for m in range(n):
                work.own[m] = rows[n, m] - gain * rows[i, m]
            more = _of_ranges(work.own, ranges)
        for c in range(4):
            removed[c] = work.removed[c] + gain * rows[n + c, i]
        _write_one(
            t, at + i, removed, more, undetectable or (not checked and abs(rows[n, i]) > limit), system.common, tails
        )


@inner
def _write_together(t: int, order: int, system: _System, ranges: _RangeErrors, work: _Work, tails: _Tails) -> None:
    """Write sets of two and more: all but the last channel are left out one after the other, `depth` so far."""
    n, limit, depth = len(work.own), system.common[_LIMIT], 0
    while depth >= 0:
        i = work.start[depth]
        if i == n:
            depth -= 1
            continue
        work.start[depth] += 1
        rows = system.rows if depth == 0 else work.reduced[depth - 1]
        begin, end = work.place[depth], work.place[depth] + n - 1 - i
        sets = _Sets(tails.offset[t, begin:end], tails.sigma[t, begin:end], tails.ratio[begin:end])
        _with_each_later(rows, i, work.taken[depth], work.undetectable[depth], system.common, ranges, sets)
        with_first = work.product[depth] * work.others[i]
        for j in range(i + 1, n):
            tails.weight[t, begin + j - i - 1] = with_first * work.others[j]
        work.place[depth] = end
        if order > depth + 2:
            work.single[i] = True
            undetectable = _downdate(rows, work.single, True, limit, work.reduced[depth], work.taken[depth + 1])
            work.single[i] = False
            work.taken[depth + 1] += work.taken[depth]
            work.start[depth + 1], work.product[depth + 1] = i + 1, with_first
            work.undetectable[depth + 1] = undetectable or work.undetectable[depth]
            depth += 1


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

"""Distribution of the position error under each fault hypothesis."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.constants import LEAST_REDUNDANCY
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.level_equations import (
    LIMIT,
    Channels,
    RangeErrors,
    System,
    choose_channels,
    fit_misfits,
    new_channels,
    new_fit,
    of_ranges,
    separate,
    write_channels,
    write_with_map,
    write_without_map,
)


class _Tails(NamedTuple):
    """Offset and sigma of the error, and weight of K hypotheses, shape (T, K); separation / threshold, shape (K,)."""

    offset: Floats
    sigma: Floats
    weight: Floats
    ratio: Floats


class _Work(NamedTuple):
    """Work arrays for the hypothesis with one shared fault (base), and for those that add faulty channels to it.

    `member` are the channels of the base, shape (n,), and `rows` the system without the base, shape (n + 4, n).
    `others` are the fault priors of the other channels, shape (n,). `removed` is the effect of excluding the base,
    shape (4,). `single` and `own` are work space, shape (n,). The first index of the other fields is the number of
    further excluded channels: `reduced`, shape (2, n + 4, n), is the system and `taken`, shape (3, 4), the effect; the
    flag `undetectable`, next channel `start`, output index `place` and `product` of priors have shape (3,).
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
    """Offset, sigma, and ratio of separation to threshold, each for several sets of excluded channels."""

    offset: Floats
    sigma: Floats
    ratio: Floats


@inner
def _downdate(rows: Floats, member: Masks, every: bool, limit: float, work: Floats, removed: Floats) -> bool:
    """Exclude the channels `member` one after another; return True if a fault of all of them is undetectable.

    The effect of the channels is written to `removed`, and the remaining system to `work`. The rows of channels in
    `work` are complete only if `every` is True.
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
    ranges: RangeErrors,
    sets: _Sets,
) -> None:
    """Write the results of excluding channel i and one later channel from the system `rows`, for each later channel.

    `removed` and `undetectable` describe the channels that are already excluded.
    """
    n, own, limit = rows.shape[1], ranges.own, common[LIMIT]
    offset, sigma, ratio = sets.offset, sets.sigma, sets.ratio
    first = rows[i, i] > LEAST_REDUNDANCY
    inverse = 1.0 / rows[i, i] if first else 0.0
    weight = inverse * rows[n, i]
    undetectable = undetectable or (not first and abs(rows[n, i]) > limit)
    with_first, taken, more = np.empty(4), np.empty(4), (0.0, 0.0, 0.0)
    for c in range(4):
        with_first[c] = removed[c] + weight * rows[n + c, i]
    for at in range(n - 1 - i):
        j = i + 1 + at
        coupling = inverse * rows[i, j]
        gain, rest = rows[n, j] - coupling * rows[n, i], rows[j, j] - coupling * rows[i, j]
        checked = rest > LEAST_REDUNDANCY
        last = gain / rest if checked else 0.0
        for c in range(4):
            taken[c] = with_first[c] + last * (rows[n + c, j] - coupling * rows[n + c, i])
        if ranges.any:
            for m in range(n):
                own[m] = rows[n, m] - weight * rows[i, m] - last * (rows[j, m] - coupling * rows[i, m])
            more = of_ranges(own, ranges)
        offset[at], sigma[at], ratio[at] = separate(taken[0], taken[1], taken[2], taken[3], more, common)
        if undetectable or (not checked and abs(gain) > limit):
            offset[at], sigma[at], ratio[at] = 0.0, np.inf, 0.0


@kernel
def tails_of_hypotheses(model: Any, errors: Any, asked: Any) -> tuple[Indices, Floats, Floats, Floats, Floats]:
    """Return the position error distribution of all hypotheses for a block of epochs.

    Returns
    -------
    channel : ndarray of int, shape (T, n)
        Indices of the channels, with channels in use first.
    offset_m, sigma_m, weight : ndarray, shape (T, K)
        Arguments of `level.solve_level`. The offset is threshold plus bias. Sigma is infinite for undetectable faults.
        The weight is the prior probability.
    separation : ndarray, shape (T,)
        Field of `ProtectionLevel`.
    """
    epochs, n = len(model.root_weight), 0
    for t in range(epochs):
        n = max(n, int(np.count_nonzero(model.root_weight[t] > 0.0)))
    width, by_range = asked.bounds[-1], errors.bias_m.shape[1] > 0 or errors.least_sigma_m.shape[1] > 0
    channel, separation = np.empty((epochs, n), dtype=np.intp), np.zeros(epochs)
    tails = _Tails(np.empty((epochs, width)), np.empty((epochs, width)), np.zeros((epochs, width)), np.zeros(width))
    side_by_side, fit, work = new_channels(n), new_fit(model.clock_covariance_m2.shape[1]), _new_work(n)
    with_map = System(np.empty((n + 4, n)), np.zeros(11))
    without_map = System(np.zeros((n + 4, n)), np.zeros(11))
    for t in range(epochs):
        choose_channels(model.root_weight[t], side_by_side.number)
        channel[t] = side_by_side.number
        write_channels(model, errors, asked.prior[t], t, side_by_side)
        fit_misfits(model, t, side_by_side, fit)
        write_with_map(model, errors, asked.k_false_alarm[t], t, side_by_side, fit, with_map)
        determined = False
        if np.any(asked.wrong_map):
            determined = write_without_map(model, errors, t, side_by_side, fit, with_map, without_map)
        for base in range(len(asked.first)):
            if asked.order[t, base] < 0:
                continue
            mapped = asked.wrong_map[base]
            system, undetectable = without_map if mapped else with_map, mapped and not determined
            ranges = RangeErrors(by_range, system.rows[n], side_by_side.bias, side_by_side.beyond, work.own)
            _write_base(asked, (t, base), side_by_side, system, ranges, undetectable, work, tails)
        for m in range(width):
            if not tails.weight[t, m] > 0.0:
                tails.offset[t, m], tails.sigma[t, m] = 0.0, 1.0
            elif tails.ratio[m] > separation[t]:
                separation[t] = tails.ratio[m]
    return channel, tails.offset, tails.sigma, tails.weight, separation


@inner
def _new_work(n: int) -> _Work:
    """Allocate the work arrays."""
    return _Work(
        np.empty(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_), np.empty(n), np.zeros(4), np.empty(n),
        np.empty((n + 4, n)), np.empty((2, n + 4, n)), np.zeros((3, 4)), np.zeros(3, dtype=np.bool_),
        np.zeros(3, dtype=np.intp), np.zeros(3, dtype=np.intp), np.zeros(3),
    )  # fmt: skip


@inner
def _write_base(
    asked: Any,
    at: tuple[int, int],
    channels: Channels,
    system: System,
    ranges: RangeErrors,
    undetectable: bool,
    work: _Work,
    tails: _Tails,
) -> None:
    """Write the hypotheses at `at` (epoch, base): the shared fault alone, and combined with further faulty channels."""
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
            rows, work.member, ranges.any or order > 0, system.common[LIMIT], work.rows, work.removed
        )
        rows = work.rows
    more = of_ranges(rows[n], ranges) if ranges.any else (0.0, 0.0, 0.0)
    _write_one(t, first[0], work.removed, more, undetectable, system.common, tails)
    tails.weight[t, first[0]] = prior * (2.0 if first[0] == 0 else 1.0)  # noise has either sign
    if order > 0:
        _write_singles(t, first[1], System(rows, system.common), ranges, undetectable, work, tails)
        for i in range(n):
            tails.weight[t, first[1] + i] = prior * work.others[i]
    if order > 1:
        work.start[0], work.product[0], work.undetectable[0] = 0, prior, undetectable
        work.taken[0], work.place[:] = work.removed, first[2:5]
        _write_together(t, order, System(rows, system.common), ranges, work, tails)


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
    """Write offset, sigma and ratio of hypothesis `at` to `tails`, from the effect of excluding its channels. The sigma
    is infinite if the fault is undetectable.
    """
    tails.offset[t, at], tails.sigma[t, at], tails.ratio[at] = separate(
        removed[0], removed[1], removed[2], removed[3], more, common
    )
    if undetectable:
        tails.offset[t, at], tails.sigma[t, at], tails.ratio[at] = 0.0, np.inf, 0.0


@inner
def _write_singles(
    t: int, at: int, system: System, ranges: RangeErrors, undetectable: bool, work: _Work, tails: _Tails
) -> None:
    """Write the hypotheses in which one further channel is excluded, from index `at` on."""
    rows, n, limit, removed, whole = system.rows, len(work.own), system.common[LIMIT], np.empty(4), (0.0, 0.0, 0.0)
    if ranges.any:
        whole = of_ranges(rows[n], ranges)
    for i in range(n):
        checked, more = rows[i, i] > LEAST_REDUNDANCY, whole
        gain = rows[n, i] / rows[i, i] if checked else 0.0
        if ranges.any:
            for m in range(n):
                work.own[m] = rows[n, m] - gain * rows[i, m]
            more = of_ranges(work.own, ranges)
        for c in range(4):
            removed[c] = work.removed[c] + gain * rows[n + c, i]
        _write_one(
            t, at + i, removed, more, undetectable or (not checked and abs(rows[n, i]) > limit), system.common, tails
        )


@inner
def _write_together(t: int, order: int, system: System, ranges: RangeErrors, work: _Work, tails: _Tails) -> None:
    """Write the hypotheses with two or more further channels; the last two are excluded in one step."""
    n, limit, depth = len(work.own), system.common[LIMIT], 0
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

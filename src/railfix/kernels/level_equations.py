"""Equations of an epoch for fault hypotheses: projector, gains and residuals of the channels."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.kernels.compiling import inner

#: Smallest effect of a satellite on the position, in position sigmas; smaller effects are taken as zero.
_NO_EFFECT = 1e-6
#: Smallest separation, as a fraction of sigma; smaller separations are taken as zero.
_SAME = 1e-9
#: Indices in `System.common`: squared noise scale; variance along the line; response of the position to map errors
#: across, and up; mean map error across, and up; false-alarm threshold in sigmas; smallest tested threshold; 1 if the
#: equations exclude the map, else 0; displacement of the position without the map; smallest relevant gain.
_NOISE, _VARIANCE, _MAP_ACROSS, _MAP_UP, _BIAS_ACROSS, _BIAS_UP, _K, _LEAST, _FREE, _SHIFT, LIMIT = range(11)


class Channels(NamedTuple):
    """Contiguous arrays of one epoch's channels, shape (n,), with channels in use first and zeros for the others."""

    number: Indices  #: Index of each channel in the model.
    root: Floats  #: Square root of the weight [1/m].
    clock: Indices
    along: Floats  #: Whitened design.
    across: Floats
    up: Floats
    prior: Floats  #: Prior fault probability of each channel.
    bias: Floats  #: Whitened mean error.
    beyond: Floats  #: Whitened variance of errors other than the noise.
    shared: Floats  #: Whitened covariance of each pair of channels due to shared clocks, shape (n, n).


class System(NamedTuple):
    """Equations of one epoch.

    `rows`, shape (n + 4, n), is the projector of the channels, followed by one row each of gains, residuals, and
    responses to map errors across and up. `common`, shape (11,), has the values common to all channels.
    """

    rows: Floats
    common: Floats


class _Fit(NamedTuple):
    """Misfits summed by clock, shape (C,), and by axis, shape (3,), and the resulting steps of position and clocks."""

    by_clock: Floats
    by_axis: Floats
    step: Floats
    of_clocks: Floats


class RangeErrors(NamedTuple):
    """Additional errors of individual ranges: `bias` and variance `beyond`; `any` is True if there are such errors.

    `gain` has the gains of the ranges before exclusions. `own` is work space for gains after exclusions.
    """

    any: bool
    gain: Floats
    bias: Floats
    beyond: Floats
    own: Floats


@inner
def of_ranges(left: Floats, ranges: RangeErrors) -> tuple[float, float, float]:
    """Return bias, separation variance and position variance that range errors cause for the gains `left`."""
    bias, apart, total = 0.0, 0.0, 0.0
    for m in range(len(left)):
        bias += abs(left[m]) * ranges.bias[m]
        apart += (left[m] - ranges.gain[m]) ** 2 * ranges.beyond[m]
        total += left[m] ** 2 * ranges.beyond[m]
    return bias, apart, total


@inner
def separate(
    square: float, distance: float, across: float, up: float, more: tuple[float, float, float], common: Floats
) -> tuple[float, float, float]:
    """Return offset, sigma, and ratio of separation to threshold for the effect of a set of excluded channels."""
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
def new_channels(n: int) -> Channels:
    """Allocate the arrays for the channels of one epoch."""
    number, clock, of_each = np.zeros(n, dtype=np.intp), np.zeros(n, dtype=np.intp), np.zeros((7, n))
    return Channels(
        number, of_each[0], clock, of_each[1], of_each[2], of_each[3], of_each[4], of_each[5], of_each[6],
        np.empty((n, n)),
    )  # fmt: skip


@inner
def new_fit(clocks: int) -> _Fit:
    """Allocate the arrays for sums of misfits."""
    return _Fit(np.empty(clocks), np.empty(3), np.empty(3), np.empty(clocks))


@inner
def choose_channels(root: Floats, number: Indices) -> None:
    """Write the indices of the used channels, then the indices of the unused channels."""
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
def write_channels(model: Any, errors: Any, prior: Floats, t: int, channels: Channels) -> None:
    """Write one epoch's channel data in the order of `channels.number`."""
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
def fit_misfits(model: Any, t: int, channels: Channels, fit: _Fit) -> None:
    """Sum the misfits by clock and axis, and write the implied steps of position and clocks."""
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
def _spread(channels: Channels, i: int, covariance: Floats) -> tuple[float, float, float]:
    """Return the product of a channel's design vector and the position covariance."""
    x, y, z = channels.along[i], channels.across[i], channels.up[i]
    return (
        x * covariance[0, 0] + y * covariance[1, 0] + z * covariance[2, 0],
        x * covariance[0, 1] + y * covariance[1, 1] + z * covariance[2, 1],
        x * covariance[0, 2] + y * covariance[1, 2] + z * covariance[2, 2],
    )


@inner
def _write_projector(channels: Channels, covariance: Floats, rows: Floats) -> None:
    """Write the projector of the channels for a position covariance, and the row of gains below the projector."""
    n = len(channels.root)
    for i in range(n):
        along, across, up = _spread(channels, i, covariance)
        for j in range(n):
            by_place = along * channels.along[j] + across * channels.across[j] + up * channels.up[j]
            rows[i, j] = -channels.shared[i, j] - by_place
        rows[i, i] += 1.0 if channels.root[i] > 0.0 else 0.0
        rows[n, i] = along


@inner
def write_with_map(model: Any, errors: Any, k: float, t: int, channels: Channels, fit: _Fit, system: System) -> None:
    """Write the equations of an epoch for a correct map; `k` is the false-alarm threshold in sigmas."""
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
    common[LIMIT] = _NO_EFFECT * math.sqrt(covariance[0, 0])
    more = of_ranges(rows[n], RangeErrors(True, rows[n], channels.bias, channels.beyond, rows[n]))
    common[_LEAST] = k * _SAME * separate(0.0, 0.0, 0.0, 0.0, more, common)[1]


@inner
def write_without_map(
    model: Any, errors: Any, t: int, channels: Channels, fit: _Fit, with_map: System, system: System
) -> bool:
    """Write the equations without the map, and return True if these equations determine a position.

    Separations are not tested. Offsets include the full distance between the positions with and without the map.
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
    common[_FREE], common[_SHIFT], common[LIMIT] = 1.0, shift[0], _NO_EFFECT * math.sqrt(covariance[0, 0])
    return determined


@inner
def _without_map(covariance: Floats, prior: Floats, information: Floats, scale: float) -> tuple[Floats, bool]:
    """Return the position covariance for `information` instead of the map prior, and True if the covariance exists."""
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
    """Return the inverse of a symmetric 3 x 3 matrix, and True if, scaled to a unit diagonal, it is regular."""
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

"""How far, and how surely, the position moves without one satellite, a pair, or a constellation.

With the whitened model of `raim` (residuals ``nu``, their projector S, gains g of the along-track
position x) leaving out the channels J moves the position by ``x_J - x = -g_J^T S_JJ^-1 nu_J``, with
variance ``g_J^T S_JJ^-1 g_J``, which is also what J took off the variance of the position:
``sigma_J^2 = sigma_0^2 + var(x_J - x)``. Nothing is solved again.

The noise scale s multiplies the ranges, not the map error. Of each variance the part of the map, |a|^2
with a the response of the position to one sigma across and up, is therefore taken apart:
``s^2 (var - |a|^2) + |a|^2``, and ``a_J = a + sum c_j u_j``, ``c = S_JJ^-1 g_J``, u_j what a channel has of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.integrity.raim.exclusion import LEAST_REDUNDANCY
from railfix.integrity.raim.model import LinearModel, compact, regular_inverse

#: Effect on the position, in its own sigmas, below which a satellite has none.
NO_EFFECT: Final = 1e-6


@dataclass(frozen=True)
class AllInView:
    """The position of all satellites: T epochs, n channels in use side by side."""

    channel: Indices  # (T, n) channel of the model
    used: Masks  # (T, n)
    projector: Floats  # (T, n, n)
    residual: Floats  # (T, n)
    gain_m: Floats  # (T, n)
    map_gain_m: Floats  # (T, n, 2) what each channel has of the response to the map error
    map_m: Floats  # (T, 2) response to one sigma of map error across and up
    variance_m2: Floats  # (T,) of the weights, scale 1
    scale: Floats  # (T,)
    range_bias: Floats | None  # (T, n) largest nominal bias of each range, over its sigma
    beyond: (
        Floats | None
    )  # (T, n) variance of each range beyond that of its weight and the scale, over that of its weight
    map_bias: Floats  # (T, 2) offset of the map across and up, over the sigma of the map error

    @property
    def sigma_m(self) -> Floats:
        """Standard deviation, shape (T,)."""
        variance = scaled(self.variance_m2, self.map_m, self.scale)
        if self.beyond is not None:
            variance = variance + (self.gain_m**2 * self.beyond).sum(axis=1)
        return np.sqrt(variance)

    @property
    def by_range(self) -> bool:
        """Whether the gains of single ranges are needed."""
        return self.range_bias is not None or self.beyond is not None

    @property
    def bias_m(self) -> Floats:
        """Largest movement by nominal biases, and that by the offset of the map, shape (T,)."""
        of_map = np.abs((self.map_m * self.map_bias).sum(axis=1))
        if self.range_bias is None:
            return np.asarray(of_map)
        return np.asarray(of_map + (np.abs(self.gain_m) * self.range_bias).sum(axis=1))


@dataclass(frozen=True)
class Separations:
    """Positions without each of K subsets, T epochs by K; sigma infinite where the rest does not determine one."""

    sigma_m: Floats  # of the position without the subset
    separation_sigma_m: Floats  # of its distance from the position of all
    moved_m: Floats  # that distance, signed
    bias_m: Floats  # its largest movement by nominal biases


def scaled(variance_m2: Floats, map_m: Floats, scale: Floats) -> Floats:
    """Variance with the noise scale, of one without (last axis of `map_m` is across and up)."""
    from_map = map_m[..., 0] ** 2 + map_m[..., 1] ** 2
    variance = variance_m2 - from_map
    variance *= scale**2 if variance_m2.ndim == 1 else scale[:, None] ** 2
    variance += from_map
    return np.maximum(variance, 0.0, out=variance)


def all_in_view(
    model: LinearModel,
    scale: Floats,
    bias_m: Floats | None,
    map_bias_m: Floats | None = None,
    least_sigma_m: Floats | None = None,
) -> AllInView:
    """The parts that every subset asks for.

    Parameters
    ----------
    model : LinearModel
        T epochs with a position, on the line.
    scale : ndarray, shape (T,)
    bias_m : ndarray, shape (T, M) [m], or None
    map_bias_m : ndarray, shape (T, 2) [m], or None
    least_sigma_m : ndarray, shape (T, M) [m], or None
        Least standard deviation of each range; none: that of its weight times the scale.
    """
    parts = compact(model)
    root = np.sqrt(np.einsum("ii->i", model.prior))[1:]
    gain = np.take_along_axis(model.design @ model.covariance_m2, parts.channel[..., None], axis=1)
    range_bias = None
    if bias_m is not None:
        range_bias = np.take_along_axis(np.abs(bias_m) * model.root_weight, parts.channel, axis=1)
        range_bias = np.where(parts.used, range_bias, 0.0)
    beyond = None
    if least_sigma_m is not None:
        least = np.take_along_axis(np.where(model.used, least_sigma_m * model.root_weight, 0.0), parts.channel, axis=1)
        beyond = np.where(parts.used, np.maximum(least**2 - scale[:, None] ** 2, 0.0), 0.0)
    return AllInView(
        channel=parts.channel,
        used=parts.used,
        projector=parts.projector,
        residual=parts.residual,
        gain_m=parts.gain_m[..., 0],
        map_gain_m=-gain[..., 1:] * root,
        map_m=-model.covariance_m2[:, 0, 1:] * root,
        variance_m2=model.covariance_m2[:, 0, 0],
        scale=scale,
        range_bias=range_bias,
        beyond=beyond,
        map_bias=np.zeros((len(model), 2)) if map_bias_m is None else map_bias_m * root,
    )


def without_one(full: AllInView) -> Separations:
    """Each channel left out, K = n."""
    share, gain = np.einsum("tii->ti", full.projector), full.gain_m
    checked = share > LEAST_REDUNDANCY
    weight = np.where(checked, gain / np.where(checked, share, 1.0), 0.0)
    blind = ~checked & (np.abs(gain) > NO_EFFECT * np.sqrt(full.variance_m2)[:, None])
    left = gain[:, None, :] - weight[:, :, None] * full.projector if full.by_range else None
    return separations(full, weight * gain, weight[..., None] * full.map_gain_m, -weight * full.residual, left, blind)


def without_two(full: AllInView, first: Indices, second: Indices) -> Separations:
    """Pairs of places (K,) in the compact arrays left out.

    Two that only check each other (both of a clock of their own) have a singular S_JJ. Where the error
    that no residual shows does not move the position, what the residuals show of the pair is used; where it
    does, nothing bounds it.
    """
    n, gain = full.channel.shape[1], full.gain_m
    share = np.einsum("tii->ti", full.projector)
    a, c = share[:, first], share[:, second]
    b = np.take(full.projector.reshape(-1, n * n), first * n + second, axis=1)
    gain_1, gain_2 = gain[:, first], gain[:, second]
    product = a * c
    determinant = product - b * b
    regular = (np.minimum(a, c) > LEAST_REDUNDANCY) & (determinant > LEAST_REDUNDANCY * product)
    inverse = 1.0 / np.where(regular, determinant, 1.0)
    weight_1, weight_2 = (c * gain_1 - b * gain_2) * inverse, (a * gain_2 - b * gain_1) * inverse
    blind = np.zeros(regular.shape, dtype=bool)
    if not regular.all():
        t, k = np.nonzero(~regular)
        # S_JJ = (x, y)(x, y)^T; (y, -x) is what no residual shows.
        x, y = np.sqrt(np.maximum(a[t, k], 0.0)), np.copysign(np.sqrt(np.maximum(c[t, k], 0.0)), b[t, k])
        size = x**2 + y**2
        seen = size > LEAST_REDUNDANCY
        hidden = np.where(seen, np.abs(y * gain_1[t, k] - x * gain_2[t, k]), np.hypot(gain_1[t, k], gain_2[t, k]))
        limit = NO_EFFECT * np.sqrt(full.variance_m2[t]) * np.where(seen, np.sqrt(size), 1.0)
        blind[t, k] = hidden > limit
        shown = np.where(seen, (x * gain_1[t, k] + y * gain_2[t, k]) / np.where(seen, size, 1.0) ** 2, 0.0)
        weight_1[t, k], weight_2[t, k] = x * shown, y * shown
    moved = -(weight_1 * full.residual[:, first] + weight_2 * full.residual[:, second])
    # Across and up are each contiguous, as all sums run over the pairs.
    response = np.moveaxis(np.empty((2, *weight_1.shape)), 0, -1)
    for axis in range(2):
        of_map = np.ascontiguousarray(full.map_gain_m[..., axis])
        np.multiply(weight_1, of_map[:, first], out=response[..., axis])
        response[..., axis] += weight_2 * of_map[:, second]
    left = None
    if full.by_range:
        left = gain[:, None, :] - weight_1[..., None] * full.projector[:, first]
        left -= weight_2[..., None] * full.projector[:, second]
    return separations(full, weight_1 * gain_1 + weight_2 * gain_2, response, moved, left, blind)


def without_three(full: AllInView, members: Indices) -> Separations:
    """Triples of places (K, 3) in the compact arrays left out.

    Where S_JJ is singular (satellites of a clock of their own), the direction that no residual shows must not move
    the position; where it does, nothing bounds it.
    """
    n, gain = full.channel.shape[1], full.gain_m
    flat = full.projector.reshape(-1, n * n)
    i, j, k = members.T
    a, b, c = (np.take(flat, m * n + m, axis=1) for m in (i, j, k))
    d, e, f = (np.take(flat, m * n + o, axis=1) for m, o in ((i, j), (i, k), (j, k)))
    # Cofactors of the symmetric matrix [[a, d, e], [d, b, f], [e, f, c]].
    aa, bb, cc = b * c - f * f, a * c - e * e, a * b - d * d
    dd, ee, ff = e * f - c * d, d * f - b * e, d * e - a * f
    determinant = a * aa + d * dd + e * ee
    least = np.minimum(np.minimum(a, b), c)
    regular = (least > LEAST_REDUNDANCY) & (determinant > LEAST_REDUNDANCY * a * b * c)
    inverse = 1.0 / np.where(regular, determinant, 1.0)
    gain_1, gain_2, gain_3 = gain[:, i], gain[:, j], gain[:, k]
    weights = np.stack(
        [
            aa * gain_1 + dd * gain_2 + ee * gain_3,
            dd * gain_1 + bb * gain_2 + ff * gain_3,
            ee * gain_1 + ff * gain_2 + cc * gain_3,
        ]
    )
    weights *= inverse
    used = full.used[:, i] & full.used[:, j] & full.used[:, k]
    blind = np.zeros(regular.shape, dtype=bool)
    t, at = np.nonzero(~regular & used)
    if len(t):
        places = members[at]
        part = full.projector[t[:, None, None], places[:, :, None], places[:, None, :]]
        values, vectors = np.linalg.eigh(part)
        shown = values > LEAST_REDUNDANCY
        share = np.einsum("sij,si->sj", vectors, np.take_along_axis(gain[t], places, axis=1))
        hidden = np.sqrt((np.where(shown, 0.0, share) ** 2).sum(axis=1))
        blind[t, at] = hidden > NO_EFFECT * np.sqrt(full.variance_m2[t])
        solved = np.where(shown, share / np.where(shown, values, 1.0), 0.0)
        weights[:, t, at] = np.einsum("sij,sj->is", vectors, solved)
    square, moved, left = np.zeros(gain_1.shape), np.zeros(gain_1.shape), None
    response = np.zeros((*gain_1.shape, 2))
    for place, weight in zip((i, j, k), weights, strict=True):
        square += weight * gain[:, place]
        moved -= weight * full.residual[:, place]
        response += weight[..., None] * full.map_gain_m[:, place]
    if full.by_range:
        left = np.repeat(gain[:, None, :], len(members), axis=1)
        for place, weight in zip((i, j, k), weights, strict=True):
            left -= weight[..., None] * full.projector[:, place]
    return separations(full, np.maximum(square, 0.0), response, moved, left, blind)


def without_constellation(model: LinearModel, members: Masks, full: AllInView) -> Separations:
    """A whole constellation left out, K = 1: the information of the rest, inverted (3 x 3).

    Its channels share a clock. With ``S' = I - R K R^T`` of the clocks alone, r the 1/sigma of the members
    and kappa the variance of their clock, ``S'_JJ = I - kappa r r^T``, and the information that goes is
    ``B_J^T S'_JJ^-1 B_J``. Where the clock is theirs alone r is what no residual shows, and moves nothing.

    Parameters
    ----------
    model : LinearModel
        T epochs.
    members : ndarray of bool, shape (M,)
    full : AllInView
        Of this model.
    """
    clock = int(model.clock[members][0])
    root = np.where(members, model.root_weight, 0.0)
    design = model.design * members[:, None]
    kappa, mass = model.clock_covariance_m2[:, clock, clock], (root**2).sum(axis=1)
    alone = 1.0 - kappa * mass <= LEAST_REDUNDANCY
    more = np.where(alone, 0.0, kappa / np.where(alone, 1.0, 1.0 - kappa * mass))
    pull = np.matmul(root[:, None, :], design)[:, 0]  # B_J^T r
    gone = design.swapaxes(1, 2) @ design + more[:, None, None] * pull[:, :, None] * pull[:, None, :]
    covariance = model.covariance_m2
    left = np.eye(3) - covariance @ gone
    blind = ~(np.linalg.det(left) > LEAST_REDUNDANCY)
    left[blind] = np.eye(3)
    row = np.linalg.solve(left, covariance[:, :, :1])[..., 0]  # first row of the covariance without them
    # Misfits with the clocks taken out, and what they ask of the place without the members.
    misfit = model.residual + np.matmul(model.design, model.step_m[..., None])[..., 0]
    own = np.where(members, misfit, 0.0)
    ask = np.matmul(model.misfit[:, None, :], model.design)[:, 0] - np.matmul(own[:, None, :], design)[:, 0]
    ask -= (more * (root * own).sum(axis=1))[:, None] * pull
    moved = (row * ask).sum(axis=1) - model.step_m[:, 0]
    prior = np.sqrt(np.einsum("ii->i", model.prior))[1:]
    kept = None
    if full.by_range:
        between = model.clock_covariance_m2[:, clock][:, model.clock] * model.root_weight
        response = np.matmul(model.design, row[..., None])[..., 0]
        response += ((1.0 + more * mass) * (row * pull).sum(axis=1))[:, None] * between
        kept = np.take_along_axis(np.where(members, 0.0, response), full.channel, axis=1)[:, None]
    return separations(
        full,
        (row[:, 0] - covariance[:, 0, 0])[:, None],
        (-row[:, 1:] * prior - full.map_m)[:, None],
        moved[:, None],
        kept,
        blind[:, None],
    )


def without_map(
    full: AllInView, model: LinearModel, seen_m: Floats, information: Floats
) -> tuple[Separations, Separations]:
    """The map left out, alone (K = 1) and with each channel (K = n).

    What takes the place of the map is its offset as the positions in space of the last minutes show it. Without one
    the position is that in space. The distance from the position of all is computed and counts whole, so that nothing
    is left to be tested.

    Parameters
    ----------
    full : AllInView
    model : LinearModel
    seen_m : ndarray, shape (T, 2) [m]
        Place of the antenna across and above the line over minutes; any finite value where nothing is known.
    information : ndarray, shape (T, 2, 2) [1/m^2]
        Inverse covariance of that; 0 where nothing is known.
    """
    square = full.scale[:, None, None] ** 2
    of_map = np.zeros((len(model), 3, 3))
    of_map[:, 1:, 1:] = square * information
    normal = np.linalg.inv(model.covariance_m2) - model.prior
    covariance = regular_inverse(normal + of_map)
    blind: Masks = np.asarray(~np.isfinite(covariance).all(axis=(1, 2)))
    covariance = np.where(blind[:, None, None], np.eye(3), covariance)
    ask = np.matmul(model.misfit[:, None, :], model.design)[:, 0]
    ask[:, 1:] += np.einsum("tij,tj->ti", of_map[:, 1:, 1:], seen_m)
    shift = np.einsum("tij,tj->ti", covariance, ask) - model.step_m
    parts = compact(replace(model, covariance_m2=covariance))
    residual = model.residual - np.einsum("tmi,ti->tm", model.design, shift)
    nothing = np.zeros((len(model), 2))
    free = replace(
        full,
        projector=parts.projector,
        residual=np.where(parts.used, np.take_along_axis(residual, parts.channel, axis=1), 0.0),
        gain_m=parts.gain_m[..., 0],
        map_gain_m=np.zeros(full.map_gain_m.shape),
        map_m=nothing,
        variance_m2=covariance[:, 0, 0],
        map_bias=nothing,
    )
    one = without_one(free)
    alone = Separations(
        sigma_m=np.where(blind, np.inf, free.sigma_m)[:, None],
        separation_sigma_m=np.zeros((len(model), 1)),
        moved_m=np.zeros((len(model), 1)),
        bias_m=np.where(blind, 0.0, np.abs(shift[:, 0]) + free.bias_m)[:, None],
    )
    with_one = Separations(
        sigma_m=np.where(blind[:, None], np.inf, one.sigma_m),
        separation_sigma_m=np.zeros(one.moved_m.shape),
        moved_m=np.zeros(one.moved_m.shape),
        bias_m=np.where(np.isfinite(one.sigma_m), np.abs(shift[:, :1] + one.moved_m) + one.bias_m, 0.0),
    )
    return alone, with_one


def separations(
    full: AllInView, square: Floats, response: Floats, moved: Floats, left: Floats | None, blind: Masks
) -> Separations:
    """From variance of the distance (T, K), response to the map error (T, K, 2), gains of what is left (T, K, n)."""
    whole_response = full.map_m[:, None] + response
    apart = scaled(square, response, full.scale)
    total = scaled(full.variance_m2[:, None] + square, whole_response, full.scale)
    bias = whole_response[..., 0] * full.map_bias[:, :1] + whole_response[..., 1] * full.map_bias[:, 1:]
    np.abs(bias, out=bias)
    if left is not None and full.range_bias is not None:
        bias = bias + np.einsum("tki,ti->tk", np.abs(left), full.range_bias)
    if left is not None and full.beyond is not None:
        apart = apart + np.einsum("tki,ti->tk", (left - full.gain_m[:, None]) ** 2, full.beyond)
        total = total + np.einsum("tki,ti->tk", left**2, full.beyond)
    np.sqrt(total, out=total)
    np.sqrt(apart, out=apart)
    if blind.any():
        total[blind], apart[blind], moved[blind], bias[blind] = np.inf, np.inf, 0.0, 0.0
    return Separations(sigma_m=total, separation_sigma_m=apart, moved_m=moved, bias_m=bias)

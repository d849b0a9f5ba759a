"""The level's hypotheses in numpy, all sets of channels side by side: what the compiled loop is held against.

How far, and how surely, the position moves without some satellites, those of a shared fault, or the map.

With the whitened model of `raim` (residuals ``nu``, their projector S, gains g of the along-track
position x) leaving out the channels J moves the position by ``x_J - x = -g_J^T S_JJ^-1 nu_J``, with
variance ``g_J^T S_JJ^-1 g_J``, which is also what J took off the variance of the position:
``sigma_J^2 = sigma_0^2 + var(x_J - x)``. Nothing is solved again.

The noise scale s multiplies the ranges, not the map error. Of each variance the part of the map, |a|^2
with a the response of the position to one sigma across and up, is therefore taken apart:
``s^2 (var - |a|^2) + |a|^2``, and ``a_J = a + sum c_j u_j``, ``c = S_JJ^-1 g_J``, u_j what a channel has of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.constants import LEAST_REDUNDANCY
from railfix.integrity.protection.solution_separation import Asked, Errors
from railfix.integrity.raim.position_model import LinearModel, ModelArrays, compact

#: Effect on the position, in its own sigmas, below which a satellite has none.
NO_EFFECT: Final = 1e-6
#: Separations below this share of sigma are none.
_SAME: Final = 1e-9


def one_after_the_other(columns: Floats, members: Masks) -> tuple[Floats, Floats, Masks]:
    """Leave out a group of channels, each from what those before it leave.

    `columns`, shape (T, n, n + c): projector of the residuals, and what changes alike. Returns the row of each member
    and that over its part of the projector, shapes (T, m, n + c), 0 where nothing checks it, and which are checked.
    Without the group the columns are less by ``rows[..., :n]^T scaled``.
    """
    at = np.arange(len(columns))
    place = np.argsort(~members, axis=1, kind="stable")[:, : int(members.sum(axis=1).max(initial=0))]
    rows = columns[at[:, None], place] * members[at[:, None], place][..., None]
    scaled, checked = np.empty_like(rows), np.empty(place.shape, dtype=bool)
    for k in range(place.shape[1]):
        row, later = rows[:, k], rows[:, k + 1 :]
        share = row[at, place[:, k]]
        checked[:, k] = share > LEAST_REDUNDANCY
        scaled[:, k] = row / np.where(checked[:, k], share, np.inf)[:, None]
        later -= np.take_along_axis(later, place[:, None, k, None], axis=2) * scaled[:, k, None]
    return rows, scaled, checked


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
        of_map = (self.map_m**2).sum(axis=1)
        variance = np.maximum(self.scale**2 * (self.variance_m2 - of_map) + of_map, 0.0)
        if self.beyond is not None:
            variance = variance + (self.gain_m**2 * self.beyond).sum(axis=1)
        return np.asarray(np.sqrt(variance))

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


def all_in_view(
    model: LinearModel, scale: Floats, least_sigma_m: Floats, bias_m: Floats, map_bias_m: Floats
) -> AllInView:
    """The parts that every subset asks for.

    Parameters
    ----------
    model : LinearModel
        T epochs with a position, on the line.
    scale : ndarray, shape (T,)
    least_sigma_m : ndarray, shape (T, M) [m], or (T, 0)
        Least standard deviation of each range; none: that of its weight times the scale.
    bias_m : ndarray, shape (T, M) [m], or (T, 0)
        Largest nominal bias of each range; none: 0.
    map_bias_m : ndarray, shape (T, 2) [m]
    """
    parts = compact(model)
    root = np.sqrt(np.einsum("ii->i", model.prior))[1:]
    gain = np.take_along_axis(model.design @ model.covariance_m2, parts.channel[..., None], axis=1)
    of_range = np.where(parts.used, 1.0 / np.where(parts.used, parts.sigma_m, 1.0), 0.0)
    range_bias = beyond = None
    if bias_m.shape[1]:
        range_bias = np.abs(np.take_along_axis(bias_m, parts.channel, axis=1)) * of_range
    if least_sigma_m.shape[1]:
        least = np.where(parts.used, np.take_along_axis(least_sigma_m, parts.channel, axis=1), 0.0) * of_range
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
        map_bias=map_bias_m * root,
    )


@dataclass(frozen=True)
class WithoutMap:
    """The position without the map."""

    of_ranges: AllInView
    shift_m: Floats  # (T,) its distance from the position with the map
    blind: Masks  # (T,) nothing determines it

    def apart(self, more: Separations) -> Separations:
        """Return separations of `of_ranges` as those of the position with the map.

        The distance between the two is computed and counts whole, so that nothing is left to be tested.
        """
        none, blind = np.zeros(more.moved_m.shape), self.blind[:, None]
        bias = np.abs(self.shift_m[:, None] + more.moved_m) + more.bias_m
        return Separations(
            sigma_m=np.where(blind, np.inf, more.sigma_m),
            separation_sigma_m=none,
            moved_m=none,
            bias_m=np.where(~blind & np.isfinite(more.sigma_m), bias, 0.0),
        )


@dataclass(frozen=True)
class Remaining:
    """Channels of T epochs without those of a shared fault, and what these take with them.

    Columns are those of the projector, then gain, residual and response to the map error across and up.
    """

    of: AllInView
    columns: Floats  # (T, n, n + 4)
    gone: Floats  # (T, 4) variance of the distance, -distance, its response to the map error across and up
    blind: Masks  # (T,) nothing bounds a fault

    def without(self, members: Indices) -> Separations:
        """Leave out K sets of k channels, one member after the other.

        Without a channel i the others have the projector ``S - S_.i S_i. / S_ii``, and residuals, gains and responses
        to the map alike. A member that nothing checks by then, ``S_ii = 0`` (a satellite, or the last of several, of a
        clock of its own), must not move the position; where it does, nothing bounds it.

        Parameters
        ----------
        members : ndarray of int, shape (k, K)
            Places in the compact arrays.
        """
        full, epochs, (size, count) = self.of, len(self.gone), members.shape
        n = full.channel.shape[1]
        limit = NO_EFFECT * np.sqrt(full.variance_m2)[:, None]
        gone = np.repeat(self.gone[..., None], count, axis=2)
        blind = np.repeat(self.blind[:, None], count, axis=1)
        by_channel = np.moveaxis(self.columns[..., n:], 2, 1)
        own = [by_channel[..., m] for m in members]
        shares = {(q, r): self.columns[:, members[q], members[r]] for q in range(size) for r in range(q, size)}
        rows = [self.columns[:, m, :n] for m in members] if full.by_range else []
        left = np.broadcast_to(by_channel[:, :1], (epochs, count, n)) if full.by_range else None
        for q in range(size):
            share = shares[q, q]
            unchecked = share <= LEAST_REDUNDANCY
            if unchecked.any():
                share = np.where(unchecked, np.inf, share)
                blind |= unchecked & (np.abs(own[q][:, 0]) > limit)
            inverse = 1.0 / share
            weight = inverse * own[q][:, 0]
            gone += weight[:, None] * own[q]
            if left is not None:
                left = left - weight[..., None] * rows[q]
            for r in range(q + 1, size):
                ratio = inverse * shares[q, r]
                own[r] = own[r] - ratio[:, None] * own[q]
                for k in range(r, size):
                    shares[r, k] = shares[r, k] - ratio * shares[q, k]
                if left is not None:
                    rows[r] = rows[r] - ratio[..., None] * rows[q]
        return _separations(full, gone, left, blind)


def without_group(full: AllInView, members: Masks | None) -> Remaining:
    """Leave out a group of channels, one after the other.

    Parameters
    ----------
    full : AllInView
    members : ndarray of bool, shape (T, n), or None
        Places of the group in the compact arrays; some epochs may have none.
    """
    epochs, n = full.channel.shape
    columns = np.concatenate(
        [full.projector, full.gain_m[..., None], full.residual[..., None], full.map_gain_m], axis=2
    )
    if members is None:
        return Remaining(full, columns, np.zeros((epochs, 4)), np.zeros(epochs, dtype=bool))
    rows, scaled, checked = one_after_the_other(columns, members)
    limit = NO_EFFECT * np.sqrt(full.variance_m2)[:, None]
    blind: Masks = np.any(~checked & (np.abs(rows[..., n]) > limit), axis=1)
    gone = np.einsum("tm,tmc->tc", rows[..., n], scaled[..., n:])
    return Remaining(full, columns - rows[..., :n].swapaxes(1, 2) @ scaled, gone, blind)


def inverse_3x3(matrix: Floats) -> Floats:
    """Invert symmetric 3 x 3 matrices by cofactors; NaN where the scaled determinant is below 1e-12."""
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2]
    d, e, f = matrix[..., 1, 1], matrix[..., 1, 2], matrix[..., 2, 2]
    cofactors = np.empty(matrix.shape)
    cofactors[..., 0, 0] = d * f - e * e
    cofactors[..., 1, 1] = a * f - c * c
    cofactors[..., 2, 2] = a * d - b * b
    cofactors[..., 0, 1] = cofactors[..., 1, 0] = c * e - b * f
    cofactors[..., 0, 2] = cofactors[..., 2, 0] = b * e - c * d
    cofactors[..., 1, 2] = cofactors[..., 2, 1] = b * c - a * e
    determinant = a * cofactors[..., 0, 0] + b * cofactors[..., 0, 1] + c * cofactors[..., 0, 2]
    regular = determinant > 1e-12 * ((a + d + f) / 3.0) ** 3
    determinant = np.where(regular, determinant, np.nan)
    return cofactors / determinant[..., None, None]


def regular_inverse(matrix: Floats) -> Floats:
    """Inverse of symmetric 3 x 3 matrices, each scaled to a unit diagonal; NaN where singular."""
    diagonal = np.einsum("tii->ti", matrix)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, np.nan))
    outer = scale[:, :, None] * scale[:, None, :]
    return np.asarray(inverse_3x3(matrix * outer) * outer)


def without_map(full: AllInView, model: LinearModel, seen_m: Floats, information: Floats) -> WithoutMap:
    """The map left out.

    What takes the place of the map is its offset as the positions in space of the last minutes show it. Without one
    the position is that in space.

    Parameters
    ----------
    full : AllInView
    model : LinearModel
    seen_m : ndarray, shape (T, 2) [m]
        Place of the antenna across and above the line over minutes; any finite value where nothing is known.
    information : ndarray, shape (T, 2, 2) [1/m^2]
        Inverse covariance of that; 0 where nothing is known.
    """
    of_map = np.zeros((len(model), 3, 3))
    of_map[:, 1:, 1:] = full.scale[:, None, None] ** 2 * information
    normal = np.linalg.inv(model.covariance_m2) - model.prior
    covariance = regular_inverse(normal + of_map)
    blind: Masks = np.asarray(~np.isfinite(covariance[:, 0, 0]))
    covariance[blind] = np.eye(3)
    ask = np.matmul(model.misfit[:, None, :], model.design)[:, 0]
    ask[:, 1:] += np.einsum("tij,tj->ti", of_map[:, 1:, 1:], seen_m)
    shift = np.einsum("tij,tj->ti", covariance, ask) - model.step_m
    free = replace(model, covariance_m2=covariance)
    own = np.take_along_axis(model.design, full.channel[..., None], axis=1)
    nothing = np.zeros((len(model), 2))
    without = replace(
        full,
        projector=compact(free).projector,
        residual=full.residual - np.einsum("tni,ti->tn", own, shift),
        gain_m=np.einsum("tni,ti->tn", own, covariance[:, :, 0]),
        map_gain_m=np.zeros(full.map_gain_m.shape),
        map_m=nothing,
        variance_m2=covariance[:, 0, 0],
        map_bias=nothing,
    )
    return WithoutMap(without, shift[:, 0], blind)


def _separations(full: AllInView, gone: Floats, left: Floats | None, blind: Masks) -> Separations:
    """Noise and biases of what K sets of channels take with them.

    Parameters
    ----------
    full : AllInView
    gone : ndarray, shape (T, 4, K)
        Variance of the distance of the positions, -distance, and its response to the map error across and up.
    left : ndarray, shape (T, K, n), or None
        Gains of the ranges without the set; None where those of single ranges are not needed.
    blind : ndarray of bool, shape (T, K)
        Nothing bounds a fault.
    """
    noise = full.scale[:, None] ** 2
    square, moved, response = gone[:, 0], -gone[:, 1], gone[:, 2:]
    whole = response + full.map_m[..., None]
    apart = noise * square
    total = apart + noise * full.variance_m2[:, None]
    if (noise != 1.0).any():
        apart += (1.0 - noise) * np.einsum("tak,tak->tk", response, response)
        total += (1.0 - noise) * np.einsum("tak,tak->tk", whole, whole)
    bias = np.abs(np.einsum("tak,ta->tk", whole, full.map_bias))
    if left is not None and full.range_bias is not None:
        bias += np.einsum("tki,ti->tk", np.abs(left), full.range_bias)
    if left is not None and full.beyond is not None:
        apart = np.maximum(apart, 0.0) + np.einsum("tki,ti->tk", (left - full.gain_m[:, None]) ** 2, full.beyond)
        total = np.maximum(total, 0.0) + np.einsum("tki,ti->tk", left**2, full.beyond)
    sigma, separation = np.sqrt(np.maximum(total, 0.0)), np.sqrt(np.maximum(apart, 0.0))
    if blind.any():
        sigma[blind], separation[blind], moved[blind], bias[blind] = np.inf, 0.0, 0.0, 0.0
    return Separations(sigma_m=sigma, separation_sigma_m=separation, moved_m=moved, bias_m=bias)


def tails_of_hypotheses(
    model: ModelArrays, errors: Errors, asked: Asked
) -> tuple[Indices, Floats, Floats, Floats, Floats]:
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
    epochs = len(errors.scale)
    whole = LinearModel(**model._asdict(), freedom=np.full(epochs, -1), interest=1)
    full = all_in_view(whole, errors.scale, errors.least_sigma_m, errors.bias_m, errors.map_bias_m)
    n = full.channel.shape[1]
    prior = np.take_along_axis(asked.prior, full.channel, axis=1) * full.used
    offset, sigma, weight = (np.zeros((epochs, int(asked.bounds[-1]))) for _ in range(3))
    separation = np.zeros(epochs)
    free = without_map(full, whole, errors.map_seen_m, errors.map_information) if asked.wrong_map.any() else None
    for b, first in enumerate(asked.first.tolist()):
        if first[0] < 0:
            continue
        members = np.take_along_axis(asked.members[:, b], full.channel, axis=1) & full.used
        apart = free if free is not None and asked.wrong_map[b] else None
        rest = without_group(full if apart is None else apart.of_ranges, members if members.any() else None)
        others = prior * ~members
        for k, start in enumerate(first):
            if start < 0:
                continue
            sets = np.array(list(combinations(range(n), k)), dtype=np.intp).reshape(math.comb(n, k), k).T
            got = rest.without(sets) if apart is None else apart.apart(rest.without(sets))
            here = slice(start, start + sets.shape[1])
            # Noise passes on either side.
            of_group = asked.shared_prior[:, b] * (asked.order[:, b] >= k) * (2.0 if start == 0 else 1.0)
            weight[:, here] = of_group[:, None] * others[:, sets].prod(axis=1)
            threshold = asked.k_false_alarm[:, None] * got.separation_sigma_m
            likely = weight[:, here] > 0.0
            offset[:, here] = np.where(likely, threshold + got.bias_m, 0.0)
            sigma[:, here] = np.where(likely, got.sigma_m, 1.0)
            moving = likely & (got.separation_sigma_m > _SAME * sigma[:, :1])
            ratio = np.abs(got.moved_m) / np.where(moving, threshold, np.inf)
            separation = np.maximum(separation, ratio.max(axis=1, initial=0.0))
    return full.channel, offset, sigma, weight, separation

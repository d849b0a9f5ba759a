"""Other places of the line that the hypotheses of a level leave open.

A level is linear: it bounds the error along the tangent at the position. Where the line turns away, passes itself or
branches, a satellite left out can move the position to a place that no tangent leads to. Under each hypothesis
of the level (no fault, one faulty satellite, two) the weighted sum of squared residuals is a quadratic form in the
place, which is evaluated along the line around the position.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

import numpy as np
from scipy.special import ndtr

from railfix.core.arrays import Floats, Indices, Masks
from railfix.integrity.protection import RiskBudget
from railfix.integrity.protection.risk import one_sided_k
from railfix.integrity.raim import LinearModel
from railfix.integrity.raim.exclusion import LEAST_REDUNDANCY
from railfix.integrity.raim.model import Compact, compact
from railfix.kernels import compiled_by
from railfix.positioning.normal_equations import inverse_3x3
from railfix.positioning.section_search import SearchIndex

#: Cosine of the angle off the tangent (6 deg) within which the linear model of the level holds.
_ALONG: Final = 0.9945
#: Furthest places looked at [m]: the linear model of a range is off by 0.7 m there.
_FURTHEST_M: Final = 5000.0
#: Distance up to which the line is looked over for parts off the tangent before anything else [m].
_CLEAR_M: Final = 200.0
#: Points this near to a tangent are not off it beyond any level [m].
_ON_TANGENT_M: Final = 1e-3
#: Share of the risk of a sample below which places are not looked for.
_NEGLIGIBLE: Final = 0.01
#: Numbers that a block of epochs by pairs of satellites, or of sections by hypotheses holds.
_BLOCK_SIZE: Final = 300_000
#: Numbers that a block of epochs by channels squared holds.
_BOUND_SIZE: Final = 100_000


@dataclass(frozen=True)
class _Forms:
    """Sum of squared residuals in variances, over the place d from the position, under K hypotheses, T epochs.

    ``q(d) = constant - 2 d . slope + d^T matrix d``, d along, across and up at the position.
    """

    prior: Floats  # (T, K)
    constant: Floats  # (T, K)
    slope: Floats  # (T, K, 3) [1/m]
    matrix: Floats  # (T, K, 3, 3) [1/m^2]

    def take(self, epochs: Indices) -> _Forms:
        """Return the forms of some epochs, by index."""
        return _Forms(self.prior[epochs], self.constant[epochs], self.slope[epochs], self.matrix[epochs])

    def coefficients(self) -> Floats:
        """Return the coefficients of the monomials of `_Sections.monomials`, shape (T, 10, K)."""
        of_squares = [self.matrix[..., i, i] for i in range(3)]
        of_products = [2.0 * self.matrix[..., i, j] for i, j in ((0, 1), (0, 2), (1, 2))]
        return np.stack([self.constant, *np.moveaxis(-2.0 * self.slope, 2, 0), *of_squares, *of_products], axis=1)

    def radius_m(self, risk: float) -> Floats:
        """Return the distance from the position within which all open places lie, shape (T,); `_FURTHEST_M` at most.

        Places further away have a hundredth of the risk at most.
        """
        covariance = inverse_3x3(self.matrix)
        centre = np.einsum("tkij,tkj->tki", covariance, self.slope)
        form = np.maximum(np.einsum("tki,tki->tk", centre, self.slope), 0.0)
        # The trace of a covariance is above its largest eigenvalue.
        widest = np.trace(covariance, axis1=2, axis2=3)
        total = self.prior.sum(axis=1, keepdims=True)
        sigmas = np.maximum(one_sided_k(_NEGLIGIBLE * risk / np.where(total > 0, total, 1.0)), 0.0)
        radius = np.linalg.norm(centre, axis=2) + np.sqrt((form + sigmas**2) * widest)
        radius = np.where(self.prior > 0, np.nan_to_num(radius, nan=_FURTHEST_M), 0.0)
        return np.asarray(np.minimum(radius.max(axis=1), _FURTHEST_M))


@dataclass(frozen=True)
class _Sections:
    """Sections of the line around the positions: P pairs of an epoch and a section, sorted by epoch."""

    epoch: Indices  # (P,)
    start_m: Floats  # (P, 3) first point, along, across and up from the position
    tangent: Floats  # (P, 3)
    length_m: Floats  # (P,)
    beyond: Masks  # (P,) with a part beyond the level that the tangent does not lead to

    def take(self, pairs: Masks | Indices) -> _Sections:
        """Return some of the sections."""
        return _Sections(
            self.epoch[pairs], self.start_m[pairs], self.tangent[pairs], self.length_m[pairs], self.beyond[pairs]
        )

    def monomials(self) -> Floats:
        """Return the monomials of q at the start, of its slope and of its curvature along each section, (P, 3, 10)."""
        (x, y, z), (a, b, c) = self.start_m.T, self.tangent.T
        none, one = np.zeros(len(x)), np.ones(len(x))
        start = [one, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
        slope = [none, a, b, c, 2 * x * a, 2 * y * b, 2 * z * c, x * b + y * a, x * c + z * a, y * c + z * b]
        curvature = [none, none, none, none, a * a, b * b, c * c, a * b, a * c, b * c]
        return np.moveaxis(np.array([start, slope, curvature]), 2, 0)


def places_beyond_the_level(
    index: SearchIndex,
    arc_m: Floats,
    model: LinearModel,
    level_m: Floats,
    scale: Floats,
    systems: Sequence[str],
    risk: RiskBudget,
    rows: Indices,
) -> Masks:
    """Return the epochs with places of the line that are open beyond the level, shape (T,).

    Under a hypothesis J, a place that fits worse than the best place of the line by x variances is the true one with a
    probability of ``Q(sqrt(x))`` at most. An epoch is returned where these probabilities, of the best place beyond
    the level, times the prior of J, add up to more than the risk of a sample. Where the line is straight, the level
    keeps this sum within the risk.

    Parameters
    ----------
    index : SearchIndex
        Of the trajectory.
    arc_m : ndarray, shape (T,) [m]
        Positions.
    model : LinearModel
        Of the positions.
    level_m : ndarray, shape (T,) [m]
    scale : ndarray, shape (T,)
        Noise scale, taken as 1 at least.
    systems : sequence of str
        Constellation letter of each channel.
    risk : RiskBudget
    rows : ndarray of int
        Epochs to look at; those without a finite level are left out.
    """
    result = np.zeros(len(arc_m), dtype=bool)
    rows = rows[np.isfinite(level_m[rows]) & np.isfinite(arc_m[rows]) & np.isfinite(model.wsse[rows])]
    if not len(rows):
        return result
    channels = int(np.count_nonzero(model.used[rows], axis=1).max())
    size = max(1, _BOUND_SIZE // channels**2)
    for first in range(0, len(rows), size):
        block = rows[first : first + size]
        parts, design, none = _whitened(model.take(block), index, np.maximum(scale[block], 1.0))
        prior = np.where(parts.used, risk.prior(systems)[parts.channel], 0.0)
        bound = risk_off_tangent(
            parts.projector,
            parts.residual,
            design,
            prior,
            none.slope[:, 0],
            none.matrix[:, 0],
            _off_tangent_m(index, arc_m[block]),
        )
        near = np.flatnonzero(bound > risk.risk_per_sample)
        for some in np.array_split(near, 1 + 9 * len(near) // size) if len(near) else ():
            rest = block[some]
            spent = _risk_of_block(
                index, arc_m[rest], level_m[rest], parts.take(some), design[some], none.take(some), prior[some], risk
            )
            result[rest] = spent > risk.risk_per_sample
    return result


def _off_tangent_m(index: SearchIndex, arc_m: Floats) -> Floats:
    """Return a distance within which no part of the line lies off the tangent, at positions on it, shape (T,) [m].

    Along and across, without the height. The same for all positions on a section; at most `_CLEAR_M`.
    """
    line = index.trajectory
    section = line.segment_at(arc_m)[0]
    new = np.unique(section[np.isnan(index.off_tangent_m[section])])
    if len(new):
        middle = line.ecef_m[new] + 0.5 * line.length_m[new, None] * line.tangent[new]
        reach = _CLEAR_M + 0.5 * line.length_m[new] + line.length_m.max()
        lists = index.tree.query_ball_point(middle, reach)
        count = np.fromiter(map(len, lists), dtype=np.intp, count=len(lists))
        vertex = np.fromiter(chain.from_iterable(lists), dtype=np.intp, count=int(count.sum()))
        row = np.repeat(np.arange(len(new)), count)
        other = (vertex < len(line.length_m)) & (vertex != new[row])
        row, vertex = row[other], vertex[other]
        own, tangent, across = line.length_m[new[row]], line.tangent[new[row]], line.across[new[row]]
        along, distance, off = [], [], np.zeros(len(row), dtype=bool)
        for end in (vertex, vertex + 1):
            away = line.ecef_m[end] - line.ecef_m[new[row]]
            ahead = np.einsum("pi,pi->p", away, tangent)
            # Of all places on the section, the one abeam or nearest sees the end furthest off the tangent.
            least = np.maximum(np.maximum(ahead - own, -ahead), 0.0)
            beside = np.linalg.norm(away - ahead[:, None] * tangent, axis=1)
            distance.append(np.hypot(least, np.einsum("pi,pi->p", away, across)))
            off |= (least < _ALONG * np.hypot(least, beside)) & (beside > _ON_TANGENT_M)
            along.append(ahead)
        # A section that passes by has ends in both directions, and a middle off the tangent.
        passing = np.minimum(np.maximum(*along), own) - np.maximum(np.minimum(*along), 0.0) > _ON_TANGENT_M
        near = np.where(off | passing, np.minimum(*distance) - line.length_m[vertex], _CLEAR_M)
        clear = np.full(len(new), _CLEAR_M)
        np.minimum.at(clear, row, near)
        index.off_tangent_m[new] = np.maximum(clear, 0.0)
    return np.asarray(index.off_tangent_m[section])


@compiled_by("open_places")
def risk_off_tangent(
    projector: Floats,
    residual: Floats,
    design: Floats,
    prior: Floats,
    slope: Floats,
    matrix: Floats,
    clear_m: Floats,
) -> Floats:
    """Return an upper bound of the probability that the true place lies off the tangent beyond a distance.

    At a distance D along and across a form exceeds its value at the position by ``(D - |c|)^2 / trace(C) - c . s`` at
    least: c its lowest place and C the inverse of its matrix, both along and across, and s its slope.

    Parameters
    ----------
    projector : ndarray, shape (T, n, n)
    residual, prior : ndarray, shape (T, n)
    design : ndarray, shape (T, n, 3)
    slope : ndarray, shape (T, 3)
    matrix : ndarray, shape (T, 3, 3)
        Of the form without a fault.
    clear_m : ndarray, shape (T,) [m]
        Distance within which no place is off the tangent.

    Returns
    -------
    ndarray, shape (T,)
        Summed over no fault, one faulty satellite and two.
    """
    share = np.einsum("tii->ti", projector)
    s = [slope[:, a, None] for a in range(3)]
    entries = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    m = {(a, b): matrix[:, a, b, None] for a, b in entries}
    f = [design[..., a] for a in range(3)]
    total = _bounded(np.full((len(clear_m), 1), 2.0), s, m, clear_m)

    checked = share > LEAST_REDUNDANCY
    inverse = np.where(checked, 1.0 / np.where(checked, share, 1.0), 0.0)
    own = inverse * residual
    scaled = [inverse * f[a] for a in range(3)]
    total += _bounded(
        prior, [s[a] - own * f[a] for a in range(3)], {(a, b): m[a, b] - scaled[a] * f[b] for a, b in entries}, clear_m
    )

    n = prior.shape[1]
    i, j = np.triu_indices(n, 1)
    a_i, b_ij, c_j = share[:, i], np.take(projector.reshape(-1, n * n), i * n + j, axis=1), share[:, j]
    product = a_i * c_j
    determinant = product - b_ij * b_ij
    checked = (np.minimum(a_i, c_j) > LEAST_REDUNDANCY) & (determinant > LEAST_REDUNDANCY * product)
    inverse = np.where(checked, 1.0 / np.where(checked, determinant, 1.0), 0.0)
    a_i, b_ij, c_j = a_i * inverse, b_ij * inverse, c_j * inverse
    one, two = residual[:, i], residual[:, j]
    own_one, own_two = c_j * one - b_ij * two, a_i * two - b_ij * one
    first, second = [f[a][:, i] for a in range(3)], [f[a][:, j] for a in range(3)]
    move_one = [c_j * first[a] - b_ij * second[a] for a in range(3)]
    move_two = [a_i * second[a] - b_ij * first[a] for a in range(3)]
    return total + _bounded(
        prior[:, i] * prior[:, j],
        [s[a] - own_one * first[a] - own_two * second[a] for a in range(3)],
        {(a, b): m[a, b] - move_one[a] * first[b] - move_two[a] * second[b] for a, b in entries},
        clear_m,
    )


def _bounded(
    prior: Floats, slope: Sequence[Floats], matrix: Mapping[tuple[int, int], Floats], clear_m: Floats
) -> Floats:
    """Return the bound of `risk_off_tangent` over K hypotheses, shape (T,): prior (T, K), parts of slope and matrix."""
    xx, xy, xz, yy, yz, zz = (matrix[key] for key in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    s, t, u = slope
    c_xx, c_yy, c_zz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    c_xy, c_xz, c_yz = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    determinant = xx * c_xx + xy * c_xy + xz * c_xz
    regular = determinant > 1e-12 * ((xx + yy + zz) / 3.0) ** 3
    inverse = 1.0 / np.where(regular, determinant, 1.0)
    x, y, z = (
        (c_xx * s + c_xy * t + c_xz * u) * inverse,
        (c_xy * s + c_yy * t + c_yz * u) * inverse,
        (c_xz * s + c_yz * t + c_zz * u) * inverse,
    )
    gap = np.maximum(clear_m[:, None] - np.sqrt(x * x + y * y), 0.0)
    spread = np.where(regular, (c_xx + c_yy) * inverse, np.inf)
    excess = gap * gap / spread - np.maximum(x * s + y * t + z * u, 0.0)
    tail = np.where(excess > 0.0, ndtr(-np.sqrt(np.maximum(excess, 0.0))), 1.0)
    return np.asarray((prior * tail).sum(axis=1))


def _risk_of_block(
    index: SearchIndex,
    arc_m: Floats,
    level_m: Floats,
    parts: Compact,
    design: Floats,
    none: _Forms,
    prior: Floats,
    risk: RiskBudget,
) -> Floats:
    """Return the probability that the true place lies beyond the level off the tangent, shape (T,)."""
    allowed = risk.risk_per_sample
    forms = _beside(none, _without_one(parts, design, none, prior))
    spent = _risk_beyond(forms, _around(index, arc_m, level_m, forms.radius_m(allowed)))
    left = np.flatnonzero(spent <= allowed)
    if len(left) and parts.channel.shape[1] > 1:
        pairs = _without_two(parts.take(left), design[left], none.take(left), prior[left])
        spent[left] += _risk_beyond(pairs, _around(index, arc_m[left], level_m[left], pairs.radius_m(allowed)))
    return spent


def _beside(first: _Forms, second: _Forms) -> _Forms:
    return _Forms(
        *(
            np.concatenate([getattr(first, name), getattr(second, name)], axis=1)
            for name in ("prior", "constant", "slope", "matrix")
        )
    )


def _whitened(model: LinearModel, index: SearchIndex, scale: Floats) -> tuple[Compact, Floats, _Forms]:
    """Return the residuals with the map error in the noise, their change with the place, and the form without fault.

    The map error is taken alike in all horizontal directions: another place has another tangent.
    """
    plan, height = index.trajectory.sigma_plan_m, index.trajectory.sigma_height_m
    normal = np.linalg.inv(model.covariance_m2) - model.prior
    prior = scale[:, None, None] ** 2 * np.diag([plan**-2.0, plan**-2.0, height**-2.0])
    covariance = np.asarray(np.linalg.inv(normal + prior), dtype=np.float64)
    whole = replace(model, covariance_m2=covariance)
    parts = compact(whole)
    spread = covariance @ prior
    design = np.take_along_axis(model.design @ spread, parts.channel[..., None], axis=1) / scale[:, None, None]
    misfit = np.take_along_axis(model.misfit, parts.channel, axis=1) / scale[:, None]
    parts = replace(parts, residual=parts.residual / scale[:, None])
    none = _Forms(
        prior=np.full((len(scale), 1), 2.0),  # noise passes on either side
        constant=np.einsum("tn,tn->t", misfit, parts.residual)[:, None],
        slope=np.einsum("tni,tn->ti", design, misfit)[:, None],
        matrix=(normal @ spread / scale[:, None, None] ** 2)[:, None],
    )
    return parts, design, none


def _without_one(parts: Compact, design: Floats, none: _Forms, prior: Floats) -> _Forms:
    """Forms with each channel left out, K = n."""
    share = np.einsum("tii->ti", parts.projector)
    checked = share > LEAST_REDUNDANCY
    inverse = np.where(checked, 1.0 / np.where(checked, share, 1.0), 0.0)
    return _Forms(
        prior=prior,
        constant=none.constant - inverse * parts.residual**2,
        slope=none.slope - (inverse * parts.residual)[..., None] * design,
        matrix=none.matrix - inverse[..., None, None] * design[..., None] * design[..., None, :],
    )


def _without_two(parts: Compact, design: Floats, none: _Forms, prior: Floats) -> _Forms:
    """Forms with each pair of channels left out."""
    i, j = np.triu_indices(parts.channel.shape[1], 1)
    share = np.einsum("tii->ti", parts.projector)
    a, b, c = share[:, i], parts.projector[:, i, j], share[:, j]
    product = a * c
    determinant = product - b * b
    checked = (np.minimum(a, c) > LEAST_REDUNDANCY) & (determinant > LEAST_REDUNDANCY * product)
    inverse = np.where(checked, 1.0 / np.where(checked, determinant, 1.0), 0.0)
    one, two = parts.residual[:, i], parts.residual[:, j]
    own_one, own_two = (c * one - b * two) * inverse, (a * two - b * one) * inverse
    first, second = design[:, i], design[:, j]
    move_one = (c[..., None] * first - b[..., None] * second) * inverse[..., None]
    move_two = (a[..., None] * second - b[..., None] * first) * inverse[..., None]
    return _Forms(
        prior=prior[:, i] * prior[:, j],
        constant=none.constant - one * own_one - two * own_two,
        slope=none.slope - own_one[..., None] * first - own_two[..., None] * second,
        matrix=none.matrix - move_one[..., None] * first[..., None, :] - move_two[..., None] * second[..., None, :],
    )


def _around(index: SearchIndex, arc_m: Floats, level_m: Floats, radius_m: Floats) -> _Sections:
    """Sections of the line within a radius of each position that has any off the tangent beyond its level.

    Sections that the level cuts are divided there.
    """
    line = index.trajectory
    here, place = line.segment_at(arc_m)[0], line.at_arc(arc_m)
    axes = np.stack([line.tangent[here], line.across[here], line.up[here]], axis=1)
    lists = index.tree.query_ball_point(place, radius_m + line.length_m.max(), return_sorted=True)
    count = np.fromiter(map(len, lists), dtype=np.intp, count=len(lists))
    vertex = np.fromiter(chain.from_iterable(lists), dtype=np.intp, count=int(count.sum()))
    epoch = np.repeat(np.arange(len(arc_m)), count)
    inside = vertex < len(line.length_m)
    epoch, vertex = epoch[inside], vertex[inside]
    start = np.einsum("pij,pj->pi", axes[epoch], line.ecef_m[vertex] - place[epoch])
    tangent, length = np.einsum("pij,pj->pi", axes[epoch], line.tangent[vertex]), line.length_m[vertex]
    # |start + s tangent| = level at both roots; between them is what the level reaches.
    middle = -np.einsum("pi,pi->p", start, tangent)
    square = middle**2 - np.einsum("pi,pi->p", start, start) + level_m[epoch] ** 2
    half = np.sqrt(np.maximum(square, 0.0))
    first, second = np.clip(middle - half, 0.0, length), np.clip(middle + half, 0.0, length)
    first = np.where(square > 0, first, length)
    edges = np.stack([np.zeros(len(epoch)), first, np.maximum(second, first), length], axis=1)
    pair, piece = np.nonzero(np.diff(edges, axis=1) > 0)
    low, high = edges[pair, piece], edges[pair, piece + 1]
    ends = start[pair, None] + np.stack([low, high], axis=1)[..., None] * tangent[pair, None]
    off = (np.abs(ends[..., 0]) < _ALONG * np.linalg.norm(ends, axis=2)).any(axis=1)
    beyond = (piece != 1) & off
    turning = np.zeros(len(arc_m), dtype=bool)
    turning[epoch[pair[beyond]]] = True
    return _Sections(epoch[pair], ends[:, 0], tangent[pair], high - low, beyond).take(turning[epoch[pair]])


def _risk_beyond(forms: _Forms, sections: _Sections) -> Floats:
    """Probability that the true place lies beyond the level, summed over the hypotheses, shape (T,)."""
    spent = np.zeros(len(forms.prior))
    epochs, starts, count = np.unique(sections.epoch, return_index=True, return_counts=True)
    if not len(epochs):
        return spent
    forms = forms.take(epochs)
    coefficients = forms.coefficients()
    # Epochs of like numbers of sections together: no block is wider than it must be.
    order = np.argsort(count, kind="stable")
    size = max(1, _BLOCK_SIZE // max(1, int(count.max()) * forms.prior.shape[1]))
    for first in range(0, len(order), size):
        some = order[first : first + size]
        place = np.arange(count[some].max())
        there = place < count[some, None]
        part = sections.take(np.where(there, starts[some, None] + place, starts[some, None]).ravel())
        width = 3 * len(place)
        values = part.monomials().reshape(len(some), width, 10) @ coefficients[some]
        start, slope, curvature = np.moveaxis(values.reshape(len(some), len(place), 3, -1), 2, 0)
        length = part.length_m.reshape(there.shape)[..., None]
        step = np.clip(-0.5 * slope / np.where(curvature > 0, curvature, np.inf), 0.0, length)
        least = start + step * (slope + step * curvature)
        beyond = np.where(part.beyond.reshape(there.shape)[..., None], least, np.inf).min(axis=1)
        excess = beyond - least.min(axis=1)
        tail = np.where(excess > 0, ndtr(-np.sqrt(np.maximum(excess, 0.0))), 1.0)
        spent[epochs[some]] = (forms.prior[some] * tail).sum(axis=1)
    return spent

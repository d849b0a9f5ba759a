"""Other places of the line that the hypotheses of a level leave open.

A level bounds the error along the tangent. Where the line turns away, passes itself or branches, a satellite left out
can move the position to a place that no tangent leads to. Under each hypothesis of the level the sum of squared
residuals, a quadratic form in the place, is evaluated along the line where a bound does not rule such places out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Final, NamedTuple

import numpy as np

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Masks, over_blocks
from railfix.core.constants import ALONG, LEAST_REDUNDANCY
from railfix.integrity.protection.risk import RiskBudget, one_sided_k
from railfix.integrity.raim import LinearModel
from railfix.integrity.raim.model import Compact, compact
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.normal_equations import inverse_3x3
from railfix.positioning.section_search import SearchIndex

_FURTHEST_M: Final = 5000.0  #: Furthest places looked at [m]: the linear model of a range is off by 0.7 m there.
_NEGLIGIBLE: Final = 0.01  #: Share of the risk of a sample below which places are not looked for.


class Forms(NamedTuple):
    """Sum of squared residuals in variances, over the place d from the position, under K hypotheses, T epochs.

    ``q(d) = constant - 2 d . slope + d^T matrix d``, d along, across and up at the position.
    """

    prior: Floats  # (T, K)
    constant: Floats  # (T, K)
    slope: Floats  # (T, K, 3) [1/m]
    matrix: Floats  # (T, K, 3, 3) [1/m^2]

    def beside(self, *others: Forms) -> Forms:
        """Return these and other hypotheses of the same epochs together."""
        return Forms(*(np.concatenate(arrays, axis=1) for arrays in zip(self, *others, strict=True)))

    def radius_m(self, risk: float) -> Floats:
        """Return the distance within which the open places of each hypothesis lie, shape (T, K); 0 without a prior.

        Beyond them all have 1 % of the risk, the same for each.
        """
        covariance = inverse_3x3(self.matrix)
        centre = np.einsum("tkij,tkj->tki", covariance, self.slope)
        form = np.maximum(np.einsum("tki,tki->tk", centre, self.slope), 0.0)
        # The trace of a covariance is above its largest eigenvalue.
        widest = np.trace(covariance, axis1=2, axis2=3)
        each = _NEGLIGIBLE * risk / np.maximum(np.count_nonzero(self.prior, axis=1, keepdims=True), 1)
        sigmas = np.maximum(one_sided_k(each / np.where(self.prior > 0, self.prior, 1.0)), 0.0)
        radius = np.linalg.norm(centre, axis=2) + np.sqrt((form + sigmas**2) * widest)
        radius = np.where(self.prior > 0, np.nan_to_num(radius, nan=_FURTHEST_M), 0.0)
        return np.asarray(np.minimum(radius, _FURTHEST_M))


def whiten_residuals(model: LinearModel, plan: float, height: float, scale: Floats) -> tuple[Compact, Floats, Forms]:
    """Return the residuals of n channels with the map error in the noise, their design, and the form without fault (K =
    1).

    The map error is taken alike in all horizontal directions: another place has another tangent. The design, shape (T,
    n, 3) [1/m], is the decrease of the residuals by a step along, across and up.
    """
    normal = np.linalg.inv(model.covariance_m2) - model.prior
    prior = scale[:, None, None] ** 2 * np.diag([plan**-2.0, plan**-2.0, height**-2.0])
    covariance = np.asarray(np.linalg.inv(normal + prior), dtype=np.float64)
    whole = replace(model, covariance_m2=covariance)
    parts = compact(whole)
    spread = covariance @ prior
    design = np.take_along_axis(model.design @ spread, parts.channel[..., None], axis=1) / scale[:, None, None]
    misfit = np.take_along_axis(model.misfit, parts.channel, axis=1) / scale[:, None]
    parts = replace(parts, residual=parts.residual / scale[:, None])
    none = Forms(
        prior=np.full((len(scale), 1), 2.0),  # noise passes on either side
        constant=np.einsum("tn,tn->t", misfit, parts.residual)[:, None],
        slope=np.einsum("tni,tn->ti", design, misfit)[:, None],
        matrix=(normal @ spread / scale[:, None, None] ** 2)[:, None],
    )
    return parts, design, none


def without_sides(parts: Compact, design: Floats, none: Forms, sides: Masks, prior: float) -> Forms:
    """Return the forms without the channels of each side (T, S, M), K = S; prior 0 with fewer than two in use."""
    n, forms = parts.channel.shape[1], []
    columns = np.concatenate([parts.projector, parts.residual[..., None], design], axis=2)
    for c in range(sides.shape[1]):
        members = np.take_along_axis(sides[:, c], parts.channel, axis=1) & parts.used
        rows, scaled, _ = one_after_the_other(columns, members)
        residual, own = rows[..., n], rows[..., n + 1 :]
        forms.append(
            Forms(
                prior=np.where(members.sum(axis=1) > 1, prior, 0.0)[:, None],
                constant=none.constant - np.einsum("tm,tm->t", residual, scaled[..., n])[:, None],
                slope=none.slope - np.einsum("tm,tmi->ti", residual, scaled[..., n + 1 :])[:, None],
                matrix=none.matrix - np.einsum("tmi,tmj->tij", own, scaled[..., n + 1 :])[:, None],
            )
        )
    empty = Forms(none.prior[:, :0], none.constant[:, :0], none.slope[:, :0], none.matrix[:, :0])
    return empty.beside(*forms)


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


_BOUND_SIZE: Final = 200_000  #: Numbers that a block of epochs by channels squared holds.


def places_beyond_the_level(
    antennas: AntennaRows,
    arc_m: Floats,
    model: LinearModel,
    level_m: Floats,
    scale: Floats,
    systems: Sequence[str],
    risk: RiskBudget,
    sides: Masks,
) -> Masks:
    """Return the epochs with places of the line that are open beyond the level, shape (T,).

    Under a hypothesis J, a place that fits worse than the best by x variances is the true one with a probability of
    ``Q(sqrt(x))`` at most. An epoch is returned where these probabilities, of the best place beyond the level, times
    the prior of J, add up to more than the risk of a sample. `scale` is taken as 1 at least; `sides`, shape (T, S, M),
    are the low satellites of each side.
    """
    result = np.zeros(len(arc_m), dtype=bool)
    rows = (np.isfinite(level_m) & np.isfinite(arc_m) & np.isfinite(model.wsse)).nonzero()[0]
    if not len(rows):
        return result
    channels = int(model.used[rows].sum(axis=1).max())
    size = max(1, _BOUND_SIZE // channels**2)
    likely, sigmas = risk.prior(systems), (antennas.sigma_plan_m, antennas.sigma_height_m)
    clear = np.full(len(arc_m), np.nan)
    for index, own in antennas.split(rows):
        clear[own] = index.clear_of_tangent_m(arc_m[own])

    def fill(block: Indices) -> None:
        part, noise = model.take(block), np.maximum(scale[block], 1.0)
        bound = kernels.off_tangent.risk_off_tangent(
            part.arrays, noise, likely, np.ascontiguousarray(sides[block]), risk.side_prior, clear[block], sigmas,
            risk.risk_per_sample,
        )  # fmt: skip
        near = block[bound > risk.risk_per_sample]
        for index, own in antennas.split(near):
            for some in np.array_split(own, 1 + 9 * len(own) // size):
                parts, design, none = whiten_residuals(model.take(some), *sigmas, np.maximum(scale[some], 1.0))
                prior = np.where(parts.used, likely[parts.channel], 0.0)
                forms = [
                    _without_one(parts, design, none, prior),
                    without_sides(parts, design, none, sides[some], risk.side_prior),
                ]
                if parts.channel.shape[1] > 1:
                    forms.append(_without_two(parts, design, none, prior))
                spent = _risk_of_block(index, arc_m[some], level_m[some], none.beside(*forms), risk)
                result[some] = spent > risk.risk_per_sample

    over_blocks(fill, (rows[first : first + size] for first in range(0, len(rows), size)))
    return result


def _risk_of_block(index: SearchIndex, arc_m: Floats, level_m: Floats, forms: Forms, risk: RiskBudget) -> Floats:
    """Return the probability that the true place lies beyond the level off the tangent, shape (T,)."""
    radius = forms.radius_m(risk.risk_per_sample)
    sections = _around(index, arc_m, level_m, radius.max(axis=1))
    return kernels.off_tangent.risk_beyond(forms, radius, *sections)


def _without_one(parts: Compact, design: Floats, none: Forms, prior: Floats) -> Forms:
    """Forms with each channel left out, K = n."""
    share = np.einsum("tii->ti", parts.projector)
    checked = share > LEAST_REDUNDANCY
    inverse = np.where(checked, 1.0 / np.where(checked, share, 1.0), 0.0)
    return Forms(
        prior=prior,
        constant=none.constant - inverse * parts.residual**2,
        slope=none.slope - (inverse * parts.residual)[..., None] * design,
        matrix=none.matrix - inverse[..., None, None] * design[..., None] * design[..., None, :],
    )


def _without_two(parts: Compact, design: Floats, none: Forms, prior: Floats) -> Forms:
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
    return Forms(
        prior=prior[:, i] * prior[:, j],
        constant=none.constant - one * own_one - two * own_two,
        slope=none.slope - own_one[..., None] * first - own_two[..., None] * second,
        matrix=none.matrix - move_one[..., None] * first[..., None, :] - move_two[..., None] * second[..., None, :],
    )


def _around(
    index: SearchIndex, arc_m: Floats, level_m: Floats, radius_m: Floats
) -> tuple[Indices, Floats, Floats, Floats, Floats]:
    """Return the sections within a radius of each position, divided at its level, epoch after epoch.

    Returns
    -------
    first : ndarray of int, shape (T + 1,)
        First section of each epoch, then their number P.
    start_m, tangent : ndarray, shape (P, 3)
        Along, across and up from the position.
    length_m : ndarray, shape (P,)
    beyond_m : ndarray, shape (P,)
        Distance of what lies beyond the level where the tangent does not lead to; others infinite.
    """
    line = index.trajectory
    here, place = line.segment_at(arc_m)[0], line.at_arc(arc_m)
    axes = line.axes_of(here)
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
    off = (np.abs(ends[..., 0]) < ALONG * np.linalg.norm(ends, axis=2)).any(axis=1)
    nearest = start[pair] + np.clip(middle[pair], low, high)[:, None] * tangent[pair]
    beyond = np.where((piece != 1) & off, np.linalg.norm(nearest, axis=1), np.inf)
    first = np.searchsorted(epoch[pair], np.arange(len(arc_m) + 1))
    return first, np.ascontiguousarray(ends[:, 0]), tangent[pair], high - low, beyond

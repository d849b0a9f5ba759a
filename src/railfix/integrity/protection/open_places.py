"""Search, where the line leaves its tangent, for possible true positions that the protection level does not cover.

A protection level bounds the error along the tangent. Where the line bends or passes close to itself, the true position
can be on the line but away from the tangent. Under each fault hypothesis, the sum of squared residuals is a quadratic
form of the position. This form is evaluated along the line, except where a bound already excludes positions away from
the tangent.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Final, NamedTuple

import numpy as np

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Masks, over_blocks
from railfix.core.constants import ALONG
from railfix.integrity.protection.risk import RiskBudget, one_sided_k
from railfix.integrity.raim import LinearModel
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.search_index import SearchIndex

#: Largest search radius [m]. At this distance, the linear range model has an error of 0.7 m.
_FURTHEST_M: Final = 5000.0
_NEGLIGIBLE: Final = 0.01  #: Fraction of a sample's risk allocated to positions outside the search radius.


class Forms(NamedTuple):
    """Sums of squared residuals of T epochs under K hypotheses, as quadratic forms of the offset d from the position.

    The form is ``q(d) = constant - 2 d . slope + d^T matrix d`` in noise variances; d has the components along, across
    and up. The map error is assumed to be equal in all horizontal directions, because the tangent changes along the
    line.
    """

    prior: Floats  # (T, K) probability of the hypothesis, 0 for unused entries
    form: Floats  # (T, K, 10) constant, slope [1/m], upper triangle of the matrix [1/m^2]
    lowest_m: Floats  # (T, K) distance from the position to the form's minimum; NaN where singular
    depth: Floats  # (T, K) value of the form at the position minus its minimum
    widest_m2: Floats  # (T, K) trace of the inverse matrix, an upper bound on its largest eigenvalue

    def radius_m(self, risk: float) -> Floats:
        """Return the search radius of each hypothesis, shape (T, K); 0 for a hypothesis whose prior is 0.

        The probability of a true position outside the radii is at most 1 % of the risk, divided equally among
        hypotheses. A radius is at most 5 km.
        """
        possible = self.prior > 0
        each = _NEGLIGIBLE * risk / np.maximum(np.count_nonzero(possible, axis=1, keepdims=True), 1)
        sigmas = np.maximum(one_sided_k(each / np.where(possible, self.prior, 1.0)), 0.0)
        radius = self.lowest_m + np.sqrt((self.depth + sigmas**2) * self.widest_m2)
        return np.where(possible, np.fmin(radius, _FURTHEST_M), 0.0)


_BOUND_SIZE: Final = 200_000  #: Largest product of a block's number of epochs and squared number of channels.


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
    """Return True for epochs whose protection level does not cover a possible position on the line, shape (T,).

    Under a hypothesis J, let the sum of squared residuals of a position exceed its minimum by x noise variances. This
    position is the true position with a probability of at most ``Q(sqrt(x))``. For each hypothesis, this probability is
    computed for the best-fitting position beyond the protection level, and multiplied by the prior of J. The result is
    True where the sum over the hypotheses exceeds the risk of a sample. A `scale` below 1 counts as 1. `sides`, shape
    (T, S, M), marks the low satellites of each side of the track.
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
                noise = np.maximum(scale[some], 1.0)
                forms = kernels.off_tangent.forms_of_hypotheses(
                    model.take(some).arrays, noise, likely, np.ascontiguousarray(sides[some]), risk.side_prior, sigmas
                )
                spent = _risk_of_block(index, arc_m[some], level_m[some], Forms(*forms), risk)
                result[some] = spent > risk.risk_per_sample

    over_blocks(fill, (rows[first : first + size] for first in range(0, len(rows), size)))
    return result


def _risk_of_block(index: SearchIndex, arc_m: Floats, level_m: Floats, forms: Forms, risk: RiskBudget) -> Floats:
    """Return an upper bound on the probability of a true position beyond the level and off the tangent, shape (T,)."""
    radius = forms.radius_m(risk.risk_per_sample)
    sections = _around(index, arc_m, level_m, radius.max(axis=1))
    return kernels.off_tangent.risk_beyond(forms.prior, forms.form, radius, *sections)


def _around(
    index: SearchIndex, arc_m: Floats, level_m: Floats, radius_m: Floats
) -> tuple[Indices, Floats, Floats, Floats, Floats]:
    """Return, for each epoch, the line sections within `radius_m` of the position, split at the distance `level_m`.

    Returns
    -------
    first : ndarray of int, shape (T + 1,)
        Index of each epoch's first section, followed by the total number P of sections.
    start_m, tangent : ndarray, shape (P, 3)
        Start point relative to the position and unit vector of each section, as components along, across and up.
    length_m : ndarray, shape (P,)
    beyond_m : ndarray, shape (P,)
        Distance of each section from the position; infinite for sections within the level or near the tangent.
    """
    line = index.trajectory
    here, place = line.segment_at(arc_m)[0], line.at_arc(arc_m)
    axes = line.get_axes(here)
    lists = index.tree.query_ball_point(place, radius_m + line.length_m.max(), return_sorted=True)
    count = np.fromiter(map(len, lists), dtype=np.intp, count=len(lists))
    vertex = np.fromiter(chain.from_iterable(lists), dtype=np.intp, count=int(count.sum()))
    epoch = np.repeat(np.arange(len(arc_m)), count)
    inside = vertex < len(line.length_m)
    epoch, vertex = epoch[inside], vertex[inside]
    start = np.einsum("pij,pj->pi", axes[epoch], line.ecef_m[vertex] - place[epoch])
    tangent, length = np.einsum("pij,pj->pi", axes[epoch], line.tangent[vertex]), line.length_m[vertex]
    # |start + s tangent| = level has two roots s; the level covers the part of the section between the roots.
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

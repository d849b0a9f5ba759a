"""Bound of the probability that the true place lies off the tangent at the position.

Under each hypothesis of the level (no fault, one faulty satellite, two, those of a side) the weighted sum of squared
residuals is a quadratic form in the place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from scipy.special import ndtr

from railfix.core.arrays import Floats, Indices, Masks
from railfix.integrity.protection.risk import one_sided_k, pair_sum
from railfix.integrity.protection.separation import one_after_the_other
from railfix.integrity.raim import LinearModel
from railfix.integrity.raim.exclusion import LEAST_REDUNDANCY
from railfix.integrity.raim.model import Compact, ModelArrays, compact
from railfix.kernels import compiled_by
from railfix.positioning.normal_equations import inverse_3x3

#: Furthest places looked at [m]: the linear model of a range is off by 0.7 m there.
_FURTHEST_M: Final = 5000.0
#: Share of the risk of a sample below which places are not looked for.
_NEGLIGIBLE: Final = 0.01


@dataclass(frozen=True)
class Forms:
    """Sum of squared residuals in variances, over the place d from the position, under K hypotheses, T epochs.

    ``q(d) = constant - 2 d . slope + d^T matrix d``, d along, across and up at the position.
    """

    prior: Floats  # (T, K)
    constant: Floats  # (T, K)
    slope: Floats  # (T, K, 3) [1/m]
    matrix: Floats  # (T, K, 3, 3) [1/m^2]

    def take(self, epochs: Indices) -> Forms:
        """Return the forms of some epochs, by index."""
        return Forms(self.prior[epochs], self.constant[epochs], self.slope[epochs], self.matrix[epochs])

    def beside(self, *others: Forms) -> Forms:
        """Return these and other hypotheses of the same epochs together."""
        every = (self, *others)
        return Forms(*(np.concatenate([getattr(f, item.name) for f in every], axis=1) for item in fields(Forms)))

    def coefficients(self) -> Floats:
        """Return the coefficients of `open_places._Sections.monomials`, shape (T, 10, K)."""
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


def whitened(model: LinearModel, plan: float, height: float, scale: Floats) -> tuple[Compact, Floats, Forms]:
    """Return the residuals with the map error in the noise, their change with the place, and the form without fault.

    The map error is taken alike in all horizontal directions: another place has another tangent.

    Parameters
    ----------
    model : LinearModel
        T epochs, on the line.
    plan, height : float [m]
        Sigmas of the map.
    scale : ndarray, shape (T,)
        Noise scale of the ranges.

    Returns
    -------
    parts : Compact
        n channels side by side.
    design : ndarray, shape (T, n, 3) [1/m]
        Decrease of their residuals by a step along, across and up.
    none : Forms
        K = 1.
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


@compiled_by("off_tangent")
def risk_off_tangent(
    model: ModelArrays,
    scale: Floats,
    likely: Floats,
    sides: Masks,
    side_prior: float,
    clear_m: Floats,
    sigma_plan_m: float,
    sigma_height_m: float,
    enough: float,
) -> Floats:
    """Return an upper bound of the probability that the true place lies off the tangent beyond a distance.

    At a distance D along and across a form exceeds its value at the position by ``(D - |c|)^2 / trace(C) - c . s`` at
    least: c its lowest place and C the inverse of its matrix, both along and across, and s its slope. Without the
    channels J the matrix is at least ``1 - tau`` times that of all, ``tau = trace(F_J C F_J^T S_JJ^-1)`` with their
    rows F_J of the design: the largest tau of one channel and of two decides most epochs. In the others each subset has
    its own bound.

    Parameters
    ----------
    model : ModelArrays
        T epochs by M channels.
    scale : ndarray, shape (T,)
    likely : ndarray, shape (M,)
        Probability of a fault of each channel.
    sides : ndarray of bool, shape (T, S, M)
        Channels that are faulty together.
    side_prior : float
        Probability of that.
    clear_m : ndarray, shape (T,) [m]
        Distance within which no place is off the tangent.
    sigma_plan_m, sigma_height_m : float [m]
    enough : float
        Probability up to which a loose bound will do.

    Returns
    -------
    ndarray, shape (T,)
        Summed over no fault, one faulty satellite, two and those of a side.
    """
    parts, rows, none = whitened(LinearModel.on_line(model), sigma_plan_m, sigma_height_m, scale)
    prior = np.where(parts.used, likely[parts.channel], 0.0)
    side = without_sides(parts, rows, none, sides, side_prior)
    of_sides = _bounded(
        side.prior,
        [side.slope[..., a] for a in range(3)],
        {(a, b): side.matrix[..., a, b] for a in range(3) for b in range(a, 3)},
        clear_m,
    )
    bound = of_sides + _loose(parts.projector, rows, prior, none, clear_m)
    near = np.flatnonzero(~(bound <= enough))
    if len(near):
        bound[near] = of_sides[near] + _tight(parts.take(near), rows[near], prior[near], none.take(near), clear_m[near])
    return bound


def without_sides(parts: Compact, design: Floats, none: Forms, sides: Masks, prior: float) -> Forms:
    """Return the forms with the channels of each side left out, K = S; prior 0 where fewer than two are in use.

    Parameters
    ----------
    parts, design, none
        As `whitened` returns them.
    sides : ndarray of bool, shape (T, S, M)
    prior : float
    """
    n, forms = parts.channel.shape[1], []
    columns = np.concatenate([parts.projector, parts.residual[..., None], design], axis=2)
    for c in range(sides.shape[1]):
        members = np.take_along_axis(sides[:, c], parts.channel, axis=1) & parts.used
        rows, scaled, _ = one_after_the_other(columns, members)
        residual, own = rows[..., n], rows[..., n + 1 :]
        forms.append(
            Forms(
                prior=np.where(np.count_nonzero(members, axis=1) > 1, prior, 0.0)[:, None],
                constant=none.constant - np.einsum("tm,tm->t", residual, scaled[..., n])[:, None],
                slope=none.slope - np.einsum("tm,tmi->ti", residual, scaled[..., n + 1 :])[:, None],
                matrix=none.matrix - np.einsum("tmi,tmj->tij", own, scaled[..., n + 1 :])[:, None],
            )
        )
    empty = Forms(none.prior[:, :0], none.constant[:, :0], none.slope[:, :0], none.matrix[:, :0])
    return empty.beside(*forms)


def _loose(projector: Floats, design: Floats, prior: Floats, none: Forms, clear_m: Floats) -> Floats:
    """Return the bound of `risk_off_tangent` by the largest tau of one channel and of two, shape (T,)."""
    covariance, slope = inverse_3x3(none.matrix[:, 0]), none.slope[:, 0]
    spread = covariance[:, 0, 0] + covariance[:, 1, 1]
    start = np.sqrt(np.maximum(np.einsum("ti,tij,tj->t", slope, covariance, slope), 0.0))
    effect = design @ covariance @ design.swapaxes(1, 2)
    share, own = np.einsum("tii->ti", projector), np.einsum("tii->ti", effect)
    checked = share > LEAST_REDUNDANCY
    of_one = np.where(checked, own / np.where(checked, share, 1.0), 0.0).max(axis=1)
    product = share[:, :, None] * share[:, None, :]
    determinant = product - projector * projector
    size = share[:, :, None] * own[:, None, :]
    size = size + size.swapaxes(1, 2) - 2.0 * projector * effect
    regular = checked[:, :, None] & checked[:, None, :] & (determinant > LEAST_REDUNDANCY * product)
    of_two = np.max(size / np.where(regular, determinant, np.inf), axis=(1, 2))
    # No subset takes more off the sum of squares than there is.
    misfit, total = np.sqrt(np.maximum(none.constant[:, 0], 0.0)), np.zeros(len(clear_m))
    for weight, tau in ((2.0, np.zeros(len(clear_m))), (prior.sum(axis=1), of_one), (pair_sum(prior), of_two)):
        left = np.where(tau < 1.0, 1.0 - tau, np.nan)
        form = (start + np.sqrt(np.maximum(tau, 0.0)) * misfit) ** 2 / left
        gap = np.maximum(clear_m - np.sqrt(spread / left * form), 0.0)
        excess = gap * gap * left / spread - form
        total += weight * np.where(excess > 0.0, ndtr(-np.sqrt(np.maximum(excess, 0.0))), 1.0)
    return total


def _tight(parts: Compact, design: Floats, prior: Floats, none: Forms, clear_m: Floats) -> Floats:
    """Return the bound of `risk_off_tangent` with each hypothesis by itself, shape (T,)."""
    projector, residual, slope, matrix = parts.projector, parts.residual, none.slope[:, 0], none.matrix[:, 0]
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

"""Bound of the probability that the true place lies off the tangent at the position.

Under each hypothesis of the level (no fault, one faulty satellite, two, those of a side) the weighted sum of squared
residuals is a quadratic form in the place.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.integrity.protection.risk import one_sided_k
from railfix.integrity.raim import LinearModel
from railfix.integrity.raim.model import Compact, compact
from railfix.kernels.layout import LEAST_REDUNDANCY
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


def one_after_the_other(columns: Floats, members: Masks) -> tuple[Floats, Floats, Masks]:
    """Leave out a group of channels, each from what those before it leave.

    Parameters
    ----------
    columns : ndarray, shape (T, n, n + c)
        Projector of the residuals, and beside it what changes alike.
    members : ndarray of bool, shape (T, n)

    Returns
    -------
    rows, scaled : ndarray, shape (T, m, n + c)
        Row of each member, and that over its part of the projector; 0 where nothing checks it. Without the group the
        columns are less by ``rows[..., :n]^T scaled``.
    checked : ndarray of bool, shape (T, m)
    """
    at = np.arange(len(columns))
    place = np.argsort(~members, axis=1, kind="stable")[:, : int(np.count_nonzero(members, axis=1).max(initial=0))]
    rows = columns[at[:, None], place] * members[at[:, None], place][..., None]
    scaled, checked = np.empty_like(rows), np.empty(place.shape, dtype=bool)
    for k in range(place.shape[1]):
        row, later = rows[:, k], rows[:, k + 1 :]
        share = row[at, place[:, k]]
        checked[:, k] = share > LEAST_REDUNDANCY
        scaled[:, k] = row / np.where(checked[:, k], share, np.inf)[:, None]
        later -= np.take_along_axis(later, place[:, None, k, None], axis=2) * scaled[:, k, None]
    return rows, scaled, checked

"""Update of Gaussians by measurements with Student's t errors: iterated reweighting of one epoch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.tracking.rows import Kind, Rows
from railfix.tracking.state import Unknown


@dataclass(frozen=True, kw_only=True)
class Update:
    """Gaussians after an epoch.

    Attributes
    ----------
    change : ndarray, shape (H, N)
        Of the mean.
    covariance : ndarray, shape (H, N, N)
    weight : ndarray, shape (H, M)
        1 / (variance inflation) of each row, at most (nu + 1) / nu.
    residual : ndarray, shape (H, M)
        After the update.
    spread : ndarray, shape (H, M)
        Variance of the fitted value.
    log_evidence : ndarray, shape (H,)
        Laplace approximation, up to a constant common to the hypotheses.
    """

    change: Floats
    covariance: Floats
    weight: Floats
    residual: Floats
    spread: Floats
    log_evidence: Floats


def first_weights(rows: Rows, covariance: Floats, degrees: float) -> Floats:
    """Weights from innovations, what a clock common to a kind takes up left out as their median, shape (H, M).

    The clocks begin at every epoch nearly unknown: with their prior in it, the variance of an innovation would
    hide every outlier.
    """
    blind = rows.design.copy()
    blind[:, :, [Unknown.CODE_CLOCK, Unknown.PHASE_CLOCK, Unknown.DRIFT]] = 0.0
    spread = ((blind @ covariance) * blind).sum(axis=-1) + rows.variance
    value = rows.value.copy()
    for mask in rows.common:
        if mask.any():
            value[:, mask] -= np.median(value[:, mask], axis=1, keepdims=True)
    return np.asarray((degrees + 1.0) / (degrees + value**2 / spread))


def robust_update(
    rows: Rows, covariance: Floats, weight: Floats, *, degrees: float, passes: int, use: Masks | None = None
) -> Update:
    """Reweighted least squares of one epoch against its prior.

    Variational form of Student's t (M. E. Tipping and N. D. Lawrence, Variational inference for Student-t models,
    2005): the weight of a row is ``(nu + 1) / (nu + (residual^2 + spread) / variance)``.

    Parameters
    ----------
    rows : Rows
    covariance : ndarray, shape (H, N, N)
        Before the epoch.
    weight : ndarray, shape (H, M)
        Of the first pass.
    degrees : float
    passes : int
    use : ndarray of bool, shape (H, M), optional
        Rows that each Gaussian takes.
    """
    count, _, width = rows.design.shape
    inverse = np.linalg.inv(covariance)
    prior = np.asarray(0.5 * (inverse + np.swapaxes(inverse, 1, 2)), dtype=np.float64)
    transposed = np.swapaxes(rows.design, 1, 2)
    change = np.zeros((count, width))
    after, residual, spread = covariance, rows.value, np.zeros_like(rows.value)
    for turn in range(passes):
        weight = weight if use is None else np.where(use, weight, 0.0)
        scaled = transposed * (weight / rows.variance)[:, None, :]
        after = np.asarray(np.linalg.inv(prior + scaled @ rows.design), dtype=np.float64)
        change = (after @ (scaled @ rows.value[..., None]))[..., 0]
        residual = rows.value - (rows.design @ change[..., None])[..., 0]
        spread = ((rows.design @ after) * rows.design).sum(axis=-1)
        if turn < passes - 1:
            weight = (degrees + 1.0) / (degrees + (residual**2 + spread) / rows.variance)
    after = 0.5 * (after + np.swapaxes(after, 1, 2))
    fit = -0.5 * (degrees + 1.0) * np.log1p(residual**2 / (degrees * rows.variance)).sum(axis=1)
    away = -0.5 * (change[:, None, :] @ prior @ change[:, :, None])[:, 0, 0]
    volume = 0.5 * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(covariance)[1])
    return Update(
        change=change,
        covariance=after,
        weight=weight,
        residual=residual,
        spread=spread,
        log_evidence=fit + away + volume,
    )


def better_mode(
    rows: Rows, covariance: Floats, update: Update, freedom: Floats, *, degrees: float, passes: int
) -> Update:
    """The update from another start where its evidence is larger, hypothesis by hypothesis.

    Student's t has several maxima. The second start frees place, speed and acceleration first: what most
    measurements agree on is found although the prediction contradicts it, and its evidence, with the prediction
    in it, decides.

    Parameters
    ----------
    rows : Rows
    covariance : ndarray, shape (H, N, N)
    update : Update
        From the first start.
    freedom : ndarray, shape (3,)
        Variances added to place, speed and acceleration for the second start.
    degrees : float
    passes : int
    """
    free = covariance.copy()
    diagonal = np.arange(len(freedom))
    free[:, diagonal, diagonal] += freedom
    start = robust_update(rows, free, first_weights(rows, free, degrees), degrees=degrees, passes=passes)
    other = robust_update(rows, covariance, start.weight, degrees=degrees, passes=passes)
    better = other.log_evidence > update.log_evidence
    if not better.any():
        return update

    def chosen(name: str) -> Floats:
        a, b = getattr(other, name), getattr(update, name)
        return np.asarray(np.where(better.reshape((-1,) + (1,) * (a.ndim - 1)), a, b))

    return Update(**{name: chosen(name) for name in update.__dataclass_fields__})


def mean_weight(rows: Rows, weight: Floats, kinds: tuple[Kind, ...]) -> float:
    """Mean weight of the rows of some kinds, NaN without any; `weight` is that of one hypothesis, shape (M,)."""
    mask = rows.of(kinds)
    return float(weight[mask].mean()) if mask.any() else float("nan")

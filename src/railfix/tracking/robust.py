"""Update of Gaussians by measurements with Student's t errors: iterated reweighting of one epoch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.tracking.rows import MOTION, Rows
from railfix.tracking.state import Unknown
from railfix.tracking.student_t import Tails

#: Share of a sensor's variance that no weight takes away: two sensors of the same combination keep it regular.
SENSOR_FLOOR: Final = 1e-6

#: Mean weight of codes, or of phases and Dopplers, under which another start of the reweighting is tried.
DOUBTFUL: Final = 0.7
#: Variances of place and speed added for that start [m2, m2/s2].
FREEDOM: Final = np.array([30.0**2, 10.0**2])
#: The equations are made again when a place has moved by more than this [m]: 26 000 km away a range bends by 2 cm
#: over 1 km, the line by 1 m over 20 m in its sharpest curves.
MOVED_M: Final = 2.0
RELINEARISED: Final = 4


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Gaussians of the combinations of one epoch before its measurements.

    Attributes
    ----------
    root : ndarray, shape (H, D)
        Standard deviations of the combinations; everything else counts in them.
    gain : ndarray, shape (H, N, D)
        Covariance of unknowns with combinations times `information`.
    covariance, information : ndarray, shape (H, D, D)
    design : ndarray, shape (H, M, D)
    """

    root: Floats
    gain: Floats
    covariance: Floats
    information: Floats
    design: Floats


@dataclass(frozen=True, kw_only=True)
class Update:
    """Gaussians of the combinations after an epoch.

    Attributes
    ----------
    change : ndarray, shape (H, D)
        Of the mean.
    covariance : ndarray, shape (H, D, D)
    weight : ndarray, shape (H, M)
        1 / (variance inflation) of each row, at most (nu + 1) / nu.
    residual : ndarray, shape (H, M)
        After the update.
    spread : ndarray, shape (H, M)
        Variance of the fitted value.
    """

    change: Floats
    covariance: Floats
    weight: Floats
    residual: Floats
    spread: Floats


def prior_of(rows: Rows, covariance: Floats) -> Prior:
    """The combinations before the epoch, of unknowns with a covariance of shape (H, N, N)."""
    cross = covariance @ np.swapaxes(rows.combine, 1, 2)
    own = rows.combine @ cross
    diagonal = np.arange(own.shape[1])
    variance = own[:, diagonal, diagonal]
    variance[:, rows.bounds[0] + 1 + MOTION :] += SENSOR_FLOOR * rows.variance[rows.bounds[2] :]
    root = np.sqrt(variance)
    scale = 1.0 / root
    own = own * scale[:, :, None] * scale[:, None, :]
    own[:, diagonal, diagonal] = 1.0
    information = _inverse(own)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    gain = (cross * scale[:, None, :]) @ information
    return Prior(root=root, gain=gain, covariance=own, information=information, design=rows.design * root[:, None, :])


def first_weights(rows: Rows, prior: Prior, tails: Tails, freedom: Floats | None = None) -> Floats:
    """Weights from innovations, what a clock common to a kind takes up left out as their median, shape (H, M).

    The clocks begin at every epoch nearly unknown: with their prior in it, the variance of an innovation would
    hide every outlier.

    Parameters
    ----------
    rows : Rows
    prior : Prior
    tails : Tails
    freedom : ndarray, shape (2,), optional
        Variances added to place and speed.
    """
    codes = rows.bounds[0]
    blind = prior.design.copy()
    blind[:, :, [codes, codes + 2, codes + MOTION]] = 0.0
    spread = ((blind @ prior.covariance) * blind).sum(axis=-1) + rows.variance
    if freedom is not None:
        spread += _freed(rows, Unknown.PLACE) ** 2 * freedom[0] + _freed(rows, Unknown.SPEED) ** 2 * freedom[1]
    value = rows.value.copy()
    for part in rows.common:
        if part.stop > part.start:
            value[:, part] -= median(value[:, part])[:, None]
    return tails.weight(value, value**2 / spread, codes)


def _inverse(matrices: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _freed(rows: Rows, unknown: Unknown) -> Floats:
    """Coefficients of an unknown in each row, shape (H, M)."""
    return np.asarray((rows.design @ rows.combine[:, :, unknown, None])[..., 0])


def median(values: Floats) -> Floats:
    """Median over the last axis, which has at least one element."""
    ordered = np.sort(values, axis=-1)
    middle = values.shape[-1] // 2
    if values.shape[-1] % 2:
        return np.asarray(ordered[..., middle])
    return np.asarray(0.5 * (ordered[..., middle - 1] + ordered[..., middle]))


def robust_update(
    rows: Rows,
    prior: Prior,
    weight: Floats,
    *,
    tails: Tails,
    passes: int,
    use: Masks | None = None,
    information: Floats | None = None,
) -> Update:
    """Reweighted least squares of one epoch against its prior.

    Variational form of Student's t (M. E. Tipping and N. D. Lawrence, Variational inference for Student-t models,
    2005): the weight of a row is ``(nu + 1) / (nu + (residual^2 + spread) / variance)``, that of a late code `Tails`.

    Parameters
    ----------
    rows : Rows
    prior : Prior
    weight : ndarray, shape (H, M)
        Of the first pass.
    tails : Tails
    passes : int
    use : ndarray of bool, shape (H, M), optional
        Rows that each Gaussian takes.
    information : ndarray, shape (H, D, D), optional
        Instead of that of the prior.
    """
    design, information = prior.design, prior.information if information is None else information
    transposed = np.swapaxes(design, 1, 2)
    change = np.zeros(design.shape[::2])
    after, residual, spread = prior.covariance, rows.value, np.zeros_like(rows.value)
    for turn in range(passes):
        weight = weight if use is None else np.where(use, weight, 0.0)
        scaled = transposed * (weight / rows.variance)[:, None, :]
        after = _inverse(information + scaled @ design)
        change = (after @ (scaled @ rows.value[..., None]))[..., 0]
        residual = rows.value - (design @ change[..., None])[..., 0]
        spread = ((design @ after) * design).sum(axis=-1)
        if turn < passes - 1:
            weight = tails.weight(residual, (residual**2 + spread) / rows.variance, rows.bounds[0])
    return Update(change=change, covariance=after, weight=weight, residual=residual, spread=spread)


def log_evidence(rows: Rows, prior: Prior, update: Update, tails: Tails) -> Floats:
    """Logarithm of the evidence by Laplace's approximation, up to a constant common to the hypotheses, shape (H,)."""
    fit = tails.log_density(update.residual, update.residual**2 / rows.variance, rows.bounds[0]).sum(axis=1)
    change = update.change
    away = -0.5 * (change[:, None, :] @ prior.information @ change[:, :, None])[:, 0, 0]
    volume = 0.5 * (np.linalg.slogdet(update.covariance)[1] + np.linalg.slogdet(prior.information)[1])
    return np.asarray(fit + away + volume)


def motion_evidence(rows: Rows, prior: Prior, update: Update, *, tails: Tails, passes: int) -> Floats:
    """Logarithm of the evidence of all measurements but the codes, shape (H,); 0 without any."""
    use = np.ones(rows.value.shape, dtype=np.bool_)
    use[:, rows.codes] = False
    alone = robust_update(rows, prior, update.weight, tails=tails, passes=passes, use=use)
    residual = np.where(use, alone.residual, 0.0)
    return log_evidence(rows, prior, replace(alone, residual=residual), tails)


def applied(mean: Floats, covariance: Floats, prior: Prior, update: Update) -> tuple[Floats, Floats]:
    """Mean and covariance of all unknowns after the update of the combinations, shapes (H, N) and (H, N, N)."""
    less = prior.covariance - update.covariance
    after = covariance - prior.gain @ less @ np.swapaxes(prior.gain, 1, 2)
    after = 0.5 * (after + np.swapaxes(after, 1, 2))
    return mean + (prior.gain @ update.change[..., None])[..., 0], after


def better_mode(rows: Rows, prior: Prior, update: Update, freedom: Floats, *, tails: Tails, passes: int) -> Update:
    """The update from another start where its evidence is larger, hypothesis by hypothesis.

    Student's t has several maxima. The second start frees place and speed first: what most
    measurements agree on is found although the prediction contradicts it, and its evidence, with the prediction
    in it, decides.

    Parameters
    ----------
    rows : Rows
    prior : Prior
    update : Update
        From the first start.
    freedom : ndarray, shape (2,)
        Variances added to place and speed for the second start.
    tails : Tails
    passes : int
    """
    freed = np.stack([rows.combine[:, :, unknown] / prior.root for unknown in (Unknown.PLACE, Unknown.SPEED)], axis=2)
    free = prior.covariance + (freed * freedom) @ np.swapaxes(freed, 1, 2)
    weight = first_weights(rows, prior, tails, freedom)
    start = robust_update(rows, prior, weight, tails=tails, passes=passes, information=_inverse(free))
    other = robust_update(rows, prior, start.weight, tails=tails, passes=passes)
    better = log_evidence(rows, prior, other, tails) > log_evidence(rows, prior, update, tails)
    if not better.any():
        return update

    def chosen(name: str) -> Floats:
        a, b = getattr(other, name), getattr(update, name)
        return np.asarray(np.where(better.reshape((-1,) + (1,) * (a.ndim - 1)), a, b))

    return Update(**{name: chosen(name) for name in update.__dataclass_fields__})


def mean_weight(weight: Floats, part: slice) -> Floats:
    """Mean weight of some rows, NaN without any, shape (H,); `weight` has shape (H, M)."""
    if part.stop == part.start:
        return np.full(len(weight), np.nan)
    return np.asarray(weight[:, part].mean(axis=1))

"""Hypotheses over places of the line: where they begin."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.geodesy import range_with_rotation
from railfix.kernels.tracking.constants import CODE_CLOCK_SIGMA_M
from railfix.tracking.chunk import Chunk
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import CLOCKS, OFFSETS, SATELLITES, StateIndex

#: The line is searched at points this far apart; a Gaussian of `start_sigma_m` covers what lies between, and codes
#: count with the error that a place between two points makes [m].
_SPACING_M: Final = 15.0
#: Codes beyond place and clocks that places are sought with: with one alone a wrong place fits as well.
REDUNDANT: Final = 2
#: Places whose logarithm of likelihood is this far below the best are not begun with.
_WORSE: Final = 25.0
#: Standard deviation of an unknown speed: no train is faster than twice this [m/s].
_ANY_SPEED_MPS: Final = 50.0
_ANY_DRIFT_MPS: Final = 1e3
#: Priors of the sensors: a wheel worn or entered wrongly by 2 %, an accelerometer's offset and mounting, a radar's
#: angle.
WHEEL_PRIOR: Final = 0.02
FORCE_PRIOR_MPS2: Final = 0.1
RADAR_PRIOR: Final = 0.02
#: Standard deviation of the speed beyond a bend [m/s], and the share of probability that places beside get.
_BEND_SPEED_MPS: Final = 10.0
_BESIDE_SHARE: Final = 0.01
#: What a new hypothesis takes over from a lost track: its error has gone into everything else.
_KEPT: Final = np.array([StateIndex.WHEEL, StateIndex.FORCE_OFFSET, StateIndex.RADAR])


def places(chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits) -> tuple[Floats, Floats]:
    """Places along the line that the codes of an epoch are consistent with.

    Returns
    -------
    arc_m : ndarray, shape (C,) [m]
        Local maxima of the likelihood with Student's t errors, the best first; empty with fewer than `REDUNDANT`
        codes beyond the unknowns.
    sigma_m : ndarray, shape (C,) [m]
        Half of the stretch that is about as likely, at least `start_sigma_m`.
    """
    has = chunk.has[0, epoch]
    groups = [has & (chunk.offset == g) for g in range(len(CLOCKS))]
    groups = [group for group in groups if group.sum() > 1]
    if sum(int(group.sum()) - 1 for group in groups) < 1 + REDUNDANT:
        return np.empty(0), np.empty(0)
    keep = _thin(line)
    arc, points = line.arc_m[keep], line.ecef_m[keep]
    likelihood = np.zeros(len(arc))
    tails = limits.tails
    for group in groups:
        distance, _ = range_with_rotation(chunk.sat_ecef_m[epoch, group], points[:, None, :])
        residual = chunk.measured[0, epoch, group] - distance
        variance = (1.0 + limits.code_white_share**2) * chunk.code_sigma_m[epoch, group] ** 2 + _SPACING_M**2 / 12.0
        clock = np.median(residual, axis=1, keepdims=True)
        for _ in range(limits.passes):
            away = residual - clock
            weight = tails.weight(away, away**2 / variance, away.shape[1]) / variance
            clock = (weight * residual).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
        away = residual - clock
        likelihood += tails.log_density(away, away**2 / variance, away.shape[1]).sum(axis=1)
    order = np.argsort(-likelihood, kind="stable")
    order = order[likelihood[order] > likelihood[order[0]] - _WORSE]
    chosen: list[int] = []
    for candidate in order.tolist():
        apart = np.abs(line.nearest_m(arc[chosen], arc[candidate]) - arc[candidate])
        if (apart > limits.start_separation_m).all():
            chosen.append(candidate)
        if len(chosen) == limits.most_hypotheses:
            break
    sigma = np.full(len(chosen), limits.start_sigma_m)
    return arc[chosen], sigma


def _thin(line: Line) -> Indices:
    """Vertices about `_SPACING_M` apart."""
    marks = np.arange(line.arc_m[0], line.arc_m[-1] + _SPACING_M, _SPACING_M)
    return np.unique(np.minimum(np.searchsorted(line.arc_m, marks), len(line.arc_m) - 1))


def begin(
    arc_m: Floats,
    sigma_m: Floats,
    satellites: int,
    line: Line,
    limits: TrackingLimits,
    *,
    known: tuple[Floats, Floats] | None = None,
) -> tuple[Floats, Floats]:
    """Mean and covariance of new hypotheses at places, shapes (H, N) and (H, N, N).

    Parameters
    ----------
    arc_m, sigma_m : ndarray, shape (H,) [m]
    satellites : int
        Errors of satellites in the state.
    line : Line
    limits : TrackingLimits
    known : tuple of ndarray, shapes (N,) and (N, N), optional
        Mean and covariance of a lost track: what it knew of the sensors is kept, clocks and satellites begin anew.
    """
    width = SATELLITES + satellites
    mean = np.zeros((len(arc_m), width))
    mean[:, StateIndex.ARC] = mean[:, StateIndex.PREVIOUS_ARC] = arc_m
    variance = np.ones((len(arc_m), width))
    variance[:, StateIndex.ARC] = variance[:, StateIndex.PREVIOUS_ARC] = sigma_m**2
    variance[:, StateIndex.SPEED] = variance[:, StateIndex.PREVIOUS_SPEED] = _ANY_SPEED_MPS**2
    variance[:, StateIndex.ACCELERATION] = limits.acceleration_mps2**2
    variance[:, StateIndex.DRIFT] = _ANY_DRIFT_MPS**2
    variance[:, StateIndex.MAP_RIGHT] = line.sigma_plan_m**2
    variance[:, StateIndex.MAP_UP] = line.sigma_height_m**2
    variance[:, StateIndex.CODE_PLACE] = limits.slow_code_m**2
    variance[:, StateIndex.DOPPLER_SPEED] = limits.doppler_error_mps**2
    variance[:, StateIndex.WHEEL] = WHEEL_PRIOR**2
    variance[:, StateIndex.FORCE_OFFSET] = FORCE_PRIOR_MPS2**2
    variance[:, StateIndex.RADAR] = RADAR_PRIOR**2
    variance[:, OFFSETS:SATELLITES] = limits.offset_prior_m**2
    covariance = np.zeros((len(arc_m), width, width))
    diagonal = np.arange(width)
    covariance[:, diagonal, diagonal] = variance
    covariance[:, StateIndex.CODE_CLOCK, StateIndex.CODE_CLOCK] = CODE_CLOCK_SIGMA_M**2
    covariance[:, StateIndex.PHASE_CLOCK, StateIndex.PHASE_CLOCK] = CODE_CLOCK_SIGMA_M**2
    if known is not None:
        mean[:, _KEPT] = known[0][_KEPT]
        covariance[:, _KEPT[:, None], _KEPT] = known[1][_KEPT[:, None], _KEPT]
    return mean, covariance


def split(
    mean: Floats, covariance: Floats, log_probability: float, arc_m: Floats, sigma_m: Floats
) -> tuple[Floats, Floats, Floats]:
    """Narrower hypotheses within a wide one, about places; probabilities by its density there.

    Parameters
    ----------
    mean, covariance : ndarray, shapes (N,), (N, N)
        The wide hypothesis.
    log_probability : float
    arc_m, sigma_m : ndarray, shape (C,) [m]
    """
    place = StateIndex.ARC
    wide = covariance[place, place]
    gain = covariance[:, place] / wide
    means = mean + gain * (arc_m - mean[place])[:, None]
    narrower = covariance - np.outer(gain, gain) * wide
    covariances = narrower + np.outer(gain, gain) * (sigma_m**2)[:, None, None]
    log_weight = -0.5 * (arc_m - mean[place]) ** 2 / wide + np.log(sigma_m)
    return means, covariances, log_probability + log_weight - np.logaddexp.reduce(log_weight)


def beside(mean: Floats, covariance: Floats, limits: TrackingLimits) -> tuple[Floats, Floats, Floats]:
    """Mean, covariance and logarithm of the share of hypotheses a little before and after one, its speed unknown.

    Where a line turns back within some tens of metres, Dopplers fit one leg run forward and the other run backward
    alike, and a step of the estimate over the bend is none of the equations linearised before it. Contradicted by its
    motion, the place beyond the bend must be tried.

    Parameters
    ----------
    mean, covariance : ndarray, shapes (N,), (N, N)
    limits : TrackingLimits
    """
    steps = limits.bend_m * np.array([-2.0, -1.0, 1.0, 2.0])
    gain = np.zeros(len(mean))
    gain[[StateIndex.ARC, StateIndex.PREVIOUS_ARC]] = 1.0
    means = mean + gain * steps[:, None]
    wider = covariance + np.outer(gain, gain) * (0.5 * limits.bend_m) ** 2
    for unknown, sigma in ((StateIndex.SPEED, _BEND_SPEED_MPS), (StateIndex.ACCELERATION, limits.acceleration_mps2)):
        wider[unknown, unknown] += sigma**2
    covariances = np.repeat(wider[None], len(steps), axis=0)
    return means, covariances, np.full(len(steps), np.log(_BESIDE_SHARE / len(steps)))

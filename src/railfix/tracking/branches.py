"""Hypotheses over places of the line: where they begin, how they are joined and dropped."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.geodesy import range_with_rotation
from railfix.tracking.chunk import Chunk
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.predict import CODE_CLOCK_SIGMA_M
from railfix.tracking.state import CLOCKS, OFFSETS, SATELLITES, Unknown

#: The line is searched at points this far apart; a Gaussian of `start_sigma_m` covers what lies between, and codes
#: count with the error that a place between two points makes [m].
_SPACING_M: Final = 15.0
#: Places whose logarithm of likelihood is this far below the best are not begun with.
_WORSE: Final = 12.0
#: Standard deviation of an unknown speed: no train is faster than twice this [m/s].
_ANY_SPEED_MPS: Final = 50.0
_ANY_DRIFT_MPS: Final = 1e3
#: Priors of the sensors: a wheel worn or entered wrongly by 2 %, an accelerometer's offset and mounting, a radar's
#: angle.
WHEEL_PRIOR: Final = 0.02
FORCE_PRIOR_MPS2: Final = 0.1
RADAR_PRIOR: Final = 0.02
#: How much more probable another place must be to be gone by: near-equal ones would take turns.
SWITCH: Final = 3.0
#: Logarithm of the odds that a difference of one `map_branch_m` can give: 1 / (2 s^2) with s^2 = 2 (1/3)^2.
MOST_ODDS: Final = 2.25
#: Standard deviation of the speed beyond a bend [m/s], and the share of probability that places beside get.
_BEND_SPEED_MPS: Final = 10.0
_BESIDE_SHARE: Final = 0.01
#: Places beside are tried once motion has been contradicted for so long [s]: shorter it is a reflection, at any rate.
BESIDE_AFTER_S: Final = 0.9
#: What a new hypothesis takes over from a lost track: its error has gone into everything else.
_KEPT: Final = np.array([Unknown.WHEEL, Unknown.FORCE_OFFSET, Unknown.RADAR])


def places(chunk: Chunk, epoch: int, line: Line, limits: TrackingLimits) -> tuple[Floats, Floats]:
    """Places along the line that the codes of an epoch are consistent with.

    Returns
    -------
    arc_m : ndarray, shape (C,) [m]
        Local maxima of the likelihood with Student's t errors, the best first; empty without redundant codes.
    sigma_m : ndarray, shape (C,) [m]
        Half of the stretch that is about as likely, at least `start_sigma_m`.
    """
    has = chunk.has[0, epoch]
    groups = [has & (chunk.offset == g) for g in range(len(CLOCKS))]
    groups = [group for group in groups if group.sum() > 1]
    if sum(int(group.sum()) - 1 for group in groups) < 1:
        return np.empty(0), np.empty(0)
    keep = _thinned(line)
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


def _thinned(line: Line) -> Indices:
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
    mean[:, Unknown.PLACE] = mean[:, Unknown.BEFORE] = arc_m
    variance = np.ones((len(arc_m), width))
    variance[:, Unknown.PLACE] = variance[:, Unknown.BEFORE] = sigma_m**2
    variance[:, Unknown.SPEED] = variance[:, Unknown.SPEED_BEFORE] = _ANY_SPEED_MPS**2
    variance[:, Unknown.ACCELERATION] = limits.acceleration_mps2**2
    variance[:, Unknown.DRIFT] = _ANY_DRIFT_MPS**2
    variance[:, Unknown.MAP_RIGHT] = line.sigma_plan_m**2
    variance[:, Unknown.MAP_UP] = line.sigma_height_m**2
    variance[:, Unknown.CODE_PLACE] = limits.slow_code_m**2
    variance[:, Unknown.DOPPLER_SPEED] = limits.doppler_error_mps**2
    variance[:, Unknown.WHEEL] = WHEEL_PRIOR**2
    variance[:, Unknown.FORCE_OFFSET] = FORCE_PRIOR_MPS2**2
    variance[:, Unknown.RADAR] = RADAR_PRIOR**2
    variance[:, OFFSETS:SATELLITES] = limits.offset_prior_m**2
    covariance = np.zeros((len(arc_m), width, width))
    diagonal = np.arange(width)
    covariance[:, diagonal, diagonal] = variance
    covariance[:, Unknown.CODE_CLOCK, Unknown.CODE_CLOCK] = CODE_CLOCK_SIGMA_M**2
    covariance[:, Unknown.PHASE_CLOCK, Unknown.PHASE_CLOCK] = CODE_CLOCK_SIGMA_M**2
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
    place = Unknown.PLACE
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
    means = np.repeat(mean[None], len(steps), axis=0)
    means[:, Unknown.PLACE] += steps
    covariances = np.repeat(covariance[None], len(steps), axis=0)
    for unknown, sigma in (
        (Unknown.PLACE, 0.5 * limits.bend_m),
        (Unknown.SPEED, _BEND_SPEED_MPS),
        (Unknown.ACCELERATION, limits.acceleration_mps2),
    ):
        covariances[:, unknown, unknown] += sigma**2
    return means, covariances, np.full(len(steps), np.log(_BESIDE_SHARE / len(steps)))


def judged(log_probability: Floats, log_evidence: Floats, ecef_m: Floats, limits: TrackingLimits) -> Floats:
    """Probabilities after an epoch, up to a constant, where branches may lie within the error of the map, shape (H,).

    Two branches a few metres apart differ in their ranges by as much as the map may be wrong, at every epoch alike:
    summed over epochs the difference would decide between them, and often wrongly. The difference to the most probable
    hypothesis counts by ``d^2 / (d^2 + map_branch_m^2)`` with their distance d, and takes the logarithm of their odds
    no further than ``d^2 / (2 s^2)``, all that a place known without noise could say with a map that is wrong by
    map_branch_m / 3 at each branch (s^2 twice its square). What motion decided while they were apart stays.

    Parameters
    ----------
    log_probability : ndarray, shape (H,)
        Before the epoch.
    log_evidence : ndarray, shape (H,)
        Of this epoch.
    ecef_m : ndarray, shape (H, 3) [m]
        Places of the hypotheses.
    limits : TrackingLimits
    """
    best = int(np.argmax(log_probability))
    square = ((ecef_m - ecef_m[best]) ** 2).sum(axis=1)
    before = log_probability - log_probability[best]
    after = before + square / (square + limits.map_branch_m**2) * (log_evidence - log_evidence[best])
    most = MOST_ODDS * square / limits.map_branch_m**2
    return np.asarray(np.clip(after, np.minimum(before, -most), np.maximum(before, most)))


def on_the_line(mean: Floats, covariance: Floats, line: Line, limits: TrackingLimits) -> Floats:
    """Means with places a little beyond an end of the line put on it, shape (H, N).

    Projection on the constraint along the correlations (D. Simon, Kalman filtering with state constraints, 2010); a
    place within two sigmas of it is noise, and one further out than a start may be wrong is left: the map may end
    before the line.
    """
    place = mean[:, Unknown.PLACE]
    excess = np.clip(place, *line.bounds_m) - place
    sigma = np.sqrt(covariance[:, Unknown.PLACE, Unknown.PLACE])
    excess = np.where((np.abs(excess) > 2.0 * sigma) & (np.abs(excess) <= limits.start_sigma_m), excess, 0.0)
    if not excess.any():
        return mean
    gain = covariance[:, :, Unknown.PLACE] / covariance[:, Unknown.PLACE, Unknown.PLACE, None]
    return np.asarray(mean + gain * excess[:, None])


def most_probable(log_probability: Floats) -> int:
    """The hypothesis to go by: that of before, the first, unless another is `SWITCH` times as probable."""
    best = int(np.argmax(log_probability))
    return best if log_probability[best] > log_probability[0] + np.log(SWITCH) else 0


def surviving(
    mean: Floats, covariance: Floats, log_probability: Floats, origin_m: Floats, limits: TrackingLimits
) -> tuple[Indices, Floats]:
    """Hypotheses to go on with, the most probable first, and their probabilities.

    Those that have come to the same place count as one. Improbable ones are dropped once all have travelled far
    enough for their motion to have told them apart.
    """
    order = np.argsort(-log_probability, kind="stable")
    first = most_probable(log_probability)
    order = np.concatenate([[first], order[order != first]])
    place = mean[:, Unknown.PLACE]
    sigma = np.sqrt(covariance[:, Unknown.PLACE, Unknown.PLACE])
    kept: list[int] = []
    joined = log_probability.copy()
    for one in order.tolist():
        twin = next((k for k in kept if abs(place[one] - place[k]) < max(2.0, sigma[one] + sigma[k])), None)
        if twin is None:
            kept.append(one)
        else:
            joined[twin] = np.logaddexp(joined[twin], joined[one])
    chosen = np.array(kept[: limits.most_hypotheses], dtype=np.intp)
    probability = joined[chosen] - np.logaddexp.reduce(joined[chosen])
    travelled = np.abs(place[chosen] - origin_m[chosen])
    if travelled[0] >= limits.decided_travel_m:
        alive = probability > np.log(limits.least_probability)
        chosen, probability = chosen[alive], probability[alive]
        probability = probability - np.logaddexp.reduce(probability)
    return chosen, probability

"""Track selection at standstill from codes and carrier phases (P1 2.5).

A hypothesis is a track together with the direction in which the train faces. The track *none* stands for a parallel
track that is missing from the map. At standstill, each satellite's code has a constant bias, so that the covariance of
the mean does not decrease with the number of epochs. The posterior probability of a hypothesis is proportional to its
prior times the likelihood integrated along the track. A track is selected when the total posterior probability of all
other tracks is below the allowed risk. If the error model is correct, this also bounds the probability of a wrong
decision (a posterior is a martingale; Baum & Veeravalli 1994, doi:10.1109/18.340472).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy
from pydantic import Field

from railfix.core.arrays import Floats, Strings
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.positioning.standstill_phase import CodePlace, MeanPhases, phase_log_likelihood, uniform_log_likelihood
from railfix.track.network import ANTENNA_SIGMA_M, ANTENNA_UP_M, CLEARANCE_M, UNMAPPED_PRIOR

#: Integration step along the track [m].
_ALONG_M: Final = 0.25
#: Integration step across the track [m].
_ACROSS_M: Final = 0.3
#: Relative weight of an unmapped track within the clearance of a mapped track; such a track exists only if the map is
#: displaced. An unmapped track farther away has the weight 1.
_BETWEEN_SHARE: Final = 0.1
#: Minimum distance of an unmapped track from a mapped track [m].
_BETWEEN_M: Final = 1.2
#: No track is selected if the code position is more than this number of sigmas from the most probable track.
_LARGEST_MISFIT: Final = 4.0
#: The likelihood is integrated along the track up to this distance from the code position, in both directions [m].
_REACH_M: Final = 40.0
_LEAST_ELEVATION_DEG: Final = 10.0  #: Errors below this elevation are as large as at this elevation.
#: Residual atmospheric error of the phase difference of two receivers, as a fraction of the distance between them.
_PHASE_SHARE: Final = 1e-6
#: Phases are not evaluated for hypotheses whose log likelihood from codes is more than this below the largest.
_UNLIKELY: Final = 25.0
#: In the phase search, the position along the track and the height have this standard deviation [m].
_ANY_PLACE_M: Final = 50.0
#: Significance level of the chi-square test of the code residuals.
_MISFIT: Final = 1e-4
NONE: Final = "none"
_FREEDOM: Final = 8.0  #: Degrees of freedom of the Student's t distribution of height errors.
#: Probability that, during a standstill, an undetected slip or half cycle affects the phases.
_PHASE_FAULT_PRIOR: Final = 1e-3
_UNMAPPED_WIDTH_M: Final = 60.0  #: Width of the strip along the nearest track that may contain an unmapped track [m].


class StandstillErrors(Settings):
    """Standard deviations of code and phase errors at rest, and prior probability of an unmapped track."""

    #: Standard deviation of a satellite's constant code error (multipath) at the zenith. It is divided by the sine of
    #: the elevation.
    code_bias_m: float = option("Sigma of a satellite's constant code error at the zenith.", 0.6, metavar="M", gt=0)
    #: Standard deviation of a satellite's varying code error at the zenith. It is divided by the sine of the elevation.
    code_noise_m: float = option("Sigma of a satellite's varying code error at the zenith.", 0.5, metavar="M", gt=0)

    correlation_s: float = option("Correlation time of the varying code error.", 60.0, metavar="S", gt=0)
    #: Standard deviation of a satellite's constant phase error at the zenith. It is divided by the sine of the
    #: elevation.
    phase_bias_m: float = option("Sigma of a satellite's constant phase error at the zenith.", 0.005, metavar="M", gt=0)
    #: Standard deviation per axis of each antenna's position on the train (antenna spacing, sway and lean).
    antenna_sigma_m: float = Field(default=0.05, gt=0)
    #: Standard deviation of the lateral map error common to all tracks of a yard, including antenna shifts due to cant.
    map_sigma_m: float = option("Sigma of the lateral map error common to all mapped tracks.", 0.3, metavar="M", ge=0)

    #: If None, the height is `ANTENNA_UP_M`; its standard deviation `ANTENNA_SIGMA_M` covers usual vehicles.
    antenna_up_m: float | None = option(
        "Height of the antennas above the rails, to distinguish tracks at different levels; by default about 2.5 m.",
        None,
        name="--antenna-height",
        metavar="M",
        ge=0,
    )

    unmapped_prior: float = option(
        "Prior probability of a track not in the map.", UNMAPPED_PRIOR, metavar="P", gt=0, lt=1
    )

    def bias_m(self, elevation_deg: Floats) -> Floats:
        """Return the standard deviation of the constant code error [m]."""
        return np.asarray(self.code_bias_m / _sine(elevation_deg))

    def phase_sigma_m(self, elevation_deg: Floats, *, distance_m: float) -> Floats:
        """Return the standard deviation of the phase difference of two receivers [m], including atmospheric errors."""
        return np.asarray(np.hypot(np.sqrt(2.0) * self.phase_bias_m, _PHASE_SHARE * distance_m) / _sine(elevation_deg))

    def mean_noise_m(self, elevation_deg: Floats, seconds: float) -> Floats:
        """Return the standard deviation of the mean of the varying code error over a time T of `seconds` [m].

        Averaging a Gauss-Markov process multiplies its variance by 2 tau/T (1 - tau/T (1 - exp(-T/tau))).
        """
        ratio = self.correlation_s / max(seconds, 1e-9)
        share = 2.0 * ratio * (1.0 - ratio * (1.0 - np.exp(-1.0 / ratio)))
        return np.asarray(self.code_noise_m / _sine(elevation_deg) * np.sqrt(min(share, 1.0)))


def _sine(elevation_deg: Floats) -> Floats:
    return np.asarray(np.sin(np.radians(np.maximum(elevation_deg, _LEAST_ELEVATION_DEG))))


@dataclass(frozen=True, kw_only=True)
class StandstillFix:
    """Mean position of one antenna at standstill."""

    east_north_m: Floats  #: Position east and north of the yard's origin, shape (2,).
    own_m2: Floats  #: Covariance due to code bias and noise of this antenna, shape (2, 2).
    common_m2: Floats  #: Covariance due to satellite and atmospheric errors, common to all antennas, shape (2, 2).
    misfit: float  #: Weighted sum of squared code residuals.
    freedom: int  #: Degrees of freedom of `misfit`.
    place: CodePlace | None = None  #: Position including the height.

    @property
    def fits(self) -> bool:
        """True if the residuals agree with the error model."""
        return self.freedom < 1 or bool(scipy.special.chdtrc(self.freedom, self.misfit) > _MISFIT)


def standstill_fix(
    azimuth_deg: Floats,
    elevation_deg: Floats,
    system: Strings,
    residual_m: Floats,
    *,
    seconds: float,
    common_m: Floats,
    errors: StandstillErrors,
    receivers: int = 1,
) -> StandstillFix | None:
    """Estimate an antenna position at standstill from mean code residuals; return None if it is undetermined.

    All arrays have the shape (K,). `system` has clock letters. `residual_m` has observed minus computed codes at the
    origin, averaged over `seconds`. `common_m` has the sigmas of satellite and atmospheric errors. `receivers` is the
    number of receivers whose errors affect the codes: 2 if the codes of a base station are subtracted, otherwise 1.
    """
    letters = np.unique(system)
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    toward = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=-1
    )
    design = np.hstack([-toward, (system[:, None] == letters).astype(np.float64)])
    freedom = len(system) - design.shape[1]
    if freedom < 0:
        return None
    own = receivers * (errors.bias_m(elevation_deg) ** 2 + errors.mean_noise_m(elevation_deg, seconds) ** 2)
    weight = 1.0 / (own + common_m**2)
    normal = design.T @ (weight[:, None] * design)
    if np.linalg.cond(normal) > 1e10:
        return None
    gain = np.linalg.solve(normal, design.T * weight)
    estimate = gain @ residual_m
    left = residual_m - design @ estimate
    plan = gain[:2]
    return StandstillFix(
        east_north_m=estimate[:2],
        own_m2=(plan * own) @ plan.T,
        common_m2=(plan * common_m**2) @ plan.T,
        misfit=float(weight @ left**2),
        freedom=freedom,
        place=CodePlace(place_m=estimate[:3], covariance_m2=(gain[:3] / weight) @ gain[:3].T),
    )


@dataclass(frozen=True, kw_only=True)
class YardTrack:
    """Name and points of a track near the train; points are east and north of the origin, shape (n, 2) [m]."""

    name: str
    points_m: Floats
    up_m: float = np.nan  #: Height, relative to the origin, of the track near the origin; NaN if unknown.
    sigma_up_m: float = 0.0  #: Standard deviation of `up_m`.


@dataclass(frozen=True, kw_only=True)
class TrackPosterior:
    """Posterior probability of each track, and agreement of each track with the codes."""

    names: tuple[str, ...]  #: Names of all tracks, followed by `NONE`.
    probability: Floats  #: Posterior probability for each name, shape (tracks + 1,).
    #: Probability that the train is on the track and faces in the track's direction, shape (tracks,).
    with_rising: Floats
    fits: bool  #: True if the codes agree with the error model.
    #: Distance of the code position from each track in standard deviations, shape (tracks + 1,); NaN for `NONE`.
    misfit_sigmas: Floats

    def decision(self, *, risk: float) -> str:
        """Return the track (or `NONE`) whose probability exceeds one minus `risk`; empty if no track is selected."""
        best = int(np.argmax(self.probability))
        if not self.fits or self.misfit_sigmas[best] > _LARGEST_MISFIT:
            return ""
        return self.names[best] if 1.0 - self.probability[best] < risk else ""


def track_posterior(
    tracks: Sequence[YardTrack],
    fixes: Sequence[StandstillFix],
    *,
    arms_m: Sequence[float],
    errors: StandstillErrors,
    prior: Mapping[str, float] | None = None,
    phases: Sequence[MeanPhases] = (),
) -> TrackPosterior:
    """Compute the probability that a train at rest is on each track, or on none.

    `arms_m` are the positions of the antennas along the train, positive towards its front. `prior` has the weight of
    each track, 0 for tracks without an entry. Raise ValueError if all weights are 0. `phases` has one item per antenna;
    it is empty without a base station.
    """
    covariance = _covariance(fixes, errors, tracks)
    places = np.concatenate([fix.east_north_m for fix in fixes])
    weights = np.array([1.0 if prior is None else prior.get(track.name, 0.0) for track in tracks])
    if not weights.sum() > 0.0:
        raise ValueError("prior has no positive weight for any track; its keys must be names of the tracks")
    weights = weights / weights.sum() * (1.0 - errors.unmapped_prior)
    nearest = int(np.argmin([_distance(track.points_m, fixes[0].east_north_m) for track in tracks]))
    half = _UNMAPPED_WIDTH_M / 2.0
    shifts = np.arange(-half, half + _ACROSS_M / 2.0, _ACROSS_M)
    width = len(shifts)
    likely = _shift_weights(shifts, tracks, nearest, fixes[0].east_north_m)
    shifts, likely = shifts[likely > 0.0], likely[likely > 0.0]
    # hypotheses: each track, and laterally shifted copies of the nearest track, each with both facings
    lines = [*((track, np.zeros(1)) for track in tracks), (tracks[nearest], shifts)]
    found = [
        [_places(track.points_m, places, covariance, arms_m, facing, across) for facing in (1.0, -1.0)]
        for track, across in lines
    ]
    if phases:
        found = _with_phases(found, fixes, phases, errors)
    found[-1] = [
        replace(item, log_evidence=item.log_evidence + np.log(likely)) if len(item.log_evidence) else item
        for item in found[-1]
    ]
    with np.errstate(divide="ignore"):
        log_prior = np.log([*weights, errors.unmapped_prior / width])
    logs = np.array(
        [
            [scipy.special.logsumexp(item.log_evidence) if len(item.log_evidence) else -np.inf for item in row]
            for row in found
        ]
    )
    logs += log_prior[:, None] + _height_likelihood(tracks, fixes, errors)[:, None]
    total = scipy.special.logsumexp(logs)
    if not np.isfinite(total):
        shares = np.zeros((len(tracks) + 1, 2))
        shares[-1] = 0.5
    else:
        shares = np.exp(logs - total)
    return TrackPosterior(
        names=(*(track.name for track in tracks), NONE),
        probability=shares.sum(axis=1),
        with_rising=shares[:-1, 0],
        fits=all(fix.fits for fix in fixes),
        misfit_sigmas=np.array([*(min(float(item.misfit) for item in row) for row in found[:-1]), np.nan]),
    )


def _height_likelihood(tracks: Sequence[YardTrack], fixes: Sequence[StandstillFix], errors: StandstillErrors) -> Floats:
    """Return the log likelihood of each track and of `NONE` from the code height, shape (tracks + 1,).

    Student's t distribution limits the effect of a height that agrees with no track. For `NONE` and tracks of unknown
    height, the largest likelihood of the other tracks is used.
    """
    codes = [fix.place for fix in fixes if fix.place is not None]
    up = np.array([track.up_m for track in tracks])
    if not codes or np.isnan(up).all():
        return np.zeros(len(tracks) + 1)
    unknown = errors.antenna_up_m is None
    above = float(np.mean([code.place_m[2] for code in codes])) - (
        ANTENNA_UP_M if unknown else errors.antenna_up_m or 0.0
    )
    variance = max(float(code.covariance_m2[2, 2]) for code in codes) + (ANTENNA_SIGMA_M**2 if unknown else 0.0)
    square = (above - up) ** 2 / (variance + np.array([track.sigma_up_m for track in tracks]) ** 2)
    logs = -0.5 * (_FREEDOM + 1.0) * np.log1p(square / _FREEDOM)
    return np.append(np.where(np.isnan(logs), np.nanmax(logs), logs), np.nanmax(logs))


def _with_phases(
    found: list[list[_Places]], fixes: Sequence[StandstillFix], phases: Sequence[MeanPhases], errors: StandstillErrors
) -> list[list[_Places]]:
    """Return the hypotheses after adding the log likelihood from the phases."""
    codes = [fix.place for fix in fixes if fix.place is not None]
    heights = np.array([code.place_m[2] for code in codes])
    best = max(item.log_evidence.max(initial=-np.inf) for row in found for item in row)
    lowest = uniform_log_likelihood(phases, fault_prior=_PHASE_FAULT_PRIOR)
    result = []
    for row in found:
        updated: list[_Places] = []
        for k, item in enumerate(row):
            evidence = item.log_evidence + lowest
            likely = item.log_evidence > best - _UNLIKELY
            if k == 1 and len(codes) == 1:
                # with one antenna, both facings have the same likelihood
                evidence = updated[0].log_evidence
            elif likely.any():
                count = int(likely.sum())
                expected = np.dstack([item.expected_m[likely], np.broadcast_to(heights, (count, len(codes)))])
                evidence[likely] = item.log_evidence[likely] + phase_log_likelihood(
                    expected.reshape(count, -1),
                    _spread(item.heading, errors),
                    codes,
                    phases,
                    fault_prior=_PHASE_FAULT_PRIOR,
                )
            updated.append(replace(item, log_evidence=evidence))
        result.append(updated)
    return result


def _spread(heading: Floats, errors: StandstillErrors) -> Floats:
    """Return the covariance of A antenna positions, shape (3 A, 3 A); along-track and map errors are common to them."""
    count = len(heading)
    along = np.column_stack([heading, np.zeros(count)])
    right = np.column_stack([heading[:, 1], -heading[:, 0], np.zeros(count)])
    common = _ANY_PLACE_M**2 * np.outer(along, along) + errors.map_sigma_m**2 * np.outer(right, right)
    own = errors.antenna_sigma_m**2 * np.eye(3) + _ANY_PLACE_M**2 * np.diag([0.0, 0.0, 1.0])
    return np.asarray(common + np.kron(np.eye(count), own))


def _covariance(fixes: Sequence[StandstillFix], errors: StandstillErrors, tracks: Sequence[YardTrack]) -> Floats:
    """Return the covariance of A code positions, shape (2 A, 2 A); they share `common_m2` and the map error."""
    nearest = min(tracks, key=lambda track: _distance(track.points_m, fixes[0].east_north_m))
    step = np.diff(nearest.points_m, axis=0)
    middle = nearest.points_m[:-1] + step / 2.0
    heading = step[int(np.argmin(np.linalg.norm(middle - fixes[0].east_north_m, axis=1)))]
    across = np.array([heading[1], -heading[0]]) / np.linalg.norm(heading)
    shared = np.mean([fix.common_m2 for fix in fixes], axis=0) + errors.map_sigma_m**2 * np.outer(across, across)
    covariance = np.kron(np.ones((len(fixes), len(fixes))), shared)
    for k, fix in enumerate(fixes):
        covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += fix.own_m2
    return np.asarray(covariance + 1e-6 * np.eye(2 * len(fixes)))


def _shift_weights(shifts_m: Floats, tracks: Sequence[YardTrack], nearest: int, place_m: Floats) -> Floats:
    """Return the weight of each lateral shift: 1 far from all tracks, smaller near a track, 0 on a track."""
    points = tracks[nearest].points_m
    start, step = points[:-1], np.diff(points, axis=0)
    share = np.clip(((place_m - start) * step).sum(axis=1) / (step**2).sum(axis=1), 0.0, 1.0)
    foot = start + share[:, None] * step
    k = int(np.argmin(np.linalg.norm(foot - place_m, axis=1)))
    right = np.array([step[k, 1], -step[k, 0]]) / np.linalg.norm(step[k])
    places = foot[k] + shifts_m[:, None] * right
    nearest_m = np.min([_distances(track.points_m, places) for track in tracks], axis=0)
    return np.where(nearest_m >= CLEARANCE_M, 1.0, np.where(nearest_m >= _BETWEEN_M, _BETWEEN_SHARE, 0.0))


def _distance(points_m: Floats, place_m: Floats) -> float:
    return float(_distances(points_m, place_m[None])[0])


def _distances(points_m: Floats, places_m: Floats) -> Floats:
    """Return the distances of positions (n, 2) from a polyline, shape (n,)."""
    start, step = points_m[:-1], np.diff(points_m, axis=0)
    offset = places_m[:, None] - start
    share = np.clip((offset * step).sum(axis=-1) / (step**2).sum(axis=-1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * step, axis=-1).min(axis=1))


@dataclass(frozen=True, kw_only=True)
class _Places:
    """Hypotheses for one track and one facing, with U lateral shifts."""

    log_evidence: Floats  #: Logarithm of the likelihood integrated along the track, shape (U,).
    expected_m: Floats  #: Most likely positions of the antennas, shape (U, A, 2).
    heading: Floats  #: Unit vectors along the track at the antennas, shape (A, 2).
    misfit: float = np.inf  #: Distance of the code positions from the track, in standard deviations.


def _places(
    points_m: Floats, places_m: Floats, covariance: Floats, arms_m: Sequence[float], facing: float, shifts_m: Floats
) -> _Places:
    """Return the hypotheses for a track and lateral shifts; empty if the antennas are beyond the ends of the track."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))])
    dense = np.linspace(0.0, way[-1], max(2, int(np.ceil(way[-1] / 5.0)) + 1))
    line = np.stack([np.interp(dense, way, points_m[:, i]) for i in (0, 1)], axis=-1)
    centre = dense[int(np.argmin(np.linalg.norm(line - places_m[:2], axis=1)))] - facing * arms_m[0]
    at = np.arange(centre - _REACH_M, centre + _REACH_M, _ALONG_M)
    at = at[(at > 0.0) & (at < way[-1])]
    if not len(at) or not len(shifts_m):
        none = np.zeros((0, len(arms_m), 2))
        return _Places(log_evidence=np.zeros(0), expected_m=none, heading=np.zeros((len(arms_m), 2)))
    inverse = np.linalg.inv(covariance)
    expected, headings = [], []
    for arm in arms_m:
        place = np.clip(at + facing * arm, 0.0, way[-1])
        segment = np.clip(np.searchsorted(way, place, side="right") - 1, 0, len(way) - 2)
        heading = (points_m[segment + 1] - points_m[segment]) / (way[segment + 1] - way[segment])[:, None]
        point = points_m[segment] + heading * (place - way[segment])[:, None]
        right = np.stack([heading[:, 1], -heading[:, 0]], axis=-1)
        expected.append(point[:, None] + right[:, None] * shifts_m[None, :, None])
        headings.append(heading)
    left = places_m - np.concatenate(expected, axis=-1)
    exponent = -0.5 * np.einsum("nui,ij,nuj->nu", left, inverse, left)
    likeliest = np.argmax(exponent, axis=0)
    chosen = np.stack(expected, axis=2)[likeliest, np.arange(len(shifts_m))]
    return _Places(
        log_evidence=scipy.special.logsumexp(exponent, axis=0)
        - 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1]
        + np.log(_ALONG_M),
        expected_m=chosen,
        heading=np.stack(headings, axis=1)[likeliest[len(shifts_m) // 2]],
        misfit=float(np.sqrt(-2.0 * exponent.max())),
    )

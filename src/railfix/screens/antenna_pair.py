"""Comparison of the pseudoranges of two antennas, given their spacing (P1 2.3(3), figure 5, table 6: 5 m).

The range from the rear antenna to a satellite is longer by ``L (cos el cos(az - heading) cos gradient + sin el sin
gradient)``, with L the antenna spacing. A deviation from this difference indicates multipath at one of the two
antennas, but not at which one.

If `clocks` is "common", the receivers must share a clock: at epochs where the median over the satellites of the
pseudorange difference exceeds `SEPARATE_CLOCKS_M`, no satellite is tested (P1 6). If `clocks` is "median", the clock
difference is estimated by the median over the satellites of a constellation. If range rates are given, the satellites'
motion between the two time tags is removed (0.8 m in 1 ms at most).

Errors of gradient, sway and map make the elevation uncertain by 3 deg, and the azimuth relative to the car body by
3.5 deg (P1). Multipath errors smaller than the effect of these angle errors are not detected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.array_functions import medians
from railfix.core.arrays import Floats, Strings, copy_with
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.ranges.corrected import AntennaRanges
from railfix.screens.base import ObservationPicture, ScreenColumn, Screened, Verdict
from railfix.screens.medians import clock_medians
from railfix.screens.pairs import PairedEpochs, PairScreen, on_pairs, pair_channels

#: Descriptions of the treatment of the receiver clocks, for results.
CLOCKS: Final = {
    "common": "the receivers' clocks are common by hardware",
    "median": "the receivers' clock difference is the median pseudorange difference of each constellation",
}
#: Median pseudorange difference of all satellites [m] above which the receivers are assumed to have separate clocks.
SEPARATE_CLOCKS_M: Final = 100.0


class AntennaPairLimits(Settings):
    """Limits of the antenna-pair screen."""

    #: Largest accepted deviation of the pseudorange difference from the expected difference; 5 in P1 table 6.
    limit_m: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Deviations that elevation errors (relative to the car body) up to this can explain are accepted; 3 in P1 2.3(3).
    elevation_error_deg: float = Field(default=3.0, ge=0.0, le=90.0)
    #: Deviations that azimuth errors (relative to the car body) up to this can explain are accepted; 3.5 in P1 2.3(3).
    azimuth_error_deg: float = Field(default=3.5, ge=0.0, le=90.0)
    #: Both receivers share one clock ("common"), or a median removes the difference of their clocks ("median").
    clocks: Literal["common", "median"] = "median"
    #: With clocks "median", constellations with fewer than this many satellites seen by both antennas are not tested.
    least_satellites: int = Field(default=4, ge=3)
    #: Epochs are paired if their time tags differ by at most this.
    tag_tolerance_s: float = Field(default=0.01, ge=0.0, lt=1.0)
    #: Treatment of an inconsistent satellite: its sigma is increased ("weigh"), or it is rejected ("reject"), as in P1.
    #: Both antennas are treated alike, because the faulty antenna is unknown.
    verdict: Literal["weigh", "reject"] = "weigh"


@dataclass(frozen=True, kw_only=True)
class AntennaPairScreened(Screened):
    """Verdict on P pairs of epochs and C pairs of channels; the metric is measured minus expected difference [m]."""

    expected_m: Floats  #: Rear minus front pseudorange expected from the spacing [m], shape (P, C).
    #: Eliminated clock difference [m], rear minus front; 0 for a common clock; NaN if unknown; shape (P, C).
    clock_m: Floats
    clocks: str  #: Description of the treatment of the clocks, from `CLOCKS`.
    zone: Callable[[], Floats]  #: Function that computes `ambiguity_m`.

    @cached_property
    def ambiguity_m(self) -> Floats:
        """Largest effect of the angle errors [m], shape (P, C); satellites with a smaller metric are not rejected."""
        return self.zone()


class Spacing(NamedTuple):
    """Direction and length of the line from the rear to the front antenna, shape (P,) or scalar; NaN where unknown."""

    heading_deg: ArrayLike
    gradient_permille: ArrayLike
    spacing_m: ArrayLike


class TagDifference(NamedTuple):
    """Difference between the time tags of the two receivers, and the range rates that correct pseudoranges for it."""

    later: ArrayLike  #: Time tag of the rear receiver minus time tag of the front receiver, timedelta64, shape (P,).
    range_rate_mps: ArrayLike  #: Range rate ``-lambda D``, shape (P, C); NaN (unknown) counts as 0.


def spacing_direction(front_ecef_m: ArrayLike, rear_ecef_m: ArrayLike) -> Spacing:
    """Return the heading [deg], gradient [permille] and length [m] of the line from the rear to the front antenna.

    Parameters
    ----------
    front_ecef_m, rear_ecef_m : array_like, shape (P, 3) [m]
        Antenna positions on their trajectories at the same instant. Only the difference of the two positions is used,
        so that, on a straight line, a common error of both positions has no effect.
    """
    front, rear = np.asarray(front_ecef_m, dtype=np.float64), np.asarray(rear_ecef_m, dtype=np.float64)
    latitude, longitude, _ = geodetic_from_ecef((front + rear) / 2.0)
    enu = np.einsum("pij,pj->pi", enu_axes(latitude, longitude), front - rear)
    level = np.hypot(enu[:, 0], enu[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient = 1e3 * enu[:, 2] / level
    heading = np.degrees(np.arctan2(enu[:, 0], enu[:, 1])) % 360.0
    return Spacing(heading, gradient, np.hypot(level, enu[:, 2]))


def expected_difference_m(
    elevation_deg: ArrayLike,
    azimuth_deg: ArrayLike,
    *,
    heading_deg: ArrayLike,
    gradient_permille: ArrayLike,
    spacing_m: ArrayLike,
) -> Floats:
    """Return rear minus front pseudorange expected for a common receiver clock, shape (P, C) [m].

    Parameters
    ----------
    elevation_deg, azimuth_deg : array_like, shape (P, C) [deg]
    heading_deg, gradient_permille, spacing_m : array_like, shape (P,) or scalar
        Line from the rear to the front antenna. For a train that faces falling chainage, the heading is opposite to the
        heading of the track, and the gradient has the opposite sign.
    """
    elevation, azimuth = np.radians(elevation_deg), np.radians(azimuth_deg)
    heading, spacing = (np.asarray(value, dtype=np.float64)[..., None] for value in (heading_deg, spacing_m))
    climb = np.arctan(np.asarray(gradient_permille, dtype=np.float64) / 1e3)[..., None]
    level = np.cos(elevation) * np.cos(azimuth - np.radians(heading)) * np.cos(climb)
    return np.asarray(spacing * (level + np.sin(elevation) * np.sin(climb)))


def ambiguity_m(
    elevation_deg: ArrayLike,
    relative_azimuth_deg: ArrayLike,
    spacing_m: ArrayLike,
    *,
    elevation_error_deg: float = 3.0,
    azimuth_error_deg: float = 3.5,
) -> Floats:
    """Return the largest change of the expected difference that angle errors can cause [m].

    For a spacing of 18.2 m and the default errors, the change is at most 1.1 m, for a low satellite abeam (P1 2.3(3)).

    Parameters
    ----------
    elevation_deg, relative_azimuth_deg : array_like, shapes that broadcast [deg]
        The relative azimuth is the azimuth of the satellite minus the heading.
    spacing_m : array_like [m]
    elevation_error_deg, azimuth_error_deg : float [deg]
    """
    angles = np.broadcast_arrays(np.radians(elevation_deg), np.radians(relative_azimuth_deg))
    shape = angles[0].shape  # scalars become rows of one element; there may be no channel
    rows = (math.prod(shape[:-1]), shape[-1]) if len(shape) > 1 else (-1, 1)
    elevation, azimuth = (np.ascontiguousarray(a.reshape(rows)) for a in angles)
    errors = np.radians(elevation_error_deg), np.radians(azimuth_error_deg)
    changes = largest_changes(elevation, azimuth, float(errors[0]), float(errors[1]))
    return np.asarray(np.asarray(spacing_m, dtype=np.float64) * changes.reshape(shape))


def largest_changes(elevation: Floats, azimuth: Floats, elevation_error: float, azimuth_error: float) -> Floats:
    """Return the largest change of ``cos(elevation) cos(azimuth)`` within the errors, (T, M); all angles in radians."""
    # the product of two cosines is extremal where both cosines are extremal
    (up, *ups), (aside, *asides) = _cosines(elevation, elevation_error), _cosines(azimuth, azimuth_error)
    return np.asarray(np.max([np.abs(a * b - up * aside) for a, b in product(ups, asides)], axis=0))


def _cosines(angle: Floats, error: float) -> tuple[Floats, Floats, Floats]:
    """Return the cosine of the angle, and the smallest and largest cosine within the error; all angles in radians."""
    cosine, least = np.cos(angle), math.cos(error)
    middle, half = cosine * least, np.abs(np.sin(angle)) * math.sin(error)
    low = np.where(cosine <= -least, -1.0, middle - half)
    return cosine, low, np.where(cosine >= least, 1.0, middle + half)


def antenna_pair_screen(
    code_front_m: ArrayLike,
    code_rear_m: ArrayLike,
    elevation_deg: ArrayLike,
    azimuth_deg: ArrayLike,
    *,
    satellite: Strings,
    spacing: Spacing,
    tags: TagDifference | None = None,
    limits: AntennaPairLimits | None = None,
) -> AntennaPairScreened:
    """Reject satellites whose pseudorange difference is inconsistent with the antenna spacing (P1 2.3(3), table 6).

    Parameters
    ----------
    code_front_m, code_rear_m : array_like, shape (P, C) [m]
        Pseudoranges at paired epochs (`pairs.pair_epochs`) and channels (`pairs.pair_channels`), both raw or both
        corrected; NaN where absent.
    elevation_deg, azimuth_deg : array_like, shape (P, C) [deg]
    satellite : ndarray of str, shape (C,)
    spacing : Spacing
        Returned by `spacing_direction`.
    tags : TagDifference, optional
        If None, the observations of both receivers are assumed to be simultaneous.

    Returns
    -------
    AntennaPairScreened
        The metric is NaN, and nothing is rejected, where a pseudorange or the spacing is missing, for constellations
        with fewer than `least_satellites` satellites (clocks "median"), and at epochs with separate clocks (clocks
        "common").
    """
    limits = limits or AntennaPairLimits()
    front, rear = np.asarray(code_front_m, dtype=np.float64), np.asarray(code_rear_m, dtype=np.float64)
    expected = expected_difference_m(elevation_deg, azimuth_deg, **spacing._asdict())
    rate = np.zeros(front.shape) if tags is None else np.nan_to_num(np.asarray(tags.range_rate_mps))
    later = np.zeros(len(front)) if tags is None else seconds(tags.later)
    raw = rear - front - expected - rate * later[:, None]
    if limits.clocks == "median":
        # the clock difference also shifts the instants of observation
        timed = raw + rate * clock_medians(raw, satellite) / SPEED_OF_LIGHT
        clock = clock_medians(timed, satellite, least=limits.least_satellites)
        raw = raw + rate * clock / SPEED_OF_LIGHT
    else:
        separate = np.abs(medians(raw))[:, None] > SEPARATE_CLOCKS_M
        clock = np.broadcast_to(np.where(separate, np.nan, 0.0), raw.shape)
    metric = raw - clock
    heading, length = (np.asarray(a, dtype=np.float64)[..., None] for a in (spacing.heading_deg, spacing.spacing_m))

    def zone() -> Floats:
        return ambiguity_m(
            elevation_deg, np.asarray(azimuth_deg) - heading, length, elevation_error_deg=limits.elevation_error_deg,
            azimuth_error_deg=limits.azimuth_error_deg,
        )  # fmt: skip

    screened = AntennaPairScreened(
        metric=metric, reject=np.abs(metric) > limits.limit_m, limit=limits.limit_m, expected_m=expected,
        clock_m=clock, clocks=CLOCKS[limits.clocks], zone=zone,
    )  # fmt: skip
    if screened.reject.any():
        screened = copy_with(screened, reject=screened.reject & (np.abs(metric) > screened.ambiguity_m))
    return screened


class AntennaPairScreen(PairScreen[AntennaPairLimits]):
    """Screen of the pseudorange difference of two antennas; its verdict applies to both antennas."""

    name = "antenna_pair"
    limits = AntennaPairLimits()
    needs = (
        f"{PairScreen.needs}, and one clock for both receivers where `antenna_pair.clocks` is `common`, as in the "
        "preset `p1` (set it to `median` for separate clocks)"
    )
    columns = (
        ScreenColumn(
            name="metric_antenna_pair_m",
            meaning="screen `antenna_pair`: rear minus front pseudorange, minus the expected difference",
            verdict="antenna_pair",
        ),
    )
    observation_pictures = (
        ObservationPicture(
            "antenna_pair", "pseudoranges of two antennas", "rear - front - expected [m]", "metric_antenna_pair_m",
            Reason.ANTENNA_PAIR, "limit_m",
        ),
    )  # fmt: skip

    def judge(
        self, front: AntennaRanges, rear: AntennaRanges, pair: PairedEpochs, limits: AntennaPairLimits
    ) -> Mapping[str, tuple[Verdict, ...]]:
        """Return the verdict on a chunk for "front" and "rear"; both antennas have the same verdict."""
        at_front, at_rear = pair.front_epoch, pair.rear_epoch
        ours, theirs = pair_channels(front.satellite, front.signal, rear.satellite, rear.signal)
        here = at_front[:, None], ours
        rate = -SPEED_OF_LIGHT / front.frequency_hz[ours] * front.doppler_hz[here]
        screened = antenna_pair_screen(
            front.corrected_code_m[here], rear.corrected_code_m[at_rear[:, None], theirs], front.elevation_deg[here],
            front.azimuth_deg[here], satellite=front.satellite[ours],
            spacing=spacing_direction(pair.front_ecef_m, pair.rear_ecef_m),
            tags=TagDifference(rear.time[at_rear] - front.time[at_front], rate), limits=limits,
        )  # fmt: skip
        verdicts = {}
        for name, antenna, epochs, channels in (("front", front, at_front, ours), ("rear", rear, at_rear, theirs)):
            own = on_pairs(screened, antenna.reason.shape, epochs, channels)
            error = own.metric if limits.verdict == "weigh" else None
            verdict = Verdict(name=self.name, reason=Reason.ANTENNA_PAIR, screened=own, error_m=error)
            verdicts[name] = (verdict,)
        return verdicts


SCREEN = AntennaPairScreen()

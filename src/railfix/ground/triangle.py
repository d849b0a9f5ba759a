"""Reference triangle: verdict on satellite positioning from the fixes of three receivers at known points.

P3 (reference triangle): each fix is compared with its point by a circle of allowable error, and the vectors between
neighbouring fixes (distance and bearing) with those between the points. P3 takes a fix inside its circle as the point
itself, so that a drift inside the circle cannot be seen. Here the vectors come from the raw fixes: errors common to
the three receivers cancel in them, their limit can be far below the radius, and such a drift is seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Self

import numpy as np
from pydantic import model_validator

from railfix.core.arrays import Codes, Floats, Integers, Masks, freeze_arrays
from railfix.core.settings import Settings, option

#: Receivers of each side of the triangle.
SIDES: Final = ((0, 1), (1, 2), (2, 0))
#: Seconds of a year of 365.25 days.
YEAR_S: Final = 31_557_600.0


class TriangleVerdict(IntEnum):
    """TriangleVerdict on one set of three fixes; every one from `ONE_RECEIVER` on stops the trains."""

    #: Every fix inside its circle, every side as it should be.
    HEALTHY = 0
    #: Every fix inside its circle, but one side, or both sides of one receiver, differ: a warning.
    RECEIVER_DRIFTING = 1
    #: One fix outside its circle, and both its sides differ.
    ONE_RECEIVER = 2
    #: Three fixes outside, the shape kept: satellites or a disturbance that acts on all alike.
    SATELLITES_OR_JAMMING = 3
    #: The fixes coincide: one false signal for all three receivers.
    SPOOFING = 4
    #: Any other combination: the ground side cannot judge.
    GROUND_LOST = 5
    #: A fix is absent.
    MONITOR_LOST = 6
    #: A fix is absent and the C/N0 of all three has fallen.
    JAMMING = 7


#: Verdicts that stop the trains.
STOPPING: Final = frozenset(verdict for verdict in TriangleVerdict if verdict >= TriangleVerdict.ONE_RECEIVER)


class TriangleLimits(Settings):
    """Limits of the triangle."""

    #: Radius of the circle of allowable error. An error of up to this size stays unseen: it belongs into the error
    #: budget of the trains.
    radius_m: float = option("Radius of the circle of allowable error.", 12.0, name="--radius", metavar="M", gt=0)
    #: Largest deviation of the vector between two fixes from that between their points.
    side_m: float = option("Largest deviation of the vector between two fixes.", 6.0, name="--side", metavar="M", gt=0)

    @model_validator(mode="after")
    def _side_within_twice_the_radius(self) -> Self:
        if self.side_m > 2.0 * self.radius_m:
            raise ValueError("side_m is at most twice radius_m: two fixes inside their circles differ by no more")
        return self


def limits_for_false_stops(
    sigma_m: float, own_sigma_m: float, *, stops_per_year: float, independent_s: float = 100.0
) -> TriangleLimits:
    """Limits that give a rate of false stops a year.

    The length of a horizontal error of standard deviation sigma an axis is Rayleigh distributed:
    ``P(e > R) = exp(-R^2 / (2 sigma^2))``. Half of the false stops are allotted to the three circles, half to the
    three sides; a year has as many independent samples as `independent_s` fit into it.

    Parameters
    ----------
    sigma_m : float [m]
        Standard deviation of a fix, an axis.
    own_sigma_m : float [m]
        That of the part which the other receivers do not share; a side has it twice.
    stops_per_year : float
    independent_s : float [s]
        Time after which the errors of a fix are independent of those before.

    Raises
    ------
    ValueError
        An argument is not positive, `own_sigma_m` exceeds `sigma_m`, or the rate is higher than the samples allow.
    """
    if not (0.0 < own_sigma_m <= sigma_m and stops_per_year > 0.0 and independent_s > 0.0):
        raise ValueError("0 < own_sigma_m <= sigma_m, stops_per_year > 0 and independent_s > 0 were expected")
    probability = stops_per_year * independent_s / YEAR_S / 6.0
    if probability >= 0.1:
        raise ValueError(f"{stops_per_year} stops a year are more than the limits can be chosen for")
    factor = float(np.sqrt(-2.0 * np.log(probability)))
    return TriangleLimits(
        radius_m=factor * sigma_m, side_m=min(factor * np.sqrt(2.0) * own_sigma_m, 2.0 * factor * sigma_m)
    )


@dataclass(frozen=True, kw_only=True)
class TriangleResult:
    """Comparison of T sets of fixes with the reference triangle."""

    error_m: Floats  #: Horizontal distance of each fix from its point; NaN without a fix; shape (T, 3).
    side_error_m: Floats  #: Deviation of the vector between two fixes, in the order of `SIDES`; shape (T, 3).
    distance_error_m: Floats  #: Deviation of the length of that vector, shape (T, 3).
    bearing_error_deg: Floats  #: Deviation of its bearing, clockwise, in [-180, 180); shape (T, 3).
    verdict: Codes  #: `TriangleVerdict`, shape (T,).
    receiver: Integers  #: Receiver that the verdict names, -1 where it names none; shape (T,).

    def __post_init__(self) -> None:
        freeze_arrays(self)


def compare_triangle(
    points_m: Floats, fixes_m: Floats, *, limits: TriangleLimits, cn0_fallen: Masks | None = None
) -> TriangleResult:
    """Compare fixes with the reference triangle.

    Parameters
    ----------
    points_m : ndarray, shape (3, 2) [m]
        Known points, east and north of any origin.
    fixes_m : ndarray, shape (T, 3, 2) [m]
        Raw fixes from the same satellites at the same epoch, in the same frame; NaN where there is none.
    cn0_fallen : ndarray of bool, shape (T, 3), optional
        True where the C/N0 of a receiver has fallen.

    Raises
    ------
    ValueError
        The sides of the triangle are too short for the limits: a side is longer than ``2 radius_m + side_m``.
    """
    first, second = np.array(SIDES).T
    side = points_m[second] - points_m[first]
    shortest = float(np.hypot(side[:, 0], side[:, 1]).min())
    if not shortest > 2.0 * limits.radius_m + limits.side_m:
        raise ValueError(
            f"the shortest side of the triangle is {shortest:.1f} m; more than two radii and the limit of the sides "
            f"({2.0 * limits.radius_m + limits.side_m:.1f} m) were expected"
        )
    offset = fixes_m - points_m
    measured = fixes_m[:, second] - fixes_m[:, first]
    error, side_error = np.hypot(*np.moveaxis(offset, -1, 0)), np.hypot(*np.moveaxis(measured - side, -1, 0))
    apart = np.hypot(*np.moveaxis(measured, -1, 0))
    # comparisons with NaN are False: a fix that is absent is neither inside its circle nor in its place
    inside, small = error <= limits.radius_m, side_error <= limits.side_m
    coincide = (apart <= limits.side_m).all(axis=1)
    fallen = np.zeros(error.shape, dtype=bool) if cn0_fallen is None else cn0_fallen
    verdict, receiver = _verdicts(
        np.isfinite(error).all(axis=1), inside, small, coincide, np.asarray(fallen.all(axis=1))
    )
    turned = np.degrees(np.arctan2(measured[..., 0], measured[..., 1]) - np.arctan2(side[:, 0], side[:, 1]))
    return TriangleResult(
        error_m=error,
        side_error_m=side_error,
        distance_error_m=apart - np.hypot(side[:, 0], side[:, 1]),
        bearing_error_deg=(turned + 180.0) % 360.0 - 180.0,
        verdict=verdict,
        receiver=receiver,
    )


def _verdicts(
    present: Masks, inside: Masks, small: Masks, coincide: Masks, all_fallen: Masks
) -> tuple[Codes, Integers]:
    """Return verdict and named receiver of each set of fixes, shapes (T,)."""
    outside = (~inside).sum(axis=1)
    # receiver i alone: the sides that end at it differ, the third does not
    alone = np.stack([~small[:, i] & ~small[:, i - 1] & small[:, i - 2] for i in range(3)], axis=1)
    named = np.where(alone.any(axis=1), alone.argmax(axis=1), -1)
    own_outside = np.take_along_axis(~inside, np.maximum(named, 0)[:, None], axis=1)[:, 0] & (named >= 0)
    verdict = np.select(
        [
            ~present & all_fallen,
            ~present,
            (outside == 0) & small.all(axis=1),
            # a drift passes one of its two limits first, by noise
            (outside == 0) & ((named >= 0) | (small.sum(axis=1) == 2)),
            (outside == 1) & own_outside,
            (outside == 3) & small.all(axis=1),
            (outside >= 2) & coincide,
        ],
        [
            TriangleVerdict.JAMMING,
            TriangleVerdict.MONITOR_LOST,
            TriangleVerdict.HEALTHY,
            TriangleVerdict.RECEIVER_DRIFTING,
            TriangleVerdict.ONE_RECEIVER,
            TriangleVerdict.SATELLITES_OR_JAMMING,
            TriangleVerdict.SPOOFING,
        ],
        TriangleVerdict.GROUND_LOST,
    ).astype(np.int8)
    names_one = np.isin(verdict, [TriangleVerdict.RECEIVER_DRIFTING, TriangleVerdict.ONE_RECEIVER])
    return verdict, np.where(names_one, named, -1).astype(np.int64)

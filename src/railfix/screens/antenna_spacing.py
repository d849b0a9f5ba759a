"""Comparison of the distance between two antennas' positions with the antenna spacing (P1 2.3(5), table 6: 5 m)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.reasons import Status
from railfix.core.settings import Settings
from railfix.screens.base import RunTables, ScreenColumn, Screened, ScreenPicture
from railfix.screens.pairs import FilteredMotion, PairedEpochs, PositionScreen


class AntennaSpacingLimits(Settings):
    """Limits of the antenna-spacing screen."""

    #: Largest accepted difference between the distance of the two positions and the antenna spacing; 5 in P1 table 6.
    limit_m: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: A difference of filter positions or speeds is rejected only if it exceeds this number of standard deviations, in
    #: addition to the limit in m or m/s. The standard deviations grow when the filter predicts over a gap.
    filter_sigmas: float = Field(default=4.0, gt=0.0, allow_inf_nan=False)
    #: Largest difference of the two antennas' filter speeds. Antennas on one vehicle differ in speed by a few cm/s at
    #: most, where the track curves or its cant changes. A difference below the limit at a single epoch changes a
    #: position by less than 1 m.
    filter_speed_mps: float = Field(default=1.5, gt=0.0)
    #: Time after a rejection for which neither filter position is used. A wrong speed causes a wrong position, which
    #: pseudoranges correct within about 20 s.
    filter_held_s: float = Field(default=20.0, ge=0.0, allow_inf_nan=False)


def antenna_spacing_screen(
    chainage_front_m: ArrayLike,
    chainage_rear_m: ArrayLike,
    spacing_m: ArrayLike,
    *,
    facing: ArrayLike = 1,
    limits: AntennaSpacingLimits | None = None,
) -> Screened:
    """Reject pairs of positions whose distance along the track differs from the antenna spacing (P1 2.3(5), table 6).

    Parameters
    ----------
    chainage_front_m, chainage_rear_m : array_like, shape (P,) [m]
        Chainages at the same instants along one line; a pair with NaN is not rejected.
    spacing_m : array_like, shape (P,) or scalar [m]
        Expected distance from the rear to the front position, not negative. It is the antenna spacing if the chainages
        are the chainages of the antennas, and 0 if both chainages refer to one reference point.
    facing : array_like of int, shape (P,) or scalar
        Direction of the vehicle's front: 1 towards rising chainage, -1 towards falling chainage, 0 if unknown. With 0
        the order of the two positions is not tested.

    Returns
    -------
    Screened
        Shapes (P,). The metric is ``facing (front - rear) - spacing`` [m], positive if the positions are too far apart,
        or ``|front - rear| - spacing`` where facing is 0. A rejection applies to both positions.

    Raises
    ------
    ValueError
        `facing` is not -1, 0 or 1, or `spacing_m` is negative.
    """
    limits = limits or AntennaSpacingLimits()
    apart = np.asarray(chainage_front_m, dtype=np.float64) - np.asarray(chainage_rear_m, dtype=np.float64)
    spacing, sign = np.asarray(spacing_m, dtype=np.float64), np.asarray(facing)
    if not (sign * sign == np.abs(sign)).all():
        raise ValueError("facing must be 1 (rising chainage), -1 (falling) or 0 (unknown)")
    if (spacing < 0.0).any():
        raise ValueError("spacing_m must not be negative; facing gives the order of the two antennas")
    metric = np.where(sign == 0, np.abs(apart), sign * apart) - spacing
    return Screened(metric=metric, reject=np.abs(metric) > limits.limit_m, limit=limits.limit_m)


class AntennaSpacingScreen(PositionScreen[AntennaSpacingLimits]):
    """Screen of the distance between two antennas' positions."""

    name = "antenna_spacing"
    limits = AntennaSpacingLimits()
    status = Status.ANTENNAS_DISAGREE
    columns = (
        ScreenColumn(
            name="metric_antenna_spacing_m",
            meaning="screen `antenna_spacing`: distance between the two positions minus the antenna spacing",
            verdict="antenna_spacing",
            table="positions",
        ),
    )

    def judge(
        self, front_chainage_m: Floats, rear_chainage_m: Floats, pair: PairedEpochs, limits: AntennaSpacingLimits
    ) -> Screened:
        """Return the metric and the verdict for pairs of positions; NaN and False where the spacing is unknown."""
        unknown = np.isnan(pair.along_m)
        along = np.where(unknown, 0.0, pair.along_m)
        found = antenna_spacing_screen(
            front_chainage_m, rear_chainage_m, np.abs(along), facing=np.sign(along).astype(int), limits=limits
        )
        metric = np.where(unknown, np.nan, found.metric)
        return Screened(metric=metric, reject=found.reject & ~unknown, limit=found.limit)

    def judge_filtered(
        self, front: FilteredMotion, rear: FilteredMotion, pair: PairedEpochs, limits: AntennaSpacingLimits
    ) -> Screened:
        """Return the metric and the verdict for pairs of filtered positions.

        A pair is rejected where the distance deviates from the spacing, or the speeds differ, by more than `limit_m` or
        `filter_speed_mps`, respectively, and by more than `filter_sigmas` standard deviations.
        """
        found = self.judge(front.chainage_m, rear.chainage_m, pair, limits)
        apart = np.abs(found.metric) > limits.filter_sigmas * np.hypot(front.sigma_m, rear.sigma_m)
        difference = np.abs(front.speed_mps - rear.speed_mps)
        beyond_noise = difference > limits.filter_sigmas * np.hypot(front.speed_sigma_mps, rear.speed_sigma_mps)
        reject = (found.reject & apart) | ((difference > limits.filter_speed_mps) & beyond_noise)
        return Screened(metric=found.metric, reject=reject, limit=limits.limit_m)

    def pictures(self, tables: RunTables, limits: AntennaSpacingLimits) -> Iterator[tuple[str, ScreenPicture]]:
        """Yield the picture that shows the differences from the spacing, and their limit."""
        spacing = tables.epochs("metric_antenna_spacing_m")
        yield (
            "antenna_spacing",
            ScreenPicture(
                title="positions of two antennas",
                label="distance minus spacing [m]",
                metric=spacing,
                reject=np.abs(spacing) > limits.limit_m,
                limit=limits.limit_m,
            ),
        )


SCREEN = AntennaSpacingScreen()

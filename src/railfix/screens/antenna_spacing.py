"""Positions of the two antennas against their spacing along the track (P1 2.3(5), table 6: 5 m).

The two positions come from different receivers and antennas, so that their distance is a check on
both. Where it does not fit, one of them is wrong, which one is unknown, and both are marked.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.reasons import Status
from railfix.core.settings import Settings
from railfix.screens.base import PairedEpochs, PositionScreen, RunTables, ScreenColumn, Screened, ScreenPicture


class AntennaSpacingLimits(Settings):
    """Limits of the check of two positions.

    Attributes
    ----------
    limit_m : float [m]
        Largest difference from the spacing; P1 table 6: 5.
    filter_sigmas : float
        Places by the filter differ by more than the limit where both were predicted: by so many of their standard
        deviations too.
    """

    limit_m: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    filter_sigmas: float = Field(default=4.0, gt=0.0, allow_inf_nan=False)


def antenna_spacing_screen(
    chainage_front_m: ArrayLike,
    chainage_rear_m: ArrayLike,
    spacing_m: ArrayLike,
    *,
    facing: ArrayLike = 1,
    limits: AntennaSpacingLimits | None = None,
) -> Screened:
    """Reject pairs of positions that are not as far apart along the track as the antennas.

    Parameters
    ----------
    chainage_front_m, chainage_rear_m : array_like, shape (P,) [m]
        Of the same instants, counted along one line; NaN where there is no position: not judged.
    spacing_m : array_like, shape (P,) or scalar [m]
        Front less rear along the track as the chainages count it, not negative: the antennas' distance
        where each chainage is the one abeam its antenna, 0 where both are that of one reference point.
    facing : array_like of int, shape (P,) or scalar
        1 where the vehicle's front looks to rising chainage, -1 to falling, 0 where that is unknown:
        then the order of the two is not judged.
    limits : AntennaSpacingLimits, optional

    Returns
    -------
    Screened
        Shapes (P,). The metric is ``facing (front - rear) - spacing`` [m], positive where they are too
        far apart; ``|front - rear| - spacing`` where facing is 0. Both positions are rejected.
    """
    limits = limits or AntennaSpacingLimits()
    apart = np.asarray(chainage_front_m, dtype=np.float64) - np.asarray(chainage_rear_m, dtype=np.float64)
    spacing, sign = np.asarray(spacing_m, dtype=np.float64), np.asarray(facing)
    if not (sign * sign == np.abs(sign)).all():
        raise ValueError("facing must be 1 (rising chainage), -1 (falling) or 0 (unknown)")
    if (spacing < 0.0).any():
        raise ValueError("spacing_m must not be negative; facing gives the order of the two")
    metric = np.where(sign == 0, np.abs(apart), sign * apart) - spacing
    return Screened(metric=metric, reject=np.abs(metric) > limits.limit_m)


class AntennaSpacingScreen(PositionScreen[AntennaSpacingLimits]):
    """Spacing of the two positions against that of the antennas."""

    name = "antenna_spacing"
    limits = AntennaSpacingLimits()
    status = Status.ANTENNAS_DISAGREE
    columns = (
        ScreenColumn(
            name="metric_antenna_spacing_m",
            meaning="screen `antenna_spacing`: distance of the two positions less that of the antennas",
            verdict="antenna_spacing",
            table="positions",
        ),
    )

    def judge(
        self, front_chainage_m: Floats, rear_chainage_m: Floats, pair: PairedEpochs, limits: AntennaSpacingLimits
    ) -> Screened:
        """Return metric and verdict of the pairs of positions; not ordered where the spacing is unknown."""
        along = np.nan_to_num(pair.along_m)
        return antenna_spacing_screen(
            front_chainage_m, rear_chainage_m, np.abs(along), facing=np.sign(along).astype(int), limits=limits
        )

    def judge_filtered(
        self,
        front_chainage_m: Floats,
        rear_chainage_m: Floats,
        sigma_m: Floats,
        pair: PairedEpochs,
        limits: AntennaSpacingLimits,
    ) -> Screened:
        """Return metric and verdict of pairs of places by the filter: beyond the limit and what noise explains."""
        found = self.judge(front_chainage_m, rear_chainage_m, pair, limits)
        beyond = np.abs(found.metric) > np.nan_to_num(limits.filter_sigmas * sigma_m, nan=np.inf)
        return Screened(metric=found.metric, reject=found.reject & beyond)

    def pictures(self, tables: RunTables, limits: AntennaSpacingLimits) -> Iterator[tuple[str, ScreenPicture]]:
        """Yield the differences from the spacing against the limit."""
        spacing = tables.epochs("metric_antenna_spacing_m")
        yield (
            "antenna_spacing",
            ScreenPicture(
                title="positions of two antennas",
                label="distance less spacing [m]",
                metric=spacing,
                reject=np.abs(spacing) > limits.limit_m,
                limit=limits.limit_m,
            ),
        )


SCREEN = AntennaSpacingScreen()

"""Positions of the two antennas against their spacing along the track (P1 2.3(5), table 6: 5 m)."""

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
    """Limits of the check of two positions."""

    #: Largest difference from the spacing; P1 table 6: 5.
    limit_m: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Filter positions, and speeds, must also differ by this many of their standard deviations, as both may be
    #: predicted.
    filter_sigmas: float = Field(default=4.0, gt=0.0, allow_inf_nan=False)
    #: Largest difference of the two speeds by the filter. Antennas of one vehicle have equal speeds, up to a few cm/s
    #: where the track curves or its cant changes; a smaller difference of single epochs moves no position by a metre.
    filter_speed_mps: float = Field(default=1.5, gt=0.0)
    #: Time for which neither position is used: a wrong speed results in a wrong position, which codes correct within
    #: some 20 s.
    filter_held_s: float = Field(default=20.0, ge=0.0, allow_inf_nan=False)


def antenna_spacing_screen(
    chainage_front_m: ArrayLike,
    chainage_rear_m: ArrayLike,
    spacing_m: ArrayLike,
    *,
    facing: ArrayLike = 1,
    limits: AntennaSpacingLimits | None = None,
) -> Screened:
    """Reject pairs of positions that are not as far apart along the track as the antennas (P1 2.3(5); table 6: 5 m).

    Parameters
    ----------
    chainage_front_m, chainage_rear_m : array_like, shape (P,) [m]
        Chainages at the same instants along one line; NaN without a position, which is not tested.
    spacing_m : array_like, shape (P,) or scalar [m]
        Expected front less rear chainage, not negative: the antenna distance if each chainage refers to its antenna, 0
        if both refer to one reference point.
    facing : array_like of int, shape (P,) or scalar
        1 if the vehicle's front points to rising chainage, -1 to falling, 0 if unknown; the order of the two is then
        not tested.

    Returns
    -------
    Screened
        Shapes (P,). The metric is ``facing (front - rear) - spacing`` [m], positive if the positions are too far apart;
        ``|front - rear| - spacing`` where facing is 0. Both positions are rejected.
    """
    limits = limits or AntennaSpacingLimits()
    apart = np.asarray(chainage_front_m, dtype=np.float64) - np.asarray(chainage_rear_m, dtype=np.float64)
    spacing, sign = np.asarray(spacing_m, dtype=np.float64), np.asarray(facing)
    if not (sign * sign == np.abs(sign)).all():
        raise ValueError("facing must be 1 (rising chainage), -1 (falling) or 0 (unknown)")
    if (spacing < 0.0).any():
        raise ValueError("spacing_m must not be negative; facing gives the order of the two")
    metric = np.where(sign == 0, np.abs(apart), sign * apart) - spacing
    return Screened(metric=metric, reject=np.abs(metric) > limits.limit_m, limit=limits.limit_m)


class AntennaSpacingScreen(PositionScreen[AntennaSpacingLimits]):
    """Distance of the two positions against the antenna spacing."""

    name = "antenna_spacing"
    limits = AntennaSpacingLimits()
    status = Status.ANTENNAS_DISAGREE
    columns = (
        ScreenColumn(
            name="metric_antenna_spacing_m",
            meaning="screen `antenna_spacing`: distance of the two positions less the antenna spacing",
            verdict="antenna_spacing",
            table="positions",
        ),
    )

    def judge(
        self, front_chainage_m: Floats, rear_chainage_m: Floats, pair: PairedEpochs, limits: AntennaSpacingLimits
    ) -> Screened:
        """Return metric and verdict of the position pairs; their order is not tested if the spacing is unknown."""
        along = np.where(np.isnan(pair.along_m), 0.0, pair.along_m)
        return antenna_spacing_screen(
            front_chainage_m, rear_chainage_m, np.abs(along), facing=np.sign(along).astype(int), limits=limits
        )

    def judge_filtered(
        self, front: FilteredMotion, rear: FilteredMotion, pair: PairedEpochs, limits: AntennaSpacingLimits
    ) -> Screened:
        """Return metric and verdict of filtered pairs: positions or speeds beyond limit and noise."""
        found = self.judge(front.chainage_m, rear.chainage_m, pair, limits)
        apart = np.abs(found.metric) > limits.filter_sigmas * np.hypot(front.sigma_m, rear.sigma_m)
        difference = np.abs(front.speed_mps - rear.speed_mps)
        beyond_noise = difference > limits.filter_sigmas * np.hypot(front.speed_sigma_mps, rear.speed_sigma_mps)
        reject = (found.reject & apart) | ((difference > limits.filter_speed_mps) & beyond_noise)
        return Screened(metric=found.metric, reject=reject, limit=limits.limit_m)

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

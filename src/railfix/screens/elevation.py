"""Elevation mask (20 degrees in P1 table 6)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.ranges.corrected import AntennaRanges
from railfix.screens.base import (
    ObservationPicture,
    ObservationScreen,
    Screened,
    ScreenSetup,
    Verdict,
)


class ElevationLimits(Settings):
    """Limits of the elevation mask."""

    #: Elevation below which satellites are rejected; P1 3.3 and table 6 use 20.
    mask_deg: float = Field(default=20.0, ge=-90.0, lt=90.0)


def elevation_screen(elevation_deg: ArrayLike, *, limits: ElevationLimits | None = None) -> Screened:
    """Reject satellites below the elevation mask.

    The metric is the elevation [deg]. A satellite whose elevation is unknown (NaN) is not rejected.
    """
    limits = limits or ElevationLimits()
    metric = np.asarray(elevation_deg, dtype=np.float64)
    return Screened(metric=metric, reject=metric < limits.mask_deg, limit=limits.mask_deg)


class ElevationScreen(ObservationScreen[ElevationLimits]):
    """Elevation mask."""

    name = "elevation"
    limits = ElevationLimits()
    needs = "navigation records"
    observation_pictures = (
        ObservationPicture(
            "elevation", "elevation mask", "elevation [deg]", "elevation_deg", Reason.ELEVATION_MASK, "mask_deg",
            "below",
        ),
    )  # fmt: skip

    def judge(
        self, antenna: AntennaRanges, limits: ElevationLimits, setup: ScreenSetup, state: Any
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdict on a chunk, and the state unchanged, because no earlier epochs are used."""
        screened = elevation_screen(antenna.elevation_deg, limits=limits)
        return (Verdict(name="elevation", reason=Reason.ELEVATION_MASK, screened=screened),), state


SCREEN = ElevationScreen()

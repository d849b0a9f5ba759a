"""Name, settings and picture of the screen `raim`; the pipeline runs RAIM when it computes positions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from railfix.integrity.raim import RaimLimits
from railfix.screens.base import RunTables, Screen, ScreenPicture


class RaimScreen(Screen[RaimLimits]):
    """Fault detection and exclusion (`railfix.integrity.raim`)."""

    name = "raim"
    limits = RaimLimits()
    needs = "more satellites than unknowns"

    def pictures(self, tables: RunTables, limits: RaimLimits) -> Iterator[tuple[str, ScreenPicture]]:
        """Yield the picture of the test statistic before any exclusion, and its threshold."""
        statistic, threshold = tables.epochs("raim_statistic"), tables.epochs("raim_threshold")
        unit = "m^2" if limits.mode == "fixed" else "noise variances"
        yield (
            "raim",
            ScreenPicture(
                title="RAIM, before any exclusion",
                label=f"sum of squared residuals [{unit}]",
                metric=np.where(np.isfinite(threshold), statistic, np.nan),
                reject=statistic >= threshold,
                limit=threshold,
                sides="above",
            ),
        )


SCREEN = RaimScreen()

"""Screen that rejects ranges with a large assumed standard deviation."""

from collections.abc import Iterator
from typing import Any

from pydantic import Field

from railfix.core.reason_names import screen_reason
from railfix.core.settings import Settings
from railfix.screens.base import (
    AntennaRanges,
    ObservationScreen,
    RunTables,
    ScreenColumn,
    Screened,
    ScreenPicture,
    ScreenSetup,
    Verdict,
)

REASON = screen_reason("large_sigma")


class LargeSigmaLimits(Settings):
    """Limits of the screen.

    Attributes
    ----------
    limit_m : float [m]
        Largest standard deviation of a range that is used.
    """

    limit_m: float = Field(default=10.0, gt=0)


class LargeSigmaScreen(ObservationScreen[LargeSigmaLimits]):
    """Screen that rejects ranges with a large assumed standard deviation."""

    name = "large_sigma"
    limits = LargeSigmaLimits()
    needs = "weights"
    columns = (ScreenColumn(name="metric_large_sigma_m", meaning="assumed sigma", verdict="large_sigma"),)

    def judge(
        self, antenna: AntennaRanges, limits: LargeSigmaLimits, setup: ScreenSetup, state: Any
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdict on a chunk, and None as the state, because no earlier epochs are used."""
        screened = Screened(metric=antenna.sigma_m, reject=antenna.sigma_m > limits.limit_m, limit=limits.limit_m)
        return (Verdict(name=self.name, reason=REASON, screened=screened),), None

    def pictures(self, tables: RunTables, limits: LargeSigmaLimits) -> Iterator[tuple[str, ScreenPicture]]:
        """Yield the picture of the standard deviations and their limit."""
        yield (
            self.name,
            ScreenPicture(
                title="assumed standard deviation",
                label="sigma [m]",
                metric=tables.channels("metric_large_sigma_m"),
                reject=tables.rejected(REASON),
                limit=limits.limit_m,
                sides="above",
            ),
        )


SCREEN = LargeSigmaScreen()

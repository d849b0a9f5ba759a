"""Steps of a chunk of one antenna, and what two antennas show each other between them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from railfix.core.arrays import Floats
from railfix.screens import AntennaRanges, Screened, Verdict


class Followed(NamedTuple):
    """Places of one antenna by the filter and their standard deviations, shape (T,) [m]; NaN without one."""

    chainage_m: Floats
    sigma_m: Floats


class PositionVerdict(NamedTuple):
    """Verdict of a screen on the positions of one antenna: doubtful ones get the status."""

    name: str
    screened: Screened
    status: int


class ChunkSteps(Protocol):
    """A chunk of one antenna, in this process or another one; the steps are called in this order."""

    def screened(self) -> AntennaRanges:
        """Return the corrected ranges after the screens of this antenna alone."""

    def judge(self, verdicts: Iterable[Verdict]) -> None:
        """Take the verdicts of the screens of common observations."""

    def solved(self) -> Floats:
        """Solve and return the chainages that are published, NaN where there is none, shape (T,) [m]."""

    def check(self, verdicts: Iterable[PositionVerdict]) -> None:
        """Take the verdicts of the screens of the published positions."""

    def followed(self) -> Followed:
        """Filter along the track and return its places; NaN where the filter is off."""

    def check_filter(self, spacing: Screened | None) -> None:
        """Take the verdict on the distance of those places; None where it was not looked at."""

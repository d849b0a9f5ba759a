"""Steps of a chunk of one antenna, and what two antennas show each other between them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from railfix.core.arrays import Floats
from railfix.screens import AntennaRanges, Screened, Verdict


@dataclass(frozen=True, kw_only=True)
class Published:
    """Positions of T epochs that are compared with those of the other antenna.

    Attributes
    ----------
    chainage_m : ndarray, shape (T,) [m]
        NaN where there is none.
    """

    chainage_m: Floats


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

    def solved(self) -> Published:
        """Solve and return what is published of the positions."""

    def check(self, verdicts: Iterable[PositionVerdict]) -> None:
        """Take the verdicts of the screens of the published positions."""

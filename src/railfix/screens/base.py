"""Base classes of the screens: inputs and results of a screen, and the methods that a screen may override.

A screen is one subclass of `ObservationScreen`, `PairScreen` or `PositionScreen`, and one line in
`railfix.screens.registry` or one entry point of an installed package (docs/screens.md shows an example).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Generic, Literal, NamedTuple, Protocol, TypeVar

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.core.notebook import NotebookTable
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.ranges.corrected import AntennaRanges as AntennaRanges

Limits = TypeVar("Limits", bound=Settings)
#: Least number of sigmas added to the sigma of a suspected range: at most a fifth of its weight remains.
LEAST_SUSPICION: Final = 2.0


@dataclass(frozen=True, kw_only=True, repr=False)
class Screened(NotebookTable):
    """Metric and verdict of one screen, T epochs by M channels, or P pairs of positions."""

    metric: Floats  #: Measured quantity in the unit that the screen names; NaN where it cannot be run.
    reject: Masks  #: True = rejected. Where the metric is NaN the screen does not reject.
    #: Limit that the metric is compared with, in its unit; broadcasts to it; NaN where nothing is compared.
    limit: Floats | float = float("nan")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A screen's result on the channels of one antenna."""

    name: str  #: Key in `AntennaResult.screens`: the screen's name, or one name per verdict if it has several.
    reason: Reason  #: Reason given to the rejected observations.
    screened: Screened  #: Shapes (T, K).
    #: Size of the measured error, by which the weight of suspected ranges is lowered; None for rejection; shape (T, K).
    error_m: Floats | None = None


def suspicion_sigma_m(reject: Masks, error_m: Floats, sigma_m: Floats) -> Floats:
    """Return the standard deviation of ranges of which some are suspected, shape (T, M) [m].

    The error of a suspected range (`reject`), as measured by the screen (`error_m`) and at least two sigmas, is added
    to `sigma_m` as another standard deviation.
    """
    if not reject.any():
        return sigma_m
    at, result = np.nonzero(reject), sigma_m.copy()
    sigma = sigma_m[at]
    result[at] = np.hypot(sigma, np.fmax(np.abs(error_m[at]), LEAST_SUSPICION * sigma))
    return result


@dataclass(frozen=True, kw_only=True)
class ScreenSetup:
    """Properties of a run that some screens need."""

    antennas: int = 1  #: Number of antennas.
    spacing_known: bool = False  #: Whether a vehicle file places both antennas on one vehicle.
    cn0_curve: Cn0Curve | None = None  #: Mean C/N0 over elevation of antenna and receiver.


@dataclass(frozen=True, kw_only=True)
class ScreenColumn:
    """Column of the result tables filled by a screen."""

    name: str  #: Name with its unit: ``metric_doppler_m``.
    meaning: str
    verdict: str  #: Key in `AntennaResult.screens`.
    field: str = "metric"  #: Array of that verdict: "metric", or another one of a subclass of `Screened`.
    table: Literal["observations", "positions"] = "observations"


@dataclass(frozen=True)
class ScreenPicture:
    """Data of the picture of one screen, T epochs by M channels (M = 1 for a screen of positions)."""

    title: str
    label: str  #: Name of the metric, with its unit.
    metric: Floats  #: Shape (T, M).
    reject: Masks  #: Shape (T, M).
    limit: Floats | float  #: Broadcasts to (T, M).
    #: Side on which the screen rejects: beyond the limit on both sides, above it, or below it.
    sides: Literal["both", "above", "below"] = "both"


class ObservationPicture(NamedTuple):
    """Picture of an observation column against its limit."""

    name: str
    title: str
    label: str
    metric: str  #: Column of the observations.
    reason: Reason  #: Reason of the rejected observations.
    limit: str  #: Field of the screen's limits (no picture where it is None), or column of the observations.
    sides: Literal["both", "above", "below"] = "both"


class RunTables(Protocol):
    """Result tables of one antenna as arrays, for the charts."""

    def channels(self, column: str) -> Floats:
        """Return the column of the observations, shape (T, M); NaN where not observed."""

    def rejected(self, reason: Reason) -> Masks:
        """Return observations that carry a reason, shape (T, M)."""

    def epochs(self, column: str) -> Floats:
        """Return the column of the positions, shape (T, 1)."""


class Screen(ABC, Generic[Limits]):
    """Base class of a screen; derive from the subclass for its kind of verdict."""

    name: ClassVar[str]  #: Name in `Config.screens` and of its settings group.
    limits: Limits  #: Default limits, whose type defines the settings group.
    needs: ClassVar[str]  #: Required data, for the note on a missing screen.
    columns: ClassVar[tuple[ScreenColumn, ...]] = ()  #: Columns of the result tables.
    observation_pictures: ClassVar[tuple[ObservationPicture, ...]] = ()

    def unable(self, limits: Limits, setup: ScreenSetup) -> bool:
        """Return whether the screen cannot be run in this run at all."""
        return False

    def notes(self, limits: Limits, setup: ScreenSetup) -> tuple[str, ...]:
        """Return sentences on a requested screen that cannot be run, or only in part."""
        return (f"screen {self.name} was not run: it needs {self.needs}",) if self.unable(limits, setup) else ()

    def pictures(self, tables: RunTables, limits: Limits) -> Iterator[tuple[str, ScreenPicture]]:
        """Yield name and data of each picture of the screen: `observation_pictures`, or an override of it."""
        for name, title, label, metric, reason, where, sides in self.observation_pictures:
            limit = getattr(limits, where) if hasattr(limits, where) else tables.channels(where)
            if limit is not None:
                yield name, ScreenPicture(title, label, tables.channels(metric), tables.rejected(reason), limit, sides)


class ObservationScreen(Screen[Limits]):
    """A screen of the observations of one antenna."""

    @abstractmethod
    def judge(
        self, antenna: AntennaRanges, limits: Limits, setup: ScreenSetup, state: Any
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdicts on a chunk, and the state for the next one.

        Parameters
        ----------
        state : object
            State returned with the previous chunk; None at the start. Screens without memory return None.
        """

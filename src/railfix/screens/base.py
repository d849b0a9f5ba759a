"""Base classes of the screens: inputs and results of a screen, and the methods that a screen may override.

A new screen is a subclass of `ObservationScreen`, `PairScreen` or `PositionScreen`. It is registered by a line in
`railfix.screens.registry`, or by an entry point of an installed package (docs/screens.md shows an example).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, NamedTuple, Protocol, TypeVar

from railfix.core.arrays import Floats, Masks, Strings
from railfix.core.notebook import NotebookTable
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.gnss.observations import ObservationHeader
from railfix.ranges.corrected import AntennaRanges as AntennaRanges

Limits = TypeVar("Limits", bound=Settings)


@dataclass(frozen=True, kw_only=True, repr=False)
class Screened(NotebookTable):
    """Metric and verdict of one screen, shape (T, M) for observations and (P,) for pairs of positions."""

    metric: Floats  #: Measured quantity, in the unit of the screen; NaN where the test is impossible.
    reject: Masks  #: True where rejected; always False where the metric is NaN.
    #: Limit of the metric, in the same unit; broadcasts to the shape of the metric; NaN where no test is made.
    limit: Floats | float = float("nan")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A screen's result on the channels of one antenna."""

    name: str  #: Key in `AntennaResult.screens`: name of the screen, or of one of several verdicts of the screen.
    reason: Reason  #: Rejection reason of the observations that the screen rejects.
    screened: Screened  #: Metric and verdict, shape (T, M).
    #: Measured error that increases the sigma of a suspected range; None to reject the range; shape (T, M).
    error_m: Floats | None = None


class OpenSkyCn0(Protocol):
    """Mean C/N0 of an antenna and receiver under open sky (`railfix.ranges.cn0_curve.Cn0Curve`)."""

    def covers(self, satellite: Strings, signal: Strings) -> Masks:
        """Return whether the mean of each channel is known, shape (M,)."""

    def mean_dbhz(self, elevation_deg: Floats, *, satellite: Strings, signal: Strings) -> Floats:
        """Return the mean C/N0 of channels at their elevations, shape (T, M) [dB-Hz]; NaN where unknown."""

    def notes_for(self, header: ObservationHeader) -> tuple[str, ...]:
        """Return one sentence for each difference in antenna or receiver between a log's header and the curve."""


@dataclass(frozen=True, kw_only=True)
class ScreenSetup:
    """Properties of a run that some screens need."""

    antennas: int = 1  #: Number of antennas.
    spacing_known: bool = False  #: Whether a vehicle file states the positions of both antennas on one vehicle.
    cn0_curve: OpenSkyCn0 | None = None  #: Mean C/N0 of the antenna and receiver as a function of elevation.


@dataclass(frozen=True, kw_only=True)
class ScreenColumn:
    """Column that a screen fills in the result tables."""

    name: str  #: Name of the column, ending with the unit: ``metric_doppler_m``.
    meaning: str
    verdict: str  #: Key of the verdict in `AntennaResult.screens`.
    field: str = "metric"  #: Name of the array in `Verdict.screened` that fills the column.
    table: Literal["observations", "positions"] = "observations"


@dataclass(frozen=True)
class ScreenPicture:
    """Data of the picture of one screen, T epochs by M channels (M = 1 for a screen of positions)."""

    title: str
    label: str  #: Name of the metric, with its unit.
    metric: Floats  #: Shape (T, M).
    reject: Masks  #: Shape (T, M).
    limit: Floats | float  #: Broadcasts to (T, M).
    #: Values that are rejected: above the limit, below the limit, or with a magnitude above the limit ("both").
    sides: Literal["both", "above", "below"] = "both"
    weighs: bool = False  #: Whether the screen increases the sigma of suspect values instead of rejecting them.


class ObservationPicture(NamedTuple):
    """Definition of a picture that shows an observation column and its limit."""

    name: str
    title: str
    label: str
    metric: str  #: Column of the observations.
    reason: Reason  #: Rejection reason of the observations drawn as rejected.
    limit: str  #: Name of an observation column or a field of the screen's limits (no picture if the field is None).
    sides: Literal["both", "above", "below"] = "both"


class RunTables(Protocol):
    """Result tables of one antenna as arrays, for the charts."""

    def channels(self, column: str) -> Floats:
        """Return a column of the observations, shape (T, M); NaN where not observed."""

    def rejected(self, reason: Reason) -> Masks:
        """Return the mask of the observations rejected for a reason, shape (T, M)."""

    def epochs(self, column: str) -> Floats:
        """Return a column of the positions, shape (T, 1)."""


class Screen(ABC, Generic[Limits]):
    """Base class of `ObservationScreen`, `PairScreen` and `PositionScreen`; derive new screens from these three."""

    name: ClassVar[str]  #: Name of the screen in `Config.screens`, and of its settings group.
    limits: Limits  #: Default limits; the type of this object defines the settings group.
    needs: ClassVar[str]  #: Data that the screen requires; quoted in the note to the user if the data are missing.
    columns: ClassVar[tuple[ScreenColumn, ...]] = ()  #: Columns of the result tables.
    observation_pictures: ClassVar[tuple[ObservationPicture, ...]] = ()

    def unable(self, limits: Limits, setup: ScreenSetup) -> bool:
        """Return whether the data required by the screen are missing in the whole run."""
        return False

    def notes(self, limits: Limits, setup: ScreenSetup) -> tuple[str, ...]:
        """Return notes to the user on a requested screen that cannot be run, or can be run only in part."""
        return (f"screen {self.name} was not run: it needs {self.needs}",) if self.unable(limits, setup) else ()

    def pictures(self, tables: RunTables, limits: Limits) -> Iterator[tuple[str, ScreenPicture]]:
        """Yield the name and data of each picture of the screen; the default uses `observation_pictures`."""
        for name, title, label, metric, reason, where, sides in self.observation_pictures:
            limit = getattr(limits, where) if hasattr(limits, where) else tables.channels(where)
            if limit is not None:
                yield name, ScreenPicture(title, label, tables.channels(metric), tables.rejected(reason), limit, sides)


class ObservationScreen(Screen[Limits]):
    """Screen of one antenna's observations."""

    @abstractmethod
    def judge(
        self, antenna: AntennaRanges, limits: Limits, setup: ScreenSetup, state: Any
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdicts on a chunk of epochs, and the state for the next chunk.

        Parameters
        ----------
        state : object
            State returned for the previous chunk; None at the start. A screen that does not use earlier epochs returns
            the state unchanged.
        """

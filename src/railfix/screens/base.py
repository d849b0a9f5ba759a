"""Base classes of the screens: inputs and results of a screen, and the methods that a screen may override.

A screen is one subclass of `ObservationScreen`, `PairScreen` or `PositionScreen`, and one line in
`railfix.screens.registry` or one entry point of an installed package (docs/screens.md shows an example).

Pairs of epochs and channels of two antennas, and medians over the channels of a clock, are for screens of pairs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, Final, Generic, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from railfix import kernels
from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings, kernel_array
from railfix.core.constants import CLOCK_GROUP
from railfix.core.reasons import Reason, Status
from railfix.core.settings import Settings
from railfix.core.tables import NotebookTable
from railfix.core.timescale import nearest_rows
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.ranges.corrected import AntennaRanges
from railfix.track.trajectory import Trajectory

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

    name: str  #: Key in `AntennaResult.screens`: the screen's own name, or one a verdict where it has several.
    reason: Reason  #: Given to the rejected observations.
    screened: Screened  #: Shapes (T, K).
    #: Size of the measured error: suspected ranges are weighted down by it. None: rejected; shape (T, K).
    error_m: Floats | None = None


def suspicion_sigma_m(reject: Masks, error_m: Floats, sigma_m: Floats) -> Floats:
    """Return the standard deviation of ranges of which some are suspected, shape (T, M) [m].

    The error of a suspected range (`reject`), as the screen measured it (`error_m`), two sigmas at least, is added to
    `sigma_m` as another standard deviation.
    """
    if not reject.any():
        return sigma_m
    at, result = np.nonzero(reject), sigma_m.copy()
    sigma = sigma_m[at]
    result[at] = np.hypot(sigma, np.fmax(np.abs(error_m[at]), LEAST_SUSPICION * sigma))
    return result


@dataclass(frozen=True, kw_only=True)
class ScreenSetup:
    """Facts of a run that some screens need."""

    antennas: int = 1  #: Number of antennas.
    spacing_known: bool = False  #: Whether a vehicle file places both antennas on one vehicle.
    cn0_curve: Cn0Curve | None = None  #: Mean C/N0 over elevation of antenna and receiver.


@dataclass(frozen=True, kw_only=True)
class ScreenColumn:
    """A column of the result tables that a screen fills."""

    name: str  #: With its unit: ``metric_doppler_m``.
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
    """Picture of a column of the observations against its limit."""

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
    """One screen; derive from the subclass for its kind of verdict."""

    name: ClassVar[str]  #: In `Config.screens`, and of its group of settings.
    limits: Limits  #: Default limits; their type has the fields of the group of settings.
    needs: ClassVar[str]  #: Data without which it cannot be run, for the note.
    columns: ClassVar[tuple[ScreenColumn, ...]] = ()  #: Columns of the result tables.
    observation_pictures: ClassVar[tuple[ObservationPicture, ...]] = ()

    def unable(self, limits: Limits, setup: ScreenSetup) -> bool:
        """Return whether the screen cannot be run at all in this run."""
        return False

    def notes(self, limits: Limits, setup: ScreenSetup) -> tuple[str, ...]:
        """Return sentences on a screen that was requested and cannot be run, or not fully."""
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
            Returned with the previous chunk; None at the start. Screens without memory return None.
        """


@dataclass(frozen=True, kw_only=True)
class PairedEpochs:
    """Common epochs of two antennas of one vehicle, P of them."""

    #: Epochs of each antenna that belong together, shape (P,).
    front_epoch: Indices
    rear_epoch: Indices
    #: Approximate positions of the antennas on their trajectories, shape (P, 3).
    front_ecef_m: Floats
    rear_ecef_m: Floats
    #: Chainage of the front antenna less that of the rear one: negative if facing falling chainage; shape (P,).
    along_m: Floats


class _OfTwoAntennas(Screen[Limits]):
    """A screen that needs two antennas of one vehicle."""

    needs = "two antennas and a vehicle file, which gives their spacing"

    def unable(self, limits: Limits, setup: ScreenSetup) -> bool:
        """Return whether two antennas with a known spacing are missing."""
        return setup.antennas < 2 or not setup.spacing_known


class PairScreen(_OfTwoAntennas[Limits]):
    """A screen of the observations of two antennas of one vehicle."""

    @abstractmethod
    def judge(
        self, front: AntennaRanges, rear: AntennaRanges, pair: PairedEpochs, limits: Limits
    ) -> Mapping[str, tuple[Verdict, ...]]:
        """Return the verdicts on a chunk by antenna, "front" and "rear"."""


class FilteredMotion(NamedTuple):
    """Positions [m] and speeds [m/s] of one antenna by the filter along the track, NaN where missing, shape (T,)."""

    chainage_m: Floats
    sigma_m: Floats
    speed_mps: Floats
    speed_sigma_mps: Floats

    def take(self, epochs: Indices) -> FilteredMotion:
        """Return those of some epochs."""
        return FilteredMotion(*(values[epochs] for values in self))


class PositionScreen(_OfTwoAntennas[Limits]):
    """A screen of the positions of two antennas of one vehicle."""

    status: ClassVar[Status]  #: Given to the epochs of both antennas whose positions are rejected.

    @abstractmethod
    def judge(self, front_chainage_m: Floats, rear_chainage_m: Floats, pair: PairedEpochs, limits: Limits) -> Screened:
        """Return metric and verdict of the P pairs of positions, chainages of shape (P,) [m]."""

    @abstractmethod
    def judge_filtered(
        self, front: FilteredMotion, rear: FilteredMotion, pair: PairedEpochs, limits: Limits
    ) -> Screened:
        """Return the verdict for the P pairs of positions and speeds by the filter along the track."""


def pair_epochs(time_front: ArrayLike, time_rear: ArrayLike, *, tolerance_s: float) -> tuple[Indices, Indices]:
    """Return the epochs of two receivers that belong together, by rising time tags that differ by `tolerance_s` at
    most.

    Each epoch is in one pair at most: two epochs are paired if each is the nearest to the other.
    """
    within_ns = round(tolerance_s * 1e9)
    to_rear = nearest_rows(time_rear, time_front, within_ns=within_ns)
    to_front = nearest_rows(time_front, time_rear, within_ns=within_ns)
    index = (to_rear >= 0).nonzero()[0]
    index = index[to_front[to_rear[index]] == index]
    return index, to_rear[index]


def pair_channels(
    satellite_front: Strings, signal_front: Strings, satellite_rear: Strings, signal_rear: Strings
) -> tuple[Indices, Indices]:
    """Return the channels of the same satellite and signal at both receivers, in the order of the front one's."""
    if satellite_front is satellite_rear and signal_front is signal_rear:  # epochs of both are rows of the same arrays
        every = np.arange(len(satellite_front))
        return every, every
    rear = {key: m for m, key in enumerate(zip(satellite_rear.tolist(), signal_rear.tolist(), strict=True))}
    keys = enumerate(zip(satellite_front.tolist(), signal_front.tolist(), strict=True))
    pairs = [(m, rear[key]) for m, key in keys if key in rear]
    both = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def on_pairs(screened: Screened, shape: tuple[int, ...], epochs: Indices, channels: Indices) -> Screened:
    """Return a verdict on pairs of epochs and channels laid on one antenna's own, of shape `shape`."""
    metric, reject = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    where = (epochs[:, None], channels) if len(shape) > 1 else epochs
    metric[where], reject[where] = screened.metric, screened.reject
    limit = screened.limit
    if isinstance(limit, np.ndarray):
        limit = np.full(shape, np.nan)
        limit[where] = screened.limit
    return Screened(metric=metric, reject=reject, limit=limit)


def pair_antennas(
    front_time: Datetimes,
    rear_time: Datetimes,
    front_arc_m: Floats,
    front_path: Trajectory,
    rear_path: Trajectory,
    *,
    tolerance_s: float,
) -> PairedEpochs:
    """Return the epochs of two antennas matched by their time tags, with both positions on the line.

    `front_arc_m`: approximate arc lengths of the front antenna, shape (T,).
    """
    at_front, at_rear = pair_epochs(front_time, rear_time, tolerance_s=tolerance_s)
    front_arc = front_arc_m[at_front]
    rear_arc = rear_path.arc_of_body(front_path.body_at(front_arc))
    return PairedEpochs(
        front_epoch=at_front, rear_epoch=at_rear, front_ecef_m=front_path.at_arc(front_arc),
        rear_ecef_m=rear_path.at_arc(rear_arc),
        along_m=front_path.chainage_at(front_arc) - rear_path.chainage_at(rear_arc),
    )  # fmt: skip


def clock_medians(values: Floats, satellite: Strings, *, least: int = 0) -> Floats:
    """Return the median over the channels of one clock, at each channel (T, M); NaN below `least` satellites."""
    return kernels.screens.clock_medians(
        kernel_array(values), *_clocks(satellite.dtype.str, satellite.tobytes()), least
    )


@lru_cache(maxsize=256)
def _clocks(kind: str, satellites: bytes) -> tuple[Indices, Indices]:
    """Return numbers of clock and satellite of M channels."""
    names = np.frombuffer(satellites, dtype=kind).tolist()
    clock, number = (np.unique(of, return_inverse=True)[1] for of in ([CLOCK_GROUP[n[0]] for n in names], names))
    return clock.astype(np.intp), number.astype(np.intp)

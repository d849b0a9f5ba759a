"""Counts of the epochs and observations of a run, and writing of the result tables in chunks."""

from __future__ import annotations

import pickle
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Masks, Strings
from railfix.core.reason_names import first_reason, reason_names
from railfix.core.reasons import Reason, Status
from railfix.integrity.interference import CAUSES, Suspicion
from railfix.integrity.point_validation import PointStatus
from railfix.integrity.protection import Cause, LevelStatus
from railfix.pipeline.antenna_order import AntennaOrder
from railfix.pipeline.balises import balise_notes
from railfix.pipeline.filter_result import Replay
from railfix.pipeline.interference_stage import Interference
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.result_tables import (
    antenna_positions,
    antenna_train,
    observations_table,
    passing_table,
    positions_table,
    smoothed_table,
    train_table,
    with_smoothed,
)
from railfix.pipeline.results import AntennaResult, Result
from railfix.pipeline.smoothed_track import smooth
from railfix.run.output import OutputFolder
from railfix.run.sensor_checks import SensorChecks
from railfix.run.sources import OpenedLine
from railfix.tracking import Line

if TYPE_CHECKING:
    import polars as pl


_NOT_A_REJECTION = Reason.NOT_OBSERVED
#: If the interference check has one of these results, an offset of the positions may still be a map error.
_MAP_IN_QUESTION: Final = (Suspicion.NONE, Suspicion.JAMMING_SUSPECTED, Suspicion.CONTRADICTED)
_NO_RECORD = Reason.NO_EPHEMERIS | Reason.EPHEMERIS_TOO_OLD


@dataclass(frozen=True, kw_only=True)
class MapOffsetFound:
    """Mean offset of the 3-D positions of a time window from the line."""

    time: np.datetime64  #: End of the window.
    across_m: float  #: Offset to the right of the line [m].
    up_m: float  #: Offset above the line [m].
    across_sigma_m: float  #: Standard deviation of `across_m` [m].
    up_sigma_m: float  #: Standard deviation of `up_m` [m].
    statistic: float  #: Test statistic of the offset (`railfix.integrity`).

    @property
    def text(self) -> str:
        """Clause on the offset with its likely causes."""
        across, up = abs(self.across_m) / self.across_sigma_m, abs(self.up_m) / self.up_sigma_m
        causes = "heights without the geoid, or in another height system" if up > across else "a parallel track"
        side, above = "right" if self.across_m > 0 else "left", "above" if self.up_m > 0 else "below"
        return (
            f"over the minutes before {str(self.time)[:19]} the 3-D positions lie {abs(self.across_m):.1f} m "
            f"(sigma {self.across_sigma_m:.1f} m) {side} of the line and {abs(self.up_m):.1f} m (sigma "
            f"{self.up_sigma_m:.1f} m) {above} it; likely causes: {causes}, or another reference frame"
        )


@dataclass(kw_only=True)
class AntennaTally:
    """Counts of one antenna's epochs and observations."""

    min_satellites: int = 3  #: Minimum number of satellites that a position requires.
    judged: dict[str, bool] = field(default_factory=dict)  #: For each screen, whether it has tested any data.
    epochs: int = 0  #: Number of epochs.
    observed: int = 0  #: Number of epochs with at least one pseudorange.
    positioned: int = 0  #: Number of epochs with coordinates.
    observations: int = 0  #: Number of pseudoranges.
    used: int = 0  #: Number of pseudoranges used for positions.

    status: Counter[str] = field(default_factory=Counter)  #: Number of epochs by status.
    status_positioned: Counter[str] = field(default_factory=Counter)  #: Number of epochs with coordinates, by status.
    #: Number of epochs with too few satellites, by decisive reason. Rejection reasons are applied in the order of their
    #: bits; the first after which too few satellites remain is decisive. The decisive reason is `not_observed` if too
    #: few satellites were observed, and `used` if enough remained, but their clocks left no range for the position.
    short_first: Counter[str] = field(default_factory=Counter)
    #: For each rejection reason, number of epochs with too few satellites that would have enough without this reason.
    short_only: Counter[str] = field(default_factory=Counter)
    #: For each rejection reason, number of observations whose first reason it is.
    first_reason: Counter[str] = field(default_factory=Counter)
    #: For each rejection reason, number of observations that have only this reason.
    only_reason: Counter[str] = field(default_factory=Counter)
    satellites: Counter[str] = field(default_factory=Counter)  #: Number of observations by satellite.
    #: For each satellite, number of observations without a valid navigation record.
    unrecorded: Counter[str] = field(default_factory=Counter)

    first: np.datetime64 | None = None
    last: np.datetime64 | None = None
    conventional: int = 0  #: Number of epochs with a valid conventional position.
    #: Smallest distance of a valid conventional position from the trajectory [m]; NaN if there is none.
    conventional_nearest_m: float = float("nan")
    #: Number of epochs by status of the protection level; empty if protection levels are off.
    level_status: Counter[str] = field(default_factory=Counter)
    #: Number of epochs without a protection level, because too many satellites are excluded, or because the probability
    #: of more simultaneous faults than can be excluded exceeds the risk.
    without_budget: int = 0
    #: Map offset with the largest test statistic; None if no window had enough positions.
    map_offset: MapOffsetFound | None = None
    #: For each satellite, number of epochs at which the filter excluded its codes as persistently wrong, and the first
    #: of these epochs.
    left_out: dict[str, tuple[int, np.datetime64]] = field(default_factory=dict)
    #: Same as `left_out`, but for codes that single-epoch positioning excluded.
    lasting: dict[str, tuple[int, np.datetime64]] = field(default_factory=dict)
    #: For each sign of interference, number of epochs with this sign, and the first of these epochs.
    interference: dict[str, tuple[int, np.datetime64]] = field(default_factory=dict)
    #: Smallest and largest time-tag error at epochs with suspected time tags [s], positive for late tags; NaN without
    #: such epochs.
    tag_error_s: tuple[float, float] = (float("nan"), float("nan"))
    #: Detectable map offset, shape (2, 2) [m]: smallest (row 0) and largest (row 1) of all windows, across (column 0)
    #: and up (column 1). NaN if there is no window.
    map_detectable_m: Floats = field(default_factory=lambda: np.full((2, 2), np.nan))

    def add(self, result: AntennaResult) -> None:
        """Add the counts of a chunk of results."""
        if not len(result.time):
            return
        self.first = result.time[0] if self.first is None else self.first
        self.last = result.time[-1]
        for name, screened in result.screens.items():
            self.judged[name] = self.judged.get(name, False) or bool(np.isfinite(screened.metric).any())
        counts = np.bincount(result.status, minlength=len(Status))
        self.epochs += len(result.time)
        self.observed += len(result.time) - int(counts[Status.NO_OBSERVATION])
        has = np.isfinite(result.chainage_m)
        positioned = np.bincount(result.status[has], minlength=len(Status))
        self.positioned += int(np.count_nonzero(has))
        self.status.update({s.text: int(counts[s]) for s in Status if counts[s]})
        self.status_positioned.update({s.text: int(positioned[s]) for s in Status if positioned[s]})
        self._add_reasons(result)
        self._add_short(result)
        self.add_conventional(result)
        self._add_map_offset(result)
        lasting = (result.reason & int(Reason.LASTING_ERROR)) != 0
        _count_left_out(self.lasting, lasting, result.satellite, result.time)
        if result.interference is not None:
            signs = (result.interference.causes[:, None] & np.array([int(cause) for cause in CAUSES])) != 0
            _count_left_out(self.interference, signs, np.array([str(c.name).lower() for c in CAUSES]), result.time)
            self._add_tag_error(result.interference)
        if result.protection is not None:
            levels = np.bincount(result.protection.status, minlength=len(LevelStatus))
            self.level_status.update({s.name.lower(): int(levels[s]) for s in LevelStatus})
            self.without_budget += int(np.count_nonzero(result.protection.level.cause == Cause.BUDGET))

    def add_conventional(self, result: AntennaResult) -> None:
        """Count the valid conventional positions, and update their smallest distance from the trajectory.

        Invalid conventional positions are ignored, because inconsistent ranges give arbitrary positions.
        """
        offset = result.conventional_offset_m[result.conventional_status == PointStatus.VALID]
        self.conventional += len(offset)
        if len(offset):
            self.conventional_nearest_m = float(np.fmin(self.conventional_nearest_m, offset.min()))

    def _add_tag_error(self, interference: Interference) -> None:
        error = interference.motion.tag_error_s[interference.suspicion == Suspicion.TIME_TAGS]
        error = error[np.isfinite(error)]
        if len(error):
            low, high = self.tag_error_s
            self.tag_error_s = float(np.fmin(low, error.min())), float(np.fmax(high, error.max()))

    def _add_map_offset(self, result: AntennaResult) -> None:
        """Keep the most significant map offset of the windows whose interference result is in `_MAP_IN_QUESTION`."""
        offset, interference = result.map_offset, result.interference
        if not np.isfinite(offset.statistic).any():
            return
        least, largest = np.nanmin(offset.detectable_m, axis=0), np.nanmax(offset.detectable_m, axis=0)
        known = self.map_detectable_m
        self.map_detectable_m = np.stack([np.fmin(known[0], least), np.fmax(known[1], largest)])
        own = np.full(len(result.time), True)
        if interference is not None:
            own = np.isin(interference.suspicion, _MAP_IN_QUESTION)
        if not np.isfinite(offset.statistic[own]).any():
            return
        worst = int(np.nanargmax(np.where(own, offset.statistic, np.nan)))
        if self.map_offset is None or offset.statistic[worst] > self.map_offset.statistic:
            names = ("across_m", "up_m", "across_sigma_m", "up_sigma_m", "statistic")
            values = {name: float(getattr(offset, name)[worst]) for name in names}
            self.map_offset = MapOffsetFound(time=result.time[worst], **values)

    def _add_reasons(self, result: AntennaResult) -> None:
        seen = (result.reason & _NOT_A_REJECTION) == 0
        reason = result.reason[seen]
        first = first_reason(reason)
        self.observations += reason.size
        self.used += int(np.count_nonzero(reason == 0))
        for bit, name in reason_names().items():
            if count := int(np.count_nonzero(first == bit)):
                self.first_reason[name] += count
            if count := int(np.count_nonzero(reason == bit)):
                self.only_reason[name] += count
        without = seen & ((result.reason & _NO_RECORD) != 0)
        for counter, mask in ((self.satellites, seen), (self.unrecorded, without)):
            of_channel = np.count_nonzero(mask, axis=0)
            for channel in np.flatnonzero(of_channel):
                counter[str(result.satellite[channel])] += int(of_channel[channel])

    def _add_short(self, result: AntennaResult) -> None:
        """Add the reasons for too few satellites to `short_first` and `short_only`."""
        short = np.flatnonzero(result.status == Status.TOO_FEW_SATELLITES)
        if not len(short):
            return
        names, which = np.unique(result.satellite, return_inverse=True)
        member = (which[:, None] == np.arange(len(names))).astype(np.int64)
        reason = result.reason[short]
        # Signals that were not selected were not checked, and are therefore not counted as usable.
        looked_at = (reason & Reason.OTHER_SIGNAL_TAKEN) == 0

        def enough(without: int) -> Masks:
            left = (looked_at & ((reason & without) == 0)).astype(np.int64) @ member > 0
            return np.asarray(np.count_nonzero(left, axis=1) >= self.min_satellites)

        so_far, undecided = 0, np.ones(len(short), dtype=bool)
        all_reasons = sum(reason_names())
        for bit, name in reason_names().items():
            so_far |= bit
            lost = undecided & ~enough(so_far)
            self.short_first.update({name: int(lost.sum())})
            undecided &= ~lost
            if bit != Reason.NOT_OBSERVED:
                self.short_only.update({name: int((enough(all_reasons & ~bit) & ~enough(all_reasons)).sum())})
        self.short_first.update({"used": int(undecided.sum())})

    @property
    def never_recorded(self) -> dict[str, int]:
        """Number of observations by satellite, for satellites that never had a valid navigation record."""
        return {s: n for s, n in sorted(self.unrecorded.items()) if n == self.satellites[s]}

    def as_dict(self) -> dict[str, Any]:
        """Return the counts as plain values for JSON."""
        return {
            "epochs": self.epochs,
            "epochs_with_observations": self.observed,
            "epochs_with_position": self.positioned,
            "positioning_rate": self.positioned / self.observed if self.observed else None,
            "ok_rate": self.status[Status.OK.text] / self.observed if self.observed else None,
            "first_epoch_gpst": None if self.first is None else str(self.first),
            "last_epoch_gpst": None if self.last is None else str(self.last),
            "status": {s.text: self.status[s.text] for s in Status},
            "epochs_with_position_by_status": dict(+self.status_positioned),
            "epochs_without_position_by_status": dict(self.status - self.status_positioned),
            "too_few_satellites_by_first_reason": dict(+self.short_first),
            "too_few_satellites_by_one_reason_alone": dict(+self.short_only),
            "observations": self.observations,
            "observations_used": self.used,
            "observations_rejected_by_first_reason": dict(self.first_reason),
            "observations_rejected_by_one_reason_alone": dict(self.only_reason),
            "satellites_seen": dict(sorted(self.satellites.items())),
            "satellites_without_any_record": self.never_recorded,
            "interference": {s: {"epochs": n, "first": str(t)[:19]} for s, (n, t) in self.interference.items()},
            "satellites_left_out": {s: n for s, (n, _) in sorted(self.lasting.items())},
            "satellites_left_out_by_the_filter": {s: n for s, (n, _) in sorted(self.left_out.items())},
        }


@dataclass(kw_only=True)
class Tally:
    """Counts of all antennas of a run."""

    min_satellites: int = 3  #: Minimum number of satellites that a position requires.
    antennas: dict[str, AntennaTally] = field(default_factory=dict)
    #: Notes of all chunks, as keys, in order of time.
    notes: dict[str, None] = field(default_factory=dict)
    #: For each chunk: first epoch, number of epochs of all antennas, and processing time [s].
    chunks: list[tuple[np.datetime64, int, float]] = field(default_factory=list)
    order: AntennaOrder | None = None  #: Test for exchanged front and rear antennas; None with one antenna.

    def add(self, result: Result) -> None:
        """Add the counts of a chunk of results."""
        for name, antenna in result.antennas.items():
            tally = self.antennas.setdefault(name, AntennaTally(min_satellites=self.min_satellites))
            tally.add(antenna)
            if name in result.fusion:
                of_filter, satellite = result.fusion[name], antenna.satellite[antenna.columns]
                _count_left_out(tally.left_out, of_filter.tracked.faulty, satellite, of_filter.time)
        if self.order is not None and len(result.antennas) > 1:
            both = (result.antennas["front"], result.antennas["rear"])
            self.order.add(*((each.time, each.chainage_m, each.along_sigma_m) for each in both))
        self.notes.update(dict.fromkeys(result.notes))

    @property
    def all_notes(self) -> tuple[str, ...]:
        """Notes of all chunks, and any note on exchanged antennas."""
        order = None if self.order is None else self.order.note
        return tuple(self.notes) if order is None else (*self.notes, order)

    def took(self, times: Iterable[Datetimes], spent_s: float) -> None:
        """Record the processing time of a chunk [s]. `times` has the time tags of each antenna."""
        some = [part for part in times if len(part)]
        if some:
            self.chunks.append((min(part[0] for part in some), sum(map(len, some)), spent_s))

    @property
    def epochs(self) -> int:
        """Number of epochs, summed over all antennas."""
        return sum(a.epochs for a in self.antennas.values())

    @property
    def positioned(self) -> int:
        """Number of epochs with coordinates, summed over all antennas."""
        return sum(a.positioned for a in self.antennas.values())


def _count_left_out(
    counts: dict[str, tuple[int, np.datetime64]], left_out: Masks, satellite: Strings, time: Datetimes
) -> None:
    """Add to `counts` the number of epochs flagged in each column of `left_out`, shape (T, K).

    `satellite` has the column names. For each name, the first flagged epoch is also kept.
    """
    for k in np.flatnonzero(left_out.any(axis=0)).tolist():
        name, first = str(satellite[k]), time[int(np.argmax(left_out[:, k]))]
        before = counts.get(name, (0, first))
        counts[name] = (before[0] + int(left_out[:, k].sum()), before[1])


#: Functions that return the result tables, by table name. Tables of the filter are None without the filter.
TABLES: Final[Mapping[str, Callable[[Result], pl.DataFrame | None]]] = {
    "positions": positions_table,
    "train": lambda result: train_table(result) if result.fusion else None,
    "passings": lambda result: passing_table(result) if result.fusion else None,
}


def make_tables(result: Result, *, passings: bool) -> dict[str, pl.DataFrame]:
    """Return the tables of a chunk, with the name of each table as key. Filtered positions and passings (optional)
    exist only with the filter.

    The table of passings may have no rows.
    """
    tables = {name: table_of(result) for name, table_of in TABLES.items() if passings or name != "passings"}
    return {name: table for name, table in tables.items() if table is not None}


@dataclass(frozen=True, kw_only=True)
class ResultRows:
    """Writer of the tables of a run, in chunks."""

    folder: OutputFolder
    line: OpenedLine
    observations: bool  #: Whether the table of observations is written.
    checks: SensorChecks | None  #: Checks of the sensors against the first antenna; None without sensors.
    replays: Mapping[str, Replays]  #: Filter input by antenna, stored for smoothing; empty without smoothing.
    passings: bool = False  #: Whether the table of passings of balises and virtual balises is written.
    #: Notes on balises that were missed or were read at a wrong position.
    balise_notes: list[str] = field(default_factory=list)

    def write(self, result: Result) -> None:
        """Append the rows of a chunk to the tables. On a network, columns and a table of tracks are added."""
        tables = make_tables(result, passings=self.passings)
        if self.observations:
            tables["observations"] = observations_table(result)
        if self.checks is not None and result.fusion:
            name = next(iter(result.fusion))
            self.checks.take(antenna_positions(name, result.antennas[name]), antenna_train(name, result.fusion[name]))
        for name, own in result.fusion.items():
            self.balise_notes.extend(balise_notes(name, own.passings))
        for name, kept in self.replays.items():
            if name in result.fusion:
                kept.keep(result.replays[name])
        if self.line.route is not None:
            tables["positions"], tables["tracks"] = self.line.route.on_tracks(tables["positions"], self.line.track)
            if "train" in tables:
                tables["train"], _ = self.line.route.on_tracks(tables["train"], self.line.track)
        for name, table in tables.items():
            if name == "observations":
                self.folder.append_parquet(f"{name}.parquet", table)
            else:
                self.folder.append_rows(name, table)


#: Maximum number of notes on balises in a run.
_MOST_NOTES: Final = 20


def shorten_notes(notes: list[str]) -> list[str]:
    """Return at most `_MOST_NOTES` notes. If notes are omitted, a last sentence states their number."""
    more = len(notes) - _MOST_NOTES
    return notes if more <= 0 else [*notes[:_MOST_NOTES], f"{more} more notes on balises; see the table of passings"]


class Replays:
    """Filter input for smoothing, in a temporary file that is deleted with this object or when the process ends."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  open as long as the run
        self._starts: list[int] = []

    def __del__(self) -> None:
        self._file.close()

    def keep(self, chunk: tuple[Replay, ...]) -> None:
        """Store the input of a chunk."""
        self._starts.append(self._file.tell())
        pickle.dump(chunk, self._file, protocol=pickle.HIGHEST_PROTOCOL)

    def backward(self) -> Iterator[Replay]:
        """Yield the stored input in reverse order of time."""
        for start in reversed(self._starts):
            self._file.seek(start)
            yield from reversed(pickle.load(self._file))


def add_smoothed(replays: Mapping[str, Replays], processor: EpochProcessor, folder: OutputFolder) -> None:
    """Smooth each antenna's filter input, and rewrite `train.*` with the columns of the smoother added."""
    smoothed = {}
    for name, kept in replays.items():
        trajectory = processor.trajectories[name]
        result = smooth(kept.backward(), Line(trajectory), processor.config.tracking)
        smoothed[name] = smoothed_table(result, trajectory)
    done = dict.fromkeys(smoothed, 0)

    def with_smoother(table: pl.DataFrame) -> pl.DataFrame:
        parts = {}
        for name, whole in smoothed.items():
            count = int((table["antenna"] == name).sum())
            parts[name] = whole[done[name] : done[name] + count]
            done[name] += count
        return with_smoothed(table, parts)

    folder.change("train", with_smoother)

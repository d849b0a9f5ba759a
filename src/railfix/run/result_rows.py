"""Rows of a run: the tables of each chunk, and the columns of the smoother at the end."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from railfix.pipeline.passing_table import balise_notes, passing_table
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import Result
from railfix.pipeline.smoothing import Replay, smooth
from railfix.pipeline.tables import antenna_positions, observations_table, positions_table, rounded
from railfix.pipeline.train_table import antenna_train, smoothed_table, train_table, with_smoothed
from railfix.run.batch_check import BatchCheck
from railfix.run.output import OutputFolder
from railfix.run.sensor_checks import SensorChecks
from railfix.run.sources import OpenedLine
from railfix.tracking import Line

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, kw_only=True)
class ResultRows:
    """What is made of each chunk of results."""

    folder: OutputFolder
    line: OpenedLine
    observations: bool  #: Whether rows of observations are wanted.
    checks: SensorChecks | None  #: Takes those of the first antenna, where there are sensors.
    replays: Mapping[str, Replays]  #: Keeps what the filter was given, by antenna; empty where nothing is smoothed.
    #: The same, of the epochs that a batch is compared with.
    batches: Mapping[str, BatchCheck] = field(default_factory=dict)
    passings: bool = False  #: Whether rows of balises and virtual ones are wanted.
    #: Balises so far that were missed, or read where they are not.
    balise_notes: list[str] = field(default_factory=list)

    def write(self, result: Result) -> None:
        """Write the rows of a chunk, with their tracks on a route of a network."""
        tables = {"positions": positions_table(result)}
        if result.fusion:
            tables["train"] = train_table(result)
        if self.observations:
            tables["observations"] = observations_table(result)
        if self.checks is not None and result.fusion:
            name = next(iter(result.fusion))
            self.checks.take(antenna_positions(name, result.antennas[name]), antenna_train(name, result.fusion[name]))
        for name, own in result.fusion.items():
            self.balise_notes.extend(balise_notes(name, own.passings))
        if self.passings:
            tables["passings"] = passing_table(result)
        for name, check in self.batches.items():
            if name in result.fusion:
                check.take(result.fusion[name])
        for name, kept in self.replays.items():
            if name in result.fusion:
                kept.keep(result.fusion[name].replay)
        if self.line.route is not None:
            tables["positions"], tables["tracks"] = self.line.route.on_tracks(tables["positions"], self.line.track)
            if "train" in tables:
                tables["train"], _ = self.line.route.on_tracks(tables["train"], self.line.track)
        for name, table in tables.items():
            self.folder.append_parquet(f"{name}.parquet", table)
            if name != "observations":
                self.folder.append_csv(f"{name}.csv", rounded(table))


#: Notes on balises that a run gives.
_MOST_NOTES: Final = 20


def shortened(notes: list[str]) -> list[str]:
    """Return the first notes, and how many there are beside."""
    more = len(notes) - _MOST_NOTES
    return notes if more <= 0 else [*notes[:_MOST_NOTES], f"{more} more notes on balises; see the table of passings"]


class Replays:
    """What the filter was given, chunk by chunk, in a file that ends with the process."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  open as long as the run
        self._starts: list[int] = []

    def __del__(self) -> None:
        self._file.close()

    def keep(self, chunk: tuple[Replay, ...]) -> None:
        """Add a chunk."""
        self._starts.append(self._file.tell())
        pickle.dump(chunk, self._file, protocol=pickle.HIGHEST_PROTOCOL)

    def backward(self) -> Iterator[Replay]:
        """Yield what was kept, the last first."""
        for start in reversed(self._starts):
            self._file.seek(start)
            yield from reversed(pickle.load(self._file))


def add_smoothed(replays: Mapping[str, Replays], processor: EpochProcessor, folder: OutputFolder) -> None:
    """Write `train.*` again with the columns of the smoother, after the last chunk."""
    smoothed = {}
    for name, kept in replays.items():
        trajectory = processor.trajectories[name]
        result = smooth(kept.backward(), Line.of(trajectory), processor.config.tracking)
        smoothed[name] = smoothed_table(result, trajectory)
    done = dict.fromkeys(smoothed, 0)

    def widened(table: pl.DataFrame) -> pl.DataFrame:
        parts = {}
        for name, whole in smoothed.items():
            count = int((table["antenna"] == name).sum())
            parts[name] = whole[done[name] : done[name] + count]
            done[name] += count
        return with_smoothed(table, parts)

    folder.change("train", widened)

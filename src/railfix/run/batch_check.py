"""Compare the filter along the track of a run with a fit of the whole log (`railfix.tracking.batch`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Masks
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.result_columns import Column, by_name, make_table
from railfix.run.output import OutputFolder
from railfix.track.trajectory import Trajectory
from railfix.tracking import GnssEpochs
from railfix.tracking.batch import BatchTrack, fit_batch, joined_epochs

#: Differences beyond so many standard deviations, of filter and batch together, are reported.
_SIGMAS: Final = 5.0
#: Spacing of the epochs that are fitted [ns].
_PERIOD_NS: Final = 1_000_000_000


#: Columns that the check adds to ``train.*`` (`railfix run --check batch`), at an epoch a second.
BATCH_COLUMNS: Final[Mapping[str, Column[tuple[BatchTrack, Trajectory]]]] = by_name(
    (
        Column(
            "batch_chainage_m",
            "distance along the line by a robust fit of codes and Dopplers of the whole log",
            lambda found: found[1].chainage_at(found[0].arc_m),
        ),
        Column("batch_sigma_m", "its standard deviation, that of the map in it", lambda found: found[0].sigma_m),
    )
)


@dataclass(kw_only=True)
class BatchCheck:
    """Epochs of one antenna, an epoch a second, with the places that the filter gave them."""

    trajectory: Trajectory
    _epochs: list[GnssEpochs] = field(default_factory=list)
    _places: list[Floats] = field(default_factory=list)
    _last: int = -1

    def take(self, result: AlongTrack) -> None:
        """Take what the filter was given and returned for a chunk."""
        second = result.time.astype("datetime64[ns]").astype(np.int64) // _PERIOD_NS
        rows = np.flatnonzero(np.diff(second, prepend=self._last) > 0)
        if not len(rows):
            return
        self._last = int(second[-1])
        given = joined_epochs([replay.epochs for replay in result.replay if len(replay.epochs)])
        self._epochs.append(given.take(rows))
        self._places.append(np.stack([result.tracked.arc_m, result.tracked.sigma_m], axis=1)[rows])

    def fit(self) -> tuple[BatchTrack, Floats, Masks]:
        """Return the batch, places of the filter less those of it [m], and which both sigmas do not explain."""
        epochs, places = joined_epochs(self._epochs), np.concatenate(self._places)
        batch = fit_batch(epochs, self.trajectory, places[:, 0])
        apart, turn = places[:, 0] - batch.arc_m, self.trajectory.turn_m
        if np.isfinite(turn):
            apart = apart - turn * np.round(apart / turn)
        return batch, apart, np.abs(apart) > _SIGMAS * np.hypot(places[:, 1], batch.sigma_m)

    def __bool__(self) -> bool:
        return bool(self._epochs)


def add_batch(checks: Mapping[str, BatchCheck], folder: OutputFolder) -> list[str]:
    """Write ``train.*`` again with `BATCH_COLUMNS`, after the last chunk; return a note an antenna."""
    found: list[pl.DataFrame] = []
    notes: list[str] = []
    for name, check in checks.items():
        if check:
            batch, apart, wrong = check.fit()
            table = make_table(BATCH_COLUMNS, (batch, check.trajectory), len(batch.time))
            found.append(table.with_columns(time_gpst=batch.time, antenna=pl.lit(name)))
            notes += _note(name, batch, apart, wrong, check.trajectory)
    if found:
        rows = pl.concat(found)
        folder.change(
            "train", lambda table: table.join(rows, on=["time_gpst", "antenna"], how="left", maintain_order="left")
        )
    return notes


def _note(name: str, batch: BatchTrack, apart: Floats, wrong: Masks, trajectory: Trajectory) -> Iterator[str]:
    """Yield a note on the epochs where the two differ: how many, where and by how much."""
    compared = int(np.isfinite(apart).sum())
    if not compared:
        yield f"{name}: batch check: nothing to compare; there are no places of the filter and of codes together"
        return
    worst = int(np.nanargmax(np.where(wrong, np.abs(apart), np.nan) if wrong.any() else np.abs(apart)))
    where = (
        f"by {abs(apart[worst]):.1f} m at {str(batch.time[worst])[:19]}, chainage "
        f"{float(trajectory.chainage_at(batch.arc_m[worst])):.1f} m by the batch"
    )
    if wrong.any():
        first = str(batch.time[int(np.argmax(wrong))])[:19]
        yield (
            f"{name}: batch check: filter and batch differ by more than {_SIGMAS:g} of their standard deviations at "
            f"{int(wrong.sum())} of {compared} epochs, first at {first}, most {where}"
        )
    else:
        yield f"{name}: batch check: filter and batch agree at all {compared} epochs within their sigmas, most {where}"

"""Add what the smoother found to the rows of the filter along the track."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from railfix.pipeline.train_table import with_smoothed
from railfix.run.antennas import AntennaRun, OtherProcess
from railfix.run.output import OutputFolder

if TYPE_CHECKING:
    import polars as pl


def add_smoothed(runs: Mapping[str, AntennaRun | OtherProcess], folder: OutputFolder) -> None:
    """Write `train.*` again with the columns of the smoother, after the last chunk."""
    smoothed = {name: run.smoothed() for name, run in runs.items()}
    done = dict.fromkeys(smoothed, 0)

    def widened(table: pl.DataFrame) -> pl.DataFrame:
        parts = {}
        for name, whole in smoothed.items():
            count = int((table["antenna"] == name).sum())
            parts[name] = whole[done[name] : done[name] + count]
            done[name] += count
        return with_smoothed(table, parts)

    folder.change("train", widened)

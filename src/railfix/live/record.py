"""Tables of the results of a live session, as ``railfix run`` writes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import polars as pl

from railfix.live.engine import LiveOutput
from railfix.pipeline.passing_table import passing_table
from railfix.pipeline.tables import positions_table, rounded
from railfix.pipeline.train_table import train_table
from railfix.run.output import OutputFolder, Overwrite

#: Results that are kept in memory before they are written.
_BLOCK = 600


class ResultTables:
    """A context manager that writes ``positions.*``, ``train.*`` and ``passings.*`` of a session into a folder."""

    def __init__(self, out: Path, *, overwrite: Overwrite, inputs: Sequence[Path]) -> None:
        self._folder = OutputFolder(out, overwrite=overwrite, inputs=list(inputs))
        self._positions: list[pl.DataFrame] = []
        self._train: list[pl.DataFrame] = []
        self._passings: list[pl.DataFrame] = []

    def __enter__(self) -> ResultTables:
        self._folder.__enter__()
        return self

    def add(self, output: LiveOutput) -> None:
        """Take the rows of one output."""
        if output.result is None or output.part == "message":
            return
        self._positions.append(positions_table(output.result))
        if output.result.fusion:
            self._train.append(train_table(output.result))
        if any(own.passings for own in output.result.fusion.values()):
            self._passings.append(passing_table(output.result))
        if len(self._positions) >= _BLOCK:
            self._write()

    def _write(self) -> None:
        for name, tables in (("positions", self._positions), ("train", self._train), ("passings", self._passings)):
            if tables:
                table = pl.concat(tables)
                self._folder.append_parquet(f"{name}.parquet", table)
                self._folder.append_csv(f"{name}.csv", rounded(table))
                tables.clear()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._write()
            self._folder.commit({})
        self._folder.__exit__(kind, error, trace)

"""Parquet files written as their rows come."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import polars as pl

#: Rows of a group of a file, which is put together in memory.
_GROUP: Final = 30_000
#: How often a caller that waits looks whether the writer has failed [s].
_LOOK_S: Final = 0.1


class ParquetFile:
    """A Parquet file to which rows are appended; memory does not grow with their number.

    polars writes a file from one query. Here the source of the query waits for the next rows, in a thread, and one
    table at most waits for it.

    Parameters
    ----------
    path : Path
    schema : polars.Schema
        Of every table that is appended.
    """

    def __init__(self, path: Path, schema: pl.Schema) -> None:
        self._path, self._schema = path, schema
        self._waiting: Queue[pl.DataFrame | None] = Queue(maxsize=1)
        self._metadata: dict[str, str] = {}
        self._error: BaseException | None = None
        self._thread = Thread(target=self._write, name=path.name, daemon=True)
        self._thread.start()

    def append(self, table: pl.DataFrame) -> None:
        """Append rows; raises what the writing of earlier ones has raised."""
        from polars.exceptions import SchemaError

        if table.schema != self._schema:
            raise SchemaError(f"rows have the columns {dict(table.schema)}, expected {dict(self._schema)}")
        self._give(table)

    def end(self, metadata: Mapping[str, str] | None = None) -> None:
        """Write the footer, with `metadata`; raises what writing has raised."""
        self._metadata = dict(metadata or {})
        self._give(None)
        self._thread.join()
        if self._error is not None:
            raise self._error

    def _give(self, table: pl.DataFrame | None) -> None:
        while self._thread.is_alive():
            with suppress(Full):
                return self._waiting.put(table, timeout=_LOOK_S)
        if self._error is not None:
            raise self._error
        raise ValueError(f"{self._path.name} has ended")

    def _write(self) -> None:
        from polars.io.plugins import register_io_source

        def tables(*_: object) -> Iterator[pl.DataFrame]:
            while (table := self._waiting.get()) is not None:
                yield table

        try:
            rows = register_io_source(tables, schema=self._schema)
            # The metadata is asked for last, with the footer.
            rows.sink_parquet(self._path, row_group_size=_GROUP, metadata=lambda _: self._metadata)
        except BaseException as error:  # noqa: BLE001  raised again where rows are given
            self._error = error

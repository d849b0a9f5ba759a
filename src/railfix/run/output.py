"""The folder a run writes to: everything under temporary names, in place only when the run is done."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

from railfix.core.errors import OutputError

if TYPE_CHECKING:
    import polars as pl

#: How times are written to CSV: ISO 8601, GPS time, to the nanosecond, no time zone.
CSV_TIME = "%Y-%m-%dT%H:%M:%S%.9f"


class OutputFolder:
    """A folder that gets all files of a run at once, or none.

    Used as a context manager. Inside it, tables are appended piece by piece under a temporary
    folder; `commit` moves them in place. Leaving without `commit` (an error) removes what was
    written, and the folder itself where it had not been there before.

    Parameters
    ----------
    path : Path
        Made where it does not exist, with its parents.
    overwrite : {"refuse", "replace"}
        What to do with a folder that has files in it already: "replace" replaces files of the
        same names at the end and leaves others alone.

    Raises
    ------
    OutputError
        The folder cannot be made or written, or is not empty.
    """

    def __init__(self, path: Path, *, overwrite: str = "refuse") -> None:
        if overwrite not in ("refuse", "replace"):
            raise ValueError(f"overwrite is {overwrite!r}, expected 'refuse' or 'replace'")
        self.path = path
        self._made: list[Path] = []
        self._csv: dict[str, IO[bytes]] = {}
        self._pieces: dict[str, list[Path]] = {}
        self._staged: list[Path] = []
        with _writing(path):
            if path.exists() and not path.is_dir():
                raise OutputError(f"{path}: is a file, expected a folder for the results; name another folder")
            if overwrite == "refuse" and path.is_dir() and any(path.iterdir()):
                raise OutputError(f"{path}: the folder is not empty; name another one, or give --overwrite")
            self._make()
            try:
                self._staging = Path(tempfile.mkdtemp(prefix=".railfix-", dir=path))
            except OSError:
                self._unmake()
                raise

    def _make(self) -> None:
        missing = [p for p in (self.path, *self.path.parents) if not p.exists()]
        for folder in reversed(missing):
            try:
                folder.mkdir()
            except OSError:
                self._unmake()
                raise
            self._made.append(folder)

    def _unmake(self) -> None:
        for folder in reversed(self._made):
            with suppress(OSError):
                folder.rmdir()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for handle in self._csv.values():
            handle.close()
        shutil.rmtree(self._staging, ignore_errors=True)
        if kind is not None:
            self._unmake()

    def append_csv(self, name: str, table: pl.DataFrame) -> None:
        """Append rows to a CSV file; the header is written once."""
        with _writing(self.path / name):
            first = name not in self._csv
            if first:
                self._csv[name] = (self._staging / name).open("wb")
            table.write_csv(self._csv[name], include_header=first, datetime_format=CSV_TIME)

    def append_parquet(self, name: str, table: pl.DataFrame) -> None:
        """Append rows to a Parquet file, kept as pieces until `commit`."""
        with _writing(self.path / name):
            pieces = self._pieces.setdefault(name, [])
            piece = self._staging / f"{name}.{len(pieces):06d}"
            table.write_parquet(piece, compression="lz4", statistics=False)
            pieces.append(piece)

    def scan(self, name: str) -> pl.LazyFrame:
        """What was appended so far to a Parquet file."""
        import polars as pl

        return pl.scan_parquet(self._pieces[name])

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write one JSON file."""
        with _writing(self.path / name):
            text = json.dumps(_finite(content), indent=2, ensure_ascii=False, allow_nan=False)
            (self._staging / name).write_text(text + "\n", encoding="utf-8")
        self._staged.append(self._staging / name)

    def commit(self, metadata: Mapping[str, str]) -> dict[str, Path]:
        """Join the pieces and move every file in place.

        Parameters
        ----------
        metadata : mapping of str to str
            Written into the footer of each Parquet file.

        Returns
        -------
        dict of str to Path
            Where each file stands.
        """
        files: dict[str, Path] = {}
        with _writing(self.path):
            for name, handle in self._csv.items():
                handle.close()
                self._staged.append(self._staging / name)
            for name in self._pieces:
                whole = self._staging / name
                self.scan(name).sink_parquet(whole, metadata=dict(metadata))
                self._staged.append(whole)
            for source in self._staged:
                if (target := self.path / source.name).is_dir():
                    raise OutputError(f"{target}: is a folder, expected a file to replace; remove it")
            for source in sorted(self._staged):
                files[source.name] = source.replace(self.path / source.name)
        return files


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn what the system says about a file into one sentence."""
    from polars.exceptions import PolarsError

    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{path}: cannot be written ({reason}); name a folder that can be written to") from error
    except PolarsError as error:
        raise OutputError(f"{path}: cannot be written ({error})") from error


def _finite(value: Any) -> Any:
    """The same plain values with NaN and infinities, which JSON has not, as words."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value

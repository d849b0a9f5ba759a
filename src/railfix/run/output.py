"""Writing of output files under temporary names. All files are moved to the output folder when they are complete.

An output never replaces an input. The files are first written to a hidden, locked staging folder. If a process is
killed, its staging folder remains, but the operating system releases the lock. A staging folder that is not locked
therefore belongs to a process that has ended.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Final, Literal, Self

from railfix.core.errors import OutputError
from railfix.core.staged_files import write_error

if TYPE_CHECKING:
    import polars as pl


_PREFIX: Final = ".railfix-"
_LOCK: Final = ".lock"
#: Subfolder of a staging folder with the complete files. A single rename creates it with all files.
READY: Final = "ready"


@dataclass(frozen=True, kw_only=True)
class Staging:
    """Hidden folder inside a results folder, and its open lock file, which contains the process identifier."""

    path: Path
    lock: IO[str]

    def remove(self) -> None:
        """Remove the folder and then the lock file."""
        shutil.rmtree(self.path, ignore_errors=True)
        name = Path(self.lock.name)
        if sys.platform == "win32":
            self.lock.close()
        name.unlink(missing_ok=True)
        self.lock.close()


def make_staging(folder: Path) -> Staging:
    """Create a staging folder inside `folder`, locked by this process. Raise OSError if `folder` is not writable."""
    while True:
        name = folder / f"{_PREFIX}{secrets.token_hex(4)}"
        path, staging = name.with_name(name.name + _LOCK), None
        try:
            lock = path.open("x", encoding="ascii")
            staging = Staging(path=name, lock=lock)
            lock.write(f"{os.getpid()}\n")
            lock.flush()
            # Before the new lock file was locked, another process may have removed it as a remnant.
            if _try_lock(lock) and Path(lock.name).exists():
                name.mkdir()
                return staging
        except BaseException as error:  # also KeyboardInterrupt and SystemExit, even while the file is opened
            if staging is not None:
                staging.remove()
            elif not isinstance(error, FileExistsError):
                path.unlink(missing_ok=True)
            raise
        lock.close()


def clean_up(folder: Path) -> None:
    """Remove the staging folders of killed processes; complete files in them are first moved to `folder`.

    Raise OutputError if another process is writing to the folder.
    """
    for path in [p for p in folder.iterdir() if p.name.startswith(_PREFIX)]:
        if path.name.endswith(_LOCK):
            _release(path)
        elif not path.with_name(path.name + _LOCK).exists():
            shutil.rmtree(path, ignore_errors=True)


def _release(lock: Path) -> None:
    """Remove a killed process's lock file and staging folder. Raise OutputError if the process is still running."""
    try:
        file = lock.open("r+", encoding="ascii", errors="replace")
    except FileNotFoundError:
        return
    with file:
        if not _try_lock(file):
            process = file.read().strip() or "unknown"
            raise OutputError(
                f"{lock.parent}: another railfix (process {process}) is writing there; wait for it, or give "
                "another folder"
            )
        staging = lock.with_name(lock.name.removesuffix(_LOCK))
        if (staging / READY).is_dir():
            move_in_place(staging / READY, lock.parent)
        shutil.rmtree(staging, ignore_errors=True)
        if sys.platform == "win32":
            file.close()
        lock.unlink(missing_ok=True)


def move_in_place(ready: Path, folder: Path) -> dict[str, Path]:
    """Move all files in `ready` to `folder`, records (JSON) last. Return the new paths by name.

    Records that will be replaced are removed first, so that a record is never in a folder with another run's tables.
    """
    files = sorted(ready.iterdir(), key=lambda path: (path.suffix == ".json", path.name))
    for source in files:
        if source.suffix == ".json":
            (folder / source.name).unlink(missing_ok=True)
    moved = {source.name: source.replace(folder / source.name) for source in files}
    return {name: moved[name] for name in sorted(moved)}


def _try_lock(file: IO[str]) -> bool:
    """Lock a file for this process. Return False if another process has locked it."""
    if sys.platform == "win32":
        import msvcrt

        with suppress(OSError):
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            return True
        return False
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


#: Rows per row group of a Parquet file. Each group is assembled in memory.
_GROUP: Final = 30_000
#: Interval at which a waiting caller checks whether the writer has failed [s].
_LOOK_S: Final = 0.1


class ParquetFile:
    """Parquet file to which tables of one schema are appended. Memory use does not grow with the number of tables.

    polars writes a file from a single query. A thread runs the query; its source waits for each appended table. At most
    one table is queued.
    """

    def __init__(self, path: Path, schema: pl.Schema) -> None:
        self._path, self._schema = path, schema
        self._waiting: Queue[pl.DataFrame | None] = Queue(maxsize=1)
        self._metadata: dict[str, str] = {}
        self._error: BaseException | None = None
        self._thread = Thread(target=self._write, name=path.name, daemon=True)
        self._thread.start()

    def append(self, table: pl.DataFrame) -> None:
        """Queue rows for writing. Raise SchemaError if their columns differ, and any error in writing earlier rows."""
        from polars.exceptions import SchemaError

        if table.schema != self._schema:
            raise SchemaError(f"rows have the columns {dict(table.schema)}, expected {dict(self._schema)}")
        self._give(table)

    def end(self, metadata: Mapping[str, str] | None = None) -> None:
        """Write the remaining rows, and the footer with `metadata`. Raise any error that occurred during writing."""
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
        raise ValueError(f"{self._path.name} is closed already, so that no rows can be added")

    def _write(self) -> None:
        from polars.io.plugins import register_io_source

        def tables(*_: object) -> Iterator[pl.DataFrame]:
            while (table := self._waiting.get()) is not None:
                yield table

        try:
            rows = register_io_source(tables, schema=self._schema)
            # polars requests the metadata last, when it writes the footer.
            rows.sink_parquet(self._path, row_group_size=_GROUP, metadata=lambda _: self._metadata)
        except BaseException as error:  # noqa: BLE001  raised again when rows are appended
            self._error = error


#: Whether existing files are an error or are replaced.
Overwrite = Literal["refuse", "replace"]
#: Kind of a single output file, for `check_output_file`.
FileKind = Literal["page", "csv", "pos", "picture", "png", "map", "any"]
#: For each kind of file: description, name endings, and hint on other formats.
_ENDINGS: Final[Mapping[str, tuple[str, tuple[str, ...], str]]] = {
    "page": ("an HTML page", (".html", ".htm"), "; for a PDF file, print the page in a browser"),
    "csv": ("a table in CSV", (".csv",), ""),
    "pos": ("RTKLIB's format of positions", (".pos",), ""),
    "picture": ("a picture in PNG or SVG", (".png", ".svg"), ""),
    "png": ("a picture in PNG", (".png",), ""),
    "map": ("a file for maps", (".kml", ".gpx", ".geojson", ".gpkg", ".parquet", ".mcap"), ""),
}
#: Format of GPS times in CSV: ISO 8601 with nanoseconds, without a time zone.
CSV_TIME: Final = "%Y-%m-%dT%H:%M:%S%.9f"
#: Number of rows that `OutputFolder.change` transforms at a time.
_ROWS: Final = 50_000

#: Number of attempts to create a folder while other runs create and remove its parent folders.
_ATTEMPTS: Final = 10


class OutputFolder:
    """Output folder of a command. It receives all files at once or none, and is created if it does not exist.

    In the block of this context manager, files are written to a hidden staging folder; `commit` moves them to the
    output folder. If the block ends with an error, the written files are removed, and so is the output folder if it was
    created. Remains of a killed process are removed by the next `OutputFolder` at the same path. With "replace",
    `commit` replaces existing files that have the same names. Files in `inputs` are never overwritten.

    Raise OutputError if the folder cannot be created or written, if it is not empty (with "refuse"), if another process
    is writing to it, or if a file would overwrite an input.
    """

    def __init__(self, path: Path, *, overwrite: Overwrite = "refuse", inputs: Sequence[Path] = ()) -> None:
        if overwrite not in ("refuse", "replace"):
            raise ValueError(f"overwrite is {overwrite!r}, expected 'refuse' or 'replace'")
        self.path = path
        self._inputs = tuple(inputs)
        self._made: list[Path] = []
        self._csv: dict[str, IO[bytes]] = {}
        self._parquet: dict[str, ParquetFile] = {}
        self._staged: list[str] = []
        with _writing(path):
            check_folder(path, overwrite=overwrite)
            try:
                self._make()
                self._staging = make_staging(path)
            except BaseException:  # also KeyboardInterrupt and SystemExit
                self._unmake()
                raise

    def _make(self) -> None:
        """Create the folder and its parents. Other runs may create or remove the same folders at the same time."""
        for left in reversed(range(_ATTEMPTS)):
            try:
                for folder in reversed([p for p in (self.path, *self.path.parents) if not p.exists()]):
                    folder.mkdir()
                    self._made.append(folder)
                return
            except FileNotFoundError:
                if not left:
                    raise
            except FileExistsError:
                if not left or folder == self.path or not folder.is_dir():
                    raise

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
        for file in self._parquet.values():
            with suppress(Exception):  # an error has no effect, as the file is removed
                file.end()
        self._staging.remove()
        if kind is not None:
            self._unmake()

    @property
    def staging(self) -> Path:
        """Path of the staging folder. Only files registered by `stage` become results."""
        return self._staging.path

    def stage(self, name: str) -> Path:
        """Return a temporary path for writing a result. `commit` moves the file to the output folder.

        Raise OutputError if the file would overwrite an input, or if a folder of the same name exists.
        """
        target = self.path / name
        check_not_input(target, self._inputs)
        if target.is_dir():
            raise OutputError(f"{target}: is a folder, expected a file to replace; remove it")
        if name not in self._staged:
            self._staged.append(name)
        return self._staging.path / name

    def append_csv(self, name: str, table: pl.DataFrame) -> None:
        """Append rows to a CSV file; the header is written before the first rows."""
        with _writing(self.path / name):
            first = name not in self._csv
            if first:
                self._csv[name] = self.stage(name).open("wb")
            table.write_csv(self._csv[name], include_header=first, datetime_format=CSV_TIME)

    def append_parquet(self, name: str, table: pl.DataFrame) -> None:
        """Append rows to a Parquet file, which another thread writes (`ParquetFile`)."""
        with _writing(self.path / name):
            if name not in self._parquet:
                self._parquet[name] = ParquetFile(self.stage(name), table.schema)
            self._parquet[name].append(table)

    def append_rows(self, name: str, table: pl.DataFrame) -> None:
        """Append rows to a table: unrounded to its Parquet file, and rounded to its CSV file."""
        from railfix.pipeline.result_tables import round_floats

        self.append_parquet(f"{name}.parquet", table)
        self.append_csv(f"{name}.csv", round_floats(table))

    def end_parquet(self, metadata: Mapping[str, str] | None = None) -> None:
        """Close all Parquet files, with `metadata` in each footer. `scan` can read only closed files."""
        while self._parquet:
            name, file = next(iter(self._parquet.items()))
            with _writing(self.path / name):
                file.end(metadata)
            del self._parquet[name]

    def change(self, name: str, transform: Callable[[pl.DataFrame], pl.DataFrame]) -> None:
        """Apply a function to consecutive blocks of rows of a table, and rewrite its Parquet and CSV files."""
        import polars as pl

        file = f"{name}.parquet"
        self._csv.pop(f"{name}.csv").close()
        with _writing(self.path / file):
            self._parquet.pop(file).end()
            before = pl.scan_parquet(self.stage(file).replace(self.staging / f"{file}.before"))
            for start in range(0, before.select(pl.len()).collect().item(), _ROWS):
                self.append_rows(name, transform(before.slice(start, _ROWS).collect()))

    def scan(self, name: str) -> pl.LazyFrame:
        """Return a lazy frame of a Parquet file that `end_parquet` has closed."""
        import polars as pl

        return pl.scan_parquet(self.staging / name)

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file. NaN and infinities, which JSON lacks, are written as text (`finite_values`)."""
        with _writing(self.path / name):
            text = json.dumps(finite_values(content), indent=2, ensure_ascii=False, allow_nan=False)
            self.stage(name).write_text(text + "\n", encoding="utf-8")

    def commit(self, metadata: Mapping[str, str] | None = None) -> dict[str, Path]:
        """Move all registered files to the output folder, and return their paths by name.

        `metadata` is written to the footer of each Parquet file that is not yet closed.
        """
        staging = self._staging.path
        with _writing(self.path):
            for handle in self._csv.values():
                handle.close()
            self.end_parquet(metadata)
            ready = staging / f"{READY}.part"
            ready.mkdir()
            for name in self._staged:
                self.stage(name).replace(ready / name)
            # If the process is killed after this rename, the next process moves the files to the output folder.
            return move_in_place(ready.replace(staging / READY), self.path)


def check_folder(path: Path, *, overwrite: Overwrite) -> None:
    """Remove the remains of killed processes from a results folder. Raise OutputError if it must not be written.

    A folder must not be written if the path is a file, if another process is writing to the folder, or, with "refuse",
    if the folder is not empty.
    """
    with _writing(path):
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path}: is a file, expected a folder for the results; give another folder")
        if path.is_dir():
            clean_up(path)
        if overwrite == "refuse" and path.is_dir() and any(path.iterdir()):
            raise OutputError(f"{path}: the folder is not empty; give another folder, or add --overwrite")


def check_not_input(target: Path, inputs: Sequence[Path]) -> None:
    """Raise OutputError if a file to be written is one of the inputs, or a link to one of them."""
    for path in inputs:
        if target.resolve() == path.resolve() or (target.exists() and path.exists() and target.samefile(path)):
            raise OutputError(f"{target}: is an input, which is never overwritten; give another output")


def check_output_file(target: Path, *, overwrite: Overwrite, inputs: Sequence[Path], kind: FileKind = "any") -> None:
    """Raise OutputError if an output file cannot or must not be written.

    Possible reasons: the folder of the file does not exist or is not writable; the path is a folder or one of `inputs`;
    the file exists (with "refuse"); the name ending does not match `kind`.
    """
    with _writing(target):
        check_not_input(target, inputs)
        if not target.parent.is_dir():
            raise OutputError(f"{target}: the folder {target.parent} does not exist; create it, or give another folder")
        if target.is_dir():
            raise OutputError(f"{target}: is a folder, expected the name of a file to write")
        what, endings, other = _ENDINGS.get(kind, ("", (), ""))
        if endings and target.suffix.lower() not in endings:
            raise OutputError(
                f"{target}: {what} is written; give a file name that ends in {' or '.join(endings)}{other}"
            )
        if target.exists() and overwrite == "refuse":
            raise OutputError(f"{target}: the file exists already; give another file, or add --overwrite")
        if not os.access(target.parent, os.W_OK):
            raise OutputError(f"{target}: the folder {target.parent} cannot be written; give another folder")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Convert an OSError or PolarsError raised in the block to an OutputError that names the file."""
    from polars.exceptions import PolarsError

    try:
        yield
    except OSError as error:
        raise write_error(path, error) from error
    except PolarsError as error:
        raise OutputError(f"{path}: cannot be written ({error})") from error


def finite_values(value: Any) -> Any:
    """Return nested plain values, with NaN and infinities replaced by the texts "nan", "inf" and "-inf"."""
    if isinstance(value, Mapping):
        return {key: finite_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_values(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value

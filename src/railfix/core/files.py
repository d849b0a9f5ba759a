"""Read plain, compressed and Hatanaka files, and find the commit of railfix's source code.

Compressed files are gzip, compress (.Z), bzip2, xz, zstd and zip files. The first bytes of a file, not its name,
determine how it is read. Memory is bounded: plain files and most compressed files are streamed, a compress file is
unpacked to a temporary file by `ncompress`, and Hatanaka data are piped through ``crx2rnx`` (from a temporary file if
the CRX file is compressed).
"""

from __future__ import annotations

import codecs
import hashlib
import importlib.resources
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import cache
from os import PathLike
from pathlib import Path
from typing import IO, Any, Final, Literal, cast

import ncompress

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.packed import COMPRESS, STREAMS, ZIP, damage_errors, open_zip, zip_member
from railfix.core.staged_files import FilePath as FilePath

Paths = FilePath | Sequence[FilePath]  #: Path of one file, or paths of several files.
#: Policy of a reader for a malformed line: stop with an error, or skip and count the line.
BrokenLines = Literal["stop", "count"]
Reader = Literal["railfix", "georinex"]  #: Package with which RINEX observation files are read.
#: End of each message about a malformed line; it names the option that skips malformed lines.
LENIENT: Final = "--lenient (broken_lines='count') skips and counts malformed lines"

#: Name endings of compressed files. The ending before such an ending shows the kind of file, as in ``log.csv.gz``.
_SUFFIXES: Final = (".gz", ".z", ".bz2", ".xz", ".zst")
_UTF16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_HEAD_BYTES: Final = 4096
_COPY_BYTES: Final = 1 << 20
#: A file that is read as a whole is rejected if the ratio of its decompressed to its compressed size exceeds this
#: value. Text compresses by a factor of 20 to 50; with a larger factor, it is not text and could fill the memory.
_LARGEST_RATIO: Final = 100
_LARGEST_BYTES: Final = 64_000_000  #: Up to this decompressed size, a file is accepted at any ratio of sizes [bytes].


class ByteStream(io.BufferedIOBase):
    """Stream of the decompressed bytes of a file; `read` raises InputFileError if the data are cut short or damaged."""

    def __init__(self, path: FilePath, source: IO[bytes], held: ExitStack, *, disk: IO[bytes] | None = None) -> None:
        self.path = str(path)
        self._source = source
        self._held = held
        self._disk = source if disk is None else disk

    @property
    def share(self) -> float:
        """Fraction of the bytes on disk that has been read, 0 to 1."""
        number = self._disk.fileno()
        return os.lseek(number, 0, os.SEEK_CUR) / max(os.fstat(number).st_size, 1)

    def readable(self) -> bool:
        """Return True."""
        return True

    def read(self, size: int | None = -1, /) -> bytes:
        """Return up to `size` bytes, or all remaining bytes if `size` is negative or None; ``b""`` at the end."""
        try:
            return self._source.read(-1 if size is None else size)
        except EOFError as error:
            raise InputFileError(self.path, "the packed data end early; copy or download the file again") from error
        except damage_errors() as error:
            raise InputFileError(
                self.path, f"the packed data are damaged ({error}); download the file again"
            ) from error
        except OSError as error:
            raise InputFileError(self.path, f"cannot be read ({error.strerror or error})") from error

    def read1(self, size: int = -1, /) -> bytes:
        """Equivalent to `read`."""
        return self.read(size)

    def close(self) -> None:
        """Close the file, end the decoder, and remove temporary files."""
        if not self.closed:
            self._held.close()
        super().close()


class _HatanakaStream(ByteStream):
    """Output stream of the Hatanaka decoder; the decoder's exit code is checked at the end of the stream."""

    def __init__(
        self, path: FilePath, process: subprocess.Popen[bytes], log: IO[bytes], held: ExitStack, *, disk: IO[bytes]
    ) -> None:
        super().__init__(path, cast("IO[bytes]", process.stdout), held, disk=disk)
        self._process = process
        self._log = log
        self._done = False

    def read(self, size: int | None = -1, /) -> bytes:
        block = super().read(size)
        at_end = size is None or size < 0 or (not block and size > 0)
        if at_end and not self._done:
            self._done = True
            if self._process.wait() != 0:
                raise InputFileError(self.path, self._error_text())
        return block

    def _error_text(self) -> str:
        self._log.seek(0)
        text = self._log.read().decode("ascii", "replace")
        what = re.search(r"(?:ERROR|WARNING)[^:]*:?\s*([^\n]+)", text)
        where = re.search(r"line\s*:?\s*(\d+)", text)
        reason = what.group(1).strip().rstrip(".") if what else "the decoder crx2rnx gives no reason"
        place = f" at line {where.group(1)} of the compressed text" if where else ""
        return f"the Hatanaka (CRX) data are cut short or damaged{place}: {reason}; download the file again"


def path_names(paths: Paths) -> list[str]:
    """Return the given paths as a list of strings; raise SettingsError if there is none, or an item is not a path."""
    names = list(paths) if isinstance(paths, Iterable) and not isinstance(paths, str) else [paths]
    if not names:
        raise SettingsError("no file was given")
    if wrong := [name for name in names if not isinstance(name, str | PathLike)]:
        raise SettingsError(f"expected a path or several paths, got {type(wrong[0]).__name__}")
    return [str(name) for name in names]


def open_stream(path: FilePath, *, content: Literal["text", "bytes"] = "text") -> ByteStream:
    """Open a file as a stream of its decompressed bytes.

    Line ends are not converted. With "text", UTF-16 is converted to UTF-8 and a byte order mark is removed. Raise
    InputFileError if the file is missing, a folder, unreadable, empty, an unsupported archive, or, with "text", binary.
    """
    held = ExitStack()
    with held:
        source = held.enter_context(closing(_open_plain(path)))
        head = source.read(_HEAD_BYTES)
        source.seek(0)
        if head.startswith(b"7z\xbc\xaf"):
            raise InputFileError(path, "is a 7-zip archive; unpack it first (.gz, .Z, .bz2, .xz, .zst, .zip are read)")
        disk = source
        if head.startswith(ZIP):
            archive = held.enter_context(open_zip(path, source))
            source = held.enter_context(archive.open(zip_member(path, archive)))
        while True:
            with ByteStream(path, source, ExitStack()) as unpacked:
                head = unpacked.read(_HEAD_BYTES)
            source.seek(0)
            unpack = next((opened for magic, opened in STREAMS.items() if head.startswith(magic)), None)
            if unpack is None:
                break
            source = held.enter_context(closing(cast("IO[bytes]", unpack(source))))
        if head.startswith(COMPRESS):
            source = disk = _unpack_compress(path, source, held)
            head = source.read(_HEAD_BYTES)
            source.seek(0)
        if not head.strip():
            raise InputFileError(path, "is empty")
        if content == "text" and head.startswith(_UTF16):
            source = _as_utf8(path, source, held)
        elif content == "text" and b"\0" in head.rstrip(b"\0"):  # a power failure leaves zeros at the end
            raise InputFileError(path, "is binary; a text file was expected")
        if b"COMPACT RINEX" in head[:80]:
            return _decode_hatanaka(path, source, held)
        if content == "text" and head.startswith(codecs.BOM_UTF8):
            source.seek(len(codecs.BOM_UTF8))
        return ByteStream(path, source, held.pop_all(), disk=disk)


@contextmanager
def unpacked_file(path: FilePath) -> Iterator[Path]:
    """Yield the path of a file with the decompressed content, for programs that open files themselves.

    For a file that is not compressed, the given path is returned. All files of a zip archive are extracted into one
    folder. The temporary files are removed at the end of the block.
    """
    with _open_plain(path) as source:
        head = source.read(_HEAD_BYTES)
    if not head.startswith((ZIP, COMPRESS, *STREAMS)):
        yield Path(path)
        return
    with tempfile.TemporaryDirectory(prefix="railfix-") as folder:
        if head.startswith(ZIP):
            with _open_plain(path) as source, open_zip(path, source) as archive:
                member = zip_member(path, archive)
                archive.extractall(folder)
            yield Path(folder) / member
            return
        name = Path(Path(path).name)
        target = Path(folder) / (name.stem if name.suffix.lower() in _SUFFIXES else name.name)
        with open_stream(path, content="bytes") as stream, target.open("wb") as file:
            shutil.copyfileobj(stream, file, _COPY_BYTES)
        yield target


def read_bytes(path: FilePath) -> bytes:
    """Read the decompressed content of a small file (navigation, SP3, map); raise the errors of `open_stream`.

    Raise InputFileError if the content exceeds both `_LARGEST_RATIO` times the size of the file and `_LARGEST_BYTES`.
    """
    content = bytearray()
    with open_stream(path) as stream:
        most = max(_LARGEST_BYTES, _LARGEST_RATIO * Path(path).stat().st_size)
        while block := stream.read(_COPY_BYTES):
            content += block
            if len(content) > most:
                raise InputFileError(
                    path, f"unpacks to more than {most / 1e6:,.0f} MB, too much for a file of this compressed size"
                )
    return bytes(content)


def read_text(path: FilePath) -> str:
    """Read the text of a small UTF-8 file, without a byte order mark; raise the errors of `read_bytes`.

    Raise InputFileError if the content is not UTF-8.
    """
    content = read_bytes(path)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputFileError(path, "is not UTF-8 text; save the file as UTF-8", line=line) from None


def ending(path: FilePath) -> str:
    """Return the lower-case file name ending, ignoring compression; for a zip archive, the ending of the file in it.

    >>> ending("Line.GeoJSON.gz")
    '.geojson'
    """
    name = Path(Path(path).name.lower())
    if name.suffix in (".zip", ".kmz") and zipfile.is_zipfile(path):
        with _open_plain(path) as source, open_zip(path, source) as archive:
            return ending(zip_member(path, archive))
    return name.with_suffix("").suffix if name.suffix in _SUFFIXES else name.suffix


def file_sha256(path: FilePath) -> str:
    """Return the SHA-256 of a file as hexadecimal digits; raise InputFileError if the file cannot be read."""
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputFileError(path, f"cannot be read ({error.strerror}); check the name") from None


def fingerprint(kind: str, path: FilePath, *, name: str | None = None) -> dict[str, Any]:
    """Return a file's kind, path (`name` if given), size [byte] and SHA-256 as plain values for JSON."""
    digest = file_sha256(path)
    return {"input": kind, "path": name or str(path), "bytes": Path(path).stat().st_size, "sha256": digest}


def read_json_object(path: FilePath, *, what: str) -> dict[str, Any]:
    """Read the object in a JSON file; raise InputFileError if the file does not contain one.

    `what` names the expected kind of file in messages, with its article ("the record of a run").
    """
    try:
        content = json.loads(read_text(path))
    except RecursionError:
        raise InputFileError(path, f"is nested too deeply; expected {what}") from None
    except json.JSONDecodeError as error:
        raise InputFileError(path, f"is not valid JSON ({error}); expected {what}") from None
    if not isinstance(content, dict):
        raise InputFileError(path, f"is not {what}; expected a JSON object")
    return content


def read_text_lines(path: FilePath) -> list[str]:
    """Read a small file as Latin-1, so that each byte is one column, and return its lines without line ends."""
    lines = [line.removesuffix("\r") for line in read_bytes(path).decode("latin-1").split("\n")]
    return lines if lines[-1] else lines[:-1]


def _open_plain(path: FilePath) -> IO[bytes]:
    file = Path(path)
    if file.is_dir():
        raise InputFileError(path, "is a folder; give the file inside it")
    try:
        if file.exists() and not file.is_file():
            raise InputFileError(path, "is not a regular file; write its content to a file first")
        return file.open("rb")
    except FileNotFoundError as error:
        raise InputFileError(path, "there is no such file; check the name") from error
    except OSError as error:
        raise InputFileError(path, f"cannot be opened ({error.strerror or error})") from error


def _as_utf8(path: FilePath, source: IO[bytes], held: ExitStack) -> IO[bytes]:
    """Convert UTF-16 text, which spreadsheets write, to UTF-8 in a temporary file."""
    with ByteStream(path, source, ExitStack()) as unpacked:
        try:
            text = unpacked.read().decode("utf-16")
        except UnicodeDecodeError as error:
            raise InputFileError(path, f"is not UTF-16 text ({error.reason}); save the file as UTF-8") from None
    converted = _temporary(held)
    converted.write(text.encode("utf-8"))
    converted.seek(0)
    return converted


def _temporary(held: ExitStack) -> IO[bytes]:
    return held.enter_context(cast("IO[bytes]", tempfile.TemporaryFile(prefix="railfix-")))


def _unpack_compress(path: FilePath, source: IO[bytes], held: ExitStack) -> IO[bytes]:
    unpacked = _temporary(held)
    try:
        ncompress.decompress(source, unpacked)
    except ValueError as error:
        raise InputFileError(path, f"the compress (.Z) data are damaged ({error}); download the file again") from error
    unpacked.seek(0)
    return unpacked


def hatanaka_program(name: str) -> AbstractContextManager[Path]:
    """Return a context manager that yields the path of a program of the package `hatanaka`."""
    file = f"{name}.exe" if sys.platform == "win32" else name
    return importlib.resources.as_file(importlib.resources.files("hatanaka.bin") / file)


def _decode_hatanaka(path: FilePath, source: IO[bytes], held: ExitStack) -> ByteStream:
    """Start the Hatanaka decoder on an open file; return its output as a stream that releases `held` when closed."""
    if not isinstance(getattr(source, "raw", None), io.FileIO):
        spool = _temporary(held)
        with ByteStream(path, source, ExitStack()) as unpacked:
            shutil.copyfileobj(unpacked, spool, _COPY_BYTES)
        spool.flush()
        source = spool
    # the decoder inherits the file descriptor; `source.seek` within the buffer does not move the descriptor
    os.lseek(source.fileno(), 0, os.SEEK_SET)
    log = _temporary(held)
    program = held.enter_context(hatanaka_program("crx2rnx"))
    process = subprocess.Popen([str(program), "-"], stdin=source, stdout=subprocess.PIPE, stderr=log)
    held.callback(_end, process)
    return _HatanakaStream(path, process, log, held.pop_all(), disk=source)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.stdout is not None:
        process.stdout.close()
    if process.poll() is None:
        process.terminate()
    process.wait()


#: File with the commit of the source; the build adds the file to wheels and source archives (``.ci/hatch_build.py``).
FROM_BUILD: Final = Path(__file__).parents[1] / "_commit.txt"


@cache
def source_commit() -> str:
    """Return the commit of the source, or "unknown" if neither the build nor a checkout states it.

    "+changed" is appended if the files differed from the commit when the package was built. In a checkout
    (``pip install -e``), the commit is read from git's files; uncommitted changes are not detected.
    """
    if FROM_BUILD.is_file():
        return FROM_BUILD.read_text(encoding="ascii").strip()
    return read_commit(Path(__file__).parents[3]) or "unknown"


def read_commit(root: Path) -> str:
    """Read the commit checked out in a folder, or in an additional work tree, from git's files; "" if there is none."""
    git = root / ".git"
    if git.is_file():
        git = root / git.read_text(encoding="utf-8").removeprefix("gitdir:").strip()
    head = _first_line(git / "HEAD")
    if not head.startswith("ref: "):
        return head
    branch = head.removeprefix("ref: ")
    common = git / _first_line(git / "commondir")
    packed = common / "packed-refs"
    lines = packed.read_text(encoding="utf-8").splitlines() if packed.is_file() else []
    return _first_line(common / branch) or next((line.split()[0] for line in lines if line.endswith(f" {branch}")), "")


def _first_line(path: Path) -> str:
    return path.read_text(encoding="utf-8").partition("\n")[0].strip() if path.is_file() else ""

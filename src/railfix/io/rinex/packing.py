"""How a written RINEX file is packed, and its header records.

Packed bytes depend on the content only: gzip is given no name and no time, and the date that
``rnx2crx`` writes into its header is blanked.
"""

from __future__ import annotations

import gzip
import importlib.resources
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Final, Literal, cast, get_args

import numpy as np

from railfix.core.errors import OutputError
from railfix.core.files import FilePath, staged_file

Packing = Literal["plain", "gz", "crx", "crx.gz"]

_HATANAKA_NAME: Final = re.compile(r"\.(crx|\d\dd)$", re.IGNORECASE)
_CRX_HEADER_BYTES: Final = 162


def packing_of(path: FilePath) -> Packing:
    """Return the packing by file name: ``front.crx.gz``, ``log.26d``, ``nav.rnx.gz``, ``log.rnx``."""
    name = Path(path).name
    inner = name.removesuffix(".gz")
    packing = ("crx" if _HATANAKA_NAME.search(inner) else "", "gz" if inner != name else "")
    return cast("Packing", ".".join(part for part in packing if part) or "plain")


@contextmanager
def open_target(path: FilePath, *, packing: Packing | None = None) -> Iterator[IO[bytes]]:
    """Open a stream whose bytes are packed into a file; the file appears where the block ends without error.

    The packing is by default that of the file name (`packing_of`); "crx" takes RINEX observation text. OutputError: the
    file cannot be written, or `rnx2crx` rejects the text.
    """
    kind = packing_of(path) if packing is None else packing
    if kind not in get_args(Packing):
        raise ValueError(f"packing {kind!r} is unknown; expected one of {', '.join(get_args(Packing))}")
    with staged_file(path) as temporary, temporary.open("xb") as raw, ExitStack() as held:
        sink = cast("IO[bytes]", raw)
        if kind.endswith("gz"):
            zipped = gzip.GzipFile(filename="", mode="wb", fileobj=raw, mtime=0, compresslevel=6)
            sink = cast("IO[bytes]", held.enter_context(zipped))
        if kind.startswith("crx"):
            sink = held.enter_context(_hatanaka(path, sink))
        yield sink


@contextmanager
def _hatanaka(path: FilePath, sink: IO[bytes]) -> Iterator[IO[bytes]]:
    """Open a stream that `rnx2crx` of the `hatanaka` package compresses into `sink`."""
    name = "rnx2crx.exe" if sys.platform == "win32" else "rnx2crx"
    with (
        importlib.resources.as_file(importlib.resources.files("hatanaka.bin") / name) as program,
        tempfile.TemporaryFile(prefix="railfix-") as packed,
        tempfile.TemporaryFile(prefix="railfix-") as log,
    ):
        process = subprocess.Popen([str(program), "-"], stdin=subprocess.PIPE, stdout=packed, stderr=log)
        stream = cast("IO[bytes]", process.stdin)
        try:
            yield stream
            stream.close()
        except BrokenPipeError:
            pass  # the program ended early: its exit code and messages are checked below
        except BaseException:
            process.kill()
            raise
        finally:
            code = process.wait()
        log.seek(0)
        messages = " ".join(log.read().decode("ascii", "replace").split())
        if code != 0 or messages:
            raise OutputError(f"{path}: rnx2crx cannot compress the text ({messages or f'exit code {code}'})")
        packed.seek(0)
        sink.write(_without_date(packed.read(_CRX_HEADER_BYTES)))
        shutil.copyfileobj(packed, sink, 1 << 20)


def _without_date(head: bytes) -> bytes:
    """Blank the date of compression in the header of a CRX file."""
    lines = head.split(b"\n")
    lines[1] = lines[1][:40] + b" " * 20 + lines[1][60:]
    return b"\n".join(lines)


PROGRAM = "railfix"


def header_line(text: str, label: str) -> str:
    """Format one header record of 80 columns with its line end; ValueError for more than 60 characters or no ASCII."""
    if len(text) > 60 or not text.isascii():
        raise ValueError(f"{label}: {text!r} is not ASCII of at most 60 characters")
    return f"{text:<60}{label:<20}\n"


def program_line(created: np.datetime64 | None) -> str:
    """Format PGM / RUN BY / DATE; the date, in UTC, is blank without `created`."""
    date = ""
    if created is not None:
        date = (
            str(np.datetime_as_string(created, unit="s")).replace("-", "").replace(":", "").replace("T", " ") + " UTC"
        )
    return header_line(f"{PROGRAM:<20}{'':20}{date:<20}", "PGM / RUN BY / DATE")

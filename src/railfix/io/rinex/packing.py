"""Files to write: plain, gzip, Hatanaka (CRX), under a temporary name until they are whole.

Packed bytes depend on the content alone: gzip is given no name and no time, and the date that
``rnx2crx`` puts into its header is blanked.
"""

from __future__ import annotations

import gzip
import importlib.resources
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from os import PathLike
from pathlib import Path
from typing import IO, Final, Literal, cast, get_args

from railfix.core.errors import OutputError

Packing = Literal["plain", "gz", "crx", "crx.gz"]

_HATANAKA_NAME: Final = re.compile(r"\.(crx|\d\dd)$", re.IGNORECASE)
_CRX_HEADER_BYTES: Final = 162


def packing_of(path: str | PathLike[str]) -> Packing:
    """Packing that a file's name tells: ``front.crx.gz``, ``log.26d``, ``nav.rnx.gz``, ``log.rnx``."""
    name = Path(path).name
    inner = name.removesuffix(".gz")
    packing = ("crx" if _HATANAKA_NAME.search(inner) else "", "gz" if inner != name else "")
    return cast("Packing", ".".join(part for part in packing if part) or "plain")


@contextmanager
def open_target(path: str | PathLike[str], *, packing: Packing | None = None) -> Iterator[IO[bytes]]:
    """A stream of bytes to be packed into a file, which appears when the block ends without error.

    Parameters
    ----------
    path : path-like
    packing : {"plain", "gz", "crx", "crx.gz"}, optional
        Without it the name tells (`packing_of`). "crx" takes RINEX observation text.

    Raises
    ------
    OutputError
        The file cannot be written, or `rnx2crx` refuses the text.
    """
    kind = packing_of(path) if packing is None else packing
    if kind not in get_args(Packing):
        raise ValueError(f"packing {kind!r} is unknown; expected one of {', '.join(get_args(Packing))}")
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with temporary.open("xb") as raw:
            try:
                with ExitStack() as held:
                    sink = cast("IO[bytes]", raw)
                    if kind.endswith("gz"):
                        zipped = gzip.GzipFile(filename="", mode="wb", fileobj=raw, mtime=0, compresslevel=6)
                        sink = cast("IO[bytes]", held.enter_context(zipped))
                    if kind.startswith("crx"):
                        sink = held.enter_context(_hatanaka(path, sink))
                    yield sink
                raw.close()
                temporary.replace(target)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise OutputError(f"{path}: the file cannot be written ({error.strerror or error})") from error


@contextmanager
def _hatanaka(path: str | PathLike[str], sink: IO[bytes]) -> Iterator[IO[bytes]]:
    """RINEX observation text, compressed by the `rnx2crx` of the `hatanaka` package into `sink`."""
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
            pass  # the program ended early: its exit code and words follow
        except BaseException:
            process.kill()
            raise
        finally:
            code = process.wait()
        log.seek(0)
        words = " ".join(log.read().decode("ascii", "replace").split())
        if code != 0 or words:
            raise OutputError(f"{path}: rnx2crx cannot compress the text ({words or f'exit code {code}'})")
        packed.seek(0)
        sink.write(_without_date(packed.read(_CRX_HEADER_BYTES)))
        shutil.copyfileobj(packed, sink, 1 << 20)


def _without_date(head: bytes) -> bytes:
    """The first two lines of a CRX file with the date of compression blanked."""
    lines = head.split(b"\n")
    lines[1] = lines[1][:40] + b" " * 20 + lines[1][60:]
    return b"\n".join(lines)

"""Compressed files, detected by their first bytes: gzip, bzip2, xz, zstd, compress, zip."""

from __future__ import annotations

import bz2
import gzip
import lzma
import sys
import zipfile
import zlib
from collections.abc import Callable
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import IO, Any, Final

from railfix.core.errors import InputFileError

FilePath = str | PathLike[str]


def _zstd() -> Any:
    """Return the zstd module of the standard library (Python 3.14 and newer), or its backport."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


def damage_errors() -> tuple[type[Exception], ...]:
    """Return the errors that decompression raises if the data are damaged."""
    return zlib.error, gzip.BadGzipFile, lzma.LZMAError, zipfile.BadZipFile, _zstd().ZstdError


def open_zip(path: FilePath, source: IO[bytes]) -> zipfile.ZipFile:
    """Open a zip archive; raise InputFileError if it is damaged."""
    try:
        return zipfile.ZipFile(source)
    except zipfile.BadZipFile as error:
        raise InputFileError(path, f"the zip archive is damaged ({error}); download the archive again") from None


def zip_member(path: FilePath, archive: zipfile.ZipFile) -> str:
    """Return the name of the file to read in a zip archive: its only file, or its only KML or SHP file.

    Raise InputFileError if there is no such file, or the archive is a document (spreadsheet).
    """
    names = [
        item.filename
        for item in archive.infolist()
        if not item.is_dir() and "__MACOSX" not in item.filename and not Path(item.filename).name.startswith(".")
    ]
    maps = [name for name in names if name.lower().endswith((".kml", ".shp"))]
    if len(names) == 1 or len(maps) == 1:
        return maps[0] if maps else names[0]
    if {"[Content_Types].xml", "mimetype"} & {*names}:
        raise InputFileError(path, "is a spreadsheet or another document; save it as CSV, and give the CSV file")
    shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    raise InputFileError(path, f"is a zip archive of {len(names)} files ({shown}); unpack it, and give the files")


COMPRESS: Final = b"\x1f\x9d"  #: First bytes of a compress (.Z) file.
ZIP: Final = b"PK\x03\x04"  #: First bytes of a zip archive.
#: First bytes of compressed files that are read as streams, with the function that opens such a file.
STREAMS: Final[dict[bytes, Callable[[IO[bytes]], Any]]] = {
    b"\x1f\x8b": lambda source: gzip.GzipFile(fileobj=source, mode="rb"),
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
    b"(\xb5/\xfd": lambda source: _zstd().ZstdFile(source),
}

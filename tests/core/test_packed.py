"""Packed files are read as the plain one by every reader: gz, Z, bz2, xz, zip, zip of gz, KMZ."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import ncompress
import pytest

from railfix.core.errors import InputFileError
from railfix.core.files import ending, read_bytes, read_text, unpacked_file

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

pytestmark = pytest.mark.requirement("G5")

TEXT = b"a line of text\n" * 400


def zipped(content: bytes, name: str = "run.csv") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("__MACOSX/._run.csv", b"x")
        archive.writestr(name, content)
    return file.getvalue()


FORMS: dict[str, Callable[[bytes], bytes]] = {
    "run.csv": bytes,
    "run.csv.gz": gzip.compress,
    "run.csv.Z": ncompress.compress,
    "run.csv.bz2": bz2.compress,
    "run.csv.xz": lzma.compress,
    "run.csv.zst": zstd.compress,
    "run.zip": zipped,
    "packed.zip": lambda content: zipped(gzip.compress(content), "run.csv.gz"),
}


@pytest.mark.parametrize("name", FORMS)
def test_the_content_and_the_ending_are_those_of_the_plain_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(FORMS[name](TEXT))
    assert read_bytes(path) == TEXT
    assert ending(path) == ".csv"
    with unpacked_file(path) as file:
        content = file.read_bytes()
        assert (gzip.decompress(content) if name == "packed.zip" else content) == TEXT
    if name != "run.csv":
        path.write_bytes(path.read_bytes()[:-10])
        if not name.endswith(".Z"):  # which does not say how long it is
            with pytest.raises(InputFileError, match=r"damaged|end early|cannot be read"):
                read_bytes(path)


def test_an_archive_of_several_files_names_them(tmp_path: Path) -> None:
    path = tmp_path / "two.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.obs", TEXT)
        archive.writestr("b.obs", TEXT)
    with pytest.raises(InputFileError, match=r"zip archive of 2 files \(a.obs, b.obs\); unpack it"):
        read_bytes(path)


def test_a_packed_file_that_would_fill_the_memory_is_refused_early(tmp_path: Path) -> None:
    """A gzip that becomes 200 MB of equal lines, hundreds of times its size."""
    path = tmp_path / "map.csv.gz"
    with gzip.open(path, "wb") as file:
        for _ in range(200):
            file.write(b"1.5,2.5,3.5\n" * 84_000)
    assert path.stat().st_size < 640_000
    tracemalloc.start()
    with pytest.raises(InputFileError, match="unpacks to more than 64 MB"):
        read_text(path)
    assert tracemalloc.get_traced_memory()[1] < 160e6
    tracemalloc.stop()

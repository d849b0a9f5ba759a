"""Paths, and atomic writing of files."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from railfix.core.errors import OutputError, SettingsError

FilePath = str | os.PathLike[str]


def write_whole(path: FilePath, text: str, *, what: str = "file") -> None:
    """Write a text file under a temporary name, then rename it: a failed write leaves no file.

    `what` is the kind of file, for the OutputError raised where it cannot be written.
    """
    with stage_file(path, what=what) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def stage_file(path: FilePath, *, what: str = "file") -> Iterator[Path]:
    """Yield a temporary path in the folder of a file, which replaces the file if the block ends without error."""
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        try:
            yield temporary
            temporary.replace(target)
        finally:
            if temporary.parent.is_dir():
                temporary.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(target, error, what=f"the {what} ") from error


#: Errors of a full file system, and the remedy.
_FULL: Final = {
    errno.ENOSPC: "free some space on the disk, or give a folder on another disk",
    errno.EDQUOT: "free some of your quota, or give a folder elsewhere",
    errno.EFBIG: "give a folder on a file system for larger files",
}


def write_error(path: FilePath, error: OSError, *, what: str = "") -> OutputError:
    """Return the error of a file that cannot be written: the system's reason, and the remedy."""
    hint = _FULL.get(error.errno or 0, "give a folder that can be written to")
    return OutputError(f"{path}: {what}cannot be written ({error.strerror or error}); {hint}")


def check_path(path: object, *, what: str = "a path") -> None:
    """Raise SettingsError where a value is not a path; `what` names the expected item."""
    if not isinstance(path, str | os.PathLike):
        raise SettingsError(f"{what} was expected, got {type(path).__name__}")

"""Atomic writing of files, and checks of paths."""

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
    """Write a text file under a temporary name and rename it, so that a failed write leaves no partial file.

    Raise OutputError if the file cannot be written; `what` names the kind of file in the message.
    """
    with stage_file(path, what=what) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def stage_file(path: FilePath, *, what: str = "file") -> Iterator[Path]:
    """Yield the path of a temporary file in the same folder, which replaces `path` if the block ends without an error.

    Raise OutputError if a system error occurs in the block or while replacing the file.
    """
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


#: Remedy for each error number of a write that fails because of a size limit.
_FULL: Final = {
    errno.ENOSPC: "free some space on the disk, or give a folder on another disk",
    errno.EDQUOT: "free some of your quota, or give a folder elsewhere",
    errno.EFBIG: "give a folder on a file system that allows larger files",
}


def write_error(path: FilePath, error: OSError, *, what: str = "") -> OutputError:
    """Return the error for a file that cannot be written, with the system's reason and a remedy."""
    hint = _FULL.get(error.errno or 0, "give a folder that can be written to")
    return OutputError(f"{path}: {what}cannot be written ({error.strerror or error}); {hint}")


def check_path(path: object, *, what: str = "a path") -> None:
    """Raise SettingsError if a value is not a path; `what` names the expected item in the message."""
    if not isinstance(path, str | os.PathLike):
        raise SettingsError(f"{what} was expected, got {type(path).__name__}")

"""Hidden staging folders, held by a lock for as long as their process lives.

A process that is killed leaves its staging folder behind. The operating system releases the lock at the
same moment, so that the next run can tell a leftover from the folder of a run that is still writing.
"""

from __future__ import annotations

import os
import secrets
import shutil
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from railfix.core.errors import OutputError

_PREFIX: Final = ".railfix-"
_LOCK: Final = ".lock"
#: Name of the folder of complete files inside a staging folder; it appears by one rename.
READY: Final = "ready"


@dataclass(frozen=True, kw_only=True)
class Staging:
    """A hidden folder inside a results folder, and the open, locked file that holds it, with the number of the
    process.
    """

    path: Path
    lock: IO[str]

    def remove(self) -> None:
        """Remove the folder, then the lock."""
        shutil.rmtree(self.path, ignore_errors=True)
        name = Path(self.lock.name)
        if sys.platform == "win32":
            self.lock.close()
        name.unlink(missing_ok=True)
        self.lock.close()


def make_staging(folder: Path) -> Staging:
    """Return a new staging folder inside a folder, locked by this process; OSError where that cannot be written."""
    while True:
        name = folder / f"{_PREFIX}{secrets.token_hex(4)}"
        path, staging = name.with_name(name.name + _LOCK), None
        try:
            lock = path.open("x", encoding="ascii")
            staging = Staging(path=name, lock=lock)
            lock.write(f"{os.getpid()}\n")
            lock.flush()
            # Another process may have taken the new file for a leftover before it was locked.
            if _try_lock(lock) and Path(lock.name).exists():
                name.mkdir()
                return staging
        except BaseException as error:  # a signal that ends the program among them, also while the file is opened
            if staging is not None:
                staging.remove()
            elif not isinstance(error, FileExistsError):
                path.unlink(missing_ok=True)
            raise
        lock.close()


def clean_up(folder: Path) -> None:
    """Remove what killed processes left in a folder; finish what they had only to move in place.

    OutputError: a living process is writing to the folder.
    """
    for path in [p for p in folder.iterdir() if p.name.startswith(_PREFIX)]:
        if path.name.endswith(_LOCK):
            _release(path)
        elif not path.with_name(path.name + _LOCK).exists():
            shutil.rmtree(path, ignore_errors=True)


def _release(lock: Path) -> None:
    """Remove the lock of a dead process with its staging folder."""
    try:
        file = lock.open("r+", encoding="ascii", errors="replace")
    except FileNotFoundError:
        return
    with file:
        if not _try_lock(file):
            process = file.read().strip() or "unknown"
            raise OutputError(
                f"{lock.parent}: another railfix (process {process}) is writing there; wait for it, or name another "
                "folder"
            )
        staging = lock.with_name(lock.name.removesuffix(_LOCK))
        if (staging / READY).is_dir():
            move_in_place(staging / READY, lock.parent)
        shutil.rmtree(staging, ignore_errors=True)
        if sys.platform == "win32":
            file.close()
        lock.unlink(missing_ok=True)


def move_in_place(ready: Path, folder: Path) -> dict[str, Path]:
    """Move all files of a folder into another one, records (JSON) last, and return where each stands.

    A record that is replaced is removed first, so that it never stands beside the tables of another run.
    """
    files = sorted(ready.iterdir(), key=lambda path: (path.suffix == ".json", path.name))
    for source in files:
        if source.suffix == ".json":
            (folder / source.name).unlink(missing_ok=True)
    moved = {source.name: source.replace(folder / source.name) for source in files}
    return {name: moved[name] for name in sorted(moved)}


def _try_lock(file: IO[str]) -> bool:
    """Lock a file for this process; False where another one holds it."""
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

"""Disk cache of prepared lines: tracks that were read from files, and antenna trajectories.

Reading a line of 2000 km and computing the trajectories of two antennas takes seconds. The result depends only on the
files, the settings and the version of railfix. Long lines are therefore stored in a cache folder, which may be deleted
at any time. It is the platform's cache folder (``~/.cache/railfix`` on Linux), or the folder that the environment
variable `VARIABLE` specifies.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import railfix.track
from railfix import __version__
from railfix.core.arrays import read_only
from railfix.core.errors import OutputError
from railfix.core.staged_files import stage_file
from railfix.track import Track
from railfix.track.track import Provenance
from railfix.track.trajectory import Trajectory

#: Environment variable with the path of the cache folder.
VARIABLE: Final = "RAILFIX_CACHE_DIR"
#: Lines with fewer points are not cached. 5000 points with two antennas take 0.11 s to prepare and 0.01 s to load.
LEAST_POINTS: Final = 2_000
#: Maximum number of cache entries; if there are more, the oldest entries are deleted.
MOST_ENTRIES: Final = 48
#: Trajectory attributes that are computed from the points, and cached with them.
_DERIVED: Final = ("up", "across")
#: Exceptions that the reading of a damaged cache file may raise.
_DAMAGE: Final = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)


def cache_folder() -> Path:
    """Return the path of the cache folder, which may not exist yet."""
    import platformdirs

    return Path(os.environ.get(VARIABLE) or platformdirs.user_cache_path("railfix", appauthor=False))


class PreparedLines:
    """Reader and writer of the cache. `notes` collects messages on damaged files and unwritable files.

    With ``use=False``, nothing is read or written.
    """

    def __init__(self, *, use: bool = True) -> None:
        self.notes: list[str] = []
        self._folder = cache_folder() if use else None

    def track(self, key: str) -> Track | None:
        """Return the track cached under a key (`compute_key`), or None if it is not in the cache."""
        found = self._load(key)
        if found is None:
            return None
        plain, arrays = found
        provenance: dict[str, Any] = plain.pop("provenance")
        provenance |= {name: tuple(provenance[name]) for name in ("files", "notes")}
        values: dict[str, Any] = {**plain, **arrays, "sections": tuple(plain["sections"])}
        return Track(**values, provenance=Provenance(**provenance))

    def keep_track(self, key: str, track: Track) -> None:
        """Write a track to the cache if it has at least `LEAST_POINTS` points."""
        if len(track) >= LEAST_POINTS:
            plain, arrays = _parts(track)
            self._keep(key, {**plain, "provenance": asdict(track.provenance)}, arrays)

    def path(self, key: str) -> Trajectory | None:
        """Return the trajectory cached under a key (`compute_key`), or None if it is not in the cache."""
        found = self._load(key)
        if found is None:
            return None
        plain, arrays = found
        derived = {name: arrays.pop(name) for name in _DERIVED}
        values: dict[str, Any] = {**plain, **arrays, "notes": tuple(plain["notes"])}
        trajectory = Trajectory(**values)
        vars(trajectory).update({name: read_only(array) for name, array in derived.items()})
        return trajectory

    def keep_path(self, key: str, path: Trajectory) -> None:
        """Write a trajectory to the cache if it has at least `LEAST_POINTS` points."""
        if len(path) >= LEAST_POINTS:
            plain, arrays = _parts(path)
            self._keep(key, plain, arrays | {name: getattr(path, name) for name in _DERIVED})

    def _load(self, key: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]] | None:
        if self._folder is None:
            return None
        file = self._folder / f"{key}.npz"
        try:
            with file.open("rb") as handle, np.load(handle, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            plain: dict[str, Any] = json.loads(arrays.pop("plain").tobytes())
        except FileNotFoundError:
            return None
        except _DAMAGE as error:
            self.notes.append(
                f"{file}: the file is damaged; the line was prepared again ({type(error).__name__}: {error})"
            )
            return None
        return plain, arrays

    def _keep(self, key: str, plain: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        if self._folder is None:
            return
        file = self._folder / f"{key}.npz"
        text = np.frombuffer(json.dumps(plain).encode(), dtype=np.uint8)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with stage_file(file, what="prepared line") as temporary, temporary.open("wb") as handle:
                np.savez(handle, plain=text, **arrays)  # type: ignore[arg-type]  # its stub has allow_pickle
            entries = sorted(self._folder.glob("*.npz"), key=lambda entry: entry.stat().st_mtime)
            for old in entries[:-MOST_ENTRIES]:
                old.unlink(missing_ok=True)
        except (OSError, OutputError) as error:
            reason = error.strerror or str(error) if isinstance(error, OSError) else str(error)
            self.notes.append(f"{self._folder}: the prepared line could not be stored ({reason}); set {VARIABLE}")


def compute_key(kind: str, *parts: object) -> str:
    """Return the cache key of an object that is computed from `parts`: paths of files, arrays, and other values.

    The key depends on the content of files and arrays, on the text of other values, and on the version of railfix.
    """
    digest = hashlib.sha256(f"{kind} {__version__} {_code()}".encode())
    for part in parts:
        if isinstance(part, Path):
            with suppress(OSError), part.open("rb") as file:  # a missing file is reported where it is read
                digest.update(hashlib.file_digest(file, "sha256").digest())
        elif isinstance(part, np.ndarray):
            digest.update(hashlib.sha256(np.ascontiguousarray(part).tobytes()).digest())
        digest.update(f"{part if not isinstance(part, np.ndarray) else part.shape}\0".encode())
    return digest.hexdigest()


@cache
def _code() -> list[tuple[str, int, int]]:
    """Return name, size and modification time of each source file on which cached lines depend."""
    files = sorted(Path(railfix.track.__file__).parent.glob("*.py"))
    return [(file.name, (state := file.stat()).st_size, state.st_mtime_ns) for file in files]


def track_key(track: Track) -> str:
    """Return the cache key of a track from its content in memory."""
    plain, arrays = _parts(track)
    return compute_key("track", json.dumps(plain), *arrays.values(), repr(track.provenance))


def _parts(value: Track | Trajectory) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return an object's fields that are not arrays, and its arrays. The provenance is omitted."""
    values = {item.name: getattr(value, item.name) for item in fields(value) if item.name != "provenance"}
    arrays = {name: array for name, array in values.items() if isinstance(array, np.ndarray)}
    return {name: v for name, v in values.items() if name not in arrays}, arrays

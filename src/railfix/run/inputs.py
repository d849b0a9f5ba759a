"""What a run reads: named, checked and hashed."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from railfix.core.errors import InputFileError
from railfix.core.files import fingerprint
from railfix.pipeline.config import Config

Antenna = Literal["front", "rear"]


@dataclass(frozen=True, kw_only=True)
class RunInputs:
    """The files of a run.

    Attributes
    ----------
    front, rear : tuple of Path
        RINEX observation files of each antenna, in order of time; `rear` may be empty.
    nav, sp3 : tuple of Path
        Navigation files; precise orbits, which may be empty.
    track : tuple of Path
        Track map, joined to a route in this order.
    vehicle, config, truth : Path or None
        The truth is asked for by `ablate` alone.
    cn0_curve, error_model : Path or None
    sbas : tuple of Path
        Named by the settings (`with_settings`).
    """

    front: tuple[Path, ...]
    nav: tuple[Path, ...]
    track: tuple[Path, ...]
    rear: tuple[Path, ...] = ()
    sp3: tuple[Path, ...] = ()
    vehicle: Path | None = None
    config: Path | None = None
    cn0_curve: Path | None = None
    error_model: Path | None = None
    sbas: tuple[Path, ...] = ()
    truth: Path | None = None

    def with_settings(self, config: Config) -> RunInputs:
        """The same with the files that settings name."""
        return replace(self, cn0_curve=config.cn0_curve, error_model=config.error_model, sbas=config.sbas)

    def named(self) -> Iterator[tuple[str, Path]]:
        """Each file with the name of what it is."""
        for item in fields(self):
            value = getattr(self, item.name)
            for path in value if isinstance(value, tuple) else (value,):
                if path is not None:
                    yield item.name, path

    @property
    def logs(self) -> dict[Antenna, tuple[Path, ...]]:
        """Observation files by antenna."""
        both: dict[Antenna, tuple[Path, ...]] = {"front": self.front, "rear": self.rear}
        return {name: paths for name, paths in both.items() if paths}

    def check(self) -> None:
        """Look at every file before the work begins.

        Raises
        ------
        InputFileError
            A file is missing, a folder, or cannot be opened; or the same log is given twice.
        """
        for name, path in self.named():
            _check_file(name, path)
        seen: dict[Path, tuple[str, Path]] = {}
        for name, paths in self.logs.items():
            for path in paths:
                whole = path.resolve()
                if whole in seen:
                    option, first = seen[whole]
                    raise InputFileError(
                        path, f"is given twice (--{option} {first} and --{name} {path}); give each log once"
                    )
                seen[whole] = (name, path)

    def fingerprints(self, pool: Executor) -> list[Future[dict[str, Any]]]:
        """Name, path, size and SHA-256 of every file, computed while the run goes on."""
        return [pool.submit(fingerprint, name, path) for name, path in self.named()]


def _check_file(name: str, path: Path) -> None:
    try:
        if path.is_dir():
            raise InputFileError(path, f"is a folder, --{name} expects a file; name the file in it")
        if not path.is_file():
            what = "is no regular file" if path.exists() else "there is no such file"
            raise InputFileError(path, f"{what}; check what --{name} names")
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise InputFileError(path, f"cannot be read ({error.strerror}); check what --{name} names") from error

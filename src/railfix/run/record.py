"""Record of a run (``run.json``): inputs, settings given and used, results; written, and read back."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import polars as pl
import polars.selectors as cs
from polars.exceptions import PanicException, PolarsError

from railfix import __version__
from railfix.core.commit import source_commit
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import file_sha256, read_json_object
from railfix.core.reasons import Status
from railfix.core.settings import Model, validated
from railfix.gnss.navigation import Navigation
from railfix.kernels import numba_version
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.level_stage import level_facts
from railfix.run.inputs import RunInputs, RunOptions, input_path
from railfix.run.output import OutputFolder
from railfix.run.tally import AntennaTally, Tally
from railfix.tracking import TrackStatus

#: Packages whose version may matter to a result.
PACKAGES: Final = ("numpy", "scipy", "polars", "pyproj", "pydantic", "hatanaka", "georinex", "japan-geoid")


#: Figures of an antenna without rows.
NO_FIGURES: Final = {"along_sigma_m": None, "protection_level": None, "filter": None}


def figures_of(folder: OutputFolder, tally: Tally, config: Config) -> dict[str, dict[str, Any]]:
    """Return percentiles of each antenna from the rows written [m]; None in place of what the run has not.

    Of sigma along the line; of protection levels, the finite ones, with epochs by status; of the filter, with epochs by
    status, and its levels with the number of finite ones.
    """
    return {
        name: {
            "along_sigma_m": _along_sigma(_rows(folder, "positions", name)),
            "protection_level": _level(_rows(folder, "positions", name), antenna) if antenna.level_status else None,
            "filter": _filter_figures(_rows(folder, "train", name))
            if config.filter == "track" and antenna.epochs
            else None,
        }
        for name, antenna in tally.antennas.items()
    }


def _along_sigma(rows: pl.LazyFrame) -> dict[str, float] | None:
    sigma = pl.col("along_sigma_m")
    found = _one_by_one(rows, {"p50_m": sigma.quantile(0.5), "p95_m": sigma.quantile(0.95), "max_m": sigma.max()})
    return None if found["max_m"] is None else found


def _level(rows: pl.LazyFrame, antenna: AntennaTally) -> dict[str, Any]:
    finite = pl.col("protection_level_m").filter(pl.col("protection_level_m").is_finite())
    return {
        **_one_by_one(rows, {"p50_m": finite.quantile(0.5), "p95_m": finite.quantile(0.95)}),
        **{word: antenna.level_status[word] for word in ("available", "unavailable", "alarm")},
        "without_budget": antenna.without_budget,
    }


def _filter_figures(rows: pl.LazyFrame) -> dict[str, Any]:
    status, level = pl.col("status"), pl.col("protection_level_m")
    finite = level.filter(level.is_finite())
    words = {word.text: (status == word.text).sum() for word in TrackStatus}
    counts = rows.select(**words, levels=level.count()).collect().row(0, named=True)
    figures = {"p50_m": finite.quantile(0.5), "p95_m": finite.quantile(0.95), "finite": finite.len()}
    bound = _one_by_one(rows, figures) if counts.pop("levels") else None
    return {"status": counts, "along_sigma_m": _along_sigma(rows), "level": bound}


def _rows(folder: OutputFolder, table: str, antenna: str) -> pl.LazyFrame:
    return folder.scan(f"{table}.parquet").filter(pl.col("antenna") == antenna)


def _one_by_one(rows: pl.LazyFrame, figures: Mapping[str, pl.Expr]) -> dict[str, Any]:
    """Return figures of many rows; each reads its column anew, so that one copy of one column is in memory."""
    return {name: rows.select(figure).collect().item() for name, figure in figures.items()}


@dataclass(frozen=True, kw_only=True)
class RunProvenance:
    """What a run was made from."""

    files: Sequence[Mapping[str, Any]]  #: Inputs with size and hash.
    packages: Mapping[str, str]  #: `package_versions`.
    asked: Mapping[str, Any]  #: Settings as given.
    config: Config  #: Settings that were in force.
    options: RunOptions  #: Choices that are no settings of the positions.
    line: Mapping[str, Any]  #: Facts of the track map, the vehicle and the trajectories.
    navigation: Navigation


def run_record(
    made_from: RunProvenance,
    tally: Tally,
    notes: Sequence[str],
    figures: Mapping[str, Mapping[str, Any]],
    wall_s: float,
) -> dict[str, Any]:
    """Return the content of ``run.json`` as plain values; `figures` are those of `figures_of`."""
    navigation, config = made_from.navigation, made_from.config
    observed = sum(antenna.observed for antenna in tally.antennas.values())
    ok = sum(antenna.status[Status.OK.text] for antenna in tally.antennas.values())
    return {
        "versions": {
            "railfix": __version__,
            "commit": source_commit(),
            "python": platform.python_version(),
            **made_from.packages,
        },
        "platform": platform.platform(),
        "kernels": numba_version(),
        "command": sys.argv,
        "inputs": list(made_from.files),
        "settings_asked": dict(made_from.asked),
        "settings_used": config.as_dict(),
        "options": made_from.options.model_dump(mode="json"),
        "line": dict(made_from.line),
        "navigation": {
            "records": len(navigation.kepler) + len(navigation.glonass),
            "skipped": dict(navigation.skipped),
            "klobuchar_from": sorted(navigation.klobuchar),
            "precise": "" if navigation.precise is None else navigation.precise.source,
        },
        "protection": level_facts(config),
        "notes": list(notes),
        "positioning_rate": tally.positioned / observed if observed else None,
        "ok_rate": ok / observed if observed else None,
        "antennas": {name: {**antenna.as_dict(), **figures[name]} for name, antenna in tally.antennas.items()},
        "wall_s": round(wall_s, 3),
        "chunks": {
            "first_epoch_gpst": [str(first) for first, _, _ in tally.chunks],
            "epochs": [epochs for _, epochs, _ in tally.chunks],
            "positioning_s": [round(spent, 6) for _, _, spent in tally.chunks],
        },
    }


def package_versions() -> dict[str, str]:
    """Return the versions of `PACKAGES`, "absent" for those that are not installed."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "absent"
    return versions


#: Settings, by group and name, that were removed because nothing used them: records of earlier runs have them.
WITHOUT_EFFECT: Final = (("section", "predicted_sigmas"),)


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """Record of a run: ``run.json`` in the folder that `run_files` wrote."""

    path: Path  #: The folder.
    record: Mapping[str, Any]  #: ``run.json``.

    def part(self, name: str) -> dict[str, Any]:
        """Return a table of the record; InputFileError: it is missing or not a table."""
        table = self.record.get(name)
        if not isinstance(table, dict):
            raise InputFileError(self.path / "run.json", f"has no table {name}; repeat the run with this version")
        return table

    @cached_property
    def config(self) -> Config:
        """Settings that were used, with the files they name where these are now.

        Settings that earlier versions recorded and that never changed a result are left out. InputFileError: the record
        lacks them, or they are not settings of this version.
        """
        used = dict(self.part("settings_used"))
        for group, name in WITHOUT_EFFECT:
            if isinstance(used.get(group), dict):
                used[group] = {key: value for key, value in used[group].items() if key != name}
        config = self._this_version(lambda: parse_config(used, source="settings_used"))
        files = {name: self.input_paths(name) for name in ("cn0_curve", "error_model", "integrity_support", "sbas")}
        changes = {name: tuple(paths) if name == "sbas" else paths[0] for name, paths in files.items() if paths}
        return config.replaced(**changes) if changes else config

    @cached_property
    def inputs(self) -> RunInputs:
        """Input files, where they are now."""
        kinds = dict.fromkeys(str(entry["input"]) for entry in self.entries)
        several = {name for name, field in RunInputs.model_fields.items() if field.annotation == tuple[Path, ...]}
        values = {
            name: tuple(self.input_paths(name)) if name in several else self.input_paths(name)[0] for name in kinds
        }
        return self._this_version(lambda: validated(RunInputs, values, source="inputs"))

    @cached_property
    def options(self) -> RunOptions:
        """Options that were used."""
        return self._this_version(lambda: validated(RunOptions, self.part("options"), source="options"))

    def _this_version(self, read: Callable[[], Model]) -> Model:
        try:
            return read()
        except SettingsError as error:
            path = self.path / "run.json"
            raise InputFileError(path, f"does not fit this version ({error}); repeat the run with it") from None

    def check_inputs(self) -> None:
        """Raise InputFileError where an input file is missing, MismatchError where one has changed since the run."""
        self.inputs.check()
        for entry in self.entries:
            path = input_path(entry, self.path)
            if file_sha256(path) != entry["sha256"]:
                raise MismatchError(
                    f"{path}: has changed since the run in {self.path} read it as --{entry['input']}; repeat the run"
                )

    def input_paths(self, kind: str) -> list[Path]:
        """Return where the files of one kind of input are now, in order; see `railfix.run.inputs.input_path`."""
        return [input_path(entry, self.path) for entry in self.entries if entry["input"] == kind]

    @property
    def entries(self) -> list[Mapping[str, Any]]:
        """Input files with kind, path and SHA-256; InputFileError: the record has no such list."""
        entries = self.record.get("inputs", [])
        complete = isinstance(entries, list) and all(
            isinstance(entry, dict) and {"input", "path", "sha256"} <= set(entry) for entry in entries
        )
        if not complete:
            raise InputFileError(
                self.path / "run.json", "has inputs that are no list of input, path and sha256; repeat the run"
            )
        return list(entries)


def read_record(folder: Path) -> RunRecord:
    """Read the record of a run from its folder; InputFileError: there is none, or it is not one."""
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "there is no such folder"
        raise InputFileError(folder, f"{problem}, expected the folder that railfix run wrote; name that")
    path = folder / "run.json"
    if not path.is_file():
        raise InputFileError(path, "there is no such file; railfix run writes it beside the positions")
    return RunRecord(path=folder, record=read_json_object(path, what="the record of a run"))


def read_parquet(path: Path, *, columns: cs.Selector | None = None) -> pl.DataFrame:
    """Read a table that a run wrote: all columns, or those selected; InputFileError where it is not Parquet."""
    with reading_table(path):
        if columns is None:
            return pl.read_parquet(path)
        return pl.scan_parquet(path).select(columns).collect()


@contextmanager
def reading_table(path: Path) -> Iterator[None]:
    """Raise errors of reading a table, also of a lazy one, as `InputFileError`."""
    try:
        yield
    except (PolarsError, PanicException, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputFileError(path, f"cannot be read as a table ({reason}); run railfix run again") from None

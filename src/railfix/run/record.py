"""Record of a run (``run.json``): inputs, settings given and used, results; written, and read back."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
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
from railfix.run.inputs import RunInputs, RunOptions, located
from railfix.run.output import OutputFolder
from railfix.run.tally import Tally
from railfix.tracking import TrackStatus

#: Packages whose version may matter to a result.
PACKAGES: Final = ("numpy", "scipy", "polars", "pyproj", "pydantic", "hatanaka", "georinex", "japan-geoid")


@dataclass(frozen=True, kw_only=True)
class AlongSigma:
    """Percentiles of the along-track standard deviation of the positions [m]."""

    p50_m: float
    p95_m: float
    max_m: float


@dataclass(frozen=True, kw_only=True)
class FilterLevel:
    """Level of the filter of one antenna: median and 95th percentile of the finite ones [m], and how many these are."""

    p50_m: float | None
    p95_m: float | None
    finite: int


@dataclass(frozen=True, kw_only=True)
class Filtered:
    """Positions of the filter along the track of one antenna: epochs by status, percentiles of sigma and level [m].

    The level: median, 95th percentile and number of the finite ones; None where `tracking.level` is off.
    """

    status: dict[str, int]
    along_sigma_m: AlongSigma | None
    level: FilterLevel | None


@dataclass(frozen=True, kw_only=True)
class Levels:
    """Protection levels of an antenna: median and 95th percentile of the finite ones [m], and epochs by status.

    `without_budget`: epochs without a level because more faults than can be left out are likelier than the risk allows.
    """

    p50_m: float | None
    p95_m: float | None
    available: int
    unavailable: int
    alarm: int
    without_budget: int


def levels(folder: OutputFolder, tally: Tally) -> dict[str, Levels]:
    """Protection levels by antenna, from the rows written; empty where they are off."""
    level = pl.col("protection_level_m")
    finite = level.filter(level.is_finite())
    figures = {"p50_m": finite.quantile(0.5), "p95_m": finite.quantile(0.95)}
    return {
        name: Levels(
            **_one_by_one(_rows(folder, "positions", name), figures),
            **{word: antenna.level_status[word] for word in ("available", "unavailable", "alarm")},
            without_budget=antenna.without_budget,
        )
        for name, antenna in tally.antennas.items()
        if antenna.level_status
    }


def along_sigma(folder: OutputFolder, tally: Tally, table: str = "positions") -> dict[str, AlongSigma]:
    """Percentiles by antenna, from the rows written; an antenna without any is left out."""
    sigma = pl.col("along_sigma_m")
    figures = {"p50_m": sigma.quantile(0.5), "p95_m": sigma.quantile(0.95), "max_m": sigma.max()}
    found = {name: _one_by_one(_rows(folder, table, name), figures) for name in tally.antennas}
    return {name: AlongSigma(**row) for name, row in found.items() if row["max_m"] is not None}


def filtered(folder: OutputFolder, tally: Tally) -> dict[str, Filtered]:
    """Epochs of the filter by status and percentiles of its sigma, by antenna, from the rows written."""
    status, level = pl.col("status"), pl.col("protection_level_m")
    finite = level.filter(level.is_finite())
    words = {word.text: (status == word.text).sum() for word in TrackStatus}
    figures = {"p50_m": finite.quantile(0.5), "p95_m": finite.quantile(0.95), "finite": finite.len()}
    along = along_sigma(folder, tally, "train")
    found = {}
    for name in (name for name, antenna in tally.antennas.items() if antenna.epochs):
        rows = _rows(folder, "train", name)
        counts = rows.select(**words, levels=level.count()).collect().row(0, named=True)
        bound = FilterLevel(**_one_by_one(rows, figures)) if counts.pop("levels") else None
        found[name] = Filtered(status=counts, along_sigma_m=along.get(name), level=bound)
    return found


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


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Percentiles of a run by antenna; empty where there are none."""

    sigma: Mapping[str, AlongSigma] = field(default_factory=dict)
    levels: Mapping[str, Levels] = field(default_factory=dict)
    tracks: Mapping[str, Filtered] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: OutputFolder, tally: Tally, config: Config) -> Figures:
        """Figures of the rows written."""
        tracks = filtered(folder, tally) if config.filter == "track" else {}
        return cls(sigma=along_sigma(folder, tally), levels=levels(folder, tally), tracks=tracks)


def run_record(
    made_from: RunProvenance, tally: Tally, notes: Sequence[str], *, wall_s: float, figures: Figures | None = None
) -> dict[str, Any]:
    """Return the content of ``run.json`` as plain values."""
    figures = figures or Figures()
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
        "antennas": {
            name: {
                **antenna.as_dict(),
                "along_sigma_m": asdict(figures.sigma[name]) if name in figures.sigma else None,
                "protection_level": asdict(figures.levels[name]) if name in figures.levels else None,
                "filter": asdict(figures.tracks[name]) if name in figures.tracks else None,
            }
            for name, antenna in tally.antennas.items()
        },
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
        files = {name: self.located(name) for name in ("cn0_curve", "error_model", "integrity_support", "sbas")}
        changes = {name: tuple(paths) if name == "sbas" else paths[0] for name, paths in files.items() if paths}
        return config.replaced(**changes) if changes else config

    @cached_property
    def inputs(self) -> RunInputs:
        """Input files, where they are now."""
        kinds = dict.fromkeys(str(entry["input"]) for entry in self.entries)
        several = {name for name, field in RunInputs.model_fields.items() if field.annotation == tuple[Path, ...]}
        values = {name: tuple(self.located(name)) if name in several else self.located(name)[0] for name in kinds}
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
            path = located(entry, self.path)
            if file_sha256(path) != entry["sha256"]:
                raise MismatchError(
                    f"{path}: has changed since the run in {self.path} read it as --{entry['input']}; repeat the run"
                )

    def located(self, kind: str) -> list[Path]:
        """Return where the files of one kind of input are now, in order; see `railfix.run.inputs.located`."""
        return [located(entry, self.path) for entry in self.entries if entry["input"] == kind]

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

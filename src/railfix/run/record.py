"""Record of a run (``run.json``) with inputs, settings and results, and tables that summarise a record."""

from __future__ import annotations

import platform
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import polars as pl
import polars.selectors as cs

from railfix import __version__
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import file_sha256, read_json_object, source_commit
from railfix.core.reasons import Status
from railfix.core.settings import Model, validate
from railfix.core.tables import Table, count, number, reading_table, share
from railfix.gnss.navigation import Navigation
from railfix.kernels import numba_version
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.level_stage import level_facts
from railfix.run.inputs import RunInputs, RunOptions, input_path
from railfix.run.output import OutputFolder
from railfix.run.tally import AntennaTally, Tally
from railfix.tracking import TrackStatus

#: Packages whose versions may affect results.
PACKAGES: Final = ("numpy", "scipy", "polars", "pyproj", "pydantic", "hatanaka", "georinex", "japan-geoid")


#: For each of these values [m], the record states how many protection levels of the filter do not exceed it.
WITHIN_M: Final = (20, 50)
#: Statistics of an antenna without rows in the tables.
NO_FIGURES: Final = {"along_sigma_m": None, "chainage_m": None, "protection_level": None, "filter": None}


def compute_figures(folder: OutputFolder, tally: Tally, config: Config) -> dict[str, dict[str, Any]]:
    """Return statistics of each antenna, computed from the written tables. Lengths are in metres.

    The statistics are of the sigma along the line, the chainage, the finite protection levels (with epochs by status),
    and the filter (with epochs by status, and levels within each limit of `WITHIN_M`). Absent statistics are None.
    """
    return {
        name: {
            "along_sigma_m": _along_sigma(_rows(folder, "positions", name)),
            "chainage_m": _chainage(_rows(folder, "positions", name)),
            "protection_level": _level(_rows(folder, "positions", name), antenna) if antenna.level_status else None,
            "filter": _filter_figures(_rows(folder, "train", name))
            if config.filter == "track" and antenna.epochs
            else None,
        }
        for name, antenna in tally.antennas.items()
    }


def _along_sigma(rows: pl.LazyFrame) -> dict[str, float] | None:
    sigma = pl.col("along_sigma_m")
    found = _figures(rows, {"p50_m": sigma.quantile(0.5), "p95_m": sigma.quantile(0.95), "max_m": sigma.max()})
    return None if found["max_m"] is None else found


def _chainage(rows: pl.LazyFrame) -> dict[str, Any]:
    chainage = pl.col("chainage_m")
    return _figures(rows, {"positions": chainage.count(), "first": chainage.min(), "last": chainage.max()})


def _level(rows: pl.LazyFrame, antenna: AntennaTally) -> dict[str, Any]:
    finite = pl.col("protection_level_m").filter(pl.col("protection_level_m").is_finite())
    return {
        **_figures(rows, {"p50_m": finite.quantile(0.5), "p95_m": finite.quantile(0.95)}),
        **{word: antenna.level_status[word] for word in ("available", "unavailable", "alarm")},
        "without_budget": antenna.without_budget,
    }


def _filter_figures(rows: pl.LazyFrame) -> dict[str, Any]:
    status, level = pl.col("status"), pl.col("protection_level_m")
    finite = level.filter(level.is_finite())
    words = {word.text: (status == word.text).sum() for word in TrackStatus}
    counts = rows.select(**words, levels=level.count()).collect().row(0, named=True)
    figures = {"p50_m": finite.quantile(0.5), "p95_m": finite.quantile(0.95)}
    figures |= {f"within_{limit}_m": (finite <= limit).sum() for limit in WITHIN_M}
    bound = _figures(rows, figures) if counts.pop("levels") else None
    return {
        "status": counts,
        "along_sigma_m": _along_sigma(rows),
        "chainage_m": _chainage(rows),
        "level": bound,
    }


def _rows(folder: OutputFolder, table: str, antenna: str) -> pl.LazyFrame:
    return folder.scan(f"{table}.parquet").filter(pl.col("antenna") == antenna)


def _figures(rows: pl.LazyFrame, figures: Mapping[str, pl.Expr]) -> dict[str, Any]:
    """Return the values of aggregating expressions over all rows, by name."""
    return rows.select(**figures).collect().row(0, named=True)


@dataclass(frozen=True, kw_only=True)
class RunProvenance:
    """Input files, settings and software versions of a run for the record."""

    files: Sequence[Mapping[str, Any]]  #: Input files with size and hash (`fingerprint`).
    packages: Mapping[str, str]  #: Result of `package_versions`.
    asked: Mapping[str, Any]  #: Settings that the user specified.
    config: Config  #: All settings that were used.
    options: RunOptions  #: Options of the run.
    line: Mapping[str, Any]  #: Properties of the track map, the vehicle and the trajectories.
    navigation: Navigation


def run_record(
    made_from: RunProvenance,
    tally: Tally,
    notes: Sequence[str],
    figures: Mapping[str, Mapping[str, Any]],
    wall_s: float,
) -> dict[str, Any]:
    """Return the content of ``run.json`` as plain values. `figures` is the result of `compute_figures`."""
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
    """Return the version of each package in `PACKAGES`, or "absent" if it is not installed."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "absent"
    return versions


#: Group and name of each setting that never affected a result; records of earlier versions have these settings.
WITHOUT_EFFECT: Final = (("section", "predicted_sigmas"),)


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """Record of a run, read from the file ``run.json`` in a results folder."""

    path: Path  #: Results folder.
    record: Mapping[str, Any]  #: Content of ``run.json``.

    def part(self, name: str) -> dict[str, Any]:
        """Return a table of the record. Raise InputFileError if the entry is missing or is no table."""
        table = self.record.get(name)
        if not isinstance(table, dict):
            raise InputFileError(self.path / "run.json", f"has no table {name}; repeat the run with this version")
        return table

    @cached_property
    def config(self) -> Config:
        """Settings that were used, except `WITHOUT_EFFECT`, with the present paths of the files that they name.

        Raise InputFileError if the record has no settings, or if they are not settings of this version.
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
        """Input files with their present paths. Raise InputFileError if the inputs do not fit this version."""
        kinds = dict.fromkeys(str(entry["input"]) for entry in self.entries)
        several = {name for name, field in RunInputs.model_fields.items() if field.annotation == tuple[Path, ...]}
        values = {
            name: tuple(self.input_paths(name)) if name in several else self.input_paths(name)[0] for name in kinds
        }
        return self._this_version(lambda: validate(RunInputs, values, source="inputs"))

    @cached_property
    def options(self) -> RunOptions:
        """Options that were used. Raise InputFileError if the options do not fit this version."""
        return self._this_version(lambda: validate(RunOptions, self.part("options"), source="options"))

    def _this_version(self, read: Callable[[], Model]) -> Model:
        try:
            return read()
        except SettingsError as error:
            path = self.path / "run.json"
            raise InputFileError(
                path, f"does not fit this version ({error}); repeat the run with this version"
            ) from None

    def check_inputs(self) -> None:
        """Raise InputFileError if an input file is missing, and MismatchError if an input has changed since the run."""
        self.inputs.check()
        for entry in self.entries:
            path = input_path(entry, self.path)
            if file_sha256(path) != entry["sha256"]:
                raise MismatchError(
                    f"{path}: has changed since the run in {self.path} read it as --{entry['input']}; repeat the run"
                )

    def input_paths(self, kind: str) -> list[Path]:
        """Return the present paths (`input_path`) of the inputs of one kind, such as "front", in the recorded order."""
        return [input_path(entry, self.path) for entry in self.entries if entry["input"] == kind]

    @property
    def entries(self) -> list[Mapping[str, Any]]:
        """Recorded input files with kind, path and SHA-256. Raise InputFileError if the record has no such list."""
        entries = self.record.get("inputs", [])
        complete = isinstance(entries, list) and all(
            isinstance(entry, dict) and {"input", "path", "sha256"} <= set(entry) for entry in entries
        )
        if not complete:
            raise InputFileError(
                self.path / "run.json", "inputs must be a list of entries with input, path and sha256; repeat the run"
            )
        return list(entries)


def read_record(folder: Path) -> RunRecord:
    """Read the record in a results folder. Raise InputFileError if ``run.json`` is missing or malformed."""
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "there is no such folder"
        raise InputFileError(folder, f"{problem}, expected the folder that railfix run wrote; give that folder")
    path = folder / "run.json"
    if not path.is_file():
        raise InputFileError(path, "there is no such file; railfix run writes it with the positions")
    return RunRecord(path=folder, record=read_json_object(path, what="the record of a run"))


def read_parquet(path: Path, *, columns: cs.Selector | None = None) -> pl.DataFrame:
    """Read a table that a run wrote: the columns `columns`, or all columns if None.

    Raise InputFileError if the file is not a Parquet file.
    """
    with reading_table(path):
        if columns is None:
            return pl.read_parquet(path)
        return pl.scan_parquet(path).select(columns).collect()


Facts = Mapping[str, Any]
#: For each label in the tables, the record key of the statistic of the standard deviation.
_OF_SIGMA: Final = {"p50": "p50_m", "p95": "p95_m", "largest": "max_m"}
#: For each label in the tables, the record key of the statistic of the protection level.
_OF_LEVEL: Final = {"p50": "p50_m", "p95": "p95_m"}


def level_basis(record: Facts) -> str:
    """Return "protection" if the run's fault priors are measured, or "indicative protection" if they are not."""
    risk = (record.get("settings_used") or {}).get("risk") or {}
    return "protection" if risk.get("priors") == "measured" else "indicative protection"


def budget_tables(antennas: Mapping[str, Facts], basis: str) -> list[Table]:
    """Return three tables: filter epochs by status, single epochs by status, and pseudoranges by rejection reason.

    `antennas` has, for each antenna, its part of ``run.json``, and `basis` is the result of `level_basis`. The first
    table is absent if the filter was off. Fields that a record of an earlier version lacks are shown as a dash.
    """
    filtered = {name: facts["filter"] for name, facts in antennas.items() if facts.get("filter")}
    caption = "Single epochs (positions.csv)" if filtered else "Epochs by status"
    tables = [_filter_table(filtered, basis)] if filtered else []
    return [*tables, _epochs_table(antennas, basis, caption), _ranges_table(antennas)]


def _filter_table(filtered: Mapping[str, Facts], basis: str) -> Table:
    found = list(filtered.values())
    rows = [
        [status, *(count(each["status"][status]) for each in found)]
        for status in dict.fromkeys(word for each in found for word, epochs in each["status"].items() if epochs)
    ]
    rows += _metres("sigma along the line", [each.get("along_sigma_m") for each in found], _OF_SIGMA)
    levels = [each.get("level") for each in found]
    if any(levels):
        rows += _metres(f"{basis} level", levels, _OF_LEVEL)
        for limit in WITHIN_M:
            counts = (None if level is None else level.get(f"within_{limit}_m") for level in levels)
            rows.append([f"  within {limit} m", *(count(each) for each in counts)])
    return _table("filter", filtered, rows, "Filter along the track (train.csv)")


def _epochs_table(antennas: Mapping[str, Facts], basis: str, caption: str) -> Table:
    every = list(antennas.values())
    rows = [
        ["epochs", *(count(facts.get("epochs")) for facts in every)],
        ["with observations", *(count(facts.get("epochs_with_observations")) for facts in every)],
    ]
    for way in ("with", "without"):
        statuses = [Counter(facts.get(f"epochs_{way}_position_by_status") or {}) for facts in every]
        for epochs in statuses:
            del epochs[Status.NO_OBSERVATION.text]
        if any(statuses):
            rows.append([f"{way} coordinates", *(count(epochs.total()) for epochs in statuses)])
        for status in Status:
            if any(epochs[status.text] for epochs in statuses):
                rows.append([f"  {status.text}", *(count(epochs[status.text]) for epochs in statuses)])
                if status is Status.TOO_FEW_SATELLITES:
                    rows += _rows_of_few(every)
    rows.append(["positioning rate", *(share(facts.get("positioning_rate")) for facts in every)])
    rows.append(["rate of ok", *(share(facts.get("ok_rate")) for facts in every)])
    rows += _metres("sigma along the line", [facts.get("along_sigma_m") for facts in every], _OF_SIGMA)
    levels = [facts.get("protection_level") for facts in every]
    if any(levels):
        rows += _metres(f"{basis} level", levels, _OF_LEVEL)
        for word in ("available", "alarm"):
            shares = [
                share(None if level is None else _ratio(level[word], facts["epochs_with_observations"]))
                for level, facts in zip(levels, every, strict=True)
            ]
            rows.append([f"  {word}", *shares])
    return _table("epochs", antennas, rows, caption)


def _rows_of_few(antennas: Sequence[Facts]) -> Iterator[list[str]]:
    """Yield a row per rejection reason: `AntennaTally.short_first` and `AntennaTally.short_only` of each antenna."""
    first = [Counter(facts.get("too_few_satellites_by_first_reason") or {}) for facts in antennas]
    alone = [Counter(facts.get("too_few_satellites_by_one_reason_alone") or {}) for facts in antennas]
    for reason in dict.fromkeys(name for counts in first for name, _ in counts.most_common()):
        both = zip(first, alone, strict=True)
        yield [f"    by {reason}", *(f"{count(mine[reason])} ({count(only[reason])} alone)" for mine, only in both)]


def _ranges_table(antennas: Mapping[str, Facts]) -> Table:
    observed = [facts.get("observations") or 0 for facts in antennas.values()]

    def row(name: str, counts: Sequence[int], alone: Sequence[int] | None = None) -> list[str]:
        cells = [name]
        for k, ranges in enumerate(counts):
            cells += [count(ranges), share(_ratio(ranges, observed[k])), "" if alone is None else count(alone[k])]
        return cells

    rows = [
        row("observed", observed),
        row("used", [facts.get("observations_used") or 0 for facts in antennas.values()]),
    ]
    first, only = (
        [Counter(facts.get(f"observations_rejected_by_{which}") or {}) for facts in antennas.values()]
        for which in ("first_reason", "one_reason_alone")
    )
    for reason in dict.fromkeys(name for counts in first for name, _ in counts.most_common()):
        rows.append(row(f"  {reason}", [counts[reason] for counts in first], [counts[reason] for counts in only]))
    heads = [head for name in antennas for head in (name, "share", "alone")]
    return _table("pseudoranges", heads, rows, "Rejected pseudoranges by their first reason, and by that reason alone")


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _metres(what: str, found: Sequence[Facts | None], fields: Mapping[str, str]) -> Iterator[list[str]]:
    """Yield a row of lengths [m] for each field, with one column per antenna. Missing lengths are shown as a dash."""
    for label, field in fields.items():
        yield [f"{what}, {label}", *(number(None if each is None else each[field], 2, " m") for each in found)]


def _table(name: str, heads: Iterable[str], rows: Sequence[Sequence[str]], caption: str) -> Table:
    head = ["", *heads]
    return Table(name=name, head=head, rows=rows, caption=caption, numeric=range(1, len(head)), boxed=True)

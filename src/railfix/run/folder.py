"""Record of a run (``run.json``) read back, with its inputs where they are now."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import polars as pl
import polars.selectors as cs
from polars.exceptions import PanicException, PolarsError

from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import file_sha256, read_json_object
from railfix.core.settings import Model, validated
from railfix.pipeline.config import Config, parse_config
from railfix.run.inputs import RunInputs, located
from railfix.run.options import RunOptions

#: Settings, by group and name, that were removed because nothing used them: records of earlier runs have them.
WITHOUT_EFFECT: Final = (("section", "predicted_sigmas"),)


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """Record of a run: ``run.json`` in the folder that `run_files` wrote."""

    path: Path  #: The folder.
    record: Mapping[str, Any]  #: ``run.json``.

    def part(self, name: str) -> dict[str, Any]:
        """Return a table of the record.

        Raises
        ------
        InputFileError
            It is missing or not a table.
        """
        table = self.record.get(name)
        if not isinstance(table, dict):
            raise InputFileError(self.path / "run.json", f"has no table {name}; repeat the run with this version")
        return table

    @cached_property
    def config(self) -> Config:
        """Settings that were used, with the files they name where these are now.

        Settings that earlier versions recorded and that never changed a result are left out.

        Raises
        ------
        InputFileError
            The record lacks them, or they are not settings of this version.
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
        """Check that the input files are there and unchanged.

        Raises
        ------
        InputFileError
            One is missing.
        MismatchError
            One has changed since the run.
        """
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
        """Input files with kind, path and SHA-256.

        Raises
        ------
        InputFileError
            The record has no such list.
        """
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
    """Read the record of a run.

    Parameters
    ----------
    folder : Path
        That `railfix run` wrote.

    Raises
    ------
    InputFileError
        There is no record, or it is not one.
    """
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

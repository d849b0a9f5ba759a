"""The program where things are not as usual: pipes that close, full devices, narrow logs, words given twice."""

from __future__ import annotations

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
from railfix.cli import app

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
PROGRAM: Final = (sys.executable, "-m", "railfix")
NARROW: Final = {**os.environ, "COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"}


@pytest.fixture(scope="module")
def desk(good: Desk) -> Desk:
    return good


def text_of(output: str) -> str:
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", output).split())


# -- words --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        ("run --overwrite true", 2, "--overwrite is a switch and takes no value; leave true out"),
        ("evaluate run --reference r --overwrite yes", 2, "--overwrite is a switch and takes no value"),
        ("report run --out p.html --overwrite 1", 2, "--overwrite is a switch and takes no value; leave 1 out"),
        ("run --overwrite=true", 2, "--overwrite"),
        ("run --preset p1 --preset strict", 2, "--preset is given twice; give it once"),
        ("run --out a --out=b", 2, "--out is given twice"),
        ("simulate demo --seed 1 --seed 2 --out x", 2, "--seed is given twice"),
        ("map check --max-gap 1 line.csv --max-gap 2", 2, "--max-gap is given twice"),
        ("{log} --preset p1 --set preset=strict", 4, "the preset is given twice (--preset p1 and --set preset=strict)"),
        ("{log} --set elevation.mask_deg=1 --set elevation.mask_deg=2", 4, "elevation.mask_deg is given 2 times"),
        ("simulate demo --out x --set seed=1 --set seed=2", 4, "--set seed is given 2 times"),
        ("{log} --set elevation.mask_deg", 4, "expected KEY=VALUE"),
        ("{log} --set elevation.mask_degrees=1", 4, "unknown setting"),
        ("{log} --set elevation=1", 4, "elevation"),
        ("{log} --set elevation.mask_deg=high", 4, "elevation.mask_deg"),
        ("{log} --set elevation.mask_deg=1e999", 4, "elevation.mask_deg"),
        ("{log} --set elevation.mask_deg=nan", 4, "elevation.mask_deg"),
        ("{log} --set systems=[]", 4, "systems"),
        ("{log} --set systems=[1]", 4, "systems"),
        ("{log} --set systems=X", 4, "systems"),
        ("{log} --set a.b.c.d=1", 4, "unknown setting"),
        ("{log} --set =1", 4, "expected KEY=VALUE"),
        ("{log} --preset p2", 4, "unknown preset"),
        ("{log} --screens doppler,doppler", 4, "name each screen once"),
        ("{log} --screens radar", 4, "unknown screen"),
        ("{log} --without radar", 4, "unknown screen"),
        ("{log} --chunk 0", 4, "--chunk"),
        ("{log} --chunk -5", 4, "--chunk"),
        ("{log} --chunk 1.5", 2, "--chunk"),
        ("{log} --start 2024-03-06 --end 2024-03-05", 4, "is not before --end"),
        ("{log} --start 2024-13-05", 2, "--start"),
        ("{log} --start 2524-03-05", 4, "--start: a GPS time from 1980 to 2261"),
        ("{log} --start 2124-03-05", 5, "time span"),
        ("{log} --crs EPSG:0", 4, "EPSG:0"),
        ("{log} --height-datum sea", 4, "height_datum"),
        ("{log} --geoid flat", 4, "geoid"),
        ("{log} --reference centre", 4, "vehicle"),
        ("{log} --config {desk}/line.csv", 3, "TOML"),
        ("{log} --cn0-curve {desk}/line.csv", 3, "line.csv"),
        ("{log} --error-model {desk}/line.csv", 3, "line.csv"),
        ("{log} --sbas {desk}/line.csv", 3, "line.csv"),
        ("{log} --sp3 {desk}/line.csv", 3, "line.csv"),
        ("{log} --rear {desk}/front.obs", 3, "given twice"),
        ("simulate demo --seconds 1e12 --out {out}", 4, "duration_s"),
        ("simulate demo --seconds nan --out {out}", 4, "--seconds: Input should be a finite number"),
        ("simulate demo --seconds -1 --out {out}", 4, "--seconds: Input should be greater than 0"),
        ("simulate demo --seconds 0 --out {out}", 4, "--seconds: Input should be greater than 0"),
        ("simulate demo --seed -1 --out {out}", 4, "seed"),
        ("simulate demo --seed 1e3 --out {out}", 2, "--seed"),
        ("simulate nothing --out {out}", 3, "nothing"),
        ("simulate demo --only 1 --out {out}", 4, "single run"),
        ("simulate demo --set line.length_m=1e300 --out {out}", 4, "line"),
        ("simulate demo --set rate_hz=1e9 --out {out}", 4, "rate_hz"),
        ("map check {desk}/line.csv --max-gap nan", 4, "--max-gap"),
        ("map check {desk}/line.csv --mid-chord -1", 4, "--mid-chord"),
        ("map from-positions {desk}/rtk.csv --out {out}.csv --spacing 1e300", 7, "0 of 200 positions left"),
        ("map from-positions {desk}/rtk.csv --out {out}.csv --spacing 0", 4, "--spacing"),
        ("map from-positions {desk}/rtk.csv --out {out}.csv --quality x", 4, "--quality"),
        ("map from-positions {desk}/rtk.csv --out {out}.csv --column a", 4, "--column"),
        ("map from-positions {desk}/rtk.csv --out {out}.csv --column a=b", 4, ""),
        ("cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {out} --bin 0", 4, "--bin"),
        ("cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {out} --bin nan", 4, "--bin"),
        ("cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {out} --position 1,2", 4, "--position"),
        ("cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {out} --position 1,2,nan", 4, "--position"),
        ("cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {out} --position 91,2,3", 4, "--position"),
        ("error-model {desk}/results --reference {desk}/truth.csv --out {out} --sectors 0", 4, "--sectors: Input"),
        ("error-model {desk}/results --reference {desk}/truth.csv --out {out} --elevations 0", 4, "rising edges"),
        ("error-model {desk}/results --reference {desk}/truth.csv --out {out} --least-blocks 0", 4, "--least-blocks"),
        ("error-model {desk} --reference {desk}/truth.csv --out {out}", 3, "run.json"),
        ("evaluate {desk}/results --reference {desk}/truth.csv --section-length nan", 4, "--section-length"),
        ("evaluate {desk}/results --reference {desk}/truth.csv --alarm-limit 0", 4, "--alarm-limit"),
        ("evaluate {desk}/results --reference {desk}/truth.csv --alarm-limit 5,x", 4, "--alarm-limit"),
        ("evaluate {desk}/results --reference {desk}/truth.csv --seed -1", 4, "--seed"),
        ("evaluate {desk}/results {desk}/results --reference auto", 4, "given twice"),
        ("evaluate {desk} --reference {desk}/truth.csv", 3, "run.json"),
        ("report {desk}/results {desk}/results --out {out}.html", 4, "given twice"),
        ("report {desk}/line.csv --out {out}.html", 3, "expected the folder"),
        ("plot-screens {desk} --out {out}", 3, "run.json"),
        ("reference --rtk {desk}/rtk.csv --track {desk}/line.csv --out {out} --ratio nan", 4, "--ratio"),
        ("reference --rtk {desk}/rtk.csv --track {desk}/line.csv --out {out} --max-gap inf", 4, "--max-gap"),
        ("reference --rtk {desk}/rtk.csv --track {desk}/line.csv --out {out} --date 2024", 2, "--date"),
        (
            "reference --rtk {desk}/rtk.csv --rtk-rear {desk}/rtk.csv --track {desk}/line.csv --out {out}",
            4,
            "--vehicle",
        ),
        ("reference --track {desk}/line.csv --out {out}", 4, "--rtk"),
        ("demo --out {desk}/line.csv", 8, "is a file"),
        ("demo --out /proc/no/where", 8, "cannot be written"),
        ("{log} --out /dev/null", 2, "--out is given twice"),
        ("map from-positions {desk}/rtk.csv --out /proc/nowhere", 8, ""),
        ("report {desk}/results --out {desk}", 8, "is a folder"),
    ],
)
@pytest.mark.every(2)
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
@pytest.mark.every(2)
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
    assert done.stderr == "railfix: error: .: the working directory does not exist any more; change to one that does\n"


def test_a_name_that_is_not_utf_8_is_one_sentence(tmp_path: Path) -> None:
    name = os.fsencode(tmp_path) + b"/l\xe9ne.csv"
    Path(os.fsdecode(name)).write_text("latitude_deg\n")
    done = subprocess.run([*PROGRAM, "map", "check", name], capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stderr.startswith("railfix: error: ")
    assert "is not UTF-8; rename the file" in done.stderr
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
@pytest.mark.every(3)
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
    [(errno.ENOSPC, "free some space on the disk"), (errno.EACCES, "name a folder that can be written to")],
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

"""Commands never destroy: existing files, inputs, leftovers of killed processes, results that are moved."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random
from typing import Final

import pytest
from typer.testing import CliRunner

from bad_inputs import Desk
from railfix.cli import app
from railfix.core.errors import OutputError
from railfix.run import read_record
from railfix.run.output import FileKind, OutputFolder, check_output_file

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})

_LOG: Final = "--front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/line.csv"
#: A command of each kind, with its output in braces, and the inputs that its output could overwrite.
TO_FILE: Final = {
    "map from-positions {desk}/rtk.csv --out {out}": ("rtk.csv",),
    "cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {out}": ("front.obs", "brdc.nav"),
    "cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {desk}/new.toml --plot {out}": ("front.obs", "new.toml"),
    "error-model {desk}/results --reference {desk}/truth.csv --out {out}": ("truth.csv", "results/run.json"),
    "report {desk}/results --reference {desk}/truth.csv --out {out}": ("truth.csv", "results/positions.parquet"),
    "export {desk}/results --out {out}": ("results/positions.parquet", "results/run.json"),
}
#: Endings of the outputs, by a word of the command.
ENDINGS: Final = {"export": ".gpkg", "map": ".csv", "--plot": ".png", "report": ".html", "": ".toml"}
TO_FOLDER: Final = {
    f"run {_LOG} --out {{out}}": "positions.csv",
    f"ablate {_LOG} --out {{out}}": "ablation.csv",
    "reference --rtk {desk}/rtk.csv --track {desk}/line.csv --height 9999 --lateral 999 --out {out}": "fixes.csv",
    "evaluate {desk}/results --reference {desk}/truth.csv --out {out}": "tables.csv",
    "plot-screens {desk}/results --out {out}": "front_doppler.png",
    "simulate {desk}/scenario.toml --out {out}": "README.md",
    "map check {desk}/line.csv --out {out}": "map_check.png",
}


@pytest.fixture
def desk(good: Desk, tmp_path: Path) -> Desk:
    shutil.copytree(good.folder, tmp_path / "desk")
    return Desk(folder=tmp_path / "desk")


def call(desk: Desk, command: str, out: Path, *more: str) -> tuple[int, str]:
    words = [word.format(desk=desk.folder, out=out) for word in command.split()]
    result = RUNNER.invoke(app, [*words, *more])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return result.exit_code, result.output


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("command", TO_FILE, ids=lambda text: " ".join(text.split()[:2]))
@pytest.mark.every(4)
def test_an_existing_file_is_refused_and_an_input_never_overwritten(desk: Desk, command: str) -> None:
    ending = next(end for word, end in ENDINGS.items() if word in command)
    out = desk.folder / f"there{ending}"
    out.write_text("mine")
    before = contents(desk.folder)
    code, output = call(desk, command, out)
    assert (code, contents(desk.folder)) == (8, before)
    assert "exists already; give another file, or add --overwrite" in " ".join(output.split())
    for name in TO_FILE[command]:
        code, output = call(desk, command, desk.folder / name, "--overwrite")
        assert (code, contents(desk.folder)) == (8, before)
        assert "is an input, which is never overwritten" in " ".join(output.split())
    link = desk.folder / f"hard{ending}"
    link.hardlink_to(desk.folder / TO_FILE[command][0])
    code, output = call(desk, command, link, "--overwrite")
    assert code == 8
    assert (desk.folder / TO_FILE[command][0]).samefile(link)
    assert call(desk, command, out, "--overwrite")[0] == 0
    assert out.read_bytes() != b"mine"


@pytest.mark.parametrize("command", TO_FOLDER, ids=lambda text: " ".join(text.split()[:2]))
@pytest.mark.every(5)
def test_existing_results_are_replaced_only_when_asked(desk: Desk, command: str) -> None:
    out = desk.folder / "out"
    out.mkdir()
    (out / TO_FOLDER[command]).write_text("mine")
    (out / "other.txt").write_text("other")
    code, output = call(desk, command, out)
    assert code == 8
    assert "--overwrite" in output
    assert contents(out) == {
        name: hashlib.sha256(text.encode()).hexdigest()
        for name, text in ((TO_FOLDER[command], "mine"), ("other.txt", "other"))
    }
    assert call(desk, command, out, "--overwrite")[0] == 0
    assert (out / TO_FOLDER[command]).read_bytes() != b"mine"
    assert (out / "other.txt").read_text() == "other"
    assert [path.name for path in out.iterdir() if path.name.startswith(".")] == []


def test_a_run_into_the_folder_of_its_inputs_leaves_them(desk: Desk) -> None:
    shutil.copy(desk.folder / "rtk.csv", desk.folder / "positions.csv")
    words = f"run {_LOG.replace('line.csv', 'positions.csv')} --out {{desk}}"
    before = contents(desk.folder)
    code, output = call(desk, words, desk.folder, "--overwrite")
    assert code in (3, 5, 8)
    assert contents(desk.folder) == before
    shutil.copy(desk.folder / "line.csv", desk.folder / "positions.csv")
    before = contents(desk.folder)
    code, output = call(desk, words, desk.folder, "--overwrite")
    assert (code, contents(desk.folder)) == (8, before)
    assert "is an input, which is never overwritten" in " ".join(output.split())


@pytest.mark.requirement("G4")
def test_inputs_of_a_run_and_two_outputs_of_one_name_are_left(good: Desk, desk: Desk) -> None:
    """The error model over the run's own inputs; observations and ephemerides in one file; a log over a map."""
    record = desk.folder / "results" / "run.json"
    record.write_text(record.read_text().replace(str(good.folder), str(desk.folder)))
    before = contents(desk.folder)
    for name in ("front.obs", "line.csv", "train.toml"):
        words = "error-model {desk}/results --reference {desk}/truth.csv --out {out}"
        code, output = call(desk, words, desk.folder / name, "--overwrite")
        assert (code, contents(desk.folder)) == (8, before), output
        assert "is an input, which is never overwritten" in " ".join(output.split())
    out = desk.folder / "one.rnx"
    code, output = call(desk, "convert {desk}/front.obs --out {out} --nav-out {out}", out, "--overwrite")
    assert (code, contents(desk.folder)) == (8, before), output
    assert "is given by both --out and --nav-out" in " ".join(output.split())
    words = "live --front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/line.csv --log {out}"
    code, output = call(desk, words, desk.folder / "truth.csv")
    assert (code, contents(desk.folder)) == (8, before), output
    assert "is not a log of railfix live" in " ".join(output.split())


# -- leftovers ----------------------------------------------------------------------------------------------


def test_a_leftover_is_removed_and_a_living_run_is_not_disturbed(tmp_path: Path) -> None:
    with OutputFolder(tmp_path / "out") as folder:
        (folder.stage("a.txt")).write_text("a")
        code = "import sys; from pathlib import Path; from railfix.run.output import OutputFolder as Folder\n"
        code += "Folder(Path(sys.argv[1]))"
        command = [sys.executable, "-c", code, str(tmp_path / "out")]
        other = subprocess.run(command, capture_output=True, text=True, check=False)
        assert f"another railfix (process {os.getpid()}) is writing there" in other.stderr
        assert folder.stage("a.txt").read_text() == "a"
    # a dead process: files without a lock that anyone holds
    for name, suffix in ((".railfix-dead", ".lock"), (".railfix-gone", "")):
        (tmp_path / "out" / name).mkdir(parents=True)
        (tmp_path / "out" / name / "b.txt").write_text("b")
        if suffix:
            (tmp_path / "out" / (name + suffix)).write_text("999999\n")
    with OutputFolder(tmp_path / "out") as folder:
        assert [path.name for path in (tmp_path / "out").iterdir() if "dead" in path.name or "gone" in path.name] == []
        folder.stage("c.txt").write_text("c")
        folder.commit()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["c.txt"]


def test_what_was_complete_when_the_process_was_killed_is_moved_in_place(tmp_path: Path) -> None:
    ready = tmp_path / ".railfix-dead" / "ready"
    ready.mkdir(parents=True)
    (tmp_path / ".railfix-dead.lock").write_text("999999\n")
    (ready / "run.json").write_text("new")
    (tmp_path / "run.json").write_text("old")
    (tmp_path / "positions.csv").write_text("new")
    with pytest.raises(OutputError, match="not empty"):
        OutputFolder(tmp_path)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"run.json": "new", "positions.csv": "new"}


def test_a_file_in_a_folder_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    for target, words in ((tmp_path / "no" / "a", "does not exist"), (tmp_path, "is a folder")):
        with pytest.raises(OutputError, match=words):
            check_output_file(target, overwrite="replace", inputs=[])


@pytest.mark.requirement("G4")
@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        (
            "page",
            "report.pdf",
            r"an HTML page is written; give a file name that ends in .html or .htm; .* print the page",
        ),
        ("page", "report", r"give a file name that ends in .html"),
        ("csv", "line.csv.gz", r"give a file name that ends in .csv"),
        ("picture", "network.pdf", r"give a file name that ends in .png or .svg"),
    ],
)
def test_the_ending_of_an_output_is_that_of_its_kind(tmp_path: Path, kind: FileKind, name: str, words: str) -> None:
    with pytest.raises(OutputError, match=words):
        check_output_file(tmp_path / name, overwrite="refuse", inputs=[], kind=kind)
    for good in ("a.HTML", "a.htm") if kind == "page" else ():
        check_output_file(tmp_path / good, overwrite="refuse", inputs=[], kind=kind)


def _killed_after(words: list[str], seconds: float, number: signal.Signals, folder: Path) -> int:
    process = subprocess.Popen(
        [sys.executable, "-m", "railfix", *words], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        return process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
        return process.wait()


def _check_kills(desk: Desk, command: str, kills: int, number: signal.Signals, seed: int) -> None:
    words = [word.format(desk=desk.folder, out="out") for word in command.split()]
    out = desk.folder / "out"
    made = ("out",) if command.startswith("report") else ()  # its folder has to be there
    out.parent.joinpath(*made).mkdir(exist_ok=True)
    here = [word.format(desk=desk.folder, out=out) for word in command.split()]
    began = time.perf_counter()
    assert RUNNER.invoke(app, here).exit_code == 0
    whole_s = 1.0 + time.perf_counter() - began  # with the start of a process
    expected = sorted(path.name for path in out.iterdir())
    for name in expected:
        assert not name.startswith("."), name
    shutil.rmtree(out)
    random = Random(seed)
    for _ in range(kills):
        out.parent.joinpath(*made).mkdir(exist_ok=True)
        code = _killed_after(words, random.uniform(0.1, 1.1) * whole_s, number, desk.folder)
        assert code in (0, -number, 128 + number)
        result = RUNNER.invoke(app, here)
        # the killed process had finished its work, or the next one does it
        finished = "not empty" in result.output or "exists already" in " ".join(result.output.split())
        assert result.exit_code == 0 or (result.exit_code == 8 and finished), result.output
        assert sorted(path.name for path in out.iterdir()) == expected
        if (out / "run.json").exists():
            assert json.loads((out / "run.json").read_text())["positioning_rate"] > 0.9
        for page in out.glob("*.html"):
            assert page.read_text().rstrip().endswith("</html>")
        shutil.rmtree(out)


KILLED: Final = {
    "run": f"run {_LOG} --observations --out {{out}}",
    "simulate": "simulate {desk}/scenario.toml --out {out}",
    "report": "report {desk}/results --reference {desk}/truth.csv --out {out}/report.html",
}


@pytest.mark.parametrize("name", ["run", pytest.param("simulate", marks=pytest.mark.slow)])
@pytest.mark.every(4)
def test_the_next_run_works_after_a_kill(desk: Desk, name: str) -> None:
    _check_kills(desk, KILLED[name], 1, signal.SIGKILL, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", KILLED)
def test_the_next_run_works_after_fifty_kills(desk: Desk, name: str) -> None:
    _check_kills(desk, KILLED[name], 50, signal.SIGKILL, seed=2)


def test_a_signal_while_the_results_folder_is_made_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(_: object) -> bool:
        raise SystemExit(128 + signal.SIGTERM)

    monkeypatch.setattr("railfix.run.output._try_lock", ended)
    with pytest.raises(SystemExit):
        OutputFolder(tmp_path / "new" / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)], ids=lambda n: n.name
)
def test_a_terminated_run_leaves_nothing(desk: Desk, number: signal.Signals) -> None:
    words = [word.format(desk=desk.folder, out="out") for word in KILLED["run"].split()]
    process = subprocess.Popen([sys.executable, "-m", "railfix", *words, "--chunk", "1"], cwd=desk.folder)
    while not any((desk.folder / "out").glob(".railfix-*")) and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(number)
    assert process.wait() == 128 + number
    assert not (desk.folder / "out").exists()


# -- results that are moved ---------------------------------------------------------------------------------


def test_results_can_be_moved_together_with_their_inputs(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(desk.folder)
    words = [word.format(desk=".", out="day/results") for word in TO_FOLDER_RUN.split()]
    assert RUNNER.invoke(app, words).exit_code == 0
    record = json.loads(Path("day/results/run.json").read_text())
    assert {entry["path"] for entry in record["inputs"]} == {"../../front.obs", "../../brdc.nav", "../../line.csv"}
    monkeypatch.chdir(tmp_path)
    desk.folder.rename(tmp_path / "elsewhere")
    moved = read_record(Path("elsewhere/day/results"))
    moved.check_inputs()
    assert moved.inputs.front == (Path("elsewhere/front.obs"),)
    words = "error-model elsewhere/day/results --reference elsewhere/truth.csv --out model.toml".split()
    result = RUNNER.invoke(app, words)
    assert result.exit_code == 0, result.output


TO_FOLDER_RUN: Final = f"run {_LOG} --out {{out}}"


@pytest.mark.parametrize("meanwhile", ["made", "removed"])
def test_runs_of_a_campaign_share_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, meanwhile: str) -> None:
    """The folder above a run's own is made, or made and removed, by another run at the same time."""
    above, own = tmp_path / "train=B", tmp_path / "train=B" / "day=1"
    mkdir, calls = Path.mkdir, []

    def beside_another(path: Path) -> None:
        calls.append(path)
        if calls == [above] and meanwhile == "made":
            mkdir(above)
        if calls == [above, own] and meanwhile == "removed":
            above.rmdir()
        mkdir(path)

    monkeypatch.setattr(Path, "mkdir", lambda path, *words, **named: (
        beside_another(path) if path in (above, own) else mkdir(path, *words, **named)
    ))  # fmt: skip
    with OutputFolder(own) as folder:
        folder.write_json("run.json", {})
        folder.commit()
    assert (own / "run.json").exists()
    assert len(calls) == (2 if meanwhile == "made" else 4)

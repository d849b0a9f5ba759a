"""Every kind of input file with every fault: one sentence, the documented exit code, nothing destroyed."""

from __future__ import annotations

import hashlib
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from bad_inputs import CASES, COMMANDS, FAULTS, MISTAKES, Desk, edited
from railfix.cli import app

#: Faults that leave nothing to be read.
UNREADABLE = ("missing", "folder", "dangling_link", "link_to_itself", "empty", "zeros", "gzip_cut", "zip_archive")
#: An empty TOML file is one without settings; without Parquet the CSV file of the positions is read.
HARMLESS = {(kind, "empty") for kind in COMMANDS if kind.endswith(".toml")} | {
    ("results/positions.parquet", fault) for fault in ("missing", "folder", "dangling_link", "link_to_itself")
}

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.fixture
def desk(good: Desk, tmp_path: Path) -> Desk:
    """A copy of the good inputs; files are linked, a fault replaces the link."""
    shutil.copytree(good.folder, tmp_path / "desk", copy_function=lambda a, b: Path(b).hardlink_to(a))
    return Desk(folder=tmp_path / "desk")


def contents(folder: Path) -> dict[str, str]:
    """Digest of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        for path in sorted(folder.rglob("*"))
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", COMMANDS)
def test_the_good_inputs_are_good(desk: Desk, kind: str) -> None:
    result = RUNNER.invoke(app, desk.words(COMMANDS[kind]))
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(("kind", "fault"), CASES, ids=lambda name: name.replace("/", "-"))
@pytest.mark.every(4)
def test_one_sentence_and_nothing_destroyed(desk: Desk, kind: str, fault: str) -> None:
    FAULTS[fault](desk.folder / kind)
    before = contents(desk.folder)
    result = RUNNER.invoke(app, desk.words(COMMANDS[kind]))
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code in (0, 3, 4, 5, 6, 7), result.output
    after = contents(desk.folder)
    new = {name for name in after if name not in before}
    assert {name: after[name] for name in before} == before
    if result.exit_code in (0, 6):
        assert all(name.split("/")[0].startswith("out") for name in new)
    else:
        assert result.stderr.startswith("railfix: error: ")
        assert result.stderr.count("\n") == 1
        assert new == set()
    if fault == "byte_order_mark" and not kind.endswith(".parquet"):
        assert result.exit_code == 0, result.output
    if fault in UNREADABLE and (kind, fault) not in HARMLESS:
        assert result.exit_code == 3, result.output


@pytest.mark.requirement("G4")
@pytest.mark.parametrize("name", MISTAKES)
@pytest.mark.every(4)
def test_a_mistake_of_the_user_is_one_sentence_with_its_remedy(good: Desk, name: str) -> None:
    command, code, words = (MISTAKES[name][key] for key in ("command", "exit", "words"))
    files, words = MISTAKES[name].get("files", {}), [words] if isinstance(words, str) else words
    kept = {file: (good.folder / file).read_bytes() for file in files if (good.folder / file).exists()}
    for file, text in files.items():
        (good.folder / file).write_text(text if isinstance(text, str) else edited(good.folder, *text))
    before = contents(good.folder)
    try:
        result = RUNNER.invoke(app, good.words(command))
        after = contents(good.folder)
    finally:
        for file in files:
            (good.folder / file).unlink()
        for file, content in kept.items():
            (good.folder / file).write_bytes(content)
        # a command that should have failed leaves its results: they must not fail the next one
        shutil.rmtree(good.folder / "out", ignore_errors=True)
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code == code, result.output
    if code == 2:  # the usage and a box
        said = " ".join(re.sub("[│╭╮╰╯─]", " ", result.stderr).split())
    else:
        sentences = [line for line in result.stderr.splitlines() if not line.startswith("railfix live: ")]
        assert len(sentences) == 1
        said = sentences[0]
        assert said.startswith("railfix: error: ")
    assert not [word for word in words if word not in said]
    assert after == before


def heights(scale: float, added_m: float) -> Any:
    return lambda point: f"{point[1]}{float(point[2]) * scale + added_m:.4f}{point[3]}"


@pytest.mark.requirement("G4")
@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("line.csv", r"^([\d.]+,[\d.]+,)([\d.]+)(.*)$", heights(1 / 0.3048, 0)), "of the map may be in feet"),
        (("line.csv", r"^([\d.]+,[\d.]+,)([\d.]+)(.*)$", heights(1, -36)), "give --height-datum orthometric"),
        (("front.obs", "GPS(?= +TIME OF FIRST)", "GLO"), "with time tags 18 s earlier"),
    ],
)
def test_a_run_off_the_line_names_the_likely_cause(desk: Desk, edit: tuple[Any, ...], words: str) -> None:
    text = edited(desk.folder, *edit)
    source = edit[0]
    (desk.folder / source).unlink()
    (desk.folder / source).write_text(text)
    command = "run --front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/line.csv --out {out}"
    result = RUNNER.invoke(app, desk.words(command))
    assert result.exit_code == 7, result.output
    assert re.search(f"no position can be used; likely cause: .*{re.escape(words)}", result.output)

"""What is no mistake in a file: no permission, a full disk, an interruption, lenient reading, one file by two names."""

from __future__ import annotations

import errno
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from broken_bench import INPUT, OUTPUT, Bench, Outcome, bench_in, epoch_starts


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return bench_in(tmp_path_factory.mktemp("sound"))


@pytest.fixture
def bench(sound: Bench, tmp_path: Path) -> Bench:
    return sound.copy(tmp_path / "run")


def everything_below(folder: Path) -> dict[str, bytes]:
    """Names of all files and folders, with the content of the files."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def assert_one_sentence(outcome: Outcome, code: int, words: tuple[str, ...]) -> None:
    assert outcome.exception is None or isinstance(outcome.exception, SystemExit), repr(outcome.exception)
    assert outcome.code == code, outcome.stderr
    assert re.fullmatch(r"railfix: error: [^\n]+\n", outcome.stderr), outcome.stderr
    for word in words:
        assert word in outcome.stderr


def test_the_unbroken_run_is_sound(bench: Bench) -> None:
    outcome = bench.run(rear=bench.rear, vehicle=bench.vehicle)
    assert outcome.code == 0, outcome.stderr
    written = sorted(p.name for p in bench.out.iterdir())
    assert written == ["positions.csv", "positions.parquet", "run.json", "train.csv", "train.parquet"]


@pytest.mark.parametrize(
    "options",
    [
        {"front": "absent.obs"},
        {"out": "front.obs"},
        *(pytest.param(o, marks=pytest.mark.slow) for o in ({"track": "brdc.nav"}, {"config": "train.toml"})),
    ],
    ids=lambda o: next(iter(o)),
)
@pytest.mark.every(3)
def test_the_program_itself_ends_the_same_way(bench: Bench, options: dict[str, Any]) -> None:
    command = [sys.executable, "-m", "railfix", *bench.arguments(**options)]
    done = subprocess.run(command, cwd=bench.folder, capture_output=True, text=True, check=False)
    assert done.returncode in (3, 4, 8)
    assert re.fullmatch(r"railfix: error: [^\n]+\n", done.stderr)
    assert done.stdout == ""


def test_a_file_without_permission_is_named(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Path.open

    def refuse(path: Path, *arguments: Any, **options: Any) -> Any:
        if path == bench.nav:
            raise PermissionError(errno.EACCES, "Permission denied")
        return whole(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", refuse)
    assert_one_sentence(bench.run(), INPUT, ("brdc.nav", "Permission denied"))


def test_a_full_disk_leaves_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    import polars as pl

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pl.DataFrame, "write_csv", full)
    before = everything_below(bench.folder)
    assert_one_sentence(bench.run(), OUTPUT, ("positions.csv", "No space left on device"))
    assert everything_below(bench.folder) == before


def test_an_interrupted_run_leaves_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    import polars as pl

    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pl.DataFrame, "write_csv", interrupt)
    before = everything_below(bench.folder)
    outcome = bench.run()
    assert outcome.code != 0
    assert everything_below(bench.folder) == before


def test_broken_lines_are_counted_when_asked(bench: Bench) -> None:
    lines = bench.front.read_text().splitlines(keepends=True)
    at = epoch_starts("".join(lines))[5] + 1
    lines[at] = lines[at][:5] + "2l345678.9O1" + lines[at][17:]
    bench.write("front.obs", "".join(lines))
    outcome = bench.run(lenient=True)
    assert outcome.code == 0, outcome.stderr
    assert "front.obs, line " in outcome.stdout
    assert "front.obs, line " in (bench.out / "run.json").read_text()


def test_a_log_given_twice_by_another_name_is_found(bench: Bench) -> None:
    (bench.folder / "same.obs").symlink_to(bench.front)
    outcome = bench.run(front=[bench.front, bench.folder / "same.obs"])
    assert_one_sentence(outcome, INPUT, ("front.obs", "given twice"))

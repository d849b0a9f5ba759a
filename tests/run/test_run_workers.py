"""A run with a process for each antenna gives what a run in one process gives, and ends as it does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from broken_bench import Bench, bench_in
from railfix.core.errors import InputFileError, SettingsError
from railfix.run import RunOptions, run_files
from railfix.run.antennas import processes
from railfix.simulate.demonstration import demo_inputs

with_fork = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return bench_in(tmp_path_factory.mktemp("bench"))


def files_of(bench: Bench) -> dict[str, Path]:
    return {name: getattr(bench, name) for name in ("front", "rear", "nav", "track", "vehicle")}


def command_of(files: dict[str, Path], out: Path, *more: str) -> list[str]:
    options = [word for name, path in files.items() for word in (f"--{name}", str(path))]
    return [sys.executable, "-m", "railfix", "run", *options, "--out", str(out), *more]


def railfix_run(files: dict[str, Path], out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command_of(files, out, *more), capture_output=True, text=True, check=False)


@with_fork
def test_the_results_are_the_same_bits(bench: Bench, tmp_path: Path) -> None:
    for workers in ("1", "2"):
        done = railfix_run(files_of(bench), tmp_path / workers, "--workers", workers, "--observations", "--chunk", "7")
        assert done.returncode == 0, done.stderr
    for table in ("positions", "observations", "train"):
        one, two = (pl.read_parquet(tmp_path / workers / f"{table}.parquet") for workers in ("1", "2"))
        assert one.height > 0
        assert_frame_equal(one, two, check_exact=True)


@with_fork
def test_an_error_in_the_other_process_is_that_of_the_run(bench: Bench, tmp_path: Path) -> None:
    broken = tmp_path / "rear.rnx"
    broken.write_text("".join([*bench.rear.read_text().splitlines(keepends=True)[:-3], "G07 what is this\n"]))
    files = {**files_of(bench), "rear": broken}
    found = [railfix_run(files, tmp_path / "out", "--workers", workers) for workers in ("1", "2")]
    assert [done.returncode for done in found] == [InputFileError.exit_code] * 2, found[1].stderr
    assert found[0].stderr == found[1].stderr
    assert f"{broken}, line " in found[1].stderr.replace("\n", " ")
    assert not (tmp_path / "out").exists()


def _children(parent: int) -> list[int]:
    tasks = Path(f"/proc/{parent}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


@with_fork
@pytest.mark.parametrize("victim", ["other", "whole"])
def test_a_killed_process_leaves_no_results_and_no_process(tmp_path: Path, victim: str) -> None:
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    files = {"front": inputs.front[0], "rear": inputs.rear[0], "nav": inputs.nav[0], "track": inputs.track[0]}
    words = command_of(files | {"vehicle": inputs.vehicle}, tmp_path / "out", "--workers", "2", "--chunk", "1")
    run = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 30.0
    while not (others := _children(run.pid)) and run.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    assert others, "the other process was not started"
    os.kill(others[0] if victim == "other" else run.pid, signal.SIGKILL)
    _, said = run.communicate(timeout=60)
    assert run.returncode != 0
    if victim == "other":
        assert "the process of the rear antenna ended without an answer, exit code -9" in said
        assert not (tmp_path / "out").exists()
    gone = time.monotonic() + 30.0
    while any(Path(f"/proc/{other}").exists() for other in others) and time.monotonic() < gone:
        time.sleep(0.05)
    assert not any(Path(f"/proc/{other}").exists() for other in others)


@with_fork
def test_a_process_that_cannot_be_forked_says_so(tmp_path: Path) -> None:
    pl.DataFrame({"a": [2, 1]}).sort("a").group_by("a").agg(pl.len())  # starts the threads of polars
    assert processes(0) == processes(1) == 1
    with pytest.raises(SettingsError, match="workers = 2: polars has computed in this process"):
        run_files(demo_inputs(), out=tmp_path / "out", options=RunOptions(workers=2))
    assert not (tmp_path / "out").exists()

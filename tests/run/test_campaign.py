"""Campaigns: runs found by patterns, failures as rows, continued after a stop, one data set."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import polars as pl
import pytest
from typer.testing import CliRunner

from bad_inputs import Desk
from railfix.cli import app
from railfix.core.errors import InputFileError, OutputError, SettingsError
from railfix.run.campaign import read_campaign, run_campaign

pytestmark = pytest.mark.requirement("G1")

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
CAMPAIGN = """
front = "logs/{train}/{day}/front*.obs"
rear = "logs/{train}/{day}/rear.obs"
nav = "nav/{day}.nav"
track = ["line.csv"]
vehicle = "train.toml"
[options]
chunk_epochs = 50
"""


@pytest.fixture(scope="module")
def folder(good: Desk, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trains on two days; one log is broken, one day has no rear antenna."""
    folder = tmp_path_factory.mktemp("campaign")
    desk = good.folder
    for name in ("line.csv", "train.toml"):
        shutil.copy(desk / name, folder / name)
    (folder / "nav").mkdir()
    for day in ("2024-03-05", "2024-03-06"):
        shutil.copy(desk / "brdc.nav", folder / "nav" / f"{day}.nav")
        for train in ("A", "B"):
            place = folder / "logs" / train / day
            place.mkdir(parents=True)
            shutil.copy(desk / "front.obs", place / "front.obs")
            shutil.copy(desk / "rear.obs", place / "rear.obs")
    (folder / "logs/B/2024-03-06/rear.obs").unlink()
    (folder / "logs/B/2024-03-05/front.obs").write_text("no log\n")
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return folder


def test_runs_are_found_by_the_fields_of_the_patterns(folder: Path, tmp_path: Path) -> None:
    runs = read_campaign(folder / "campaign.toml", tmp_path)
    fields = [(train, day) for train in "AB" for day in ("2024-03-05", "2024-03-06")]
    assert [tuple(run.fields.values()) for run in runs] == fields
    for run in runs:
        assert run.inputs.nav == (folder / "nav" / f"{run.fields['day']}.nav",)
        assert run.inputs.front == (folder / "logs" / run.fields["train"] / run.fields["day"] / "front.obs",)
        assert run.options.chunk_epochs == 50
    assert runs[3].inputs.rear == ()
    assert runs[0].out == tmp_path / "runs" / "train=A" / "day=2024-03-05"


def test_a_failed_run_is_a_row_and_a_campaign_goes_on_where_it_was(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    seen, threads = [], ThreadPoolExecutor(1)
    position = partial(run_campaign, out=out, executor=threads, progress=lambda **state: seen.append(state))
    first = position(folder / "campaign.toml")
    assert first["status"].to_list() == ["done", "done", "failed", "done"]
    assert "front.obs" in first["error"][2]
    assert [(state["done"], state["failed"]) for state in seen] == [(1, 0), (2, 0), (3, 1), (4, 1)]
    assert pl.read_csv(out / "campaign.csv", try_parse_dates=False).height == 4
    rows = pl.scan_parquet(out / "runs" / "**" / "positions.parquet", hive_partitioning=True).collect()
    assert rows.group_by("train").len().sort("train").rows() == [("A", 800), ("B", 200)]

    record = out / "runs/train=A/day=2024-03-05/run.json"
    shutil.rmtree(out / "runs/train=A/day=2024-03-06")
    before = record.stat().st_mtime_ns
    seen.clear()
    again = position(folder / "campaign.toml")
    # two were there, and the failed one and the removed one are positioned again: none is counted as the first
    assert [(state["done"], state["kept"], state["failed"]) for state in seen] == [(3, 2, 0), (4, 2, 1)]
    assert record.stat().st_mtime_ns == before
    compared = [name for name in first.columns if name != "wall_s"]
    assert again.select(compared).equals(first.select(compared), null_equal=True)

    changed = folder / "strict.toml"
    (folder / "settings.toml").write_text('preset = "strict"\n')
    for options in ("[options]\nend = 2024-03-05T03:10:05", 'config = "settings.toml"\n[options]'):
        changed.write_text(CAMPAIGN.replace("[options]", options))
        position(changed)
        assert before != (before := record.stat().st_mtime_ns)


@pytest.mark.slow
def test_lenience_of_the_command_reaches_every_run(folder: Path, tmp_path: Path) -> None:
    text = (folder / "logs/A/2024-03-05/front.obs").read_text().splitlines(keepends=True)
    starts = [k for k, line in enumerate(text) if line.startswith(">")]
    text[starts[20] + 1] = "G0x" + text[starts[20] + 1][3:]
    (tmp_path / "one.obs").write_text("".join(text))
    shutil.copy(folder / "line.csv", tmp_path)
    shutil.copy(folder / "nav/2024-03-05.nav", tmp_path / "brdc.nav")
    (tmp_path / "c.toml").write_text('front = "{log}.obs"\nnav = "brdc.nav"\ntrack = ["line.csv"]\n')
    words = ["campaign", str(tmp_path / "c.toml"), "--workers", "1", "--json", "--out"]
    result = RUNNER.invoke(app, [*words, str(tmp_path / "strict")])
    assert result.exit_code == 7
    assert "--lenient" in result.stderr
    result = RUNNER.invoke(app, [*words, str(tmp_path / "lenient"), "--lenient"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["runs"][0]["status"] == "done"


def test_the_command_and_what_reads_its_runs(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = RUNNER.invoke(app, ["campaign", str(folder / "campaign.toml"), "--out", str(out), "--workers", "2"])
    assert result.exit_code == 5, result.output
    assert "4 of 4 runs, 1 failed, 0 min 00 s left" in result.stderr
    truth = str(tmp_path.parent / "none.csv")
    words = ["report", str(out / "runs/train=A/day=2024-03-05"), "--out", str(tmp_path / "page.html")]
    assert RUNNER.invoke(app, words).exit_code == 0
    assert RUNNER.invoke(app, [*words, "--overwrite", "--reference", truth]).exit_code == 3


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (("logs/{train}/{day}/front*.obs", "logs/{train}/{day}/none.obs"), InputFileError, "no file matches front"),
        (("logs/{train}/{day}/front*.obs", "logs/A/2024-03-05/front.obs"), SettingsError, "has no field"),
        (("nav/{day}.nav", "nav/{week}.nav"), SettingsError, "nav has the field week, which front lacks"),
        (("vehicle", "vehikel"), SettingsError, "vehikel"),
    ],
)
def test_a_wrong_campaign_is_one_sentence(
    folder: Path, tmp_path: Path, change: tuple[str, str], error: type[Exception], words: str
) -> None:
    wrong = folder / "wrong.toml"
    wrong.write_text(CAMPAIGN.replace(*change))
    with pytest.raises(error, match=words):
        read_campaign(wrong, tmp_path)


def test_a_folder_with_other_files_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with ThreadPoolExecutor(1) as executor, pytest.raises(OutputError, match="not the folder of a campaign"):
        run_campaign(folder / "campaign.toml", out=tmp_path, executor=executor)


def test_tracks_vehicles_and_sensors_may_have_fields(folder: Path, tmp_path: Path) -> None:
    for train in "AB":
        for name in ("line.csv", "train.toml"):
            shutil.copy(folder / name, folder / "logs" / train / name)
    text = CAMPAIGN.replace('"line.csv"', '"logs/{train}/line.csv"').replace(
        '"train.toml"', '"logs/{train}/train.toml"'
    )
    (folder / "each.toml").write_text(f'tachometer = "logs/{{train}}/{{day}}/pulses.csv"\n{text}')
    (folder / "logs/B/2024-03-06/pulses.csv").write_text("time_gpst,pulse\n")
    runs = read_campaign(folder / "each.toml", tmp_path)
    for run in runs:
        train = folder / "logs" / run.fields["train"]
        assert (run.inputs.track, run.inputs.vehicle) == ((train / "line.csv",), train / "train.toml")
    assert [run.inputs.tachometer for run in runs] == [None, None, None, folder / "logs/B/2024-03-06/pulses.csv"]


def test_a_worker_that_is_gone_is_a_failed_row(folder: Path, tmp_path: Path) -> None:
    """A process that is killed takes its pool with it; the next command goes on."""

    class Broken(ThreadPoolExecutor):
        def submit(self, function: Callable[..., Any], /, *arguments: Any, **rest: Any) -> Future[Any]:
            run = arguments[0]
            if run.fields["day"] == "2024-03-06":
                future: Future[Any] = Future()
                future.set_exception(BrokenExecutor("a process died"))
                return future
            return super().submit(function, *arguments, **rest)

    with Broken(1) as executor:
        table = run_campaign(folder / "campaign.toml", out=tmp_path / "out", executor=executor)
    assert table["status"].to_list() == ["done", "failed", "failed", "failed"]
    assert "worker process has ended" in table["error"][1]
    assert table["folder"][0] == "runs/train=A/day=2024-03-05"


def test_a_scheduler_that_is_none_is_one_sentence(folder: Path, tmp_path: Path) -> None:
    words = ["campaign", str(folder / "campaign.toml"), "--out", str(tmp_path / "out"), "--scheduler", "tpc://nowhere"]
    result = RUNNER.invoke(app, words)
    assert result.exit_code == 4, result.output
    assert "no scheduler answers at this address" in " ".join(result.output.split())


CLUSTER = """
from distributed import LocalCluster
import sys
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


def same_but_for_times(first: Path, second: Path) -> int:
    """The number of runs of two campaigns that are equal; raises where one is not."""
    folders = sorted(path.parent.relative_to(first) for path in first.rglob("run.json"))
    assert folders == sorted(path.parent.relative_to(second) for path in second.rglob("run.json"))
    for name in folders:
        for table in (path.name for path in (first / name).glob("*.parquet")):
            assert pl.read_parquet(first / name / table).equals(pl.read_parquet(second / name / table))
        records = [json.loads((out / name / "run.json").read_text()) for out in (first, second)]
        for record in records:
            for key in ("wall_s", "command", "created", "started", "stages", "processing"):
                record.pop(key, None)
        assert records[0].keys() == records[1].keys()
        for key in ("antennas", "positioning_rate", "ok_rate", "settings_used", "notes"):
            assert records[0].get(key) == records[1].get(key), key
    return len(folders)


@pytest.mark.slow
def test_two_workers_of_a_cluster_give_the_same_data_set(folder: Path, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as cluster:
        address = cluster.stdout.readline().strip()
        words = [sys.executable, "-m", "railfix", "campaign", str(folder / "campaign.toml"), "--out"]
        done = subprocess.run(
            [*words, str(tmp_path / "cluster"), "--scheduler", address], capture_output=True, text=True, check=False
        )
        cluster.communicate()
    assert done.returncode == 5, done.stderr
    assert "4 of 4 runs, 1 failed" in done.stderr
    subprocess.run([*words, str(tmp_path / "here")], capture_output=True, check=False)
    assert same_but_for_times(tmp_path / "cluster", tmp_path / "here") == 3
    tables = [pl.read_csv(tmp_path / name / "campaign.csv").drop("wall_s") for name in ("cluster", "here")]
    assert tables[0].equals(tables[1], null_equal=True)


@pytest.mark.slow
def test_a_killed_campaign_is_continued(folder: Path, tmp_path: Path) -> None:
    """At fifty random instants; a campaign that was complete is restarted."""
    out = tmp_path / "out"
    words = [sys.executable, "-m", "railfix", "campaign", str(folder / "campaign.toml"), "--out", str(out)]

    def check_whole() -> None:
        table = pl.read_csv(out / "campaign.csv")
        assert table["status"].to_list() == ["done", "done", "failed", "done"]
        assert table["epochs"].to_list() == [400, 400, None, 200]
        assert list(out.rglob(".railfix-*")) == []

    began = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 5, done.stderr
    assert "4 of 4 runs, 1 failed" in done.stderr
    whole_s = time.perf_counter() - began
    check_whole()
    shutil.rmtree(out)
    random, kills = Random(3), 0
    while kills < 50:
        with subprocess.Popen(words, start_new_session=True, stderr=subprocess.DEVNULL) as process:
            try:
                assert process.wait(random.uniform(0.05, 0.7) * whole_s) == 5
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                kills += 1
                continue
        check_whole()
        shutil.rmtree(out)
    assert subprocess.run(words, capture_output=True).returncode == 5
    check_whole()


def test_an_absolute_pattern_and_a_field_that_is_named_twice_find_the_logs(folder: Path, tmp_path: Path) -> None:
    patterns = {"front": f"{folder}/logs/{{train}}/{{day}}/front.obs", "nav": "nav/{day}.nav", "track": ["line.csv"]}
    (folder / "absolute.toml").write_text("\n".join(f"{name} = {json.dumps(text)}" for name, text in patterns.items()))
    runs = read_campaign(folder / "absolute.toml", tmp_path)
    assert dict(runs[0].fields) == {"train": "A", "day": "2024-03-05"}
    assert len(runs) == 4
    (tmp_path / "A" / "x").mkdir(parents=True)
    for name in ("A/A.obs", "A/B.obs", "n.nav", "t.csv"):
        (tmp_path / name).write_text("")
    (tmp_path / "c.toml").write_text('front = "{train}/{train}.obs"\nnav = "n.nav"\ntrack = ["t.csv"]\n')
    assert [dict(run.fields) for run in read_campaign(tmp_path / "c.toml", tmp_path)] == [{"train": "A"}]


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("in/{a}{b}.obs", "put a character between the two fields"),
        ("in/**{run}", r"\*\* is not supported; write a \* for each folder"),
        ("in/{1}.obs", r"the field \{1\} has to begin with a letter"),
    ],
)
def test_a_pattern_that_cannot_be_read_is_named(tmp_path: Path, pattern: str, words: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f'front = "{pattern}"\nnav = "n.nav"\ntrack = ["t.csv"]\n')
    with pytest.raises(SettingsError, match=words):
        read_campaign(path, tmp_path)

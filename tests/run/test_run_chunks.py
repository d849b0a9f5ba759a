"""Aligned chunks of several antennas, and the folder that gets all files at once or none."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from railfix.core.errors import OutputError
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations
from railfix.motion.samples import RadarSpeeds, SensorSamples
from railfix.pipeline.result_tables import round_floats
from railfix.run.driver import _screen_chunks
from railfix.run.output import OutputFolder
from railfix.run.sources import align_logs

START = np.datetime64("2026-05-12T03:00:00", "ns")


def log(milliseconds: list[int]) -> Observations:
    time = START + np.array(milliseconds, dtype="timedelta64[ms]")
    shape = (len(time), 1)
    values = np.arange(len(time), dtype=float)[:, None] + 2e7
    return Observations(
        time=time.astype("datetime64[ns]"),
        satellite=np.array(["G01"]),
        signal=np.array(["1C"]),
        code_m=values,
        phase_cycles=values,
        doppler_hz=values,
        cn0_dbhz=values,
        loss_of_lock=np.zeros(shape, dtype=np.uint8),
        break_before=np.zeros(len(time), dtype=bool),
    )


def parts(whole: Observations, size: int) -> Iterator[Observations]:
    return (whole[i : i + size] for i in range(0, len(whole), size))


def times(chunks: list[dict[str, Observations]], name: str) -> list[int]:
    return [int((t - START) / np.timedelta64(1, "ms")) for c in chunks if name in c for t in c[name].time]


@given(
    front=st.sets(st.integers(0, 60), max_size=40),
    rear=st.sets(st.integers(0, 60), max_size=40),
    sizes=st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_every_epoch_comes_once_and_in_order(front: set[int], rear: set[int], sizes: tuple[int, int]) -> None:
    grids = {"front": sorted(100 * k for k in front), "rear": sorted(100 * k for k in rear)}
    logs = {n: parts(log(grids[n]), size) for n, size in zip(grids, sizes, strict=True)}
    chunks = list(align_logs(logs))
    for name, grid in grids.items():
        assert times(chunks, name) == grid
    # Equal tags of the two antennas stand in the same chunk.
    for chunk in chunks:
        ends = [p.time[[0, -1]] for p in chunk.values() if len(p)]
        assert ends, "a chunk without any epoch"
    firsts = [min(p.time[0] for p in c.values() if len(p)) for c in chunks]
    lasts = [max(p.time[-1] for p in c.values() if len(p)) for c in chunks]
    assert all(last < first for last, first in zip(lasts, firsts[1:], strict=False))


def test_tags_a_little_apart_stay_together() -> None:
    front = log([100 * k for k in range(40)])
    rear = log([100 * k + 3 for k in range(40)])
    for chunk in align_logs({"front": parts(front, 7), "rear": parts(rear, 5)}):
        assert len(chunk["front"]) == len(chunk["rear"])


def test_an_antenna_that_starts_late_does_not_pile_up() -> None:
    front, rear = log(list(range(0, 1000))), log(list(range(900, 1900)))
    read: list[int] = []

    def watched(whole: Observations) -> Iterator[Observations]:
        for part in parts(whole, 10):
            read.append(len(part))
            yield part

    chunks = align_logs({"front": parts(front, 10), "rear": watched(rear)})
    for _ in range(50):
        next(chunks)
    assert sum(read) <= 20


def test_a_sample_of_a_sensor_goes_to_the_chunk_that_it_came_in() -> None:
    given: list[SensorSamples] = []

    def screened(chunk: Any, state: Any, *, sensors: SensorSamples, **_: Any) -> tuple[Any, Any]:
        given.append(sensors)
        return chunk, state

    whole = log(list(range(0, 9000, 1000)))
    radar = RadarSpeeds(time=START + np.arange(-1500, 10_000, 500).astype("timedelta64[ms]"), speed_mps=np.zeros(23))
    chunks = ({"front": part} for part in parts(whole, 3))
    processor = cast(Any, SimpleNamespace(screen=screened))
    assert len(list(_screen_chunks(chunks, (SensorSamples(radar=radar), None), processor))) == 3
    heard = [seconds(samples.radar.time - START) for samples in given]
    np.testing.assert_array_equal(np.concatenate(heard), np.arange(-1.5, 8.1, 0.5))
    assert [times[-1] for times in heard] == [2.0, 5.0, 8.0]


TABLE = pl.DataFrame(
    {"time_gpst": np.array(["2026-05-12T03:00:00.005"], dtype="datetime64[ns]"), "chainage_m": [None]},
    schema={"time_gpst": pl.Datetime("ns"), "chainage_m": pl.Float64},
)


def test_files_appear_together(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with OutputFolder(out) as folder:
        for _ in range(2):
            folder.append_csv("positions.csv", TABLE)
            folder.append_parquet("positions.parquet", TABLE)
        folder.write_json("run.json", {"a": 1})
        assert [p.name for p in out.iterdir() if not p.name.startswith(".")] == []
        files = folder.commit({"provenance": "x"})
    assert sorted(p.name for p in out.iterdir()) == ["positions.csv", "positions.parquet", "run.json"] == sorted(files)
    assert (out / "positions.csv").read_text() == (
        "time_gpst,chainage_m\n2026-05-12T03:00:00.005000000,\n2026-05-12T03:00:00.005000000,\n"
    )
    assert pl.read_parquet(files["positions.parquet"]).equals(pl.concat([TABLE, TABLE]))
    assert pl.read_parquet_metadata(files["positions.parquet"])["provenance"] == "x"
    assert json.loads(files["run.json"].read_text()) == {"a": 1}


def rows(count: int, seed: int) -> pl.DataFrame:
    """Rows of which no two are alike, so that a file of them is as large as they are."""
    numbers = np.random.default_rng(seed).normal(size=(count, 2))
    return pl.DataFrame({"antenna": ["front"] * count, "chainage_m": numbers[:, 0], "along_sigma_m": numbers[:, 1]})


def test_rows_are_in_the_parquet_file_before_it_ends(tmp_path: Path) -> None:
    tables = [rows(10_000, seed) for seed in range(60)]
    with OutputFolder(tmp_path / "out") as folder:
        for table in tables:
            folder.append_parquet("positions.parquet", table)
        # No pieces to join at the end, and of 60 tables few wait in memory.
        assert [path.name for path in folder.staging.iterdir()] == ["positions.parquet"]
        staged, written, before = folder.staging / "positions.parquet", 0, -1
        while written != before:  # the thread that writes may be behind
            time.sleep(0.3)
            before, written = written, staged.stat().st_size
        folder.end_parquet({"provenance": "x"})
        assert folder.scan("positions.parquet").select(pl.len()).collect().item() == 600_000
        file = folder.commit()["positions.parquet"]
    assert written > 0.7 * file.stat().st_size
    assert pl.read_parquet(file).equals(pl.concat(tables))
    groups = pq.ParquetFile(file)
    assert groups.metadata.metadata[b"provenance"] == b"x"
    assert groups.read().to_pydict() == pl.concat(tables).to_dict(as_series=False)


def test_a_table_is_written_again_some_rows_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("railfix.run.output._ROWS", 7)
    seen = []

    def widened(table: pl.DataFrame) -> pl.DataFrame:
        seen.append(len(table))
        return table.with_columns(smoothed_m=pl.col("chainage_m") + 1.0)

    with OutputFolder(tmp_path / "out") as folder:
        for seed in (1, 2):
            folder.append_csv("train.csv", rows(10, seed))
            folder.append_parquet("train.parquet", rows(10, seed))
        folder.change("train", widened)
        files = folder.commit({"provenance": "x"})
    wanted = pl.concat([rows(10, 1), rows(10, 2)]).with_columns(smoothed_m=pl.col("chainage_m") + 1.0)
    assert seen == [7, 7, 6]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["train.csv", "train.parquet"]
    assert pl.read_parquet(files["train.parquet"]).equals(wanted)
    assert pl.read_parquet_metadata(files["train.parquet"])["provenance"] == "x"
    assert pl.read_csv(files["train.csv"]).equals(round_floats(wanted))


def test_an_error_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with pytest.raises(KeyboardInterrupt), OutputFolder(out) as folder:  # noqa: PT012
        folder.append_csv("positions.csv", TABLE)
        folder.append_parquet("positions.parquet", TABLE)
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    assert "positions.parquet" not in {thread.name for thread in threading.enumerate()}


def test_an_error_of_writing_parquet_is_that_of_the_folder(tmp_path: Path) -> None:
    def wrong(name: str) -> None:
        with OutputFolder(tmp_path / "out") as folder:
            folder.append_parquet("positions.parquet", rows(5, 1))
            folder.append_parquet("positions.parquet", rows(5, 1).rename({"chainage_m": name}))
            folder.commit()

    with pytest.raises(OutputError, match=r"positions\.parquet: cannot be written \(rows have the columns"):
        wrong("other")
    wrong("chainage_m")


@pytest.mark.skipif(sys.platform == "win32", reason="files have no limit of size here")
def test_a_full_disk_ends_the_writing_of_parquet(tmp_path: Path) -> None:
    code = """
import resource, signal, sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from test_run_chunks import OutputError, OutputFolder, rows
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))
for tables in (4, 60):  # the footer is what does not fit, or rows long before
    try:
        with OutputFolder(Path(sys.argv[1])) as folder:
            for seed in range(tables):
                folder.append_parquet("positions.parquet", rows(10_000, seed))
            folder.commit()
    except OutputError as error:
        print(error, list(Path(sys.argv[1]).parent.iterdir()))
"""
    command = [sys.executable, "-c", code, str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parent)
    told = done.stdout.splitlines()
    assert len(told) == 2
    for line in told:
        assert "positions.parquet: cannot be written" in line
        assert "File too large" in line
        assert line.endswith("[]")


def test_an_existing_folder_is_refused_or_its_files_replaced(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        OutputFolder(tmp_path)
    with pytest.raises(ValueError, match="stop"), OutputFolder(tmp_path, overwrite="replace") as folder:  # noqa: PT012
        folder.write_json("run.json", {})
        raise ValueError("stop")
    assert (tmp_path / "run.json").read_text() == "old"
    with OutputFolder(tmp_path, overwrite="replace") as folder:
        folder.write_json("run.json", {})
        folder.commit({})
    assert (tmp_path / "run.json").read_text() == "{}\n"
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="file"):
            OutputFolder(path)

"""Live sessions over logs that do not match each other: epochs without a satellite, other starts, other rates."""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli import app
from railfix.core.timescale import GPS_EPOCH
from railfix.gnss.observations import Observations
from railfix.live import engine, session
from railfix.simulate.demonstration import demo_files
from ubx_made import log_of, rawx

pytestmark = pytest.mark.requirement("A8")
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def epochs() -> dict[str, Observations]:
    """The first half minute of the demonstration, 10 Hz, antenna by antenna."""
    return {name: railfix.read_observations(demo_files()[name])[:300] for name in ("front", "rear")}


def words(front: Path, rear: Path, out: Path) -> list[str]:
    """Inputs and results folder of a command on two logs."""
    files = demo_files()
    return [
        *("--front", str(front), "--rear", str(rear), "--nav", str(files["nav"]), "--track", str(files["track"])),
        *("--vehicle", str(files["vehicle"]), "--out", str(out)),
    ]


def assert_live_is_run(logs: dict[str, bytes], folder: Path, *choices: str) -> str:
    """Assert that `railfix live` and `railfix run` have the same tables of two logs; return what live says."""
    paths = {name: folder / f"{name}.ubx" for name in logs}
    for name, data in logs.items():
        paths[name].write_bytes(data)
    batch = RUNNER.invoke(app, ["run", *words(paths["front"], paths["rear"], folder / "run")])
    assert batch.exit_code == 0, batch.output
    command = ["live", *words(paths["front"], paths["rear"], folder / "live"), "--send", f"json@{folder / 'm.json'}"]
    live = RUNNER.invoke(app, [*command, *choices])
    assert live.exit_code == 0, live.output
    for table in ("positions", "train"):
        expected, got = (pl.read_parquet(folder / kind / f"{table}.parquet") for kind in ("run", "live"))
        assert got.select("time_gpst", "antenna").equals(expected.select("time_gpst", "antenna"))
        np.testing.assert_allclose(got["chainage_m"], expected["chainage_m"], atol=1e-6)
    return live.output


def without_satellites(log: Observations, first: int, last: int) -> Observations:
    """A log whose receiver goes on sending epochs in a tunnel, without a satellite."""
    code = np.array(log.code_m)
    code[first:last] = np.nan
    return replace(log, code_m=code)


@pytest.mark.slow
def test_epochs_without_a_satellite_of_two_antennas(epochs: dict[str, Observations], tmp_path: Path) -> None:
    """RXM-RAWX with no measurement, from both receivers and from one: as in the log."""
    logs = {name: log[:60] for name, log in epochs.items()}
    front, rear = without_satellites(logs["front"], 20, 40), without_satellites(logs["rear"], 25, 45)
    assert_live_is_run({"front": log_of(front), "rear": log_of(rear)}, tmp_path)


def test_logs_that_begin_apart(epochs: dict[str, Observations], tmp_path: Path) -> None:
    """The rear log begins 15 s after the front one: its epochs wait for their pairs, none is lost; no message more."""
    said = assert_live_is_run({"front": log_of(epochs["front"]), "rear": log_of(epochs["rear"][150:])}, tmp_path)
    assert "epochs paired: 150" in said.replace("\n", " ")
    assert "too many waiting" not in said
    assert "300 messages" in said
    assert "no_input" not in said


@pytest.mark.slow
def test_logs_of_different_rates(
    epochs: dict[str, Observations], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Front 10 Hz, rear 2 Hz: 60 pairs, also where far fewer epochs may wait."""
    monkeypatch.setattr(engine, "_LONGEST_QUEUE", 20)
    monkeypatch.setattr(session, "_LONGEST_QUEUE", 8)
    rear = b"".join(rawx(epochs["rear"], k) for k in range(0, 300, 5))
    assert "epochs paired: 60" in assert_live_is_run({"front": log_of(epochs["front"]), "rear": rear}, tmp_path)


@pytest.mark.slow
def test_the_end_of_a_paced_replay_has_its_message(epochs: dict[str, Observations], tmp_path: Path) -> None:
    """Epochs that wait for their pair or period where the logs end: all have rows, the newest has a message."""
    logs = {"front": log_of(epochs["front"][:30]), "rear": log_of(epochs["rear"][:29])}
    choices = ["--speed", "20", "--live", "period_s=60", "--live", "pair_wait_s=10"]
    said = assert_live_is_run(logs, tmp_path, *choices)
    assert "epochs front alone: 1" in said
    times = [json.loads(line)["time_ns"] for line in (tmp_path / "m.json").read_text().splitlines()]
    last = int((epochs["front"].time[29] - GPS_EPOCH).astype(np.int64))
    assert times[-1] == last


@pytest.mark.parametrize("speed", [5.0, 10.0])
def test_a_pace_counts_from_the_earlier_log(speed: float) -> None:
    """The file that is read first begins 2 s after the other one: it waits for these 2 s, divided by the speed."""

    async def waits() -> dict[str, float]:
        pace, began, took = session._Pace(speed, ["front", "rear", "empty"]), time.monotonic(), {}

        async def one(name: str, tag: str) -> None:
            await pace.wait(name, np.datetime64(tag, "ns"))
            took[name] = time.monotonic() - began

        async def no_epoch() -> None:
            pace.ended("empty")

        await asyncio.gather(one("front", "2024-03-05T03:10:02"), one("rear", "2024-03-05T03:10:00"), no_epoch())
        return took

    took = asyncio.run(waits())
    assert took["rear"] < 0.1
    assert 2.0 / speed - 0.01 < took["front"] < 2.0 / speed + 0.2


@pytest.mark.parametrize("option", ["send", "state", "log", "link"])
@pytest.mark.parametrize("role", ["front", "nav", "track", "vehicle"])
def test_no_output_replaces_an_input(tmp_path: Path, option: str, role: str) -> None:
    """Not even with --overwrite, nor under another name."""
    files = {name: tmp_path / path.name for name, path in demo_files().items()}
    for name, path in demo_files().items():
        files[name].write_bytes(path.read_bytes())
    before = files[role].read_bytes()
    target = tmp_path / "link" if option == "link" else files[role]
    if option == "link":
        target.symlink_to(files[role])
    command = ["live", "--front", str(files["front"]), "--nav", str(files["nav"]), "--track", str(files["track"])]
    command += ["--vehicle", str(files["vehicle"]), "--overwrite"]
    command += {"state": ["--state", str(target)], "log": ["--log", str(target)]}.get(
        option, ["--send", f"json@{target}"]
    )
    ended = RUNNER.invoke(app, command)
    assert ended.exit_code == 8
    assert "is an input, which is never overwritten" in " ".join(ended.output.split())
    assert files[role].read_bytes() == before


def test_two_outputs_have_two_files(tmp_path: Path) -> None:
    """The state in place of the messages, or two forms in one file."""
    files, target = demo_files(), tmp_path / "a"
    command = ["live", "--front", str(files["front"]), "--track", str(files["track"]), "--send", f"json@{target}"]
    for more in (["--state", str(target)], ["--log", str(target)], ["--send", f"nmea@{target}"]):
        ended = RUNNER.invoke(app, [*command, *more, "--overwrite"])
        assert ended.exit_code == 8
        assert "given for two outputs" in " ".join(ended.output.split())
        assert not target.exists()

"""State file of a live session: continued with it or without, never with a stale one in silence."""

from __future__ import annotations

import io
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import railfix
from live_kills import count_sessions, kill_sessions
from railfix.cli import app
from railfix.core.errors import OutputError
from railfix.io.train_message import from_json
from railfix.live.engine import EngineState, LiveEngine
from railfix.live.settings import LiveSettings
from railfix.live.state import SavedSession, belongs_to, load_state, write_state
from railfix.live.stream import Sensed, single_epochs
from railfix.motion.samples import RadarSpeeds, SensorSamples
from railfix.pipeline.processor_state import State
from railfix.simulate.demonstration import demo_files
from ubx_made import log_of

pytestmark = pytest.mark.requirement("A8")
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})
SPLIT, EPOCHS = 30, 50


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A log of 5 s, its first 3 s, the rest, and the rest after a gap of two minutes."""
    folder, observations = tmp_path_factory.mktemp("logs"), railfix.read_observations(demo_files()["front"])
    pieces = {
        "whole": observations[:EPOCHS],
        "first": observations[:SPLIT],
        "rest": observations[SPLIT:EPOCHS],
        "late": observations[SPLIT + 1200 : EPOCHS + 1200],
    }
    paths = {}
    for name, piece in pieces.items():
        assert len(piece) > 0
        paths[name] = folder / f"{name}.ubx"
        paths[name].write_bytes(log_of(piece))
    return paths


def live(
    log: Path, folder: Path, name: str, *words: str, track: Path | None = None
) -> tuple[pl.DataFrame, list[int], str]:
    """Rows of the filter, sequence numbers of the messages, and what was logged."""
    files, out = demo_files(), folder / name
    command = ["live", "--front", str(log), "--track", str(track or files["track"]), "--vehicle", str(files["vehicle"])]
    command += ["--nav", str(files["nav"]), "--out", str(out), "--live", "no_input=skip"]
    command += ["--log", str(folder / f"{name}.log")]
    done = RUNNER.invoke(app, [*command, "--send", f"json@{folder / name}.jsonl", *words])
    assert done.exit_code == 0, done.output
    numbers = [from_json(line).sequence for line in (folder / f"{name}.jsonl").read_text().splitlines()]
    return pl.read_parquet(out / "train.parquet"), numbers, (folder / f"{name}.log").read_text()


@pytest.mark.every(3)
def test_a_restart_continues_as_without_one(parts: dict[str, Path], tmp_path: Path) -> None:
    """Filter and sequence of two sessions with a state file are those of one session over the whole log."""
    state = ["--state", str(tmp_path / "state")]
    whole, _, _ = live(parts["whole"], tmp_path, "whole")
    first, numbers, told = live(parts["first"], tmp_path, "first", *state)
    assert "not found; positioning starts" in told
    rest, later, told = live(parts["rest"], tmp_path, "rest", *state)
    assert "positioning continues 0.1 s after" in told
    assert later == list(range(numbers[-1] + 1, numbers[-1] + 1 + EPOCHS - SPLIT))
    both = pl.concat([first, rest])
    assert both["status"].to_list() == whole["status"].to_list()
    assert "tracking" in both["status"].to_list()[SPLIT:]
    for name in ("chainage_m", "along_sigma_m", "speed_mps", "branch_probability"):
        assert np.array_equal(both[name].to_numpy(), whole[name].to_numpy(), equal_nan=True), name
    without, _, _ = live(parts["rest"], tmp_path, "without")
    assert not np.array_equal(without["along_sigma_m"].to_numpy(), rest["along_sigma_m"].to_numpy(), equal_nan=True)


@pytest.mark.slow
def test_a_state_that_does_not_belong_is_not_used(parts: dict[str, Path], tmp_path: Path) -> None:
    """Too old, another map, other settings, damaged: told, and the positions are those of a fresh start."""
    path = tmp_path / "state"
    live(parts["first"], tmp_path, "first", "--state", str(path))
    kept = path.read_bytes()
    fresh, _, _ = live(parts["rest"], tmp_path, "fresh")
    other = tmp_path / "track.csv"
    other.write_bytes(demo_files()["track"].read_bytes() + b"\n")
    cases = {
        "map": (kept, [], other, "was made with another track 0"),
        "settings": (kept, ["--set", "largest_sigma_m=19"], None, "was made with another settings"),
        "damaged": (kept[:-1], [], None, "is damaged or cut off"),
        "changed": (kept[:-1] + bytes([kept[-1] ^ 1]), [], None, "is damaged or cut off"),
        "empty": (b"", [], None, "is not a state file of this version"),
        "older": (kept.replace(b"live state 5", b"live state 4", 1), [], None, "is not a state file of this version"),
    }
    for name, (content, words, track, says) in cases.items():
        path.write_bytes(content)
        rows, numbers, told = live(parts["rest"], tmp_path, name, "--state", str(path), *words, track=track)
        assert f"not used, because it {says}; positioning restarts" in told, name
        assert numbers[0] == 1
        if not words:
            assert np.array_equal(rows["chainage_m"].to_numpy(), fresh["chainage_m"].to_numpy(), equal_nan=True), name
    path.write_bytes(kept)
    rows, numbers, told = live(parts["late"], tmp_path, "late", "--state", str(path))
    late, _, _ = live(parts["late"], tmp_path, "late alone")
    assert "sequence number of the file are used, because the file's last epoch is 120.1 s before" in told
    assert numbers[0] == SPLIT + 1
    assert np.array_equal(rows["chainage_m"].to_numpy(), late["chainage_m"].to_numpy(), equal_nan=True)
    path.write_bytes(kept)
    _, _, told = live(parts["first"], tmp_path, "again", "--state", str(path))
    assert "last epoch is 2.9 s after the first new epoch; it may be at most 60 s before" in told


@pytest.mark.slow
def test_no_number_is_sent_twice_after_a_crash(tmp_path: Path) -> None:
    """Killed at any moment, also before the first message; each session has positions within their bounds."""
    counted, lost, first = count_sessions(kill_sessions(tmp_path, 5, seed=4))
    assert not any(lost.values()), lost
    assert counted["messages"] >= 10
    assert counted["continued"] >= 2
    assert max(first) <= 2


def test_a_file_that_is_no_state_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    for content in (b"hello", b'{"form": "minutes"}', b"[1]"):
        path.write_bytes(content)
        with pytest.raises(OutputError, match="is not a state file of railfix live, but would be overwritten"):
            load_state(path, {})
        assert path.read_bytes() == content


def test_a_state_of_another_commit_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fields of its classes may have other names there."""
    path = tmp_path / "state"
    saved = SavedSession(engine=EngineState(state=State(), done_ns=1, last_tag={}, sequence=1), streams={})
    write_state(path, saved, belongs_to({}, {}, ("front",)))
    assert load_state(path, belongs_to({}, {}, ("front",))).session == saved
    monkeypatch.setattr("railfix.live.state.source_commit", lambda: "another")
    loaded = load_state(path, belongs_to({}, {}, ("front",)))
    assert loaded.session is None
    assert "was made with another version" in loaded.outcome


class Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        import os

        return os.system, ("echo evil",)


def archive(tree: object, **arrays: np.ndarray) -> bytes:
    """A NumPy archive as a state has it, of any content."""
    file = io.BytesIO()
    np.savez(file, tree=np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8), **arrays)
    return file.getvalue()


def objects() -> bytes:
    """An archive whose array is one of objects, pickled by NumPy: the way into a program."""
    file = io.BytesIO()
    np.savez(file, tree=np.frombuffer(b'{"array": 0}', dtype=np.uint8), a0=np.array([Evil()], dtype=object))
    return file.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        pickle.dumps(Evil()),
        objects(),
        archive({"of": "os:system", "fields": {}}),
        archive({"of": "railfix.live.state:os.system", "fields": {}}),
        archive({"of": "railfix.live.state:Path", "fields": {}}),
        archive({"of": "railfix.run.output:OutputFolder", "fields": {"path": "/tmp/x"}}),
        archive({"tuple of": "railfix.live.state:json", "values": []}),
        archive({"enum": "railfix.core.reasons:Reason", "value": "a"}),
        archive({"of": "railfix.live.state:SavedSession", "fields": {"nothing": 1}}),
        archive({"code": "1"}),
        archive("text"),
        b"",
    ],
)
def test_only_values_of_the_package_are_read(tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    """A file with a valid head whose content would run a program, or is of something else."""
    import hashlib

    path, under = tmp_path / "state", {"settings": "x"}
    saved = SavedSession(engine=EngineState(state=State(), done_ns=1, last_tag={}, sequence=1), streams={})
    write_state(path, saved, under)
    assert load_state(path, under).session == saved
    head = {"form": "railfix live state 5", **under, "bytes": len(content)}
    head["sha256"] = hashlib.sha256(content).hexdigest()
    path.write_bytes(json.dumps(head).encode() + b"\n" + content)
    loaded = load_state(path, under)
    assert loaded.session is None
    assert "contains no state" in loaded.outcome
    assert "evil" not in capfd.readouterr().out
    assert sorted(tmp_path.iterdir()) == [path]


def test_everything_that_positions_depend_on_is_in_the_hash(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_text("1")
    first = belongs_to({"track 0": file}, {"settings": railfix.Config()}, ("front",))
    file.write_text("2")
    second = belongs_to(
        {"track 0": file}, {"settings": railfix.Config(min_satellites=4)}, ("front", "rear"), base="35,139,40"
    )
    assert {name for name in first if first[name] != second[name]} == {
        "track 0", "settings", "antennas", "position of the base station",
    }  # fmt: skip


@pytest.mark.requirement("A8")
def test_a_receiver_that_comes_back_leaves_nothing_from_before() -> None:
    """Epochs that waited for their pair, and samples of sensors from before, are not used with the older tags."""
    files = demo_files()
    track, vehicle = railfix.read_track([files["track"]]), railfix.read_vehicle(files["vehicle"])
    paths = {name: railfix.antenna_trajectory(track, vehicle, name) for name in ("front", "rear")}
    logs = {name: single_epochs(railfix.read_observations(files[name])[:20]) for name in paths}
    settings = LiveSettings(restart_epochs=3, pair_wait_s=5.0, behind_s=60.0, no_input="skip")
    navigation = railfix.read_navigation(files["nav"])
    engine = LiveEngine(
        railfix.EpochProcessor(railfix.Config(filter="off"), paths, navigation=navigation), settings, ("radar",)
    )
    screen, given = engine.processor.screen, []

    def spied(epochs: Any, *arguments: Any, sensors: SensorSamples, **options: Any) -> Any:
        first = next(iter(epochs))
        given.append((first, epochs[first].time[0], len(sensors.radar)))
        return screen(epochs, *arguments, sensors=sensors, **options)

    engine.processor.screen = spied  # type: ignore[method-assign]
    engine.push("front", logs["front"][9], now_ns=0)
    later = 6_000_000_000
    begin = logs["front"][0].time[0]
    radar = RadarSpeeds(time=begin + np.arange(5, 15) * np.timedelta64(100, "ms"), speed_mps=np.zeros(10))
    engine.add_samples(Sensed(sensor="radar", samples=SensorSamples(radar=radar), until=radar.time[-1]))
    assert len(engine.poll(now_ns=later)) == 1
    for epoch in logs["front"][10:13]:
        engine.push("front", epoch, now_ns=later)
    for k in range(14):
        engine.push("front", logs["front"][k], now_ns=later)
    for k in range(2, 14):
        engine.push("rear", logs["rear"][k], now_ns=later)
    engine.poll(now_ns=later)
    assert engine.counts["restart"] == 1
    expected = [(9, 5), *((k, 0) for k in range(2, 14))]
    assert given == [("front", begin + k * np.timedelta64(100, "ms"), count) for k, count in expected]

"""Prepared lines are kept, found again for the same inputs alone, and rebuilt where they are damaged."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from broken_bench import Bench, bench_in
from railfix.run import prepared, sources
from railfix.run.inputs import TrackReading
from railfix.run.sources import OpenedLine, open_line

EPOCH = np.datetime64("2024-03-05T03:00:00", "ns")


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    (tmp_path / "bench").mkdir()
    return bench_in(tmp_path / "bench")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(prepared.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(prepared, "LEAST_POINTS", 2)
    return tmp_path / "cache"


def opened(bench: Bench, reading: TrackReading | None = None) -> OpenedLine:
    antennas = ("front", "rear")
    return open_line((bench.track,), bench.vehicle, antennas=antennas, reading=reading or TrackReading(), at=EPOCH)


def assert_same(one: OpenedLine, two: OpenedLine) -> None:
    assert one.facts == two.facts
    pairs = [(one.track, two.track), *zip(one.trajectories.values(), two.trajectories.values(), strict=True)]
    for first, second in pairs:
        for item in fields(first):
            np.testing.assert_array_equal(getattr(first, item.name), getattr(second, item.name), err_msg=item.name)
    for name, path in one.trajectories.items():
        np.testing.assert_array_equal(path.up, two.trajectories[name].up)
        np.testing.assert_array_equal(path.across, two.trajectories[name].across)


def test_a_line_is_prepared_once(bench: Bench, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = opened(bench)
    assert len(list(folder.glob("*.npz"))) == 3

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("prepared a second time")

    monkeypatch.setattr(sources, "read_segments", forbidden)
    monkeypatch.setattr(sources, "antenna_trajectory", forbidden)
    assert_same(opened(bench), first)
    with pytest.raises(AssertionError, match="second time"):
        opened(bench, TrackReading(cache="skip"))
    with pytest.raises(AssertionError, match="second time"):
        opened(bench, TrackReading(height_sigma=0.7))
    monkeypatch.setattr(prepared, "__version__", "another")
    with pytest.raises(AssertionError, match="second time"):
        opened(bench)


def test_another_file_is_another_line(bench: Bench, folder: Path) -> None:
    first = opened(bench)
    lines = bench.track.read_text().splitlines(keepends=True)
    bench.track.write_text("".join(lines[:-1]))
    second = opened(bench)
    assert len(second.track) == len(first.track) - 1
    bench.vehicle.write_text(bench.vehicle.read_text().replace("up_m = 3", "up_m = 2"))
    third = opened(bench)
    _, lower_m = third.trajectories["front"].nearest(second.trajectories["front"].ecef_m)
    assert lower_m.min() > 0.9
    assert len(list(folder.glob("*.npz"))) == 8


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "no zip"])
def test_a_damaged_entry_is_rebuilt_and_said(bench: Bench, folder: Path, damage: str) -> None:
    first = opened(bench)
    for entry in folder.glob("*.npz"):
        content = bytearray(entry.read_bytes())
        content[len(content) // 2] ^= 0xFF
        kinds = {"cut": content[: len(content) // 2], "flipped": content, "empty": b"", "no zip": b"not what it was"}
        entry.write_bytes(bytes(kinds[damage]))
    rebuilt = opened(bench)
    assert_same(rebuilt, first)
    assert len(rebuilt.preparing) == 3
    assert all("is damaged; the line was prepared again" in note for note in rebuilt.preparing)
    assert set(rebuilt.preparing) <= set(rebuilt.notes)
    assert opened(bench).preparing == ()


def test_a_folder_that_cannot_be_written_is_said(bench: Bench, folder: Path) -> None:
    folder.write_text("a file")
    line = opened(bench)
    assert line.preparing
    assert all("could not be stored" in note for note in line.preparing if "damaged" not in note)


def test_old_entries_go(bench: Bench, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared, "MOST_ENTRIES", 4)
    for sigma in (0.5, 0.6, 0.7):
        opened(bench, TrackReading(height_sigma=sigma))
    assert len(list(folder.glob("*.npz"))) == 4


def test_short_lines_and_no_cache_leave_nothing(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(prepared.VARIABLE, str(tmp_path / "cache"))
    opened(bench)
    monkeypatch.setattr(prepared, "LEAST_POINTS", 2)
    opened(bench, TrackReading(cache="skip"))
    assert not (tmp_path / "cache").exists()
    assert prepared.cache_folder() == tmp_path / "cache"

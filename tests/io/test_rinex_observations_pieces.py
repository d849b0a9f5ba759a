"""Pieces equal the whole, text comes back as it was written, packed and split files are one log."""

from __future__ import annotations

import gzip
import math
import re
from pathlib import Path

import ncompress
import numpy as np
import pytest
from hatanaka import rnx2crx
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from railfix.core import files
from railfix.core.errors import InputFileError, MismatchError
from railfix.gnss import Observations, concatenate
from railfix.io import read_observations
from railfix.io.epoch_order import EpochOrder
from railfix.io.rinex import observations_decode, scan_observations
from railfix.io.rinex.observations import BlockReader, Selection
from rinex_observations_text import epoch_2, epoch_3, event_2, field, header_2, header_3, record, text_of, write

pytestmark = pytest.mark.requirement("A7")

ARRAYS = ("time", "satellite", "signal", "code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")


def assert_same(first: Observations, second: Observations) -> None:
    """Bit for bit, with what was said about the reading."""
    for name in (*ARRAYS, "break_before"):
        one, other = getattr(first, name), getattr(second, name)
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes(), name
    assert first.problems == second.problems
    assert first.problem_count == second.problem_count
    assert first.skipped == second.skipped


def busy_log_3(epochs: int = 120, *, seed: int = 5) -> list[str]:
    """Satellites that come and go, events, types that change, broken lines, epochs out of order."""
    rng = np.random.default_rng(seed)
    types = {"G": ("C1C", "L1C", "D1C", "S1C", "C5Q", "L5Q"), "E": ("C1C", "L1C"), "R": ("C1C", "S1C")}
    lines = header_3(types)
    for k in range(epochs):
        if k == epochs // 2:
            lines += [*epoch_3("", flag=4, count=1), record("E    3 S1C C5Q L5Q", "SYS / # / OBS TYPES")]
            types = {**types, "E": ("S1C", "C5Q", "L5Q")}
        if k % 31 == 7:
            lines += [*epoch_3("", flag=3, count=1), record("ELSEWHERE", "MARKER NAME")]
        names = [f"{s}{n:02d}" for s in types for n in range(1, 9) if rng.random() < 0.4]
        satellites = {
            name: [
                field(None if rng.random() < 0.2 else rng.normal(0.0, 1e7), rng.choice(["  ", "1 ", " 7", "35"]))
                for _ in types[name[0]]
            ]
            for name in names
        }
        broken = epoch_3(f"02 {k // 60:02d} {k % 60:02d}.0000000", satellites, flag=int(rng.random() < 0.05))
        if rng.random() < 0.1 and len(broken) > 1:
            broken[1] = broken[1][:9] + "?" + broken[1][10:]
        if rng.random() < 0.05:
            broken[0] = broken[0].replace("2021", "2020")
        lines += broken
    return [*lines, *epoch_3("02 59 59.0000000", count=2)]


def busy_log_2(epochs: int = 90, *, seed: int = 6) -> list[str]:
    rng = np.random.default_rng(seed)
    types: tuple[str, ...] = ("L1", "C1", "L2", "P2", "D1", "S1", "S2")
    lines = header_2(types, system="M")
    for k in range(epochs):
        if k == epochs // 2:
            types = ("C1", "L1")
            lines += event_2(4, [record("     2    C1    L1", "# / TYPES OF OBSERV")])
        names = [f"{s}{n:2d}" for s in "GR" for n in range(1, 15) if rng.random() < 0.5]
        satellites = {
            name: [field(None if rng.random() < 0.2 else rng.normal(0.0, 1e7), " 7") for _ in types] for name in names
        }
        epoch = epoch_2(f" 0 {k // 60:2d} {k % 60:2d}.0000000", satellites, flag=int(rng.random() < 0.05))
        lines += epoch[:-1] if rng.random() < 0.05 else epoch
    return lines


@pytest.mark.parametrize("log", [busy_log_3, busy_log_2])
@pytest.mark.parametrize("epochs", [1, 7, 1000])
def test_pieces_are_the_whole(tmp_path: Path, log: type, epochs: int) -> None:
    path = write(tmp_path / "log", log())
    whole = read_observations(path, broken_lines="count")
    pieces = list(scan_observations(path, epochs=epochs, broken_lines="count"))
    assert {len(piece) for piece in pieces[1:-1]} <= {epochs}
    assert len(pieces[0]) <= epochs
    assert 0 < len(pieces[-1]) <= epochs
    assert whole.problem_count > 3
    assert_same(concatenate(pieces), whole)
    for piece in pieces:
        present = np.zeros(len(piece.satellite), dtype=bool)
        for name in ARRAYS[3:-1]:
            present |= np.isfinite(getattr(piece, name)).any(axis=0)
        assert (present | piece.loss_of_lock.any(axis=0)).all()


@pytest.mark.parametrize("log", [busy_log_3, busy_log_2])
@pytest.mark.parametrize("block_bytes", [700, 3000, 20000])
def test_where_blocks_of_text_end_does_not_matter(tmp_path: Path, log: type, block_bytes: int) -> None:
    path = write(tmp_path / "log", log(), strip=block_bytes != 3000, end="\r\n" if block_bytes == 700 else "\n")
    wanted = Selection(broken_lines="count")
    runs = list(EpochOrder("count").ordered(BlockReader(path, wanted, block_bytes=block_bytes).blocks()))
    assert len(runs) > 2
    joined = concatenate([run for run in runs if len(run)])
    whole = read_observations(path, broken_lines="count")
    for name in (*ARRAYS, "break_before"):
        assert getattr(joined, name).tobytes() == getattr(whole, name).tobytes(), name
    assert sum(run.problem_count for run in runs) == whole.problem_count


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("flag", [2, 3])
@pytest.mark.parametrize("types", [["C1C", "C1C"], ["C1C", "C1W"]], ids=["same types", "other types"])
def test_a_break_is_kept_where_a_block_ends_after_the_event(tmp_path: Path, flag: int, types: list[str]) -> None:
    """Antenna moving, or another place: no epoch after it is differenced with one before it, nor where types change."""
    lines = header_3({"G": ("C1C",)})
    for k in range(8):
        lines += epoch_3(f"02 33 {k:2d}.0000000", {"G01": [field(2e7 + k)], "G02": [field(2.1e7)]})
        lines += (
            [f"> {'':28} {flag}  1", record(f"G    1 {types[k // 2 % 2 - 1]}", "SYS / # / OBS TYPES")] if k % 2 else []
        )
    path = write(tmp_path / "log", lines)
    expected = [False, False, True, False, True, False, True, False]
    assert read_observations(path).break_before.tolist() == expected
    for block_bytes in range(60, 160, 7):
        runs = (run for _, run, _ in BlockReader(path, Selection(), block_bytes=block_bytes).blocks())
        found = [bool(broken) for run in runs for broken in run.break_before]
        assert found == expected, block_bytes


@pytest.mark.requirement("A7")
def test_fields_of_an_unusual_form_are_scaled_like_the_others(tmp_path: Path) -> None:
    lines = header_3({"G": ("C1C", "L1C")}, extra=[record("G  100   1 C1C", "SYS / SCALE FACTOR")])
    lines += epoch_3("02 33 13.0000000", {"G01": [field(2345678912.0), field(1.5)]})
    lines += epoch_3("02 33 14.0000000", {"G01": [field(" 2345678912.50"), field("         1.5e0")]})
    found = read_observations(write(tmp_path / "log", lines))
    assert found.code_m[:, 0].tolist() == [23456789.12, 23456789.125]
    assert found.phase_cycles[:, 0].tolist() == [1.5, 1.5]


@pytest.mark.parametrize(
    "pack",
    {
        "gz": gzip.compress,
        "Z": lambda text: ncompress.compress(text),
        "crx": rnx2crx,
        "crx.gz": lambda text: gzip.compress(rnx2crx(text)),
        "crx.Z": lambda text: ncompress.compress(rnx2crx(text)),
        "gz of two members": lambda text: gzip.compress(text[:999]) + gzip.compress(text[999:]),
    }.items(),
    ids=lambda item: item[0],
)
@pytest.mark.parametrize("version", [2, 3])
def test_packed_files_are_told_by_content(tmp_path: Path, pack: tuple, version: int) -> None:
    one = [field(2e7 + 1 / 3), field(1e8, "1 "), field(-1.5)]
    lines = header_3({"G": ("C1C", "L1C", "D1C")}) if version == 3 else header_2(("C1", "L1", "D1"))
    for k in range(40):
        satellites = {f"G{n:02d}": one for n in range(1 + k // 9, 15)}
        clock = f"02 33 {k:02d}.0050000"
        lines += epoch_3(clock, satellites) if version == 3 else epoch_2(clock, satellites)
    plain = read_observations(write(tmp_path / "plain.gz", lines))  # the name says nothing
    path = tmp_path / "log.obs"
    path.write_bytes(pack[1](text_of(lines)))
    assert_same(read_observations(path), plain)
    assert files.read_bytes(path).decode().split() == (tmp_path / "plain.gz").read_text().split()
    assert files.read_text_lines(path)[0].startswith(f"     {'3.04' if version == 3 else '2.11'}")


def test_streams_may_be_left_early(tmp_path: Path) -> None:
    path = tmp_path / "log.crx"
    path.write_bytes(rnx2crx(text_of(header_3() + [line for k in range(60) for line in _epoch(k)])))
    with files.open_stream(path) as stream:
        assert len(stream.read(100)) == 100
    assert stream.closed
    first = next(scan_observations(path, epochs=5))
    assert 1 <= len(first) <= 5


def _epoch(k: int, *, minute: int = 33) -> list[str]:
    return epoch_3(f"02 {minute} {k:02d}.0000000", {"G05": [field(2e7 + k)], f"G{10 + k % 3}": [field(2e7)]})


def _file(
    folder: Path, name: str, seconds: range, *, minute: int = 33, interval: str = "     1.000", slot: str = "R05  1"
) -> Path:
    extra = [record(interval, "INTERVAL"), record(f"  1 {slot}", "GLONASS SLOT / FRQ #")] if interval else []
    lines = header_3({"G": ("C1C",)}, extra=extra)
    return write(folder / name, lines + [line for k in seconds for line in _epoch(k, minute=minute)])


@pytest.mark.parametrize("interval", ["     1.000", ""])
def test_files_of_a_log_are_joined_in_order_of_time(tmp_path: Path, interval: str) -> None:
    whole = read_observations(_file(tmp_path, "whole", range(20)))
    parts = [_file(tmp_path, n, r, interval=interval, slot=s) for n, r, s in
             (("c", range(13, 20), "R07 -7"), ("a", range(6), "R05  1"), ("b", range(6, 13), "R06  2"))]  # fmt: skip
    joined = read_observations(parts)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))
    assert not joined.break_before.any()
    if interval:
        assert joined.header.glonass_channel == {"R05": 1, "R06": 2, "R07": -7}
    later = _file(tmp_path, "later", range(0, 9), minute=35, interval=interval)
    gap = read_observations([later, *parts])
    assert np.flatnonzero(gap.break_before).tolist() == [20]
    for epochs in (1, 7, 1000):
        assert_same(concatenate(list(scan_observations([later, *parts], epochs=epochs))), gap)


def test_files_that_overlap(tmp_path: Path) -> None:
    parts = [_file(tmp_path, "a", range(12)), _file(tmp_path, "b", range(8, 20))]
    for order in (parts, parts[::-1]):
        joined = read_observations(order)
        assert (joined.time - joined.time[0]).astype("m8[s]").astype(int).tolist() == list(range(20))
        assert joined.skipped == {"duplicate epochs": 4}
        assert not joined.break_before.any()
    assert len(read_observations([parts[0], parts[0]])) == 12
    long = [_file(tmp_path, "c", range(60)), _file(tmp_path, "d", range(10, 60))]
    assert read_observations(long).skipped == {"duplicate epochs": 50}


def test_a_file_without_epochs_among_several(tmp_path: Path) -> None:
    parts = [_file(tmp_path, "a", range(5)), _file(tmp_path, "empty", range(0))]
    with pytest.raises(InputFileError, match=r"empty: has a header but no epochs"):
        read_observations(parts)
    assert len(read_observations(parts, broken_lines="count")) == 5


#: What F14.3 can hold.
THOUSANDTHS = st.integers(-999_999_999_999, 9_999_999_999_999)
CHARACTERS = st.sampled_from(" -+.0123456789?Ee_")
NUMBER = re.compile(r" *[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d{1,2})?")
STANDARD = THOUSANDTHS.map(lambda n: f"{n / 1000:14.3f}")


TAILS = st.text(st.sampled_from(" 019x"), min_size=2, max_size=2)
TEXTS = st.tuples(STANDARD | st.text(CHARACTERS, min_size=14, max_size=14), TAILS)


@settings(max_examples=100)
@given(st.lists(TEXTS, min_size=1, max_size=12), st.integers(0, 16))
@example([("             -", "  "), ("         -.500", "  "), ("        - .500", "  "), ("  ,     1.500 ", "  ")], 16)
@example([("       5  .500", "  "), ("      ,5.500  ", "  "), ("     ,   1.500", "  "), ("     =   1.500", "  ")], 16)
@example([("9999999999.999", "99"), ("-999999999.999", "0 "), ("          .001", " 9"), ("1.0e5         ", "  ")], 14)
def test_fields_equal_float_of_their_text(texts: list[tuple[str, str]], cut: int) -> None:
    line = "".join(number + tail for number, tail in texts)
    line = line[: len(line) - 16 + cut]
    data = np.frombuffer(line.encode() + b"\n9" + b" " * observations_decode.PADDING, dtype=np.uint8)
    arguments = (data, np.zeros(1, dtype=np.int64), np.array([len(line)]), np.arange(len(texts)), np.ones(len(texts)))
    value, lock, bad = observations_decode.read_fields(*arguments)
    for k in range(len(texts)):
        text = f"{line[16 * k : 16 * k + 16]:<16}"
        good = (not text[:14].strip() or NUMBER.fullmatch(text[:14])) and re.fullmatch("[ 0-9]{2}", text[14:])
        assert bool(bad[0, k]) == (not good)
        if good and text[:14].strip():
            assert value[0, k] == float(text[:14])
            assert math.copysign(1.0, value[0, k]) == math.copysign(1.0, float(text[:14]))
        elif good:
            assert np.isnan(value[0, k])
        if good:
            assert lock[0, k] == int(text[14].strip() or 0)


VALUES = st.none() | THOUSANDTHS.filter(bool).map(lambda n: n / 1000)
LOCKS = st.sampled_from(" 01234567")
SATELLITE = st.tuples(st.sampled_from("GRECJSI"), st.integers(1, 99)).map(lambda t: f"{t[0]}{t[1]:02d}")
EPOCH = st.dictionaries(SATELLITE, st.lists(st.tuples(VALUES, LOCKS), min_size=4, max_size=4), max_size=15)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(epochs=st.lists(EPOCH, min_size=1, max_size=6), strip=st.booleans(), old=st.booleans())
def test_what_is_written_is_read(tmp_path: Path, epochs: list[dict], strip: bool, old: bool) -> None:
    systems = "GRECJSI" if not old else "GRECJS"
    epochs = [{name: row for name, row in epoch.items() if name[0] in systems} for epoch in epochs]
    names = ("C1", "L1", "D1", "S1") if old else ("C1C", "L1C", "D1C", "S1C")
    names = tuple(names)
    lines = header_2(names, system="M") if old else header_3(dict.fromkeys(systems, names))
    for k, epoch in enumerate(epochs):
        satellites = {n: [field(v, lock + " ") for v, lock in row] for n, row in epoch.items()}
        clock = f"02 33 {10 + k}.0050001"
        lines += epoch_2(clock, satellites) if old else epoch_3(clock, satellites)
    observations = read_observations(write(tmp_path / "log", lines, strip=strip))
    assert len(observations) == len(epochs)
    column = {str(s): i for i, s in enumerate(observations.satellite)}
    arrays = [getattr(observations, name) for name in ARRAYS[3:7]]
    expected = [np.full(a.shape, np.nan) for a in arrays]
    lock = np.zeros_like(observations.loss_of_lock)
    for k, epoch in enumerate(epochs):
        for name, row in epoch.items():
            if name not in column:
                assert all(v is None for v, _ in row)
                continue
            for j, (value, _) in enumerate(row):
                expected[j][k, column[name]] = np.nan if value is None else float(f"{value:14.3f}")
            lock[k, column[name]] = int(row[1][1].strip() or 0)
    for array, wanted in zip(arrays, expected, strict=True):
        np.testing.assert_array_equal(array, wanted)
    np.testing.assert_array_equal(observations.loss_of_lock, lock)


@pytest.mark.requirement("G5")
def test_logs_of_one_antenna_years_apart_are_not_one_run(tmp_path: Path) -> None:
    epoch = epoch_3("02 33 13.0050000", {"G05": [field(2e7), field(1e8), field(1.0), field(40.0)]})
    paths = [tmp_path / "first.obs", tmp_path / "later.obs"]
    for path, year in zip(paths, (b"2021", b"2024"), strict=True):
        path.write_bytes(text_of([*header_3(), *epoch]).replace(b"2021", year))
    with pytest.raises(
        MismatchError, match=r"first.obs begins at 2021-05-17T02:33:13 and .*later.obs at 2024.* 1,096 d"
    ):
        read_observations(paths)

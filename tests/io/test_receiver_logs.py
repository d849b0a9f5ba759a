"""Receiver logs: values against RTKLIB's, cuts and damage, protocols mixed, logs in place of RINEX."""

from __future__ import annotations

import datetime
import gzip
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import railfix
import ubx_made
from pipeline_cases import demo_observations
from railfix.core.checksums import crc24q
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.errors import InputFileError, MismatchError
from railfix.gnss import Observations, concatenate
from railfix.io import rinex
from railfix.io.receiver.framing import find_frames
from railfix.io.receiver.log import StreamState, decode
from railfix.io.receiver.measurements import Tracking, join_observations
from ubx_made import log_of

pytestmark = pytest.mark.requirement("A8")

COLD_START = "16dBatt_no_interference_coldstart.ubx.gz"
TWO_BANDS = "F9T-L2-5min.ubx.gz"
RTCM = "idd2023229c.rtc.gz"
NUMBERS = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz")


@pytest.fixture(scope="module", params=[COLD_START, TWO_BANDS], ids=["cold start", "two bands"])
def ubx(request: pytest.FixtureRequest, recordings: Path) -> Path:
    return recordings / "live" / request.param


def program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} (Debian package rtklib) is not installed")
    return found


def unpacked(path: Path, folder: Path) -> Path:
    target = folder / path.name.removesuffix(".gz")
    target.write_bytes(gzip.decompress(path.read_bytes()))
    return target


def channels(observations: Observations) -> list[tuple[str, str]]:
    return list(zip(observations.satellite.tolist(), observations.signal.tolist(), strict=True))


def convbin(source: Path) -> tuple[Path, Path]:
    """RINEX observation and navigation files that RTKLIB makes of a UBX log."""
    observations, navigation = source.with_suffix(".obs"), source.with_suffix(".nav")
    words = [program("convbin"), *"-r ubx -od -os -f 5 -v 3.04".split(), "-o", observations, "-n", navigation, source]
    subprocess.run([str(word) for word in words], capture_output=True, check=True, timeout=120)
    return observations, navigation


def test_ubx_observations_are_those_of_rtklib(ubx: Path, tmp_path: Path) -> None:
    """Every value of the channels that both have: absent in both, or within what RINEX rounds to."""
    ours, theirs = (railfix.read_observations(path) for path in (ubx, convbin(unpacked(ubx, tmp_path))[0]))
    assert len(ours) == len(theirs)
    assert np.abs((ours.time - theirs.time).astype(np.int64)).max() <= 50  # RINEX has 100 ns
    common = [c for c in channels(theirs) if c in channels(ours)]
    mine, others = [channels(ours).index(c) for c in common], [channels(theirs).index(c) for c in common]
    for name in NUMBERS:
        a, b = getattr(ours, name)[:, mine], getattr(theirs, name)[:, others]
        assert np.isfinite(b).sum() > 9_000
        assert np.array_equal(np.isnan(a), np.isnan(b)), name
        assert np.nanmax(np.abs(a - b)) <= 0.00062, name


def test_ubx_ephemerides_are_those_of_rtklib(recordings: Path, tmp_path: Path) -> None:
    log = recordings / "live" / COLD_START
    ours = railfix.read_navigation(log).kepler
    theirs = rinex.read_navigation(convbin(unpacked(log, tmp_path))[1]).kepler
    keys = [list(zip(k.satellite.tolist(), k.toe.tolist(), k.iode.tolist(), strict=True)) for k in (ours, theirs)]
    common = [key for key in keys[1] if key in keys[0]]
    assert len(common) >= 9
    mine, others = [keys[0].index(key) for key in common], [keys[1].index(key) for key in common]
    for name in type(ours).__dataclass_fields__:
        x, y = getattr(ours, name)[mine], getattr(theirs, name)[others]
        if x.dtype.kind == "f":
            assert np.allclose(x, y, rtol=1e-11, atol=0.0, equal_nan=True), name
        else:
            assert x.tolist() == y.tolist(), name
    assert sorted(ours.satellite.astype("<U1").tolist()) == ["E"] * 19 + ["G"] * 9


def in_fragments(data: bytes, cuts: list[int], state: StreamState | None = None) -> tuple[Observations, list[object]]:
    """A log decoded as it arrives in fragments."""
    state, tracking = state or StreamState(), Tracking()
    parts, records = [], []
    for first, last in zip([0, *cuts], [*cuts, None], strict=True):
        piece, state = decode(data[first:last], state, at_end=last is None)
        observations, tracking = join_observations(piece.measurements, tracking)
        parts.append(observations)
        found = piece.ephemerides
        records += [
            (r.satellite, r.epoch, at, *r.numbers) for r, at in zip(found.records, found.complete_at, strict=True)
        ]
        records += list(zip(piece.sbas.time.tolist(), piece.sbas.prn.tolist(), piece.sbas.octets.tolist(), strict=True))
    return concatenate(parts), [repr(record) for record in records]


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in range(1, 4))])
def test_a_stream_cut_anywhere_gives_the_same(recordings: Path, seed: int) -> None:
    data = gzip.decompress((recordings / "live" / COLD_START).read_bytes())[:900_000]
    cuts = sorted(np.random.default_rng(seed).integers(1, len(data), 60).tolist())
    whole, records = in_fragments(data, [])
    pieces, records_in_pieces = in_fragments(data, cuts)
    assert sorted(records) == sorted(records_in_pieces)
    assert channels(whole) == channels(pieces)
    for name in ("time", *NUMBERS, "loss_of_lock"):
        assert np.array_equal(
            getattr(whole, name), getattr(pieces, name), equal_nan=name not in ("time", "loss_of_lock")
        ), name


def damaged(data: bytes, seed: int) -> bytes:
    """Bytes flipped, dropped, doubled, put in between, or the end cut off."""
    rng = np.random.default_rng(seed)
    values = bytearray(data)
    for _ in range(int(rng.integers(1, 40))):
        place = int(rng.integers(0, len(values) - 300))
        match int(rng.integers(0, 4)):
            case 0:
                values[place] ^= int(rng.integers(1, 256))
            case 1:
                del values[place : place + int(rng.integers(1, 300))]
            case 2:
                values[place:place] = values[place : place + int(rng.integers(1, 300))]
            case _:
                values[place:place] = rng.integers(0, 256, int(rng.integers(1, 300))).astype(np.uint8).tobytes()
    return bytes(values[: int(rng.integers(len(values) // 2, len(values)))])


def observed(observations: Observations) -> set[tuple[object, ...]]:
    """Every measurement as (time, satellite, signal, values)."""
    names = channels(observations)
    rows = {}
    for t, m in np.argwhere(np.isfinite(observations.cn0_dbhz)).tolist():
        values = [np.nan_to_num(getattr(observations, name)[t, m], nan=-1.0).item() for name in NUMBERS]
        rows[observations.time[t].astype(np.int64).item(), *names[m], *values] = None
    return set(rows)


@pytest.mark.parametrize("block", [0, *(pytest.param(b, marks=pytest.mark.slow) for b in range(1, 10))])
@pytest.mark.slow
def test_damage_gives_no_false_observation(recordings: Path, block: int) -> None:
    """30 variants a block: no exception, nothing observed that the whole log does not have, counts add up."""
    data = gzip.decompress((recordings / "live" / TWO_BANDS).read_bytes())[:120_000]
    whole, _ = in_fragments(data, [])
    true = observed(whole)
    seen = 0
    for seed in range(30 * block, 30 * block + 30):
        broken = damaged(data, seed)
        piece, state = decode(broken, StreamState(), at_end=True)
        observations, _ = join_observations(piece.measurements)
        assert observed(observations) <= true
        assert piece.bytes == len(broken)
        assert state.rest == b""
        frames = find_frames(np.frombuffer(broken, np.uint8))
        overhead = {"ubx": (6, 2), "rtcm3": (3, 3), "sbf": (8, 0), "nmea": (0, 5)}
        inside = sum(
            int(last - first) + sum(overhead[protocol])
            for first, last, protocol in zip(frames.start, frames.end, frames.protocol.tolist(), strict=True)
        )
        assert inside + piece.skipped_bytes == len(broken)
        seen += len(observations)
    assert seen > 100


def test_protocols_in_one_stream(recordings: Path) -> None:
    """UBX, RTCM 3 and NMEA one after the other, with text between, each found whole."""
    ubx = gzip.decompress((recordings / "live" / TWO_BANDS).read_bytes())[:30_000]
    rtcm = gzip.decompress((recordings / "live" / RTCM).read_bytes())[:30_000]
    nmea = b"$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,M,55.2,M,,*76\r\n"
    alone = [find_frames(np.frombuffer(part, np.uint8)) for part in (ubx, rtcm, nmea)]
    mixed = find_frames(np.frombuffer(ubx + b"\xff\xfe caf\xe9 " + nmea + rtcm + nmea, np.uint8))
    expected = len(alone[0]) + len(alone[1]) + 2 * len(alone[2])
    assert len(mixed) == expected
    assert len(alone[2]) == 1
    assert np.count_nonzero(mixed.protocol == "nmea") == 2


def test_text_between_messages_is_no_damage() -> None:
    """Lines of NMEA with their ends are frames, however they are cut, and no byte 36 of a damaged message is one."""
    nmea = b"$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,M,55.2,M,,*76"
    stream = np.frombuffer(nmea + b"\r\n" + nmea + b"\n" + nmea + b"$\x07\x80*00" + nmea + b"\r\n", np.uint8)
    frames = find_frames(stream)
    assert (len(frames), frames.skipped_bytes, frames.bad_checksums) == (4, 6, 0)
    for cut in range(len(stream)):
        first = find_frames(stream[:cut], at_end=False)
        second = find_frames(stream[first.consumed :])
        assert len(first) + len(second) == 4
        assert first.skipped_bytes + second.skipped_bytes == 6


def test_a_restarted_receiver_and_repeated_messages(recordings: Path) -> None:
    """The log twice over: the second time nothing is new, and that is counted."""
    data = gzip.decompress((recordings / "live" / TWO_BANDS).read_bytes())
    whole, _ = in_fragments(data, [])
    twice, _ = in_fragments(data + data, [])
    assert np.array_equal(whole.time, twice.time)
    assert twice.skipped["epochs that are not later than the previous epoch"] == len(whole)


def pieces_of(path: Path, epochs: int) -> Iterator[Observations]:
    return railfix.scan_observations(path, epochs=epochs)


def test_pieces_are_the_whole(ubx: Path) -> None:
    whole = railfix.read_observations(ubx)
    pieces = concatenate(list(pieces_of(ubx, 100)))
    assert channels(whole) == channels(pieces)
    for name in NUMBERS:
        assert np.array_equal(getattr(whole, name), getattr(pieces, name), equal_nan=True)
    some = railfix.read_observations(ubx, systems="G", start=whole.time[10], end=whole.time[20])
    assert len(some) == 10
    assert set(some.system.tolist()) == {"G"}


@pytest.mark.requirement("A7")
def test_overlapping_logs_of_one_receiver_give_each_epoch_once(tmp_path: Path) -> None:
    whole = demo_observations()["front"][:30]
    for name, part in (("one", slice(0, 20)), ("two", slice(10, 30)), ("all", slice(0, 30))):
        (tmp_path / name).write_bytes(log_of(whole[part]))
    single = railfix.read_observations(tmp_path / "all")
    both = railfix.read_observations([tmp_path / "two", tmp_path / "one"])
    assert both.time.tolist() == single.time.tolist()
    assert len(both) == 30
    for name in NUMBERS:
        np.testing.assert_array_equal(getattr(both, name), getattr(single, name))


def test_messages_of_what_cannot_be_read(recordings: Path, tmp_path: Path) -> None:
    live = recordings / "live"
    with pytest.raises(InputFileError, match="contains no observations"):
        railfix.read_observations(live / RTCM)
    with pytest.raises(InputFileError, match="contains no complete ephemeris"):
        railfix.read_navigation(live / TWO_BANDS)
    noise = tmp_path / "noise.ubx"
    noise.write_bytes(np.random.default_rng(1).integers(0, 256, 5000).astype(np.uint8).tobytes())
    with pytest.raises(InputFileError, match="is binary"):
        railfix.read_observations(noise)
    text = next((recordings / "kinematic").glob("japan*/SEPT265G.21O"))
    with pytest.raises(MismatchError, match="one kind"):
        railfix.read_observations([live / TWO_BANDS, text])


def sfrbx(prn: int, octets: bytes) -> bytes:
    """A UBX RXM-SFRBX frame of one SBAS message (eight words, left-aligned)."""
    words = b"".join(octets[k : k + 4][::-1] for k in range(0, 32, 4))
    return ubx_frame(0x0213, bytes([1, prn, 0, 0, 8, 0, 2, 0]) + words)


def rawx(week: int, tow: float) -> bytes:
    """A UBX RXM-RAWX frame without a measurement: an epoch."""
    return ubx_frame(0x0215, np.float64(tow).tobytes() + week.to_bytes(2, "little") + bytes([18, 0, 1, 1, 0, 0]))


def ubx_frame(kind: int, payload: bytes) -> bytes:
    body = kind.to_bytes(2, "big") + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for value in body:
        a = (a + value) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes([a, b])


def test_sbas_messages_of_a_receiver(recordings: Path, tmp_path: Path) -> None:
    """MSAS messages as a receiver passes them on: the same messages as from the file; damaged ones are left out."""
    from railfix.core.timescale import to_week
    from railfix.ranges.sbas import read_sbas
    from railfix.ranges.sbas.messages import with_parity

    known = read_sbas(recordings / "sbas" / "msas_20250215" / "046r_sbas_prn137.txt")
    known = known.take(np.arange(200))
    octets = with_parity(known.bits)
    week, second = to_week(known.time)
    data = b""
    for k in range(200):
        broken = bytearray(octets[k].tobytes())
        broken[10] ^= 4 if k in (17, 90) else 0
        data += rawx(int(week[k]), float(second[k])) + sfrbx(int(known.prn[k]), bytes(broken))
    log = tmp_path / "sbas.ubx"
    log.write_bytes(data)
    read = read_sbas(log)
    kept = np.delete(np.arange(200), [17, 90])
    assert read.rejected["parity"] == 2
    # An epoch comes too early to use the message after it: it counts from 1 ns later on.
    assert read.time.tolist() == (known.time[kept] + np.timedelta64(1, "ns")).tolist()
    assert read.prn.tolist() == known.prn[kept].tolist()
    assert read.type.tolist() == known.type[kept].tolist()
    assert np.array_equal(read.bits[:, :28], known.bits[kept, :28])
    assert set(read.parity_bits.tolist()) == {24}


def msm4(number: int, time_field: int) -> bytes:
    """A multiple signal message (RTCM 10403.3, 3.5.16) of satellite 5 alone, its first signal at 70.5 ms."""
    fields = [(number, 12), (0, 12), (time_field, 30), (0, 19), (1 << 59, 64), (1 << 30, 32), (1, 1)]
    fields += [(70, 8), (512, 10), (0, 15), (0, 22), (5, 4), (0, 1), (40, 6)]
    return rtcm_message(fields)


def rtcm_message(fields: list[tuple[int, int]]) -> bytes:
    """A message of values of so many bits each."""
    bits = "".join(f"{value:0{length}b}" for value, length in fields)
    body = int(bits.ljust(-len(bits) // 8 * -8, "0"), 2).to_bytes(-(-len(bits) // 8), "big")
    framed = b"\xd3" + len(body).to_bytes(2, "big") + body
    octets = np.frombuffer(framed, np.uint8)
    return framed + int(crc24q(octets, np.array([0]), np.array([len(octets)]))[0]).to_bytes(3, "big")


@pytest.mark.parametrize("day", [2, 0, 7])
def test_day_of_glonass_messages(day: int) -> None:
    """Their day of the week may be unknown (7) or left at 0; all messages of an instant are one epoch."""
    tow_ms = 204_236_600
    glonass = day << 27 | (tow_ms - 18_000 + 3 * 3_600_000) % 86_400_000
    stream = b"".join(
        msm4(1074, tow_ms + k) + msm4(1084, glonass + k) + msm4(1124, tow_ms + k - 14_000) for k in (0, 200)
    )
    piece, _ = decode(stream, StreamState(time=np.datetime64("2019-01-20", "ns")), at_end=True)
    observations, _ = join_observations(piece.measurements)
    assert observations.satellite.tolist() == ["C05", "G05", "R05"]
    assert observations.time.astype("M8[ms]").tolist() == [
        datetime.datetime(2019, 1, 22, 8, 43, 56, 600_000), datetime.datetime(2019, 1, 22, 8, 43, 56, 800_000)
    ]  # fmt: skip
    assert np.isfinite(observations.code_m).all()


@pytest.mark.requirement("A8")
def test_channel_of_glonass_phases_by_hand() -> None:
    """MSM4 has phases in metres: no cycles before message 1020 gave the channel, and its latest one after it."""
    tow_ms = 204_236_600
    epochs = [msm4(1084, 2 << 27 | (tow_ms + k - 18_000 + 3 * 3_600_000) % 86_400_000) for k in range(0, 800, 200)]
    channel = {k: rtcm_message([(1020, 12), (5, 6), (k + 7, 5), (0, 337)]) for k in (-3, 6)}
    other = rtcm_message([(1020, 12), (4, 6), (1, 5), (0, 337)])
    stream = [epochs[0], channel[-3] + other + epochs[1], epochs[2], channel[6] + epochs[3]]
    metres = 70.5e-3 * SPEED_OF_LIGHT
    expected = [np.nan, *(metres * (1602e6 + k * 562_500.0) / SPEED_OF_LIGHT for k in (-3, -3, 6))]
    for pieces in ([b"".join(stream)], stream):
        state, phases = StreamState(time=np.datetime64("2019-01-20", "ns")), []
        for k, data in enumerate(pieces):
            piece, state = decode(data, state, at_end=k == len(pieces) - 1)
            phases += piece.measurements.phase_cycles.tolist()
        np.testing.assert_allclose(phases, expected, rtol=1e-13)


def test_time_of_week_beyond_the_week_is_broken() -> None:
    piece, _ = decode(
        msm4(1074, 0) + msm4(1124, (1 << 30) - 14_000), StreamState(time=np.datetime64("2019-01-20", "ns")), at_end=True
    )
    assert piece.measurements.satellite.tolist() == ["G05"]
    assert piece.measurements.skipped == {"broken MSM": 1}


def test_observations_of_old_kinds_are_named(tmp_path: Path) -> None:
    """RTCM 3 before the multiple signal messages, and u-blox before the M8."""
    log = ubx_frame(0x0210, bytes(8))
    for number in (1004, 1004, 1083):  # the last is MSM3, without whole pseudoranges
        body = (number << 4).to_bytes(2, "big") + bytes(20)
        rtcm = b"\xd3" + len(body).to_bytes(2, "big") + body
        log += rtcm
        log += int(crc24q(np.frombuffer(rtcm, np.uint8), np.array([0]), np.array([len(rtcm)]))[0]).to_bytes(3, "big")
    (tmp_path / "old.log").write_bytes(log)
    has = r"its messages RTCM 1004 \(2\), RTCM 1083 \(1\), UBX RXM-RAW \(1\) are not supported"
    with pytest.raises(InputFileError, match=has):
        railfix.read_observations(tmp_path / "old.log")


@pytest.mark.parametrize(("satellites", "what"), [(0, "MSM without satellites"), (1 << 63, "broken MSM")])
def test_messages_without_measurements_are_counted(satellites: int, what: str) -> None:
    """An MSM7 that names no satellite, as casters send them, and one with a satellite and no signal."""
    message = rtcm_message([(1077, 12), (0, 61), (satellites, 64), (0, 103)])
    piece, _ = decode(message, StreamState(time=np.datetime64("2025-08-11", "ns")), at_end=True)
    assert piece.measurements.skipped == {what: 1}
    assert len(piece.measurements.code_m) == 0


@pytest.mark.parametrize("first", ["raw", "msm"])
def test_one_kind_of_observations_is_taken_however_the_stream_is_cut(first: str) -> None:
    """The receiver's own epochs with MSM of the same instants between; the kind that is dated first is taken whole."""
    log = demo_observations()["front"][:12]
    week, second = np.datetime64("2024-03-03", "ns"), np.timedelta64(10**9, "ns")
    tow_ms = np.rint((log.time - week) / second * 1000).astype(np.int64)
    own = [ubx_made.rawx(log, epoch) for epoch in range(len(log))]
    msm = [msm4(1074, int(tow)) for tow in tow_ms]
    pairs = zip(own, msm, strict=True) if first == "raw" else zip(msm, own, strict=True)
    data = b"".join(part for pair in pairs for part in pair)
    state = StreamState(time=np.datetime64("2024-03-05", "ns"))
    alone, _ = in_fragments(b"".join(own if first == "raw" else msm), [], state)
    for seed in range(8):
        cuts = sorted(np.random.default_rng(seed).integers(1, len(data), 4 * seed).tolist())
        mixed, _ = in_fragments(data, cuts, state)
        assert channels(mixed) == channels(alone)
        assert np.array_equal(mixed.time, alone.time)
        assert np.array_equal(mixed.code_m, alone.code_m, equal_nan=True)
        [count] = [n for what, n in mixed.skipped.items() if "is used" in what]
        assert count == 12
    if first == "raw":  # without a date those before the first epoch of the receiver have none
        undated, _ = in_fragments(b"".join(msm[:3]) + data, [])
        assert channels(undated) == channels(alone)


@pytest.mark.parametrize("system", ["G", "J"])
def test_a_flipped_bit_of_a_subframe_is_found_by_its_parity(recordings: Path, system: str) -> None:
    """One bit of every GPS subframe, data or parity, the checksum of the message put right again; the same of QZSS."""
    data = bytearray(gzip.decompress((recordings / "live" / COLD_START).read_bytes())[:1_500_000])
    frames = find_frames(np.frombuffer(bytes(data), np.uint8))
    if system == "J":
        for row in frames.of("ubx", 0x0213).tolist():
            start, end = int(frames.start[row]), int(frames.end[row])
            data[start : start + 2] = bytes([5 if data[start] == 0 else 9, data[start + 1] % 7 + 1])
            data[int(frames.frame_start[row]) : end + 2] = ubx_made.frame(0x0213, bytes(data[start:end]))
    _, true = in_fragments(bytes(data), [])
    rng, flipped = np.random.default_rng(4), 0
    for row in frames.of("ubx", 0x0213).tolist():
        start, end = int(frames.start[row]), int(frames.end[row])
        if data[start] != (0 if system == "G" else 5) or data[start + 2]:  # L1 C/A
            continue
        bit = int(rng.integers(0, 30))
        data[start + 8 + 4 * int(rng.integers(0, 10)) + bit // 8] ^= 1 << bit % 8
        payload = bytes(data[start:end])
        data[int(frames.frame_start[row]) : end + 2] = ubx_made.frame(0x0213, payload)
        flipped += 1
    piece, _ = decode(bytes(data), StreamState(), at_end=True)
    assert flipped > 200
    assert piece.ephemerides.skipped[f"{system} subframes with wrong parity"] == flipped
    assert not [record for record in piece.ephemerides.records if record.satellite.startswith(system)]
    assert [record for record in true if f"'{system}" in str(record)], "there were some to lose"

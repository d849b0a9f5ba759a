"""Navigation messages bit by bit: random contents, decoded here and by RTKLIB (pyrtklib5)."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from railfix.core.timescale import from_week
from railfix.io.receiver import nav_messages
from railfix.io.receiver.ephemerides import assemble_navigation
from railfix.io.receiver.framing import Subframes, fields, read_signed, read_unsigned, sign_magnitude
from railfix.io.receiver.log import StreamState, decode
from railfix.io.receiver.measurements import frame_time
from test_receiver_logs import ubx_frame

pytestmark = pytest.mark.requirement("A8")

#: Attributes of RTKLIB's ephemeris by the names of the fields here.
EPHEMERIS = {
    "af0_s": "f0", "af1": "f1", "af2": "f2", "eccentricity": "e", "m0": "M0", "delta_n": "deln", "omega0": "OMG0",
    "i0": "i0", "omega": "omg", "omega_dot": "OMGd", "i_dot": "idot", "cuc": "cuc", "cus": "cus", "crc": "crc",
    "crs": "crs", "cic": "cic", "cis": "cis", "toe_sow_s": "toes", "health": "svh",
}  # fmt: skip


def rtklib() -> Any:
    return pytest.importorskip("pyrtklib5", reason="the independent decoder is not installed")


def octets(rtk: Any, values: np.ndarray) -> Any:
    array = getattr(rtk, "Arr1Dunsigned char")(len(values))
    for k, value in enumerate(values.tolist()):
        array[k] = value
    return array


def put(bits: np.ndarray, first: int, length: int, value: int) -> None:
    bits[first : first + length] = [value >> (length - 1 - k) & 1 for k in range(length)]


def random_bits(seed: int, length: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, length).astype(np.uint8)


def compare(values: dict[str, np.ndarray], ephemeris: Any, names: dict[str, str] = EPHEMERIS) -> None:
    checked = 0
    for name, theirs in names.items():
        if name in values:
            expected = float(getattr(ephemeris, theirs))
            assert float(values[name][0]) == pytest.approx(expected, rel=1e-14, abs=0.0), name
            checked += 1
    assert checked > 10 or names is not EPHEMERIS


def test_integers_by_hand() -> None:
    """0b1011 is 11, as two's complement -5, as sign and magnitude -3."""
    bits = np.array([[0, 1, 0, 1, 1, 0]], dtype=np.uint8)
    assert read_unsigned(bits, 1, 4).tolist() == [11]
    assert read_signed(bits, 1, 4).tolist() == [-5]
    assert sign_magnitude(bits, 1, 4).tolist() == [-3]
    assert fields(bits, {"x": (((1, 1), (3, 2)), 3, 0.5, "u")})["x"].tolist() == [3.5]


@pytest.mark.parametrize("seed", range(20))
def test_gps_lnav(seed: int) -> None:
    rtk = rtklib()
    bits = random_bits(seed, 5 * 240)
    for k in range(5):
        put(bits, 240 * k, 8, 0x8B)
        put(bits, 240 * k + 43, 3, k + 1)
    for k in (3, 4):
        put(bits, 240 * k + 48, 2, 0)  # no almanac, which RTKLIB would write into an array of all satellites
    put(bits, 240 + 48, 8, 77)
    put(bits, 480 + 216, 8, 77)
    put(bits, 168, 8, 77)
    ephemeris = rtk.eph_t()
    almanac, ion, utc = rtk.alm_t(), rtk.Arr1Ddouble(8), rtk.Arr1Ddouble(9)
    rtk.decode_frame(octets(rtk, np.packbits(bits)), rtk.SYS_GPS, ephemeris, almanac, ion, utc)
    values: dict[str, np.ndarray] = {}
    for k in (1, 2, 3):
        values |= nav_messages.fields(
            bits[240 * (k - 1) : 240 * k][None], {**nav_messages.LNAV_HEAD, **nav_messages.LNAV[k]}
        )
    compare(values, ephemeris)
    assert values["sqrt_a"][0] ** 2 == pytest.approx(ephemeris.A, rel=1e-14)
    assert (values["iodc"][0], values["iode"][0]) == (ephemeris.iodc, ephemeris.iode)
    assert values["group_delay_1_s"][0] == pytest.approx(ephemeris.tgd[0] if bits[160:168].any() else 0.0, rel=1e-14)


@pytest.mark.parametrize("seed", range(20))
def test_galileo_inav(seed: int) -> None:
    rtk = rtklib()
    words = random_bits(seed, 7 * 128).reshape(7, 128)
    for kind in range(7):
        put(words[kind], 0, 6, kind)
    for kind in (1, 2, 3, 4):
        put(words[kind], 6, 10, 333)
    put(words[4], 16, 6, 12)
    put(words[0], 6, 2, 2)
    put(words[0], 96, 12, 1200)
    put(words[5], 73, 12, 1200)
    put(words[0], 108, 20, 1000)
    put(words[5], 85, 20, 1000)
    ephemeris = rtk.eph_t()
    rtk.decode_gal_inav(octets(rtk, np.packbits(words.reshape(-1))), ephemeris, rtk.Arr1Ddouble(8), rtk.Arr1Ddouble(8))
    values: dict[str, np.ndarray] = {}
    for kind in range(1, 6):
        values |= fields(words[kind][None], nav_messages.INAV[kind])
    compare(values, ephemeris, {k: v for k, v in EPHEMERIS.items() if k != "health"})
    assert values["group_delay_1_s"][0] == pytest.approx(ephemeris.tgd[0], rel=1e-14)
    assert values["group_delay_2_s"][0] == pytest.approx(ephemeris.tgd[1], rel=1e-14)


def put_field(bits: np.ndarray, field: Any, value: int) -> None:
    """A value in its place, or in its places."""
    place, length, _, _ = field
    left = length
    for first, count in place if isinstance(place, tuple) else ((place, length),):
        left -= count
        put(bits, first, count, value >> left & (1 << count) - 1)


def beidou_stream(pages: np.ndarray, number: int) -> bytes:
    """RXM-SFRBX of pages of 300 bits, which have ten words of 30 bits."""
    words = [read_unsigned(page.reshape(10, 30), 0, 30).astype("<u4").tobytes() for page in pages]
    return b"".join(ubx_frame(0x0213, bytes([3, number, 0, 0, 10, 0, 2, 0]) + part) for part in words)


def beidou_record(pages: np.ndarray, number: int) -> tuple[Any, Any]:
    """Records and ionosphere of a stream of pages."""
    piece, _ = decode(beidou_stream(pages, number), StreamState(), at_end=True)
    found = assemble_navigation(piece.ephemerides)
    return found.kepler, found.klobuchar.get("C")


def compare_beidou(record: Any, ephemeris: Any, rtk: Any, seed: int) -> None:
    """All fields of the record against RTKLIB's, and the week, which both have in GPS time."""
    compare({name: getattr(record, name) for name in EPHEMERIS}, ephemeris)
    for name, theirs in {"iode": "iode", "iodc": "iodc", "health": "svh"}.items():
        assert getattr(record, name).tolist() == [getattr(ephemeris, theirs)], name
    for k, delay in enumerate((record.group_delay_1_s, record.group_delay_2_s)):
        assert delay[0] == pytest.approx(ephemeris.tgd[k], rel=1e-12)
    assert record.accuracy_m[0] == nav_messages.URA_NOMINAL_M[seed % 16]
    for name, theirs in {"toe": "toe", "toc": "toc", "transmitted": "ttr"}.items():
        since = rtk.timediff(getattr(ephemeris, theirs), rtk.gpst2time(2367, 0.0))
        assert (getattr(record, name)[0] - from_week(2367, 0.0)) / np.timedelta64(1, "s") == since, name


#: Numbers that no orbit exceeds, as they are sent; others are random.
BEIDOU: dict[str, int] = {
    "eccentricity": 1 << 26, "sqrt_a": int(5282.6 * 2**19), "week": 2367 - 1356, "omega_dot": -23_456, "toc_s": 20_000,
}  # fmt: skip


@pytest.mark.parametrize("seed", range(16))
def test_beidou_d1(seed: int) -> None:
    rtk = rtklib()
    bits = random_bits(seed, 3 * 300).reshape(3, 300)
    toe = BEIDOU["toc_s"]
    sent = {**BEIDOU, "toe_high": toe >> 15, "toe_low": toe & 0x7FFF, "accuracy": seed}
    for k in range(3):
        put(bits[k], 0, 11, 0x712)
        layout = nav_messages.D1[k + 1]
        for name, value in {**sent, "subframe": k + 1, "tow_s": 160_000 + 6 * k}.items():
            if name in layout:
                put_field(bits[k], layout[name], value)
    padded = np.zeros((3, 304), np.uint8)
    padded[:, :300] = bits
    ephemeris, ion = rtk.eph_t(), rtk.Arr1Ddouble(8)
    whole = np.zeros(38 * 5, np.uint8)
    whole[: 38 * 3] = np.packbits(padded, axis=1).reshape(-1)
    rtk.decode_bds_d1(octets(rtk, whole), ephemeris, ion, rtk.Arr1Ddouble(8))
    record, ionosphere = beidou_record(bits, 10)
    compare_beidou(record, ephemeris, rtk, seed)
    assert ionosphere.tolist() == [ion[k] for k in range(8)]
    for k in range(3):  # one subframe is lost, or of the frame before
        other = bits.copy()
        put_field(other[k], nav_messages.BDS_HEAD["tow_s"], 160_000 + 6 * k - 30)
        assert not len(beidou_record(other, 10)[0])
        assert not len(beidou_record(np.delete(bits, k, axis=0), 10)[0])


@pytest.mark.parametrize("seed", range(16))
def test_beidou_d2(seed: int) -> None:
    rtk = rtklib()
    bits = random_bits(seed, 3000)
    for name, value in {**BEIDOU, "toe_sow_s": BEIDOU["toc_s"], "accuracy": seed}.items():
        put_field(bits, nav_messages.D2[name], value)
    bits = bits.reshape(10, 300)
    for k in range(10):
        put(bits[k], 0, 11, 0x712)
        put(bits[k], 42, 4, k + 1)
        for name, value in {"subframe": 1, "tow_s": 160_000 + 3 * k}.items():
            put_field(bits[k], nav_messages.BDS_HEAD[name], value)
    padded = np.zeros((10, 304), np.uint8)
    padded[:, :300] = bits
    ephemeris = rtk.eph_t()
    rtk.decode_bds_d2(octets(rtk, np.packbits(padded, axis=1).reshape(-1)), ephemeris, rtk.Arr1Ddouble(8))
    compare_beidou(beidou_record(bits, 3)[0], ephemeris, rtk, seed)
    for k in range(10):
        other = bits.copy()
        put_field(other[k], nav_messages.BDS_HEAD["tow_s"], 160_000 + 3 * k - 30)
        assert not len(beidou_record(other, 3)[0])
        assert not len(beidou_record(np.delete(bits, k, axis=0), 3)[0])


def test_beidou_geostationary_satellites_send_d2() -> None:
    """ICD B1I: C01 to C05 and C59 to C63 are geostationary; the others send D1."""
    names = ["C01", "C05", "C06", "C58", "C59", "C63"]
    words = np.zeros((len(names), 10), dtype=np.uint32)
    words[:, 0] = 0x712 << 19 | 1 << 12  # preamble, subframe 1
    words[:, 1] = 3 << 14  # the third page of ten, as D2 numbers them
    part = Subframes(
        satellite=np.array(names), signal=np.zeros(len(names), dtype=np.int64), words=words,
        glonass_channel=np.zeros(len(names), dtype=np.int64), order=np.arange(len(names)),
    )  # fmt: skip
    pages, _ = nav_messages.decode_pages(part)
    numbers = {name: number for _, name, number, _ in pages}
    assert {name for name, number in numbers.items() if number >= 100} == {"C01", "C05", "C59", "C63"}
    assert {name for name, number in numbers.items() if number == 1} == {"C06", "C58"}


@pytest.mark.parametrize("seed", range(20))
def test_glonass_hamming(seed: int) -> None:
    """One of the 256 codes passes here, RTKLIB accepts it too; no string with one bit flipped passes."""
    rtk = rtklib()
    strings = np.repeat(random_bits(seed, 88)[None], 256, axis=0)
    strings[:, 85:] = 0
    for code in range(256):
        put(strings[code], 77, 8, code)
    valid = np.flatnonzero(nav_messages.glonass_hamming(strings[:, :85]))
    assert len(valid) == 1
    good = strings[valid[0]]
    assert rtk.test_glostr(octets(rtk, np.packbits(good)))
    flipped = good[None, :85] ^ np.eye(85, dtype=np.uint8)
    assert not nav_messages.glonass_hamming(flipped).any()


@pytest.mark.parametrize("seed", range(5))
def test_glonass_strings(seed: int) -> None:
    rtk = rtklib()
    bits = random_bits(seed, 5 * 80).reshape(5, 80)
    for k in range(5):
        put(bits[k], 1, 4, k + 1)
    put(bits[0], 9, 5, 10)
    put(bits[0], 14, 6, 30)
    put(bits[1], 9, 7, 20)
    put(bits[3], 70, 5, 7)
    ephemeris = rtk.geph_t()
    ephemeris.tof = rtk.epoch2time(array(rtk, [2024, 3, 5, 3, 0, 0]))
    assert rtk.decode_glostr(octets(rtk, np.packbits(bits, axis=1).reshape(-1)), ephemeris, rtk.Arr1Ddouble(8))
    values: dict[str, np.ndarray] = {}
    for k in range(4):
        values |= fields(bits[k][None], nav_messages.GLONASS[k + 1])
    for axis, letter in enumerate("xyz"):
        assert values[letter][0] * 1e3 == pytest.approx(ephemeris.pos[axis], rel=1e-12)
        assert values[f"{letter}_velocity"][0] * 1e3 == pytest.approx(ephemeris.vel[axis], rel=1e-12)
        assert values[f"{letter}_acceleration"][0] * 1e3 == pytest.approx(ephemeris.acc[axis], rel=1e-12)
    assert values["relative_frequency"][0] == pytest.approx(ephemeris.gamn, rel=1e-12)
    assert values["tau_s"][0] == pytest.approx(ephemeris.taun, rel=1e-12)
    assert (values["ln"][0], int(values["health"][0]) >> 2) == (ephemeris.svh >> 3 & 1, ephemeris.svh & 1)


def array(rtk: Any, values: list[float]) -> Any:
    values_of = rtk.Arr1Ddouble(len(values))
    for k, value in enumerate(values):
        values_of[k] = value
    return values_of


def glonass_frame(began_s: int) -> list[bytes]:
    """RXM-SFRBX of strings 1 to 4 of R12, of a frame that begins at a second of the day of Moscow."""
    bits = random_bits(1, 4 * 88).reshape(4, 88)
    bits[:, 85:] = 0
    for k in range(4):
        put(bits[k], 0, 1, 0)
        put(bits[k], 1, 4, k + 1)
        put(bits[k], 50, 27, 14_700 * 2**11)
        put(bits[k], 21, 24, 2**20)
        put(bits[k], 45, 5, 1)
    for first, length, value in ((9, 5, began_s // 3600), (14, 6, began_s // 60 % 60), (20, 1, began_s // 30 % 2)):
        put(bits[0], first, length, value)
    put(bits[1], 9, 7, (began_s + 900) // 900)
    put(bits[3], 5, 22, 1000)
    put(bits[3], 70, 5, 12)
    parts = []
    for k in range(4):
        codes = np.repeat(bits[k][None], 256, axis=0)
        for code in range(256):
            put(codes[code], 77, 8, code)
        whole = np.concatenate([codes[nav_messages.glonass_hamming(codes[:, :85])][0], np.zeros(40, np.uint8)])
        words = np.frombuffer(np.packbits(whole).tobytes()[:16], ">u4").astype("<u4").tobytes()
        parts.append(ubx_frame(0x0213, bytes([6, 12, 0, 7, 4, 0, 2, 0]) + words))
    return parts


def empty_epoch(tow: float) -> bytes:
    return ubx_frame(0x0215, struct.pack("<dHbBBB2x", tow, 2081, 18, 0, 1, 1))


def epochs_of_records(parts: list[bytes]) -> list[str]:
    """Records of a stream, the same whole and cut at every message."""
    found = []
    for pieces in ([b"".join(parts)], parts):
        state, epochs = StreamState(), []
        for data in pieces:
            piece, state = decode(data, state)
            epochs += [str(record.epoch) for record in piece.ephemerides.records]
        found.append(epochs)
    assert found[0] == found[1]
    return found[0]


@pytest.mark.parametrize("clock", ["RXM-RAWX", "NAV-PVT"])
@pytest.mark.parametrize(("began_s", "records"), [(0, 1), (-30, 0), (30, 0)])
def test_glonass_strings_are_of_one_frame(began_s: int, records: int, clock: str) -> None:
    """String 1 comes before the receiver's first epoch: its t_k tells whether the others are of its frame.

    A log without observations has its time from NAV-PVT.
    """
    tow = 250_698.0
    parts = []
    for k, string in enumerate(glonass_frame(int(tow - 18 + 3 * 3600) % 86_400 + began_s)):
        now = tow + 2.0 * k + 2.0
        date = ubx_frame(0x0107, struct.pack("<IHBB3xB80x", round(now * 1000), 2019, 11, 26, 3))
        parts += [string, empty_epoch(now) if clock == "RXM-RAWX" else date]
    assert epochs_of_records(parts) == ["2019-11-26T21:45:00.000000000"] * records


def test_a_glonass_frame_just_after_a_leap_second() -> None:
    """At 00:00:10 GPS time of 1 January 2017 it is 23:59:53 UTC: the 18th second comes between."""
    now = np.datetime64("2017-01-01T00:00:10", "ns")
    began = {"hour": 2.0 * 3600.0, "minute": 59.0 * 60.0, "half_minute": 30.0}  # Moscow, three hours ahead
    assert frame_time(began, now) == np.datetime64("2016-12-31T23:59:47", "ns")


@pytest.mark.parametrize(
    ("before_s", "after_s", "other", "records"),
    [
        (-12, 18, (), 1),  # an epoch every 30 s
        (-120, 29, (), 1),  # a damaged log has lost two minutes of epochs
        (-12, 39, (), 0),  # the strings may be of the next frame
        (-120, 29, (1,), 0),  # string 2 is of the frame before: it came before string 1
        (-1, 18, (2,), 0),  # string 3 is lost
    ],
)
def test_glonass_records_without_an_epoch_at_their_strings(
    before_s: int, after_s: int, other: tuple[int, ...], records: int
) -> None:
    """The first epoch after all strings, less than a frame after its beginning, shows that they are of one."""
    tow = 250_698.0
    strings = glonass_frame(int(tow - 18 + 3 * 3600) % 86_400)
    kept = [string for k, string in enumerate(strings) if k not in other]
    early = [strings[1]] if other == (1,) else []
    parts = [empty_epoch(tow + before_s), *early, *kept, empty_epoch(tow + after_s), empty_epoch(tow + after_s + 1)]
    assert epochs_of_records(parts) == ["2019-11-26T21:45:00.000000000"] * records

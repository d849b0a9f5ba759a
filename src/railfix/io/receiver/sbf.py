"""Decode Septentrio SBF blocks: measurements, navigation pages and receiver positions.

Source: mosaic-X5 reference guide 4.14, sections 4.1.9 (satellites), 4.1.10 (signals), 4.2.1 (MeasEpoch), 4.2.2
(GPSRawCA, GPSRawL2C, GPSRawL5, GALRawFNAV, GALRawINAV, BDSRaw, GLORawCA, QZSRawL1CA, QZSRawL2C, QZSRawL5, GEORawL1,
GEORawL5, BDSRawB2a), 4.2.8 (PVTGeodetic, PVTCartesian); PolaRx5TR reference guide 5.5.0, page 326 (BDSRawB1C). A
B-CNAV1 frame has 1800 symbols: three subframes of 72, 1200 and 528 symbols. Subframe 1 has two code words, of 21 and 51
symbols. In each code word, the data bits precede the parity bits.
"""

from __future__ import annotations

from itertools import chain
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Indices, Integers, Strings
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.timescale import from_week
from railfix.gnss.observations import frequency_by_name_hz
from railfix.io.receiver.framing import (
    BCNAV1_PAGE,
    SBAS_L5,
    Frames,
    Subframes,
    gather_structures,
    join_subframes,
    read_unsigned,
    unpack_words,
)
from railfix.io.receiver.measurements import Measurements
from railfix.io.receiver.nav_messages import BCNAV1_PARTS, has_crc

Words = np.ndarray[tuple[int, int], np.dtype[np.uint32]]

MEAS_EPOCH: Final = 4027
PVT_CARTESIAN: Final = 4006
PVT_GEODETIC: Final = 4007
GPS_RAW_CA: Final = 4017
GPS_RAW_L2C: Final = 4018
GPS_RAW_L5: Final = 4019
GEO_RAW_L1: Final = 4020
GEO_RAW_L5: Final = 4021
GAL_RAW_FNAV: Final = 4022
GAL_RAW_INAV: Final = 4023
GLO_RAW_CA: Final = 4026
BDS_RAW: Final = 4047
BDS_RAW_B1C: Final = 4218
BDS_RAW_B2A: Final = 4219
QZS_RAW_L1CA: Final = 4066
QZS_RAW_L2C: Final = 4067
QZS_RAW_L5: Final = 4068
#: For each block with navigation pages, the constellation, and the UBX signal number for each SBF signal number. None
#: means that the UBX signal number is 0 for all SBF signal numbers.
_PAGES: Final[dict[int, tuple[str, dict[int, int] | None]]] = {
    GPS_RAW_CA: ("G", None),
    QZS_RAW_L1CA: ("J", None),
    GPS_RAW_L2C: ("G", {3: 3}),
    GPS_RAW_L5: ("G", {4: 7}),
    QZS_RAW_L2C: ("J", {7: 5}),
    QZS_RAW_L5: ("J", {26: 9}),
    GAL_RAW_FNAV: ("E", {20: 4}),
    GAL_RAW_INAV: ("E", {17: 1, 21: 5, 22: 5}),
    BDS_RAW: ("C", {28: 0, 29: 2, 30: 4}),
    BDS_RAW_B2A: ("C", {14: 8}),
    GLO_RAW_CA: ("R", None),
    GEO_RAW_L1: ("S", None),
    GEO_RAW_L5: ("S", {25: SBAS_L5}),
}
_EVEN_BITS, _BDS_BITS = 114, 300  #: Number of bits of an even I/NAV page without its tail, and of a BeiDou subframe.
#: Constellation and RINEX signal for each SBF signal number.
SIGNALS: Final = {
    0: "G1C", 1: "G1W", 2: "G2W", 3: "G2L", 4: "G5Q", 5: "G1L", 6: "J1C", 7: "J2L", 8: "R1C", 9: "R1P", 10: "R2P",
    11: "R2C", 12: "R3Q", 13: "C1P", 14: "C5P", 15: "I5A", 17: "E1C", 19: "E6C", 20: "E5Q", 21: "E7Q", 22: "E8Q",
    24: "S1C", 25: "S5I", 26: "J5Q", 28: "C2I", 29: "C7I", 30: "C6I", 32: "J1L", 33: "J1Z", 34: "C7D", 39: "J5P",
}  # fmt: skip
#: Ranges of SVID: first and last SVID, constellation, and the number to add to obtain the RINEX satellite number.
_NUMBERS: Final = (
    (1, 37, "G", 0), (38, 61, "R", -37), (63, 68, "R", -38), (71, 106, "E", -70), (120, 140, "S", -100),
    (141, 180, "C", -140), (181, 187, "J", -180), (191, 197, "I", -190), (198, 215, "S", -157), (223, 245, "C", -182),
)  # fmt: skip
_HEAD: Final = np.dtype(
    [
        ("tow_ms", "<u4"), ("week", "<u2"), ("count", "u1"), ("size1", "u1"), ("size2", "u1"), ("flags", "u1"),
        ("_", "V2"),
    ]
)  # fmt: skip
_FIRST: Final = np.dtype(
    [
        ("channel", "u1"), ("type", "u1"), ("sv", "u1"), ("misc", "u1"), ("code", "<u4"), ("doppler", "<i4"),
        ("carrier", "<u2"), ("carrier_msb", "i1"), ("cn0", "u1"), ("lock", "<u2"), ("info", "u1"), ("count", "u1"),
    ]
)  # fmt: skip
_OTHER: Final = np.dtype(
    [
        ("type", "u1"), ("lock", "u1"), ("cn0", "u1"), ("offsets", "u1"), ("carrier_msb", "i1"), ("info", "u1"),
        ("code", "<u2"), ("carrier", "<u2"), ("doppler", "<u2"),
    ]
)  # fmt: skip
_PAGE: Final = np.dtype(
    [
        ("tow_ms", "<u4"), ("week", "<u2"), ("sv", "u1"), ("passed", "u1"), ("viterbi", "u1"), ("source", "u1"),
        ("channel", "u1"), ("_", "V1"), ("words", "<u4", 10),
    ]
)  # fmt: skip
_FRAME: Final = np.dtype(
    [("tow_ms", "<u4"), ("week", "<u2"), ("sv", "u1"), ("crc", "u1", 2), ("_", "V3"), ("words", "<u4", 57)]
)
_PVT: Final = np.dtype(
    [("tow_ms", "<u4"), ("week", "<u2"), ("mode", "u1"), ("error", "u1"), ("place", "<f8", 3), ("undulation", "<f4")]
)
#: RTKLIB quality for each mode of a PVT block. The modes are 1 stand-alone, 2 differential, 3 fixed position, 4 RTK
#: fixed, 5 RTK float, 6 SBAS, 7 moving base fixed, 8 moving base float, 10 PPP.
_QUALITY: Final = {1: 5, 2: 4, 3: 1, 4: 1, 5: 2, 6: 3, 7: 1, 8: 2, 10: 6}
_NO_TIME: Final = 0xFFFFFFFF
_NO_WEEK: Final = 0xFFFF
_TIME: Final = np.dtype([("tow_ms", "<u4"), ("week", "<u2")])  #: Time fields at the beginning of each block.
_SCRAMBLED: Final = 0x80  #: Flag of a MeasEpoch block whose measurements are scrambled; such blocks are skipped.
_WITHOUT_OFFSET: Final = (1, 2)  #: SBF numbers of GPS L1P(Y) and L2P(Y), to whose C/N0 no 10 dB-Hz are added.


def _names() -> Strings:
    """Return the satellite names by SVID, blank where unknown."""
    table = np.full(256, "", dtype="<U3")
    for first, last, letter, shift in _NUMBERS:
        for number in range(first, last + 1):
            table[number] = f"{letter}{number + shift:02d}"
    return table


_NAMES: Final = _names()


_SIGNAL_NAMES: Final = np.array([SIGNALS.get(number, "") for number in range(64)], dtype="<U3")


def meas_epoch_measurements(frames: Frames) -> Measurements:
    """Return the measurements of the main antenna in all MeasEpoch blocks.

    Skip and count malformed and scrambled blocks, blocks without time, and measurements of other antennas.
    """
    chosen, head = frames.structures("sbf", [MEAS_EPOCH], _HEAD)
    dated = (head["tow_ms"] != _NO_TIME) & (head["week"] != _NO_WEEK) & (head["size1"] >= 20) & (head["size2"] >= 12)
    scrambled = dated & (head["flags"] & _SCRAMBLED != 0)
    dated &= ~scrambled
    blocks = [(row, _sub_blocks(frames, int(chosen[row]), head[row])) for row in np.flatnonzero(dated).tolist()]
    whole = [(row, found) for row, found in blocks if found is not None]
    skipped = {
        "broken MeasEpoch": len(blocks) - len(whole),
        "MeasEpoch without time": int(np.count_nonzero(~dated & ~scrambled)),
        "scrambled MeasEpoch": int(np.count_nonzero(scrambled)),
    }
    pairs = chain.from_iterable(chain.from_iterable(found for _, found in whole))
    place, master = np.fromiter(pairs, dtype=np.intp).reshape(-1, 2).T
    epoch = np.repeat(np.arange(len(whole)), np.array([len(found) for _, found in whole], dtype=np.intp))
    rows = head[np.array([row for row, _ in whole], dtype=np.intp)]
    main = frames.data[place + (place == master)] >> 5 == 0
    skipped["MeasEpoch measurements of auxiliary antennas"] = int(np.count_nonzero(~main))
    values = {name: array[main] for name, array in _decode(frames, place, master).items()}
    return Measurements(
        time=from_week(rows["week"].astype(np.int64), rows["tow_ms"] * 1e-3),
        epoch=epoch[main],
        **values,
        receiver="Septentrio",
        skipped={what: number for what, number in skipped.items() if number},
    )


def _sub_blocks(frames: Frames, index: int, head: np.void) -> list[tuple[int, int]] | None:
    """Return, for each sub-block, its own offset and the offset of the type-1 sub-block that contains it.

    Return None if the block is malformed.
    """
    cursor, end = int(frames.start[index]) + _HEAD.itemsize, int(frames.end[index])
    size1, size2 = int(head["size1"]), int(head["size2"])
    places: list[tuple[int, int]] = []
    for _ in range(int(head["count"])):
        master = cursor
        if master + size1 > end:
            return None
        cursor += size1 + size2 * int(frames.data[master + 19])
        if cursor > end:
            return None
        places += [(master, master), *((place, master) for place in range(master + size1, cursor, size2))]
    return places


def _decode(frames: Frames, place: Indices, master: Indices) -> dict[str, Any]:
    """Decode the sub-blocks at `place`. Type 2 values are relative to the type-1 sub-block at offset `master`."""
    own = place == master
    first = gather_structures(frames.data, master, _FIRST)
    other = gather_structures(frames.data, np.where(own, 0, place), _OTHER) if len(frames.data) >= 12 else first
    number = _signal_number(np.where(own, first["type"], other["type"]), np.where(own, first["info"], other["info"]))
    name = _SIGNAL_NAMES[number]
    satellite = _NAMES[first["sv"]]
    known = (np.char.str_len(satellite) > 0) & (name.astype("<U1") == satellite.astype("<U1"))
    channel = (first["info"] >> 3).astype(np.int64) - 8  # bits 3 to 7 of ObsInfo
    main = _SIGNAL_NAMES[_signal_number(first["type"], first["info"])]
    frequency, main_frequency = (frequency_by_name_hz(names, channel.astype(np.float64)) for names in (name, main))
    code_main = ((first["misc"] & 15).astype(np.int64) << 32 | first["code"].astype(np.int64)) * 1e-3
    code_main = np.where(code_main == 0, np.nan, code_main)
    doppler_main = np.where(first["doppler"] == -(1 << 31), np.nan, first["doppler"] * 1e-4)
    code_offset = _read_signed(other["offsets"] & 7, 3) * 65536 + other["code"].astype(np.int64)
    no_code = ((other["offsets"] & 7) == 4) & (other["code"] == 0)
    code = np.where(own, code_main, np.where(no_code, np.nan, code_main + code_offset * 1e-3))
    doppler_offset = _read_signed(other["offsets"] >> 3, 5) * 65536 + other["doppler"].astype(np.int64)
    no_doppler = ((other["offsets"] >> 3) == 16) & (other["doppler"] == 0)
    scaled = doppler_main * frequency / main_frequency + doppler_offset * 1e-4
    doppler = np.where(own, doppler_main, np.where(no_doppler, np.nan, scaled))
    msb = np.where(own, first["carrier_msb"], other["carrier_msb"]).astype(np.int64)
    lsb = np.where(own, first["carrier"], other["carrier"]).astype(np.int64)
    no_phase = (msb == -128) & (lsb == 0)
    phase = np.where(no_phase, np.nan, code * frequency / SPEED_OF_LIGHT + (msb * 65536 + lsb) * 1e-3)
    level = np.where(own, first["cn0"], other["cn0"]).astype(np.float64)
    cn0 = np.where(level == 255, np.nan, level * 0.25 + np.where(np.isin(number, _WITHOUT_OFFSET), 0.0, 10.0))
    lock = np.where(own, first["lock"], other["lock"]).astype(np.float64)
    unknown_lock = np.where(own, lock == 65535, lock == 255)
    info = np.where(own, first["info"], other["info"])
    glonass = np.char.startswith(satellite, "R")
    return {
        "satellite": np.where(known, satellite, ""),
        "signal": np.where(known, np.array([text[1:] for text in name.tolist()], dtype="<U2"), ""),
        "code_m": code,
        "phase_cycles": phase,
        "doppler_hz": doppler,
        "cn0_dbhz": cn0,
        "lock_s": np.where(unknown_lock, 0.0, lock),
        "half_cycle": (info & 4 != 0) & ~no_phase,
        "polarity": np.zeros(len(place), dtype=np.int64),
        "glonass_channel": np.where(glonass, channel, 99),
    }


def _signal_number(kind: Integers, info: Integers) -> Integers:
    """Return the signal number: bits 0 to 4 of Type, or, if these bits are 31, 32 plus bits 3 to 7 of ObsInfo."""
    low = np.asarray(kind, dtype=np.int64) & 31
    return np.where(low == 31, np.asarray(info, dtype=np.int64) // 8 + 32, low)


def _read_signed(value: Integers, bits: int) -> Integers:
    value = np.asarray(value, dtype=np.int64)
    return np.where(value >= 1 << bits - 1, value - (1 << bits), value)


def navigation_subframes(frames: Frames) -> Subframes:
    """Return the navigation pages that passed the receiver's check, arranged in words as in UBX RXM-SFRBX."""
    chosen = frames.of("sbf", *_PAGES)
    # The shortest block (GLONASS, three words) has 24 bytes; words that a block lacks are zero.
    chosen = chosen[frames.end[chosen] - frames.start[chosen] >= 24]
    data = np.concatenate([frames.data, np.zeros(_PAGE.itemsize, np.uint8)])
    rows, kind = gather_structures(data, frames.start[chosen], _PAGE), frames.kind[chosen]
    has = (frames.end - frames.start)[chosen][:, None] >= 16 + 4 * np.arange(10)
    words = np.where(has, rows["words"], 0).astype(np.uint32)
    satellite = _NAMES[rows["sv"]]
    signal = np.zeros(len(chosen), dtype=np.int64)
    known = np.zeros(len(chosen), dtype=bool)
    for number, (letter, signals) in _PAGES.items():
        of_kind = (kind == number) & np.char.startswith(satellite, letter)
        if signals is None:
            known |= of_kind
        for theirs, ours in (signals or {}).items():
            this = of_kind & (rows["source"] & 31 == theirs)
            signal[this], known = ours, known | this
    galileo, beidou = kind == GAL_RAW_INAV, kind == BDS_RAW
    words[galileo] = _inav_words(words[galileo])
    words[beidou] = _align_words(unpack_words(words[beidou], drop=0, keep=32)[:, :_BDS_BITS], 30)
    passed = rows["passed"] != 0
    counts = {
        "SBF navigation pages without valid CRC": int(np.count_nonzero(known & ~passed)),
        "SBF navigation pages of unknown satellites or signals": int(np.count_nonzero(~known)),
    }
    pages = Subframes(
        satellite=satellite,
        signal=signal,
        glonass_channel=rows["channel"].astype(np.int64) - 8,
        words=words,
        order=frames.frame_start[chosen],
        skipped={what: number for what, number in counts.items() if number},
    ).take(known & passed)
    return join_subframes(pages, _bcnav1_pages(frames))


def _bcnav1_pages(frames: Frames) -> Subframes:
    """Return the B-CNAV1 frames that have valid CRCs, each as three pages (`nav_messages.BCNAV1`)."""
    chosen, rows = frames.structures("sbf", [BDS_RAW_B1C], _FRAME)
    bits = np.unpackbits(rows["words"].astype(">u4").view(np.uint8).reshape(len(rows), 228), axis=1)
    subframe = {2: bits[:, 72:672], 3: bits[:, 1272:1536]}
    valid = (rows["crc"] == 1).all(axis=1) & has_crc(subframe[2], 576) & has_crc(subframe[3], 240)
    frame_of_week = 200 * np.packbits(subframe[2][:, 13:21], axis=1).astype(">u2") + np.packbits(bits[:, 21:29], axis=1)
    sent = np.unpackbits(frame_of_week.astype(">u2").view(np.uint8).reshape(len(rows), 2), axis=1)
    pages = np.zeros((len(rows), len(BCNAV1_PARTS), 320), dtype=np.uint8)
    for k, (number, first, end) in enumerate(BCNAV1_PARTS):
        pages[:, k, :6], pages[:, k, 6:8], pages[:, k, 8:24] = bits[:, :6], (k >> 1, k & 1), sent
        pages[:, k, 24 : 24 + end - first] = subframe[number][:, first:end]
    row = np.repeat(np.flatnonzero(valid), len(BCNAV1_PARTS))
    return Subframes(
        satellite=_NAMES[rows["sv"]][row],
        signal=np.full(len(row), BCNAV1_PAGE),
        glonass_channel=np.zeros(len(row), dtype=np.int64),
        words=_align_words(pages[valid], 32),
        order=frames.frame_start[chosen][row],
        skipped={"C B-CNAV1 without valid CRC": int(np.count_nonzero(~valid))} if not valid.all() else {},
    )


def clock_readings(frames: Frames) -> tuple[Integers, Datetimes]:
    """Return the offset in the stream and the time of each navigation page that has a time."""
    chosen, rows = frames.structures("sbf", [*_PAGES, BDS_RAW_B1C], _TIME)
    dated = (rows["tow_ms"] != _NO_TIME) & (rows["week"] != _NO_WEEK)
    times = from_week(rows["week"][dated].astype(np.int64), rows["tow_ms"][dated] * 1e-3)
    return frames.frame_start[chosen[dated]], times


def _align_words(bits: Bytes, length: int) -> Words:
    """Divide the bits of each message into ten right-aligned words of `length` bits, shape (N, 10)."""
    return read_unsigned(bits.reshape(-1, length), 0, length).reshape(-1, 10).astype(np.uint32)


def _inav_words(words: Words) -> Words:
    """Divide page pairs into words: four for the even page, which lacks its tail in SBF, and four for the odd page."""
    bits = unpack_words(words, drop=0, keep=32)
    pages = np.zeros((len(words), 320), dtype=np.uint8)
    pages[:, :_EVEN_BITS] = bits[:, :_EVEN_BITS]
    pages[:, 128:248] = bits[:, _EVEN_BITS : _EVEN_BITS + 120]
    return _align_words(pages, 32)


def positions(frames: Frames) -> dict[str, np.ndarray]:
    """Return the positions in PVTGeodetic or, if there are none, PVTCartesian blocks, as columns of `PositionLog`."""
    geodetic = len(frames.of("sbf", PVT_GEODETIC)) > 0
    _, rows = frames.structures("sbf", [PVT_GEODETIC if geodetic else PVT_CARTESIAN], _PVT)
    mode = rows["mode"] & 15
    timed = (rows["tow_ms"] != _NO_TIME) & (rows["week"] != _NO_WEEK)
    rows = rows[(rows["error"] == 0) & np.isin(mode, list(_QUALITY)) & timed]
    place = rows["place"]
    if geodetic:
        place = ecef_from_geodetic(np.degrees(place[:, 0]), np.degrees(place[:, 1]), place[:, 2])
    return {
        "time": from_week(rows["week"].astype(np.int64), rows["tow_ms"] * 1e-3),
        "ecef_m": place,
        "quality": np.array([_QUALITY[int(m)] for m in rows["mode"] & 15], dtype=np.int64),
        "sigma_m": np.full((len(rows), 3), np.nan),
    }

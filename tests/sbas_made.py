"""SBAS messages made field by field, to order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from railfix.ranges.sbas import SbasMessages
from railfix.ranges.sbas.messages import PREAMBLES, with_parity

START = np.datetime64("2025-02-15T12:00:00", "ns")

Field = tuple[int, int]


def message(kind: int, second: int, *fields: Field) -> np.ndarray:
    """Type, then (value, length) fields from bit 14 on; preamble of the second, parity; shape (32,)."""
    text = f"{PREAMBLES[second % 3]:08b}{kind:06b}"
    for value, length in fields:
        assert -(1 << length) < 2 * value + 1 <= (1 << (length + 1)), (value, length)
        text += f"{value & ((1 << length) - 1):0{length}b}"
    assert len(text) <= 226, (kind, len(text))
    bits = np.array([int(c) for c in text.ljust(256, "0")], dtype=np.uint8)
    return with_parity(np.packbits(bits)[None, :])[0]


def made(rows: Sequence[tuple[float, int, np.ndarray]], prn: int = 137) -> SbasMessages:
    """Log of (second of reception, PRN or 0 for the usual one, message) in the order of time."""
    rows = sorted(rows, key=lambda row: row[0])
    bits = np.array([row[2] for row in rows], dtype=np.uint8).reshape(-1, 32)
    count = len(rows)
    return SbasMessages(
        time=START + np.array([round(row[0] * 1e9) for row in rows], dtype="timedelta64[ns]"),
        prn=np.array([row[1] or prn for row in rows], dtype=np.int64),
        type=(bits[:, 1] >> 2).astype(np.int64),
        bits=bits,
        parity_bits=np.full(count, 24),
        source=np.zeros(count, dtype=np.int64),
        line=np.arange(1, count + 1),
        sources=("made",),
    )


def mask(second: int, numbers: Sequence[int], iodp: int = 0) -> np.ndarray:
    """Type 1."""
    return message(1, second, *((int(i in numbers), 1) for i in range(1, 211)), (iodp, 2))


def fast(
    second: int,
    prc: Sequence[float],
    udrei: Sequence[int],
    *,
    kind: int = 2,
    iodf: int = 0,
    iodp: int = 0,
) -> np.ndarray:
    """Types 0 and 2 to 5; corrections in metres, slots left over are not monitored."""
    values = [round(v / 0.125) for v in prc] + [0] * (13 - len(prc))
    grades = list(udrei) + [14] * (13 - len(udrei))
    return message(kind, second, (iodf, 2), (iodp, 2), *((v, 12) for v in values), *((g, 4) for g in grades))


def integrity(second: int, udrei: Sequence[int], iodf: Sequence[int] = (0, 0, 0, 0)) -> np.ndarray:
    """Type 6."""
    grades = list(udrei) + [14] * (51 - len(udrei))
    return message(6, second, *((i, 2) for i in iodf), *((g, 4) for g in grades))


def factors(second: int, indicator: Sequence[int], *, latency: int = 0, iodp: int = 0) -> np.ndarray:
    """Type 7."""
    values = list(indicator) + [0] * (51 - len(indicator))
    return message(7, second, (latency, 4), (iodp, 2), (0, 2), *((v, 4) for v in values))


def parameters(second: int, **values: int) -> np.ndarray:
    """Type 10, raw numbers by name."""
    layout = {
        "brrc": 10, "cltc_lsb": 10, "cltc_v1": 10, "iltc_v1": 9, "cltc_v0": 10, "iltc_v0": 9, "cgeo_lsb": 10,
        "cgeo_v": 10, "igeo": 9, "cer": 6, "ciono_step": 10, "iiono": 9, "ciono_ramp": 10, "rss_udre": 1,
        "rss_iono": 1, "ccovariance": 7,
    }  # fmt: skip
    assert set(values) <= set(layout)
    return message(10, second, *((values.get(name, 0), length) for name, length in layout.items()))


Still = tuple[int, int, tuple[float, float, float], float]


def _half(satellites: Sequence[Still], iodp: int) -> list[Field]:
    """Half of type 25 without velocity: (slot from 1, IODE, position [m], clock [2^-31 s]) of up to two."""
    fields: list[Field] = [(0, 1)]
    for i in range(2):
        slot, iode, position, clock = satellites[i] if i < len(satellites) else (0, 0, (0.0, 0.0, 0.0), 0.0)
        fields += [(slot, 6), (iode, 8), *((round(v / 0.125), 9) for v in position), (round(clock), 10)]
    return [*fields, (iodp, 2), (0, 1)]


def long_term(second: int, satellites: Sequence[Still], iodp: int = 0) -> np.ndarray:
    """Type 25 of velocity code 0, up to four satellites."""
    return message(25, second, *_half(satellites[:2], iodp), *_half(satellites[2:], iodp))


def moving(
    second: int,
    slot: int,
    iode: int,
    position: Sequence[float],
    velocity: Sequence[int],
    clock: int,
    rate: int,
    time_of_day: int,
    iodp: int = 0,
) -> np.ndarray:
    """Type 25 of velocity code 1, one satellite in the first half; velocities and clock are raw numbers."""
    first = [
        (1, 1), (slot, 6), (iode, 8), *((round(v / 0.125), 11) for v in position), (clock, 11),
        *((v, 8) for v in velocity), (rate, 8), (time_of_day // 16, 13), (iodp, 2),
    ]  # fmt: skip
    return message(25, second, *first, *_half([], iodp))


def mixed(
    second: int,
    prc: Sequence[float],
    udrei: Sequence[int],
    satellites: Sequence[Still],
    *,
    block: int = 0,
    iodf: int = 0,
    iodp: int = 0,
) -> np.ndarray:
    """Type 24: six fast corrections and half a type 25."""
    values = [round(v / 0.125) for v in prc] + [0] * (6 - len(prc))
    grades = list(udrei) + [14] * (6 - len(udrei))
    head = [*((v, 12) for v in values), *((g, 4) for g in grades), (iodp, 2), (block, 2), (iodf, 2), (0, 4)]
    return message(24, second, *head, *_half(satellites, iodp))


def grid_mask(second: int, band: int, bits: Sequence[int], iodi: int = 0, bands: int = 1) -> np.ndarray:
    """Type 18; bits from 0."""
    return message(18, second, (bands, 4), (band, 4), (iodi, 2), *((int(i in bits), 1) for i in range(201)))


def grid_delay(
    second: int, band: int, block: int, delay: Sequence[float], givei: Sequence[int], iodi: int = 0
) -> np.ndarray:
    """Type 26; delays in metres, 63.875 says do not use; points left over are not monitored."""
    raw = [round(v / 0.125) for v in delay] + [0] * (15 - len(delay))
    grades = list(givei) + [15] * (15 - len(givei))
    pairs = [field for v, g in zip(raw, grades, strict=True) for field in ((v, 9), (g, 4))]
    return message(26, second, (band, 4), (block, 4), *pairs, (iodi, 2))


def service(
    second: int,
    *,
    inside: int,
    outside: int,
    regions: Sequence[tuple[int, int, int, int, int]],
    issue: int = 0,
    messages: int = 1,
    number: int = 1,
    priority: int = 0,
) -> np.ndarray:
    """Type 27; regions (latitude 1, longitude 1, latitude 2, longitude 2, square)."""
    head = [(issue, 3), (messages - 1, 3), (number - 1, 3), (len(regions), 3), (priority, 2), (inside, 4), (outside, 4)]
    corners = [field for a, b, c, d, s in regions for field in ((a, 8), (b, 9), (c, 8), (d, 9), (s, 1))]
    return message(27, second, *head, *corners)


def covariance(
    second: int, slot: int, exponent: int, diagonal: Sequence[int], upper: Sequence[int], iodp: int = 0
) -> np.ndarray:
    """Type 28 of one satellite (slot from 1): E11 E22 E33 E44, E12 E13 E14 E23 E24 E34."""
    fields = [(iodp, 2), (slot, 6), (exponent, 3), *((v, 9) for v in diagonal), *((v, 10) for v in upper)]
    return message(28, second, *fields)

"""SBAS messages of 250 bits from their fields (RTCA DO-229D, appendix A.4.4): types 1 to 7, 10, 18, 24, 25, 26."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes
from railfix.ranges.sbas.messages import DATA_BITS, PREAMBLES, with_parity

Field = tuple[int, int]
#: Slot, IODE, position [m] and clock [2^-31 s] of a long-term correction without velocity.
LongTerm = tuple[int, int, tuple[float, float, float], float]

#: Resolution of corrections and delays [m].
STEP_M: Final = 0.125
#: UDREI and GIVEI of slots and points that are not monitored.
NOT_MONITORED: Final = 14
NO_DELAY: Final = 15
#: Fields of type 10 in their order, with their lengths.
DEGRADATION: Final = {
    "brrc": 10, "cltc_lsb": 10, "cltc_v1": 10, "iltc_v1": 9, "cltc_v0": 10, "iltc_v0": 9, "cgeo_lsb": 10,
    "cgeo_v": 10, "igeo": 9, "cer": 6, "ciono_step": 10, "iiono": 9, "ciono_ramp": 10, "rss_udre": 1,
    "rss_iono": 1, "ccovariance": 7,
}  # fmt: skip


def message(kind: int, second: int, *fields: Field) -> Bytes:
    """Message of a type, with one of the three preambles by its second, and its parity, shape (32,).

    The fields (value, length) lie from bit 14 on, negative values in two's complement. ValueError: when a value does
    not fit its field, or the fields are longer than a message.
    """
    text = f"{PREAMBLES[second % 3]:08b}{kind:06b}"
    for value, length in fields:
        if not -(1 << length) < 2 * value + 1 <= (1 << (length + 1)):
            raise ValueError(f"type {kind}: {value} does not fit {length} bits")
        text += f"{value & ((1 << length) - 1):0{length}b}"
    if len(text) > DATA_BITS:
        raise ValueError(f"type {kind}: {len(text)} bits, expected at most {DATA_BITS}")
    bits = np.array([int(c) for c in text.ljust(256, "0")], dtype=np.uint8)
    return np.asarray(with_parity(np.packbits(bits)[None, :])[0])


def mask(second: int, numbers: Collection[int], iodp: int = 0) -> Bytes:
    """Type 1: satellites by their numbers of the PRN mask."""
    return message(1, second, *((int(i in numbers), 1) for i in range(1, 211)), (iodp, 2))


def fast(
    second: int,
    prc: Sequence[float],
    udrei: Sequence[int],
    *,
    kind: int = 2,
    iodf: int = 0,
    iodp: int = 0,
) -> Bytes:
    """Types 0 and 2 to 5; corrections in metres, slots left over are not monitored."""
    values = [round(v / STEP_M) for v in prc] + [0] * (13 - len(prc))
    grades = list(udrei) + [NOT_MONITORED] * (13 - len(udrei))
    return message(kind, second, (iodf, 2), (iodp, 2), *((v, 12) for v in values), *((g, 4) for g in grades))


def integrity(second: int, udrei: Sequence[int], iodf: Sequence[int] = (0, 0, 0, 0)) -> Bytes:
    """Type 6: UDREI of all slots."""
    grades = list(udrei) + [NOT_MONITORED] * (51 - len(udrei))
    return message(6, second, *((i, 2) for i in iodf), *((g, 4) for g in grades))


def factors(second: int, indicator: Sequence[int], *, latency: int = 0, iodp: int = 0) -> Bytes:
    """Type 7: degradation indicator of all slots."""
    values = list(indicator) + [0] * (51 - len(indicator))
    return message(7, second, (latency, 4), (iodp, 2), (0, 2), *((v, 4) for v in values))


def parameters(second: int, **values: int) -> Bytes:
    """Type 10 with raw numbers by name, those of `DEGRADATION`; 0 where not given."""
    if unknown := values.keys() - DEGRADATION.keys():
        raise ValueError(f"type 10 has no field {min(unknown)}")
    return message(10, second, *((values.get(name, 0), length) for name, length in DEGRADATION.items()))


def half(satellites: Sequence[LongTerm], iodp: int) -> list[Field]:
    """Half of type 25 without velocity: (slot from 1, IODE, position [m], clock [2^-31 s]) of up to two."""
    fields: list[Field] = [(0, 1)]
    for i in range(2):
        slot, iode, position, clock = satellites[i] if i < len(satellites) else (0, 0, (0.0, 0.0, 0.0), 0.0)
        fields += [(slot, 6), (iode, 8), *((round(v / STEP_M), 9) for v in position), (round(clock), 10)]
    return [*fields, (iodp, 2), (0, 1)]


def long_term(second: int, satellites: Sequence[LongTerm], iodp: int = 0) -> Bytes:
    """Type 25 of velocity code 0, up to four satellites."""
    return message(25, second, *half(satellites[:2], iodp), *half(satellites[2:], iodp))


def mixed(
    second: int,
    prc: Sequence[float],
    udrei: Sequence[int],
    satellites: Sequence[LongTerm],
    *,
    block: int = 0,
    iodf: int = 0,
    iodp: int = 0,
) -> Bytes:
    """Type 24: six fast corrections and half a type 25."""
    values = [round(v / STEP_M) for v in prc] + [0] * (6 - len(prc))
    grades = list(udrei) + [NOT_MONITORED] * (6 - len(udrei))
    head = [*((v, 12) for v in values), *((g, 4) for g in grades), (iodp, 2), (block, 2), (iodf, 2), (0, 4)]
    return message(24, second, *head, *half(satellites, iodp))


def grid_mask(second: int, band: int, bits: Collection[int], iodi: int = 0, bands: int = 1) -> Bytes:
    """Type 18; bits from 0."""
    return message(18, second, (bands, 4), (band, 4), (iodi, 2), *((int(i in bits), 1) for i in range(201)))


def grid_delay(
    second: int, band: int, block: int, delay: Sequence[float], givei: Sequence[int], iodi: int = 0
) -> Bytes:
    """Type 26; delays in metres, 63.875 says do not use; points left over are not monitored."""
    raw = [round(v / STEP_M) for v in delay] + [0] * (15 - len(delay))
    grades = list(givei) + [NO_DELAY] * (15 - len(givei))
    pairs = [field for v, g in zip(raw, grades, strict=True) for field in ((v, 9), (g, 4))]
    return message(26, second, (band, 4), (block, 4), *pairs, (iodi, 2))

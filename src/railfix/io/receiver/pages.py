"""Navigation pages of receivers: which message each is, whether its check holds, and its fields."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Integers, Masks
from railfix.io.receiver import nav_messages
from railfix.io.receiver.framing import Field, Subframes, fields, packed_words, unsigned
from railfix.io.receiver.measurements import Values

#: Galileo data source: I/NAV with clock and group delay E5b/E1, received on E1-B or on E5b-I.
E1B_SOURCE, E5B_SOURCE = 1 << 0 | 1 << 9, 1 << 2 | 1 << 9
#: Galileo data source: F/NAV with clock and group delay E5a/E1.
E5A_SOURCE: Final = 1 << 1 | 1 << 8
_UBX_E5B: Final = (5, 6)
_UBX_E5A: Final = (3, 4)
_CNAV_SIGNALS: Final = {"G": (3, 4, 6, 7), "J": (4, 5, 8, 9)}  #: Signals with CNAV: L2C and L5.
#: BeiDou signals with D1 or D2, B-CNAV1 (B1C) and B-CNAV2 (B2a).
_D_SIGNALS, _B1C, _B2A = (0, 1, 2, 3, 4, 10), (5, 6), (7, 8)
#: Numbers of F/NAV pages and of CNAV messages among those of a satellite come after these.
FNAV_FROM, CNAV_FROM = 200, 300
_PREAMBLE: Final = 0x8B
#: Layouts by kind, with the fields that all messages of a family begin with.
_LNAV: Final = {k: nav_messages.LNAV_HEAD | layout for k, layout in nav_messages.LNAV.items()}
_CNAV: Final = {k: nav_messages.CNAV_HEAD | layout for k, layout in nav_messages.CNAV.items()}
_BCNAV2: Final = {k: nav_messages.BCNAV2_HEAD | layout for k, layout in nav_messages.BCNAV2.items()}
_D1: Final = {k: nav_messages.BDS_HEAD | layout for k, layout in nav_messages.D1.items()}
Pages = Iterator[tuple[int, int, Values]]  #: Row, number among those of the satellite, and fields of each page.


def decoded_pages(subframes: Subframes) -> tuple[list[tuple[int, str, int, Values]], Counter[str]]:
    """Decoded pages in the order of the stream: row, satellite, number, fields."""
    counts = Counter(subframes.skipped)
    pages: list[tuple[int, str, int, Values]] = []
    letters = subframes.satellite.astype("<U1")
    for letter, decode in (("G", _lnav), ("J", _lnav), ("E", _galileo), ("C", _beidou), ("R", _glonass)):
        rows = np.flatnonzero(letters == letter)
        if len(rows):
            for row, number, values in decode(subframes.take(rows), counts):
                pages.append((int(rows[row]), str(subframes.satellite[rows[row]]), number, values))
    pages.sort(key=lambda page: page[0])
    return pages, counts


def _of_kinds(
    bits: Bytes, valid: Masks, kind: Integers, layouts: Mapping[int, Mapping[str, Field]], first: int = 0
) -> Pages:
    """Row, number (`first` and the kind) and fields of the valid pages of each kind."""
    for k, layout in layouts.items():
        rows = np.flatnonzero(valid & (kind == k))
        table = fields(bits[rows], layout)
        for i, row in enumerate(rows.tolist()):
            yield row, first + k, {name: float(values[i]) for name, values in table.items()}


def _with_crc(
    part: Subframes, here: Masks, checked: int, counts: Counter[str], fault: str, preamble: int | None = None
) -> tuple[Bytes, Masks]:
    """Bits of pages, and which of those `here` have their preamble and CRC; the others count as `fault`."""
    bits = packed_words(part.words, drop=0, keep=32)
    if not here.any():
        return bits, here
    valid = here & nav_messages.has_crc(bits, checked)
    if preamble is not None:
        valid &= unsigned(bits, 0, 8) == preamble
    counts[fault] += int(np.count_nonzero(here & ~valid))
    return bits, valid


def _lnav(part: Subframes, counts: Counter[str]) -> Pages:
    """LNAV and CNAV."""
    letter, civil = str(part.satellite[0][0]), part.signal == 0
    cnav = np.isin(part.signal, _CNAV_SIGNALS[letter])
    counts[f"{letter} pages of other messages"] += int(np.count_nonzero(~cnav & ~civil))
    checked, fault = nav_messages.CNAV_CHECKED, f"{letter} CNAV without valid CRC"
    bits, valid = _with_crc(part, cnav, checked, counts, fault, _PREAMBLE)
    kind = unsigned(bits, 14, 6)
    kind = np.where((kind == 61) & (letter == "J"), 30, kind)  # a message of type 61 of QZSS is one of type 30
    yield from _of_kinds(bits, valid, kind, _CNAV, CNAV_FROM)
    bits = packed_words(part.words, drop=6, keep=24)
    yield from _of_kinds(bits, civil & (unsigned(bits, 0, 8) == _PREAMBLE), unsigned(bits, 43, 3), _LNAV)


def _galileo(part: Subframes, counts: Counter[str]) -> Pages:
    """I/NAV and F/NAV."""
    e5b, fnav = np.isin(part.signal, _UBX_E5B), np.isin(part.signal, _UBX_E5A)
    inav, fault = (part.signal == 1) | e5b, "E pages without valid CRC"
    counts["E pages of other messages"] += int(np.count_nonzero(~inav & ~fnav))
    bits, valid = _with_crc(part, fnav, nav_messages.FNAV_CHECKED, counts, fault)
    yield from _of_kinds(bits, valid, unsigned(bits, 0, 6), nav_messages.FNAV, FNAV_FROM)
    bits, valid = nav_messages.inav_words(part.words)
    counts[fault] += int(np.count_nonzero(inav & ~valid))
    for row, k, values in _of_kinds(bits, inav & valid, unsigned(bits, 0, 6), nav_messages.INAV):
        yield row, k, {**values, "source": float(E5B_SOURCE if e5b[row] else E1B_SOURCE)}


def _beidou(part: Subframes, counts: Counter[str]) -> Pages:
    """D1, D2 and B-CNAV2."""
    legacy, first, b2a = (np.isin(part.signal, signals) for signals in (_D_SIGNALS, _B1C, _B2A))
    counts["C pages of B-CNAV1 (B-CNAV2 of B2a is read, D1 and D2 too)"] += int(np.count_nonzero(first))
    counts["C pages of other messages"] += int(np.count_nonzero(~legacy & ~first & ~b2a))
    bits, valid = _with_crc(part, b2a, nav_messages.BCNAV2_CHECKED, counts, "C B-CNAV2 without valid CRC")
    yield from _of_kinds(bits, valid, unsigned(bits, 6, 6), _BCNAV2, CNAV_FROM)
    bits = packed_words(part.words, drop=0, keep=30)
    number = np.array([int(name[1:]) for name in part.satellite.tolist()])
    geo = (number <= 5) | (number >= 59)
    subframe = unsigned(bits, 15, 3)
    valid = legacy & (unsigned(bits, 0, 11) == 0x712)
    yield from _of_kinds(bits, valid & ~geo, subframe, _D1)
    heads = dict.fromkeys(range(1, 11), nav_messages.BDS_HEAD)
    for row, k, head in _of_kinds(bits, valid & geo & (subframe == 1), unsigned(bits, 42, 4), heads, 100):
        packed = int("".join(map(str, bits[row].tolist())), 2)
        yield row, k, {**head, "page": packed}  # the page whole: its fields go over page ends


def _glonass(part: Subframes, counts: Counter[str]) -> Pages:
    bits = packed_words(part.words[:, :3], drop=0, keep=32)[:, :85]
    valid = nav_messages.glonass_hamming(bits)
    counts["R strings without valid code"] += int(np.count_nonzero(~valid))
    for row, k, values in _of_kinds(bits, valid, unsigned(bits, 1, 4), nav_messages.GLONASS):
        yield row, k, {**values, "channel": float(part.glonass_channel[row])}

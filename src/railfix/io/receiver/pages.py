"""Navigation pages of receivers: which message each is, whether its check holds, and its fields."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Masks
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


def decoded_pages(subframes: Subframes) -> tuple[list[tuple[int, str, int, Values]], Counter[str]]:
    """Decoded pages in the order of the stream: row, satellite, number, fields."""
    counts = Counter(subframes.skipped)
    pages: list[tuple[int, str, int, Values]] = []
    letters = subframes.satellite.astype("<U1")
    for letter, decode in (("G", _lnav), ("J", _lnav), ("E", _inav), ("C", _beidou), ("R", _glonass)):
        rows = np.flatnonzero(letters == letter)
        if len(rows):
            for row, number, values in decode(subframes.take(rows), counts):
                pages.append((int(rows[row]), str(subframes.satellite[rows[row]]), number, values))
    pages.sort(key=lambda page: page[0])
    return pages, counts


def _rows(bits: Bytes, rows: np.ndarray, layout: Mapping[str, Field]) -> Iterator[tuple[int, Values]]:
    """Fields of some rows, a mapping each."""
    table = fields(bits[rows], layout)
    for k, row in enumerate(rows.tolist()):
        yield row, {name: float(values[k]) for name, values in table.items()}


def _lnav(part: Subframes, counts: Counter[str]) -> Iterator[tuple[int, int, Values]]:
    letter, civil = str(part.satellite[0][0]), part.signal == 0
    yield from _cnav(part, letter, counts)
    bits = packed_words(part.words, drop=6, keep=24)
    number = unsigned(bits, 43, 3)
    valid = civil & (unsigned(bits, 0, 8) == 0x8B)
    for k in (1, 2, 3, 4):
        for row, values in _rows(
            bits, np.flatnonzero(valid & (number == k)), nav_messages.LNAV_HEAD | nav_messages.LNAV[k]
        ):
            yield row, k, values


def _cnav(part: Subframes, letter: str, counts: Counter[str]) -> Iterator[tuple[int, int, Values]]:
    cnav = np.isin(part.signal, _CNAV_SIGNALS[letter])
    counts[f"{letter} pages of other messages"] += int(np.count_nonzero(~cnav & (part.signal != 0)))
    if not cnav.any():
        return
    bits = packed_words(part.words, drop=0, keep=32)
    valid = cnav & (unsigned(bits, 0, 8) == 0x8B) & nav_messages.has_crc(bits, nav_messages.CNAV_CHECKED)
    counts[f"{letter} CNAV without valid CRC"] += int(np.count_nonzero(cnav & ~valid))
    kind = unsigned(bits, 14, 6)
    for k, layout in nav_messages.CNAV.items():
        # a message of type 61 of QZSS is one of type 30
        rows = np.flatnonzero(valid & ((kind == k) | ((kind == 61) & (k == 30) & (letter == "J"))))
        for row, values in _rows(bits, rows, nav_messages.CNAV_HEAD | layout):
            yield row, CNAV_FROM + k, values


def _fnav(part: Subframes, counts: Counter[str]) -> Iterator[tuple[int, int, Values]]:
    here, fault = np.isin(part.signal, _UBX_E5A), "E pages without valid CRC"
    for row, kind, values in _by_kind(part, here, nav_messages.FNAV_CHECKED, 0, nav_messages.FNAV, counts, fault):
        yield row, FNAV_FROM + kind, values


def _by_kind(
    part: Subframes,
    here: Masks,
    checked: int,
    kind_bit: int,
    layouts: Mapping[int, Mapping[str, Field]],
    counts: Counter[str],
    fault: str,
) -> Iterator[tuple[int, int, Values]]:
    """Decode pages under a CRC by their kind, six bits from `kind_bit` on; those whose check fails count as `fault`."""
    if not here.any():
        return
    bits = packed_words(part.words, drop=0, keep=32)
    valid = here & nav_messages.has_crc(bits, checked)
    counts[fault] += int(np.count_nonzero(here & ~valid))
    kind = unsigned(bits, kind_bit, 6)
    for k, layout in layouts.items():
        for row, values in _rows(bits, np.flatnonzero(valid & (kind == k)), layout):
            yield row, k, values


def _inav(part: Subframes, counts: Counter[str]) -> Iterator[tuple[int, int, Values]]:
    inav = np.isin(part.signal, (1, *_UBX_E5B))
    yield from _fnav(part, counts)
    counts["E pages of other messages"] += int(np.count_nonzero(~inav & ~np.isin(part.signal, _UBX_E5A)))
    bits, valid = nav_messages.inav_words(part.words)
    counts["E pages without valid CRC"] += int(np.count_nonzero(inav & ~valid))
    kind = unsigned(bits, 0, 6)
    e5b = np.isin(part.signal, _UBX_E5B)
    for k in range(1, 7):
        for row, values in _rows(bits, np.flatnonzero(inav & valid & (kind == k)), nav_messages.INAV[k]):
            yield row, k, {**values, "source": float(E5B_SOURCE if e5b[row] else E1B_SOURCE)}


def _beidou(part: Subframes, counts: Counter[str]) -> Iterator[tuple[int, int, Values]]:
    legacy = np.isin(part.signal, _D_SIGNALS)
    yield from _bcnav2(part, counts)
    first = np.isin(part.signal, _B1C)
    counts["C pages of B-CNAV1 (B-CNAV2 of B2a is read, D1 and D2 too)"] += int(np.count_nonzero(first))
    counts["C pages of other messages"] += int(np.count_nonzero(~legacy & ~first & ~np.isin(part.signal, _B2A)))
    bits = packed_words(part.words, drop=0, keep=30)
    number = np.array([int(name[1:]) for name in part.satellite.tolist()])
    geo = (number <= 5) | (number >= 59)
    subframe = unsigned(bits, 15, 3)
    valid = legacy & (unsigned(bits, 0, 11) == 0x712)
    for k in (1, 2, 3):
        layout = nav_messages.BDS_HEAD | nav_messages.D1[k]
        for row, values in _rows(bits, np.flatnonzero(valid & ~geo & (subframe == k)), layout):
            yield row, k, values
    pages = np.flatnonzero(valid & geo & (subframe == 1))
    page = unsigned(bits, 42, 4)
    for k in range(1, 11):
        for row, head in _rows(bits, pages[page[pages] == k], nav_messages.BDS_HEAD):
            packed = int("".join(map(str, bits[row].tolist())), 2)
            yield row, 100 + k, {**head, "page": packed}  # the page whole: its fields go over page ends


def _bcnav2(part: Subframes, counts: Counter[str]) -> Iterator[tuple[int, int, Values]]:
    here, fault = np.isin(part.signal, _B2A), "C B-CNAV2 without valid CRC"
    layouts = {k: nav_messages.BCNAV2_HEAD | layout for k, layout in nav_messages.BCNAV2.items()}
    for row, kind, values in _by_kind(part, here, nav_messages.BCNAV2_CHECKED, 6, layouts, counts, fault):
        yield row, CNAV_FROM + kind, values


def _glonass(part: Subframes, counts: Counter[str]) -> Iterator[tuple[int, int, Values]]:
    bits = packed_words(part.words[:, :3], drop=0, keep=32)[:, :85]
    valid = nav_messages.glonass_hamming(bits)
    counts["R strings without valid code"] += int(np.count_nonzero(~valid))
    number = unsigned(bits, 1, 4)
    for k in (1, 2, 3, 4):
        for row, values in _rows(bits, np.flatnonzero(valid & (number == k)), nav_messages.GLONASS[k]):
            yield row, k, {**values, "channel": float(part.glonass_channel[row])}

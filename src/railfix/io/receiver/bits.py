"""Bit fields of many messages at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Floats, Integers, Strings

#: A field: first bit, number of bits, factor, and how it is coded ("u" unsigned, "s" two's complement,
#: "m" sign and magnitude). A field in pieces is a tuple of (first bit, number of bits) instead of the first two.
Field = tuple[int | tuple[tuple[int, int], ...], int, float, str]

_LONGEST: Final = 62


def unsigned(bits: Bytes, first: int, length: int) -> Integers:
    """Unsigned integers from a bit field, shape (N,)."""
    if length > _LONGEST:
        raise ValueError(f"a field has at most {_LONGEST} bits, {length} were asked for")
    value = np.zeros(len(bits), dtype=np.int64)
    for column in bits[:, first : first + length].T:
        value = value << 1 | column
    return value


def signed(bits: Bytes, first: int, length: int) -> Integers:
    """Integers in two's complement from a bit field, shape (N,)."""
    value = unsigned(bits, first, length)
    return np.where(value >> (length - 1) & 1, value - (1 << length), value)


def sign_magnitude(bits: Bytes, first: int, length: int) -> Integers:
    """Integers as sign and magnitude (GLONASS), shape (N,)."""
    value = unsigned(bits, first + 1, length - 1)
    return np.where(bits[:, first] == 1, -value, value)


def fields(bits: Bytes, layout: Mapping[str, Field]) -> dict[str, Floats]:
    """All fields of a layout, scaled, shape (N,) each, of bits of shape (N, bits)."""
    values = {}
    for name, (where, length, factor, coding) in layout.items():
        if isinstance(where, tuple):
            joined = np.concatenate([bits[:, first : first + count] for first, count in where], axis=1)
            first = 0
        else:
            joined, first = bits, where
        read = {"u": unsigned, "s": signed, "m": sign_magnitude}[coding]
        values[name] = np.asarray(read(joined, first, length) * factor, dtype=np.float64)
    return values


@dataclass(frozen=True, kw_only=True)
class Subframes:
    """Raw navigation words as UBX has them, N rows in the order of the stream."""

    satellite: Strings
    signal: Integers  #: Signal number (UBX sigId; other formats are translated to it); shape (N,).
    glonass_channel: Integers
    #: Words of 30 or 32 bits, right-aligned; unused ones 0; shape (N, 10).
    words: np.ndarray[tuple[int, int], np.dtype[np.uint32]]
    order: Integers  #: Place in the stream, to tell which epoch came before; shape (N,).
    skipped: Mapping[str, int] = field(default_factory=dict)  #: Pages left out, by reason.

    def __len__(self) -> int:
        return len(self.satellite)

    def take(self, rows: Integers | np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Subframes:
        """Some of the rows."""
        return Subframes(
            satellite=self.satellite[rows],
            signal=self.signal[rows],
            glonass_channel=self.glonass_channel[rows],
            words=self.words[rows],
            order=self.order[rows],
            skipped=self.skipped,
        )


def joined_subframes(first: Subframes, second: Subframes) -> Subframes:
    """Subframes of two formats of one stream, in its order."""
    if not len(second) and not second.skipped:
        return first
    arrays = ("satellite", "signal", "glonass_channel", "words", "order")
    both = Subframes(
        **{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in arrays},
        skipped={**first.skipped, **second.skipped},
    )
    return both.take(np.argsort(both.order, kind="stable"))


@dataclass(frozen=True, kw_only=True)
class SbasFrames:
    """SBAS messages as a receiver passes them on, N of them; parity and preamble not checked here."""

    #: 1 ns after the receiver's epoch before the message, because that epoch came too early to use it; NaT before the
    #: receiver knew the time; shape (N,).
    time: Datetimes

    prn: Integers
    octets: Bytes  #: The 250 bits from the first preamble bit on, zero behind; shape (N, 32).

    def __len__(self) -> int:
        return len(self.time)


def sbas_frames(subframes: Subframes, time: Datetimes) -> SbasFrames:
    """SBAS messages among subframes: eight words of 32 bits, left-aligned (UBX-22008968, 3.17.9)."""
    rows = np.flatnonzero(np.char.startswith(subframes.satellite, "S"))
    octets = subframes.words[rows, :8].astype(">u4").view(np.uint8).reshape(len(rows), 32).copy()
    octets[:, 31] &= 0xC0
    prn = np.array([100 + int(name[1:]) for name in subframes.satellite[rows].tolist()], dtype=np.int64)
    return SbasFrames(time=time[rows] + np.timedelta64(1, "ns"), prn=prn, octets=octets)


def packed_words(words: np.ndarray[tuple[int, int], np.dtype[np.uint32]], *, drop: int, keep: int) -> Bytes:
    """Bits of words of which the lowest `drop` are left out and the next `keep` kept, shape (N, words * keep)."""
    shift = np.arange(keep - 1, -1, -1, dtype=np.uint32) + np.uint32(drop)
    bits = words[:, :, None] >> shift & np.uint32(1)
    return bits.reshape(len(words), -1).astype(np.uint8)

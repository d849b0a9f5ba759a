"""Find the UBX, RTCM 3, SBF and NMEA frames in a byte stream, and verify their checksums. Protocols may be mixed.

Sources: u-blox F9 HPG interface description (UBX-20033635), section 3; RTCM 10403.3, section 4; Septentrio mosaic-X5
reference guide, section 4.1 (SBF); NMEA 0183, section 5.3.
"""

from __future__ import annotations

import binascii
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Floats, Indices, Integers, Masks, RowArrays, Strings, join_rows
from railfix.core.checksums import crc24q
from railfix.core.files import FilePath, open_stream

#: Longer payloads and blocks are not accepted [bytes]. UBX and SBF allow 65 535, but receivers send less than 16 KiB.
LONGEST_FRAME: Final = 16_384
_NMEA_LONGEST: Final = 512
_LETTERS: Final = b"\x00ABCDEFGHIJKLMNOPQRSTUVWXYZ"
#: Whether each byte is valid as the first (row 0) and second (row 1) character of an NMEA address. The byte 0 is valid:
#: bytes beyond the end of the buffer are read as 0.
_ADDRESS: Final = np.array([[c in text for c in range(256)] for text in (_LETTERS, _LETTERS + b"0123456789")])

#: Value of each byte as a hexadecimal digit; 255 for bytes that are no such digit.
_HEX: Final = np.full(256, 255)
_HEX[np.frombuffer(b"0123456789ABCDEFabcdef", np.uint8)] = [*range(16), *range(10, 16)]


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Frames with valid checksums, in order of the stream."""

    data: Bytes  #: Buffer that contains the frames.
    protocol: Strings  #: Protocol of each frame, "ubx", "rtcm3", "sbf" or "nmea"; shape (N,).
    kind: Integers  #: Message type (UBX: class * 256 + id; RTCM 3: number; SBF: block number; NMEA: 0), shape (N,).
    #: Start and end of the payload in `data`, shape (N,). A UBX or RTCM 3 payload excludes header and checksum; the
    #: RTCM message number is included. An SBF payload begins at the time stamp, after the header of 8 bytes. An NMEA
    #: payload is the text from ``$`` to the character before ``*``.
    start: Indices
    end: Indices
    frame_start: Indices  #: Offset of each frame's first sync byte in `data`, shape (N,).
    consumed: int  #: Number of processed bytes of the buffer; the bytes after them may be the start of a frame.
    skipped_bytes: int  #: Number of processed bytes outside frames.
    bad_checksums: int  #: Number of complete frames with a wrong checksum that begin outside all valid frames.

    def __len__(self) -> int:
        return len(self.start)

    def of(self, protocol: str, *kinds: int) -> Indices:
        """Return the indices of a protocol's frames of the given kinds, or of all its frames if no kind is given."""
        own = self._by_protocol.get(protocol, np.empty(0, dtype=np.intp))
        return own[np.isin(self.kind[own], kinds)] if kinds and len(own) else own

    def structures(self, protocol: str, kinds: Iterable[int], layout: np.dtype) -> tuple[Indices, np.ndarray]:
        """Return the indices of frames of the given kinds that are long enough for `layout`, and their fields."""
        chosen = self.of(protocol, *kinds)
        chosen = chosen[self.end[chosen] - self.start[chosen] >= layout.itemsize]
        return chosen, gather_structures(self.data, self.start[chosen], layout)

    @cached_property
    def _by_protocol(self) -> dict[str, Indices]:
        """Return the indices of the frames of each protocol. They are cached, because a decoder looks up many kinds."""
        return {name: np.flatnonzero(self.protocol == name) for name in set(self.protocol.tolist())}


def gather_structures(data: Bytes, start: np.ndarray, layout: np.dtype) -> np.ndarray:
    """Return the structures with the fields `layout` at the offsets `start` of a buffer, shape (N,)."""
    block = data[start[:, None] + np.arange(layout.itemsize)] if len(start) else np.zeros((0, layout.itemsize), "u1")
    return np.ascontiguousarray(block).view(layout)[:, 0]


@dataclass(frozen=True)
class _FrameCandidates:
    """Offsets where a frame may start, with the contents of its header."""

    name: str
    frame: Indices
    kind: Integers
    start: Indices
    end: Indices
    frame_end: Indices
    valid: Masks


def find_frames(data: Bytes, *, at_end: bool = True) -> Frames:
    """Find the frames in a buffer. An incomplete last frame is skipped if `at_end` is True, else not consumed."""
    data = np.asarray(data, dtype=np.uint8)
    candidates = [_ubx(data), _rtcm(data), _sbf(data), _nmea(data, at_end=at_end)]
    incomplete = [c.frame[c.frame_end > len(data)] for c in candidates]
    complete = [c.frame_end <= len(data) for c in candidates]
    frame = np.concatenate([c.frame[k] for c, k in zip(candidates, complete, strict=True)])
    order = np.argsort(frame, kind="stable")
    frame = frame[order]

    def joined(name: str) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        parts = [getattr(c, name)[k] for c, k in zip(candidates, complete, strict=True)]
        return np.asarray(np.concatenate(parts)[order])

    frame_end, valid = joined("frame_end"), joined("valid").astype(bool)
    names = np.concatenate(
        [np.full(int(np.count_nonzero(k)), c.name, dtype="<U5") for c, k in zip(candidates, complete, strict=True)]
    )[order]
    accepted = _without_overlap(frame, frame_end, valid)
    last = int(frame_end[accepted[-1]]) if len(accepted) else 0
    waiting = np.concatenate(incomplete)
    waiting = waiting[waiting >= last]
    consumed = len(data) if at_end or not len(waiting) else int(waiting.min())
    if not at_end and not len(waiting):
        consumed = max(last, len(data) - 2)  # the last two bytes may be the start of a header
    inside = int((frame_end[accepted] - frame[accepted]).sum())
    return Frames(
        data=data,
        protocol=names[accepted],
        kind=joined("kind")[accepted],
        start=joined("start")[accepted],
        end=joined("end")[accepted],
        frame_start=frame[accepted],
        consumed=consumed,
        skipped_bytes=consumed - inside,
        bad_checksums=_outside(frame[~valid & (frame < consumed)], frame[accepted], frame_end[accepted]),
    )


def _without_overlap(start: Indices, end: Integers, valid: Masks) -> Indices:
    """Return the indices of the valid candidates that do not begin inside a previously accepted frame."""
    accepted, free = [], 0
    for k in np.flatnonzero(valid).tolist():
        if start[k] >= free:
            accepted.append(k)
            free = int(end[k])
    return np.array(accepted, dtype=np.intp)


def _outside(places: Indices, start: Indices, end: Integers) -> int:
    """Return how many of the offsets `places` are outside all accepted frames."""
    if not len(start):
        return len(places)
    before = np.searchsorted(start, places, side="right") - 1
    return int(np.count_nonzero((before < 0) | (places >= end[np.maximum(before, 0)])))


def _at(data: Bytes, index: Indices) -> Integers:
    """Return the bytes at the offsets `index`; bytes beyond the end of the buffer are 0."""
    return np.where(index < len(data), data[np.minimum(index, len(data) - 1)], 0).astype(np.int64)


def _pairs(data: Bytes, first: int, second: int) -> Indices:
    """Return the offsets where the byte `first` is followed by the byte `second`."""
    return np.flatnonzero((data[:-1] == first) & (data[1:] == second)) if len(data) > 1 else np.zeros(0, np.intp)


def _ubx(data: Bytes) -> _FrameCandidates:
    frame = _pairs(data, 0xB5, 0x62)
    length = _at(data, frame + 4) | _at(data, frame + 5) << 8
    plausible = length <= LONGEST_FRAME
    frame, length = frame[plausible], length[plausible]
    start, end = frame + 6, frame + 6 + length
    complete = end + 2 <= len(data)
    valid = np.zeros(len(frame), dtype=bool)
    # Fletcher checksum from running sums: A is the sum of the bytes from the class byte on, B the sum of all A.
    sums = np.concatenate([[0], np.cumsum(data, dtype=np.int64)])
    double = np.concatenate([[0], np.cumsum(sums[1:])])
    a0, a1 = frame[complete] + 2, end[complete]
    sum_a = sums[a1] - sums[a0]
    sum_b = double[a1] - double[a0] - (a1 - a0) * sums[a0]
    valid[complete] = (sum_a & 255 == data[a1]) & (sum_b & 255 == data[a1 + 1])
    kind = _at(data, frame + 2) << 8 | _at(data, frame + 3)
    return _FrameCandidates("ubx", frame, kind, start, end, end + 2, valid)


def _rtcm(data: Bytes) -> _FrameCandidates:
    frame = np.flatnonzero(data == 0xD3)
    high = _at(data, frame + 1)
    frame = frame[high < 4]
    length = (_at(data, frame + 1) & 3) << 8 | _at(data, frame + 2)
    frame, length = frame[length >= 2], length[length >= 2]
    start, end = frame + 3, frame + 3 + length
    complete = end + 3 <= len(data)
    valid = np.zeros(len(frame), dtype=bool)
    stop = end[complete]
    sent = data[stop].astype(np.int64) << 16 | data[stop + 1].astype(np.int64) << 8 | data[stop + 2]
    valid[complete] = crc24q(data, frame[complete], stop) == sent
    kind = _at(data, start) << 4 | _at(data, start + 1) >> 4
    return _FrameCandidates("rtcm3", frame, kind, start, end, end + 3, valid)


def _sbf(data: Bytes) -> _FrameCandidates:
    frame = _pairs(data, ord("$"), ord("@"))
    length = _at(data, frame + 6) | _at(data, frame + 7) << 8
    plausible = (length >= 8) & (length % 4 == 0) & (length <= LONGEST_FRAME)
    frame, length = frame[plausible], length[plausible]
    end = frame + length
    valid = np.zeros(len(frame), dtype=bool)
    for k in np.flatnonzero(end <= len(data)).tolist():
        sent = int(data[frame[k] + 2]) | int(data[frame[k] + 3]) << 8
        valid[k] = binascii.crc_hqx(data[frame[k] + 4 : end[k]].tobytes(), 0) == sent
    kind = (_at(data, frame + 4) | _at(data, frame + 5) << 8) & 0x1FFF
    return _FrameCandidates("sbf", frame, kind, frame + 8, end, end, valid)


def _nmea(data: Bytes, *, at_end: bool) -> _FrameCandidates:
    dollar = np.flatnonzero(data == ord("$"))
    # An address begins with a letter, followed by a letter or digit; any other ``$`` is part of a damaged message.
    dollar = dollar[_ADDRESS[0, _at(data, dollar + 1)] & _ADDRESS[1, _at(data, dollar + 2)]]
    star = np.flatnonzero(data == ord("*"))
    after = np.searchsorted(star, dollar)
    has = after < len(star)
    end = np.where(has, star[np.minimum(after, len(star) - 1)] if len(star) else 0, len(data))
    near = end - dollar < _NMEA_LONGEST
    frame, end = dollar[near], end[near]
    sums = np.concatenate([[0], np.bitwise_xor.accumulate(data)]) if len(data) else np.zeros(1, np.uint8)
    complete = end + 3 <= len(data)
    valid = np.zeros(len(frame), dtype=bool)
    first, stop = frame[complete] + 1, end[complete]
    valid[complete] = (sums[stop] ^ sums[first]) == (_HEX[data[stop + 1]] << 4 | _HEX[data[stop + 2]])
    line_end = end + 3 + (_at(data, end + 3) == ord("\r"))
    frame_end = line_end + (_at(data, line_end) == ord("\n"))
    if not at_end:  # a sentence whose line end may be incomplete is kept for the next buffer
        frame_end = np.where(line_end >= len(data), len(data) + 1, frame_end)
    return _FrameCandidates("nmea", frame, np.zeros(len(frame), np.int64), frame, end, frame_end, valid)


#: Number of first bytes of a file in which frames are searched to recognise a receiver log.
_HEAD_BYTES: Final = 1 << 16


def is_receiver_log(head: bytes) -> bool:
    """Return whether the first bytes of a file contain a UBX, RTCM 3 or SBF frame with a valid checksum."""
    frames = find_frames(np.frombuffer(head, dtype=np.uint8))
    return bool(np.isin(frames.protocol, ["ubx", "rtcm3", "sbf"]).any())


def read_head(path: FilePath) -> bytes:
    """Return the first `_HEAD_BYTES` bytes of a file after decompression."""
    with open_stream(path, content="bytes") as stream:
        return stream.read(_HEAD_BYTES)


#: Field of a message: first bit, number of bits, scale factor and coding ("u" unsigned, "s" two's complement, "m" sign
#: and magnitude). A divided field has a tuple of (first bit, number of bits) pairs instead of the first bit.
Field = tuple[int | tuple[tuple[int, int], ...], int, float, str]

_LONGEST: Final = 62


def read_unsigned(bits: Bytes, first: int, length: int) -> Integers:
    """Return the unsigned integers in a bit field of N messages, shape (N,). `bits` has the shape (N, bits).

    Raise ValueError if the field has over 62 bits.
    """
    if length > _LONGEST:
        raise ValueError(f"a field has at most {_LONGEST} bits, {length} were requested")
    value = np.zeros(len(bits), dtype=np.int64)
    for column in bits[:, first : first + length].T:
        value = value << 1 | column
    return value


def read_signed(bits: Bytes, first: int, length: int) -> Integers:
    """Return the two's complement integers in a bit field, shape (N,)."""
    value = read_unsigned(bits, first, length)
    return np.where(value >> (length - 1) & 1, value - (1 << length), value)


def sign_magnitude(bits: Bytes, first: int, length: int) -> Integers:
    """Return the sign-magnitude integers (GLONASS) in a bit field, shape (N,)."""
    value = read_unsigned(bits, first + 1, length - 1)
    return np.where(bits[:, first] == 1, -value, value)


def fields(bits: Bytes, layout: Mapping[str, Field]) -> dict[str, Floats]:
    """Return the scaled values of all fields of a layout by name, shape (N,) each. `bits` has the shape (N, bits)."""
    values = {}
    for name, (where, length, factor, coding) in layout.items():
        if isinstance(where, tuple):
            joined = np.concatenate([bits[:, first : first + count] for first, count in where], axis=1)
            first = 0
        else:
            joined, first = bits, where
        read = {"u": read_unsigned, "s": read_signed, "m": sign_magnitude}[coding]
        values[name] = np.asarray(read(joined, first, length) * factor, dtype=np.float64)
    return values


@dataclass(frozen=True, kw_only=True)
class Subframes(RowArrays):
    """Raw navigation subframes in the layout of UBX RXM-SFRBX, N rows in the order of the stream."""

    satellite: Strings
    signal: Integers  #: UBX signal number (sigId), also used for other formats; shape (N,).
    glonass_channel: Integers  #: Frequency channel of a GLONASS satellite, shape (N,).
    #: Words of 30 or 32 bits, right-aligned; unused words are 0; shape (N, 10).
    words: np.ndarray[tuple[int, int], np.dtype[np.uint32]]
    order: Integers  #: Offset of each subframe in the stream, shape (N,).
    skipped: Mapping[str, int] = field(default_factory=dict)  #: Number of skipped pages for each reason.

    def __len__(self) -> int:
        return len(self.satellite)


def join_subframes(first: Subframes, second: Subframes) -> Subframes:
    """Join the subframes of two formats in one stream, in the order of the stream."""
    if not len(second) and not second.skipped:
        return first
    both = replace(join_rows([first, second]), skipped={**first.skipped, **second.skipped})
    return both.take(np.argsort(both.order, kind="stable"))


#: Values of `Subframes.signal` that UBX does not define, for SBAS on L5 and for B-CNAV1 pages.
SBAS_L5, BCNAV1_PAGE = -5, -6


@dataclass(frozen=True, kw_only=True)
class SbasFrames:
    """SBAS messages output by a receiver, N rows. Preamble and parity have not been checked."""

    #: Time of reception: 1 ns after the epoch before the message, shape (N,); NaT before the first time in the log.
    time: Datetimes

    prn: Integers  #: PRN of the SBAS satellite, shape (N,).
    octets: Bytes  #: Bytes of the message: 250 bits, beginning with the preamble, and zeros; shape (N, 32).
    on_l5: Masks  #: Whether the message was sent on L5 instead of L1, shape (N,).

    def __len__(self) -> int:
        return len(self.time)


def sbas_frames(subframes: Subframes, time: Datetimes) -> SbasFrames:
    """Return the SBAS messages among subframes. A message has eight words of 32 bits (UBX-22008968, 3.17.9)."""
    rows = np.flatnonzero(np.char.startswith(subframes.satellite, "S"))
    octets = subframes.words[rows, :8].astype(">u4").view(np.uint8).reshape(len(rows), 32).copy()
    octets[:, 31] &= 0xC0
    prn = np.array([100 + int(name[1:]) for name in subframes.satellite[rows].tolist()], dtype=np.int64)
    on_l5 = subframes.signal[rows] == SBAS_L5
    return SbasFrames(time=time[rows] + np.timedelta64(1, "ns"), prn=prn, octets=octets, on_l5=on_l5)


def unpack_words(words: np.ndarray[tuple[int, int], np.dtype[np.uint32]], *, drop: int, keep: int) -> Bytes:
    """Drop the lowest `drop` bits of each word, and return the next `keep` bits, shape (N, words * keep)."""
    shift = np.arange(keep - 1, -1, -1, dtype=np.uint32) + np.uint32(drop)
    bits = words[:, :, None] >> shift & np.uint32(1)
    return bits.reshape(len(words), words.shape[1] * keep).astype(np.uint8)

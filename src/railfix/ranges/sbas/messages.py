"""SBAS messages as received, with their preambles and 24-bit parity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Integers, Masks, RowArrays, freeze_rows, join_rows
from railfix.core.checksums import crc24q
from railfix.core.notebook import NotebookTable

Band = Literal["L1", "L5"]  #: Frequency band on which messages are sent.
#: Preambles of successive messages: on L1 three patterns of eight bits in turn (DO-229D, A.4.3.1), on L5 six patterns
#: of four bits.
PREAMBLES: Final[dict[Band, tuple[int, ...]]] = {"L1": (0x53, 0x9A, 0xC6), "L5": (0x5, 0xC, 0x6, 0x9, 0x3, 0xA)}
DATA_BITS: Final = 226  #: Number of bits of a message without parity: preamble, type and data.
ROW_BYTES: Final = 32  #: Number of bytes for a message in `SbasMessages.bits`.
#: A message that occurs again within this time is a duplicate, forwarded by a second receiver.
_REPEATED_WITHIN: Final = np.timedelta64(1, "s")


def message_parity(bits: Bytes) -> Integers:
    """Compute the parity of the first 226 bits of each message, shape (N,); `bits` have shape (N, 32)."""
    # Six leading zero bits extend 226 bits to whole bytes and do not change the parity.
    data = bits[:, :29].astype(np.int64)
    before = np.concatenate([np.zeros((len(bits), 1), dtype=np.int64), data[:, :-1]], axis=1)
    rows = ((before << 2) & 0xFF | data >> 6).astype(np.uint8)
    start = np.arange(len(rows)) * rows.shape[1]
    return crc24q(rows.reshape(-1), start, start + rows.shape[1])


def carried_parity(bits: Bytes) -> Integers:
    """Return the received parity, the 24 bits after the data bits of each message, shape (N,)."""
    tail = bits[:, 28:32].astype(np.int64)
    return ((tail[:, 0] & 0x3F) << 18) | (tail[:, 1] << 10) | (tail[:, 2] << 2) | (tail[:, 3] >> 6)


def with_parity(bits: Bytes) -> Bytes:
    """Return the messages with the computed parity, shape (N, 32); the bits after the parity are zero."""
    complete = np.zeros((len(bits), ROW_BYTES), dtype=np.uint8)
    complete[:, :29] = bits[:, :29]
    parity = message_parity(complete)
    complete[:, 28] = (complete[:, 28] & 0xC0) | (parity >> 18).astype(np.uint8)
    complete[:, 29] = ((parity >> 10) & 0xFF).astype(np.uint8)
    complete[:, 30] = ((parity >> 2) & 0xFF).astype(np.uint8)
    complete[:, 31] = ((parity << 6) & 0xFF).astype(np.uint8)
    return complete


def preamble_number(bits: Bytes, band: Band) -> Integers:
    """Return the index of each message's preamble in `PREAMBLES` of the band, -1 for other values, shape (N,)."""
    number = np.full(len(bits), -1, dtype=np.int64)
    first = bits[:, 0] if band == "L1" else bits[:, 0] >> 4
    for i, preamble in enumerate(PREAMBLES[band]):
        number[first == preamble] = i
    return number


def message_type(bits: Bytes, band: Band = "L1") -> Integers:
    """Return the message types, the six bits after the preambles, shape (N,)."""
    second = bits[:, 1].astype(np.int64)
    return second >> 2 if band == "L1" else (bits[:, 0].astype(np.int64) & 15) << 2 | second >> 6


@dataclass(frozen=True, kw_only=True, repr=False)
class SbasMessages(RowArrays, NotebookTable):
    """Messages that passed every check, N rows in the order of their reception."""

    #: GPS time at which the message was completely received, shape (N,). The message is used from this time on.
    time: Datetimes
    prn: Integers  #: PRN of the GEO, shape (N,).
    type: Integers  #: Message type, 0 to 63, shape (N,).
    #: Bits of each message from the first preamble bit on, eight bits per byte, shape (N, 32). The data bits are
    #: followed by the parity, if the source contains it, then by zeros.
    bits: Bytes
    #: Number of parity bits that the source contains and that were checked: 24, 6 or 0; shape (N,).
    parity_bits: Integers
    source: Integers  #: Index in `sources`, shape (N,).
    line: Integers  #: 1-based line of the file, shape (N,).
    sources: tuple[str, ...] = ()  #: Names of the files or receivers.
    #: Number of messages left out, by reason: "parity", "preamble", "line", "duplicate".
    rejected: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  #: Warnings about the messages, one sentence each.
    band: Band = "L1"

    def __post_init__(self) -> None:
        freeze_rows(self, "messages")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def prns(self) -> tuple[int, ...]:
        """PRNs with messages, in ascending order."""
        return tuple(int(prn) for prn in np.unique(self.prn))

    def describe_choice(self, prn: int) -> str:
        """Return a sentence on a requested PRN; raise ValueError if the PRN has no message."""
        known = ", ".join(map(str, self.prns))
        if prn not in self.prns:
            raise ValueError(f"the log has no SBAS message of PRN {prn}; it has {known}")
        return f"SBAS PRN {prn} was requested; the log has {known}"

    def of(self, prn: int) -> SbasMessages:
        """Return the messages of one PRN; the counts of rejected messages are for all PRNs."""
        return self.take(self.prn == prn)

    @classmethod
    def none(cls) -> SbasMessages:
        """Return an empty table of messages."""
        time, number = np.zeros(0, dtype="datetime64[ns]"), np.zeros(0, dtype=np.int64)
        bits = np.zeros((0, ROW_BYTES), dtype=np.uint8)
        return cls(time=time, prn=number, type=number, bits=bits, parity_bits=number, source=number, line=number)

    def merge(self, later: SbasMessages) -> SbasMessages:
        """Return these and later messages in order of reception; counts are summed, and repeated notes are dropped."""
        if not len(later):
            return self
        both = join_rows([self, later])
        sources = tuple(dict.fromkeys((*self.sources, *later.sources)))
        number = np.array([sources.index(name) for name in (*self.sources, *later.sources)] or [0], dtype=np.int64)
        own = np.where(np.arange(len(both)) < len(self), 0, len(self.sources))
        joined = replace(
            both,
            source=number[np.minimum(both.source + own, len(number) - 1)],
            sources=sources,
            rejected=dict(Counter(self.rejected) + Counter(later.rejected)),
            notes=tuple(dict.fromkeys((*self.notes, *later.notes))),
            band=later.band,
        )
        return joined.take(np.argsort(both.time, kind="stable"))

    def repeated(self) -> Masks:
        """Return the mask of messages that repeat an earlier message (same bits and PRN within 1 s), shape (N,).

        The preambles of successive messages differ, so no GEO sends the same 250 bits twice in succession.
        """
        again = np.zeros(len(self), dtype=bool)
        order = np.lexsort((self.time, self.prn))
        for back in range(1, 4):
            later, earlier = order[back:], order[:-back]
            same = (self.prn[later] == self.prn[earlier]) & (self.bits[later] == self.bits[earlier]).all(axis=1)
            again[later] |= same & (self.time[later] - self.time[earlier] <= _REPEATED_WITHIN)
        return again

"""SBAS messages as they were received: the arrays every later step reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Integers, Masks, read_only
from railfix.ranges.sbas.names import DECODED, system_name, type_name


@dataclass(frozen=True, kw_only=True)
class SbasLog:
    """Messages that passed every check, N rows in the order of their reception.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (N,)
        GPS time at which the message had been received whole: from here on it may be used.
    prn : ndarray of int, shape (N,)
    type : ndarray of int, shape (N,)
        0 to 63.
    bits : ndarray of uint8, shape (N, 32)
        The message from its first preamble bit, eight bits a byte; parity from bit 226 on where
        the source carries it, zero behind.
    parity_bits : ndarray of int, shape (N,)
        How many bits of parity the source carried, and were checked: 24, 6 or 0.
    source : ndarray of int, shape (N,)
        Row of `sources`.
    line : ndarray of int, shape (N,)
        1-based line of the file.
    sources : tuple of str
        Files.
    refused : mapping of str to int
        Messages left out, by reason: "parity", "preamble", "line", "duplicate".
    notes : tuple of str
        What a reader of the results must know, one sentence each.
    """

    time: Datetimes
    prn: Integers
    type: Integers
    bits: Bytes
    parity_bits: Integers
    source: Integers
    line: Integers
    sources: tuple[str, ...] = ()
    refused: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                if len(value) != len(self.time):
                    raise ValueError(f"{item.name} has {len(value)} messages, time has {len(self.time)}")
                object.__setattr__(self, item.name, read_only(value))

    def __len__(self) -> int:
        return len(self.time)

    @property
    def prns(self) -> tuple[int, ...]:
        """PRNs that sent anything, rising."""
        return tuple(int(prn) for prn in np.unique(self.prn))

    def account(self) -> dict[str, int]:
        """Every message once: decoded by type, not decoded by type and name, or refused by reason.

        Returns
        -------
        dict of str to int
            "MSAS 137 type 2 fast corrections": 600, "MSAS 137 type 63 null, not decoded": 569,
            "refused: parity": 0 ... The values sum to the messages of the files.
        """
        counts = Counter(zip(self.prn.tolist(), self.type.tolist(), strict=True))
        rows = {
            f"{system_name(prn)} {prn} type {kind} {type_name(kind, prn)}"
            + ("" if kind in DECODED else ", not decoded"): number
            for (prn, kind), number in sorted(counts.items())
        }
        return rows | {f"refused: {reason}": number for reason, number in sorted(self.refused.items())}

    def of(self, prn: int) -> SbasLog:
        """The messages of one PRN; what was refused cannot be told apart and is kept whole."""
        return self.take(self.prn == prn)

    def take(self, rows: Masks | Integers) -> SbasLog:
        """Some of the messages."""
        arrays = {
            item.name: getattr(self, item.name)[rows]
            for item in fields(self)
            if isinstance(getattr(self, item.name), np.ndarray)
        }
        return SbasLog(**arrays, sources=self.sources, refused=self.refused, notes=self.notes)

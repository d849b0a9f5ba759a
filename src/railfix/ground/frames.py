"""Redundancy layer above two links: frames with sequence numbers and time stamps, as defences according to EN 50159.

The links encrypt and authenticate frames (QUIC, TLS 1.3); the CRC of a frame detects faults between this layer and the
links, but does not protect against attacks. A receiver uses each frame once, from the link that delivers it first. It
does not use frames that are older than a frame already used.
"""

from __future__ import annotations

import secrets
import struct
import zlib
from collections import Counter, deque
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Final, NamedTuple

from pydantic import Field

from railfix.core.settings import Settings

_HEAD: Final = struct.Struct("!BIQQq")
_ECHO: Final = struct.Struct("!Qqqq")
_CHECK: Final = struct.Struct("!I")
#: Longest payload [bytes]; a frame of this length fits a QUIC datagram.
LONGEST_PAYLOAD: Final = 1100
#: Number of recent sequence numbers that are stored to detect repeated frames.
REMEMBERED: Final = 4096
#: Number of earlier sessions of the sender whose identifiers are stored, to reject late frames.
RETIRED: Final = 64


def draw_session() -> int:
    """Return a random number that identifies one run of a program (a session), independent of any clock."""
    return secrets.randbits(62)


class FrameKind(IntEnum):
    """Kind of a frame."""

    #: Frame with a payload, which the receiver uses once.
    DATA = 1
    #: Answer to a frame.
    ECHO = 2
    #: Frame that only measures a link.
    PROBE = 3


class Threat(Enum):
    """Threats of EN 50159 that a receiver counts."""

    REPETITION = "repetition"
    DELETION = "deletion"
    INSERTION = "insertion"
    RESEQUENCING = "resequencing"
    CORRUPTION = "corruption"
    DELAY = "delay"
    MASQUERADE = "masquerade"


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Frame of the redundancy layer."""

    kind: FrameKind
    sender: int
    session: int  #: Random number that the sender draws at each start.
    sequence: int
    time_ns: int  #: Sender's monotonic clock at the time of sending [ns].
    payload: bytes = b""

    def encode(self) -> bytes:
        """Return the bytes of the frame, followed by their CRC."""
        if len(self.payload) > LONGEST_PAYLOAD:
            raise ValueError(f"the payload has {len(self.payload)} bytes; a frame holds at most {LONGEST_PAYLOAD}")
        data = _HEAD.pack(self.kind, self.sender, self.session, self.sequence, self.time_ns) + self.payload
        return data + _CHECK.pack(zlib.crc32(data))


class Echo(NamedTuple):
    """Answer to a frame: number of the frame, and times of sending, reception and answer."""

    sequence: int
    sent_ns: int
    received_ns: int
    answered_ns: int

    def encode(self) -> bytes:
        """Return the payload of an echo frame."""
        return _ECHO.pack(*self)

    @classmethod
    def decode(cls, payload: bytes) -> Echo | None:
        """Return the echo, None if the payload is not an echo."""
        return cls(*_ECHO.unpack(payload)) if len(payload) == _ECHO.size else None

    def round_trip_s(self, now_ns: int) -> float:
        """Return the round-trip time minus the answer delay of the other end [s]; the echo arrives at `now_ns`."""
        return (now_ns - self.sent_ns - (self.answered_ns - self.received_ns)) / 1e9


class ReceiverLimits(Settings):
    """Limits of a receiver."""

    delay_s: float = Field(default=5.0, gt=0)  #: Largest accepted delay in excess of the shortest observed delay.
    #: Largest relative drift between the clocks of both ends; the stored shortest delay grows at this rate.
    drift: float = Field(default=1e-4, ge=0)
    #: A frame is rejected if its sequence number exceeds the newest number by more than `jump`, plus `rate` for each
    #: second since the newest number arrived.
    jump: int = Field(default=1000, ge=1)
    #: Highest assumed rate at which the sender numbers its frames [1/s]; used with `jump`.
    rate: float = Field(default=100.0, gt=0)


@dataclass(kw_only=True)
class _Seen:
    """Received sequence numbers: the newest with its time of arrival, and the most recent numbers as bits."""

    newest: int = -1
    at_ns: int = 0
    bits: int = 0

    def is_alone(self, sequence: int, now_ns: int, limits: ReceiverLimits) -> bool:
        """Return whether a number is above all numbers that the sender can have reached since the newest number."""
        most = limits.jump + limits.rate * (now_ns - self.at_ns) / 1e9
        return self.newest >= 0 and sequence > self.newest + most

    def has(self, sequence: int) -> bool:
        behind = self.newest - sequence
        return behind >= REMEMBERED or (behind >= 0 and bool(self.bits >> behind & 1))

    def add(self, sequence: int, now_ns: int) -> None:
        if sequence > self.newest:
            self.at_ns = now_ns
            step = sequence - self.newest
            self.bits = ((self.bits << step) | 1) & ((1 << REMEMBERED) - 1) if step < REMEMBERED else 1
            self.newest = sequence
        else:
            self.bits |= 1 << (self.newest - sequence)


@dataclass(kw_only=True)
class FrameReceiver:
    """Receiver of the frames of one sender over any number of links."""

    #: Number of the sender, as named by the connection's certificate; frames of other senders are rejected.
    sender: int
    limits: ReceiverLimits = field(default_factory=ReceiverLimits)
    #: Number of rejected frames by threat; under `Threat.DELETION`, the number of skipped sequence numbers.
    threats: Counter[Threat] = field(default_factory=Counter)
    _session: int | None = None
    _retired: deque[int] = field(default_factory=lambda: deque(maxlen=RETIRED))
    _accepted: _Seen = field(default_factory=_Seen)
    _links: dict[tuple[str, FrameKind], _Seen] = field(default_factory=dict)
    _shortest_ns: float | None = None
    _at_ns: int = 0

    def receive(self, link: str, data: bytes, now_ns: int) -> tuple[Frame | None, Frame | None]:
        """Return the frame to answer and the frame to use; each may be None.

        A second copy of a frame is answered but not used, so that both links are measured.
        """
        frame = self._decode(data)
        if frame is None:
            return None, None
        if frame.session != self._session:
            if frame.session in self._retired:
                return self._reject(Threat.RESEQUENCING)
            self._begin(frame.session)
        on_link = self._links.setdefault((link, frame.kind), _Seen())
        if on_link.has(frame.sequence):
            return self._reject(Threat.REPETITION)
        if on_link.is_alone(frame.sequence, now_ns, self.limits):
            return self._reject(Threat.INSERTION)
        if self._late(frame, now_ns):
            return self._reject(Threat.DELAY)
        on_link.add(frame.sequence, now_ns)
        if frame.kind is not FrameKind.DATA or self._accepted.has(frame.sequence):
            return frame, None
        if frame.sequence < self._accepted.newest:
            self.threats[Threat.RESEQUENCING] += 1
            return frame, None
        if self._accepted.newest >= 0:
            self.threats[Threat.DELETION] += frame.sequence - self._accepted.newest - 1
        self._accepted.add(frame.sequence, now_ns)
        return frame, frame

    def _begin(self, session: int) -> None:
        """Reset after a restart of the sender, because the sender's sequence numbers and clock start again."""
        if self._session is not None:
            self._retired.append(self._session)
        self._session, self._accepted, self._links, self._shortest_ns = session, _Seen(), {}, None

    def _decode(self, data: bytes) -> Frame | None:
        if not _HEAD.size + _CHECK.size <= len(data) <= _HEAD.size + _CHECK.size + LONGEST_PAYLOAD:
            self.threats[Threat.CORRUPTION] += 1
            return None
        body = data[: -_CHECK.size]
        if zlib.crc32(body) != _CHECK.unpack(data[-_CHECK.size :])[0]:
            self.threats[Threat.CORRUPTION] += 1
            return None
        kind, sender, session, sequence, time_ns = _HEAD.unpack(body[: _HEAD.size])
        if sender != self.sender:
            self.threats[Threat.MASQUERADE] += 1
            return None
        if kind not in tuple(FrameKind):
            self.threats[Threat.INSERTION] += 1
            return None
        payload = body[_HEAD.size :]
        return Frame(
            kind=FrameKind(kind), sender=sender, session=session, sequence=sequence, time_ns=time_ns, payload=payload
        )

    def _late(self, frame: Frame, now_ns: int) -> bool:
        """Return whether a frame's delay exceeds the shortest delay by over `delay_s`; the two clocks may differ."""
        took = now_ns - frame.time_ns
        if self._shortest_ns is None:
            self._shortest_ns = float(took)
        self._shortest_ns = min(float(took), self._shortest_ns + self.limits.drift * (now_ns - self._at_ns))
        self._at_ns = now_ns
        return took - self._shortest_ns > self.limits.delay_s * 1e9

    def _reject(self, threat: Threat) -> tuple[None, None]:
        self.threats[threat] += 1
        return None, None

"""Supervision on board: the newest authority of the centre and its time limit."""

from __future__ import annotations

import math
import struct
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal

from pydantic import Field, ValidationError

from railfix.core.settings import Settings, option
from railfix.io.train_message import MessageError

#: Version of the message; a receiver rejects others.
VERSION: Final = 2
_FORM: Final = struct.Struct("!BIQQqb??")


class Authority(Settings):
    """One authority message, sent after each report of the train, at a stop, and at least every second."""

    train: Annotated[int, Field(ge=0, lt=1 << 32)]
    number: Annotated[int, Field(ge=0, lt=1 << 63)]  #: Rises with every message of the centre, also over its restarts.
    #: Sequence number of the train's newest report that the centre has stored, 0 without one: an acknowledgement, and
    #: the train's measure of the age of this message on its own clock.
    report: Annotated[int, Field(ge=0, lt=1 << 63)]
    end_cm: Annotated[int, Field(ge=-(1 << 62), lt=1 << 62)]  #: Chainage where the authority ends.
    direction: Literal[-1, 1]
    stopped: bool  #: Satellite positioning is suspended, the train stops.
    #: The end is one that the train is asked to take in place of a further one, where it can stop before it.
    shortens: bool = False

    def encode(self) -> bytes:
        """Return the bytes of the message."""
        return _FORM.pack(
            VERSION, self.train, self.number, self.report, self.end_cm, self.direction, self.stopped, self.shortens
        )  # fmt: skip

    @classmethod
    def decode(cls, data: bytes) -> Authority:
        """Return the message of some bytes.

        Raises
        ------
        MessageError
            The bytes are no authority message of this version.
        """
        if len(data) != _FORM.size:
            raise MessageError(f"has {len(data)} bytes, an authority has {_FORM.size}")
        version, *values = _FORM.unpack(data)
        if version != VERSION:
            raise MessageError(f"is an authority of version {version}, {VERSION} was expected")
        try:
            return cls(**dict(zip(cls.model_fields, values, strict=True)))
        except ValidationError as error:
            first = error.errors()[0]
            raise MessageError(f"{first['loc'][0]}: {first['msg']}") from None


#: Reports of which the time of sending is remembered.
REMEMBERED: Final = 600


class OnBoardLimits(Settings):
    """Limits on board."""

    #: Time limit of authorities: the train brakes where the newest one answers a report that was sent longer ago.
    fresh_s: float = option(
        "Time limit of authorities: older ones brake the train.", 15.0, name="--fresh", metavar="S", gt=0
    )
    #: Deceleration with which the train can stop before a shorter authority.
    braking_mps2: float = Field(default=0.5, gt=0)
    reaction_s: float = Field(default=3.0, ge=0)  #: Time before the brakes act, with that since the newest report.


@dataclass(kw_only=True)
class OnBoard:
    """Authority of a train, as known on board.

    The age of an authority is counted from the sending of the report that it answers, on the train's monotonic clock.
    It is never too small, whatever the links do, and clocks of train and centre need not agree.
    """

    direction: int
    #: End of the authority, the front end before the first; it is extended, and shortened where the centre asks for it
    #: and the train can stop before.
    end_m: float

    limits: OnBoardLimits = field(default_factory=OnBoardLimits)
    number: int = -1  #: Of the newest authority, -1 before the first.
    stopped: bool = False  #: The newest authority is an order to stop.
    #: Where the train's safe front end would come to rest if it braked now, the further of the last two places; None:
    #: it agrees to no shorter end.
    stops_at_m: float | None = None
    #: When the newest report was sent that an authority has answered; None before the first.
    answered_s: float | None = None
    #: Newest report from before the last turn, or from before this start: what answers it or an older one is refused.
    before_turn: int = -1

    _newest: int = -1
    _granted: bool = False
    _place_m: float | None = None
    _sent: OrderedDict[int, float] = field(default_factory=OrderedDict)

    def reported(self, sequence: int, now_s: float) -> None:
        """Note a report that is sent."""
        self._sent[sequence] = now_s
        self._newest = sequence
        if len(self._sent) > REMEMBERED:
            self._sent.popitem(last=False)

    def moved(self, safe_front_m: float | None, speed_mps: float | None) -> None:
        """Note where the train's safe front end is, and its speed; one wrong place alone agrees to no shorter end."""
        before, self._place_m, self.stops_at_m = self._place_m, None, None
        if safe_front_m is None or speed_mps is None:
            return
        way = speed_mps * self.limits.reaction_s + 0.5 * speed_mps**2 / self.limits.braking_mps2
        self._place_m = safe_front_m + self.direction * way
        if before is not None:
            self.stops_at_m = self.direction * max(self.direction * self._place_m, self.direction * before)

    def receive(self, authority: Authority) -> bool:
        """Take an authority; return whether it counts: it is newer, for this direction, and of this side of a turn.

        One that answers a report from before the last change of ends may have been granted for the direction of now
        two changes ago.
        """
        if authority.number <= self.number or authority.direction != self.direction:
            return False
        if authority.report <= self.before_turn:
            return False
        end, held = self.direction * authority.end_cm / 100.0, self.direction * self.end_m
        agrees = self.stops_at_m is not None and self.direction * self.stops_at_m <= end
        if authority.shortens and not (agrees or self._granted):
            return False  # what it held before its start is not known: it brakes until it can agree
        if not self._granted:
            self.end_m, self._granted = self.direction * end, True
        elif not authority.shortens:
            self.end_m = self.direction * max(end, held)
        elif agrees:
            self.end_m = self.direction * min(end, held)
        self.number, self.stopped = authority.number, authority.stopped
        if (sent_s := self._sent.get(authority.report)) is not None:
            self.answered_s = sent_s
        return True

    def acknowledgement(self) -> dict[str, int]:
        """What a report says of the authority that the train holds: nothing before the first."""
        if self.number < 0:
            return {}
        end_cm = self.direction * math.ceil(self.direction * self.end_m * 100.0)
        return {"authority": self.number, "authority_end_cm": end_cm}

    def age_s(self, now_s: float) -> float:
        """Age of the newest authority at most [s]; infinite before the first."""
        return float("inf") if self.answered_s is None else now_s - self.answered_s

    def fresh(self, now_s: float) -> bool:
        """Whether the newest authority is within its time limit."""
        return self.age_s(now_s) <= self.limits.fresh_s

    def brake_reason(self, now_s: float) -> str | None:
        """Return why the train brakes to a stop, None where it may run up to the end of its authority."""
        if self.stopped:
            return "ordered to stop"
        return None if self.fresh(now_s) else "no fresh authority"

    def turned(self, direction: int, front_m: float) -> None:
        """Begin in the other direction, without an authority."""
        self.direction, self.end_m, self.before_turn = direction, front_m, self._newest
        self._granted, self.answered_s, self._place_m, self.stops_at_m = False, None, None, None

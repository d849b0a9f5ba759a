"""A train's end of the links, and its supervision by the newest authority of the centre and that one's time limit."""

from __future__ import annotations

import asyncio
import json
import math
import struct
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from railfix.core.settings import Settings, option
from railfix.ground.links import Bearer, LinkMode, LinkName, TrainLinks, first_sequence
from railfix.ground.positions import Clock, read_positions, standard_input
from railfix.ground.quic import check_keys
from railfix.io.train_message import MessageError, TrainMessage, encode, validate_message

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
        return validate_message(cls, dict(zip(cls.model_fields, values, strict=True)))


#: Way back of the safe front end that is no error of two places [m].
ROLLED_M: Final = 50.0
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
    clock: Clock = option(
        "Positions are of a recording: report each as of now, at the recording's own pace.", "live", name="--replay"
    )
    mode: LinkMode = option("Send reports over bearer A alone, and over B while A fails.", "both", name="--spare")


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
    _front_m: float | None = None
    _sent: OrderedDict[int, float] = field(default_factory=OrderedDict)

    def note_report(self, sequence: int, now_s: float) -> None:
        """Note a report that is sent."""
        self._sent[sequence] = now_s
        self._newest = sequence
        if len(self._sent) > REMEMBERED:
            self._sent.popitem(last=False)

    def note_position(self, safe_front_m: float | None, speed_mps: float | None) -> None:
        """Note where the train's safe front end is, and its speed; one wrong place alone agrees to no shorter end.

        A train that has rolled back brakes: what the centre granted before does not know of it.
        """
        before, self._place_m, self.stops_at_m = self._place_m, None, None
        if safe_front_m is not None:
            if self._front_m is not None and self.direction * (safe_front_m - self._front_m) < -ROLLED_M:
                self.before_turn, self._granted, self.answered_s = self._newest - 1, False, None
            self._front_m = safe_front_m
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
        """Return what a report says of the authority that the train holds: nothing before the first."""
        if self.number < 0:
            return {}
        end_cm = self.direction * math.ceil(self.direction * self.end_m * 100.0)
        return {"authority": self.number, "authority_end_cm": end_cm}

    def age_s(self, now_s: float) -> float:
        """Age of the newest authority at most [s]; infinite before the first."""
        return float("inf") if self.answered_s is None else now_s - self.answered_s

    def brake_reason(self, now_s: float) -> str | None:
        """Return why the train brakes to a stop, None where it may run up to the end of its authority."""
        if self.stopped:
            return "ordered to stop"
        return None if self.age_s(now_s) <= self.limits.fresh_s else "no fresh authority"

    def turn(self, direction: int, front_m: float) -> None:
        """Begin in the other direction, without an authority."""
        self.direction, self.end_m, self.before_turn = direction, front_m, self._newest
        self._granted, self.answered_s, self._place_m, self.stops_at_m = False, None, None, None
        self._front_m = None


#: Time between two reports, and between two looks at the age of the authority [s].
REPORT_S, LOOK_S = 1.0, 0.1
#: Longest wait for the answer to the last report, after the end of the positions [s].
ANSWER_S: Final = 5.0
#: Largest age of what the integrity device has written [s].
INTEGRITY_S = 2.0


async def run_train(
    train: int,
    keys: Path,
    bearers: dict[LinkName, Bearer],
    *,
    lines: AsyncIterator[str] | None = None,
    write: Callable[[str], None],
    limits: OnBoardLimits | None = None,
    integrity: Path | None = None,
    for_s: float | None = None,
) -> tuple[int, int]:
    """Send the newest position every second, and write authorities and braking as lines of JSON.

    Ends with the positions, once the last report is answered or `ANSWER_S` after it. Returns the number of reports and
    of authorities.

    With the train's own two files and ``authority.pem`` of the folder `keys`. The positions are messages as
    `railfix.io.train_message.to_json` writes them, from the standard input by default; lines that are none are written
    as rejected (`railfix.ground.positions`). With `integrity`, a file of the train's integrity device, `is_complete` of
    it takes the place of what the messages say. InputFileError: when a key is not there.
    """
    check_keys(keys, f"train-{train}")
    limits = limits or OnBoardLimits()
    desk = _Desk(train=train, write=write, limits=limits, integrity=integrity)
    links = TrainLinks(train, keys, bearers, mode=limits.mode, received=desk.receive)
    await links.start()
    reading = asyncio.create_task(desk.read(standard_input() if lines is None else lines, limits.clock))
    sending = asyncio.create_task(desk.work(links))
    try:
        done, _ = await asyncio.wait([reading, sending], timeout=for_s, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in (reading, sending):
            task.cancel()
        await links.stop()
    return desk.reports, desk.authorities


def is_complete(path: Path) -> bool:
    """Return whether the train's integrity device has written "complete" in the last `INTEGRITY_S`.

    A file that is absent, unreadable, older, from the future or says anything else is no confirmation.
    """
    try:
        age_s = time.time() - path.stat().st_mtime
        return abs(age_s) <= INTEGRITY_S and path.read_bytes()[:64].strip() == b"complete"
    except OSError:
        return False


class _Desk:
    """Newest position, newest authority, and whether the train brakes."""

    def __init__(
        self, *, train: int, write: Callable[[str], None], limits: OnBoardLimits, integrity: Path | None
    ) -> None:
        self._train, self._write, self._limits, self._integrity = train, write, limits, integrity
        self._newest: TrainMessage | None = None
        self._sequence = self._answered = first_sequence()
        self._on_board: OnBoard | None = None
        self._reason: str | None = ""
        self.reports = self.authorities = 0

    async def read(self, lines: AsyncIterator[str], clock: Clock) -> None:
        async for message in read_positions(lines, rejected=lambda why: self._line(rejected=why), clock=clock):
            self._newest = message
        with suppress(TimeoutError):
            async with asyncio.timeout(ANSWER_S):
                while self._newest is not None or self._answered < self._sequence:
                    await asyncio.sleep(LOOK_S)

    async def work(self, links: TrainLinks) -> None:
        due = time.monotonic()
        while True:
            now = time.monotonic()
            if self._newest is not None and now >= due:
                self._report(links, self._newest, now)
                self._newest, due = None, now + REPORT_S
            if self._on_board is not None and (reason := self._on_board.brake_reason(now)) != self._reason:
                self._reason = reason
                self._line(brake=reason is not None, reason=reason)
            await asyncio.sleep(LOOK_S)

    def _report(self, links: TrainLinks, message: TrainMessage, now_s: float) -> None:
        # numbers go on rising where the source of the positions is started again
        self._sequence += 1
        self.reports += 1
        complete = message.complete if self._integrity is None else is_complete(self._integrity)
        taken = {} if self._on_board is None else self._on_board.acknowledgement()
        message = message.replaced(train=self._train, sequence=self._sequence, complete=complete, **taken)
        if message.facing != 0 and message.chainage_cm is not None:
            front = message.chainage_cm / 100.0
            if self._on_board is None:
                # what answers reports of a process before may be of an earlier time in this direction
                before = self._sequence - 1
                self._on_board = OnBoard(direction=message.facing, end_m=front, limits=self._limits, before_turn=before)
            elif self._on_board.direction != message.facing and message.standstill:
                self._on_board.turn(message.facing, front)
        if self._on_board is not None:
            self._on_board.note_report(self._sequence, now_s)
            ahead = speed = None
            if message.chainage_cm is not None and message.under_cm is not None and message.speed_cmps is not None:
                ahead = (message.chainage_cm + self._on_board.direction * message.under_cm) / 100.0
                speed = abs(message.speed_cmps) / 100.0
            self._on_board.note_position(ahead, speed)
        place = None if message.chainage_cm is None else message.chainage_cm / 100.0
        links.send(encode(message), chainage_m=place, direction=message.facing)

    def receive(self, payload: bytes) -> None:
        """Take an authority from the links."""
        try:
            authority = Authority.decode(payload)
        except MessageError as error:
            self._line(rejected=str(error))
            return
        self._answered = max(self._answered, authority.report)
        if self._on_board is not None and authority.train == self._train and self._on_board.receive(authority):
            self.authorities += 1
            self._line(**authority.model_dump(), age_s=round(self._on_board.age_s(time.monotonic()), 3))

    def _line(self, **values: Any) -> None:
        self._write(json.dumps(values))

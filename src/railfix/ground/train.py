"""On-board unit of a train: the train's end of the links, and supervision by the newest authority."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.frames import draw_session
from railfix.ground.keys import check_keys
from railfix.ground.links import Bearer, LinkName, TrainLinks
from railfix.ground.on_board import REPORT_S, OnBoard, OnBoardLimits
from railfix.ground.positions import Clock, read_positions, standard_input
from railfix.io.train_message import MessageError, TrainMessage, encode

#: Interval between checks of the age of the authority and of the braking curve [s].
LOOK_S = 0.1
#: Longest wait for the answer to the last report, once there are no more positions [s].
ANSWER_S: Final = 5.0
#: The train counts as complete only if its integrity device has written "complete" within this time [s].
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
    """Send the newest position every second; write received authorities, and starts and ends of braking, as JSON lines.

    The function returns the numbers of sent reports and of received authorities. After the last position, the function
    ends when the last report is answered, or after `ANSWER_S`.

    The folder `keys` contains ``train-N.pem``, ``train-N.key`` and ``authority.pem``. `lines` are position messages as
    `railfix.io.train_message.to_json` writes them, by default lines of the standard input. Other lines are reported as
    rejected. `integrity` is a file of the train's integrity device; if it is given, `is_complete` determines whether
    the train is reported as complete. Raise InputFileError if a key is missing.
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

    The result is False if the file is absent, unreadable, older, from the future, or has other content.
    """
    try:
        age_s = time.time() - path.stat().st_mtime
        return abs(age_s) <= INTEGRITY_S and path.read_bytes()[:64].strip() == b"complete"
    except OSError:
        return False


class _Desk:
    """State of a train's on-board unit: newest position, newest authority, and reason for braking."""

    def __init__(
        self, *, train: int, write: Callable[[str], None], limits: OnBoardLimits, integrity: Path | None
    ) -> None:
        self._train, self._write, self._limits, self._integrity = train, write, limits, integrity
        self._newest: TrainMessage | None = None
        # a random number identifies this session, independent of any clock
        self._session, self._sequence, self._answered = draw_session(), 0, 0
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
        self._sequence += 1
        self.reports += 1
        complete = message.complete if self._integrity is None else is_complete(self._integrity)
        if message.facing != 0 and message.chainage_cm is not None:
            front = message.chainage_cm / 100.0
            if self._on_board is None:
                self._on_board = OnBoard(
                    direction=message.facing, end_m=front, limits=self._limits, session=self._session
                )
            elif self._on_board.direction != message.facing and message.standstill:
                self._on_board.turn(message.facing, front)
        taken = {} if self._on_board is None else self._on_board.acknowledgement()
        message = message.replaced(
            train=self._train, session=self._session, sequence=self._sequence, complete=complete, **taken
        )
        if self._on_board is not None:
            self._on_board.note_report(self._sequence, now_s)
            self._note_position(self._on_board, message, now_s)
        place = None if message.chainage_cm is None else message.chainage_cm / 100.0
        links.send(encode(message), chainage_m=place, direction=message.facing)

    @staticmethod
    def _note_position(on_board: OnBoard, message: TrainMessage, now_s: float) -> None:
        """Pass a position, or its absence, to the on-board supervision."""
        place, over, under = message.chainage_cm, message.over_cm, message.under_cm
        if place is None or over is None or under is None or message.speed_cmps is None:
            on_board.note_position(None, None, now_s=now_s)
            return
        d = on_board.direction
        on_board.note_position(
            (place + d * under) / 100.0,
            abs(message.speed_cmps) / 100.0,
            speed_bound_mps=(message.speed_bound_cmps or 0) / 100.0,
            safe_rear_m=(place - d * (over + message.length_cm)) / 100.0,
            now_s=now_s - max(message.sent_ns - message.time_ns, 0) / 1e9,
        )

    def receive(self, payload: bytes) -> None:
        """Process an authority from the links."""
        try:
            authority = Authority.decode(payload)
        except MessageError as error:
            self._line(rejected=str(error))
            return
        if authority.train != self._train or self._on_board is None:
            return
        if authority.session == self._session:
            self._answered = max(self._answered, authority.report)
        if not self._on_board.receive(authority):
            return
        now = time.monotonic()
        if isinstance(authority, BrakeOrder):
            self._line(brake_order=authority.number, reason=authority.reason)
        else:
            self.authorities += 1
            self._line(**authority.model_dump(), age_s=round(self._on_board.age_s(now), 3), **self._speeds(now))

    def _speeds(self, now_s: float) -> dict[str, float]:
        """Return the permitted speed, its target, and the release speed; {} before the first position."""
        assert self._on_board is not None
        if (found := self._on_board.supervised(now_s)) is None:
            return {}
        return {
            "permitted_mps": round(found.permitted_mps, 2),
            "target_m": round(self._on_board.direction * found.target.at_m, 2),
            "target_mps": found.target.speed_mps,
            "release_mps": round(found.release_mps, 2),
        }

    def _line(self, **values: Any) -> None:
        self._write(json.dumps(values))

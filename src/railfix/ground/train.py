"""A train's end of the links: positions of ``railfix live`` to the centre, authorities back."""

from __future__ import annotations

import asyncio
import json
import os
import stat
import sys
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from railfix.ground.link_quality import LinkName
from railfix.ground.links import Bearer, TrainLinks, first_sequence
from railfix.ground.on_board import Authority, OnBoard, OnBoardLimits
from railfix.ground.quic import check_keys
from railfix.io.train_message import MessageError, TrainMessage, encode, from_json

#: Time between two reports, and between two looks at the age of the authority [s].
REPORT_S, LOOK_S = 1.0, 0.1
#: Largest age of what the integrity device has written [s].
INTEGRITY_S = 2.0
#: Longest line of a position message [bytes].
LONGEST_LINE = 100_000


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
) -> None:
    """Send the newest position every second, and write authorities and braking as lines of JSON.

    With the train's own two files and ``authority.pem`` of the folder `keys`. The positions are messages as
    `railfix.io.train_message.to_json` writes them, from the standard input by default. With `integrity`, a file of the
    train's integrity device, `is_complete` of it takes the place of what the messages say. InputFileError: when a key
    is not there, or a line is no position message.
    """
    check_keys(keys, f"train-{train}")
    desk = _Desk(train=train, write=write, limits=limits or OnBoardLimits(), integrity=integrity)
    links = TrainLinks(train, keys, bearers, received=desk.received)
    await links.start()
    reading = asyncio.create_task(desk.read(_standard_input() if lines is None else lines))
    sending = asyncio.create_task(desk.work(links))
    try:
        done, _ = await asyncio.wait([reading, sending], timeout=for_s, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in (reading, sending):
            task.cancel()
        await links.stop()


def is_complete(path: Path) -> bool:
    """Whether the train's integrity device has written "complete" in the last `INTEGRITY_S`.

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
        self._sequence = first_sequence()
        self._on_board: OnBoard | None = None
        self._reason: str | None = ""

    async def read(self, lines: AsyncIterator[str]) -> None:
        async for line in lines:
            if line.strip():
                self._newest = from_json(line)

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
                self._on_board.turned(message.facing, front)
        if self._on_board is not None:
            self._on_board.reported(self._sequence, now_s)
            ahead = speed = None
            if message.chainage_cm is not None and message.under_cm is not None and message.speed_cmps is not None:
                ahead = (message.chainage_cm + self._on_board.direction * message.under_cm) / 100.0
                speed = abs(message.speed_cmps) / 100.0
            self._on_board.moved(ahead, speed)
        place = None if message.chainage_cm is None else message.chainage_cm / 100.0
        links.send(encode(message), chainage_m=place, direction=message.facing)

    def received(self, payload: bytes) -> None:
        """Take an authority from the links."""
        try:
            authority = Authority.decode(payload)
        except MessageError as error:
            self._line(rejected=str(error))
            return
        if self._on_board is not None and authority.train == self._train and self._on_board.receive(authority):
            self._line(**authority.model_dump(), age_s=round(self._on_board.age_s(time.monotonic()), 3))

    def _line(self, **values: Any) -> None:
        self._write(json.dumps(values))


async def _standard_input() -> AsyncIterator[str]:
    """Lines as they come; a reader that waits does not hold the end of the program up."""
    kind = os.fstat(sys.stdin.fileno()).st_mode
    if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind) or sys.stdin.isatty()):  # a file has all its lines
        for line in sys.stdin:
            yield line
        return
    reader = asyncio.StreamReader(limit=LONGEST_LINE)
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    try:
        while data := await reader.readline():
            yield data.decode(errors="replace")
    except ValueError:
        raise MessageError(f"is longer than {LONGEST_LINE} bytes") from None

"""Position messages of a train in JSON lines, either live or replayed from a recording."""

from __future__ import annotations

import asyncio
import os
import stat
import sys
from collections.abc import AsyncIterator, Callable
from typing import Final, Literal

from railfix.core.utc import gps_now_ns
from railfix.io.train_message import MessageError, TrainMessage, from_json

#: Longest accepted input line [bytes]; longer lines are cut, and then rejected.
LONGEST_LINE: Final = 100_000
#: Largest number of bytes in one read.
_READ: Final = 1 << 16

#: Whether positions are live, or from a recording.
Clock = Literal["live", "replay"]


async def read_positions(
    lines: AsyncIterator[str], *, rejected: Callable[[str], None], clock: Clock = "live"
) -> AsyncIterator[TrainMessage]:
    """Yield the position messages decoded from lines; call `rejected` with the reason for each invalid line.

    With the clock "replay", messages are yielded at the pace of the recording, and their times are replaced by the
    present time, so that the centre accepts the positions as new.
    """
    first: tuple[int, int] | None = None
    number = 0
    async for line in lines:
        number += 1
        if not line.strip():
            continue
        try:
            message = from_json(line)
        except MessageError as error:
            rejected(f"line {number}: {error}")
            continue
        if clock == "replay":
            now_ns = gps_now_ns()
            first = first or (message.time_ns, now_ns)
            due_ns = first[1] + message.time_ns - first[0]
            await asyncio.sleep(max(0.0, (due_ns - now_ns) * 1e-9))
            now_ns = gps_now_ns()
            message = message.replaced(time_ns=min(due_ns, now_ns), sent_ns=now_ns)
        yield message


async def standard_input() -> AsyncIterator[str]:
    """Yield lines of the standard input as they arrive; a pending read does not keep the program from ending.

    Lines are cut at `LONGEST_LINE`; a cut line is not a valid message.
    """
    kind = os.fstat(sys.stdin.fileno()).st_mode
    if not (stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind) or sys.stdin.isatty()):  # reading a file does not block
        while data := sys.stdin.buffer.readline(LONGEST_LINE):
            yield data.decode(errors="replace")
        return
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    rest, cut = b"", False
    while data := await reader.read(_READ):
        *ended, rest = (rest + data).split(b"\n")
        for line in ended:
            if not cut:
                yield line[:LONGEST_LINE].decode(errors="replace")
            cut = False
        if len(rest) > LONGEST_LINE:
            if not cut:
                yield rest[:LONGEST_LINE].decode(errors="replace")
            rest, cut = b"", True
    if rest and not cut:
        yield rest.decode(errors="replace")

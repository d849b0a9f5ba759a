"""Queues before slow targets: a reader that does not keep up never delays the next message."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

from railfix.core.errors import OutputError

Item = TypeVar("Item")

#: Longest wait for the last items when an outlet is closed [s].
_CLOSE_S = 5.0


class Outlet(Generic[Item]):
    """A target behind a queue and a thread of its own, in which `send` takes one item.

    `full` says what happens to an item for which there is no room: dropped and counted ("drop", live), or waited for
    ("wait", replay of recorded files, which has the time).

    Attributes
    ----------
    dropped, failed : int
        Items dropped because the target was too slow; items that it refused.
    failure : str
        Why the last item was refused; blank where none was, and after one that was taken.
    """

    def __init__(self, name: str, send: Callable[[Item], None], *, waiting: int, full: str = "drop") -> None:
        self.name, self._send, self._full = name, send, full
        self.dropped = self.failed = 0
        self.failure = ""
        self._defect: Exception | None = None
        self._items: queue.Queue[Item | None] = queue.Queue(waiting)
        self._thread = threading.Thread(target=self._run, name=f"railfix {name}", daemon=True)
        self._thread.start()

    def send(self, item: Item) -> None:
        """Hand over one item; OutputError when the target refuses items, and none may be lost."""
        if self._defect is not None:
            raise self._defect
        if self._full == "wait":
            if self.failure:
                raise OutputError(f"{self.name}: {self.failure}")
            self._items.put(item)
            return
        try:
            self._items.put_nowait(item)
        except queue.Full:
            self.dropped += 1

    def _run(self) -> None:
        while (item := self._items.get()) is not None:
            try:
                self._send(item)
                self.failure = ""
            except (OSError, OutputError) as error:
                self.failed += 1
                self.failure = f"cannot be written ({getattr(error, 'strerror', None) or error})"
            except Exception as error:  # noqa: BLE001 (a defect: raised where the next item is handed over)
                self._defect = error
                self.failure = f"has ended by a defect ({error!r})"
                self.failed += 1

    def close(self) -> None:
        """Wait for the items that are left, some seconds at most; what is left then is counted as dropped.

        OutputError: as `send`.
        """
        with suppress(queue.Full):  # then the thread is given up below
            self._items.put(None, timeout=_CLOSE_S)
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self.dropped += self._items.qsize()
        if self._full == "wait" and self.failure:
            raise OutputError(f"{self.name}: {self.failure}")

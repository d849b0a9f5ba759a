"""Sequential commits to the database in a thread.

A slow database delays only messages that wait for a commit.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Final

from railfix.ground.store import DatabaseError

#: Duration of a commit above which an alarm is raised [s].
HANGS_S: Final = 1.0
#: Time between attempts to write to a database that fails [s].
RETRY_S: Final = 1.0


class ThreadWriter:
    """Executor of commits in a daemon thread, so that the process can end while a commit is in progress.

    `done` is called in the thread after each commit.
    """

    def __init__(self, done: Callable[[], None] = lambda: None) -> None:
        self._done = done
        self._queue: queue.Queue[tuple[Callable[[], None], Future[None]] | None] = queue.Queue()
        self._thread = threading.Thread(target=self._run, name="railfix store", daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], None]) -> Future[None]:
        """Queue a function, and return the future that will have its outcome."""
        outcome: Future[None] = Future()
        self._queue.put((work, outcome))
        return outcome

    def stop(self, wait_s: float) -> bool:
        """End the thread after the work in progress; return whether the thread has ended within `wait_s`."""
        self._queue.put(None)
        self._thread.join(wait_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            _carry_out(*item)
            self._done()


def _carry_out(work: Callable[[], None], outcome: Future[None]) -> Future[None]:
    """Run a function, set its outcome in the future, and return the future."""
    try:
        work()
    except Exception as error:  # noqa: BLE001 (the caller of `result` gets the error)
        outcome.set_exception(error)
    else:
        outcome.set_result(None)
    return outcome


@dataclass(kw_only=True)
class Commits:
    """Commits of the centre, at most one at a time, and the alarm if the database fails.

    `alarm` is the reason why the state cannot be written, None if it can be written. While there is an alarm, no
    authority is sent; orders to brake are still sent.
    """

    writer: ThreadWriter | None = None  #: Executor of the commits; with None, each commit is carried out at once.
    alarm: str | None = None
    _open: tuple[Future[None], Callable[[], None], float] | None = None
    _failed_s: float = float("-inf")

    def may_begin(self, now_s: float) -> bool:
        """Return whether a commit may begin: none is in progress, and none has failed within `RETRY_S`."""
        return self._open is None and now_s - self._failed_s >= RETRY_S

    def begin(self, work: Callable[[], None], then: Callable[[], None], now_s: float) -> None:
        """Begin a commit; `settle` calls `then` once the commit is done."""
        outcome = _carry_out(work, Future()) if self.writer is None else self.writer.submit(work)
        self._open = outcome, then, now_s

    def settle(self, now_s: float) -> None:
        """Process the outcome of a completed commit; raise errors that are not failures of the database."""
        if self._open is None:
            return
        outcome, then, begun_s = self._open
        if not outcome.done():
            if now_s - begun_s > HANGS_S:
                self.alarm = f"the database has not answered for {now_s - begun_s:.0f} s; no authorities are sent"
            return
        self._open = None
        try:
            outcome.result()
        except DatabaseError as error:
            self.alarm, self._failed_s = f"{error}; no authorities are sent", now_s
            return
        self.alarm = None
        then()

"""What a person sees of a session: a log, and a status line where the terminal can show one."""

from __future__ import annotations

import logging
import logging.handlers
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from railfix.core.errors import OutputError
from railfix.live.outlets import Outlet
from railfix.live.settings import LiveSettings

#: Lines that may wait for a terminal or a full disk.
_WAITING: Final = 1000


@dataclass(frozen=True)
class StatusLine:
    """A text that takes the place of the one before."""

    text: str


class _Terminal:
    """The standard error output: lines of the log, and below them the status line."""

    def __init__(self, *, status: bool) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if status else None
        if self._live is not None:
            self._live.start()

    def show(self, item: str | StatusLine) -> None:
        """Show a line, or renew the status."""
        if isinstance(item, str):
            self._console.print(item, markup=False, soft_wrap=True)
        elif self._live is not None:
            self._live.update(Text(item.text, no_wrap=True, overflow="ellipsis"), refresh=True)

    def close(self) -> None:
        """Remove the status line."""
        if self._live is not None:
            self._live.stop()


class _OnScreen(logging.Handler):
    """Hands formatted lines to the terminal's outlet, so that logging never waits."""

    def __init__(self, outlet: Outlet[str | StatusLine]) -> None:
        super().__init__()
        self._outlet = outlet

    def emit(self, record: logging.LogRecord) -> None:
        """Hand over one line."""
        self._outlet.send(self.format(record))


class _InFile(logging.handlers.QueueHandler):
    """Hands records to the outlet of the log file."""

    def __init__(self, outlet: Outlet[logging.LogRecord]) -> None:
        super().__init__(outlet)  # type: ignore[arg-type]  # of a queue it uses `enqueue` alone
        self._outlet = outlet

    def enqueue(self, record: logging.LogRecord) -> None:
        """Hand over one record."""
        self._outlet.send(record)


class _Rotating(logging.handlers.RotatingFileHandler):
    """A rotating file whose errors are raised, not printed."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802, ARG002 (the name and form of logging)
        """Raise the error that is being handled."""
        raise


#: Beginning of a line of a log of a session.
_LINE: Final = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3} ")


def check_log_file(path: Path) -> None:
    """Raise OutputError where a file is there that is no log of a session: nothing is appended to it."""
    try:
        with path.open("rb") as file:
            begin = file.read(64)
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"{path}: cannot be opened as a log file ({error.strerror or error})") from None
    if begin and not _LINE.match(begin):
        raise OutputError(f"{path}: is no log of railfix live, and is not appended to; name another file")


class SessionLog:
    """Log of a session, on the standard error output and in a rotating file, and the status line.

    At `LiveSettings.log_bytes` the file is put aside as ``path.1``, and so on (OutputError when it cannot be opened). A
    status line that is wanted is shown where the standard error output is a terminal.
    """

    def __init__(self, path: Path | None, settings: LiveSettings, *, status: bool = True) -> None:
        self.shows_status = status and sys.stderr.isatty()
        self._terminal = _Terminal(status=self.shows_status)
        self._logger = logging.getLogger("railfix.live")
        self._logger.setLevel(logging.INFO)
        self._logger.propagate = False
        self._screen: Outlet[str | StatusLine] = Outlet("log", self._terminal.show, waiting=_WAITING)
        shown = _OnScreen(self._screen)
        shown.setFormatter(logging.Formatter("railfix live: %(message)s"))
        self._handlers: list[logging.Handler] = [shown]
        self._file: _Rotating | None = None
        self._written: Outlet[logging.LogRecord] | None = None
        if path is not None:
            try:
                self._file = _Rotating(
                    path, maxBytes=settings.log_bytes, backupCount=settings.log_files, encoding="utf-8"
                )
            except OSError as error:
                self.close()
                raise OutputError(f"{path}: cannot be opened as a log file ({error.strerror or error})") from None
            self._file.setFormatter(logging.Formatter("%(asctime)s.%(msecs)03d %(message)s", "%Y-%m-%dT%H:%M:%S"))
            self._written = Outlet("log file", self._file.emit, waiting=_WAITING)
            self._handlers.append(_InFile(self._written))
        for handler in self._handlers:
            self._logger.addHandler(handler)

    def say(self, sentence: str) -> None:
        """Log one sentence."""
        self._logger.info(sentence)

    def show(self, status: str) -> None:
        """Renew the status line; nothing where the terminal has none."""
        if self.shows_status:
            self._screen.send(StatusLine(status))

    def close(self) -> None:
        """Write what is left; lines that the file lacks are told on the screen."""
        for handler in self._handlers:
            self._logger.removeHandler(handler)
        self._logger.propagate = True
        if self._written is not None and self._file is not None:
            self._written.close()
            self._file.close()
            if missing := self._written.dropped + self._written.failed:
                self._screen.send(f"railfix live: the log file lacks {missing} lines: {self._written.failure}")
        self._screen.close()
        self._terminal.close()

"""The program ``railfix``, and ``python -m railfix``."""

from __future__ import annotations

import signal
import sys
from typing import Final, NoReturn

#: Exit code of a program that Ctrl-C ended, as in a shell.
_INTERRUPTED: Final = 128 + signal.SIGINT


def raise_exit(number: int, _frame: object) -> None:
    """End by an exception, so that staging folders are removed."""
    raise SystemExit(128 + number)


def main() -> NoReturn:
    """Run the program; a signal that comes while its commands are imported ends it like one that comes later.

    Signals that the caller has the program ignore, as `nohup` and shells' background jobs do, stay ignored.
    """
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if (number := getattr(signal, name, None)) and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, raise_exit)
    try:
        from railfix.cli import app
        from railfix.cli.command import run_program

        run_program(app)
    except SystemExit as end:
        if end.code == _INTERRUPTED:
            print("railfix: interrupted; what was unfinished is removed, finished files are kept", file=sys.stderr)
        raise


if __name__ == "__main__":
    main()

"""The program ``railfix``, and ``python -m railfix``."""

from __future__ import annotations

import signal
import sys
from typing import Final, NoReturn

#: Exit code of a program that was interrupted with Ctrl-C, as in a shell.
_INTERRUPTED: Final = 128 + signal.SIGINT


def raise_exit(number: int, _frame: object) -> None:
    """Raise SystemExit on a signal, so that the exception handlers remove staging folders."""
    raise SystemExit(128 + number)


def main() -> NoReturn:
    """Run the program. Signal handlers are installed first, because the import of the commands takes time.

    Signals that are ignored when the program starts, for example under `nohup` or in a shell's background job, stay
    ignored.
    """
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if (number := getattr(signal, name, None)) and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, raise_exit)
    try:
        from railfix.cli import app
        from railfix.cli.command import run_program

        run_program(app)
    except (SystemExit, RuntimeError) as error:
        # Python 3.11 replaces an exit during the creation of a class by a RuntimeError.
        end = error if isinstance(error, SystemExit) else error.__cause__
        if not isinstance(end, SystemExit):
            raise
        if end.code == _INTERRUPTED:
            print("railfix: interrupted; unfinished files were removed, finished files are kept", file=sys.stderr)
        raise end from None


if __name__ == "__main__":
    main()

"""Base classes of the commands. A command that fails ends with a one-sentence message and an exit code."""

from __future__ import annotations

import difflib
import errno
import os
import re
import select
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from itertools import pairwise
from typing import Any, ClassVar, Final, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from railfix.core.errors import InputFileError, OutputError, RailfixError, RailfixWarning, SettingsError
from railfix.core.extras import needs_extra

#: Words that users mistakenly write after a switch as its value.
_YES_NO: Final = ("true", "false", "yes", "no", "on", "off", "0", "1")
#: The exit code of a program that was ended by a signal is this value plus the signal's number, as in POSIX shells.
SIGNALLED: Final = 128
#: Pattern of the message of `pathlib` for a symbolic link that leads to itself.
_LOOP: Final = re.compile(r"Symlink loop from '(.*)'")
#: Error numbers of a failed write to a standard output that accepts no more data, for example on a full disk.
_FULL: Final = (errno.ENOSPC, errno.EIO, errno.EFBIG, errno.EDQUOT)


class Command(TyperCommand):
    """Command that rejects repeated options and values after switches, and reports all missing options together."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; a repeated option, a value after a switch, or a missing option is a usage error."""
        options = {name: param for param in self.params for name in getattr(param, "opts", ())}
        given: Counter[str] = Counter()
        words = iter(args[: args.index("--")] if "--" in args else args)
        for word in words:
            name, equals, _ = word.partition("=")
            param = options.get(name)
            if param is None or not name.startswith("-"):
                continue
            if getattr(param, "is_flag", False):
                self._check_switch(ctx, name, args)
                continue
            given[name] += 1
            if given[name] > 1 and not param.multiple:
                ctx.fail(f"{name} is given twice; give it once")
            if not equals:
                next(words, None)
        missing = [
            param
            for param in self.params
            if isinstance(param, TyperOption) and param.required and not any(name in given for name in param.opts)
        ]
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            if len(missing) > 1 and error.param in missing:
                ctx.fail(f"Missing options {', '.join(param.opts[0] for param in missing)}.")
            raise

    @staticmethod
    def _check_switch(ctx: Any, name: str, args: list[str]) -> None:
        for before, after in pairwise(args):
            if before == name and after.lower() in _YES_NO:
                ctx.fail(f"{name} is a switch and takes no value; remove {after} after it")


class Commands(TyperGroup):
    """Group of commands; each command reports an error in one sentence, and ends with the exit code of the error."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command; report a RailfixError in one sentence, and any other error with a traceback."""
        try:
            _check_surroundings()
            with needs_extra(), warnings.catch_warnings():
                warnings.simplefilter("ignore", RailfixWarning)  # commands print these warnings as notes
                return super().invoke(ctx)
        except RailfixError as error:
            _end(error)
        except MemoryError:
            _end(
                SettingsError(
                    "the command needs more memory than is available; choose a shorter period or smaller chunks"
                )
            )
        except RuntimeError as error:
            loop = _LOOP.match(str(error))
            if loop is None:
                raise
            _end(InputFileError(loop.group(1), "is a symbolic link that leads to itself; make it a link to a file"))


#: Options of every typer application of this package; the package `rich` formats the help but not the tracebacks.
_TYPER: Final[dict[str, Any]] = {
    "add_completion": False, "pretty_exceptions_enable": False, "rich_markup_mode": "markdown"
}  # fmt: skip


def command_group(name: str, *, cls: type[Commands] = Commands, **options: Any) -> typer.Typer:
    """Return a group of commands that shows its help when it is called without a command."""
    return typer.Typer(name=name, cls=cls, no_args_is_help=True, **_TYPER, **options)


class LazyCommands(Commands):
    """Group that imports a command's module only when the command is called; the help is made from `summaries`."""

    summaries: ClassVar[Mapping[str, str]] = {}
    #: Module by name of the command, for the commands whose module has a different name.
    modules: ClassVar[Mapping[str, str]] = {}

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands."""
        return [*super().list_commands(ctx), *self.summaries]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; for a name in `summaries`, a placeholder with only name and summary, for the help."""
        if cmd_name in self.summaries:
            return Command(cmd_name, help=self.summaries[cmd_name])
        return super().get_command(ctx, cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command's name, the imported command and the command's arguments.

        The error for an unknown name suggests a similar name.
        """
        known = self.list_commands(ctx)
        word = args[0] if args else ""
        near = [] if word in known or word.startswith("-") else difflib.get_close_matches(word, known, n=1, cutoff=0.5)
        if near:
            ctx.fail(f"no such command: {word!r}; did you mean {near[0]!r}?")
        name, command, rest = super().resolve_command(ctx, args)
        return name, load_command(str(name), self.modules.get(str(name))) if name in self.summaries else command, rest


def load_command(name: str, module_name: str | None = None) -> Any:
    """Import a command from a module of `railfix.cli`, by default the module with the command's name, and return it."""
    word = name.replace("-", "_")
    module = import_module(f"railfix.cli.{module_name or word}")
    app = getattr(module, "app", None)
    if app is None:
        app = typer.Typer(**_TYPER)
        app.command(name, cls=Command)(getattr(module, word))
    command = typer.main.get_command(app)
    command.name = name
    return command


def run_program(app: typer.Typer) -> NoReturn:
    """Run the program and exit with its code; no error is reported if the reader of standard output has closed the
    pipe.
    """
    if number := getattr(signal, "SIGPIPE", None):
        signal.signal(number, _end_at_closed_pipe)
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        try:
            app(standalone_mode=True)
        finally:
            sys.stdout.flush()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except OSError as error:
        if error.filename is not None or error.errno not in _FULL:
            raise
        typer.echo(f"railfix: error: the standard output cannot be written ({error.strerror})", err=True)
        code = OutputError.exit_code
    _discard_output()
    sys.exit(code)


def _end_at_closed_pipe(number: int, _frame: object) -> None:
    """Exit if the reader of standard output has closed the pipe.

    If the reader exists, another pipe is broken; the function then returns, so that the write to it raises its error.
    """
    poll = select.poll()
    poll.register(1, 0)
    if any(event & select.POLLERR for _, event in poll.poll(0)):
        _discard_output()
        raise SystemExit(SIGNALLED + number)


def _end(error: RailfixError) -> NoReturn:
    sentence = " ".join(str(error).split())
    typer.echo(f"railfix: error: {sentence}", err=True)
    raise typer.Exit(error.exit_code) from None


def _check_surroundings() -> None:
    """Raise InputFileError if the working directory does not exist, or an argument is not valid UTF-8."""
    try:
        os.getcwd()  # noqa: PTH109
    except OSError:
        raise InputFileError(".", "the working directory no longer exists; change to an existing folder") from None
    for word in sys.argv[1:]:
        try:
            word.encode("utf-8")
        except UnicodeEncodeError:
            shown = word.encode("utf-8", "backslashreplace").decode()
            raise InputFileError(shown, "the name is not valid UTF-8; rename the file, or use a link to it") from None


def _discard_output() -> None:
    """Redirect standard output to the null device, so that flushing it at the end of the program raises no error."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)

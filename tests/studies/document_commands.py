"""Command lines that the documents show, parsed by the program's own command line without being run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer
from pydantic import ValidationError
from typer.core import TyperGroup

import paths
from railfix.cli import app
from railfix.cli.options import Choices, resolve_settings
from railfix.core.errors import SettingsError

FENCE: Final = re.compile(r"^```(?:sh|console)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ANY_FENCE: Final = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
INLINE: Final = re.compile(r"`([^`\n]+)`")
#: Options in sentences that are those of scripts of the tests.
OTHERS: Final = frozenset({"--logs", "--runs", "--epochs"})
_CONTEXT: Final = {"resilient_parsing": True}


class Shown(NamedTuple):
    """One command line of a document; `whole` where it is meant to be typed as it stands."""

    place: str
    words: tuple[str, ...]
    whole: bool


def shown(path: Path) -> Iterator[Shown]:
    """Yield the command lines of railfix in a document: those of its blocks, then those within sentences."""
    text = path.read_text(encoding="utf-8")
    for block in FENCE.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            if not re.match(r"(?:\$ )?(?:\S*/)?railfix ", line):
                continue
            words = shlex.split(line.removeprefix("$ "), comments=True)
            if "|" not in words and ">" not in words:
                yield Shown(f"{path.name}: {line.strip()}", tuple(words[1:]), "..." not in words)
    for code in INLINE.findall(ANY_FENCE.sub("", text)):
        if code.startswith("railfix ") and not code.startswith("railfix COMMAND"):
            words = shlex.split(code)
            yield Shown(f"{path.name}: {code}", tuple(words[1:]), whole=False)


@cache
def _group() -> Any:
    return typer.main.get_command(app)


def _command(words: tuple[str, ...]) -> tuple[Any, Any, list[str]]:
    """Return the command that words name, its context and what follows its name."""
    command, rest = _group(), list(words)
    context = command.make_context("railfix", [], **_CONTEXT)
    while isinstance(command, TyperGroup) and rest and not rest[0].startswith("-"):
        name = rest.pop(0)
        if name not in command.list_commands(context):
            raise ValueError(f"there is no command {name}")
        _, found, _ = command.resolve_command(context, [name])
        command, context = found, found.make_context(name, [], parent=context, **_CONTEXT)
    return command, context, rest


def options_of(command: Any) -> set[str]:
    """Return the options of a command."""
    return {name for param in command.params for name in (*param.opts, *param.secondary_opts) if name.startswith("-")}


@cache
def every_command() -> dict[str, set[str]]:
    """Return the options of all commands, however deep, by the command's words."""

    def below(command: Any, context: Any, words: str) -> Iterator[tuple[str, set[str]]]:
        yield words, options_of(command)
        if isinstance(command, TyperGroup):
            for name in command.list_commands(context):
                _, inner, _ = command.resolve_command(context, [name])
                yield from below(inner, inner.make_context(name, [], parent=context, **_CONTEXT), f"{words} {name}")

    context = _group().make_context("railfix", [], **_CONTEXT)
    return dict(below(_group(), context, "railfix"))


def every_option() -> set[str]:
    """Return the options of all commands."""
    return set().union(*every_command().values()) | {"--help", "-h", "--version"}


def wrong_with(line: Shown) -> str | None:
    """Return what the program's command line says against one that is shown; None where nothing is."""
    try:
        command, context, rest = _command(line.words)
    except ValueError as error:
        return f"{line.place}: {error}"
    known = options_of(command) | {"--help", "-h"}
    unknown = [word for word in rest if word.startswith("-") and word.partition("=")[0] not in known]
    if unknown:
        return f"{line.place}: unknown {', '.join(unknown)}"
    if "--preset" in known:
        given = {name: tuple(b for a, b in pairwise(rest) if a == f"--{name}") for name in ("set", "without")}
        one = {name: b for name in ("preset", "screens", "filter") for a, b in pairwise(rest) if a == f"--{name}"}
        try:
            resolve_settings(Choices.model_validate({"setting": given["set"], "without": given["without"], **one}))
        except (SettingsError, ValidationError) as error:
            return f"{line.place}: {error}"
    if not line.whole:
        return None
    try:
        command.make_context(command.name, rest, parent=context.parent)
    except typer.Exit:  # --list, --help
        return None
    except Exception as error:  # noqa: BLE001  a usage error, whose class depends on the version of typer
        return f"{line.place}: {error.format_message() if hasattr(error, 'format_message') else error}"
    return None


def wrong_options(path: Path) -> list[str]:
    """Return options that a sentence names and no command has; the list of changes names those that are gone."""
    sentences = ANY_FENCE.sub("", path.read_text(encoding="utf-8"))
    if path.name == "changes.md":
        return []
    named = {code.split()[0].partition("=")[0] for code in INLINE.findall(sentences) if code.startswith("--")}
    return sorted(f"{path.name}: {name}" for name in named - every_option() - OTHERS)


def wrong_scripts(path: Path) -> list[str]:
    """Return scripts and tests that a document names and that are not there, and their options that are not."""
    wrong, root = [], paths.ROOT
    for name, more in re.findall(r"(tests/[\w/]+\.py)((?: +[^`\n|]+)?)", path.read_text(encoding="utf-8")):
        script = root / name
        if not script.exists():
            wrong.append(f"{path.name}: {name} is not there")
        elif not script.name.startswith("test_") and script.name != "at_commit.py":  # its words are those of a study
            source = script.read_text(encoding="utf-8")
            before = more.split(" and ")[0].split(";")[0]
            wrong += [
                f"{path.name}: {name} has no {option}"
                for option in re.findall(r"(?<!\S)--[a-z-]+", before)
                if f'"{option}"' not in source
            ]
    return wrong

"""Reference pages from the docstrings: ``python tests/studies/reference_document.py`` writes reference.md, columns.md
and settings.md in ``docs``."""

from __future__ import annotations

import inspect
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from enum import IntEnum, IntFlag
from itertools import groupby
from pathlib import Path
from typing import Any, Final, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

import paths
from railfix.core import errors, reasons
from railfix.core.settings import Settings
from railfix.evaluate import (
    BEYOND_COLUMNS,
    EPOCH_COLUMNS,
    FIGURE_COLUMNS,
    INTERVAL_COLUMNS,
    LEVEL_COLUMNS,
    STANFORD_COLUMNS,
)
from railfix.evaluate.intervals import BRANCH_COLUMNS, OUTAGE_COLUMNS
from railfix.pipeline.config import Config
from railfix.pipeline.result_columns import OBSERVATION_COLUMNS, POSITION_COLUMNS, UNITS, Column
from railfix.pipeline.result_tables import PASSING_COLUMNS, SMOOTHED_COLUMNS, TRAIN_COLUMNS
from railfix.run.route import ON_TRACK_COLUMNS, TRACK_COLUMNS
from railfix.tracking import TrackStatus

DOCS: Final = paths.ROOT / "docs"
WRITTEN: Final = "Written by `python tests/studies/reference_document.py`."
ENDINGS: Final = tuple(f"`_{ending}`" + ("" if ending == unit else f" {unit}") for ending, unit in UNITS.items())
SIGNS: Final = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
#: Prefixes of the settings of the filter along the track.
FILTER: Final = ("filter", "tracking.", "sensors.")
#: Columns of the files of `railfix evaluate`, by the heading of their table.
EVALUATION: Final[Mapping[str, Mapping[str, str]]] = {
    "`errors.parquet`, a row an epoch, antenna and run; levels, prefixed by their kind, follow": EPOCH_COLUMNS,
    "`tables.csv`: figures, one row a group": FIGURE_COLUMNS,
    "`intervals.csv`, after `run`, `configuration`, `line`, `antenna`": INTERVAL_COLUMNS,
    "`levels.csv`, after `run`, `configuration`, `line`, `antenna`": LEVEL_COLUMNS,
    "`stanford_KIND.csv`, after `run`, `configuration`, `line`, `antenna`": STANFORD_COLUMNS,
    "`beyond_KIND.csv`": BEYOND_COLUMNS,
    "`outages.csv`, after `run`, `configuration`, `line`, `antenna`": OUTAGE_COLUMNS,
    "`branches.csv`, after `run`, `configuration`, `line`, `antenna`": BRANCH_COLUMNS,
}


def _field_comments(kind: type) -> dict[str, str]:
    """Return the `#:` comments of the fields of a class, its bases included.

    One at the end of a line is that of its field; one on lines of its own is that of the fields that follow it, up to
    the next comment or empty line.
    """
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if base in (object, BaseModel, Settings) or not base.__module__.startswith("railfix"):
            continue
        above: list[str] = []
        fields_follow = False
        for line in inspect.getsource(base).splitlines():
            text = line.strip()
            if text.startswith("#:"):
                above = [text[2:].strip()] if fields_follow else [*above, text[2:].strip()]
                fields_follow = False
            elif found := re.match(r"(\w+): .*?(?:#: (.*))?$", text):
                docs[found[1]] = found[2] or " ".join(above)
                fields_follow = True
                above = [] if found[2] else above
            elif not text:
                above = []
    return docs


def _exit_codes() -> list[str]:
    rows = re.findall(r"^(\d)\s+(.*)$", errors.__doc__ or "", flags=re.MULTILINE)
    kinds = errors.RailfixError.__subclasses__()
    raised = {str(kind.exit_code): kind.__name__ for kind in kinds}
    lines = ["## Exit codes", "", "With the error in Python.", ""]
    return lines + [f"- {code}: {text}{f' (`{raised[code]}`)' if code in raised else ''}" for code, text in rows]


def _named(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _columns(
    heading: str, columns: Mapping[str, Column[Any] | str], *, without: Iterable[str] = (), level: str = "##"
) -> list[str]:
    texts = {name: column if isinstance(column, str) else column.meaning for name, column in columns.items()}
    rows = groupby((name for name in texts if name not in without), key=lambda name: texts[name])
    return [
        "",
        f"{level} {heading}",
        "",
        *(f"- {_named(names)}: {meaning.replace('``', '`')}" for meaning, names in rows),
    ]


def _members(heading: str, kind: type[IntEnum] | type[IntFlag]) -> list[str]:
    """Members of an enumeration with the comments above them in the source."""
    comments: dict[str, str] = {}
    comment: list[str] = []
    for line in inspect.getsource(kind).splitlines():
        text = line.strip()
        if text.startswith("#:"):
            comment.append(text.removeprefix("#:").strip())
        elif found := re.match(r"([A-Z_0-9]+) = ", text):
            comments[found[1]] = " ".join(comment)
            comment = []
    rows = [(int(m), str(m.name)) for m in kind if m.name != "USED"]
    meanings = (comments[name].replace("``", "`") for _, name in rows)
    return [
        "",
        f"## {heading}",
        "",
        *(f"- {n} `{name.lower()}`: {text}" for (n, name), text in zip(rows, meanings, strict=True)),
    ]


def _bounds(field: FieldInfo) -> str:
    """Bounds of a setting other than > 0, or its other words: ``>=0``, ``[0, 1)``, ``or `off` ``."""
    if words := [str(word) for word in get_args(field.annotation) if isinstance(word, str)]:
        return f"or {', '.join(f'`{word}`' for word in words if word != field.default)}"
    limits = {sign: getattr(item, sign) for item in field.metadata for sign in SIGNS if hasattr(item, sign)}
    if limits in ({"gt": 0}, {}):
        return "(any)" if not limits and field.annotation in (float, int) else ""
    if len(limits) == 1:
        ((sign, limit),) = limits.items()
        return f"({SIGNS[sign]}{limit:g})"
    opening = f"({limits['gt']:g}" if "gt" in limits else f"[{limits['ge']:g}"
    return opening + (f", {limits['lt']:g})" if "lt" in limits else f", {limits['le']:g}]")


def _as_toml(value: object) -> str:
    """A default as a configuration file has it, without spaces; numbers with four digits where they have more."""
    if isinstance(value, Mapping):
        return f"{{{','.join(f'{key}={_as_toml(item)}' for key, item in value.items())}}}"
    if isinstance(value, tuple):
        return f"[{','.join(_as_toml(item) for item in value)}]"
    if isinstance(value, str):
        return f'"{value}"'
    return f"{value:.4g}" if isinstance(value, float) and len(str(value)) > 8 else str(value)


def _setting_cells(prefix: str, group: Settings) -> Iterator[tuple[str, str, str, str]]:
    """Group, key, default with unit and bounds, and the description of each setting."""
    docs = _field_comments(type(group))
    for name, field in type(group).model_fields.items():
        value = getattr(group, name)
        if isinstance(value, Settings):
            yield from _setting_cells(f"{prefix}.{name}".strip("."), value)
            continue
        first, *rest = re.split(r"(?<=[a-z)`\]])\. ", docs.get(name, "").replace("``", "`"), maxsplit=1)
        sentence, unit = re.match(r"(.*?)(?: \[([^\]]+)\])?$", first.rstrip(".")).groups()  # type: ignore[union-attr]
        sentence += "".join(f". {text}" for text in rest)
        default = (
            f"`{value if isinstance(value, str) else _as_toml(value)}`" if value not in (None, "", (), {}) else "none"
        )
        known = name.rsplit("_", 1)[-1] in UNITS
        yield prefix, name, " ".join(filter(None, (default, "" if known else unit, _bounds(field)))), sentence


def _settings(settings: Iterable[tuple[str, str, str, str]], level: str) -> Iterator[str]:
    """Yield the lines of settings by group, ungrouped ones first; neighbours with one meaning are one entry."""
    groups: dict[str, list[tuple[str, str, str, str]]] = {"": []}
    for cell in settings:
        groups.setdefault(cell[0], []).append(cell)
    for prefix, group in groups.items():
        yield from ("", f"{level} `[{prefix}]`" if prefix else f"{level} Outside of tables", "")
        for meaning, cells in groupby(group, key=lambda cell: cell[3]):
            _, names, values, _ = zip(*cells, strict=True)
            each = values if len(set(values)) > 1 else values[:1]
            yield f"- {_named(names)}: {', '.join(each)}. {meaning}"


def reference() -> str:
    """Page of exit codes, statuses and reasons."""
    lines = [
        "# Reference",
        "",
        WRITTEN,
        "[Columns](columns.md) and [settings](settings.md) have pages of their own.",
        "",
    ]
    lines += _exit_codes()
    lines += _members("Statuses of an epoch", reasons.Status)
    lines += _members("Statuses of the filter along the track", TrackStatus)
    lines += _members("Reasons of an observation", reasons.Reason)
    return "\n".join(lines) + "\n"


def table_columns() -> str:
    """Return the page of the columns of a run's tables and of its evaluation."""
    lines = ["# Columns", "", WRITTEN, f"Names end with their unit: {', '.join(ENDINGS)}."]
    lines += ["", "The columns that `railfix evaluate` writes are [at the end](#columns-of-the-evaluation)."]
    common = {
        name: column for name, column in POSITION_COLUMNS.items() if _meaning(TRAIN_COLUMNS, name) == column.meaning
    }
    lines += _columns("Both `positions` and `train`", common)
    lines += _columns("`positions.csv`, `positions.parquet`", POSITION_COLUMNS, without=common)
    lines += _columns("`train.csv`, `train.parquet`", TRAIN_COLUMNS, without=common)
    lines += _columns("`train.*` with `--smooth`", SMOOTHED_COLUMNS)
    lines += _columns("`passings.csv`, `passings.parquet`", PASSING_COLUMNS, without=("antenna", "speed_mps"))
    lines += _columns("`positions.*` and `train.*` on a network", ON_TRACK_COLUMNS)
    lines += _columns("`tracks.csv`, `tracks.parquet`", TRACK_COLUMNS)
    lines += _columns("`observations.parquet`", OBSERVATION_COLUMNS, without=("time_gpst", "antenna"))
    return "\n".join([*lines, "", *evaluation_columns()]) + "\n"


def _meaning(columns: Mapping[str, Column[Any]], name: str) -> str | None:
    return columns[name].meaning if name in columns else None


def evaluation_columns() -> list[str]:
    """Return the section of the columns of `railfix evaluate`."""
    lines = ["## Columns of the evaluation", "", "[Evaluation](evaluation.md) defines the figures."]
    count = Counter(item for columns in EVALUATION.values() for item in columns.items())
    common = {name: meaning for (name, meaning), number in count.items() if number > 1}
    lines += _columns("Columns of several files", common, level="###")
    for heading, columns in EVALUATION.items():
        rest = {name: meaning for name, meaning in columns.items() if common.get(name) != meaning}
        lines += _columns(heading, rest, level="###")
    return lines


def pages() -> dict[Path, str]:
    """Text of each page by its path."""
    general = (
        "Keys of the configuration file (TOML), by its tables, each with its default, or one for all keys of an entry. "
        "`--set` takes `table.key=value`. Names end with their [unit](columns.md). Numbers are above 0 unless other "
        "bounds follow; `[0, 1)` includes 0. P1 to P5 are [papers](papers.md). The settings of the filter are "
        "[at the end](#settings-of-the-filter-and-its-sensors)."
    )
    every = list(_setting_cells("", Config()))
    of_filter = [cell for cell in every if f"{cell[0]}.{cell[1]}".lstrip(".").startswith(FILTER)]
    others = [cell for cell in every if cell not in of_filter]
    title = "## Settings of the filter and its sensors"
    lines = ["# Settings", "", WRITTEN, "", general, *_settings(others, "##"), "", title, *_settings(of_filter, "###")]
    return {
        DOCS / "reference.md": reference(),
        DOCS / "columns.md": table_columns(),
        DOCS / "settings.md": "\n".join(lines) + "\n",
    }


def main() -> int:
    """Write the pages."""
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

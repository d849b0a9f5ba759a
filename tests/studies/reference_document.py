"""The reference document, from the docstrings: ``python tests/studies/reference_document.py`` writes
``docs/reference.md``."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Mapping
from enum import IntEnum, IntFlag
from typing import Any, Final, get_args

from pydantic.fields import FieldInfo

import paths
from railfix.core import errors, reasons
from railfix.core.settings import Settings
from railfix.pipeline.columns import UNITS, Column
from railfix.pipeline.config import Config
from railfix.pipeline.result_columns import OBSERVATION_COLUMNS, POSITION_COLUMNS
from railfix.pipeline.train_table import SMOOTHED_COLUMNS, TRAIN_COLUMNS
from railfix.run.route import ON_TRACK_COLUMNS, TRACK_COLUMNS
from railfix.tracking import TrackStatus

DOCUMENT: Final = paths.ROOT / "docs" / "reference.md"


def _attribute_docs(item: object) -> dict[str, str]:
    """Descriptions in the Attributes section of a numpydoc docstring, by name."""
    text = inspect.getdoc(item) or ""
    _, _, section = text.partition("Attributes\n----------\n")
    section = re.split(r"\n\n[A-Z][a-z]+\n-+\n", section)[0]
    docs: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        if line.startswith(" "):
            for name in names:
                docs[name] = f"{docs[name]} {line.strip()}".strip()
        elif line.strip():
            head, _, kind = line.partition(" : ")
            names = [n.strip() for n in head.split(",")]
            unit = re.search(r"\[[^\]]+\]$", kind)
            docs |= dict.fromkeys(names, "")
            if unit:
                docs |= dict.fromkeys(names, unit.group())
    return docs


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("``", "`")


def _exit_codes() -> list[str]:
    rows = re.findall(r"^(\d)\s+(.*)$", errors.__doc__ or "", flags=re.MULTILINE)
    kinds = errors.RailfixError.__subclasses__()
    raised = {str(kind.exit_code): kind.__name__ for kind in kinds}
    lines = ["## Exit codes", "", "| code | meaning | error in Python |", "|---:|---|---|"]
    return lines + [f"| {c} | {text} | {f'`{raised[c]}`' if c in raised else ''} |" for c, text in rows]


def _columns(heading: str, columns: Mapping[str, Column[Any] | str]) -> list[str]:
    lines = ["", f"## {heading}", "", "| column | unit | meaning |", "|---|---|---|"]
    for name, column in columns.items():
        unit, text = (
            (UNITS.get(name.rsplit("_", 1)[-1], ""), column)
            if isinstance(column, str)
            else (column.unit, column.meaning)
        )
        lines.append(f"| `{name}` | {unit} | {_cell(text)} |")
    return lines


def _members(heading: str, kind: type[IntEnum] | type[IntFlag], head: str) -> list[str]:
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
    lines = ["", f"## {heading}", "", f"| {head} | name | meaning |", "|---:|---|---|"]
    rows = [(int(m), str(m.name)) for m in kind if m.name != "USED"]
    return lines + [f"| {value} | `{name.lower()}` | {_cell(comments[name])} |" for value, name in rows]


def _bounds(field: FieldInfo) -> str:
    """Bounds of a setting, or its words: ``> 0``, ``0 to 1``."""
    if words := [str(word) for word in get_args(field.annotation) if isinstance(word, str)]:
        return ", ".join(f"`{word}`" for word in words)
    signs = {"gt": "> {:g}", "ge": ">= {:g}", "lt": "< {:g}", "le": "<= {:g}"}
    limits = [(sign, getattr(item, sign, None)) for item in field.metadata for sign in signs]
    return ", ".join(signs[sign].format(limit) for sign, limit in limits if limit is not None)


def _setting_rows(prefix: str, group: Settings) -> list[str]:
    """A row a setting; of a description the first sentence."""
    docs, rows = _attribute_docs(type(group)), []
    for name, field in type(group).model_fields.items():
        value = getattr(group, name)
        if isinstance(value, Settings):
            rows += _setting_rows(f"{prefix}{name}.", value)
            continue
        unit, text = re.match(r"(?:\[([^\]]+)\]\s*)?(.*)", docs.get(name, ""), flags=re.DOTALL).groups()  # type: ignore[union-attr]
        sentence = re.split(r"(?<=[a-z)`])[.;:] ", text)[0].rstrip(".")
        shown = _cell(str(value)) if value not in (None, "", ()) else ""
        default, unit = f"`{shown}`" if shown else "", unit or _unit_of(name)
        rows.append(f"| `{prefix}{name}` | {default} | {unit} | {_bounds(field)} | {_cell(sentence)} |")
    return rows


def _unit_of(name: str) -> str:
    """Unit that the name of a setting ends with."""
    return UNITS.get(name.rsplit("_", 1)[-1], "") if "_" in name else ""


def _settings() -> list[str]:
    lines = ["", "## Settings", "", "Keys of the configuration file (TOML) and of `--set`.", ""]
    return [
        *lines,
        "| key | default | unit | bounds | meaning |",
        "|---|---|---|---|---|",
        *_setting_rows("", Config()),
    ]


def document() -> str:
    """The document as Markdown."""
    lines = ["# Reference", "", "Written by `python tests/studies/reference_document.py` from the docstrings.", ""]
    lines += _exit_codes()
    lines += _columns("Columns of `positions.csv` and `positions.parquet`", POSITION_COLUMNS)
    lines += _columns("Columns of `train.csv` and `train.parquet`", TRAIN_COLUMNS)
    lines += _columns("Further columns of `train.*` with `--smooth`", SMOOTHED_COLUMNS)
    lines += _columns("Further columns of `positions.*` and `train.*` of a run on a network", ON_TRACK_COLUMNS)
    lines += _columns("Columns of `tracks.csv` and `tracks.parquet`", TRACK_COLUMNS)
    lines += _columns("Columns of `observations.parquet`", OBSERVATION_COLUMNS)
    lines += _members("Statuses of an epoch", reasons.Status, "number")
    lines += _members("Statuses of the filter along the track", TrackStatus, "number")
    lines += _members("Reasons of an observation", reasons.Reason, "bit")
    lines += _settings()
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the document."""
    DOCUMENT.write_text(document(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

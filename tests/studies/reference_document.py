"""The reference document, from the docstrings: ``python tests/studies/reference_document.py`` writes
``docs/reference.md``."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import sys
from collections.abc import Mapping
from enum import IntEnum, IntFlag
from typing import Any, Final

import paths
from railfix.core import errors, reasons
from railfix.pipeline.columns import UNITS, Column
from railfix.pipeline.config import Config
from railfix.pipeline.result_columns import OBSERVATION_COLUMNS, POSITION_COLUMNS
from railfix.pipeline.train_table import SMOOTHED_COLUMNS, TRAIN_COLUMNS
from railfix.run.route import ON_TRACK_COLUMNS, TRACK_COLUMNS
from railfix.tracking import TrackStatus

DOCUMENT: Final = paths.ROOT / "docs" / "reference.md"

#: Modules whose public names are listed, in reading order.
MODULES: Final = (
    "railfix.io.rinex",
    "railfix.track",
    "railfix.track.trajectory",
    "railfix.track.vehicle",
    "railfix.pipeline.config",
    "railfix.pipeline.processor",
    "railfix.pipeline.results",
    "railfix.screens",
    "railfix.integrity.raim",
    "railfix.integrity.protection",
    "railfix.integrity.stanford",
    "railfix.ranges.error_model",
    "railfix.evaluate.range_errors",
    "railfix.ranges.sbas",
    "railfix.ranges.cn0_curve",
    "railfix.pipeline.columns",
    "railfix.pipeline.tables",
    "railfix.pipeline.train_table",
    "railfix.tracking",
    "railfix.run",
    "railfix.io.reference_log",
    "railfix.reference",
    "railfix.positioning.doppler_speed",
    "railfix.evaluate",
    "railfix.evaluate.ablation",
    "railfix.report.plots",
    "railfix.report",
    "railfix.simulate",
    "railfix.core.reasons",
    "railfix.core.timescale",
    "railfix.core.geodesy",
)


def _first_paragraph(item: object) -> str:
    text = inspect.getdoc(item) or ""
    return " ".join(text.split("\n\n")[0].split())


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


def _setting_rows(prefix: str, item: Any, docs: dict[str, str]) -> list[str]:
    rows = []
    for name in docs:
        if not hasattr(item, name):
            continue
        value = getattr(item, name)
        if dataclasses.is_dataclass(value):
            continue
        rows.append(f"| `{prefix}{name}` | `{_cell(str(value))}` | {_cell(docs[name])} |")
    return rows


def _settings() -> list[str]:
    config = Config()
    lines = ["", "## Settings", "", "Keys of the configuration file (TOML) and of `--set`, with their defaults.", ""]
    lines += ["| key | default | meaning |", "|---|---|---|"]
    lines += _setting_rows("", config, {k: v for k, v in _attribute_docs(Config).items() if k != "noise"})
    for name in Config.model_fields:
        group = getattr(config, name)
        if dataclasses.is_dataclass(group):
            docs = _attribute_docs(group) or dict.fromkeys((f.name for f in dataclasses.fields(group)), "")
            lines += _setting_rows(f"{name}.", group, docs)
    return lines


def _signature(item: Any) -> str:
    try:
        text = re.sub(r"(: |-> )(['\"])(.*?)\2", r"\1\3", str(inspect.signature(item)))
    except (TypeError, ValueError):
        return ""
    return text if len(text) < 400 else "(...)"


def _module(name: str) -> list[str]:
    module = importlib.import_module(name)
    names = getattr(module, "__all__", None) or [
        n for n, v in vars(module).items() if not n.startswith("_") and getattr(v, "__module__", "") == name
    ]
    lines = ["", f"## `{name}`", "", _first_paragraph(module), ""]
    for public in names:
        item = getattr(module, public)
        if inspect.isclass(item):
            lines.append(f"- **`{public}`** {_cell(_first_paragraph(item))}")
        elif inspect.isroutine(item):
            lines.append(f"- **`{public}{_signature(item)}`** {_cell(_first_paragraph(item))}")
    return lines


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
    for name in MODULES:
        lines += _module(name)
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the document."""
    DOCUMENT.write_text(document(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Content of the page as plain values: tables, sentences, folded parts. The templates turn them into HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from railfix.core.tables import Table


@dataclass(frozen=True)
class Sentence:
    """A paragraph of text."""

    kind: ClassVar[str] = "sentence"
    text: str


@dataclass(frozen=True)
class Absent:
    """A sentence on content that the page does not have, with the reason."""

    kind: ClassVar[str] = "absent"
    text: str


@dataclass(frozen=True)
class ReportedCommand:
    """A command line."""

    kind: ClassVar[str] = "command"
    text: str


@dataclass(frozen=True)
class Notes:
    """A list of sentences under a heading."""

    kind: ClassVar[str] = "notes"
    title: str
    lines: Sequence[str]


@dataclass(frozen=True)
class Folded:
    """A part that the reader opens."""

    kind: ClassVar[str] = "folded"
    title: str
    blocks: Sequence[Block]


Block = Table | Sentence | Absent | ReportedCommand | Notes | Folded

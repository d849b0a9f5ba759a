"""Reader of the environment (open, tunnel) along a line, by sections."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Strings
from railfix.core.errors import InputFileError
from railfix.io.named_columns import read_named_columns

SECTION_COLUMNS: Final = ("from_m", "to_m", "environment")  #: Columns of a table of sections.


@dataclass(frozen=True, kw_only=True)
class Sections:
    """Environment of S sections of a line. The sections are in ascending order and do not overlap."""

    path: Path
    from_m: Floats  #: Chainage of the start of each section, shape (S,) [m].
    to_m: Floats  #: Chainage of the end of each section, shape (S,) [m]. Only the last section includes its end.
    environment: tuple[str, ...]

    def at(self, chainage_m: Floats) -> Strings:
        """Return the environment at chainages, shape (T,), blank outside all sections and for NaN chainages."""
        names = np.array([*self.environment, ""])
        index = np.searchsorted(self.from_m, chainage_m, side="right") - 1
        safe = np.maximum(index, 0)
        last = (safe == len(self.to_m) - 1) & (chainage_m == self.to_m[-1])
        inside = (index >= 0) & ((chainage_m < self.to_m[safe]) | last)
        return np.asarray(names[np.where(inside, safe, len(names) - 1)])


def read_sections(path: Path) -> Sections:
    """Read the sections of a line from a CSV file with the columns ``from_m,to_m,environment``.

    Raise InputFileError if a column is missing, or if a section is empty, has no environment or overlaps another.
    """
    table = read_named_columns(path)
    for name in SECTION_COLUMNS:
        if name not in table:
            raise InputFileError(
                path, f"has no column {name}; from_m, to_m and environment are needed", line=table.header_line
            )
    if not len(table):
        raise InputFileError(path, "has no section below the header")
    first, last = table.numbers("from_m"), table.numbers("to_m")
    for row, name in enumerate(table.cells["environment"]):
        if not name:
            raise table.error(row, "the environment is empty; expected a word such as open or tunnel")
        if not first[row] < last[row]:
            raise table.error(row, f"from_m {first[row]:g} is not below to_m {last[row]:g}; correct the section")
    order = np.argsort(first, kind="stable")
    over = np.flatnonzero(first[order][1:] < last[order][:-1] - 1e-6)
    if len(over):
        row = int(order[over[0] + 1])
        raise table.error(row, f"the section from {first[row]:g} m overlaps another section; correct the limits")
    return Sections(
        path=path, from_m=first[order], to_m=last[order], environment=tuple(table.cells["environment"].gather(order))
    )

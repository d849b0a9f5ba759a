"""Passings of balises and virtual balises as a table, and the sentences on those that are wrong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.pipeline.balises import CONTRADICTS, MISSING, NOT_LISTED, VERDICTS, Passing
from railfix.pipeline.result_columns import Column, by_name, table_of
from railfix.pipeline.results import Result

_TIME: Final = pl.Datetime("ns")


def _of(name: str) -> Any:
    """Return a getter of one field of all passings."""
    return lambda passings: np.array([getattr(passing, name) for passing in passings])


#: Columns of the table of passings.
PASSING_COLUMNS: Final[Mapping[str, Column[Sequence[Passing]]]] = by_name(
    (
        Column("time_gpst", "when the place was passed, by the filter; or a reading that is wrong", _of("time"),
               dtype=_TIME),
        Column("earliest_gpst", "begin of the interval of the passing, by the level: before, the train was not there",
               _of("earliest"), dtype=_TIME),
        Column("latest_gpst", "its end", _of("latest"), dtype=_TIME),
        Column("antenna", "`front` or `rear`", lambda _: None, dtype=pl.String()),
        Column("balise", "name in the list, or as read", _of("balise"), dtype=pl.String()),
        Column(
            "verdict",
            "`virtual`: no balise; `read`, `missing`: passed with and without a reading; `contradicts`: read where the "
            "filter excludes it; `not_listed`",
            _of("verdict"), words=VERDICTS,
        ),
        Column("chainage_m", "as listed", _of("chainage_m")),
        Column("read_gpst", "time of the reading", _of("read"), dtype=_TIME),
        Column("read_error_m", "of a reading that contradicts: listed place less that of the filter",
               _of("read_error_m")),
        Column("speed_mps", "at the passing, + toward rising chainage", _of("speed_mps")),
        Column("protection_level_m", "of the place at the passing", _of("level_m")),
        Column("doubt_over_m", "how far the train may be behind the place: `L_DOUBTOVER` less `Q_LOCACC`",
               _of("amount_m")),
        Column("doubt_under_m", "how far it may be ahead: `L_DOUBTUNDER` less `Q_LOCACC`", _of("amount_m")),
        Column("odometer_m", "for comparison: 5 m and 5 % of the way since the last balise read (SUBSET-041)",
               _of("odometer_m")),
    )
)  # fmt: skip


def passing_table(result: Result) -> pl.DataFrame:
    """Return the passings of a chunk, with `PASSING_COLUMNS`."""
    parts = [table_of(PASSING_COLUMNS, own.passings, len(own.passings), antenna=name)
             for name, own in result.fusion.items()]  # fmt: skip
    return pl.concat(parts).sort("time_gpst", maintain_order=True) if parts else table_of(PASSING_COLUMNS, (), 0)


def balise_notes(antenna: str, passings: Iterable[Passing]) -> list[str]:
    """Return a sentence on each balise that was missed, or read where it is not."""
    notes = []
    for passing in passings:
        at, name = str(passing.time)[:21], f"{antenna}: balise {passing.balise}"
        if passing.verdict == MISSING:
            early, late = str(passing.earliest)[:21], str(passing.latest)[11:21]
            notes.append(
                f"{name} at chainage {passing.chainage_m:.1f} m was passed between {early} and {late} without a reading"
            )
        elif passing.verdict == CONTRADICTS:
            which = f", next to {passing.here}" if passing.here and passing.here != passing.balise else ""
            notes.append(
                f"{name}, read at {at}, contradicts the filter: it is listed at {passing.chainage_m:.1f} m, the train "
                f"was {abs(passing.read_error_m):.1f} m from there (sigma {passing.sigma_m:.1f} m){which}; a wrong "
                "identity, or a wrong place in the list"
            )
        elif passing.verdict == NOT_LISTED:
            notes.append(f"{name}, read at {at}, is not listed on this line; the reading is not used")
    return notes

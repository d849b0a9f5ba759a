"""Examination of tables of on-board sensors, balises, sections and heights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes
from railfix.core.notebook import plural
from railfix.core.tables import reading_table
from railfix.io.file_kind import find_kind, read_column_names
from railfix.io.mate import mate_table
from railfix.io.named_columns import is_named, read_named_columns
from railfix.io.reference_log import read_acceleration, read_pulses
from railfix.io.sections import SECTION_COLUMNS, read_sections
from railfix.io.sensor_tables import find_sensor_table, read_sensor_table
from railfix.motion.samples import SENSORS
from railfix.run.checks import Span
from railfix.run.sensors import read_sensors, read_units

TableKind = Literal[
    "tachometer", "inertial", "radar", "ranging", "balises", "ranging_units", "list of balises", "pulses",
    "acceleration", "sections", "heights",
]  # fmt: skip
TABLE_KINDS: Final[tuple[TableKind, ...]] = get_args(TableKind)
#: Kind of each EGNSS MATE table that contains neither observations nor a track map.
_OF_MATE: Final[Mapping[str, TableKind]] = {
    "S_IMU": "inertial", "S_SPEEDOMETER": "radar", "S_BALISEREADER": "balises", "S_DM_BALISE": "list of balises",
}  # fmt: skip
#: Option that accepts each kind of table, with the command in front if it is not `railfix run`.
_OPTIONS: Final[Mapping[TableKind, str]] = {
    **{kind: f"--{kind.replace('_', '-')}" for kind in TABLE_KINDS},
    "list of balises": "--balise-list or --virtual-balises", "pulses": "railfix reference --pulses",
    "acceleration": "railfix reference --acceleration", "sections": "railfix evaluate --sections",
}  # fmt: skip
#: For each kind of table that is used only in a pair, the kind of its partner.
PAIRS: Final[Mapping[TableKind, TableKind]] = {
    "ranging": "ranging_units", "ranging_units": "ranging", "balises": "list of balises", "list of balises": "balises",
}  # fmt: skip


def find_table_kind(path: Path) -> TableKind | Literal["other"] | None:
    """Return the kind of a table from its header, or None if the table is a track map or a position log.

    The kind is "other" if railfix reads no table with these columns.
    """
    kind = find_kind(path)
    if kind == "mate":
        return _OF_MATE.get(mate_table(path))
    if kind == "parquet":
        with reading_table(path):
            columns = tuple(pl.read_parquet_schema(path))
    else:
        columns = read_column_names(path)
    names = {name.lower() for name in columns}
    placed = "x_m" in names or any(is_named(name, "latitude_deg") for name in names)
    if placed and not {"unit", "x_m"} <= names:
        return None
    if names.issuperset(SECTION_COLUMNS):
        return "sections"
    if names & {"chainage_m", "kilometrage_m"} and names & {"height_m", "elevation_m"}:
        return "heights"
    # a table with one of these columns has results or ground truth
    found = None if names & {"antenna", "read"} else find_sensor_table(columns)
    return next((table for table in TABLE_KINDS if table == found), "other")


def read_table_facts(path: Path, kind: TableKind) -> tuple[str, Span | None]:
    """Return a phrase on the content of a table, and the span of its times. Errors of the table's reader are raised."""
    if kind in SENSORS:
        samples = read_sensors(**{kind: path}).tables[kind]
        return _phrase(kind, plural(len(samples), "reading")), _span(samples.time)
    if kind == "sections":
        sections = read_sections(path)
        names = ", ".join(dict.fromkeys(sections.environment))
        reach = f"from {sections.from_m[0]:g} to {sections.to_m[-1]:g} m ({names})"
        return _phrase(kind, f"{plural(sections.environment, 'section')} {reach}"), None
    if kind == "heights":
        table = read_named_columns(path)
        by = "chainage" if "chainage_m" in table else "kilometrage"
        return _phrase(kind, f"{plural(table, 'height')} by {by}"), None
    if kind == "ranging_units":
        return _phrase(kind, plural(len(read_units(path).name), "ground unit")), None
    if kind == "list of balises":
        return _phrase(kind, plural(len(read_sensor_table(path, kind)), "balise")), None
    read: Callable[[Path], Datetimes] = {
        "pulses": lambda path: read_pulses(path).time, "acceleration": lambda path: read_acceleration(path).time
    }[kind]  # fmt: skip
    time = read(path)
    return _phrase(kind, plural(len(time), "reading")), _span(time)


def _phrase(kind: TableKind, content: str) -> str:
    return f"{content} ({_OPTIONS[kind]})"


def _span(time: Datetimes) -> Span | None:
    return (time.min(), time.max()) if len(time) and not np.isnat(time).any() else None


def sensor_options(tables: Mapping[TableKind, Path]) -> list[str]:
    """Return the options of `railfix run` for sensor tables. Tables without their partner (`PAIRS`) are omitted."""
    words = []
    for kind, path in tables.items():
        of_run = kind in SENSORS or kind in PAIRS.values()
        if of_run and PAIRS.get(kind, kind) in tables:
            words += [_OPTIONS[kind].partition(" or ")[0], str(path)]
    return words

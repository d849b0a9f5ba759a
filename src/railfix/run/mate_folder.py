"""Inputs of a run from a folder with EGNSS MATE tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from railfix.core.errors import InputFileError
from railfix.io.mate import mate_table

#: Field of `RunInputs` for each EGNSS MATE table. If both track tables exist, the table listed first is used.
_INPUTS: Final = {
    "S_GNSS_SAT": "front", "S_DM_TRACKPOINT": "track", "S_DM_TRACK_SEGMENT_POSITION": "track", "S_IMU": "inertial",
    "S_SPEEDOMETER": "radar", "S_BALISEREADER": "balises", "S_DM_BALISE": "balise_list",
}  # fmt: skip


def find_inputs(folder: Path) -> dict[str, Any]:
    """Return, for fields of `railfix.run.inputs.RunInputs`, the paths of the tables in a folder.

    Raise InputFileError if the folder does not exist, or if it lacks the table S_GNSS_SAT or a track table.
    """
    if not folder.is_dir():
        raise InputFileError(folder, "--mate expects a folder with tables of EGNSS MATE")
    tables = {name: path for path in sorted(folder.iterdir()) if (name := mate_table(path))}
    given: dict[str, Any] = {}
    for table, name in _INPUTS.items():
        if table in tables and name not in given:
            given[name] = (tables[table],) if name in ("front", "track") else tables[table]
    for name, needed in (("front", "S_GNSS_SAT"), ("track", "S_DM_TRACK_SEGMENT_POSITION or S_DM_TRACKPOINT")):
        if name not in given:
            raise InputFileError(folder, f"has no table {needed} (.parquet or .csv) of EGNSS MATE; add it")
    if not {"balises", "balise_list"} <= given.keys():  # balise readings are usable only with a list
        given = {name: path for name, path in given.items() if not name.startswith("balise")}
    return given

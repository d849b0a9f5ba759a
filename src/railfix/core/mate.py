"""Tables of EGNSS MATE (SBB, DLR, IABG): names, columns, and reading with their check.

Columns are those of https://github.com/EGNSS-MATE/egnss-mate-schematics (MIT), commit 0dc83ee of 14 April 2026.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Final

import polars as pl
from polars.exceptions import PolarsError

from railfix.core.errors import InputFileError

_STAMPS: Final = ("TIMESTAMP_LOCAL", "TIMESTAMP_UTC", "CREATED_TIMESTAMP")
_VALID: Final = ("VALID_FROM", "VALID_TO", "CREATED_TIMESTAMP")
_SEGMENT: Final = (
    "TRACK_EDGE_ID", "TRACK_SEGMENT_TYPE", "TRACK_SEGMENT_REFERENCE_POSITION", "TRACK_SEGMENT_LENGTH",
    "TRACK_SEGMENT_DIRECTION", *_VALID,
)  # fmt: skip
_RESULT: Final = (
    "ALGORITHM_ID", "SENSOR_SET", "PARAMETER_SET", "OPERATING_DATE", "TRAIN_NUMBER", "TIMESTAMP_LOCAL", "TIMESTAMP_UTC",
    "STATUS",
)  # fmt: skip
#: Columns of the tables that are read, in the order of the schema.
READ: Final[Mapping[str, tuple[str, ...]]] = {
    "S_GNSS_SAT": (
        "DEVICE_ID", *_STAMPS, "GPS_WEEK", "GPS_TOW", "SAT_ID", "SIGNAL_TYPE", "LOCK_TIME", "CN0", "PSEUDORANGE",
        "STD_DEV_PSEUDORANGE", "DOPPLER", "CARRIER_PHASE", "STD_DEV_CARRIER_PHASE", "AZIMUTH", "ELEVATION",
        "TRACKING_STATUS", "PVT_STATUS", "ERROR", "ANTENNA",
    ),
    "S_BALISEREADER": ("DEVICE_ID", *_STAMPS, "NID_C", "NID_BG", "N_PIG", "N_TOTAL", "M_DUP"),
    "S_IMU": (
        "DEVICE_ID", *_STAMPS, "ACCELERATION_ERROR_CODE", "ANGULAR_ERROR_CODE", "SPEC_FORCE_X", "SPEC_FORCE_Y",
        "SPEC_FORCE_Z", "ANG_RATE_X", "ANG_RATE_Y", "ANG_RATE_Z", "COMPENSATED", "CORRECTED",
    ),
    "S_SPEEDOMETER": ("DEVICE_ID", *_STAMPS, "SPEED_ERROR_CODE", "SPEED", "RELATIVE_DISTANCE", "STANDSTILL"),
    "S_DM_TRACK_SEGMENT_POSITION": (
        *_SEGMENT, "UTM_CELL", "NORTH", "EAST", "AZIMUTH", "INITIAL_ARC_LENGTH", "RADIUS", "CLOTHOID_CONSTANT",
    ),
    "S_DM_TRACK_SEGMENT_GRADIENT": (*_SEGMENT, "INITIAL_HEIGHT", "GRADIENT", "RADIUS"),
    "S_DM_TRACK_SEGMENT_CANT": (*_SEGMENT, "INITIAL_CANT", "END_CANT", "TRACK_GAUGE"),
    "S_DM_TRACKPOINT": (
        "TRACK_EDGE_ID", "POSITION", "NORTH_LV95", "EAST_LV95", "HEIGHT_LV95", "LATITUDE_ETRS89", "LONGITUDE_ETRS89",
        "ALTITUDE_ETRS89", "RADIUS", "CANT", "GRADIENT", "AZIMUTH_LV95", "AZIMUTH_ETRS89", *_VALID,
    ),
    "S_DM_BALISE": (
        "NID_C", "NID_BG", "N_PIG", "N_TOTAL", "TRACK_EDGE_ID", "BALISE_TYPE", "SLEEPER_TYPE", "POSITION",
        "CROSS_DISTANCE", "NORTH_LV95", "EAST_LV95", "LATITUDE_ETRS89", "LONGITUDE_ETRS89", *_VALID,
    ),
}  # fmt: skip
#: Columns of the tables that are written.
WRITTEN: Final[Mapping[str, tuple[str, ...]]] = {
    "R_TRACK": (
        *_RESULT, "TRACK_ID", "MOVEMENT_DIRECTION", "ORIENTATION", "TRAVELLED_DISTANCE", "RELATIVE_DISTANCE", "SPEED",
        "ACCELERATION", "OVERESTIMATION_DISTANCE", "UNDERESTIMATION_DISTANCE", "OVERESTIMATION_SPEED",
        "UNDERESTIMATION_SPEED", "CROSS_TRACK_DISTANCE", "CREATED_TIMESTAMP",
    ),
    "R_ETCS_TPR": (
        *_RESULT, "NID_LRBG_C", "NID_LRBG_BG", "NID_LRBG_PIG", "D_LRBG", "Q_DIRLRBG", "Q_DLRBG", "Q_DIRTRAIN",
        "TRAVELLED_DISTANCE", "SPEED", "ACCELERATION", "L_DOUBTOVER", "L_DOUBTUNDER", "SPEED_DOUBTOVER",
        "SPEED_DOUBTUNDER", "CREATED_TIMESTAMP",
    ),
}  # fmt: skip
#: Columns that hold names.
_TEXTS: Final = ("SAT_ID", "SIGNAL_TYPE", "ANTENNA", "TRACK_EDGE_ID", "UTM_CELL", "TRACK_SEGMENT_TYPE")


def mate_table(path: str | PathLike[str]) -> str:
    """Return which table of EGNSS MATE a file is by its name, blank where it is none: ``s_imu.parquet`` is S_IMU."""
    name, _, kind = Path(path).name.partition(".")
    return name.upper() if name.upper() in READ and kind.lower() in ("parquet", "csv", "csv.gz") else ""


def read_mate(path: str | PathLike[str], needed: tuple[str, ...]) -> pl.DataFrame:
    """Read a table, CSV (also .gz) or Parquet, with upper-case names; columns that are not in the file are empty.

    InputFileError: the file is no such table, has no rows, lacks one of the columns `needed`, or has one that the
    schema does not.
    """
    name, file = mate_table(path), Path(path)
    try:
        if file.suffix.lower() == ".parquet":
            table = pl.read_parquet(file)
        else:
            table = pl.read_csv(file, infer_schema_length=None, schema_overrides=dict.fromkeys(_TEXTS, pl.String()))
    except (PolarsError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputFileError(path, f"cannot be read as the table {name} of EGNSS MATE ({reason})") from error
    table = table.rename({column: column.upper() for column in table.columns})
    unknown = [column for column in table.columns if column not in READ[name]]
    if unknown:
        raise InputFileError(
            path, f"has a column {unknown[0]}, which {name} of EGNSS MATE has not; remove or rename it"
        )
    missing = [column for column in needed if column not in table.columns]
    if missing:
        raise InputFileError(path, f"has no column {missing[0]}; expected {', '.join(needed)} of {name} of EGNSS MATE")
    if not len(table):
        raise InputFileError(path, "has no rows; leave the table out")
    absent = [column for column in READ[name] if column not in table.columns]
    return table.with_columns(pl.lit(None).alias(column) for column in absent)


def only_device(path: str | PathLike[str], table: pl.DataFrame) -> pl.DataFrame:
    """Return the table; InputFileError where it has rows of several devices."""
    devices = table["DEVICE_ID"].drop_nulls().unique().sort().to_list()
    if len(devices) > 1:
        raise InputFileError(path, f"has devices {', '.join(map(str, devices))}; keep the rows of one")
    return table

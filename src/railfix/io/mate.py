"""Reader of EGNSS MATE tables (SBB, DLR, IABG): columns of all tables, and observations of S_GNSS_SAT.

The columns follow https://github.com/EGNSS-MATE/egnss-mate-schematics (MIT), commit 0dc83ee of 14 April 2026.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, read_bytes
from railfix.core.tables import reading_table
from railfix.core.timescale import from_week, seconds
from railfix.gnss.observations import ObservationHeader, Observations

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
#: Columns of each input table, in the order of the schema.
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
#: Columns of each output table.
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
#: Columns that are read as text.
_TEXTS: Final = ("SAT_ID", "SIGNAL_TYPE", "ANTENNA", "TRACK_EDGE_ID", "UTM_CELL", "TRACK_SEGMENT_TYPE")


def mate_table(path: FilePath) -> str:
    """Return the EGNSS MATE table that a file name denotes (S_IMU for ``s_imu.parquet``), or "" for other names."""
    name, _, kind = Path(path).name.partition(".")
    return name.upper() if name.upper() in READ and kind.lower() in ("parquet", "csv", "csv.gz") else ""


def read_mate(path: FilePath, needed: tuple[str, ...], table_name: str = "") -> pl.DataFrame:
    """Read a table (.csv, .csv.gz, .parquet). Column names become upper case; absent columns are added as null.

    Without `table_name`, the file name determines the table. Raise InputFileError if the file cannot be read, has an
    unknown column or no rows, or lacks a `needed` column.
    """
    name, file = table_name or mate_table(path), Path(path)
    with reading_table(path, f"cannot be read as the EGNSS MATE table {name} ({{}})"):
        if file.suffix.lower() == ".parquet":
            table = pl.read_parquet(file)
        else:
            overrides = dict.fromkeys(_TEXTS, pl.String())
            table = pl.read_csv(read_bytes(path), infer_schema_length=None, schema_overrides=overrides)
    table = table.rename({column: column.upper() for column in table.columns})
    unknown = [column for column in table.columns if column not in READ[name]]
    if unknown:
        raise InputFileError(
            path, f"has a column {unknown[0]} that is not in {name} of EGNSS MATE; remove or rename it"
        )
    missing = [column for column in needed if column not in table.columns]
    if missing:
        raise InputFileError(path, f"has no column {missing[0]}; the EGNSS MATE table {name} needs {', '.join(needed)}")
    if not len(table):
        raise InputFileError(path, "has no rows; leave the table out")
    absent = [column for column in READ[name] if column not in table.columns]
    return table.with_columns(pl.lit(None).alias(column) for column in absent)


def only_device(path: FilePath, table: pl.DataFrame) -> pl.DataFrame:
    """Return the table unchanged, or raise InputFileError if it has rows of several devices."""
    devices = table["DEVICE_ID"].drop_nulls().unique().sort().to_list()
    if len(devices) > 1:
        raise InputFileError(path, f"has devices {', '.join(map(str, devices))}; keep the rows of one device")
    return table


#: RINEX signal code for each Septentrio signal name of each constellation (SBF reference guide, signal types).
_CODES: Final[Mapping[str, Mapping[str, str]]] = {
    "G": {"L1CA": "1C", "L1P": "1W", "L1PY": "1W", "L2P": "2W", "L2PY": "2W", "L2C": "2L", "L5": "5Q", "L1C": "1L"},
    "R": {"L1CA": "1C", "G1CA": "1C", "L1P": "1P", "L2CA": "2C", "G2CA": "2C", "L2P": "2P", "L3": "3Q"},
    "E": {
        "E1": "1C", "E1BC": "1C", "L1BC": "1C", "E6": "6C", "E6BC": "6C", "E5A": "5Q", "E5B": "7Q", "E5": "8Q",
        "E5ALTBOC": "8Q",
    },
    "C": {"B1I": "2I", "B2I": "7I", "B3I": "6I", "B1C": "1P", "B2A": "5P", "B2B": "7D"},
    "J": {"L1CA": "1C", "L2C": "2L", "L5": "5Q", "L1C": "1L"},
    "S": {"L1CA": "1C", "L5": "5I"},
}  # fmt: skip
_NEEDED: Final = ("GPS_WEEK", "GPS_TOW", "SAT_ID", "SIGNAL_TYPE", "PSEUDORANGE")
_VALUES: Final = {
    "code_m": "PSEUDORANGE", "phase_cycles": "CARRIER_PHASE", "doppler_hz": "DOPPLER", "cn0_dbhz": "CN0",
}  # fmt: skip


def signal_code(satellite: str | None, signal: str) -> str:
    """Return the RINEX code of a signal type such as ``GPS_L1CA``, ``E5a`` or ``1C``; "" if unknown."""
    if satellite is None or len(satellite) != 3 or satellite[0] not in _CODES or not satellite[1:].isdigit():
        return ""
    name = signal.replace("-", "_").rsplit("_", 1)[-1]
    if len(name) == 2 and name[0].isdigit() and name[1].isalpha():
        return name.upper()
    return _CODES[satellite[0]].get(name.upper(), "")


def read_mate_observations(path: str) -> Observations:
    """Read the observations of a table S_GNSS_SAT, only of the antenna and device with the most rows.

    Raise InputFileError if the file is not such a table, or no row has a known satellite and signal.
    """
    table = read_mate(path, _NEEDED).with_columns(
        pl.col("SAT_ID").cast(pl.String), pl.col("SIGNAL_TYPE").cast(pl.String)
    )
    table, problems = _one_antenna(path, table)
    skipped: Counter[str] = Counter()
    usable = ~(table["ERROR"].cast(pl.Boolean).fill_null(False)) & table["TRACKING_STATUS"].cast(pl.Boolean).fill_null(
        True
    )
    skipped["rows with an error, or of signals that are not tracked"] = len(table) - int(usable.sum())
    pairs = table.select("SAT_ID", "SIGNAL_TYPE").unique()
    codes = pairs.with_columns(code=pl.Series([signal_code(*pair) for pair in pairs.iter_rows()], dtype=pl.String))
    table = table.filter(usable).join(codes, on=["SAT_ID", "SIGNAL_TYPE"], how="left", nulls_equal=True)
    known = table["code"].fill_null("") != ""
    for name, count in table.filter(~known).group_by("SIGNAL_TYPE").len().iter_rows():
        skipped[f"rows of the unknown signal type {name}"] += count
    table = table.filter(known)
    if not len(table):
        raise InputFileError(path, "has no row of a known satellite and signal, such as G05 and L1CA")
    time = from_week(table["GPS_WEEK"].to_numpy(), table["GPS_TOW"].cast(pl.Float64).to_numpy())
    return _as_arrays(table, np.round(time.astype(np.int64), -3), problems, skipped)


def _one_antenna(path: str, table: pl.DataFrame) -> tuple[pl.DataFrame, tuple[str, ...]]:
    counts = table.group_by("DEVICE_ID", "ANTENNA").len().sort("len", descending=True)
    if len(counts) == 1:
        return table, ()
    device, antenna, _ = counts.row(0)
    chosen = table.filter(
        pl.col("DEVICE_ID").eq_missing(pl.lit(device)) & pl.col("ANTENNA").eq_missing(pl.lit(antenna))
    )
    which = f"device {device}, antenna {antenna}"
    return chosen, (f"{path}: has {len(counts)} devices or antennas; only {which} with the most rows is used",)


def _as_arrays(
    table: pl.DataFrame, time_ns: np.ndarray, problems: tuple[str, ...], skipped: Counter[str]
) -> Observations:
    """Arrange the rows in arrays of epochs by channels. The last of several rows for one signal and epoch is used."""
    times, row = np.unique(time_ns, return_inverse=True)
    names = table["SAT_ID"] + table["code"]
    channels, column = np.unique(names.to_numpy().astype(np.str_), return_inverse=True)
    values: dict[str, Any] = {}
    for name, source in {**_VALUES, "lock_s": "LOCK_TIME"}.items():
        values[name] = np.full((len(times), len(channels)), np.nan)
        values[name][row, column] = table[source].cast(pl.Float64).fill_null(np.nan).to_numpy()
    time = times.astype("datetime64[ns]")
    lock = values.pop("lock_s")
    # the lock was lost if its time (in whole seconds) has decreased, or is shorter than the time since the last epoch
    lost, passed_s = np.zeros(lock.shape, dtype=np.uint8), seconds(np.diff(time))[:, None]
    lost[1:] = lock[1:] < np.fmax(np.fmin(lock[:-1], lock[:-1] + passed_s - 1.0 + 1e-6), passed_s - 1.0)
    return Observations(
        time=time,
        satellite=np.array([name[:3] for name in channels.tolist()]),
        signal=np.array([name[3:] for name in channels.tolist()]),
        **values,
        loss_of_lock=lost,
        break_before=np.zeros(len(times), dtype=np.bool_),
        header=ObservationHeader(receiver="EGNSS MATE", marker="S_GNSS_SAT"),
        problems=problems,
        problem_count=len(problems),
        skipped={name: count for name, count in skipped.items() if count},
    )

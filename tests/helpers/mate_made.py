"""Tables of EGNSS MATE (`railfix.io.mate`) of a simulated run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from railfix.core.timescale import to_week
from railfix.core.utc import gpst_to_utc
from railfix.gnss import concatenate
from railfix.io.mate import READ
from railfix.simulate.sensor_columns import sensor_tables
from railfix.simulate.signals import Simulation

#: Country of the balises, and names of signals, by constellation and RINEX code.
_COUNTRY = 493
_SIGNALS = {
    "G1C": "L1CA", "G2W": "L2P", "G2L": "L2C", "G5Q": "L5", "R1C": "L1CA", "E1C": "E1", "E5Q": "E5a", "E7Q": "E5b",
    "C2I": "B1I", "C7I": "B2I", "J1C": "L1CA", "J2L": "L2C", "J5Q": "L5",
}  # fmt: skip


def write_mate_tables(simulation: Simulation, folder: Path) -> dict[str, Path]:
    """Write S_GNSS_SAT of the front antenna, S_DM_TRACKPOINT, and the sensors that there are; return the files.

    Balises are numbered in order of chainage. Numbers have the decimals of the schema.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sensors = sensor_tables(simulation)
    tables = {"S_GNSS_SAT": _satellites(simulation), "S_DM_TRACKPOINT": _track_points(simulation)}
    if "inertial" in sensors:
        named = dict(zip(sensors["inertial"].columns[1:], _SIX, strict=True))
        six = sensors["inertial"].drop("time_gpst").rename(named)
        tables["S_IMU"] = six.select(_utc(sensors["inertial"]), pl.all().round(6), COMPENSATED=False)
    if "radar" in sensors:
        speed = sensors["radar"].select(SPEED=pl.col("speed_mps").round(3))
        tables["S_SPEEDOMETER"] = speed.select(_utc(sensors["radar"]), pl.all(), SPEED_ERROR_CODE=0)
    if "balises" in sensors:
        number = {name: k + 1 for k, name in enumerate(sensors["balise_list"]["balise"])}
        group = pl.col("balise").replace_strict(number, default=0).alias("NID_BG")
        own = {"NID_C": _COUNTRY, "N_PIG": 0, "N_TOTAL": 1}
        tables["S_BALISEREADER"] = sensors["balises"].select(_utc(sensors["balises"]), group, **_constants(own))
        tables["S_DM_BALISE"] = sensors["balise_list"].select(
            group, POSITION="chainage_m", **_constants(own | {"TRACK_EDGE_ID": simulation.line.track().name})
        )
    files = {}
    for name, table in tables.items():
        known = [column for column in READ[name] if column in table.columns]
        files[name] = folder / f"{name}.parquet"
        table.select(known).write_parquet(files[name])
    return files


_SIX = ("SPEC_FORCE_X", "SPEC_FORCE_Y", "SPEC_FORCE_Z", "ANG_RATE_X", "ANG_RATE_Y", "ANG_RATE_Z")


def _constants(values: dict[str, Any]) -> dict[str, pl.Expr]:
    return {name: pl.lit(value) for name, value in values.items()}


def _utc(table: pl.DataFrame) -> pl.Series:
    return pl.Series("TIMESTAMP_UTC", gpst_to_utc(table["time_gpst"].to_numpy()), dtype=pl.Datetime("us"))


def _satellites(simulation: Simulation) -> pl.DataFrame:
    """One row an epoch, satellite and signal; the lock time is that since the last loss of lock."""
    log = concatenate([piece.observations for piece in simulation.pieces("front", chunk_epochs=100_000)])
    epoch, channel = np.nonzero(np.isfinite(log.code_m))
    week, of_week = to_week(log.time)
    lost = np.where(log.loss_of_lock & 1, np.arange(len(log))[:, None], 0)
    since = np.maximum.accumulate(lost, axis=0)
    locked = (log.time[:, None] - log.time[since]) / np.timedelta64(1, "s")
    codes = [satellite[0] + signal for satellite, signal in zip(log.satellite, log.signal, strict=True)]
    signals = np.array([_SIGNALS.get(code, code[1:]) for code in codes])

    def of(values: np.ndarray, digits: int) -> pl.Series:
        return pl.Series(values=np.round(values[epoch, channel], digits), nan_to_null=True)

    return pl.DataFrame(
        {
            "DEVICE_ID": pl.Series(values=[1]).new_from_index(0, len(epoch)),
            "TIMESTAMP_UTC": pl.Series(gpst_to_utc(log.time)[epoch], dtype=pl.Datetime("us")),
            "GPS_WEEK": week[epoch],
            "GPS_TOW": np.round(of_week[epoch], 6),
            "SAT_ID": log.satellite[channel].tolist(),
            "SIGNAL_TYPE": signals[channel].tolist(),
            "LOCK_TIME": of(locked, 0),
            "CN0": of(log.cn0_dbhz, 3),
            "PSEUDORANGE": of(log.code_m, 6),
            "DOPPLER": of(log.doppler_hz, 6),
            "CARRIER_PHASE": of(log.phase_cycles, 6),
            "TRACKING_STATUS": pl.Series(values=[True]).new_from_index(0, len(epoch)),
            "ANTENNA": pl.Series(values=["Main"]).new_from_index(0, len(epoch)),
        }
    )


def _track_points(simulation: Simulation) -> pl.DataFrame:
    """The points of the map, with the coordinates of the simulation in the columns of ETRS89."""
    track = simulation.line.track()
    return pl.DataFrame(
        {
            "TRACK_EDGE_ID": pl.Series(values=[track.name]).new_from_index(0, len(track)),
            "POSITION": track.chainage_m.round(3),
            "LATITUDE_ETRS89": track.latitude_deg.round(9),
            "LONGITUDE_ETRS89": track.longitude_deg.round(9),
            "ALTITUDE_ETRS89": track.height_m.round(3),
            "RADIUS": np.where(np.isfinite(track.radius_m), track.radius_m, 0.0).round(3),
            "CANT": (1e3 * track.cant_m).round(3),
            "GRADIENT": track.gradient_permille.round(3),
        }
    )

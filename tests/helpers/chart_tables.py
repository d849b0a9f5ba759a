"""Small tables of epochs, positions and observations whose charts can be checked by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.reasons import Reason

START = np.datetime64("2024-03-05T03:10:00", "ns")


def times(seconds: Any) -> np.ndarray:
    return START + (np.asarray(seconds) * 1e9).astype("timedelta64[ns]")


def errors_table() -> pl.DataFrame:
    """Five epochs; the fourth has no position on the map, the fifth a reference that is too bad."""
    return pl.DataFrame(
        {
            "time_gpst": times([0.0, 1.0, 2.0, 3.0, 4.0]),
            "status": ["ok", "ok", "ok", "too_few_satellites", "ok"],
            "chainage_m": [10.0, 20.0, 30.0, 40.0, 50.0],
            "error_m": [0.5, -1.0, 2.0, None, 9.0],
            "conventional_error_m": [1.5, -3.0, None, 4.0, 9.0],
            "along_sigma_m": [1.0, 1.1, 1.2, None, 1.3],
            "protection_level_m": [5.0, float("inf"), 1.5, None, 6.0],
            "reference_good": [True, True, True, True, False],
            "interval_m": [None, 10.0, 10.0, None, 20.0],
            "conventional_interval_m": [None, 10.0, None, 20.0, 10.0],
        }
    )


def positions_table() -> pl.DataFrame:
    """A straight line to the north, a position a second and 10 m apart, the third off it to the east."""
    latitude = 35.0 + np.arange(5) * 10.0 / 110_941.0
    ecef = ecef_from_geodetic(latitude, np.full(5, 135.0), np.full(5, 50.0))
    aside = ecef_from_geodetic(latitude, np.full(5, 135.0 + 5.0 / 91_288.0), np.full(5, 50.0))
    return pl.DataFrame(
        {
            "time_gpst": times(np.arange(5)),
            "antenna": ["front"] * 5,
            "status": ["ok", "ok", "uncertain", "ok", "ok"],
            "chainage_m": np.arange(5) * 10.0,
            "kilometrage_m": 1000.0 + np.arange(5) * 10.0,
            **{f"{axis}_m": ecef[:, i] for i, axis in enumerate("xyz")},
            **{f"conventional_{axis}_m": aside[:, i] for i, axis in enumerate("xyz")},
            "conventional_chainage_m": [0.0, 11.0, None, 29.0, 40.0],
            "n_used": [8, 7, 4, 8, 9],
            "n_rejected": [1, 2, 5, 1, 0],
        }
    )


def observations_table() -> pl.DataFrame:
    """Two epochs of three satellites; one has a second signal, one is refused."""
    taken, other = 0, int(Reason.OTHER_SIGNAL_TAKEN)
    mask = int(Reason.ELEVATION_MASK | Reason.CN0_FLOOR)
    rows = [("G01", "1C", taken, 40.0, 90.0, 45.0), ("G01", "2W", other, 40.0, 90.0, 30.0)]
    rows += [("E05", "1C", mask, 12.0, 359.5, 28.0), ("J02", "1C", taken, 80.0, 10.0, None)]
    table = pl.DataFrame(
        rows, schema=["satellite", "signal", "reason", "elevation_deg", "azimuth_deg", "cn0_dbhz"], orient="row"
    )
    return pl.concat([table.with_columns(pl.lit(t).alias("time_gpst")) for t in times([0.0, 1.0])])

"""Horizontal errors of the fixes of static recordings.

The point is the header's, or for recordings without one the median of the fixes themselves.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np

import paths
from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.ground.fixes_at_stations import StationFixes, station_fixes, stream_fixes
from railfix.io import read_navigation, read_observations
from railfix.io.receiver.log import read_receiver_positions


def of_log(log: Path, nav: Path, *, seconds: float | None = None) -> tuple[Datetimes, Floats, Integers]:
    """Times, east and north errors [m] and satellites of the fixes of a log, or of its first seconds."""
    observations = read_observations(log)
    if seconds is not None:
        observations = observations[: int(np.searchsorted(
            observations.time, observations.time[0] + np.timedelta64(round(seconds), "s")
        ))]  # fmt: skip
    fixes = station_fixes([observations], observations.header.approximate_ecef_m[None], read_navigation([nav]))
    offset = (fixes.fixes_m - fixes.points_m)[:, 0]
    return fixes.time, offset if seconds is None else offset - np.nanmedian(offset, axis=0), fixes.n_satellites


def of_stream(path: Path) -> tuple[Datetimes, Floats, Integers]:
    """The same of a receiver's stream with its own ephemerides; the point is the median of its own positions."""
    place = np.nanmedian(read_receiver_positions(path).ecef_m, axis=0)

    async def work() -> list[StationFixes]:
        return [fixes async for fixes in stream_fixes([str(path)], place[None])]

    fixes = asyncio.run(work())
    return (
        np.concatenate([one.time for one in fixes]),
        np.concatenate([one.fixes_m[:, 0] for one in fixes]),
        np.concatenate([one.n_satellites for one in fixes]),
    )


def recordings(data: Path = paths.DATA) -> dict[str, tuple[Datetimes, Floats, Integers]]:
    """Errors of every static recording with navigation, by name."""
    day, geonet = data / "static" / "ESBC_2020177", data / "static" / "rtklib_geonet2005"
    crescent = data / "sbas" / "msas_20080526_crescent"
    name = "ESBC00DNK_R_20201770000_01D"
    return {
        "ESBC, 24 h at 30 s": of_log(day / f"{name}_30S_MO.crx.gz", day / f"{name}_MN.rnx.gz"),
        "GEONET 0759, 1 h at 30 s, GPS": of_log(geonet / "07590920.05o", geonet / "07590920.05n"),
        "GEONET 3040, 1 h at 30 s, GPS": of_log(geonet / "30400920.05o", geonet / "30400920.05n"),
        "Crescent, parked 200 s, GPS": of_log(
            crescent / "cres_20080526.bin.obs", crescent / "cres_20080526.bin.nav", seconds=200.0
        ),
        "u-blox, 16 dB attenuation, cold start": of_stream(
            data / "live" / "16dBatt_no_interference_coldstart.ubx.gz"
        ),
    }  # fmt: skip

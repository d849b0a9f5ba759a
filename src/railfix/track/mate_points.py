"""Track tables of EGNSS MATE of another kind than `mate_file` reads: points, and tables in Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.errors import InputFileError
from railfix.core.mate import mate_table, read_mate
from railfix.track.crs import frame_degrees
from railfix.track.mate_file import read_mate_segments
from railfix.track.route import MapReading, Segment

#: CRS of coordinates in degrees with their ellipsoidal height (ETRS89).
_ETRS89: Final = "EPSG:4937"
_NUMBERS: Final = ("LATITUDE_ETRS89", "LONGITUDE_ETRS89", "ALTITUDE_ETRS89", "RADIUS", "CANT", "GRADIENT")
_POINT: Final = ("TRACK_EDGE_ID", "POSITION", *_NUMBERS[:3])


def read_edges(path: Path, reading: MapReading) -> list[Segment]:
    """Read the edges of S_DM_TRACKPOINT, or of S_DM_TRACK_SEGMENT_POSITION in Parquet, as segments named by them.

    Points have heights, radius and cant; their CRS is ETRS89 unless `reading` has one.

    InputFileError: a table is not what it should be.
    """
    if mate_table(path) != "S_DM_TRACKPOINT":
        return read_mate_segments(path, reading)
    table = read_mate(path, _POINT).sort("TRACK_EDGE_ID", "POSITION", maintain_order=True)
    edges = table.group_by("TRACK_EDGE_ID", maintain_order=True)
    return [_segment_of_points(path, str(key[0]), rows, reading) for key, rows in edges]


def _segment_of_points(path: Path, edge: str, rows: pl.DataFrame, reading: MapReading) -> Segment:
    """The points of one track edge; cant in millimetres, a radius of 0 or none is straight."""
    values = {name: rows[name].cast(pl.Float64).fill_null(np.nan).to_numpy() for name in _NUMBERS}
    for name in _NUMBERS[:3]:
        if not np.isfinite(values[name]).all():
            raise InputFileError(path, f"track edge {edge}: a point has no {name}; complete it")
    crs = reading.crs or _ETRS89
    latitude, longitude, frame = frame_degrees(
        crs, values["LONGITUDE_ETRS89"], values["LATITUDE_ETRS89"], path=f"{path} ({edge})"
    )
    radius = np.where(np.nan_to_num(values["RADIUS"]) == 0.0, np.inf, values["RADIUS"])
    return Segment(
        source=f"{path} ({edge})",
        file=str(path),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=values["ALTITUDE_ETRS89"],
        kilometrage_m=np.full(len(rows), np.nan),
        cant_m=values["CANT"] * 1e-3,
        radius_m=radius,
        gradient_permille=values["GRADIENT"],
        crs=crs,
        frame=frame,
        height_datum="ellipsoidal",
        geoid="",
        metadata={"name": edge},
    )

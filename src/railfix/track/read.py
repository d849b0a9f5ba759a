"""Reading of a track map from one or several files."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import ending
from railfix.track.csv_file import read_csv_segment
from railfix.track.geojson_file import read_geojson_segments
from railfix.track.heights import check_height_datum
from railfix.track.route import MAX_GAP_M, join
from railfix.track.segment import Segment
from railfix.track.track import Track


def read_track(
    paths: str | PathLike[str] | Sequence[str | PathLike[str]],
    *,
    crs: str | None = None,
    height_datum: str | None = None,
    geoid: str | None = None,
    name: str | None = None,
    max_gap_m: float = MAX_GAP_M,
    sigma_plan_m: float | None = None,
    sigma_height_m: float | None = None,
    duplicates: str = "reject",
) -> Track:
    """Read the centreline of a route from CSV (``.csv``) or GeoJSON (``.geojson``, ``.json``) files, plain or packed.

    Parameters
    ----------
    paths : path or sequence of paths
        Several files are joined in the given order; each may have either direction.
    crs : str, optional
        Coordinate reference system of files without one, for example ``EPSG:6677``.
    height_datum : {"ellipsoidal", "orthometric"}, optional
        For GeoJSON without one; for CSV the column name gives it.
    geoid : str, optional
        Geoid of orthometric heights: ``japan`` (JPGEO2024), ``gsigeo2011``, a pyproj grid or CRS.
    name : str, optional
        Name of the route; by default that of the file, else the file name.
    max_gap_m : float [m]
        Widest gap between the ends of two segments.
    sigma_plan_m, sigma_height_m : float, optional [m]
        Accuracy of the map; by default that of the file, else 0.30 m and 0.60 m (P1 4.1(3)).
    duplicates : {"reject", "keep"}
        Equal consecutive points are an error, or kept for `railfix.track.check_track`.

    Returns
    -------
    Track

    Raises
    ------
    InputFileError
        A file is not a track map; the message names line and cause.
    SettingsError
        An option is unknown or contradicts the file.
    """
    check_height_datum(height_datum)
    if duplicates not in ("reject", "keep"):
        raise ValueError(f"duplicates is {duplicates!r}, expected 'reject' or 'keep'")
    for key, value in (("sigma_plan_m", sigma_plan_m), ("sigma_height_m", sigma_height_m)):
        if value is not None and not value > 0.0:
            raise SettingsError(f"{key} is {value:g}; a positive number of metres was expected")
    files = [paths] if isinstance(paths, str | PathLike) else list(paths)
    if not files:
        raise SettingsError("no track map was given")
    segments: list[Segment] = []
    for file in files:
        kind = ending(file)
        if kind in (".geojson", ".json"):
            segments += read_geojson_segments(
                file, crs=crs, height_datum=height_datum, geoid=geoid, duplicates=duplicates
            )
        elif kind == ".csv":
            segments.append(
                read_csv_segment(file, crs=crs, height_datum=height_datum, geoid=geoid, duplicates=duplicates)
            )
        else:
            raise InputFileError(file, "a track map ends in .csv, .geojson or .json")
    return join(
        segments,
        name=name,
        height_datum_asked=height_datum,
        max_gap_m=max_gap_m,
        sigma_plan_m=sigma_plan_m,
        sigma_height_m=sigma_height_m,
    )

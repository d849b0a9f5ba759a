"""Read a track map from one or several files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Unpack

import numpy as np

from railfix.core.arrays import take_rows
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import FilePath, ending, path_names
from railfix.core.notebook import plural
from railfix.io.file_kind import GDAL, find_kind, wrong_kind
from railfix.track.height_source import RASTERS, HeightSource, check_raster, with_heights
from railfix.track.heights import GEOIDS, check_height_datum
from railfix.track.point_files import read_csv_segment, read_geojson_segments
from railfix.track.route import MAX_GAP_M, NO_HEIGHTS, MapOptions, MapReading, Segment, join
from railfix.track.track import SIGMA_PLAN_M, Track
from railfix.track.vector_file import SIGMA_M as OSM_SIGMA_M
from railfix.track.vector_file import read_vector_segments
from railfix.track.xml_files import read_rinf_segments


def read_track(
    paths: FilePath | Sequence[FilePath],
    *,
    name: str | None = None,
    max_gap_m: float = MAX_GAP_M,
    sigma_height_m: float | None = None,
    heights: FilePath | None = None,
    **options: Unpack[MapOptions],
) -> Track:
    """Read the centreline of a route from map files.

    CSV (``.csv``) and GeoJSON files (``.geojson``, ``.json``) may be compressed. Further formats are, through GDAL,
    GeoPackage, Shapefile, FlatGeobuf, GML, GPX, KML, DXF and OpenStreetMap; alignments in IFC 4.3 (``.ifc``) and
    LandXML; railML 3 (``.xml``, ``.railml``); RINF as RDF; and the tables of EGNSS MATE.

    Parameters
    ----------
    paths : path or sequence of paths
        Several files are joined in the given order; each file is reversed if necessary.
    crs : str, optional
        Coordinate reference system of files that state none, for example ``EPSG:6677``.
    height_datum : {"ellipsoidal", "orthometric"}, optional
        Height datum of GeoJSON files that do not state it; in CSV files the column name states the datum.
    geoid : str, optional
        Geoid of orthometric heights: ``japan`` (JPGEO2024), ``gsigeo2011``, a pyproj grid, or a CRS.
    name : str, optional
        Name of the route; by default the name in the file, otherwise the file name.
    max_gap_m : float [m]
        Largest gap between two segments that is bridged.
    sigma_plan_m, sigma_height_m : float, optional [m]
        Standard deviations of the map in plan and in height; by default the values stated in the file or, if the file
        states none, 0.30 m and 0.60 m (P1 4.1(3)).
    duplicates : {"merge", "keep"}
        Whether equal consecutive points are merged, with a note, or kept for `railfix.track.check_track`.
    heights : path, optional
        File with heights for a map without heights; see `railfix.track.height_source.with_heights`.

    Returns
    -------
    Track

    Raises
    ------
    InputFileError
        A file is not a valid track map. The message states the line and the cause.
    SettingsError
        An option is unknown, missing, or contradicts the file.
    ValueError
        `duplicates` is neither "merge" nor "keep".
    """
    names = path_names(paths)
    reading = MapReading(**options)
    check_height_datum(reading.height_datum)
    if reading.duplicates not in ("merge", "keep"):
        raise ValueError(f"duplicates is {reading.duplicates!r}, expected 'merge' or 'keep'")
    for key, value in (("sigma_plan_m", reading.sigma_plan_m), ("sigma_height_m", sigma_height_m)):
        if value is not None and not value > 0.0:
            raise SettingsError(f"{key} is {value:g}; a positive number of metres was expected")
    return track_of_segments(
        [segment for file in names for segment in read_segments(file, reading)],
        heights=heights,
        geoid=reading.geoid,
        name=name,
        height_datum=reading.height_datum,
        max_gap_m=max_gap_m,
        sigma_height_m=sigma_height_m,
    )


def track_of_segments(
    segments: Sequence[Segment],
    *,
    heights: HeightSource | None = None,
    geoid: str | None = None,
    name: str | None = None,
    height_datum: str | None = None,
    max_gap_m: float = MAX_GAP_M,
    sigma_height_m: float | None = None,
) -> Track:
    """Join segments to a track; if they have no heights, use the file `heights`; see `read_track`."""
    check_heights(segments, heights, geoid=geoid, height_datum=height_datum, sigma_height_m=sigma_height_m)
    track = join(
        [replace(s, height_m=np.zeros(len(s.height_m))) if s.height_datum == NO_HEIGHTS else s for s in segments],
        name=name,
        height_datum_asked=height_datum,
        max_gap_m=max_gap_m,
        sigma_height_m=sigma_height_m,
    )
    if heights is None:
        return track
    return with_heights(track, heights, geoid=geoid, height_datum=height_datum, sigma_m=sigma_height_m)


def check_heights(
    segments: Sequence[Segment],
    heights: HeightSource | None,
    *,
    geoid: str | None,
    height_datum: str | None,
    sigma_height_m: float | None,
) -> None:
    """Check that the heights come from either the segments or `heights`.

    Raise InputFileError if there are no heights. Raise SettingsError if `heights` is given although a segment has
    heights, or if options for a raster are missing.
    """
    flat = [s for s in segments if s.height_datum == NO_HEIGHTS]
    if flat and heights is None:
        raise InputFileError(
            flat[0].source,
            "the coordinates have no height; give heights (--heights): a profile by chainage; a log of 3-D positions; "
            "in railfix run, `log` for the heights of the log's own positions; or a raster file with height_datum "
            "(--height-datum), sigma_height_m (--height-sigma) and, for orthometric heights, geoid (--geoid) "
            f"({GEOIDS})",
        )
    if heights is not None and len(flat) < len(segments):
        raise SettingsError(
            f"{segments[0].source} already has heights; heights (--heights) are for maps without heights"
        )
    if isinstance(heights, str | PathLike) and ending(heights) in RASTERS:
        check_raster(heights, geoid=geoid, height_datum=height_datum, sigma_m=sigma_height_m)


def read_segments(file: FilePath, reading: MapReading) -> list[Segment]:
    """Read the lines of one map file as segments, in the order of the file.

    If a file has no heights, its segments have the height datum `NO_HEIGHTS`. Errors are listed in `read_track`.
    """
    segments = [_without_repeated(segment, reading) for segment in _read_segments(file, reading)]
    if (given := reading.sigma_plan_m) is not None:
        return [_with_given_accuracy(segment, given) for segment in segments]
    if unknown := [s for s in segments if np.isnan(s.datum_plan_m)]:
        raise SettingsError(
            f"{unknown[0].source}: the accuracy of the transformation from its CRS is unknown; give the accuracy of "
            "the transformed map (sigma_plan_m, --plan-sigma)"
        )
    return [s if "sigma_plan_m" in s.metadata else _with_usual_accuracy(s, Path(file).name) for s in segments]


def _without_repeated(segment: Segment, reading: MapReading) -> Segment:
    """Return a segment without repeated consecutive points, unless `reading.duplicates` is "keep".

    Raise InputFileError if the segment has fewer than two different points.
    """
    points = np.stack([segment.latitude_deg, segment.longitude_deg, np.nan_to_num(segment.height_m)])
    new = np.concatenate([[True], (np.diff(points) != 0.0).any(axis=0)])
    if new.sum() < 2:
        raise InputFileError(segment.source, "a track needs at least two different points")
    if new.all() or reading.duplicates == "keep":
        return segment
    note = f"{segment.source}: {plural(int((~new).sum()), 'repeated point')} left out"
    return replace(take_rows(segment, new), notes=(*segment.notes, note))


def _with_usual_accuracy(segment: Segment, file: str) -> Segment:
    drawn = "origin" in segment.metadata
    sigma_m, source = (OSM_SIGMA_M, "OpenStreetMap") if drawn else (SIGMA_PLAN_M, file)
    usual = "" if drawn else ", as for an aerial survey"
    note = f"map: {source} states no accuracy, {sigma_m:g} m in plan is assumed{usual} (--plan-sigma)"
    return _with_accuracy(segment, sigma_m, note)


def _with_given_accuracy(segment: Segment, given_m: float) -> Segment:
    """Return a segment with a given accuracy in plan, in which the datum transformation is already included."""
    note = f"map: {given_m:g} m in plan (--plan-sigma) is better than the accuracy of the map's transformation"
    notes = [note] if segment.datum_plan_m > given_m else []
    return replace(_with_accuracy(segment, given_m, *notes), datum_plan_m=0.0)


def _with_accuracy(segment: Segment, sigma_m: float, *notes: str) -> Segment:
    metadata = segment.metadata | {"sigma_plan_m": f"{sigma_m:g}"}
    return replace(segment, metadata=metadata, notes=(*segment.notes, *notes))


def _read_segments(file: FilePath, reading: MapReading) -> list[Segment]:
    kind = find_kind(file)
    if kind == "mate":
        from railfix.track.mate_file import read_edges

        return read_edges(Path(file), reading)
    if kind == "table":
        return [read_csv_segment(file, reading)]
    if kind == "rdf":
        return read_rinf_segments(file, reading)
    if kind == "geojson":
        return read_geojson_segments(file, reading)
    if kind in ("kml", "gpx", "osm", *GDAL):
        return read_vector_segments(file, reading)
    if kind == "ifc":
        from railfix.track.ifc_file import read_ifc_segments

        return read_ifc_segments(file, reading)
    if kind == "xml":
        from railfix.track.xml_files import read_xml_segments

        return read_xml_segments(file, reading)
    raise wrong_kind(
        file,
        "a track map (a table, GeoJSON, KML, GPX, OpenStreetMap, LandXML, railML, IFC, RDF of RINF, GeoPackage, "
        "Shapefile, FlatGeobuf, GML or DXF)",
    )

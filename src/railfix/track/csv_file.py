"""Track maps as CSV with named columns."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import write_whole
from railfix.core.settings import misspelt
from railfix.core.tables import plural
from railfix.io.named_columns import NamedColumns, read_named_columns
from railfix.track.crs import frame_degrees, known_crs, older_datum_note, used_crs
from railfix.track.heights import check_height_datum, ellipsoidal_heights
from railfix.track.route import RINF_NAMES, RINF_SECTIONS, MapReading, Segment
from railfix.track.track import UNNAMED, Track

#: Attribute of the track, factor, and value of an empty cell, by column of the file.
OPTIONAL_COLUMNS: Final[dict[str, tuple[str, float, float]]] = {
    "kilometrage_m": ("kilometrage_m", 1.0, np.nan),
    "cant_mm": ("cant_m", 1e-3, np.nan),
    "radius_m": ("radius_m", 1.0, np.inf),
    "gradient_permille": ("gradient_permille", 1.0, np.nan),
}
#: Standard deviations of each point, for people: positioning takes those of the whole map.
SIGMA_COLUMNS: Final = ("sigma_plan_m", "sigma_height_m")
KNOWN_COLUMNS: Final = (
    "latitude_deg", "longitude_deg", "height_m", "elevation_m", "geoid_m", *OPTIONAL_COLUMNS, *SIGMA_COLUMNS,
)  # fmt: skip
#: ``# key: value`` lines above the header that are used; others are ignored.
KNOWN_METADATA: Final = ("name", "crs", "height_datum", "geoid", "sigma_plan_m", "sigma_height_m", "note")


def attributes(count: int, read: Callable[[str, float], Floats | None]) -> dict[str, Floats]:
    """Read optional attributes of points by `read(name, blank)`; radii of 0, straight track, become infinite."""
    found: dict[str, Floats] = {}
    for column, (name, factor, blank) in OPTIONAL_COLUMNS.items():
        values = read(column, blank)
        found[name] = np.full(count, np.nan) if values is None else values * factor
    return found | {"radius_m": np.where(found["radius_m"] == 0.0, np.inf, found["radius_m"])}


def read_csv_segment(path: str | PathLike[str], reading: MapReading) -> Segment:
    """Read a CSV track map as one segment of a route; its CRS is geographic."""
    check_height_datum(reading.height_datum)
    table = read_named_columns(path)
    notes = _check_columns(table)
    if "note" in table.metadata:
        notes += tuple(table.metadata["note"].split("; "))
    latitude, longitude = table.numbers("latitude_deg"), table.numbers("longitude_deg")
    check_degrees(table, latitude, longitude)
    datum = _datum(table, reading.height_datum)
    heights = table.numbers("height_m" if datum == "ellipsoidal" else "elevation_m")
    if len(table) < 2:
        raise InputFileError(path, f"{plural(table, 'point')}; a track needs at least two")
    same = (np.diff(latitude) == 0) & (np.diff(longitude) == 0) & (np.diff(heights) == 0)
    if reading.duplicates == "reject" and same.any():
        row = int(np.argmax(same)) + 1
        raise table.error(
            row,
            f"the same point as line {table.line[row - 1]} ({int(same.sum())} such in the file); remove it, "
            "'railfix map check' lists them all",
        )
    crs = used_crs(path, reading.crs, table.metadata.get("crs"))
    latitude, longitude, frame = _in_frame(crs, latitude, longitude, path=table.path)
    geoid = reading.geoid
    if geoid is None and datum == "orthometric" and "geoid_m" not in table:
        geoid = table.metadata.get("geoid")
    height, model = ellipsoidal_heights(
        heights,
        latitude,
        longitude,
        datum=datum,
        geoid=geoid,
        geoid_m=table.numbers("geoid_m") if "geoid_m" in table and datum == "orthometric" else None,
        path=table.path,
    )
    return Segment(
        source=table.path,
        file=table.path,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        crs=crs or UNNAMED,
        frame=frame,
        height_datum=datum,
        geoid=model,
        metadata={key: value for key, value in table.metadata.items() if key in KNOWN_METADATA},
        notes=(*notes, *older_datum_note(crs)),
        **attributes(len(table), lambda column, blank: table.numbers(column, blank=blank) if column in table else None),
    )


def _check_columns(table: NamedColumns) -> tuple[str, ...]:
    """Reject a header without coordinates or with a misspelt column; return notes on unused columns."""
    close = misspelt(table.cells, KNOWN_COLUMNS)
    for wrong, right in close.items():
        if right not in table:
            message = f"column {wrong!r} is unknown; is {right!r} meant?"
            raise InputFileError(table.path, message, line=table.header_line)
    for wrong, right in misspelt(table.metadata, KNOWN_METADATA).items():
        if right not in table.metadata:
            raise InputFileError(table.path, f"the line '# {wrong}: {table.metadata[wrong]}': is '# {right}' meant?")
    for name in ("latitude_deg", "longitude_deg"):
        if name not in table:
            message = f"there is no column {name!r}; the columns are {', '.join(table.cells)}"
            if any(cell.lower() in RINF_NAMES for cell in table.cells):
                message += f"; {RINF_SECTIONS}"
            raise InputFileError(table.path, message, line=table.header_line)
    if ("height_m" in table) == ("elevation_m" in table):
        what = "both 'height_m' and 'elevation_m'" if "height_m" in table else "neither 'height_m' nor 'elevation_m'"
        message = f"{what}; one is needed: height_m is ellipsoidal, elevation_m is orthometric (levelling)"
        raise InputFileError(table.path, message, line=table.header_line)
    used = [name for name in KNOWN_COLUMNS if name != "geoid_m" or "elevation_m" in table]
    extra = [name for name in table.cells if name not in used]
    return (f"{table.path}: columns not used: {', '.join(extra)}",) if extra else ()


def _datum(table: NamedColumns, asked: str | None) -> str:
    datum = "ellipsoidal" if "height_m" in table else "orthometric"
    for source, stated in (("height_datum", asked), ("the line '# height_datum'", table.metadata.get("height_datum"))):
        if stated is not None and stated != datum:
            column = "height_m" if datum == "ellipsoidal" else "elevation_m"
            message = (
                f"{source} is {stated!r}, but the column {column} is {datum}; rename the column or drop the setting"
            )
            raise InputFileError(table.path, message, line=table.header_line)
    return datum


def check_degrees(table: NamedColumns, latitude_deg: Floats, longitude_deg: Floats) -> None:
    """Reject coordinates that cannot be degrees of latitude and longitude."""
    outside = np.abs(latitude_deg) > 90.0
    if outside.any():
        row = int(np.argmax(outside))
        value = latitude_deg[row]
        hint = "are latitude and longitude swapped?"
        if abs(value) > 360.0:
            hint = "degrees were expected, not metres of a grid (read from GeoJSON), minutes or seconds"
        raise table.error(row, f"latitude_deg {value:g} is over 90; {hint}")
    outside = np.abs(longitude_deg) > 360.0
    if outside.any():
        row = int(np.argmax(outside))
        raise table.error(row, f"longitude_deg {longitude_deg[row]:g} is over 360; degrees were expected")
    if len(table) and (np.abs(latitude_deg) <= np.pi / 2).all() and (np.abs(longitude_deg) <= np.pi).all():
        raise table.error(0, "all coordinates lie within a few degrees of 0, 0: radians were given, degrees expected")


def _in_frame(crs: str | None, latitude: Floats, longitude: Floats, *, path: str) -> tuple[Floats, Floats, str]:
    """Degrees of a geographic system, and the modern frame they are in."""
    if crs is None:
        return latitude, longitude, "EPSG:4979"
    system = known_crs(crs, path=path)
    if not system.is_geographic:
        raise SettingsError(
            f"{path}: {crs} is {system.name}, but the columns are latitude and longitude; "
            "projected coordinates are read from GeoJSON"
        )
    unit = system.axis_info[0].unit_name
    if unit != "degree":
        raise SettingsError(f"{path}: {crs} is {system.name}, in {unit}s, but the columns are in degrees")
    return frame_degrees(crs, longitude, latitude, path=path)


def write_track_csv(track: Track, path: str | PathLike[str], *, sigma_m: Floats | None = None) -> None:
    """Write a track as CSV with ellipsoidal heights; a failed write leaves no file.

    Attributes without any value are omitted. The file reads back equal to the track within
    1e-10 degrees and 0.1 mm. Standard deviations of each point, plan and height, shape (V, 2) [m], are columns more.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    columns = {
        "latitude_deg": [f"{v:.10f}" for v in track.latitude_deg],
        "longitude_deg": [f"{v:.10f}" for v in track.longitude_deg],
        "height_m": [f"{v:.4f}" for v in track.height_m],
    }
    for column, (name, factor, _) in OPTIONAL_COLUMNS.items():
        values = getattr(track, name) / factor
        if np.isfinite(values).any() or np.isinf(values).any():
            columns[column] = ["" if np.isnan(v) else f"{v:.10g}" for v in values]
            if column == "radius_m" and np.isnan(values).any():
                columns[column] = ["nan" if np.isnan(v) else f"{v:.10g}" for v in values]
    if sigma_m is not None:
        columns |= {name: [f"{v:.3f}" for v in sigma_m[:, i]] for i, name in enumerate(SIGMA_COLUMNS)}
    lines = [
        f"# name: {track.name}",
        f"# crs: {track.provenance.frame}",
        "# height_datum: ellipsoidal",
        f"# sigma_plan_m: {track.sigma_plan_m:g}",
        f"# sigma_height_m: {track.sigma_height_m:g}",
        *(f"# note: {note}" for note in track.provenance.notes),
        ",".join(columns),
        *(",".join(row) for row in zip(*columns.values(), strict=True)),
    ]
    write_whole(path, "\n".join(lines) + "\n")

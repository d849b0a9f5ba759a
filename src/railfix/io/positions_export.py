"""Write positions of a run as KML, GPX, GeoJSON, GeoPackage or GeoParquet, with a style for QGIS.

KML and GPX are written from templates, because pyogrio writes no styles to KML and no description to GPX. GeoParquet is
written by polars, because the pyogrio wheels lack the GeoParquet driver. Files are built in memory, because GDAL does
not always report a full disk.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
import polars.selectors as cs
from pyproj import CRS

from railfix.core.errors import NoPositionError
from railfix.core.extras import needs_extra
from railfix.core.staged_files import stage_file
from railfix.core.utc import gpst_to_utc

#: Columns written as attributes of each position, if the table has them.
ATTRIBUTES: Final = (
    "time_gpst", "antenna", "status", "chainage_m", "kilometrage_m", "along_sigma_m", "protection_level_m",
    "protection_level_ground_m", "protection_status", "speed_mps", "track", "track_chainage_m", "track_probability",
)  # fmt: skip
COORDINATES: Final = ("longitude_deg", "latitude_deg", "height_m")
#: Colour of each status, chosen by the reliability of such positions; "other" is for statuses that are not listed.
STATUS_COLOURS: Final[Mapping[str, str]] = {
    "ok": "#00805e",
    "tracking": "#00805e",
    "coasting": "#0072b2",
    "ambiguous": "#e69f00",
    "several_branches": "#e69f00",
    "uncertain": "#e69f00",
    "inconsistent": "#d55e00",
    "antennas_disagree": "#d55e00",
    "doubtful": "#d55e00",
    "lost": "#d55e00",
    "off_map": "#a3487e",
    "map_offset": "#a3487e",
    "map_end": "#e69f00",
    "jamming_suspected": "#e69f00",
    "spoofing_suspected": "#d55e00",
    "other": "#767676",
}
#: Coordinate reference system of the written positions: WGS 84 with ellipsoidal heights.
_CRS: Final = "EPSG:4979"
_STYLED: Final = (".geojson", ".gpkg", ".parquet")


def style_file(path: Path) -> Path | None:
    """Return the path of the QGIS style to write for a file, or None if no style must be written.

    No style is written if the format has none, or if the style file already exists with the same content.
    """
    style = path.with_suffix(".qml")
    if path.suffix.lower() not in _STYLED or (style.is_file() and style.read_bytes() == _style()):
        return None
    return style


def write_positions(rows: pl.DataFrame, path: Path, *, description: str) -> int:
    """Write the rows that have coordinates, and the QGIS style. Return the number of rows written.

    The ending of the file name determines the format. Raise NoPositionError if no row has coordinates.
    """
    points = _points(rows)
    if points.is_empty():
        raise NoPositionError(f"{path}: no epoch has a position; nothing was written")
    contents = {path: _content(points, path, description)}
    if style := style_file(path):
        contents[style] = _style()
    with ExitStack() as staged:
        for target, content in contents.items():
            staged.enter_context(stage_file(target)).write_bytes(content)
    return len(points)


def _points(rows: pl.DataFrame) -> pl.DataFrame:
    """Return time, attributes and coordinates of the rows that have coordinates."""
    known = rows.drop_nulls(COORDINATES)
    utc = pl.Series(gpst_to_utc(known["time_gpst"].to_numpy())).dt.replace_time_zone("UTC")
    return known.select(utc.alias("time_utc"), cs.by_name(*ATTRIBUTES, *COORDINATES, require_all=False)).with_columns(
        cs.float().replace([math.inf, -math.inf, math.nan], None)
    )


def _content(points: pl.DataFrame, path: Path, description: str) -> bytes:
    ending = path.suffix.lower()
    if ending == ".parquet":
        return _geoparquet(points, description)
    points = points.with_columns(
        pl.col("time_utc").dt.round("1ms").dt.cast_time_unit("ms"), pl.col("time_gpst").dt.to_string("iso:strict")
    )
    if ending == ".gpkg":
        return _features(points, "GPKG", layer=path.stem, DESCRIPTION=description)
    if ending == ".geojson":
        options = {"RFC7946": "YES", "COORDINATE_PRECISION": "9", "DESCRIPTION": description}
        return _features(points, "GeoJSON", layer=path.stem, **options)
    points = points.with_columns(pl.col("time_utc").dt.strftime("%Y-%m-%dT%H:%M:%S%.3fZ"))
    names = points["antenna"].unique(maintain_order=True)
    antennas = {name: points.filter(antenna=name).iter_rows(named=True) for name in names}
    fields = [name for name in points.columns if name not in ("time_utc", *COORDINATES)]
    return _render(f"positions{ending}", name=path.stem, description=description, antennas=antennas, fields=fields)


def _features(points: pl.DataFrame, driver: str, *, layer: str, **options: str) -> bytes:
    """Return the file content for a format that is written by GDAL."""
    with needs_extra():
        import pyogrio

    fields = [column for column in points if column.name not in COORDINATES]
    values = [column.to_numpy() for column in fields]
    file = BytesIO()
    pyogrio.raw.write(
        file,
        _wkb(points, "extended"),  # pyogrio up to 0.10 accepts no other flavor
        [value if value.dtype.kind in "fM" else value.astype(object) for value in values],
        np.array([column.name for column in fields]),
        field_mask=[column.is_null().to_numpy() for column in fields],
        gdal_tz_offsets={"time_utc": np.full(len(points), 100)},  # GDAL's code for UTC
        layer=layer,
        driver=driver,
        geometry_type="Point Z",
        crs=_CRS,
        layer_options=options,
    )
    return file.getvalue()


def _geoparquet(points: pl.DataFrame, description: str) -> bytes:
    """Return the content of a GeoParquet 1.1 file."""
    place = points.select(COORDINATES).to_numpy()
    column = {
        "encoding": "WKB",
        "geometry_types": ["Point Z"],
        "crs": CRS(_CRS).to_json_dict(),
        "bbox": [*place.min(axis=0), *place.max(axis=0)],
    }
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    table = points.drop(COORDINATES).with_columns(pl.Series("geometry", _wkb(points, "iso").tolist(), dtype=pl.Binary))
    file = BytesIO()
    table.write_parquet(file, metadata={"geo": json.dumps(geo), "description": description})
    return file.getvalue()


def _wkb(points: pl.DataFrame, flavor: str) -> Any:
    """Return the points as well-known binary of the flavor "iso" or "extended", shape (n,)."""
    with needs_extra():
        import shapely

    return shapely.to_wkb(shapely.points(points.select(COORDINATES).to_numpy()), flavor=flavor)


def _style() -> bytes:
    """Return the style for QGIS: a dot for each position, coloured by status."""
    return _render("positions.qml")


def _render(template: str, **values: Any) -> bytes:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("railfix.io"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    file = BytesIO()
    environment.get_template(f"{template}.j2").stream(colours=STATUS_COLOURS, **values).dump(file, encoding="utf-8")
    return file.getvalue()

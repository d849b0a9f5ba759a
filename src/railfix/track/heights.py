"""Conversion of orthometric to ellipsoidal heights with a named geoid model (P1 3.1(1))."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Final

import japan_geoid
import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, SettingsError
from railfix.track.crs import vertical_of
from railfix.track.route import MapReading

#: Geoid models of the GSI of Japan: GSIGEO2011 for heights levelled before April 2025, JPGEO2024 since.
JAPAN_MODELS: Final = {
    "japan": "JPGEO2024",
    "jpgeo2024": "JPGEO2024",
    "jpgeo2024+hrefconv2024": "JPGEO2024+Hrefconv2024",
    "gsigeo2011": "GSIGEO2011",
}
_LOADERS: Final = {
    "JPGEO2024": japan_geoid.load_embedded_jpgeo2024,
    "JPGEO2024+Hrefconv2024": japan_geoid.load_embedded_jpgeo2024_hrefconv2024,
    "GSIGEO2011": japan_geoid.load_embedded_gsigeo2011,
}
GEOIDS: Final = "egm96 of the world, japan, a grid file, or a vertical CRS such as EPSG:3855"  #: Geoids by name.
#: Advice for orthometric heights without a geoid.
GEOID_HELP: Final = f"give one (--geoid): {GEOIDS}; or a column geoid_m"
#: EGM96: the grid of 15' that PROJ knows of, and the error of the one of 1 degree that sidereon ships [m].
_EGM96: Final = "us_nga_egm96_15.tif"
_EGM96_NAMES: Final = ("egm96", "epsg:5773")
HEIGHT_DATUMS: Final = ("ellipsoidal", "orthometric")


def check_height_datum(height_datum: str | None) -> None:
    """Raise `SettingsError` for a height datum other than ellipsoidal and orthometric."""
    if height_datum is not None and height_datum not in HEIGHT_DATUMS:
        raise SettingsError(f"height_datum {height_datum!r} is unknown; expected 'ellipsoidal' or 'orthometric'")


def geoid_heights(geoid: str, latitude_deg: Floats, longitude_deg: Floats, *, path: str) -> tuple[Floats, str]:
    """Height of a geoid above the WGS 84 ellipsoid, shape (n,) [m], and the model used.

    The geoid is a key of `JAPAN_MODELS`; ``egm96``, by PROJ's grid, else by `sidereon` (0.4 m RMS from it); a pyproj
    grid (``.tif``, ``.gtx``); or a vertical or compound CRS (``EPSG:5773``). SettingsError: unknown or not installed.
    InputFileError: points outside the area of the model.
    """
    key = geoid.strip().lower()
    if key in JAPAN_MODELS:
        name = JAPAN_MODELS[key]
        heights = np.asarray(_LOADERS[name]().get_heights(np.array(longitude_deg), np.array(latitude_deg)), np.float64)
    elif key in _EGM96_NAMES and not _has_grid(_EGM96):
        name, heights = _egm96(latitude_deg, longitude_deg)
    else:
        name, transformer = _proj_transformer(_EGM96 if key == "egm96" else geoid)
        zeros = np.zeros_like(latitude_deg)
        heights = np.asarray(transformer.transform(longitude_deg, latitude_deg, zeros)[2], np.float64)
    outside = ~np.isfinite(heights)
    if outside.any():
        i = int(np.argmax(outside))
        raise InputFileError(
            path,
            f"{int(outside.sum())} of {len(heights)} points lie outside the geoid {name}, the first at latitude "
            f"{latitude_deg[i]:.6f}, longitude {longitude_deg[i]:.6f}; are latitude and longitude swapped, or is it "
            "another country's geoid?",
        )
    return heights, name


def _has_grid(name: str) -> bool:
    """Whether PROJ has a grid."""
    return any((Path(folder) / name).is_file() for folder in (*get_data_dir().split(os.pathsep), get_user_data_dir()))


def _egm96(latitude_deg: Floats, longitude_deg: Floats) -> tuple[str, Floats]:
    """EGM96 by sidereon's grid of 1 degree."""
    try:
        import sidereon
    except ImportError:
        raise SettingsError(
            f"geoid egm96: neither PROJ's grid nor a package with it is installed; projsync --file {_EGM96}, or "
            "pip install 'railfix[maps]'"
        ) from None
    east = (longitude_deg + 180.0) % 360.0 - 180.0
    heights = sidereon.egm96_undulations_deg(np.ascontiguousarray(np.stack([latitude_deg, east], axis=-1)))
    return "EGM96, 1 degree grid (0.4 m)", np.asarray(heights, dtype=np.float64)


def _missing_grids(source: CRS) -> str:
    """Names of the grids that PROJ would need for heights of a compound CRS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(source, "EPSG:4979", always_xy=True, allow_ballpark=False)
    names = {grid.short_name for operation in group.unavailable_operations for grid in operation.grids}
    return " or ".join(sorted(names)) or "NAME"


def _proj_transformer(geoid: str) -> tuple[str, Transformer]:
    """Create a pyproj transformation from geoid to ellipsoidal heights; ballpark results are not allowed."""
    grid = geoid.lower().endswith((".tif", ".tiff", ".gtx")) or Path(geoid).is_file()
    name = Path(geoid).name
    try:
        if grid:
            steps = f"+proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=vgridshift +grids={geoid} +multiplier=1"
            back = "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
            return geoid, Transformer.from_pipeline(f"+proj=pipeline +step {steps} {back}")
        crs = CRS.from_user_input(geoid)
        if not (crs.is_vertical or crs.is_compound):
            raise SettingsError(f"geoid {geoid!r} is {crs.name}, which has no height datum; {GEOID_HELP}")
        plan, vertical = CRS.from_user_input(4326), crs
        if crs.is_compound:
            geodetic, vertical = crs.sub_crs_list[0].geodetic_crs, crs.sub_crs_list[1]
            plan = plan if geodetic is None else geodetic.to_2d()
        source = CompoundCRS(vertical.name, [plan, vertical])
        name = _missing_grids(source)
        transformer = Transformer.from_crs(source, "EPSG:4979", always_xy=True, allow_ballpark=False, only_best=True)
        return crs.name, transformer
    except CRSError:
        raise SettingsError(f"geoid {geoid!r} is unknown; {GEOID_HELP}") from None
    except ProjError:
        raise SettingsError(
            f"geoid {geoid!r}: the grid is not installed in PROJ; install it (projsync --file {name}), or give its path"
        ) from None


def stated_heights(
    heights_m: Floats, latitude_deg: Floats, longitude_deg: Floats, reading: MapReading, *, path: str
) -> tuple[Floats, str, str]:
    """Ellipsoidal heights of a file without a datum of its own, the geoid used, and the datum, which must be given."""
    check_height_datum(reading.height_datum)
    datum, geoid = own_height_datum(reading.crs, reading.height_datum, reading.geoid, path=path)
    if datum is None:
        raise SettingsError(f"{path}: the height datum is missing; give --height-datum ellipsoidal or orthometric")
    height, model = ellipsoidal_heights(
        heights_m, latitude_deg, longitude_deg, datum=datum, geoid=geoid, geoid_m=None, path=path
    )
    return height, model, datum


def own_height_datum(
    crs: str | None, height_datum: str | None, geoid: str | None, *, path: str
) -> tuple[str | None, str | None]:
    """Height datum and geoid asked for, or those of a compound CRS; SettingsError when they contradict each other."""
    vertical = vertical_of(crs)
    if vertical is None:
        return height_datum, geoid
    if height_datum == "ellipsoidal":
        raise SettingsError(
            f"{path}: height_datum 'ellipsoidal' contradicts the file's own CRS, whose heights are {vertical.name}"
        )
    return "orthometric", geoid or crs


def ellipsoidal_heights(
    heights_m: Floats,
    latitude_deg: Floats,
    longitude_deg: Floats,
    *,
    datum: str,
    geoid: str | None,
    geoid_m: Floats | None,
    path: str,
) -> tuple[Floats, str]:
    """Convert heights of a datum to ellipsoidal ones, by a model or the map's `geoid_m`; name the geoid used."""
    if datum == "ellipsoidal":
        if geoid is not None:
            raise SettingsError(f"{path}: geoid {geoid!r} was given, but the heights are ellipsoidal already")
        return heights_m, ""
    if geoid_m is not None:
        if geoid is not None:
            raise SettingsError(f"{path}: geoid {geoid!r} was given, but the map has geoid_m itself; use one")
        return heights_m + geoid_m, "geoid_m of the map"
    if geoid is None:
        raise InputFileError(path, f"the heights are orthometric, which needs a geoid; {GEOID_HELP}")
    model_m, name = geoid_heights(geoid, latitude_deg, longitude_deg, path=path)
    return heights_m + model_m, name

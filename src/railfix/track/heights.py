"""Conversion of the heights of a map to ellipsoidal heights, by a geoid model or a PROJ operation (P1 3.1(1))."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Final

import japan_geoid
import numpy as np
import scipy
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError, ProjError

from railfix.core.arrays import Floats, read_only
from railfix.core.errors import InputFileError, SettingsError
from railfix.track.crs import find_operations, get_vertical_datum, known_accuracy_m
from railfix.track.georeference import NEGLIGIBLE_M, EllipsoidalHeights, Georeference
from railfix.track.route import MapReading

#: Geoid models of Japan (GSI) by name in options: GSIGEO2011 for heights levelled before April 2025, JPGEO2024 for
#: later heights.
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
#: Standard deviation of the Japanese models [m], as stated by the GSI from a comparison of GNSS with levelling.
_JAPAN_M: Final = 0.02
GEOIDS: Final = "egm96 of the world, japan, a grid file, or a vertical CRS such as EPSG:3855"  #: Accepted geoids.
#: End of messages on orthometric heights without a geoid.
GEOID_HELP: Final = f"specify a geoid (--geoid): {GEOIDS}; or provide a column geoid_m"
_EGM96_NAMES: Final = ("egm96", "epsg:5773")
#: Standard deviation of EGM96 [m], as stated by EPSG (operation 10084).
_EGM96_M: Final = 1.0
HEIGHT_DATUMS: Final = ("ellipsoidal", "orthometric")


@dataclass(frozen=True, kw_only=True)
class GeoidModel:
    """Geoid heights at n points."""

    height_m: Floats  #: Height of the geoid above the ellipsoid, shape (n,).
    name: str  #: Name of the model.
    accuracy_m: float  #: Standard deviation of the model; NaN if unknown.


def check_height_datum(height_datum: str | None) -> None:
    """Raise SettingsError unless a height datum is None, "ellipsoidal" or "orthometric"."""
    if height_datum is not None and height_datum not in HEIGHT_DATUMS:
        raise SettingsError(f"height_datum {height_datum!r} is unknown; expected 'ellipsoidal' or 'orthometric'")


def geoid_heights(geoid: str | CRS, place: Georeference, *, path: str) -> GeoidModel:
    """Compute the heights of a geoid above the ellipsoid at the points of a map.

    `geoid` is a name in `JAPAN_MODELS`, ``egm96``, a PROJ grid, or a vertical or compound CRS. Raise SettingsError if
    the geoid is unknown or not installed, and InputFileError if the geoid does not cover all points.
    """
    key = geoid.strip().lower() if isinstance(geoid, str) else ""
    if isinstance(geoid, CRS) and geoid.to_authority() == ("EPSG", "5773"):
        key = _EGM96_NAMES[0]
    if key in JAPAN_MODELS:
        name = JAPAN_MODELS[key]
        degrees = np.array(place.longitude_deg), np.array(place.latitude_deg)
        heights = np.asarray(_LOADERS[name]().get_heights(*degrees), np.float64)
        model = GeoidModel(height_m=heights, name=name, accuracy_m=_JAPAN_M)
    elif key in _EGM96_NAMES:
        heights = egm96_heights(place.latitude_deg, place.longitude_deg)
        model = GeoidModel(height_m=heights, name="EGM96, grid of 15'", accuracy_m=_EGM96_M)
    else:
        model = _model_of_proj(geoid, place)
    outside = ~np.isfinite(model.height_m)
    if outside.any():
        i = int(np.argmax(outside))
        raise InputFileError(
            path,
            f"{int(outside.sum())} of {len(outside)} points are outside the geoid {model.name}, the first at latitude "
            f"{place.latitude_deg[i]:.6f}, longitude {place.longitude_deg[i]:.6f}; give the geoid of the country, or "
            "check whether latitude and longitude are swapped",
        )
    return model


def egm96_heights(latitude_deg: Floats, longitude_deg: Floats) -> Floats:
    """Compute the heights of the geoid EGM96 above the WGS 84 ellipsoid, shape (n,) [m].

    A cubic spline interpolates the 15' grid (NGA, WW15MGH). The results are within 5 mm of the published test values.
    """
    place = (90.0 - latitude_deg) * 4.0, (longitude_deg % 360.0) * 4.0 + _WRAP
    return np.asarray(scipy.ndimage.map_coordinates(_egm96_spline(), place, order=3, prefilter=False, mode="nearest"))


#: Number of grid columns that are repeated at each side, so that the spline is periodic in longitude.
_WRAP: Final = 16


@lru_cache(maxsize=1)
def _egm96_spline() -> Floats:
    """Return the spline coefficients of the EGM96 grid [m], which is stored as differences along both axes [cm]."""
    with (files("railfix.track") / "egm96_15.npz").open("rb") as file, np.load(file) as data:
        heights = data["second_differences_cm"].astype(np.int64).cumsum(axis=0).cumsum(axis=1) / 100.0
    return read_only(scipy.ndimage.spline_filter(np.pad(heights, ((0, 0), (_WRAP, _WRAP)), mode="wrap"), order=3))


def _model_of_proj(geoid: str | CRS, place: Georeference) -> GeoidModel:
    """Compute geoid heights with PROJ from a grid file, or by the operation from a height datum to the ellipsoid.

    Raise SettingsError if the geoid is unknown or has no height datum, or if the grid is not installed.
    """
    try:
        if isinstance(geoid, str) and (geoid.lower().endswith((".tif", ".tiff", ".gtx")) or _is_file(geoid)):
            steps = f"+proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=vgridshift +grids={geoid} +multiplier=1"
            back = "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
            transformer = Transformer.from_pipeline(f"+proj=pipeline +step {steps} {back}")
            return GeoidModel(height_m=_undulation(transformer, place), name=geoid, accuracy_m=0.0)
        crs = geoid if isinstance(geoid, CRS) else CRS.from_user_input(geoid)
    except CRSError:
        raise SettingsError(f"geoid {geoid!r} is unknown; {GEOID_HELP}") from None
    except ProjError:
        raise SettingsError(
            f"geoid {geoid!r}: the grid is not installed in PROJ; install it (projsync --file "
            f"{Path(str(geoid)).name}), or give its path"
        ) from None
    if not (crs.is_vertical or crs.is_compound):
        raise SettingsError(f"geoid {geoid!r} is {crs.name}, which has no height datum; {GEOID_HELP}")
    vertical = crs.sub_crs_list[1] if crs.is_compound else crs
    frame = CRS.from_user_input(place.frame)
    source = CompoundCRS(vertical.name, [frame.to_2d(), vertical])
    operations = find_operations(source, frame.to_3d(), place.box)
    if not operations.usable:
        why = operations.describe_lacking() or "there is no operation of PROJ"
        raise SettingsError(
            f"the heights are {vertical.name}, for which PROJ has no installed operation at this location: {why}; "
            "or give the grid file itself (--geoid)"
        )
    best = operations.usable[0]
    accuracy = known_accuracy_m(best.accuracy)
    return GeoidModel(
        height_m=_undulation(best, place),
        name=vertical.name,
        accuracy_m=accuracy if np.isfinite(accuracy) else np.nan,
    )


def _is_file(geoid: str) -> bool:
    """Return whether a text is the path of an existing file; False if the text is too long for a path."""
    try:
        return Path(geoid).is_file()
    except OSError:
        return False


def _undulation(transformer: Transformer, place: Georeference) -> Floats:
    """Return the ellipsoidal heights of points with orthometric height 0, shape (n,) [m]."""
    zeros = np.zeros(len(place.latitude_deg))
    return np.asarray(transformer.transform(place.longitude_deg, place.latitude_deg, zeros)[2], np.float64)


def heights_of_file(
    heights_m: Floats,
    place: Georeference,
    reading: MapReading,
    *,
    path: str,
    datum: str | None = None,
    geoid: str | None = None,
    geoid_m: Floats | None = None,
) -> EllipsoidalHeights:
    """Convert the heights of a file to ellipsoidal heights.

    `datum`, `geoid` and `geoid_m` are from the file. The user's datum and geoid in `reading` take precedence. Raise
    InputFileError if the file names an unknown datum. Raise SettingsError if there is no datum or two datums contradict
    each other.
    """
    check_height_datum(reading.height_datum)
    if datum is not None and datum not in HEIGHT_DATUMS:
        raise InputFileError(path, f"height_datum is {datum!r}; expected 'ellipsoidal' or 'orthometric'")
    if None not in (reading.height_datum, datum) and reading.height_datum != datum:
        raise SettingsError(f"{path}: height_datum {reading.height_datum!r} contradicts the file's own {datum!r}")
    used, model = own_height_datum(reading.crs, reading.height_datum or datum, reading.geoid, path=path)
    if used is None:
        raise SettingsError(
            f"{path}: the height datum is missing; give --height-datum ellipsoidal, or --height-datum orthometric with "
            "--geoid egm96 (in a campaign file: height_datum and geoid under [options.track])"
        )
    if used == "ellipsoidal":
        geoid_m = None
    elif geoid_m is not None and not isinstance(model, str):
        model = None  # the map's `geoid_m` replaces the geoid of the compound CRS
    elif model is None:
        model = geoid
    return ellipsoidal_heights(heights_m, place, datum=used, geoid=model, geoid_m=geoid_m, path=path)


def own_height_datum(
    crs: str | None, height_datum: str | None, geoid: str | None, *, path: str
) -> tuple[str | None, str | CRS | None]:
    """Return height datum and geoid, from the user or a compound CRS; each is None if neither of the two states it.

    Raise SettingsError if user and CRS contradict each other.
    """
    vertical = get_vertical_datum(crs)
    if vertical is None:
        return height_datum, geoid
    if height_datum == "ellipsoidal":
        raise SettingsError(
            f"{path}: height_datum 'ellipsoidal' contradicts the file's own CRS, whose heights are {vertical.name}"
        )
    if geoid is not None and not _is_geoid_of(geoid, vertical):
        raise SettingsError(
            f"{path}: geoid {geoid!r} contradicts the file's own CRS, whose heights are {vertical.name}; "
            "leave the geoid out, or give the grid file of that height datum"
        )
    return "orthometric", geoid or vertical


def _is_geoid_of(geoid: str, vertical: CRS) -> bool:
    """Return whether a geoid belongs to a height datum; grid files are not checked, and the result is True."""
    key = geoid.strip().lower()
    if key in JAPAN_MODELS:
        return vertical.name.startswith(("JGD", "JSLD"))
    if key in _EGM96_NAMES:
        return vertical.name.startswith("EGM96")
    try:
        given = CRS.from_user_input(geoid)
    except CRSError:
        return True
    own = given.sub_crs_list[1] if given.is_compound else given
    return own.name == vertical.name


def ellipsoidal_heights(
    heights_m: Floats,
    place: Georeference,
    *,
    datum: str,
    geoid: str | CRS | None,
    path: str,
    geoid_m: Floats | None = None,
) -> EllipsoidalHeights:
    """Convert heights to ellipsoidal heights, by a geoid model or the map's geoid heights `geoid_m`.

    Raise SettingsError for contradictory options, and InputFileError for orthometric heights without a geoid.
    """
    if datum == "ellipsoidal":
        if geoid is not None:
            raise SettingsError(f"{path}: geoid {geoid!r} was given, but the heights are ellipsoidal already")
        return EllipsoidalHeights(
            height_m=heights_m,
            datum=datum,
            notes=("map: the heights are taken as heights above the ellipsoid of WGS 84",) if place.operation else (),
        )
    if geoid_m is not None:
        if geoid is not None:
            raise SettingsError(f"{path}: geoid {geoid!r} was given, but the map has geoid_m itself; use one")
        return EllipsoidalHeights(height_m=heights_m + geoid_m, datum=datum, geoid="geoid_m of the map")
    if geoid is None:
        raise InputFileError(path, f"the heights are orthometric and require a geoid; {GEOID_HELP}")
    model = geoid_heights(geoid, place, path=path)
    accuracy = f"{model.accuracy_m:g} m" if np.isfinite(model.accuracy_m) else "unknown (--height-sigma)"
    return EllipsoidalHeights(
        height_m=heights_m + model.height_m,
        datum=datum,
        geoid=model.name,
        accuracy_m=model.accuracy_m,
        notes=() if model.accuracy_m < NEGLIGIBLE_M else (f"map: heights by {model.name}, accuracy {accuracy}",),
    )

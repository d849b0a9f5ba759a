"""Reference frames of track maps, and maps moved to the frame of the satellites.

Broadcast orbits are in WGS 84, which agrees with ITRF2020 at the epoch of observation to centimetres; precise
orbits are in a realisation of the ITRF. Maps are in a frame that moves with its plate (ETRS89, NAD83(2011),
GDA2020, JGD2011), or in the ITRF at the epoch of their survey. The transformations are those of PROJ with
coordinate epoch; where PROJ has none the motion of the plate is used (ITRF2020 plate motion model, Altamimi et al.
2023, doi:10.1029/2023GL106373, as PROJ ships it), and said.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import lru_cache
from os import PathLike
from typing import Any, Final, Literal, TypedDict, Unpack

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import read_text
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.track.track import UNNAMED, Track

#: ITRF2020, three-dimensional geographic: the frame in which positions are computed.
WORKING_FRAME: Final = "EPSG:9989"
#: Frames that maps of a region are usually in: name, three-dimensional code.
REGIONAL: Final = {
    "ETRS89": "EPSG:4937",
    "NAD83(2011)": "EPSG:6319",
    "GDA2020": "EPSG:7843",
    "JGD2011": "EPSG:6667",
}
#: Frames without a transformation in PROJ that are an ITRF held at an epoch: plate, epoch [year], and a sentence on
#: what that leaves. JGD2011 is ITRF94 at 1997.0 in the west of Japan, ITRF2008 at 2011.4 in the east.
_HELD: Final = {
    "JGD2011": ("EURA", 2011.4, "deformation since then, and the epoch 1997.0 of western Japan, are left out"),
    "JGD2000": ("EURA", 1997.0, "deformation since then, the earthquake of 2011 included, is left out"),
}
PLATES: Final = tuple("AMUR ANTA ARAB AUST CARB EURA INDI NAZC NOAM NUBI PCFC SOAM SOMA".split())
#: Accuracy [m] worse than which a transformation of PROJ is between datums of another age.
_MODERN_M: Final = 0.5

Kind = Literal["wgs84", "moves with its plate", "dynamic", "older datum"]


@dataclass(frozen=True, kw_only=True)
class FrameShift:
    """How a map was moved to the frame of the satellites.

    Attributes
    ----------
    frame : str
        Frame of the map, as its CRS is named.
    used : str
        Frame and epoch of the positions.
    method : str
        The transformation, in words.
    east_m, north_m, up_m : float
        Shift at the middle of the line.
    notes : tuple of str
    """

    frame: str
    used: str
    method: str
    east_m: float = 0.0
    north_m: float = 0.0
    up_m: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def facts(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "frame": self.frame,
            "used": self.used,
            "method": self.method,
            "shift_east_north_up_m": [round(v, 4) for v in (self.east_m, self.north_m, self.up_m)],
        }


def decimal_year(time: np.datetime64 | Datetimes) -> float:
    """Time as a decimal year, as frames' epochs are written."""
    year = np.asarray(time, dtype="datetime64[Y]")
    start, end = year.astype("datetime64[s]"), (year + np.timedelta64(1, "Y")).astype("datetime64[s]")
    part = (np.asarray(time, dtype="datetime64[s]") - start) / (end - start)
    return float(year.astype(np.int64) + 1970 + part)


@lru_cache(maxsize=32)
def kind_of_frame(crs: str) -> Kind:
    """How a CRS is tied to the Earth; SettingsError when it is unknown."""
    geodetic = _geodetic(crs)
    name = geodetic.name
    if name.startswith("WGS 84"):
        return "wgs84"
    if name.split(" (")[0] in _HELD:
        return "moves with its plate"
    if name.startswith("ITRF") or "IGS" in name[:4]:
        return "dynamic"
    return "older datum" if _operation(crs) is None else "moves with its plate"


def known_crs(crs: str, *, path: str | PathLike[str] = "") -> CRS:
    """The system of a name, asked for in a file; SettingsError when PROJ does not know it."""
    try:
        return CRS.from_user_input(crs)
    except CRSError:
        where = f"{path}: " if path else ""
        raise SettingsError(
            f"{where}the CRS {crs!r} is unknown; give for example EPSG:4326 (WGS 84), EPSG:4258 (ETRS89) or EPSG:6677"
        ) from None


def used_crs(path: str | PathLike[str], given: str | None, named: str | None) -> str | None:
    """The CRS given for a file, or the one that it names itself; SettingsError when they contradict each other."""
    if given is not None and named is not None and known_crs(given, path=path) != known_crs(named, path=path):
        raise SettingsError(f"{path}: --crs {given} contradicts the file's own CRS {named}")
    return given or named


def _geodetic(crs: str) -> CRS:
    geodetic = known_crs(crs).geodetic_crs
    if geodetic is None:
        raise SettingsError(f"the CRS {crs!r} has no geodetic frame; give for example EPSG:4258 (ETRS89)")
    return geodetic


@lru_cache(maxsize=32)
def _operation(crs: str) -> Transformer | None:
    """PROJ's best transformation of a frame to the working frame; None where it has none between modern frames."""
    source = _geodetic(crs).to_3d()
    try:
        group = TransformerGroup(source, WORKING_FRAME, always_xy=True, allow_ballpark=False)
    except ProjError:
        return None
    usable = [t for t in group.transformers if 0.0 <= t.accuracy <= _MODERN_M]
    return usable[0] if usable else None


def frame_degrees(crs: str, x: Floats, y: Floats) -> tuple[Floats, Floats, str]:
    """Latitude and longitude of map coordinates (longitude and latitude, or easting and northing), and their frame's
    code.

    Projected coordinates are turned into degrees of the frame they are based on; nothing is shifted between modern
    frames. Coordinates of an older datum (Tokyo, Belgian Datum 72) are transformed by PROJ to the modern frame of
    their region, with the accuracy that PROJ has for it.
    """
    kind = kind_of_frame(crs)
    frame = _modern_frame(crs)[0] if kind == "older datum" else _frame_of(crs)
    longitude, latitude = _in_plan(crs, frame).transform(x, y)
    return np.asarray(latitude, np.float64), np.asarray(longitude, np.float64), frame


@lru_cache(maxsize=32)
def _in_plan(crs: str, frame: str) -> Transformer:
    source, target = (CRS.from_user_input(name).to_2d() for name in (crs, frame))
    return Transformer.from_crs(source, target, always_xy=True)


@lru_cache(maxsize=32)
def _frame_of(crs: str) -> str:
    geodetic = _geodetic(crs)
    authority = geodetic.to_authority()
    return geodetic.to_wkt() if authority is None else ":".join(authority)


@lru_cache(maxsize=32)
def _modern_frame(crs: str) -> tuple[str, float, bool]:
    """The modern frame to which PROJ transforms an older datum best, how well [m], and whether a grid is missing.

    WGS 84 and NaN where PROJ has no transformation.
    """
    source, best = _geodetic(crs).to_2d(), ("EPSG:4326", np.inf, False)
    for code in REGIONAL.values():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about missing grids: reported by `older_datum_note`
            group = TransformerGroup(source, CRS.from_user_input(code).to_2d(), always_xy=True, allow_ballpark=False)
        for transformer in group.transformers:
            if 0.0 <= transformer.accuracy < best[1]:
                best = (code, transformer.accuracy, bool(group.unavailable_operations))
    return best


@lru_cache(maxsize=32)
def older_datum_note(crs: str | None) -> tuple[str, ...]:
    """A note on the transformation of a map in an older datum; none for other maps."""
    if crs is None or kind_of_frame(crs) != "older datum":
        return ()
    code, accuracy, missing = _modern_frame(crs)
    name, to = _geodetic(crs).name, CRS.from_user_input(code).name
    size = f"with an accuracy of {accuracy:g} m" if np.isfinite(accuracy) else "with unknown accuracy"
    grid = "; a grid that PROJ knows of would be better and is not installed (projsync)" if missing else ""
    return (f"map: {name} is an older datum, transformed to {to} by PROJ {size}{grid}",)


class MapMotion(TypedDict, total=False):
    """What moves coordinates of a map to the frame of the satellites, beside PROJ.

    Attributes
    ----------
    epoch : float or None [year]
        Epoch of the map's coordinates, where its frame is an ITRF.
    plate : str or None
        Plate that moves coordinates of an ITRF from `epoch` to the time of the log: one of `PLATES`.
    parameters : path or None
        Semi-dynamic correction of Japan (``SemiDynaEXE`` format) that moves coordinates in JGD2011 to its own epoch,
        deformation included; `epoch` is that of the file then, from which on the plate moves them.
    """

    epoch: float | None
    plate: str | None
    parameters: str | PathLike[str] | None


def track_at(track: Track, time: np.datetime64, **motion: Unpack[MapMotion]) -> tuple[Track, FrameShift]:
    """The track, moved from the frame that its `Provenance.frame` names to that of the satellites at a time.

    Keywords (`epoch`, `plate`, `parameters`) and errors as for `points_at`.
    """
    provenance = track.provenance
    moved, shift = points_at(track.ecef_m, provenance.frame, time, named=provenance.crs != UNNAMED, **motion)
    if moved is track.ecef_m:
        return track, shift
    latitude, longitude, height = geodetic_from_ecef(moved)
    provenance = replace(provenance, frame=WORKING_FRAME)
    return replace(track, latitude_deg=latitude, longitude_deg=longitude, height_m=height, provenance=provenance), shift


def points_at(
    ecef_m: Floats, crs: str, time: np.datetime64, *, named: bool = True, **motion: Unpack[MapMotion]
) -> tuple[Floats, FrameShift]:
    """Points of a map, shape (n, 3), in the frame of the satellites at a time, and the shift at the middle one.

    `crs` is their frame: where it is that of the satellites, they are returned as they are. `time` is that of the log.
    Where the map does not name its frame itself, the size of the doubt is noted. SettingsError: when the plate is
    unknown, or an epoch or plate is given for a frame that does not need it.
    """
    epoch, plate, parameters = motion.get("epoch"), motion.get("plate"), motion.get("parameters")
    kind, frame, year = kind_of_frame(crs), _geodetic(crs), decimal_year(time)
    used = f"ITRF2020 at {year:.2f}"
    if plate is not None and plate not in PLATES:
        raise SettingsError(f"plate {plate!r} is unknown; expected one of {', '.join(PLATES)}")
    held = _HELD.get(frame.name.split(" (")[0])
    if (epoch is not None or plate is not None) and not (kind == "dynamic" or held):
        raise SettingsError(f"the map's frame is {frame.name}, which takes no epoch and no plate of its own")
    if parameters is not None and not frame.name.startswith("JGD2011"):
        raise SettingsError(f"the map's frame is {frame.name}; semi-dynamic parameters are for JGD2011")
    middle = ecef_m[len(ecef_m) // 2]
    if kind in ("wgs84", "older datum"):
        notes = () if named else _doubt(middle, time)
        return ecef_m, FrameShift(frame=frame.name, used=used, method="used as it is", notes=notes)
    if parameters is not None:
        moved, method, notes = _by_parameters(ecef_m, parameters, year, epoch, plate or "EURA")
    elif held is not None:
        moved_by, since, rest = held
        plate, epoch = plate or moved_by, epoch or since
        moved, method = _by_plate(ecef_m, plate, year - epoch), f"motion of the plate {plate} since {epoch:g}; {rest}"
        notes = (f"map: {frame.name} moved to {used} by the {method}",)
    elif kind == "dynamic":
        moved, method, notes = _from_dynamic(ecef_m, crs, year, epoch, plate)
    else:
        operation = _operation(crs)
        assert operation is not None
        moved, method, notes = _transformed(operation, ecef_m, year), f"PROJ: {operation.description}", ()
    at = geodetic_from_ecef(middle)
    east, north, up_m = (float(v) for v in enu_axes(float(at[0]), float(at[1])) @ (moved[len(ecef_m) // 2] - middle))
    shift = FrameShift(
        frame=frame.name, used=used, method=method, east_m=east, north_m=north, up_m=up_m, notes=tuple(notes)
    )
    return moved, shift


def _transformed(operation: Transformer, ecef_m: Floats, year: float) -> Floats:
    """Points after a transformation of PROJ at an epoch."""
    latitude, longitude, height = geodetic_from_ecef(ecef_m)
    lon, lat, up, _ = operation.transform(longitude, latitude, height, np.full(len(height), year))
    return ecef_from_geodetic(np.asarray(lat), np.asarray(lon), np.asarray(up))


def in_map_frame(
    ecef_m: Floats, crs: str, time: np.datetime64, *, named: bool = True, **motion: Unpack[MapMotion]
) -> tuple[Floats, FrameShift]:
    """Positions from satellites, NaN where there is none, in the frame of a map: the shift of `points_at` taken off.

    A shift of metres changes by micrometres over its own length, so it is taken at the positions.
    """
    known = np.flatnonzero(np.isfinite(ecef_m[:, 0]))
    if not len(known):
        raise MismatchError("there is no position to move to the frame of the map")
    moved, shift = points_at(ecef_m[known], crs, time, named=named, **motion)
    back = ecef_m.copy()
    back[known] = 2.0 * ecef_m[known] - moved
    return back, shift


def _from_dynamic(
    ecef_m: Floats, crs: str, year: float, epoch: float | None, plate: str | None
) -> tuple[Floats, str, tuple[str, ...]]:
    """Coordinates of an ITRF at an epoch, in the working frame at the log's."""
    name = _geodetic(crs).name
    operation = Transformer.from_crs(_geodetic(crs).to_3d(), WORKING_FRAME, always_xy=True)
    moved = _transformed(operation, ecef_m, year if epoch is None else epoch)
    if epoch is None:
        note = (
            f"map: coordinates in {name} move 1 to 8 cm a year; no epoch is named, that of the log ({year:.2f}) is used"
        )
        return moved, f"{name} at the epoch of the log", (note,)
    if plate is None:
        note = f"map: {name} at {epoch:g} is not moved to {year:.2f}, for no plate is named (1 to 8 cm a year)"
        return moved, f"{name} at {epoch:g}, not moved", (note,)
    return _by_plate(moved, plate, year - epoch), f"{name} at {epoch:g}, motion of the plate {plate}", ()


def _by_parameters(
    ecef_m: Floats, path: str | PathLike[str], year: float, epoch: float | None, plate: str
) -> tuple[Floats, str, tuple[str, ...]]:
    """Coordinates of JGD2011 moved by a semi-dynamic correction, and with the plate from its epoch on, where named.

    The correction changes by millimetres over 100 m, so it is taken once in each cell of a thousandth of a degree.
    """
    try:
        import jgdtrans
    except ImportError:
        raise InputFileError(path, "semi-dynamic correction needs jgdtrans: pip install 'railfix[maps]'") from None
    try:
        correction = jgdtrans.loads(read_text(path), format="SemiDynaEXE")
    except jgdtrans.ParseParFileError as error:
        raise InputFileError(path, f"is no parameter file of semi-dynamic correction ({error})") from None
    latitude, longitude, height = geodetic_from_ecef(ecef_m)
    cells, which = np.unique(np.round(np.stack([latitude, longitude], axis=-1), 3), axis=0, return_inverse=True)
    try:
        values = [correction.forward_corr(*cell) for cell in cells.tolist()]
    except jgdtrans.ParameterNotFoundError:
        raise InputFileError(path, "has no parameters for a part of the map; is it the file of its region?") from None
    moves = np.array([(v.latitude, v.longitude, v.altitude) for v in values])[which.ravel()]
    moved = ecef_from_geodetic(latitude + moves[:, 0], longitude + moves[:, 1], height + moves[:, 2])
    method = f"semi-dynamic correction {path}"
    if epoch is None:
        return moved, method, (f"map: JGD2011 moved by the {method}; its epoch is not named (--map-epoch)",)
    method += f", motion of the plate {plate} since its epoch {epoch:g}"
    return _by_plate(moved, plate, year - epoch), method, (f"map: JGD2011 moved by the {method}",)


def _by_plate(ecef_m: Floats, plate: str, years: float) -> Floats:
    """Coordinates moved with a plate for some years (ITRF2020 plate motion model)."""
    motion = Transformer.from_pipeline(f"+proj=pipeline +step +init=ITRF2020:{plate} +t_epoch=0")
    x, y, z, _ = motion.transform(ecef_m[:, 0], ecef_m[:, 1], ecef_m[:, 2], np.full(len(ecef_m), years))
    return np.stack([x, y, z], axis=-1)


def _doubt(ecef_m: Floats, time: np.datetime64) -> tuple[str, ...]:
    """A note on how far a map without a named frame may be off at a point of it."""
    latitude, longitude, _ = (float(v) for v in geodetic_from_ecef(ecef_m))
    for name, code in REGIONAL.items():
        area = CRS.from_user_input(code).area_of_use
        if area is None or not (area.south <= latitude <= area.north and _between(longitude, area.west, area.east)):
            continue
        _, shift = points_at(ecef_m[None], code, time)
        size = float(np.hypot(np.hypot(shift.east_m, shift.north_m), shift.up_m))
        return (
            f"map: no reference frame is named, WGS 84 is assumed; if the map is in {name}, as is usual there, "
            f"it is {size:.2f} m off (east {shift.east_m:+.2f}, north {shift.north_m:+.2f}, up {shift.up_m:+.2f} m); "
            f"give --crs {code}",
        )
    return ("map: no reference frame is named, WGS 84 is assumed; national frames differ from it by up to 2 m",)


def _between(longitude: float, west: float, east: float) -> bool:
    return west <= longitude <= east if west <= east else longitude >= west or longitude <= east

"""Reference frames of track maps, and transformation of maps to the frame of the satellites.

Broadcast orbits (WGS 84) agree with ITRF2020 at the epoch of observation within centimetres. Maps are in a plate-fixed
frame, or in an ITRF realisation at the epoch of the survey. Maps are transformed with PROJ. Where PROJ has no
transformation, the ITRF2020 plate motion model (Altamimi et al. 2023, doi:10.1029/2023GL106373) is used, with a note.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Final, TypedDict, Unpack

import numpy as np
from pyproj import CRS, Transformer

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.extras import needs_extra
from railfix.core.files import FilePath, read_text
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.track.crs import (
    HELD,
    REALISATIONS,
    REGIONAL,
    SAME,
    WORKING_FRAME,
    HeldFrame,
    find_operation,
    get_geodetic_frame,
    is_in_area,
    kind_of_frame,
)
from railfix.track.track import UNNAMED, Track

PLATES: Final = tuple("AMUR ANTA ARAB AUST CARB EURA INDI NAZC NOAM NUBI PCFC SOAM SOMA".split())


@dataclass(frozen=True, kw_only=True)
class FrameShift:
    """Description of the transformation of a map to the frame of the satellites."""

    frame: str  #: Name of the map's frame.
    used: str  #: Frame and epoch of the transformed map, and of positions computed with this map.
    method: str  #: Description of the transformation.
    #: Shift of the map at the middle of the line, to east, north and up.
    east_m: float = 0.0
    north_m: float = 0.0
    up_m: float = 0.0

    notes: tuple[str, ...] = ()  #: Notes on the uncertainty of the transformation.

    @property
    def sentences(self) -> tuple[str, ...]:
        """Notes to the user on the transformation, including the shift in plan if the shift is not zero."""
        size = float(np.hypot(self.east_m, self.north_m))
        moved = (
            f"map: {self.frame} moved by {size:.2f} m (east {self.east_m:+.2f}, north {self.north_m:+.2f}) to "
            f"{self.used}, the frame of the positions (if positions are in the frame of the map, give --same-frame)"
        )
        return (*self.notes, moved) if size > 0.0 else self.notes

    @property
    def facts(self) -> dict[str, Any]:
        """Description of the transformation as plain values for JSON."""
        return {
            "frame": self.frame,
            "used": self.used,
            "method": self.method,
            "shift_east_north_up_m": [round(v, 4) for v in (self.east_m, self.north_m, self.up_m)],
        }


def decimal_year(time: np.datetime64 | Datetimes) -> float:
    """Return a time as a decimal year, the unit in which epochs of frames are stated."""
    year = np.asarray(time, dtype="datetime64[Y]")
    start, end = year.astype("datetime64[s]"), (year + np.timedelta64(1, "Y")).astype("datetime64[s]")
    part = (np.asarray(time, dtype="datetime64[s]") - start) / (end - start)
    return float(year.astype(np.int64) + 1970 + part)


class MapMotion(TypedDict, total=False):
    """Options for those motions of map coordinates that PROJ does not model."""

    epoch: float | None  #: Epoch of the map's coordinates, for a frame that is an ITRF realisation [year].
    plate: str | None  #: Plate, one of `PLATES`, with which ITRF coordinates move from `epoch` to the time of the log.
    #: Parameter file of Japan's semi-dynamic correction (``SemiDynaEXE`` format). The correction transforms JGD2011 to
    #: the epoch of the file, including crustal deformation. If a file is given, `epoch` is the epoch of the file; after
    #: this epoch, the plate motion is used.
    parameters: FilePath | None


def track_at(track: Track, time: np.datetime64, **motion: Unpack[MapMotion]) -> tuple[Track, FrameShift]:
    """Transform a track from `Provenance.frame` to the frame of the satellites at a time; see `points_at`."""
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
    """Transform points of a map to the frame of the satellites at a time.

    Parameters
    ----------
    ecef_m : ndarray, shape (n, 3) [m]
    crs : str
        CRS of the map. If `named` is False, the map names no frame, and `crs` is an assumption.
    time : datetime64
        Time of the log.

    Returns
    -------
    tuple
        Transformed points, shape (n, 3) [m], and a description of the transformation.

    Raises
    ------
    SettingsError
        The plate is unknown, or epoch, plate or parameters do not apply to the frame of the map.
    """
    epoch, plate, parameters = motion.get("epoch"), motion.get("plate"), motion.get("parameters")
    kind, frame, year = kind_of_frame(crs), get_geodetic_frame(crs), decimal_year(time)
    used = f"ITRF2020 at {year:.2f}"
    if plate is not None and plate not in PLATES:
        raise SettingsError(f"plate {plate!r} is unknown; expected one of {', '.join(PLATES)}")
    held = HELD.get(frame.name)
    if (epoch is not None or plate is not None) and not (kind == "dynamic" or held):
        raise SettingsError(f"the map's frame is {frame.name}, to which no epoch and no plate apply")
    if parameters is not None and not frame.name.startswith("JGD2011"):
        raise SettingsError(f"the map's frame is {frame.name}; semi-dynamic parameters apply only to JGD2011")
    middle = ecef_m[len(ecef_m) // 2]
    if kind in ("wgs84", "older datum"):
        notes = () if named else _doubt(middle, time)
        method = "used as it is" + ", taken as its latest realisation, which is ITRF2020" * (kind == "wgs84")
        return ecef_m, FrameShift(frame=frame.name, used=used, method=method, notes=notes)
    operation = find_operation(crs)
    if parameters is not None:
        moved, method, notes = _by_parameters(ecef_m, parameters, year, epoch, plate or "EURA")
    elif kind == "dynamic":
        moved, method, notes = _from_dynamic(ecef_m, crs, year, epoch, plate)
    elif operation is not None and not (held and (epoch or plate)):
        moved, method = _transform(operation, ecef_m, year), f"PROJ: {operation.description}"
        notes = _realisation_note(frame, operation)
    else:
        assert held is not None
        moved, method, notes = _from_held(ecef_m, frame.name, held, year, epoch, plate)
    at = geodetic_from_ecef(middle)
    east, north, up_m = (float(v) for v in enu_axes(float(at[0]), float(at[1])) @ (moved[len(ecef_m) // 2] - middle))
    parts = {"east_m": east, "north_m": north, "up_m": up_m}
    return moved, FrameShift(frame=frame.name, used=used, method=method, notes=tuple(notes), **parts)


def _transform(operation: Transformer, ecef_m: Floats, year: float) -> Floats:
    """Return points transformed by a PROJ operation at an epoch [year], shape (n, 3) [m]."""
    latitude, longitude, height = geodetic_from_ecef(ecef_m)
    lon, lat, up, _ = operation.transform(longitude, latitude, height, np.full(len(height), year))
    return ecef_from_geodetic(np.asarray(lat), np.asarray(lon), np.asarray(up))


def in_map_frame(
    ecef_m: Floats, crs: str, time: np.datetime64, *, named: bool = True, **motion: Unpack[MapMotion]
) -> tuple[Floats, FrameShift]:
    """Transform positions, shape (n, 3) [m], from the satellites' frame to the frame of a map.

    The shift computed by `points_at` is subtracted. Positions that are NaN remain NaN. Raise MismatchError if all
    positions are NaN.
    """
    known = np.flatnonzero(np.isfinite(ecef_m[:, 0]))
    if not len(known):
        raise MismatchError("all positions are NaN, so none can be transformed to the frame of the map")
    moved, shift = points_at(ecef_m[known], crs, time, named=named, **motion)
    back = ecef_m.copy()
    back[known] = 2.0 * ecef_m[known] - moved
    return back, shift


def _from_dynamic(
    ecef_m: Floats, crs: str, year: float, epoch: float | None, plate: str | None
) -> tuple[Floats, str, tuple[str, ...]]:
    """Transform ITRF coordinates to ITRF2020 at the epoch of the log.

    Return the coordinates, a description of the transformation, and notes.
    """
    name = get_geodetic_frame(crs).name
    moved = _in_itrf2020(ecef_m, REALISATIONS[name], year if epoch is None else epoch)
    if epoch is None:
        note = (
            f"map: coordinates in {name} move 1 to 8 cm per year; the epoch of the log ({year:.2f}) is used, because "
            "no epoch is given (--map-epoch)"
        )
        return moved, f"{name} at the epoch of the log", (note,)
    if plate is None:
        note = f"map: {name} at {epoch:g} is not moved to {year:.2f} (1 to 8 cm per year), because no plate is given"
        return moved, f"{name} at {epoch:g}, not moved", (note,)
    return _by_plate(moved, plate, year - epoch), f"{name} at {epoch:g}, motion of the plate {plate}", ()


def _in_itrf2020(ecef_m: Floats, code: str, year: float) -> Floats:
    """Transform coordinates from a realisation of the ITRF to ITRF2020 at the same epoch."""
    return _transform(Transformer.from_crs(code, WORKING_FRAME, always_xy=True, allow_ballpark=False), ecef_m, year)


def _from_held(
    ecef_m: Floats, name: str, held: HeldFrame, year: float, epoch: float | None, plate: str | None
) -> tuple[Floats, str, tuple[str, ...]]:
    """Move coordinates of a frame fixed at an ITRF epoch to `year`.

    By default, the plate is the one on which the line's middle point lies. Return the coordinates, a description of the
    transformation, and notes.
    """
    since = epoch or held.epoch
    latitude, longitude, _ = geodetic_from_ecef(ecef_m[len(ecef_m) // 2])
    plate = plate or held.plate_at(float(latitude), float(longitude))
    moved = _by_plate(_in_itrf2020(ecef_m, held.code, since), plate, year - since)
    method = f"{held.itrf} at {since:g}, motion of the plate {plate}"
    return moved, method, (f"map: {name} is {method} to {year:.2f} in ITRF2020; {held.describe_rest(year - since)}",)


def _realisation_note(frame: CRS, operation: Transformer) -> tuple[str, ...]:
    """Return a note if the frame is a datum ensemble or is treated as another frame, otherwise an empty tuple."""
    if frame.name in SAME and not operation.description.startswith(frame.name):
        code, how_well = SAME[frame.name]
        return (f"map: {frame.name} is taken as {CRS.from_user_input(code).name}; {how_well}",)
    datum = frame.datum.to_json_dict() if frame.datum is not None else {}
    if "members" not in datum:
        return ()
    taken = re.search(rf"{re.escape(frame.name)} to (\S+)", operation.description)
    return (
        f"map: {frame.name} is an ensemble of {len(datum['members'])} realisations, which agree within "
        f"{datum['accuracy']} m; taken as {taken[1] if taken else operation.description}",
    )


def _by_parameters(
    ecef_m: Floats, path: FilePath, year: float, epoch: float | None, plate: str
) -> tuple[Floats, str, tuple[str, ...]]:
    """Transform JGD2011 coordinates to the epoch of a semi-dynamic correction, then by plate motion to `year`.

    The correction is computed once for each cell of 0.001 deg. Raise InputFileError if the file is not valid or does
    not cover the map.
    """
    with needs_extra(f"{path}: semi-dynamic correction"):
        import jgdtrans
    try:
        correction = jgdtrans.loads(read_text(path), format="SemiDynaEXE")
    except jgdtrans.ParseParFileError as error:
        raise InputFileError(path, f"is not a parameter file of semi-dynamic correction ({error})") from None
    latitude, longitude, height = geodetic_from_ecef(ecef_m)
    cells, which = np.unique(np.round(np.stack([latitude, longitude], axis=-1), 3), axis=0, return_inverse=True)
    try:
        values = [correction.forward_corr(*cell) for cell in cells.tolist()]
    except jgdtrans.ParameterNotFoundError:
        raise InputFileError(path, "has no parameters for a part of the map; give the file of the region") from None
    moves = np.array([(v.latitude, v.longitude, v.altitude) for v in values])[which.ravel()]
    moved = ecef_from_geodetic(latitude + moves[:, 0], longitude + moves[:, 1], height + moves[:, 2])
    method = f"semi-dynamic correction {path}"
    if epoch is None:
        return moved, method, (f"map: JGD2011 moved by the {method}; its epoch is not given (--map-epoch)",)
    method += f", motion of the plate {plate} since the map epoch {epoch:g}"
    return _by_plate(moved, plate, year - epoch), method, (f"map: JGD2011 moved by the {method}",)


def _by_plate(ecef_m: Floats, plate: str, years: float) -> Floats:
    """Move coordinates with a plate over a number of years (ITRF2020 plate motion model)."""
    motion = Transformer.from_pipeline(f"+proj=pipeline +step +init=ITRF2020:{plate} +t_epoch=0")
    x, y, z, _ = motion.transform(ecef_m[:, 0], ecef_m[:, 1], ecef_m[:, 2], np.full(len(ecef_m), years))
    return np.stack([x, y, z], axis=-1)


def _doubt(ecef_m: Floats, time: np.datetime64) -> tuple[str, ...]:
    """Return a note that WGS 84 is assumed, and how large the error is if the map is in a usual frame of its region."""
    latitude, longitude, _ = (float(v) for v in geodetic_from_ecef(ecef_m))
    found = []
    for name, code in REGIONAL.items():
        if not is_in_area(CRS.from_user_input(code), np.array([latitude]), np.array([longitude]), margin_deg=0.0)[0]:
            continue
        _, shift = points_at(ecef_m[None], code, time)
        size = float(np.hypot(np.hypot(shift.east_m, shift.north_m), shift.up_m))
        parts = f"east {shift.east_m:+.2f}, north {shift.north_m:+.2f}, up {shift.up_m:+.2f} m"
        found.append(f"in {name}, it is displaced by {size:.2f} m ({parts}): give crs {code} (--crs)")
    if found:
        choices = "; if ".join(found)
        return (
            f"map: no reference frame is named, WGS 84 is assumed; if the map is, as usual in its region, {choices}",
        )
    return ("map: no reference frame is named, WGS 84 is assumed; national frames differ from it by up to 2 m",)

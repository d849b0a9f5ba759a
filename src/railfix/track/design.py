"""Segments of a route from the alignment elements of a design file (IFC, LandXML)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from pyproj import CRS, Transformer

from railfix.core.arrays import Floats, Masks
from railfix.core.errors import InputFileError
from railfix.track.crs import LARGEST_SCALE, MARGIN_DEG, frame_degrees, is_in_area, older_datum_note, unit_of_grid
from railfix.track.elements import CantElement, PlanElement, ProfileElement, alignment_points
from railfix.track.heights import stated_heights
from railfix.track.segment import NO_HEIGHTS, MapReading, Segment

#: Longest part of an alignment to which its profile is extended [m].
_PROFILE_BEYOND_M: Final = 50.0


def segment_of_design(
    *,
    path: str,
    name: str,
    plan: Sequence[PlanElement],
    profile: Sequence[ProfileElement],
    cant: Sequence[CantElement],
    reading: MapReading,
    grid: tuple[float, float, float, float, float, float] | None = None,
    notes: tuple[str, ...] = (),
) -> Segment:
    """The points of one alignment as a segment, without heights where the profile is empty.

    The CRS, which is required, is that of the grid, height datum and geoid those of the profile. `grid`: easting,
    northing, height, cosine and sine of the rotation, and scale that turn the file's coordinates into those of the
    grid. InputFileError: when the alignment has no element, or no grid. SettingsError: when the height datum is
    missing.
    """
    if not plan:
        raise InputFileError(path, f"alignment {name!r} has no element in plan")
    crs = reading.crs
    if crs is None:
        raise InputFileError(path, f"alignment {name!r} is in a grid that the file does not name; give --crs")
    points, joints = alignment_points(plan, profile, cant)
    xy, up, scale = points.xy_m, 0.0, 1.0
    unit = unit_of_grid(crs, path=path)
    if grid is not None:
        if unit != 1.0:
            raise InputFileError(path, f"the grid {crs} is not in metres, which is not read; give one in metres")
        east, north, up, cosine, sine, scale = grid
        xy = np.array([east, north]) + scale * xy @ np.array([[cosine, sine], [-sine, cosine]])
    xy /= unit
    curvature = points.curvature
    if grid is None and _within(crs, xy[:, ::-1]) and not _within(crs, xy):
        # northing before easting turns the plane over, so a curve to the left in the file is one to the right
        xy, curvature = xy[:, ::-1], -curvature
        joints = (*joints, f"{name}: the file has northing before easting")
    latitude, longitude, frame = frame_degrees(crs, xy[:, 0], xy[:, 1], path=f"{path} ({name})")
    _check_length(plan, frame, latitude, longitude, path=f"{path} ({name})")
    height, model, datum = np.full(len(latitude), np.nan), "", NO_HEIGHTS
    if profile:
        joints += _check_profile(plan, profile, path=f"{path} ({name})")
        height, model, datum = stated_heights(points.height_m + up, latitude, longitude, reading, path=path)
    radius = np.full(len(latitude), np.inf)
    bent = np.abs(curvature) > 1e-9
    radius[bent] = -1.0 / curvature[bent] * scale
    return Segment(
        source=f"{path} ({name})",
        file=path,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        kilometrage_m=np.full(len(latitude), np.nan),
        cant_m=points.cant_m * _side_of_curve(curvature, bent),
        radius_m=radius,
        gradient_permille=points.gradient * 1e3,
        crs=crs,
        frame=frame,
        height_datum=datum,
        geoid=model,
        metadata={"name": name},
        notes=(*notes, *joints, *older_datum_note(crs)),
    )


def _check_profile(plan: Sequence[PlanElement], profile: Sequence[ProfileElement], *, path: str) -> tuple[str, ...]:
    """Reject a profile that leaves out more of the plan than `_PROFILE_BEYOND_M`; note what it leaves out."""
    length, low = sum(element.length_m for element in plan), min(element.start_m for element in profile)
    high = max(element.start_m + element.length_m for element in profile)
    left_out = max(low, 0.0) + max(length - high, 0.0)
    where = f"the profile runs from {low:.0f} to {high:.0f} m of an alignment of {length:.0f} m"
    if left_out > _PROFILE_BEYOND_M:
        raise InputFileError(path, f"{where}; mend its stations, or remove it and give --heights")
    return (f"{path}: {where}; its last gradients go on",) if left_out > 1.0 else ()


def _check_length(plan: Sequence[PlanElement], frame: str, latitude: Floats, longitude: Floats, *, path: str) -> None:
    """Reject an alignment whose length on the map is not that of its design: its grid is another one."""
    designed = sum(element.length_m for element in plan)
    geod = CRS.from_user_input(frame).get_geod()
    found = float(geod.line_length(longitude, latitude)) if geod is not None else designed
    if abs(found - designed) > LARGEST_SCALE * designed + 0.5:
        raise InputFileError(
            path,
            f"the design is {designed:.0f} m long, on the map {found:.0f} m; give the right --crs, or mend the "
            "elements that do not meet",
        )


def _side_of_curve(curvature: Floats, bent: Masks) -> Floats:
    """Side of the curve at each point, and of the nearest curve where the line is straight: at the foot of a ramp."""
    if not bent.any():
        return np.ones(len(curvature))
    place = np.arange(len(curvature))
    nearest = np.searchsorted(place[bent], place).clip(0, bent.sum() - 1)
    before = (nearest - 1).clip(0)
    nearer = np.abs(place[bent][before] - place) < np.abs(place[bent][nearest] - place)
    return np.asarray(np.sign(curvature[bent])[np.where(nearer, before, nearest)])


def _within(crs: str, xy: Floats) -> bool:
    """Whether coordinates lie in the area of use of a CRS; True where it has none."""
    system = CRS.from_user_input(crs)
    if system.area_of_use is None:
        return True
    transformer = Transformer.from_crs(system.to_2d(), "EPSG:4326", always_xy=True)
    longitude, latitude = (np.asarray(v) for v in transformer.transform(xy[:, 0], xy[:, 1]))
    return bool(is_in_area(system, latitude, longitude, margin_deg=MARGIN_DEG).all())

"""A track file as the line: a smooth curve through its points.

Assumptions: the file's points lie on the line; between them it is a cubic spline in space (not-a-knot
end conditions), whose arc length is the chainage. Cant changes linearly from point to point; where
the file has none the track is not canted. The side to which cant leans the vehicle is that of the
file's radius, of the spline's curvature where the file has none. Noise in the points becomes
curvature of the line: a file with a curve tighter than 30 m is an error.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from railfix.core.arrays import Floats, Masks
from railfix.core.errors import InputFileError
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.simulate.line_elements import Knots
from railfix.simulate.line_settings import LineFile
from railfix.track import Track, read_track

#: Spacing of the points by which the spline is turned into one of arc length [m].
_STEP_M: Final = 0.5
#: Tightest plausible curve [m].
_TIGHTEST_M: Final = 30.0


@dataclass(frozen=True, kw_only=True)
class FileLine:
    """The line of a track file.

    Attributes
    ----------
    track : Track
        The file's points that are used.
    point_m : ndarray, shape (V,) [m]
        Chainage of the points on the curve.
    curve : CubicHermiteSpline
        Points of the line, ECEF [m], over chainage [m].
    knots : Knots
    """

    track: Track
    point_m: Floats
    curve: CubicHermiteSpline[np.float64]
    knots: Knots


def line_of_file(settings: LineFile) -> FileLine:
    """The line through the points of a track file.

    InputFileError: when the file is no track map, has fewer than four points in the part asked for, or bends too
    sharply to be a line.
    """
    track = read_track(
        settings.path,
        crs=settings.crs or None,
        height_datum=settings.height_datum or None,
        geoid=settings.geoid or None,
    )
    used = (track.chainage_m >= settings.from_m) & (track.chainage_m <= settings.to_m)
    if used.sum() < 4:
        raise InputFileError(
            settings.path,
            f"has {used.sum()} points from {settings.from_m:g} to {settings.to_m:g} m of its "
            f"{track.chainage_m[-1]:.0f} m, expected at least 4",
        )
    track = _part(track, used)
    chord = CubicSpline(track.chainage_m, track.ecef_m, axis=0)
    at, arc = _arc_length(chord, track.chainage_m)
    place, slope, bend = (chord(at, order) for order in range(3))
    tangent = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    curvature, grade = _curvature_and_grade(place, slope, bend)
    worst = int(np.argmax(np.abs(curvature)))
    if abs(curvature[worst]) > 1.0 / _TIGHTEST_M:
        raise InputFileError(
            settings.path,
            f"bends with a radius of {1.0 / abs(curvature[worst]):.1f} m at {at[worst]:.1f} m of it, expected at least "
            f"{_TIGHTEST_M:g} m; take out points that jitter, or the digits are too few (map convert can thin it)",
        )
    point = np.interp(track.chainage_m, at, arc)
    return FileLine(
        track=track,
        point_m=point,
        curve=CubicHermiteSpline(arc, place, tangent, axis=0),
        knots=_knots(track, point, arc, curvature, grade),
    )


def _part(track: Track, used: Masks) -> Track:
    """Some of the points of a track."""
    if used.all():
        return track
    columns: dict[str, Any] = {
        item.name: getattr(track, item.name)[used]
        for item in fields(track)
        if isinstance(getattr(track, item.name), np.ndarray)
    }
    return replace(track, **columns)


def _arc_length(chord: CubicSpline[np.float64], knots: Floats) -> tuple[Floats, Floats]:
    """Parameters at about every half metre, the knots among them, and the arc length there (Gauss, 3 points)."""
    pieces = np.maximum(np.ceil(np.diff(knots) / _STEP_M).astype(np.int64), 1)
    start = np.repeat(knots[:-1], pieces)
    step = np.repeat(np.diff(knots) / pieces, pieces)
    number = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    at = np.append(start + number * step, knots[-1])
    node, weight = np.polynomial.legendre.leggauss(3)
    gauss = at[:-1, None] + np.diff(at)[:, None] * (node + 1.0) / 2.0
    speed = np.linalg.norm(chord(gauss, 1), axis=-1)
    lengths = speed @ (weight / 2.0) * np.diff(at)
    return at, np.concatenate([[0.0], np.cumsum(lengths)])


def _curvature_and_grade(place: Floats, slope: Floats, bend: Floats) -> tuple[Floats, Floats]:
    """Curvature in plan, right positive [1/m], and gradient [m/m]."""
    latitude, longitude, _ = geodetic_from_ecef(place)
    axes = enu_axes(latitude, longitude)
    v, a = np.einsum("nij,nj->ni", axes, slope), np.einsum("nij,nj->ni", axes, bend)
    plan = np.hypot(v[:, 0], v[:, 1])
    return (v[:, 1] * a[:, 0] - v[:, 0] * a[:, 1]) / plan**3, v[:, 2] / plan


def _knots(track: Track, point: Floats, arc: Floats, curvature: Floats, grade: Floats) -> Knots:
    """Curvature of the file where it has radii, else of the spline; lean of the file's cant."""
    bend = (
        np.interp(arc, point, _fill_gaps(point, 1.0 / track.radius_m))
        if (~np.isnan(track.radius_m)).any()
        else curvature
    )
    cant = _fill_gaps(point, track.cant_m) if np.isfinite(track.cant_m).any() else np.zeros(len(point))
    side = np.sign(np.interp(point, arc, bend))
    return Knots(
        knot_m=arc,
        curvature=bend,
        lean_m=np.interp(arc, point, side * cant),
        grade_knot_m=arc,
        grade=grade,
    )


def _fill_gaps(point: Floats, values: Floats) -> Floats:
    """Values with NaN filled by their neighbours."""
    known = np.isfinite(values)
    return np.interp(point, point[known], values[known])

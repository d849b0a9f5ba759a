"""Elements of an alignment in plan, profile and cant, as in design files (IFC, LandXML), and points of the alignment.

The direction is the integral of the curvature in closed form. The position is the integral of the direction, by
Gauss-Legendre quadrature. As in IFC 4.3 and LandXML, lengths are in plan, directions are counter-clockwise from the x
axis (easting), and curvature is positive to the left.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
import scipy
from pyproj import CRS, Transformer

from railfix.core.arrays import Floats, Masks
from railfix.core.errors import InputFileError
from railfix.track.crs import LARGEST_SCALE, MARGIN_DEG, is_in_area, unit_of_grid
from railfix.track.georeference import Georeference, georeference
from railfix.track.heights import heights_of_file
from railfix.track.route import MapReading, Segment, make_segment
from railfix.track.transitions import OrdinateElement

#: Laws by which curvature or cant changes along an element (IFC 4.3.2). The first function of a law is the fraction of
#: the change that is reached at the fraction t of the length. The second function is the integral of the first one from
#: 0 to t.
LAWS: Final[dict[str, tuple[Callable[[Floats], Floats], Callable[[Floats], Floats]]]] = {
    "linear": (lambda t: t, lambda t: t**2 / 2.0),
    "bloss": (lambda t: 3.0 * t**2 - 2.0 * t**3, lambda t: t**3 - t**4 / 2.0),
    "cosine": (lambda t: (1.0 - np.cos(np.pi * t)) / 2.0, lambda t: t / 2.0 - np.sin(np.pi * t) / (2.0 * np.pi)),
    "sine": (
        lambda t: t - np.sin(2.0 * np.pi * t) / (2.0 * np.pi),
        lambda t: t**2 / 2.0 + (np.cos(2.0 * np.pi * t) - 1.0) / (4.0 * np.pi**2),
    ),
    "helmert": (
        lambda t: np.where(t < 0.5, 2.0 * t**2, -1.0 + 4.0 * t - 2.0 * t**2),
        lambda t: np.where(t < 0.5, 2.0 * t**3 / 3.0, 1.0 / 6.0 - t + 2.0 * t**2 - 2.0 * t**3 / 3.0),
    ),
    "viennese": (
        lambda t: t**4 * (35.0 - 84.0 * t + 70.0 * t**2 - 20.0 * t**3),
        lambda t: t**5 * (7.0 - 14.0 * t + 10.0 * t**2 - 2.5 * t**3),
    ),
}
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
#: Largest turn within one quadrature interval [rad]; up to this turn, 12 nodes are exact except for rounding errors.
_PIECE_RAD: Final = 0.5
_CHORD_M: Final = 0.01  #: Largest distance of the chords between points from the alignment [m].
_LONGEST_M: Final = 25.0  #: Largest spacing of an alignment's points [m].
#: Number of points on a profile clothoid; linear interpolation between the points is accurate to 1 um.
_CLOTHOID_POINTS: Final = 2001
#: Distance between an element's end and the next element's start above which a note is given [m].
_JOINT_M: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class PlanElement:
    """Element of the horizontal alignment; `law` states how the curvature changes along the element."""

    x_m: float  #: Easting of the first point.
    y_m: float  #: Northing of the first point.
    direction_rad: float  #: Direction at the first point, counter-clockwise from the x axis.
    first: float  #: Curvature at the first point, positive to the left [1/m].
    last: float  #: Curvature at the last point, positive to the left [1/m].

    length_m: float
    law: str = "linear"  #: Law of the curvature, a key of `LAWS`.
    #: For a Viennese bend, the height of the centre of gravity times the change of the cant angle, positive if the
    #: right rail rises. The law of a Viennese bend describes the path of the centre of gravity. For other laws,
    #: `lean_m` is 0.
    lean_m: float = 0.0

    def curvature_at(self, way_m: Floats) -> Floats:
        """Return the curvature, positive to the left [1/m], at distances from the first point [m]."""
        t = way_m / self.length_m
        bend = self.lean_m / self.length_m**2 * 420.0 * t**2 * (1.0 - t) ** 2 * (1.0 - 2.0 * t)
        return np.asarray(self.first + (self.last - self.first) * LAWS[self.law][0](t) - bend)

    def direction_at(self, way_m: Floats) -> Floats:
        """Return the direction, counter-clockwise from the x axis [rad], at distances from the first point [m]."""
        t = way_m / self.length_m
        change = (self.last - self.first) * self.length_m * LAWS[self.law][1](t)
        change = change - self.lean_m / self.length_m * 140.0 * t**3 * (1.0 - t) ** 3
        return np.asarray(self.direction_rad + self.first * way_m + change)

    def place_at(self, way_m: Floats) -> Floats:
        """Return the easting and northing, shape (n, 2) [m], at distances from the first point [m]."""
        turn = max(abs(self.first), abs(self.last)) * self.length_m
        # even number, because Helmert's law has a knot in the middle
        pieces = max(2, 2 * int(np.ceil(turn / (2.0 * _PIECE_RAD))))
        knots = np.linspace(0.0, self.length_m, pieces + 1)
        whole = np.concatenate([np.zeros((1, 2)), np.cumsum(self._integral(knots[:-1], knots[1:]), axis=0)])
        piece = np.clip(np.searchsorted(knots, way_m, side="right") - 1, 0, pieces - 1)
        return np.asarray(np.array([self.x_m, self.y_m]) + whole[piece] + self._integral(knots[piece], way_m))

    def _integral(self, start: Floats, end: Floats) -> Floats:
        half = (end - start)[:, None] / 2.0
        direction = self.direction_at(start[:, None] + half * (1.0 + _NODES))
        return np.stack([(half * _WEIGHTS * part(direction)).sum(axis=1) for part in (np.cos, np.sin)], axis=-1)


#: Element in plan, defined by a law of the curvature or by offsets from the tangent.
Plan = PlanElement | OrdinateElement


@dataclass(frozen=True)
class Stations:
    """Stations (kilometrage) of an alignment, which may jump at station equations."""

    #: One row for the start and one row for each jump, in order of distance. A row has the distance in plan from the
    #: start of the alignment, the station just before the jump, and the station just after the jump [m].
    rows: tuple[tuple[float, float, float], ...]
    last_sign: float = 1.0  #: 1 if the stations rise after the last row, -1 if they fall.
    jump_m: float = 0.05  #: A jump of the kilometrage is spread over this distance before and after the jump.

    @property
    def places_m(self) -> Floats:
        """Distances in plan from the start to the points before and after each jump [m]."""
        place = np.array([row[0] for row in self.rows[1:]])
        return np.concatenate([place - self.jump_m, place + self.jump_m])

    def at(self, place_m: Floats) -> Floats:
        """Return the stations at distances in plan from the start, shape (n,) [m]."""
        place, _, ahead = np.array(self.rows).T
        row = np.clip(np.searchsorted(place, place_m, side="right") - 1, 0, len(place) - 1)
        signs = [*(np.sign(b[1] - a[2]) or 1.0 for a, b in pairwise(self.rows)), self.last_sign]
        return np.asarray(ahead[row] + np.array(signs)[row] * (place_m - place[row]))


@dataclass(frozen=True, kw_only=True)
class ProfileElement:
    """Element of the profile: constant gradient, circular arc, parabola or clothoid."""

    start_m: float  #: Distance in plan from the start of the alignment to the start of the element.
    length_m: float  #: Length of the element in plan.
    height_m: float  #: Height at the start of the element.
    first: float  #: Gradient at the start of the element [m/m].
    last: float  #: Gradient at the end of the element [m/m].
    #: Shape: "circle", "clothoid" or "parabola"; a constant gradient is a parabola with equal gradients at both ends.
    arc: str = "parabola"
    bend: float = 0.0  #: Curvature of a clothoid at the start, positive in a sag [1/m].

    def height_at(self, place_m: Floats) -> Floats:
        """Return the height at distances in plan, shape (n,) [m]."""
        way = place_m - self.start_m
        if self.arc == "parabola" or self.first == self.last:
            bend = (self.last - self.first) * way**2 / (2.0 * self.length_m)
            return np.asarray(self.height_m + self.first * way + bend)
        if self.arc == "clothoid":
            place, height, _ = self._clothoid
            return np.asarray(self.height_m + np.interp(way, place, height))
        sine = _sine(self.first) + (_sine(self.last) - _sine(self.first)) * way / self.length_m
        radius = self.length_m / (_sine(self.last) - _sine(self.first))
        return np.asarray(self.height_m - radius * (np.sqrt(1.0 - sine**2) - np.sqrt(1.0 - _sine(self.first) ** 2)))

    def gradient_at(self, place_m: Floats) -> Floats:
        """Return the gradient [m/m] at distances in plan, shape (n,) [m]."""
        share = (place_m - self.start_m) / self.length_m
        if self.arc == "parabola" or self.first == self.last:
            return np.asarray(self.first + (self.last - self.first) * share)
        if self.arc == "clothoid":
            place, _, gradient = self._clothoid
            return np.asarray(np.interp(share * self.length_m, place, gradient))
        sine = _sine(self.first) + (_sine(self.last) - _sine(self.first)) * share
        return np.asarray(sine / np.sqrt(1.0 - sine**2))

    @cached_property
    def _clothoid(self) -> tuple[Floats, Floats, Floats]:
        """Return points of a clothoid: distances in plan from its start, heights above its start, and gradients.

        The slope angle is a quadratic function of the length along the curve.
        """
        start, turn = np.arctan(self.first), np.arctan(self.last) - np.arctan(self.first)
        length = self.length_m
        # iterate the length along the curve until the curve has the given length in plan
        for _ in range(20):
            way = np.linspace(0.0, length, _CLOTHOID_POINTS)
            angle = start + self.bend * way + (turn - self.bend * length) * (way / length) ** 2
            place, height = (
                scipy.integrate.cumulative_simpson(part(angle), x=way, initial=0.0) for part in (np.cos, np.sin)
            )
            length *= self.length_m / place[-1]
        return np.asarray(place), np.asarray(height), np.tan(angle)


@dataclass(frozen=True, kw_only=True)
class CantElement:
    """Element of the cant; `law` states how the heights of both rails change along the element."""

    start_m: float  #: Distance in plan from the start of the alignment to the start of the element.
    length_m: float  #: Length of the element in plan.
    left_m: tuple[float, float]  #: Heights of the left rail above the profile, at start and end of the element.
    right_m: tuple[float, float]  #: Heights of the right rail above the profile, at start and end of the element.
    law: str = "linear"  #: Law by which the height varies along the element, a key of `LAWS`.

    def rails_at(self, place_m: Floats) -> tuple[Floats, Floats]:
        """Return the heights of left and right rail above the profile at distances in plan, shape (n,) each [m]."""
        share = LAWS[self.law][0](np.clip((place_m - self.start_m) / self.length_m, 0.0, 1.0))
        left, right = (np.asarray(a + (b - a) * share) for a, b in (self.left_m, self.right_m))
        return left, right


def _sine(gradient: float) -> float:
    return float(gradient / np.hypot(1.0, gradient))


@dataclass(frozen=True, kw_only=True)
class AlignmentPoints:
    """Points of an alignment in grid coordinates, n points."""

    place_m: Floats  #: Distance in plan from the start of the alignment, shape (n,).
    xy_m: Floats  #: Easting and northing, shape (n, 2).
    height_m: Floats  #: Height of the middle between the rail tops, shape (n,); NaN without a profile.
    curvature: Floats  #: Curvature, positive to the left, shape (n,) [1/m].
    cant_m: Floats  #: Height of the right rail above the left rail, shape (n,); NaN without cant.
    gradient: Floats  #: Gradient of the profile [m/m], shape (n,); NaN without a profile.


def alignment_at(
    place_m: Floats, plan: Sequence[Plan], profile: Sequence[ProfileElement], cant: Sequence[CantElement]
) -> AlignmentPoints:
    """Compute the points of an alignment at distances in plan, shape (n,) [m].

    Each position is computed from the first point of the element, so that gaps between successive elements do not add
    up.
    """
    starts = plan_starts(plan)
    xy, curvature = np.zeros((len(place_m), 2)), np.zeros(len(place_m))
    for rows, k in _by_start(place_m, starts):
        way = place_m[rows] - starts[k]
        xy[rows], curvature[rows] = plan[k].place_at(way), plan[k].curvature_at(way)
    height, gradient = np.full(len(place_m), np.nan), np.full(len(place_m), np.nan)
    for rows, k in _by_start(place_m, [element.start_m for element in profile]):
        height[rows] = profile[k].height_at(place_m[rows])
        gradient[rows] = profile[k].gradient_at(place_m[rows])
    difference = np.full(len(place_m), np.nan)
    for rows, k in _by_start(place_m, [element.start_m for element in cant]):
        left, right = cant[k].rails_at(place_m[rows])
        height[rows] += (left + right) / 2.0
        difference[rows] = right - left
    return AlignmentPoints(
        place_m=place_m, xy_m=xy, height_m=height, curvature=curvature, cant_m=difference, gradient=gradient
    )


def plan_starts(plan: Sequence[Plan]) -> Floats:
    """Return the distance in plan from the alignment's start to the start of each element, shape (elements,) [m]."""
    return np.cumsum([0.0, *(element.length_m for element in plan)])[:-1]


def _by_start(place_m: Floats, starts: Sequence[float] | Floats) -> list[tuple[Masks, int]]:
    """Return, for each element on which distances lie, the mask of these distances and the element's index.

    A distance belongs to the last element that starts before it, or to the first element.
    """
    if not len(starts):
        return []
    index = np.maximum(np.searchsorted(starts, place_m, side="right") - 1, 0)
    return [(index == k, k) for k in np.unique(index).tolist()]


def alignment_points(
    plan: Sequence[Plan],
    profile: Sequence[ProfileElement],
    cant: Sequence[CantElement],
    at_m: Sequence[float] | Floats = (),
) -> tuple[AlignmentPoints, tuple[str, ...]]:
    """Compute points of an alignment, and notes on successive elements that do not meet.

    The chords between points are within 1 cm of the alignment. `at_m` are distances in plan of additional points [m].
    """
    starts = plan_starts(plan)
    length = starts[-1] + plan[-1].length_m
    places = [np.array([0.0, length]), np.asarray(at_m, dtype=np.float64)]
    for element, start in zip(plan, starts, strict=True):
        bend = max(abs(element.first), abs(element.last))
        step = min(_LONGEST_M, np.sqrt(8.0 * _CHORD_M / bend)) if bend else _LONGEST_M
        places.append(start + np.linspace(0.0, element.length_m, int(np.ceil(element.length_m / step)) + 1))
    places += [np.array([e.start_m, e.start_m + e.length_m]) for e in profile]
    places += [np.array([e.start_m, e.start_m + e.length_m]) for e in cant]
    place = np.unique(np.concatenate(places).clip(0.0, length))
    place = place[np.concatenate([[True], np.diff(place) > 1e-3])]
    gaps = [
        float(np.hypot(*(before.place_at(np.array([before.length_m]))[0] - (after.x_m, after.y_m))))
        for before, after in pairwise(plan)
    ]
    wide = [gap for gap in gaps if gap > _JOINT_M]
    notes = (
        (f"{len(wide)} of {len(gaps)} pairs of successive elements do not meet; the widest gap is {max(wide):.3f} m",)
        if wide
        else ()
    )
    return alignment_at(place, plan, profile, cant), notes


#: An alignment is rejected if more than this length has no profile [m]; otherwise the outermost gradients continue.
_PROFILE_BEYOND_M: Final = 50.0


@dataclass(frozen=True, kw_only=True)
class Design:
    """Elements of one alignment in order of chainage, and the stations of the alignment."""

    plan: Sequence[Plan]
    profile: Sequence[ProfileElement] = ()
    cant: Sequence[CantElement] = ()
    stations: Stations | None = None  #: Stations; None if the file states no stations.


def segment_of_design(
    *,
    path: str,
    name: str,
    design: Design,
    reading: MapReading,
    grid: tuple[float, float, float, float, float, float] | None = None,
    notes: tuple[str, ...] = (),
) -> Segment:
    """Create a segment from the elements of one alignment.

    `grid` is the transformation from the file's coordinates to the grid: easting, northing and height of the origin
    [m], cosine and sine of the rotation, and scale. Raise InputFileError or SettingsError if plan, profile or CRS are
    not valid.
    """
    plan, profile, stations = design.plan, design.profile, design.stations
    if not plan:
        raise InputFileError(path, f"alignment {name!r} has no element in plan")
    crs = reading.crs
    if crs is None:
        raise InputFileError(path, f"alignment {name!r} is in a grid that the file does not name; specify crs (--crs)")
    points, joints = alignment_points(plan, profile, design.cant, at_m=() if stations is None else stations.places_m)
    xy, up, scale = points.xy_m, 0.0, 1.0
    unit = unit_of_grid(crs, path=path)
    if grid is not None:
        if unit != 1.0:
            raise InputFileError(
                path, f"the grid {crs} is not in metres, which is not supported; give a grid in metres"
            )
        east, north, up, cosine, sine, scale = grid
        xy = np.array([east, north]) + scale * xy @ np.array([[cosine, sine], [-sine, cosine]])
    xy /= unit
    curvature = points.curvature
    if grid is None and is_within(crs, xy[:, ::-1]) and not is_within(crs, xy):
        # exchanging easting and northing mirrors the plane, so that left curves become right curves
        xy, curvature = xy[:, ::-1], -curvature
        joints = (*joints, f"{name}: the file has northing before easting")
    source, heights = f"{path} ({name})", None
    place = georeference(crs, xy[:, 0], xy[:, 1], path=source)
    _check_length(plan, place, path=source)
    if profile:
        joints += _check_profile(plan, profile, path=source)
        heights = heights_of_file(points.height_m + up, place, reading, path=path)
    radius = np.full(len(xy), np.inf)
    bent = np.abs(curvature) > 1e-9
    radius[bent] = -1.0 / curvature[bent] * scale
    return make_segment(
        place,
        heights,
        source=source,
        file=path,
        crs=crs,
        metadata={"name": name},
        notes=(*notes, *joints),
        attributes={
            "cant_m": points.cant_m * _side_of_curve(curvature, bent),
            "radius_m": radius,
            "gradient_permille": points.gradient * 1e3,
            **({} if stations is None else {"kilometrage_m": stations.at(points.place_m)}),
        },
    )


def _check_profile(plan: Sequence[Plan], profile: Sequence[ProfileElement], *, path: str) -> tuple[str, ...]:
    """Check that a profile covers the plan, and return a note on the length that it does not cover.

    Raise InputFileError if this length exceeds `_PROFILE_BEYOND_M`.
    """
    length, low = sum(element.length_m for element in plan), min(element.start_m for element in profile)
    high = max(element.start_m + element.length_m for element in profile)
    left_out = max(low, 0.0) + max(length - high, 0.0)
    where = f"the profile runs from {low:.0f} to {high:.0f} m of an alignment of {length:.0f} m"
    if left_out > _PROFILE_BEYOND_M:
        raise InputFileError(path, f"{where}; correct the profile's stations, or remove the profile and give heights")
    return (f"{path}: {where}; beyond its ends the outermost gradients are continued",) if left_out > 1.0 else ()


def _check_length(plan: Sequence[Plan], place: Georeference, *, path: str) -> None:
    """Raise InputFileError if an alignment's length on the map differs from its design length.

    Causes of a difference are a wrong CRS, and elements that do not meet.
    """
    designed = sum(element.length_m for element in plan)
    geod = CRS.from_user_input(place.frame).get_geod()
    found = float(geod.line_length(place.longitude_deg, place.latitude_deg)) if geod is not None else designed
    if abs(found - designed) > LARGEST_SCALE * designed + 0.5:
        raise InputFileError(
            path,
            f"the design is {designed:.0f} m long, but {found:.0f} m on the map; give the right crs (--crs), or "
            "correct the elements that do not meet",
        )


def _side_of_curve(curvature: Floats, bent: Masks) -> Floats:
    """Return the sign of each point's curvature or, on straight track, of the nearest curve's curvature, shape (n,).

    The nearest curve is used because a cant ramp can begin on straight track. Without curves, the sign is 1.
    """
    if not bent.any():
        return np.ones(len(curvature))
    place = np.arange(len(curvature))
    nearest = np.searchsorted(place[bent], place).clip(0, bent.sum() - 1)
    before = (nearest - 1).clip(0)
    nearer = np.abs(place[bent][before] - place) < np.abs(place[bent][nearest] - place)
    return np.asarray(np.sign(curvature[bent])[np.where(nearer, before, nearest)])


def is_within(crs: str, xy: Floats) -> bool:
    """Return whether all coordinates (n, 2) are in the area of use of a CRS; True for a CRS without an area."""
    system = CRS.from_user_input(crs)
    if system.area_of_use is None:
        return True
    transformer = Transformer.from_crs(system.to_2d(), "EPSG:4326", always_xy=True)
    longitude, latitude = (np.asarray(v) for v in transformer.transform(xy[:, 0], xy[:, 1]))
    return bool(is_in_area(system, latitude, longitude, margin_deg=MARGIN_DEG).all())

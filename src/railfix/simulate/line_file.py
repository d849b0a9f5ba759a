"""Settings of the simulated line, and smooth curves through the points of a track file.

The curve is a cubic spline in space (not-a-knot), whose arc length is the chainage. Cant is linear between points. The
side of the outer rail follows from the file's radii, or from the curvature of the spline if the file has no radii. A
file with a radius below 30 m is rejected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from railfix.core.arrays import Floats, places_in_groups, take_rows
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import axes_at
from railfix.simulate.settings import (
    Between,
    Finite,
    NotNegative,
    Positive,
    ScenarioSettings,
    Seed,
    at_least,
    beyond_start,
)
from railfix.track import Track, read_track

PATTERN_LENGTH_M: Final = 756.0  #: Default length of the pattern of P1's test line [m].
GENERATED_LENGTH_M: Final = 36_000.0  #: Default length of a generated line [m].
LONGEST_LINE_M: Final = 1e7  #: A line or an element must not be longer than this [m].


class Element(ScenarioSettings):
    """Horizontal alignment element."""

    #: Kind of element; a transition is a clothoid from the previous to the next element, with a linear cant ramp.
    kind: Literal["straight", "transition", "curve"]

    length_m: float = Field(gt=0.0, le=LONGEST_LINE_M)
    #: Radius of a curve, positive to the right; infinite for other elements.
    radius_m: float = Field(default=math.inf, allow_inf_nan=True)
    cant_m: float = Field(default=0.0, ge=0.0, le=0.3)  #: Cant of a curve, outer rail above inner rail.

    @model_validator(mode="after")
    def _curves_alone_bend(self) -> Element:
        curved = self.kind == "curve"
        if curved != math.isfinite(self.radius_m) or (curved and abs(self.radius_m) < 30.0):
            raise ValueError(
                f"radius_m of a {self.kind} is {self.radius_m}; a curve has a radius of at least 30 m "
                "(negative to the left), and only curves have a radius"
            )
        if self.cant_m > 0.0 and not curved:
            raise ValueError(f"cant_m of a {self.kind} is {self.cant_m}; only a curve has a cant")
        return self


class Gradient(ScenarioSettings):
    """Gradient of the line from a chainage to the next change of gradient."""

    from_m: NotNegative  #: Chainage at which the gradient begins: the middle of the vertical curve.
    permille: float = Field(ge=-100.0, le=100.0)  #: Gradient, positive where the line rises with chainage.
    vertical_radius_m: Positive = 4000.0  #: Radius of the vertical curve from the previous gradient to this gradient.


class Terrain(ScenarioSettings):
    """Ranges of uniformly distributed properties of a generated line, from `from_m` to the next terrain."""

    from_m: NotNegative = 0.0  #: Chainage at which this terrain begins.
    straight_m: Annotated[Between, at_least(1.0)] = (200.0, 1500.0)  #: Range of the lengths of straights.
    #: Range of the lengths of curves, excluding their transitions.
    curve_m: Annotated[Between, at_least(1.0)] = (100.0, 500.0)
    radius_m: Annotated[Between, at_least(100.0)] = (400.0, 1600.0)  #: Range of the radii of curves.
    permille: float = Field(default=10.0, ge=0.0, le=35.0)  #: Largest magnitude of the drawn gradients.
    #: Range of the distance between two changes of gradient.
    gradient_m: Annotated[Between, at_least(200.0)] = (400.0, 1500.0)


class GeneratedLine(ScenarioSettings):
    """Randomly generated line with the geometry of a line in service."""

    seed: Seed = 1  #: Seed of the line, separate from the seed of the run, so that several runs can share a line.
    #: Speed for which curves have equilibrium cant. The cant is limited to `largest_cant_m` and rounded to 5 mm.
    speed_mps: Positive = 110.0 / 3.6

    largest_cant_m: NotNegative = 0.105
    vertical_radius_m: Positive = 4000.0  #: Radius of the vertical curves.
    terrain: tuple[Terrain, ...] = (Terrain(),)  #: Terrains in order of `from_m`; the first begins at 0.

    @field_validator("terrain")
    @classmethod
    def _from_the_start(cls, terrain: tuple[Terrain, ...]) -> tuple[Terrain, ...]:
        starts = [part.from_m for part in terrain]
        if not starts or starts[0] != 0.0 or any(a >= b for a, b in pairwise(starts)):
            raise ValueError(f"from_m must begin at 0 and be in ascending order, got {starts}")
        return terrain


class LineFile(ScenarioSettings):
    """Track file used as the line."""

    path: str  #: Path of the track file; in a scenario file, relative to the folder of the scenario file.
    from_m: NotNegative = 0.0  #: Chainage in the track file at which the line begins.
    to_m: float = Field(default=math.inf, allow_inf_nan=True)  #: Chainage in the track file at which the line ends.
    crs: str = ""  #: CRS of the track file, an option of `read_track`; empty if the file states the CRS.
    height_datum: str = ""  #: Height datum of the track file, an option of `read_track`; empty if the file states it.
    geoid: str = ""  #: Geoid of orthometric heights, an option of `read_track`; empty if no geoid is needed.

    _forward = field_validator("to_m")(beyond_start)


class MapError(ScenarioSettings):
    """Offset of the map from the true line: a smooth Gaussian function of chainage."""

    plan_sigma_m: NotNegative = 0.0  #: Standard deviation of the east offset and of the north offset.
    height_sigma_m: NotNegative = 0.0  #: Standard deviation of the vertical offset.
    correlation_m: Positive = 500.0  #: Distance along the line over which the correlation falls to exp(-1/2).
    seed: Seed = 1


def _length_m(given: dict[str, Any]) -> float:
    """Return the default length of a line with the given settings; NaN for a track file."""
    total = math.fsum(item.length_m for item in given.get("elements", ()))
    by_kind = {"pattern": PATTERN_LENGTH_M, "generated": GENERATED_LENGTH_M, "elements": total}
    return by_kind.get(given.get("kind", "file"), math.nan)


class LineSettings(ScenarioSettings):
    """Line, and spacing of the points of the track map."""

    name: str = "simulated test line"
    #: Source of the line: the pattern of P1's test line, `elements` with `gradients`, `generated`, or `file`.
    kind: Literal["pattern", "elements", "generated", "file"] = "pattern"
    latitude_deg: float = Field(default=35.05, gt=-80.0, lt=80.0)  #: Latitude of the first point; not used for a file.
    longitude_deg: Finite = 135.45  #: Longitude of the first point; not used for a file.
    height_m: Finite = 162.0  #: Ellipsoidal height of the first point; not used for a file.
    azimuth_deg: Finite = 63.0  #: Azimuth of the line at its first point; not used for a file.
    #: Kilometrage of the first point; the kilometrage rises with chainage. Not used for a file, which has its own
    #: kilometrage.
    kilometrage_start_m: Finite = 12_340.0
    straight_spacing_m: Positive = 20.0  #: Largest spacing of map points on straights; not used for a file.
    curve_spacing_m: Positive = 2.32  #: Largest spacing of map points in curves and transitions; not used for a file.

    elements: tuple[Element, ...] = ()
    gradients: tuple[Gradient, ...] = ()  #: Gradients by rising chainage; without gradients, the line is level.
    #: Length of the line. The pattern of 756 m is repeated up to this length, with every second copy mirrored. With
    #: `elements`, the length is the sum of the element lengths; for a file, `length_m` must be NaN.
    length_m: float = Field(default_factory=_length_m, allow_inf_nan=True)

    generated: GeneratedLine = GeneratedLine()
    file: LineFile | None = None
    map_error: MapError = MapError()

    @model_validator(mode="after")
    def _of_one_kind(self) -> LineSettings:
        """Reject settings that belong to another kind of line, and lengths that do not fit the kind."""
        total = math.fsum(item.length_m for item in self.elements)
        if (self.kind == "elements") != bool(self.elements) or (self.gradients and not self.elements):
            raise ValueError(f"line.elements and line.gradients require line.kind 'elements', got {self.kind!r}")
        if (self.kind == "file") != (self.file is not None):
            raise ValueError(f"line.file requires line.kind 'file', got {self.kind!r}")
        if self.kind != "generated" and self.generated != GeneratedLine():
            raise ValueError(f"line.generated requires line.kind 'generated', got {self.kind!r}")
        if self.length_m > LONGEST_LINE_M:
            raise ValueError(f"length_m is {self.length_m:g}, expected at most {LONGEST_LINE_M:g}")
        if self.kind == "file" and not math.isnan(self.length_m):
            raise ValueError("length_m follows from the file; to use a part, set line.file.from_m and to_m")
        if self.kind == "elements" and abs(self.length_m - total) > 1e-6:
            raise ValueError(f"length_m is {self.length_m}, but the elements are {total} m long")
        if self.kind != "file" and not self.length_m >= 100.0:
            raise ValueError(f"length_m must be at least 100 m for a train to run, got {self.length_m}")
        return self


#: Distance between the contact points of a wheelset [m], used for the equilibrium cant of generated lines.
_CONTACT_M: Final = 1.137
#: If a generated line has turned by more than this angle [rad], its next curve turns back.
_FAR_RAD: Final = np.radians(50.0)
#: If a generated line is higher or lower than its start by more than this [m], its next gradient leads back.
_HIGH_M: Final = 150.0
_CANT_STEP_M: Final = 0.005  #: Cant is rounded to multiples of this [m].


@dataclass(frozen=True, kw_only=True)
class Knots:
    """Curvature and cant at K knots, and gradient at G knots, linear between the knots."""

    knot_m: Floats  #: Chainages at which the elements begin and end, shape (K,).
    curvature: Floats  #: Curvature in plan, positive to the right, shape (K,) [1/m].
    lean_m: Floats  #: Cant, positive if the vehicle leans to the right, shape (K,).
    grade_knot_m: Floats  #: Chainage of the knots of the gradient, shape (G,).
    grade: Floats  #: Gradient, climb over plan length, shape (G,) [m/m].


def knots_of_elements(elements: Sequence[Element], gradients: Sequence[Gradient]) -> Knots:
    """Return the knots of a line that is specified by elements and gradients.

    Raise SettingsError if consecutive elements, or the gradients, do not fit together.
    """
    for k, (element, following) in enumerate(pairwise(elements)):
        both = {element.kind, following.kind}
        if both == {"transition"}:
            raise SettingsError(f"line.elements {k + 1} and {k + 2} are both transitions; join them to one transition")
        if "transition" not in both and (element.radius_m, element.cant_m) != (following.radius_m, following.cant_m):
            raise SettingsError(
                f"line.elements {k + 1} ({element.kind}) and {k + 2} ({following.kind}) need a transition between them"
            )
    knot = np.concatenate([[0.0], np.cumsum([item.length_m for item in elements])])
    ends = np.zeros((2, len(knot)))
    for k, item in enumerate(elements):
        if item.kind != "transition":
            bend, lean = 1.0 / item.radius_m, np.sign(item.radius_m) * item.cant_m
            ends[:, k], ends[:, k + 1] = (bend, lean), (bend, lean)
    grade_knot, grade = _vertical(gradients, float(knot[-1]))
    return Knots(knot_m=knot, curvature=ends[0], lean_m=ends[1], grade_knot_m=grade_knot, grade=grade)


def _vertical(gradients: Sequence[Gradient], length_m: float) -> tuple[Floats, Floats]:
    """Return the chainages of the ends of the vertical curves, and the gradients at these ends.

    Raise SettingsError if a vertical curve overlaps the previous vertical curve or extends beyond an end of the line.
    """
    places, values, reached, current = [0.0], [0.0], 0.0, 0.0
    for k, item in enumerate(gradients):
        value = 1e-3 * item.permille
        half = item.vertical_radius_m * abs(value - current) / 2.0
        if item.from_m == 0.0 and k == 0:
            values[0] = current = value
            continue
        if item.from_m - half < reached - 1e-9 or item.from_m + half > length_m:
            raise SettingsError(
                f"line.gradients {k + 1} at {item.from_m} m: its vertical curve of {2.0 * half:.1f} m "
                "overlaps the previous vertical curve or an end of the line"
            )
        if half > 0.0:
            places += [item.from_m - half, item.from_m + half]
            values += [current, value]
        current, reached = value, item.from_m + half
    return np.array([*places, length_m]), np.array([*values, current])


def generate_knots(settings: LineSettings) -> Knots:
    """Return the knots of a generated line, in which straights and curves alternate."""
    rng = np.random.default_rng([settings.generated.seed, 11])
    return knots_of_elements(_plan(settings, rng), _profile(settings, rng))


def _terrain(generated: GeneratedLine, chainage_m: float) -> Terrain:
    return [part for part in generated.terrain if part.from_m <= chainage_m][-1]


def _plan(settings: LineSettings, rng: np.random.Generator) -> list[Element]:
    limits = settings.generated
    elements: list[Element] = []
    place, heading = 0.0, 0.0
    while place < settings.length_m:
        here = _terrain(limits, place)
        radius = float(np.round(rng.uniform(*here.radius_m), -1))
        straight, curve = (float(np.round(rng.uniform(*r))) for r in (here.straight_m, here.curve_m))
        to_right = rng.random() < 0.5 if abs(heading) < _FAR_RAD else heading < 0.0
        side = 1.0 if to_right else -1.0
        # Equilibrium cant. The length of the transition is the largest of 20 m, 400 times the cant, and 8 times the
        # cant times the speed in km/h.
        cant = min(limits.speed_mps**2 / (GRAVITY_MPS2 * radius) * _CONTACT_M, limits.largest_cant_m)
        cant = float(np.round(np.round(cant / _CANT_STEP_M) * _CANT_STEP_M, 3))
        speed_kmh = 3.6 * min(limits.speed_mps, np.sqrt(GRAVITY_MPS2 * radius * (cant + 0.06) / _CONTACT_M))
        ramp = float(np.ceil(max(20.0, 400.0 * cant, 8.0 * cant * speed_kmh)))
        turn = (curve + ramp) / radius
        if turn > 2.0 * _FAR_RAD:
            curve = max(10.0, float(np.floor(2.0 * _FAR_RAD * radius - ramp)))
            turn = (curve + ramp) / radius
        heading += side * turn
        bend = Element(kind="curve", length_m=curve, radius_m=side * radius, cant_m=cant)
        elements += [Element(kind="straight", length_m=straight), Element(kind="transition", length_m=ramp)]
        elements += [bend, Element(kind="transition", length_m=ramp)]
        place += straight + curve + 2.0 * ramp
    return _cut(elements, settings.length_m)


def _cut(elements: list[Element], length_m: float) -> list[Element]:
    """Return the elements up to a length; a straight replaces the last curve and its transitions if they do not fit."""
    while elements and sum(item.length_m for item in elements) > length_m:
        # Straight, transition, curve, transition: all four are replaced.
        del elements[-4:]
    rest = length_m - sum(item.length_m for item in elements)
    return [*elements, Element(kind="straight", length_m=rest)] if rest > 0.0 else elements


def _profile(settings: LineSettings, rng: np.random.Generator) -> list[Gradient]:
    limits = settings.generated
    changes: list[Gradient] = []
    place, height, before, behind = 0.0, 0.0, 0.0, np.inf
    while True:
        here = _terrain(limits, place)
        step = float(np.round(rng.uniform(*here.gradient_m)))
        permille = float(np.round(rng.uniform(-here.permille, here.permille) * 2.0) / 2.0)
        if abs(height) > _HIGH_M:
            permille = -float(np.sign(height)) * abs(permille)
        # The change of gradient is limited so that vertical curves do not overlap.
        fits = 0.9 * min(step, behind) / limits.vertical_radius_m * 1e3
        permille = float(np.clip(permille, before - fits, before + fits))
        if place + 2.0 * step > settings.length_m:
            break
        changes.append(Gradient(from_m=place, permille=permille, vertical_radius_m=limits.vertical_radius_m))
        height, before, place, behind = height + 1e-3 * permille * step, permille, place + step, step
    return changes


_STEP_M: Final = 0.5  #: Spacing of the points at which the spline is converted to a function of arc length [m].
_TIGHTEST_M: Final = 30.0  #: A line from a file must not have curves with a smaller radius [m].


@dataclass(frozen=True, kw_only=True)
class FileLine:
    """Line through the V points of a track file."""

    track: Track  #: Points of the file that belong to the line.
    point_m: Floats  #: Chainage of each point along the curve, shape (V,).
    curve: CubicHermiteSpline[np.float64]  #: ECEF position [m] of the line as a function of chainage [m].
    knots: Knots


def line_of_file(settings: LineFile) -> FileLine:
    """Return the line through the points of a track file.

    Raise InputFileError if there are fewer than four points, or a radius is below `_TIGHTEST_M`.
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
            f"has {used.sum()} points between {settings.from_m:g} and {settings.to_m:g} m; expected at least 4 (the "
            f"file is {track.chainage_m[-1]:.0f} m long)",
        )
    track = track if used.all() else take_rows(track, used)
    chord = CubicSpline(track.chainage_m, track.ecef_m, axis=0)
    at, arc = _arc_length(chord, track.chainage_m)
    place, slope, bend = (chord(at, order) for order in range(3))
    tangent = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    curvature, grade = _curvature_and_grade(place, slope, bend)
    worst = int(np.argmax(np.abs(curvature)))
    if abs(curvature[worst]) > 1.0 / _TIGHTEST_M:
        raise InputFileError(
            settings.path,
            f"has a radius of {1.0 / abs(curvature[worst]):.1f} m at chainage {at[worst]:.1f} m; expected at least "
            f"{_TIGHTEST_M:g} m; remove noisy points, or give coordinates with more digits",
        )
    point = np.interp(track.chainage_m, at, arc)
    return FileLine(
        track=track,
        point_m=point,
        curve=CubicHermiteSpline(arc, place, tangent, axis=0),
        knots=_knots(track, point, arc, curvature, grade),
    )


def _arc_length(chord: CubicSpline[np.float64], knots: Floats) -> tuple[Floats, Floats]:
    """Return spline parameters at intervals of about 0.5 m, including the knots, and their arc lengths from the start.

    The arc length is integrated by three-point Gauss quadrature.
    """
    pieces = np.maximum(np.ceil(np.diff(knots) / _STEP_M).astype(np.int64), 1)
    knot, number = places_in_groups(pieces)
    at = np.append(knots[knot] + number * (np.diff(knots) / pieces)[knot], knots[-1])
    node, weight = np.polynomial.legendre.leggauss(3)
    gauss = at[:-1, None] + np.diff(at)[:, None] * (node + 1.0) / 2.0
    speed = np.linalg.norm(chord(gauss, 1), axis=-1)
    lengths = speed @ (weight / 2.0) * np.diff(at)
    return at, np.concatenate([[0.0], np.cumsum(lengths)])


def _curvature_and_grade(place: Floats, slope: Floats, bend: Floats) -> tuple[Floats, Floats]:
    """Return the curvature in plan, positive to the right [1/m], and the gradient [m/m].

    `place`, `slope` and `bend` are ECEF position, first and second derivative of the spline, shape (n, 3).
    """
    axes = axes_at(place)
    v, a = np.einsum("nij,nj->ni", axes, slope), np.einsum("nij,nj->ni", axes, bend)
    plan = np.hypot(v[:, 0], v[:, 1])
    return (v[:, 1] * a[:, 0] - v[:, 0] * a[:, 1]) / plan**3, v[:, 2] / plan


def _knots(track: Track, point: Floats, arc: Floats, curvature: Floats, grade: Floats) -> Knots:
    """Return the knots of a line from a file; the curvature is from the file's radii, or else from the spline."""
    bend = (
        np.interp(arc, point, _fill_gaps(point, 1.0 / track.radius_m))
        if (~np.isnan(track.radius_m)).any()
        else curvature
    )
    cant = _fill_gaps(point, track.cant_m) if np.isfinite(track.cant_m).any() else np.zeros(len(point))
    side = np.sign(np.interp(point, arc, bend))
    return Knots(knot_m=arc, curvature=bend, lean_m=np.interp(arc, point, side * cant), grade_knot_m=arc, grade=grade)


def _fill_gaps(point: Floats, values: Floats) -> Floats:
    """Return values in which NaN is replaced by linear interpolation over chainage; at the ends, the nearest value is
    used.
    """
    known = np.isfinite(values)
    return np.interp(point, point[known], values[known])

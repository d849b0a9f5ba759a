"""Continuous line: curvature, cant and gradient as functions of chainage, integrated to a curve in space.

The curve is the ground truth. The track map consists of points of the curve, displaced by the offset `MapError`.
Chainage is the arc length in three dimensions. Curvature and cant change linearly in transitions (clothoids and cant
ramps), and the gradient changes linearly in vertical curves. The curve is integrated on the WGS 84 ellipsoid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline

from railfix.core.arrays import Floats, read_only
from railfix.core.geodesy import axes_at, ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.simulate.errors import RandomFunction
from railfix.simulate.line_file import (
    PATTERN_LENGTH_M,
    FileLine,
    Knots,
    LineSettings,
    generate_knots,
    knots_of_elements,
    line_of_file,
)
from railfix.track import Track, interpolate_kilometrage

_SEMI_MAJOR_M: Final = 6_378_137.0
_FLATTENING: Final = 1.0 / 298.257_223_563
#: Spacing of the points at which the line is integrated [m]; the spline between the points is accurate to 1e-6 m.
_STEP_M: Final = 0.5
#: Number of rounds of the integration; each round multiplies the error by (line length / Earth radius).
_ROUNDS: Final = 8

#: Elements of the simulated test line: length [m]; radius at the end of the element (right positive) [m]; cant at the
#: end of the element [m].
PATTERN: Final = (
    (90.0, np.inf, 0.0),
    (40.0, -160.0, 0.090),
    (120.0, -160.0, 0.090),
    (40.0, np.inf, 0.0),
    (60.0, np.inf, 0.0),
    (35.0, 300.0, 0.060),
    (110.0, 300.0, 0.060),
    (35.0, np.inf, 0.0),
    (226.0, np.inf, 0.0),
)
#: Gradients of the simulated test line: chainage [m] and gradient [permille]; linear between these chainages.
GRADIENT: Final = (
    (0.0, 0.0), (60.0, 0.0), (100.0, -4.0), (180.0, -4.0), (240.0, 10.0), (380.0, 10.0), (450.0, 2.5),
    (560.0, 2.5), (620.0, -6.0), (700.0, -6.0), (756.0, 0.0),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Alignment(Knots):
    """Continuous line of a scenario."""

    settings: LineSettings
    file: FileLine | None = None  #: Curve through the points of a track file, used instead of an integrated curve.

    @property
    def length_m(self) -> float:
        """Chainage of the end of the line; the line begins at chainage 0."""
        return float(self.knot_m[-1])

    def curvature_at(self, chainage_m: ArrayLike) -> Floats:
        """Return the curvature in plan [1/m], positive to the right."""
        return np.interp(np.asarray(chainage_m, dtype=np.float64), self.knot_m, self.curvature)

    def lean_at(self, chainage_m: ArrayLike) -> Floats:
        """Return the cant [m], positive where the vehicle leans to the right."""
        return np.interp(np.asarray(chainage_m, dtype=np.float64), self.knot_m, self.lean_m)

    def grade_at(self, chainage_m: ArrayLike) -> Floats:
        """Return the gradient [m/m]."""
        return np.interp(np.asarray(chainage_m, dtype=np.float64), self.grade_knot_m, self.grade)

    def kilometrage_at(self, chainage_m: ArrayLike) -> Floats:
        """Return the kilometrage at chainages [m]."""
        if self.file is not None:
            return interpolate_kilometrage(chainage_m, self.file.point_m, self.file.track.kilometrage_m)
        return np.asarray(np.asarray(chainage_m, dtype=np.float64) + self.settings.kilometrage_start_m)

    @cached_property
    def _curve(self) -> CubicHermiteSpline[np.float64]:
        if self.file is not None:
            return self.file.curve
        place, tangent = _integrate(self)
        chainage = np.linspace(0.0, self.length_m, len(place))
        return CubicHermiteSpline(chainage, place, tangent, axis=0)

    def at(self, chainage_m: ArrayLike) -> Floats:
        """Return points of the curve, shape (..., 3) ECEF [m]; beyond the ends, the curve is extrapolated."""
        return np.asarray(self._curve(np.asarray(chainage_m, dtype=np.float64)))

    def tangent_at(self, chainage_m: ArrayLike) -> Floats:
        """Return tangent vectors toward rising chainage, shape (..., 3); their length is 1 within 1e-6."""
        return np.asarray(self._curve(np.asarray(chainage_m, dtype=np.float64), 1))

    def point_beside(self, chainage_m: Floats, lateral_m: float, height_m: float) -> Floats:
        """Return points at lateral (right positive) and vertical offsets from the curve, shape (n, 3) ECEF [m].

        The lateral offset is horizontal and perpendicular to the curve.
        """
        place, tangent = self.at(chainage_m), self.tangent_at(chainage_m)
        up = axes_at(place)[:, 2]
        right = np.cross(tangent, up)
        right /= np.linalg.norm(right, axis=-1, keepdims=True)
        return np.asarray(place + lateral_m * right + height_m * up)

    def point_chainage_m(self) -> Floats:
        """Return the chainages of the points of the track map.

        The points are the ends of the elements and evenly spaced points between the ends. For a line from a track file,
        they are the points of the file.
        """
        if self.file is not None:
            return self.file.point_m
        points = [np.zeros(1)]
        for first, last, *bend in zip(
            self.knot_m[:-1], self.knot_m[1:], self.curvature[:-1], self.curvature[1:], strict=True
        ):
            spacing = self.settings.curve_spacing_m if np.any(bend) else self.settings.straight_spacing_m
            pieces = max(1, int(np.ceil((last - first) / spacing - 1e-9)))
            points.append(np.linspace(first, last, pieces + 1)[1:])
        return np.concatenate(points)

    def map_error_m(self, chainage_m: ArrayLike) -> Floats:
        """Return the offset of the map from the line, east, north and up, shape (..., 3) [m]."""
        error = self.settings.map_error
        rng = np.random.default_rng([error.seed, 12])
        sigmas = (error.plan_sigma_m, error.plan_sigma_m, error.height_sigma_m)
        offsets = [RandomFunction.smooth(rng, sigma=sigma, correlation=error.correlation_m) for sigma in sigmas]
        return np.stack([offset.at(chainage_m) for offset in offsets], axis=-1)

    def track(self) -> Track:
        """Return the track map: the points at `point_chainage_m` with their attributes, displaced by the map error."""
        chainage = self.point_chainage_m()
        ecef = self.at(chainage)
        exact = not (self.settings.map_error.plan_sigma_m or self.settings.map_error.height_sigma_m)
        if self.file is not None and exact:
            return self.file.track
        if not exact:
            ecef = ecef + np.einsum("ni,nij->nj", self.map_error_m(chainage), axes_at(ecef))
        place = geodetic_from_ecef(ecef)
        if self.file is not None:
            latitude, longitude, height = (read_only(part) for part in place)
            return replace(self.file.track, latitude_deg=latitude, longitude_deg=longitude, height_m=height)
        curvature = self.curvature_at(chainage)
        with np.errstate(divide="ignore"):
            radius = np.where(curvature == 0.0, np.inf, 1.0 / curvature)
        return Track.from_geodetic(
            *place,
            name=self.settings.name,
            kilometrage_m=self.kilometrage_at(chainage),
            cant_m=np.abs(self.lean_at(chainage)),
            radius_m=radius,
            gradient_permille=1e3 * self.grade_at(chainage),
        )


def build_alignment(settings: LineSettings) -> Alignment:
    """Return the line of a scenario.

    Raise SettingsError if the elements do not fit together, and InputFileError if the track file cannot be read, has
    too few points, or has a curve that is too sharp.
    """
    if settings.kind == "file":
        assert settings.file is not None
        line = line_of_file(settings.file)
        return Alignment(settings=settings, file=line, **vars(line.knots))
    if settings.kind == "elements":
        knots = knots_of_elements(settings.elements, settings.gradients)
    elif settings.kind == "generated":
        knots = generate_knots(settings)
    else:
        knots = _pattern_knots(settings.length_m)
    return Alignment(settings=settings, **vars(knots))


def _pattern_knots(length_m: float) -> Knots:
    """Return the knots of the simulated test line: `PATTERN` is repeated up to `length_m`, with every second copy
    mirrored.
    """
    repeats = int(np.ceil(length_m / PATTERN_LENGTH_M - 1e-12))
    lengths, radii, cants = (np.array(column) for column in zip(*PATTERN, strict=True))
    side = np.repeat(np.where(np.arange(repeats) % 2 == 0, 1.0, -1.0), len(lengths))
    knot = np.concatenate([[0.0], np.cumsum(np.tile(lengths, repeats))])
    curvature = np.concatenate([[0.0], side / np.tile(radii, repeats)])
    lean = np.concatenate([[0.0], side * np.tile(np.sign(radii) * cants, repeats)])
    place, permille = (np.array(column) for column in zip(*GRADIENT, strict=True))
    turn = np.where(np.arange(repeats) % 2 == 0, 1e-3, -1e-3)[:, None]
    grade_knot = (place[:-1] + PATTERN_LENGTH_M * np.arange(repeats)[:, None]).ravel()
    grade = (permille[:-1] * turn).ravel()
    inside = knot < length_m
    end = np.array([length_m])
    return Knots(
        knot_m=np.concatenate([knot[inside], end]),
        curvature=np.concatenate([curvature[inside], np.interp(end, knot, curvature)]),
        lean_m=np.concatenate([lean[inside], np.interp(end, knot, lean)]),
        grade_knot_m=np.append(grade_knot, PATTERN_LENGTH_M * repeats),
        grade=np.append(grade, 0.0),
    )


def _integrate(line: Alignment) -> tuple[Floats, Floats]:
    """Return ECEF points [m] and unit tangents of the curve at evenly spaced chainages, shapes (n, 3).

    Derivatives with respect to plan length: ``d azimuth = curvature + sin(latitude) d longitude`` (meridian
    convergence), ``d latitude = cos(azimuth) / (M + h)``, ``d longitude = sin(azimuth) / ((N + h) cos(latitude))``;
    derivative with respect to arc length: ``d height = sin(slope)``. The equations are integrated in several rounds by
    two-point Gauss quadrature.
    """
    cells = int(np.ceil(line.length_m / _STEP_M))
    step = line.length_m / cells
    edges = np.linspace(0.0, line.length_m, cells + 1)
    offset = np.array([0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0)]) * step
    gauss = edges[:-1, None] + offset
    settings = line.settings
    lat0, lon0 = np.radians([settings.latitude_deg, settings.longitude_deg])

    def total(rate: Floats) -> tuple[Floats, Floats]:
        """Integrate a rate, given at the Gauss points, up to the interval edges and up to the Gauss points."""
        at_edges = np.concatenate([[0.0], np.cumsum(rate.mean(axis=1) * step)])
        slope = (rate[:, 1] - rate[:, 0]) / (offset[1] - offset[0])
        start = rate[:, 0] - slope * offset[0]
        return at_edges, at_edges[:-1, None] + start[:, None] * offset + slope[:, None] * offset**2 / 2.0

    climb = np.sin(np.arctan(line.grade_at(gauss)))
    plan = np.cos(np.arctan(line.grade_at(gauss)))
    height_e, height = (settings.height_m + part for part in total(climb))
    turn_e, turn = total(line.curvature_at(gauss) * plan)
    latitude, convergence = np.full(gauss.shape, lat0), np.zeros(gauss.shape)
    e2 = _FLATTENING * (2.0 - _FLATTENING)
    for _ in range(_ROUNDS):
        azimuth = np.radians(settings.azimuth_deg) + turn + convergence
        w = np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
        north_rate = plan * np.cos(azimuth) / (_SEMI_MAJOR_M * (1.0 - e2) / w**3 + height)
        east_rate = plan * np.sin(azimuth) / ((_SEMI_MAJOR_M / w + height) * np.cos(latitude))
        convergence_e, convergence = total(east_rate * np.sin(latitude))
        latitude_e, latitude = (lat0 + part for part in total(north_rate))
        longitude_e = lon0 + total(east_rate)[0]
    azimuth_e = np.radians(settings.azimuth_deg) + turn_e + convergence_e
    lat_deg, lon_deg = np.degrees(latitude_e), np.degrees(longitude_e)
    slope_e = np.arctan(line.grade_at(edges))
    local = np.stack([np.cos(slope_e) * np.sin(azimuth_e), np.cos(slope_e) * np.cos(azimuth_e), np.sin(slope_e)], -1)
    tangent = np.einsum("nij,ni->nj", enu_axes(lat_deg, lon_deg), local)
    return ecef_from_geodetic(lat_deg, lon_deg, height_e), tangent

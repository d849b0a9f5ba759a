"""Transition curves in plan that are defined by their offsets from the tangent: cubic parabolas and the half-sine.

The abscissa x is measured along the tangent from the straight end, and the ordinate y is the offset from the tangent. X
is the length projected on the tangent, and R is the radius at the curved end:

- The cubic parabola ``y = x^3 / (6 R X)`` is used by many railways. IFC defines ``y = x^3 / (6 R L)`` with the length L
  of the curve.
- The corrected parabola of Japanese railways is ``y = x^3 (1 + (X / 2R)^2)^1.5 / (6 R X)``. The curvature at the end of
  this parabola is 1/R within half a percent.
- The half-sine of the Shinkansen is ``y = X^2 / R ((x/X)^2 / 4 - (1 - cos(pi x/X)) / (2 pi^2))``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats

Shape = Literal["cubic", "half-sine"]
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
#: Number of intervals for the numerical integration of the length. With 12 nodes in each interval, the length is exact
#: except for rounding errors.
_PIECES: Final = 16
_ROUNDS: Final = 30  #: Number of fixed-point iterations for the length X; ten are enough to converge.
_HALF_SINE_END: Final = 0.25 - 1.0 / np.pi**2  #: Value of y R / X^2 at the end of a half-sine.


@dataclass(frozen=True, kw_only=True)
class OrdinateElement:
    """Transition between straight and curve, defined by offsets from the tangent at the straight end."""

    x_m: float  #: Easting of the first point.
    y_m: float  #: Northing of the first point.
    direction_rad: float  #: Direction at the first point, counter-clockwise from the x axis (east).
    tangent_m: float  #: Length X projected on the tangent.
    ordinate_m: float  #: Ordinate at X, positive to the left of the tangent, seen from the straight end.
    shape: Shape = "cubic"
    into: bool = True  #: Whether the first point is the straight end.

    def _ordinates(self, x: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the ordinates y [m] at abscissae x [m], and the derivatives dy/dx and d2y/dx2."""
        share, end, size = x / self.tangent_m, self.ordinate_m, self.tangent_m
        if self.shape == "cubic":
            return end * share**3, 3.0 * end / size * share**2, 6.0 * end / size**2 * share
        scale, turn = end / _HALF_SINE_END, np.pi * share
        return (
            scale * (share**2 / 4.0 - (1.0 - np.cos(turn)) / (2.0 * np.pi**2)),
            scale / size * (share / 2.0 - np.sin(turn) / (2.0 * np.pi)),
            scale / size**2 * (1.0 - np.cos(turn)) / 2.0,
        )

    @cached_property
    def _knots(self) -> tuple[Floats, Floats]:
        """Limits of the intervals, as abscissae on the tangent, and the curve length up to each limit [m]."""
        x = np.linspace(0.0, self.tangent_m, _PIECES + 1)
        return x, np.concatenate([[0.0], np.cumsum(self._length_between(x[:-1], x[1:]))])

    def _length_between(self, start: Floats, end: Floats) -> Floats:
        half = (end - start)[:, None] / 2.0
        slope = self._ordinates(start[:, None] + half * (1.0 + _NODES))[1]
        return np.asarray((half * _WEIGHTS * np.hypot(1.0, slope)).sum(axis=1))

    @property
    def length_m(self) -> float:
        """Length of the curve [m]."""
        return float(self._knots[1][-1])

    def _place_on_tangent(self, way_m: Floats) -> Floats:
        """Return the abscissae on the tangent [m] at distances along the curve from the first point [m]."""
        x, length = self._knots
        target = way_m if self.into else length[-1] - way_m
        piece = np.clip(np.searchsorted(length, target, side="right") - 1, 0, _PIECES - 1)
        place = np.interp(target, length, x)
        for _ in range(4):  # Newton iterations
            rest = length[piece] + self._length_between(x[piece], place) - target
            place = place - rest / np.hypot(1.0, self._ordinates(place)[1])
        return np.asarray(place)

    @property
    def turn_rad(self) -> float:
        """Direction at the curved end minus direction at the straight end, positive to the left [rad]."""
        return float(np.arctan(self._ordinates(np.array([self.tangent_m]))[1][0]))

    @property
    def first(self) -> float:
        """Curvature at the first point, positive to the left [1/m]."""
        return float(self.curvature_at(np.zeros(1))[0])

    @property
    def last(self) -> float:
        """Curvature at the last point, positive to the left [1/m]."""
        return float(self.curvature_at(np.array([self.length_m]))[0])

    def curvature_at(self, way_m: Floats) -> Floats:
        """Return the curvature, positive to the left [1/m], at distances along the curve from the first point [m]."""
        _, slope, second = self._ordinates(self._place_on_tangent(way_m))
        curvature = second / np.hypot(1.0, slope) ** 3
        return np.asarray(curvature if self.into else -curvature)

    def place_at(self, way_m: Floats) -> Floats:
        """Return the easting and northing, shape (n, 2) [m], at distances along the curve from the first point [m]."""
        x = self._place_on_tangent(way_m)
        own = np.stack([x, self._ordinates(x)[0]], axis=-1)
        if not self.into:  # a transition from curve to straight is the same curve, travelled from the curved end
            cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
            own = (np.array([self.tangent_m, self.ordinate_m]) - own) @ np.array([[cosine, -sine], [sine, cosine]])
        cosine, sine = np.cos(self.direction_rad), np.sin(self.direction_rad)
        return np.asarray(np.array([self.x_m, self.y_m]) + own @ np.array([[cosine, sine], [-sine, cosine]]))


def cubic_of_length(
    *, x_m: float, y_m: float, direction_rad: float, first: float, last: float, length_m: float, variant: str
) -> OrdinateElement:
    """Compute a cubic parabola of a given curve length.

    `first` and `last` are the curvatures at the ends, positive to the left [1/m]; one of them is 0. The variant is
    ``"length"`` (IFC), ``"tangent"`` (length on the tangent) or ``"corrected"`` (Japanese railways).
    """
    into = first == 0.0
    curvature = last if into else -first
    tangent = length_m
    for _ in range(_ROUNDS):
        coefficient = curvature / (6.0 * (length_m if variant == "length" else tangent))
        if variant == "corrected":
            coefficient *= (1.0 + (curvature * tangent / 2.0) ** 2) ** 1.5
        element = OrdinateElement(
            x_m=x_m,
            y_m=y_m,
            direction_rad=direction_rad,
            tangent_m=tangent,
            ordinate_m=coefficient * tangent**3,
            into=into,
        )
        tangent *= length_m / element.length_m
    return element

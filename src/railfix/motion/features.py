"""Positions from changes of gradient and curvature (P2 2.3): features of a map, and matching of a measured feature.

P2 uses the points of change, not the values, so that slow biases have no effect. A position is accepted where its
distance to the earlier features agrees, the other quantity fits, and no other position explains the measurement nearly
as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats
from railfix.track.trajectory import Trajectory

#: Quantities of a feature.
Quantity = Literal["gradient", "curvature"]
QUANTITIES: Final[tuple[Quantity, ...]] = ("gradient", "curvature")

#: Least change: 3 permille, and from straight to a radius of 1000 m.
_GRADIENT_CHANGE: Final = 0.003
_CURVATURE_CHANGE_1PM: Final = 1e-3
_LIKELIHOOD_RATIO: Final = 1e3  #: Distance of the accepted position to any other position in the window.
_GAP_SIGMAS: Final = 3.0  #: Disagreement with the distance to the last accepted feature.
_FIT_LIMIT: Final = 3.0  #: Mean square of the other quantity's residual over its variance.
SCALE_SIGMA: Final = 2e-3  #: Error of a distance by wheel, as a fraction.
STEP_M: Final = 1.0  #: Spacing of the series along the line.
HALF_LENGTH_M: Final = 60.0  #: Length of line before and behind a feature that is compared.
#: A change of less than this fraction of another within `HALF_LENGTH_M` is the ripple of a curve through sparse points.
_RIPPLE: Final = 0.2
#: Length over which a change is computed: about the distance of a vehicle's bogies, which smooths shorter changes.
BASE_M: Final = 15.0


@dataclass(frozen=True, kw_only=True)
class LineSeries:
    """Gradient and curvature along a line, at N points `STEP_M` apart."""

    arc_m: Floats  #: Shape (N,).
    gradient: Floats  #: Climb over horizontal length in rising arc length, shape (N,).
    curvature_1pm: Floats  #: + to the right in rising arc length, shape (N,).

    def of(self, quantity: Quantity) -> Floats:
        """Return the values of one quantity."""
        return self.gradient if quantity == "gradient" else self.curvature_1pm


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A change of gradient or curvature."""

    arc_m: float
    quantity: Quantity
    change: float


def line_series(trajectory: Trajectory) -> LineSeries:
    """Return gradient and curvature of a trajectory over chords of `BASE_M`, as for a vehicle on two bogies."""
    half = 0.5 * BASE_M
    arc = np.arange(half, float(trajectory.arc_m[-1]) - half, STEP_M)
    front, rear = trajectory.at_arc(arc + half), trajectory.at_arc(arc - half)
    index = trajectory.segment_at(arc)[0]
    chord = front - rear
    up = trajectory.up[index]
    climb = (chord * up).sum(axis=1)
    flat = chord - climb[:, None] * up
    gradient = climb / np.linalg.norm(flat, axis=1)
    ahead = flat[1:] / np.linalg.norm(flat[1:], axis=1, keepdims=True)
    behind = flat[:-1] / np.linalg.norm(flat[:-1], axis=1, keepdims=True)
    turn = -(np.cross(behind, ahead) * up[1:]).sum(axis=1) / STEP_M
    # each change of direction belongs to the middle of its step
    curvature = np.concatenate([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]])
    return LineSeries(arc_m=arc, gradient=gradient, curvature_1pm=curvature)


def map_features(series: LineSeries, *, least: Mapping[Quantity, Floats] | None = None) -> list[Feature]:
    """Return the features of a line in order: where gradient or curvature change most within `BASE_M`, the middle of a
    change that is longer.

    `least`, by quantity, shape (N,), of a measured line: a change must also exceed the root sum of squares of both
    sides.
    """
    reach, around_steps = 2 * max(round(BASE_M / STEP_M), 1), round(HALF_LENGTH_M / STEP_M)
    found: list[Feature] = []
    smallest: dict[Quantity, float] = {"gradient": _GRADIENT_CHANGE, "curvature": _CURVATURE_CHANGE_1PM}
    for quantity, limit in smallest.items():
        change = series.of(quantity)[reach:] - series.of(quantity)[:-reach]
        size = np.abs(change)
        if least is not None:
            size[size < np.hypot(least[quantity][reach:], least[quantity][:-reach])] = 0.0
        while len(size) and size.max() >= limit:
            k = int(np.argmax(size))
            # a change that is longer lies in the middle of where it is half as large
            less = np.flatnonzero(np.where(change * change[k] > 0.0, size, 0.0) < 0.5 * size[k])
            first, end = int(np.max(less[less < k], initial=-1)) + 1, int(np.min(less[less > k], initial=len(size)))
            arc = 0.5 * float(series.arc_m[first] + series.arc_m[end - 1 + reach])
            found.append(Feature(arc_m=arc, quantity=quantity, change=float(change[k])))
            size[max(first - reach // 2, 0) : end + reach // 2] = 0.0
            around = size[max(first - around_steps, 0) : end + around_steps]
            around[around < _RIPPLE * abs(change[k])] = 0.0
    return sorted(found, key=lambda feature: feature.arc_m)


@dataclass(frozen=True, kw_only=True)
class LocatedFeature:
    """Position of a measured series on the line."""

    verdict: Literal["accepted", "ambiguous", "none"]
    arc_m: float  #: Position of the middle of the series; NaN unless accepted.
    sigma_m: float  #: ``sqrt(S / integral (dq/ds)^2 ds)`` with the noise density S of the measured quantity.
    reason: str = ""  #: Reason for rejection.


def locate(
    measured: LineSeries,
    line: LineSeries,
    predicted_m: float,
    sigma_m: float,
    *,
    quantity: Quantity,
    noise: tuple[float, float],
    last: tuple[float, float, float] | None = None,
) -> LocatedFeature:
    """Return the position of a measured stretch by maximum likelihood within four sigmas of the predicted one.

    A constant offset of the quantity is free: a bias of the sensor does not matter.

    Parameters
    ----------
    measured : LineSeries
        Over travelled distance in rising arc length, `arc_m` about the predicted position (0 in its middle).
    line : LineSeries
    predicted_m, sigma_m : float [m]
        A-priori arc length of the middle of the stretch.
    quantity : {"gradient", "curvature"}
        Quantity that is matched; the other quantity must fit there.
    noise : tuple of float
        Standard deviations of the two quantities in one step.
    last : tuple of float, optional
        Position of the last accepted feature, its sigma, and the distance by wheel since then [m].
    """
    offsets = np.arange(-4.0 * sigma_m, 4.0 * sigma_m + STEP_M, 0.25 * STEP_M)
    at = predicted_m + offsets[:, None] + measured.arc_m
    expected = np.interp(at, line.arc_m, line.of(quantity))
    residual = measured.of(quantity) - expected
    residual = residual - residual.mean(axis=1, keepdims=True)
    spread = noise[QUANTITIES.index(quantity)]
    likelihood = -0.5 * (residual**2).sum(axis=1) / spread**2
    slope = np.gradient(expected[int(np.argmax(likelihood))], STEP_M)
    information = float(((slope - slope.mean()) ** 2).sum()) / spread**2
    best = int(np.argmax(likelihood))
    if information < 16.0 / sigma_m**2:
        return _unplaced("none", np.nan, "no change sharper than the prediction")
    sigma = float(1.0 / np.sqrt(information))
    place = predicted_m + float(offsets[best]) + _vertex(likelihood, best) * 0.25 * STEP_M
    apart = np.abs(offsets - offsets[best]) > max(5.0 * sigma, 2.0 * STEP_M)
    if best in (0, len(offsets) - 1):
        return _unplaced("ambiguous", sigma, "best at the edge of the window")
    if apart.any() and likelihood[best] - likelihood[apart].max() < np.log(_LIKELIHOOD_RATIO):
        return _unplaced("ambiguous", sigma, "another place fits nearly as well")
    other: Quantity = QUANTITIES[1 - QUANTITIES.index(quantity)]
    rest = measured.of(other) - np.interp(place + measured.arc_m, line.arc_m, line.of(other))
    misfit = float(((rest - rest.mean()) ** 2).mean()) / noise[QUANTITIES.index(other)] ** 2
    if misfit > _FIT_LIMIT:
        return _unplaced("none", sigma, f"the {other} does not fit there")
    if last is not None:
        gap = place - last[0]
        allowed = _GAP_SIGMAS * np.sqrt(sigma**2 + last[1] ** 2 + (SCALE_SIGMA * last[2]) ** 2)
        if abs(gap - last[2]) > allowed:
            return _unplaced("none", sigma, "distance to the last feature disagrees")
    return LocatedFeature(verdict="accepted", arc_m=place, sigma_m=sigma)


def _unplaced(verdict: Literal["ambiguous", "none"], sigma_m: float, reason: str) -> LocatedFeature:
    return LocatedFeature(verdict=verdict, arc_m=np.nan, sigma_m=sigma_m, reason=reason)


def _vertex(values: Floats, best: int) -> float:
    """Return the offset in steps of the vertex of the parabola through a maximum and its neighbours."""
    if best in (0, len(values) - 1):
        return 0.0
    left, middle, right = values[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    return 0.0 if bend == 0.0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))

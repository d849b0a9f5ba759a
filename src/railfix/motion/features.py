"""Positions from changes of gradient and curvature (P2 2.3): features of a map, and matching of measured features.

P2 uses the positions at which gradient and curvature change, instead of their values, so that slow sensor biases have
no effect. A position from one quantity is accepted under three conditions: the other quantity agrees with the map, no
other position fits nearly as well, and the wheel distance since the last feature agrees with the map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats
from railfix.track.trajectory import Trajectory

#: Quantity whose change is a feature.
Quantity = Literal["gradient", "curvature"]
QUANTITIES: Final[tuple[Quantity, ...]] = ("gradient", "curvature")

_GRADIENT_CHANGE: Final = 0.003  #: Smallest change of gradient that counts as a feature.
#: Smallest change of curvature that counts as a feature [1/m]: from straight track to a radius of 1000 m.
_CURVATURE_CHANGE_1PM: Final = 1e-3
#: Smallest likelihood ratio of an accepted position to any other position in the search window.
_LIKELIHOOD_RATIO: Final = 1e3
_GAP_SIGMAS: Final = 3.0  #: Largest accepted difference of map and wheel distance since the last feature [sigma].
_FIT_LIMIT: Final = 3.0  #: Largest accepted mean squared residual of the second quantity, in noise variances.
SCALE_SIGMA: Final = 2e-3  #: Relative standard deviation of a distance from wheel pulses.
STEP_M: Final = 1.0  #: Spacing of the series along the line.
HALF_LENGTH_M: Final = 60.0  #: Length of the line compared before a feature, and after it.
#: Changes below this fraction of a larger change within `HALF_LENGTH_M` are ignored, because the curvature of a line
#: through sparse points has ripples.
_RIPPLE: Final = 0.2
#: Length over which a change is computed: about the distance between a vehicle's bogies, which smooth shorter changes.
BASE_M: Final = 15.0


@dataclass(frozen=True, kw_only=True)
class LineSeries:
    """Gradient and curvature at N points along a line, `STEP_M` apart."""

    arc_m: Floats  #: Arc length of the points, shape (N,).
    gradient: Floats  #: Height change per horizontal length, positive if the line climbs, shape (N,).
    curvature_1pm: Floats  #: Curvature, positive to the right in the direction of rising arc length; shape (N,).

    def of(self, quantity: Quantity) -> Floats:
        """Return the values of the given quantity."""
        return self.gradient if quantity == "gradient" else self.curvature_1pm


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A change of gradient or curvature."""

    arc_m: float
    quantity: Quantity
    change: float


def line_series(trajectory: Trajectory) -> LineSeries:
    """Compute gradient and curvature of a trajectory over chords of the length `BASE_M`, like a car on two bogies that
    are `BASE_M` apart.
    """
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
    # the change of direction over a step is valid at the middle of the step
    curvature = np.concatenate([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]])
    return LineSeries(arc_m=arc, gradient=gradient, curvature_1pm=curvature)


def map_features(series: LineSeries, *, least: Mapping[Quantity, Floats] | None = None) -> list[Feature]:
    """Find the largest changes of gradient and of curvature over `BASE_M`, in the order of their arc lengths.

    The position of a feature is the middle of its change. For a measured line, `least` has, for each quantity, a bound
    at each point, shape (N,). A change is then ignored if it is below the root sum of squares of the bounds at its two
    ends.
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
            # the change extends over the stretch where it has at least half of its maximum
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
    arc_m: float  #: Arc length of the middle of the series; NaN if not accepted.
    #: Standard deviation ``sqrt(S / integral (dq/ds)^2 ds)`` with the noise density S of the measured quantity q; NaN
    #: if the series does not determine the position better than the prediction.
    sigma_m: float
    reason: str = ""  #: Why the position is not accepted; empty if accepted.


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
    """Estimate the position of a measured series by maximum likelihood, within four sigmas of the predicted position.

    A constant offset of the quantity is also estimated, so that a bias of the sensor has no effect.

    Parameters
    ----------
    measured : LineSeries
        Measured series over the distance travelled, in the direction of rising arc length; `arc_m` is 0 at its middle.
    line : LineSeries
        Series of the map.
    predicted_m, sigma_m : float [m]
        Predicted arc length of the middle of the series, and its standard deviation.
    quantity : {"gradient", "curvature"}
        Quantity that is matched. The second quantity must agree with the map at the estimated position.
    noise : tuple of float
        Standard deviations of the gradient and of the curvature [1/m] at each point of the series.
    last : tuple of float, optional
        Arc length of the last accepted feature, its sigma, and the wheel distance travelled since that feature [m].

    Returns
    -------
    LocatedFeature
        The verdict is "ambiguous" if another position fits nearly as well, or if the best fit is at the edge of the
        search window. The verdict is "none" if the series has no sharp change, or if the second quantity or `last`
        contradicts the position.
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
        return _unplaced("none", np.nan, "no change is sharp enough to improve the prediction")
    sigma = float(1.0 / np.sqrt(information))
    place = predicted_m + float(offsets[best]) + _vertex(likelihood, best) * 0.25 * STEP_M
    apart = np.abs(offsets - offsets[best]) > max(5.0 * sigma, 2.0 * STEP_M)
    if best in (0, len(offsets) - 1):
        return _unplaced("ambiguous", sigma, "best fit at the edge of the search window")
    if apart.any() and likelihood[best] - likelihood[apart].max() < np.log(_LIKELIHOOD_RATIO):
        return _unplaced("ambiguous", sigma, "another position fits nearly as well")
    other: Quantity = QUANTITIES[1 - QUANTITIES.index(quantity)]
    rest = measured.of(other) - np.interp(place + measured.arc_m, line.arc_m, line.of(other))
    misfit = float(((rest - rest.mean()) ** 2).mean()) / noise[QUANTITIES.index(other)] ** 2
    if misfit > _FIT_LIMIT:
        return _unplaced("none", sigma, f"the {other} does not agree with the map at this position")
    if last is not None:
        gap = place - last[0]
        allowed = _GAP_SIGMAS * np.sqrt(sigma**2 + last[1] ** 2 + (SCALE_SIGMA * last[2]) ** 2)
        if abs(gap - last[2]) > allowed:
            return _unplaced("none", sigma, "distance from the last feature disagrees with the wheel distance")
    return LocatedFeature(verdict="accepted", arc_m=place, sigma_m=sigma)


def _unplaced(verdict: Literal["ambiguous", "none"], sigma_m: float, reason: str) -> LocatedFeature:
    return LocatedFeature(verdict=verdict, arc_m=np.nan, sigma_m=sigma_m, reason=reason)


def _vertex(values: Floats, best: int) -> float:
    """Return the offset from a maximum to the vertex of the parabola through it and its two neighbours, in steps."""
    if best in (0, len(values) - 1):
        return 0.0
    left, middle, right = values[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    return 0.0 if bend == 0.0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))

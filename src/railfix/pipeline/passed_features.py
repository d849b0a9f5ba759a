"""Rates of the vehicle body, and the interface of the search for features of the line that the body has passed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.core.timescale import seconds
from railfix.track.trajectory import Trajectory

#: The body's rates are used only above this speed [m/s].
SLOWEST_MPS: Final = 1.0


def ahead_m(trajectory: Trajectory) -> float:
    """Return the chainage of an antenna minus the chainage of the vehicle's middle [m]; 0 without a vehicle."""
    if trajectory.body_chainage_m is None:
        return 0.0
    return float(np.median(trajectory.chainage_m - trajectory.body_chainage_m))


@dataclass(frozen=True, kw_only=True)
class RateSeries:
    """Changes of the body's heading and pitch, wheel distances and speeds at K sample times (ticks)."""

    time: Datetimes  #: Times at which the rates are valid, shape (K,).
    known: Datetimes  #: Times at which the rates became known, shape (K,).
    distance_m: Floats  #: Wheel distance since the tick before tick 0, positive toward rising arc length; (K,).
    arc_m: Floats  #: Antenna position by dead reckoning with the wheel, shape (K,); NaN if unknown.
    turned_rad: Floats  #: Change of heading since the previous tick, positive if it turns right; shape (K,).
    climbed_rad: Floats  #: Change of pitch since the previous tick, positive with the nose up; shape (K,).
    speed_mps: Floats  #: Speed, positive toward rising arc length, shape (K,).
    rolls: Masks  #: True where the wheel rolls without slip, shape (K,).

    def arc_at(self, time: Datetimes) -> Floats:
        """Return antenna positions at times after the first tick, extrapolated from the preceding tick [m]."""
        last = np.maximum(np.searchsorted(self.time, time, side="right") - 1, 0)
        since = seconds(time - self.time[last])
        return np.asarray(self.arc_m[last] + np.nan_to_num(self.speed_mps[last]) * since)


@dataclass(frozen=True, kw_only=True)
class FeatureState:
    """State of the feature search after a chunk."""

    distance_m: float = 0.0  #: Wheel distance at the last tick.
    angles: tuple[float, float] = (0.0, 0.0)  #: Heading and pitch at the last tick, from an arbitrary origin [rad].
    #: Whole metres of wheel distance passed since the last break, in the order of travel; shape (M,).
    metre: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    heading_rad: Floats = field(default_factory=lambda: np.empty(0))  #: Heading at each metre, shape (M,).
    pitch_rad: Floats = field(default_factory=lambda: np.empty(0))  #: Pitch at each metre, shape (M,).
    #: Position and sigma of the last accepted feature, and wheel distance there [m]; None before the first feature.
    last: tuple[float, float, float] | None = None
    done_m: float = float("nan")  #: Features up to this position have been compared; NaN at the start.


class PassedFeature(NamedTuple):
    """Position measured with a feature of the line that the train has passed."""

    tick: int  #: Index of the tick at which the feature was compared, after the body's middle had passed it.
    correction_m: float  #: Measured position minus wheel position.
    #: Standard deviation of the position, including errors of the map and of the body's position on the bogies.
    sigma_m: float


class FeatureSearch(Protocol):
    """Search for features of a line, such as curves (`railfix.pipeline.feature_fixes.TrackFeatures`)."""

    def locate(
        self, rates: RateSeries, facing: float, sigma_m: float, state: FeatureState, *, noise: tuple[float, float]
    ) -> tuple[tuple[PassedFeature, ...], FeatureState]:
        """Return the features that the train has passed, and the state for the next chunk.

        `facing` is 1 if the front points to rising arc length, else -1; `sigma_m` is the standard deviation of the
        wheel position; `noise` has the standard deviations of gradient and curvature over one metre.
        """

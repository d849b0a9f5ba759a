"""Test of the order of two antennas of one vehicle by their positions.

Each antenna is positioned on its own trajectory, with its own offset from the vehicle. If the two logs are swapped, or
if the vehicle faces the other way, each position still fits the ranges of its log. The front antenna then appears
behind the rear antenna instead of ahead of it, at the same distance.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Datetimes
from railfix.screens.pairs import pair_epochs
from railfix.track.trajectory import Trajectory

#: Length of a stretch of the line [m]. The pairs of positions on one stretch count as one sample, because the same
#: reflections affect all of them.
_STRETCH_M: Final = 50.0
#: The order is judged only with pairs on at least this number of stretches, so not while the train is at rest.
_LEAST_STRETCHES: Final = 4
#: The antennas are in the wrong order if the front antenna is behind the rear antenna by more than this number of
#: sigmas.
_CERTAIN: Final = 5.0
#: The order is tested if the antenna distance is at least this [m].
_LEAST_DISTANCE_M: Final = 0.5


class AntennaOrder:
    """Mean distance by which the front antenna is ahead of the rear antenna, from positions on the same track.

    `distance_m` is the distance by which the front antenna is ahead according to the vehicle file [m]. Epochs of the
    two antennas are paired if their time tags differ by at most `tolerance_s`.
    """

    def __init__(self, front: Trajectory, rear: Trajectory, *, tolerance_s: float) -> None:
        paths = front, rear
        begin, end = (float(of([float(t.body_at(t.arc_m[k])) for t in paths])) for of, k in ((max, 0), (min, -1)))
        arcs = [t.arc_of_body(np.linspace(begin, end, 21)[1:-1]) for t in paths]
        along = front.at_arc(arcs[0]) - rear.at_arc(arcs[1])
        ahead = front.at_arc(arcs[0] + 1.0) - front.at_arc(arcs[0])
        rising = float(np.median(np.einsum("ni,ni->n", along, ahead)))
        apart = float(np.median(front.chainage_at(arcs[0]) - rear.chainage_at(arcs[1])))
        self._facing = front.front_sign
        self.distance_m = self._facing * rising
        self._reference_m = apart - rising  # nonzero if both chainages refer to the same point of the vehicle
        self._tolerance_s = tolerance_s
        #: For each stretch: number of pairs, sum of distances [m], sum of variances [m^2].
        self._stretches: dict[int, tuple[float, float, float]] = {}

    @classmethod
    def between(cls, trajectories: Mapping[str, Trajectory], *, tolerance_s: float) -> AntennaOrder | None:
        """Return a new test, or None if `trajectories` lacks the paths of two antennas of one vehicle."""
        if len(trajectories) < 2 or any(t.body_chainage_m is None for t in trajectories.values()):
            return None
        return cls(trajectories["front"], trajectories["rear"], tolerance_s=tolerance_s)

    def add(self, front: tuple[Datetimes, ArrayLike, ArrayLike], rear: tuple[Datetimes, ArrayLike, ArrayLike]) -> bool:
        """Add the positions of more epochs; return whether any of them is on a new stretch.

        `front` has time tags, chainages [m] and sigmas [m], shape (F,) each, NaN without a position; `rear` has the
        same values, shape (R,) each.
        """
        at_front, at_rear = pair_epochs(front[0], rear[0], tolerance_s=self._tolerance_s)
        (place, other), (sigma, other_sigma) = (
            (np.asarray(front[k], dtype=np.float64)[at_front], np.asarray(rear[k], dtype=np.float64)[at_rear])
            for k in (1, 2)
        )
        measured = self._facing * (place - other - self._reference_m)
        variance = sigma**2 + other_sigma**2
        known = np.isfinite(measured) & np.isfinite(variance)
        # a gross error is clipped to three times the distance between the antennas
        bound = 3.0 * abs(self.distance_m)
        measured, variance = np.clip(measured[known], -bound, bound), variance[known]
        stretch, which = np.unique(np.floor(place[known] / _STRETCH_M).astype(np.int64), return_inverse=True)
        seen = len(self._stretches)
        sums = (np.bincount(which, weights=part) for part in (np.ones(len(which)), measured, variance))
        for key, *more in zip(stretch.tolist(), *(part.tolist() for part in sums), strict=True):
            before = self._stretches.get(key, (0.0, 0.0, 0.0))
            self._stretches[key] = (before[0] + more[0], before[1] + more[1], before[2] + more[2])
        return len(self._stretches) > seen

    def measure(self) -> tuple[float, float]:
        """Return the mean distance by which the front antenna is ahead of the rear antenna, and the mean's sigma [m].

        The mean distance on a stretch has the variance of a single pair, because position errors on a stretch do not
        average out. If the stretches scatter more than their variances explain, the sigma is larger. With fewer than
        four stretches, both values are NaN.
        """
        if len(self._stretches) < _LEAST_STRETCHES:
            return float("nan"), float("nan")
        count, distance, variance = np.array(list(self._stretches.values())).T
        mean, weight = distance / count, count / variance
        overall = float(np.average(mean, weights=weight))
        scatter = float(np.sum(weight * (mean - overall) ** 2)) / (len(mean) - 1)
        return overall, float(np.sqrt(max(1.0, scatter) / weight.sum()))

    @property
    def note(self) -> str | None:
        """Return a sentence on antennas in the wrong order; None if the order is correct or uncertain."""
        mean, sigma = self.measure()
        right = abs(self.distance_m)
        ahead = float(np.sign(self.distance_m)) * mean
        exchanged = right >= _LEAST_DISTANCE_M and -2.0 * right < ahead < -_CERTAIN * sigma
        if not exchanged:
            return None
        first, second = ("front", "rear") if self.distance_m > 0.0 else ("rear", "front")
        return (
            f"according to the vehicle file, the positions of the {first} log should be {right:.1f} m ahead of those "
            f"of the {second} log, but they are {-ahead:.1f} m (sigma {sigma:.1f} m) behind; either the logs are "
            "swapped (--front, --rear), or the vehicle faces the other way (facing)"
        )

"""Common epochs and channels of two antennas on one vehicle, and base classes of screens that compare two antennas."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Datetimes, Floats, Indices, Strings
from railfix.core.nearest_times import nearest_rows
from railfix.core.reasons import Status
from railfix.ranges.corrected import AntennaRanges
from railfix.screens.base import Limits, Screen, Screened, ScreenSetup, Verdict
from railfix.track.trajectory import Trajectory


def pair_epochs(time_front: ArrayLike, time_rear: ArrayLike, *, tolerance_s: float) -> tuple[Indices, Indices]:
    """Return the indices of epochs of two receivers with time tags that differ by at most `tolerance_s`.

    The time tags must ascend. Two epochs are a pair if each is the nearest to the other, so that no epoch belongs to
    two pairs.
    """
    within_ns = round(tolerance_s * 1e9)
    to_rear = nearest_rows(time_rear, time_front, within_ns=within_ns)
    to_front = nearest_rows(time_front, time_rear, within_ns=within_ns)
    index = (to_rear >= 0).nonzero()[0]
    index = index[to_front[to_rear[index]] == index]
    return index, to_rear[index]


def pair_channels(
    satellite_front: Strings, signal_front: Strings, satellite_rear: Strings, signal_rear: Strings
) -> tuple[Indices, Indices]:
    """Return the front and rear indices of channels with equal satellite and signal, in the front receiver's order."""
    # the same arrays mean equal channels
    if satellite_front is satellite_rear and signal_front is signal_rear:
        every = np.arange(len(satellite_front))
        return every, every
    rear = {key: m for m, key in enumerate(zip(satellite_rear.tolist(), signal_rear.tolist(), strict=True))}
    keys = enumerate(zip(satellite_front.tolist(), signal_front.tolist(), strict=True))
    pairs = [(m, rear[key]) for m, key in keys if key in rear]
    both = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def on_pairs(screened: Screened, shape: tuple[int, ...], epochs: Indices, channels: Indices) -> Screened:
    """Expand a verdict on pairs to one antenna's epochs and channels; the metric is NaN outside the pairs."""
    metric, reject = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    where = (epochs[:, None], channels) if len(shape) > 1 else epochs
    metric[where], reject[where] = screened.metric, screened.reject
    limit = screened.limit
    if isinstance(limit, np.ndarray):
        limit = np.full(shape, np.nan)
        limit[where] = screened.limit
    return Screened(metric=metric, reject=reject, limit=limit)


def pair_antennas(
    front_time: Datetimes,
    rear_time: Datetimes,
    front_arc_m: Floats,
    front_path: Trajectory,
    rear_path: Trajectory,
    *,
    tolerance_s: float,
) -> PairedEpochs:
    """Match the epochs of two antennas by their time tags, and compute the positions of both antennas on the line.

    `front_arc_m` is the approximate arc length of the front antenna, shape (T,) [m]. The position of the rear antenna
    follows from the geometry of the vehicle.
    """
    at_front, at_rear = pair_epochs(front_time, rear_time, tolerance_s=tolerance_s)
    front_arc = front_arc_m[at_front]
    rear_arc = rear_path.arc_of_body(front_path.body_at(front_arc))
    return PairedEpochs(
        front_epoch=at_front, rear_epoch=at_rear, front_ecef_m=front_path.at_arc(front_arc),
        rear_ecef_m=rear_path.at_arc(rear_arc),
        along_m=front_path.chainage_at(front_arc) - rear_path.chainage_at(rear_arc),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PairedEpochs:
    """P common epochs of two antennas of one vehicle."""

    #: For each antenna, indices of its paired epochs, shape (P,).
    front_epoch: Indices
    rear_epoch: Indices
    #: Approximate positions of the antennas on their trajectories, shape (P, 3).
    front_ecef_m: Floats
    rear_ecef_m: Floats
    #: Front antenna's chainage minus rear antenna's; negative if the vehicle faces falling chainage; shape (P,).
    along_m: Floats


class _OfTwoAntennas(Screen[Limits]):
    """Screen that needs two antennas of one vehicle."""

    needs = "two antennas, and a vehicle file with their positions"

    def unable(self, limits: Limits, setup: ScreenSetup) -> bool:
        """Return whether the run lacks two antennas with a known spacing."""
        return setup.antennas < 2 or not setup.spacing_known


class PairScreen(_OfTwoAntennas[Limits]):
    """Screen of the observations of two antennas of one vehicle."""

    @abstractmethod
    def judge(
        self, front: AntennaRanges, rear: AntennaRanges, pair: PairedEpochs, limits: Limits
    ) -> Mapping[str, tuple[Verdict, ...]]:
        """Return the verdicts on a chunk for each antenna, "front" and "rear"."""


class FilteredMotion(NamedTuple):
    """One antenna's filtered chainages [m] and speeds [m/s], with their sigmas, shape (T,); NaN where missing."""

    chainage_m: Floats
    sigma_m: Floats
    speed_mps: Floats
    speed_sigma_mps: Floats

    def take(self, epochs: Indices) -> FilteredMotion:
        """Return the values of selected epochs."""
        return FilteredMotion(*(values[epochs] for values in self))


class PositionScreen(_OfTwoAntennas[Limits]):
    """Screen of the positions of two antennas of one vehicle."""

    status: ClassVar[Status]  #: Status of both antennas at epochs with rejected positions.

    @abstractmethod
    def judge(self, front_chainage_m: Floats, rear_chainage_m: Floats, pair: PairedEpochs, limits: Limits) -> Screened:
        """Return the metric and the verdict for P pairs of positions, given as chainages of shape (P,) [m]."""

    @abstractmethod
    def judge_filtered(
        self, front: FilteredMotion, rear: FilteredMotion, pair: PairedEpochs, limits: Limits
    ) -> Screened:
        """Return the metric and the verdict for P pairs of filtered positions and speeds."""

"""Detection of map errors from the mean offset of 3-D positions from the line.

A constant offset can be smaller than the noise of a single epoch, but larger than the noise of the mean over a window.
The covariance of the mean has three parts: noise, which decreases with the number of samples; satellite and atmospheric
errors, which do not decrease; and the stated map error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
import scipy
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Datetimes, Floats, Masks, kernel_array
from railfix.core.notebook import NotebookTable
from railfix.core.settings import Settings
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.noise_windows import correlated_sums
from railfix.positioning.normal_equations import SinglePoint
from railfix.positioning.range_arrays import RangeArrays, Ranges

_SUMS: Final = 9  #: Number of sums in `MapOffsetState.sums` for each of its two groups of epochs.


class MapOffsetLimits(Settings):
    """Limits of the map test with 3-D positions."""

    #: Time constant of exponential forgetting. The default corresponds to six independent samples, and is short enough
    #: to detect local map errors.
    window_s: float = Field(default=120.0, gt=0)
    correlation_s: float = Field(default=20.0, gt=0)  #: Epochs within this time count together as one sample.
    least_samples: float = Field(default=3.0, gt=0)  #: With fewer independent samples, no offset is computed.
    #: Probability that noise alone causes a note on the map (chi-square, two degrees of freedom).
    note_risk: float = Field(default=1e-2, gt=0, lt=1)
    #: Probability that noise alone causes the status `map_offset`, if the nominal sigmas are correct. On recordings
    #: with a correct map and all screens, the statistic is below the default threshold of 13.8
    #: (``tests/references/results/bounds.txt``).
    risk: float = Field(default=1e-3, gt=0, lt=1)
    #: Probability that the test misses an offset of the smallest detectable size.
    missed: float = Field(default=1e-2, gt=0, lt=1)

    @cached_property
    def note_threshold(self) -> float:
        """Threshold of the statistic for a note on the map."""
        return float(scipy.special.chdtri(2, self.note_risk))

    @cached_property
    def threshold(self) -> float:
        """Threshold of the statistic for the status `map_offset`."""
        return float(scipy.special.chdtri(2, self.risk))

    @cached_property
    def detectable_sigmas(self) -> float:
        """Smallest detectable offset in sigmas; the test for `map_offset` misses it with the probability `missed`."""
        return float(np.sqrt(scipy.special.chndtrinc(self.threshold, 2, self.missed)))


@dataclass(frozen=True, kw_only=True)
class MapOffsetState:
    """State after a chunk: sums with exponential forgetting (`MapOffsetLimits.window_s`)."""

    #: Time of the last epoch; NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Time from the start of the log to the last epoch, in window lengths (`noise_windows`).
    #: Nine sums for epochs on the map, then nine for epochs off the map, shape (18,): information matrix (3),
    #: information times offset (2), covariance of satellite and atmospheric errors (3), and number of samples.
    sums: Floats = field(default_factory=lambda: np.zeros(2 * _SUMS))


@dataclass(frozen=True, kw_only=True, repr=False)
class MapOffset(NotebookTable):
    """Mean offset of 3-D positions from the line over a window, T epochs; NaN with too few samples."""

    across_m: Floats  #: Offset to the right of the line, seen in the direction of rising chainage, shape (T,).
    up_m: Floats  #: Offset above the line, shape (T,).
    #: Covariance of the offset for a correct map, shape (T, 2, 2): noise, satellite and atmospheric errors, and the
    #: stated map error.
    covariance_m2: Floats
    statistic: Floats  #: Squared Mahalanobis distance of the offset from zero, shape (T,).
    #: Smallest detectable lateral offset and smallest detectable vertical offset, shape (T, 2), if the other component
    #: is 0.
    detectable_m: Floats

    @property
    def across_sigma_m(self) -> Floats:
        """Standard deviation of `across_m`, shape (T,) [m]."""
        return np.asarray(np.sqrt(self.covariance_m2[:, 0, 0]))

    @property
    def up_sigma_m(self) -> Floats:
        """Standard deviation of `up_m`, shape (T,) [m]."""
        return np.asarray(np.sqrt(self.covariance_m2[:, 1, 1]))

    @property
    def seen(self) -> tuple[Floats, Floats]:
        """Offset, shape (T, 2) [m], and its inverse covariance, shape (T, 2, 2) [1/m^2]; 0 with too few samples."""
        known = np.isfinite(self.across_m)[:, None]
        offset = np.where(known, np.array([self.across_m, self.up_m]).T, 0.0)
        return offset, np.where(known[..., None], _inverse_2x2(self.covariance_m2), 0.0)

    @property
    def beyond_m(self) -> tuple[Floats, Floats]:
        """Lateral and vertical offset reduced by one sigma, shape (T,) each [m]; 0 with too few samples."""
        across = np.sign(self.across_m) * np.maximum(np.abs(self.across_m) - self.across_sigma_m, 0.0)
        up = np.sign(self.up_m) * np.maximum(np.abs(self.up_m) - self.up_sigma_m, 0.0)
        known = np.isfinite(self.across_m)
        return np.where(known, across, 0.0), np.where(known, up, 0.0)


class OffsetErrors(NamedTuple):
    """Range error statistics used for the map offset, T epochs."""

    nominal_m: Floats  #: Standard deviations of satellite and atmospheric errors, shape (T, M).
    variance: Floats  #: Ratio of the actual variance of ranges to the variance assumed in the weights, shape (T,).


class LinePositions(NamedTuple):
    """Positions on the line at T epochs."""

    arc_m: Floats  #: Arc length, shape (T,); NaN without a position.
    #: True for epochs at which the train is off the line, shape (T,). These epochs have separate sums, because
    #: positions off the line contain no information on the map.
    off_map: Masks


def map_offset(
    time: Datetimes,
    ranges: Ranges,
    point: SinglePoint,
    errors: OffsetErrors,
    antennas: AntennaRows,
    positions: LinePositions,
    states: Sequence[MapOffsetState],
    *,
    limits: MapOffsetLimits | None = None,
) -> tuple[MapOffset, list[MapOffsetState]]:
    """Compute the mean offset of 3-D positions from the line over the window up to each epoch."""
    limits, (arc_m, off_map) = limits or MapOffsetLimits(), positions
    usable = np.isfinite(point.ecef_m[:, 0]) & np.isfinite(arc_m) & (ranges.space_redundancy > 0)
    arc = np.where(usable, arc_m, 0.0)
    axes, place = antennas.get_axes(antennas.segment_at(arc))[:, 1:], antennas.at_arc(arc)
    at = np.where(usable[:, None], point.ecef_m, place)
    covariance = np.where(usable[:, None, None], point.covariance_m2, np.eye(3))
    terms = terms_of_epochs(
        ranges.arrays, at, covariance, place, axes, np.ascontiguousarray(errors.nominal_m), errors.variance
    )
    sample = np.zeros((len(time), 2, _SUMS))
    rows = usable.nonzero()[0]
    sample[rows, off_map[rows].astype(np.intp)] = terms[rows]
    before, own, ended, last = correlated_sums(
        time, sample.reshape(-1, 2 * _SUMS), np.array([state.sums for state in states]), antennas.parts,
        [(state.time, state.age) for state in states], window_s=limits.window_s, correlation_s=limits.correlation_s,
    )  # fmt: skip
    both = before + own
    after = [MapOffsetState(time=when, age=age, sums=own) for (when, age), own in zip(last, ended, strict=True)]
    sums = np.where(off_map[:, None], both[:, _SUMS:], both[:, :_SUMS])
    enough = sums[:, 8] >= limits.least_samples
    sums = np.where(enough[:, None], sums, [1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    mean, known, statistic, detectable = means_of_windows(
        sums, antennas.sigma_plan_m, antennas.sigma_height_m, limits.detectable_sigmas
    )
    result = MapOffset(
        across_m=np.where(enough, mean[:, 0], np.nan), up_m=np.where(enough, mean[:, 1], np.nan),
        covariance_m2=np.where(enough[:, None, None], known, np.nan), statistic=np.where(enough, statistic, np.nan),
        detectable_m=np.where(enough[:, None], detectable, np.nan),
    )  # fmt: skip
    return result, after


def offset_from_line(ecef_m: Floats, arc_m: Floats, antennas: AntennaRows) -> Floats:
    """Return the offsets of 3-D positions to the right of and above the line, shape (T, 2) [m]; NaN without `arc_m`."""
    known = np.isfinite(arc_m)
    arc = np.where(known, arc_m, 0.0)
    axes = antennas.get_axes(antennas.segment_at(arc))[:, 1:]
    offset = np.einsum("tij,tj->ti", axes, ecef_m - antennas.at_arc(arc))
    return np.asarray(np.where(known[:, None], offset, np.nan))


def terms_of_epochs(
    ranges: RangeArrays,
    ecef_m: Floats,
    covariance_m2: Floats,
    place_ecef_m: Floats,
    axes: Floats,
    nominal_m: Floats,
    variance: Floats,
) -> Floats:
    """Return the contribution of each epoch to the sums of its window (`MapOffsetState.sums`), shape (T, 9).

    `ecef_m` are 3-D positions, `place_ecef_m` are the corresponding positions on the line, shape (T, 3), and `axes` are
    the lateral and vertical unit vectors at the positions on the line, shape (T, 2, 3). `nominal_m` (in C order) and
    `variance` are fields of `OffsetErrors`.
    """
    offset = np.einsum("tij,tj->ti", axes, ecef_m - place_ecef_m)
    gain = (axes @ covariance_m2) @ (
        kernels.ranges.reduced_equations(ranges, kernel_array(ecef_m))[2][:, :3] * ranges.weight[:, None]
    )
    nominal = gain * np.where(ranges.weight > 0, np.fmax(nominal_m, 0.0), 0.0)[:, None]
    bias = nominal @ nominal.swapaxes(1, 2)
    information = _inverse_2x2((axes @ covariance_m2 @ axes.swapaxes(1, 2)) * variance[:, None, None])
    return np.concatenate(
        [
            information[:, [0, 0, 1], [0, 1, 1]],
            np.einsum("tij,tj->ti", information, offset),
            bias[:, [0, 0, 1], [0, 1, 1]],
            np.ones((len(ecef_m), 1)),
        ],
        axis=1,
    )


def means_of_windows(
    sums: Floats, sigma_plan_m: float, sigma_height_m: float, detectable_sigmas: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return mean offset (T, 2), covariance (T, 2, 2), statistic (T,) and detectable offsets (T, 2), which `MapOffset`
    describes. `sums` are window sums, shape (T, 9).
    """
    of_noise = _inverse_2x2(sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    mean = np.einsum("tij,tj->ti", of_noise, sums[:, 3:5])
    known = of_noise + sums[:, [5, 6, 6, 7]].reshape(-1, 2, 2) / sums[:, 8, None, None]
    known = known + np.diag([sigma_plan_m**2, sigma_height_m**2])
    inverse = _inverse_2x2(known)
    statistic = (mean * np.einsum("tij,tj->ti", inverse, mean)).sum(axis=1)
    return mean, known, statistic, detectable_sigmas / np.sqrt(inverse[:, [0, 1], [0, 1]])


def _inverse_2x2(matrix: Floats) -> Floats:
    """Return the inverse of symmetric 2 x 2 matrices, shape (T, 2, 2)."""
    a, b, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    determinant = np.maximum(a * d - b * b, 1e-300)
    return np.array([d, -b, -b, a]).T.reshape(-1, 2, 2) / determinant[:, None, None]


def beyond_threshold(offset: MapOffset, limits: MapOffsetLimits) -> Masks:
    """Return True for epochs whose statistic exceeds the threshold for the status `map_offset`, shape (T,)."""
    return np.asarray(offset.statistic > limits.threshold)

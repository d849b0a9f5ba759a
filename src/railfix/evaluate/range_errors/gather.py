"""Errors of the train's pseudoranges: corrected code less range to the reference, clock and common errors (P1 7)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Strings
from railfix.core.errors import MismatchError
from railfix.core.geodesy import range_with_rotation
from railfix.core.reasons import Reason
from railfix.core.timescale import seconds
from railfix.evaluate import interpolate_reference
from railfix.evaluate.range_errors.base_station import BaseStation
from railfix.evaluate.range_errors.robust_clock import robust_clock
from railfix.io.reference_log import AntennaReference
from railfix.pipeline.results import AntennaResult
from railfix.positioning.normal_equations import clock_groups
from railfix.ranges.error_model import ErrorSamples
from railfix.track.trajectory import Trajectory

#: Reasons of ranges that have no error to speak of: no code, no satellite, no correction.
NO_RANGE: Final = (
    Reason.NOT_OBSERVED
    | Reason.IMPLAUSIBLE_CODE
    | Reason.SYSTEM_NOT_SELECTED
    | Reason.OTHER_SIGNAL_TAKEN
    | Reason.NO_EPHEMERIS
    | Reason.EPHEMERIS_TOO_OLD
    | Reason.UNHEALTHY
    | Reason.NO_CORRECTION
    | Reason.SBAS_NOT_COVERED
    | Reason.SBAS_NO_CORRECTION
    | Reason.SBAS_TIMED_OUT
    | Reason.SBAS_DO_NOT_USE
    | Reason.SBAS_NO_IONOSPHERE
)


@dataclass(frozen=True, kw_only=True)
class GatherLimits:
    """What is good enough to take an error from.

    Attributes
    ----------
    largest_reference_sigma_m : float
        Epochs whose reference is stated to be worse are left out.
    largest_reference_gap_s, largest_base_gap_s : float
        Longest step of the reference and of the reference station that is interpolated over.
    least_ranges : int
        Ranges that passed the screens, of one constellation, without which there is no clock to compare with.
    """

    largest_reference_sigma_m: float = 0.5
    largest_reference_gap_s: float = 2.5
    largest_base_gap_s: float = 35.0
    least_ranges: int = 4


@dataclass(frozen=True, kw_only=True)
class RangeErrors:
    """Errors of n pseudoranges, and where they belong.

    Attributes
    ----------
    samples : ErrorSamples
    time : ndarray of datetime64[ns], shape (n,)
    satellite : ndarray of str, shape (n,)
    epochs : int
        Epochs that had a reference.
    """

    samples: ErrorSamples
    time: Datetimes
    satellite: Strings
    epochs: int


def range_errors(
    result: AntennaResult,
    trajectory: Trajectory,
    reference: AntennaReference,
    base: BaseStation | None = None,
    *,
    limits: GatherLimits | None = None,
    block_s: float = 30.0,
) -> RangeErrors:
    """Errors of one antenna's chunk.

    The clock of each constellation is the robust mean of the ranges that passed the screens. What it takes
    away of their own errors is given back by ``1 / sqrt(1 - share)``; a common error of all satellites stays
    in the clock, where it does no harm to a position.

    Parameters
    ----------
    result : AntennaResult
        T epochs.
    trajectory : Trajectory
        Of the antenna; tells which way the car points.
    reference : AntennaReference
    base : BaseStation, optional
        Without one, errors of satellites and atmosphere stay in.
    limits : GatherLimits, optional
    block_s : float [s]
        Length of the blocks of `ErrorSamples.block`.

    Returns
    -------
    RangeErrors

    Raises
    ------
    MismatchError
        The reference is nowhere good enough.
    """
    limits = limits or GatherLimits()
    columns = result.columns
    good = ~(reference.sigma_m > limits.largest_reference_sigma_m)
    if np.count_nonzero(good) < 2:
        raise MismatchError(
            f"of {len(good)} positions of the reference fewer than two have a sigma of "
            f"{limits.largest_reference_sigma_m:g} m or less; a better reference is needed"
        )
    place = interpolate_reference(
        result.time, reference.time[good], reference.ecef_m[good], largest_gap_s=limits.largest_reference_gap_s
    )
    distance, _ = range_with_rotation(result.satellites.position_ecef_m, place[:, None, :])
    reason = result.reason[:, columns]
    satellite = result.satellite[columns]
    residual = np.where((reason & NO_RANGE) == 0, result.corrected_code_m[:, columns] - distance, np.nan)
    if base is not None:
        residual = residual - base.at(result.time, satellite, largest_gap_s=limits.largest_base_gap_s)
    used = (reason == Reason.USED) & np.isfinite(residual)
    groups = clock_groups(satellite.astype("<U1"))
    clock = robust_clock(
        np.where(used, residual, np.nan), result.sigma_m[:, columns], groups, least_ranges=limits.least_ranges
    )
    for g, group in enumerate(groups):
        residual[:, group] -= clock.clock_m[:, g][:, None]
    error = residual / np.sqrt(1.0 - clock.share)
    arc, _ = trajectory.nearest(place)
    turned = result.azimuth_deg[:, columns] - trajectory.body_azimuth_deg(arc)[:, None]
    epoch, channel = np.nonzero(np.isfinite(error) & (result.elevation_deg[:, columns] > 0.0))
    numbers = np.array([ord(name[0]) * 1000 + int(name[1:]) for name in satellite.tolist()], dtype=np.int64)
    time_block = (seconds(result.time - np.datetime64("2000-01-01T00:00:00", "ns")) // block_s).astype(np.int64)
    return RangeErrors(
        samples=ErrorSamples(
            error_m=error[epoch, channel],
            elevation_deg=result.elevation_deg[:, columns][epoch, channel],
            relative_azimuth_deg=turned[epoch, channel] % 360.0,
            cn0_dbhz=result.cn0_dbhz[:, columns][epoch, channel],
            block=time_block[epoch] * 1_000_000 + numbers[channel],
            used=used[epoch, channel],
        ),
        time=result.time[epoch],
        satellite=satellite[channel],
        epochs=int(np.isfinite(place[:, 0]).sum()),
    )


def joined(parts: list[ErrorSamples]) -> ErrorSamples:
    """Samples of several chunks, antennas and runs together."""
    return ErrorSamples(
        **{item.name: np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(ErrorSamples)}
    )

"""Pseudorange errors of the train: corrected pseudorange minus reference range, clock and common errors (P1 7)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Strings
from railfix.core.errors import MismatchError
from railfix.core.geodesy import range_with_rotation
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.evaluate import interpolate_reference
from railfix.evaluate.range_errors.base_station import CommonErrors
from railfix.io.reference_log import AntennaReference
from railfix.pipeline.results import AntennaResult
from railfix.positioning.normal_equations import clock_groups
from railfix.positioning.robust_clock import robust_clock
from railfix.ranges.error_model import ErrorSamples
from railfix.track.trajectory import Trajectory

#: Rejection reasons without a defined range error: no pseudorange, no ephemeris, no correction.
NO_RANGE: Final = (
    Reason.NOT_OBSERVED
    | Reason.IMPLAUSIBLE_CODE
    | Reason.SYSTEM_NOT_SELECTED
    | Reason.OTHER_SIGNAL_TAKEN
    | Reason.EXCLUDED_BY_SETTING
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


class GatherLimits(Settings):
    """Limits for the range errors of a run."""

    #: Epochs whose reference has a larger standard deviation are left out.
    largest_reference_sigma_m: float = Field(default=0.5, gt=0.0)
    #: Longest gap of the reference trajectory and of the reference station that is interpolated over.
    largest_reference_gap_s: float = Field(default=2.5, gt=0.0)
    largest_base_gap_s: float = Field(default=35.0, gt=0.0)
    #: Fewest ranges of one constellation, after the screens, from which its receiver clock is estimated.
    least_ranges: int = Field(default=4, ge=1)


@dataclass(frozen=True, kw_only=True)
class RangeErrors:
    """Errors of n pseudoranges with time and satellite."""

    samples: ErrorSamples
    time: Datetimes  #: Shape (n,).
    satellite: Strings  #: Shape (n,).
    epochs: int  #: Epochs with a reference position.


def range_errors(
    result: AntennaResult,
    trajectory: Trajectory,
    reference: AntennaReference,
    base: CommonErrors | None = None,
    *,
    limits: GatherLimits | None = None,
    block_s: float = 30.0,
) -> RangeErrors:
    """Pseudorange errors of one antenna over one chunk of T epochs.

    The clock of each constellation is the robust mean of the ranges that passed the screens. Each range
    contributes to its clock estimate, which shrinks its residual; ``1 / sqrt(1 - share)`` restores the size. An
    error common to all satellites stays in the clock and does not affect the position.

    Parameters
    ----------
    result : AntennaResult
    trajectory : Trajectory
        Of the antenna; gives the azimuth of the vehicle.
    reference : AntennaReference
    base : CommonErrors, optional
        Without one, satellite and atmospheric errors remain.
    limits : GatherLimits, optional
    block_s : float [s]
        Length of the blocks of `ErrorSamples.block`.

    Raises
    ------
    MismatchError
        Fewer than two reference positions have a sigma within the limit.
    """
    limits = limits or GatherLimits()
    columns = result.columns
    good = ~(reference.sigma_m > limits.largest_reference_sigma_m)
    if np.count_nonzero(good) < 2:
        raise MismatchError(
            f"fewer than two of the {len(good)} reference positions have a sigma of "
            f"{limits.largest_reference_sigma_m:g} m or less; a more accurate reference is needed"
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
    # What a screen suspects has a sigma of its own: the errors of the others are what the model is of.
    for name in ("doppler", "antenna_pair"):
        if name in result.screens:
            used &= ~result.screens[name].reject
    groups = clock_groups(satellite.astype("<U1"))
    clock = robust_clock(
        np.where(used, residual, np.nan), result.sigma_m[:, columns], groups, least_ranges=limits.least_ranges
    )
    widths = [group.stop - group.start for group in groups]
    error = (residual - np.repeat(clock.clock_m, widths, axis=1)) / np.sqrt(1.0 - clock.share)
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
            sigma_m=_level_sigma_m(result)[epoch, channel],
            chainage_m=trajectory.chainage_at(trajectory.nearest(place[epoch])[0]),
        ),
        time=result.time[epoch],
        satellite=satellite[channel],
        epochs=int(np.isfinite(place[:, 0]).sum()),
    )


def _level_sigma_m(result: AntennaResult) -> Floats:
    """Standard deviation of each range in the protection level of the run, shape (T, K) [m]."""
    columns = result.columns
    stated = result.sigma_m[:, columns] * np.maximum(result.noise_scale, 1.0)[:, None]
    return np.asarray(np.fmax(stated, result.bound_sigma_m[:, columns]))


def joined(parts: list[ErrorSamples]) -> ErrorSamples:
    """Samples of several chunks, antennas and runs concatenated."""
    return ErrorSamples(
        **{item.name: np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(ErrorSamples)}
    )

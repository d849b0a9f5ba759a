"""Satellite states, approximate positions and corrected pseudoranges of a chunk."""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np

from railfix.core.arrays import Floats, Masks, copy_with
from railfix.core.reasons import Reason
from railfix.gnss.observations import Observations
from railfix.integrity.protection.araim import SatelliteSupport
from railfix.pipeline.config import Config
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.approximate import ANCHOR_SIGMA_M, ApproximatePosition, approximate_position
from railfix.positioning.range_arrays import Ranges, weighted_ranges
from railfix.ranges.channels import Channels
from railfix.ranges.corrected import CorrectedRanges, SatelliteRanges, corrected_ranges, find_satellites
from railfix.ranges.error_conditions import Conditions, condition_differences
from railfix.ranges.second_codes import find_second_codes
from railfix.ranges.sources import CorrectionSource
from railfix.screens import Verdict, suspicion_sigma_m
from railfix.screens.base import OpenSkyCn0


class RangeErrorModel(Protocol):
    """Overbound of range errors by direction and C/N0 (`railfix.ranges.error_model.ErrorModel`)."""

    @property
    def covers(self) -> Literal["local", "satellite_and_atmosphere"]:
        """Errors that the model covers: local errors alone, or satellite and atmospheric errors as well."""

    @property
    def conditions(self) -> Conditions | None:
        """Settings under which the model is valid; None if unknown."""

    def at(self, elevation_deg: Floats, relative_azimuth_deg: Floats, cn0_dbhz: Floats) -> tuple[Floats, Floats]:
        """Return the overbounding sigma and bias of observations, shape (T, K) [m]; NaN where unknown."""

    def missing_parts(self) -> tuple[str, ...]:
        """Return a sentence for each part that the model lacks because an earlier version of railfix wrote it."""


class Models(NamedTuple):
    """Contents of model files: error model, C/N0 curve, and integrity support message for ARAIM levels."""

    error_model: RangeErrorModel | None = None
    cn0_curve: OpenSkyCn0 | None = None
    support: SatelliteSupport | None = None


def correct_ranges(
    obs: Observations,
    channels: Channels,
    config: Config,
    source: CorrectionSource,
    antennas: AntennaRows,
    *,
    error_model: RangeErrorModel | None = None,
) -> tuple[CorrectedRanges, ApproximatePosition]:
    """Return corrected ranges of a chunk, and approximate antenna positions.

    An error model provides minimum sigmas for the protection level; the weights are based on ``config.noise``.
    """
    satellites = find_satellites(obs, channels, source, max_age_s=config.max_ephemeris_age_s)
    near = approximate_position(
        raw_ranges(obs, channels, satellites), antennas, limits=config.single_point, section=config.section
    )
    corrected = corrected_ranges(obs, channels, satellites, near.ecef_m, source, gross=near.gross, noise=config.noise)
    corrected = copy_with(corrected, unsure=near.unsure)
    if source.second == "required" or (source.second == "optional" and channels.second.shape[1]):
        corrected = find_second_codes(corrected, source, config.noise)
    if error_model is not None:
        corrected = _apply_error_model(error_model, corrected, antennas, near.arc_m, config)
    return corrected, near


def raw_ranges(obs: Observations, channels: Channels, satellites: SatelliteRanges) -> Ranges:
    """Return equally weighted ranges: codes corrected for satellite clock and group delay."""
    code = np.where(satellites.reason == 0, obs.code_m[:, channels.columns] + satellites.correction_m, np.nan)
    sigma = np.full(code.shape, ANCHOR_SIGMA_M)
    return weighted_ranges(satellites.states.position_ecef_m, code, sigma, channels.clock)


def fit_ranges(corrected: CorrectedRanges) -> Ranges:
    """Return the ranges without a rejection reason, ready to be fitted."""
    return weighted_ranges(
        corrected.satellites.position_ecef_m, corrected.used_code_m, corrected.sigma_m, corrected.channels.clock
    )


def reject(corrected: CorrectedRanges, mask: Masks, reason: Reason) -> CorrectedRanges:
    """Return the ranges with a rejection reason added to observed channels where `mask`, shape (T, K), is true."""
    if not mask.any():
        return corrected
    hit = mask & ((corrected.reason & int(Reason.NOT_OBSERVED)) == 0)
    return copy_with(corrected, reason=np.where(hit, corrected.reason | int(reason), corrected.reason))


def apply_verdict(corrected: CorrectedRanges, verdict: Verdict) -> CorrectedRanges:
    """Apply the verdict of a screen to ranges: suspected ranges are rejected, or their weights are lowered."""
    failed = verdict.screened.reject
    if verdict.error_m is None:
        return reject(corrected, failed, verdict.reason)
    if not failed.any():
        return corrected
    return copy_with(corrected, sigma_m=suspicion_sigma_m(failed, verdict.error_m, corrected.sigma_m))


def _apply_error_model(
    model: RangeErrorModel, corrected: CorrectedRanges, antennas: AntennaRows, arc_m: Floats, config: Config
) -> CorrectedRanges:
    """Return the ranges with overbounding sigmas and biases of an error model; ranges without a sigma are rejected."""
    front_deg = antennas.each(lambda index, rows: index.trajectory.body_azimuth_deg(arc_m[rows]))
    turned = corrected.azimuth_deg - front_deg[:, None]
    bound, bias = model.at(corrected.elevation_deg, turned, corrected.cn0_dbhz)
    bound = np.hypot(bound, corrected.nominal_m) if model.covers == "local" or config.sbas else bound
    unbounded = (corrected.reason == 0) & ~np.isfinite(bound)
    return copy_with(
        corrected, bound_sigma_m=bound, bias_m=np.nan_to_num(bias),
        reason=np.where(unbounded, int(Reason.NO_CORRECTION), corrected.reason),
    )  # fmt: skip


def error_model_notes(model: RangeErrorModel | None, config: Config) -> tuple[str, ...]:
    """Return sentences on conditions in which the error model and the run differ, and on missing parts of the model."""
    if model is None:
        return ()
    notes, own = model.missing_parts(), collect_conditions(config)
    if model.conditions is not None and (differences := condition_differences(model.conditions, own)):
        return (f"error model: its conditions differ from those of this run: {'; '.join(differences)}", *notes)
    return notes


def collect_conditions(config: Config) -> Conditions:
    """Collect the settings that affect range errors; an error model fitted to the run stores them as conditions."""
    return Conditions(
        systems=config.systems, signals={letter: config.signals.get(letter, ()) for letter in config.systems},
        screens=config.screens, elevation_mask_deg=config.elevation.mask_deg,
        codes="smoothed" if config.carrier == "smoothed" else "raw",
        ionosphere="sbas" if config.sbas else config.ionosphere,
        troposphere="sbas" if config.sbas else config.troposphere,
    )  # fmt: skip

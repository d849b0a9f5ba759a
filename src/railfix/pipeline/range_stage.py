"""Satellite states, approximate positions and corrected pseudoranges of a chunk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Masks, copy_with
from railfix.core.reasons import Reason
from railfix.gnss.observations import Observations
from railfix.integrity.protection.araim import IntegritySupport
from railfix.pipeline.config import Config
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.approximate import ANCHOR_SIGMA_M, ApproximatePosition, approximate_position
from railfix.positioning.range_arrays import Ranges, weighted_ranges
from railfix.ranges.channels import Channels
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.ranges.corrected import CorrectedRanges, SatelliteRanges, corrected_ranges, find_satellites
from railfix.ranges.error_model import Conditions, ErrorModel
from railfix.ranges.sources import CorrectionSource
from railfix.screens import Verdict, suspicion_sigma_m


class Models(NamedTuple):
    """Measured models: error model, C/N0 curve, and integrity support message of ARAIM levels."""

    error_model: ErrorModel | None = None
    cn0_curve: Cn0Curve | None = None
    support: IntegritySupport | None = None


def correct_ranges(
    obs: Observations,
    channels: Channels,
    config: Config,
    source: CorrectionSource,
    antennas: AntennaRows,
    *,
    error_model: ErrorModel | None = None,
) -> tuple[CorrectedRanges, ApproximatePosition]:
    """Return corrected ranges of a chunk, and approximate antenna positions.

    An error model gives minimum sigmas for the protection level; the weights follow ``config.noise``.
    """
    satellites = find_satellites(obs, channels, source, max_age_s=config.max_ephemeris_age_s)
    near = approximate_position(
        raw_ranges(obs, channels, satellites), antennas, limits=config.single_point, section=config.section
    )
    corrected = corrected_ranges(obs, channels, satellites, near.ecef_m, source, gross=near.gross, noise=config.noise)
    corrected = copy_with(corrected, unsure=near.unsure)
    if error_model is not None:
        corrected = _apply_error_model(error_model, corrected, antennas, near.arc_m, config)
    return corrected, near


def raw_ranges(obs: Observations, channels: Channels, satellites: SatelliteRanges) -> Ranges:
    """Return the codes corrected for satellite clock and group delay, with equal weights."""
    code = np.where(satellites.reason == 0, obs.code_m[:, channels.columns] + satellites.correction_m, np.nan)
    sigma = np.full(code.shape, ANCHOR_SIGMA_M)
    return weighted_ranges(satellites.states.position_ecef_m, code, sigma, channels.clock)


def fit_ranges(corrected: CorrectedRanges) -> Ranges:
    """Return the ranges without a rejection reason, ready to be fitted."""
    return weighted_ranges(
        corrected.satellites.position_ecef_m, corrected.used_code_m, corrected.sigma_m, corrected.channels.clock
    )


def reject(corrected: CorrectedRanges, mask: Masks, reason: Reason) -> CorrectedRanges:
    """Return the ranges with a reason added to the observed channels of a mask, shape (T, K)."""
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
    model: ErrorModel, corrected: CorrectedRanges, antennas: AntennaRows, arc_m: Floats, config: Config
) -> CorrectedRanges:
    """Return the ranges with overbounding sigma and bias by an error model; unbounded ranges are rejected."""
    front_deg = antennas.each(lambda index, rows: index.trajectory.body_azimuth_deg(arc_m[rows]))
    turned = corrected.azimuth_deg - front_deg[:, None]
    bound, bias = model.at(corrected.elevation_deg, turned, corrected.cn0_dbhz)
    bound = np.hypot(bound, corrected.nominal_m) if model.covers == "local" or config.sbas else bound
    unbounded = (corrected.reason == 0) & ~np.isfinite(bound)
    return copy_with(
        corrected, bound_sigma_m=bound, bias_m=np.nan_to_num(bias),
        reason=np.where(unbounded, int(Reason.NO_CORRECTION), corrected.reason),
    )  # fmt: skip


def collect_conditions(config: Config) -> Conditions:
    """Collect settings that affect range errors: the conditions of an error model fitted on such a run."""
    return Conditions(
        systems=config.systems, signals={letter: config.signals.get(letter, ()) for letter in config.systems},
        screens=config.screens, elevation_mask_deg=config.elevation.mask_deg,
        codes="smoothed" if config.carrier == "smoothed" else "raw",
        ionosphere="sbas" if config.sbas else config.ionosphere,
        troposphere="sbas" if config.sbas else config.troposphere,
    )  # fmt: skip

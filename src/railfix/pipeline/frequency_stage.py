"""Combine the codes of two frequencies to one pseudorange per satellite."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, copy_with
from railfix.core.reasons import Reason
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.positioning.two_frequencies import TwoFrequencyState, combine_codes, ionosphere_free
from railfix.ranges.atmosphere import thin_shell_obliquity
from railfix.screens import Screened, Verdict

#: Key of the verdict.
NAME: Final = "two_frequencies"
#: Arc, of 1000 km, over which the error of the ionosphere's model changes by its own size [rad].
_IONOSPHERE_ARC: Final = 0.157
#: A delay about a plane over the sky, of itself: Galileo's have 0.06 of 1.5 m at a station in a solar minimum, 0.02 of
#: 3.9 m on a drive in Japan, 0.05 of 6.4 m on a roof there in 2024 (0.35 m: Walter et al., Navigation 48, 2001).
_IONOSPHERE_REST: Final = 0.05


def combine_frequencies(
    ranges: CorrectedRanges, config: Config, ionosphere_sigma_m: float, state: TwoFrequencyState
) -> tuple[CorrectedRanges, TwoFrequencyState]:
    """Return the ranges with two codes combined, and weighted down where the two disagree."""
    second = ranges.second
    if second is None:
        return ranges, state
    usable = ranges.reason == 0
    known = config.noise.floor_sigma_m**2 + (ranges.nominal_m**2 if config.dual_frequency_sbas else 0.0)
    noise = np.sqrt(np.maximum(ranges.sigma_m**2 - known, 1e-4))
    vertical = np.hypot(config.nominal.ionosphere_sigma_m, ionosphere_sigma_m)
    found, state = combine_codes(
        ranges.time,
        np.where(usable, ranges.corrected_code_m, np.nan),
        noise,
        second,
        _field_of_ionosphere(ranges, vertical),
        (ranges.channels.pair_names, ranges.channels.pair_groups),
        state,
        config.two_frequencies,
    )
    local_m, nominal_m = ranges.bound_sigma_m, np.zeros(usable.shape)
    if config.dual_frequency_sbas:
        gps = np.char.startswith(ranges.satellite, "G")  # corrections refer to clocks without group delays
        delays = (np.where(gps, each, 0.0) for each in (ranges.satellites.group_delay_m, second.group_delay_m))
        code = np.where(usable, ranges.corrected_code_m, np.nan)
        found = ionosphere_free(code, noise, second, tuple(delays), found)
        nominal_m = np.where(local_m > 0.0, ranges.nominal_m, 0.0)
        local_m = np.sqrt(np.maximum(local_m**2 - nominal_m**2, 0.0))
    joint = np.isfinite(found.share)
    magnified = np.where(joint, np.abs(1.0 - found.share) + np.abs(found.share), 1.0)
    ranges = copy_with(
        ranges,
        corrected_code_m=np.where(joint, found.code_m, ranges.corrected_code_m),
        sigma_m=np.where(joint, np.sqrt(ranges.sigma_m**2 + found.variance_m2), ranges.sigma_m),
        bound_sigma_m=np.hypot(local_m * magnified, nominal_m),
        bias_m=ranges.bias_m * magnified,
        combined=found,
    )
    screened = Screened(metric=found.difference_m, reject=found.suspected)
    verdict = Verdict(name=NAME, reason=Reason.USED, screened=screened, error_m=found.difference_m)
    return ranges.apply([verdict]), state


def _field_of_ionosphere(ranges: CorrectedRanges, vertical_m: float) -> Floats:
    """Return sigmas of the modelled ionosphere by offset, gradients and the satellite's rest, shape (T, K, 4) [m]."""
    obliquity, azimuth = thin_shell_obliquity(ranges.elevation_deg), np.radians(ranges.azimuth_deg)
    offset = vertical_m * obliquity
    to_pierce_point = np.radians(90.0 - ranges.elevation_deg) - np.arccos(1.0 / obliquity)
    slope = offset * to_pierce_point / _IONOSPHERE_ARC
    rest = _IONOSPHERE_REST * ranges.ionosphere_m
    return np.stack([offset, slope * np.sin(azimuth), slope * np.cos(azimuth), rest], axis=-1)

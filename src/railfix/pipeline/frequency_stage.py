"""Combine the codes of two frequencies into one pseudorange per satellite."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, copy_with
from railfix.core.epoch_rows import take_epochs
from railfix.core.reasons import Reason
from railfix.pipeline.config import Config
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.search_index import SearchIndex
from railfix.positioning.two_frequencies import Combined, TwoFrequencyState, combine_codes, ionosphere_free
from railfix.ranges.atmosphere import thin_shell_obliquity
from railfix.ranges.corrected import CorrectedRanges
from railfix.screens import Screened, Verdict

#: Name of this stage's verdict.
NAME: Final = "two_frequencies"
#: Correlation length of the ionospheric model error, as an angle at the Earth's centre [rad]: 1000 km.
_IONOSPHERE_ARC: Final = 0.157
#: Deviation of a satellite's delay from a common offset with two gradients over the sky, as a fraction of the delay.
#: For Galileo, the fraction was 0.06 at a station in a solar minimum (mean delay 1.5 m), 0.02 on a drive in Japan (3.9
#: m), and 0.05 on a roof in Japan in 2024 (6.4 m). Walter et al. (Navigation 48, 2001) use 0.35 m instead.
_IONOSPHERE_REST: Final = 0.05


def combine_frequencies(
    corrected: CorrectedRanges,
    antennas: AntennaRows,
    config: Config,
    ionosphere_sigma_m: float,
    states: Sequence[TwoFrequencyState],
) -> tuple[CorrectedRanges, Combined, Verdict, list[TwoFrequencyState]]:
    """Return combined ranges, the combination, the verdict on inconsistent codes, and the new states."""
    usable, second = corrected.reason == 0, corrected.second
    assert second is not None
    code = np.where(usable, corrected.corrected_code_m, np.nan)
    known = config.noise.floor_sigma_m**2 + (corrected.nominal_m**2 if config.dual_frequency_sbas else 0.0)
    noise = np.sqrt(np.maximum(corrected.sigma_m**2 - known, 1e-4))
    vertical_m = config.nominal.vertical_ionosphere_m(corrected.vertical_ionosphere_m)
    field_m = _field_of_ionosphere(corrected, np.hypot(vertical_m, ionosphere_sigma_m))
    pairs = corrected.channels.pair_names, corrected.channels.pair_groups

    def own_codes(_: SearchIndex, rows: slice, state: TwoFrequencyState) -> tuple[Combined, TwoFrequencyState]:
        given = corrected.time[rows], code[rows], noise[rows]
        return combine_codes(
            *given, take_epochs(second, rows), field_m[rows], pairs, state, config.two_frequencies
        )  # fmt: skip

    found, after = antennas.each_with_state(own_codes, states)
    local_m, nominal_m = corrected.bound_sigma_m, np.zeros(usable.shape)
    if config.dual_frequency_sbas:
        gps = np.char.startswith(corrected.satellite, "G")  # SBAS clock corrections exclude group delays
        delays = (np.where(gps, each, 0.0) for each in (corrected.satellites.group_delay_m, second.group_delay_m))
        found = ionosphere_free(code, noise, second, tuple(delays), found)
        nominal_m = np.where(local_m > 0.0, corrected.nominal_m, 0.0)
        local_m = np.sqrt(np.maximum(local_m**2 - nominal_m**2, 0.0))
    joint = np.isfinite(found.share)
    magnified = np.where(joint, np.abs(1.0 - found.share) + np.abs(found.share), 1.0)
    corrected = copy_with(
        corrected,
        corrected_code_m=np.where(joint, found.code_m, corrected.corrected_code_m),
        sigma_m=np.where(joint, np.sqrt(corrected.sigma_m**2 + found.variance_m2), corrected.sigma_m),
        bound_sigma_m=np.hypot(local_m * magnified, nominal_m),
        bias_m=corrected.bias_m * magnified,
    )
    screened = Screened(metric=found.difference_m, reject=found.suspected)  # no common limit of all satellites
    verdict = Verdict(name=NAME, reason=Reason.USED, screened=screened, error_m=found.difference_m)
    return corrected, found, verdict, after


def _field_of_ionosphere(ranges: CorrectedRanges, vertical_m: Floats) -> Floats:
    """Return sigmas of the ionospheric model error, (T, K, 4) [m]: offset, two gradients, rest of each satellite."""
    obliquity, azimuth = thin_shell_obliquity(ranges.elevation_deg), np.radians(ranges.azimuth_deg)
    offset = vertical_m[:, None] * obliquity
    to_pierce_point = np.radians(90.0 - ranges.elevation_deg) - np.arccos(1.0 / obliquity)
    slope = offset * to_pierce_point / _IONOSPHERE_ARC
    rest = _IONOSPHERE_REST * ranges.ionosphere_m
    return np.stack([offset, slope * np.sin(azimuth), slope * np.cos(azimuth), rest], axis=-1)

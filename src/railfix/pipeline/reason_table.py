"""Combine the rejection reasons of all channels, and count them by satellite."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Bits, Integers, Masks
from railfix.core.reasons import Reason
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.positioning.normal_equations import UNTIED_M, ClockTies


def reason_of_all_channels(corrected: CorrectedRanges) -> Bits:
    """Return the reasons of all channels of the observations, shape (T, M)."""
    not_observed = ~np.isfinite(corrected.observations.code_m) * np.int64(Reason.NOT_OBSERVED)
    reason = np.asarray(not_observed | corrected.channels.left_out)
    reason[:, corrected.columns] = corrected.reason
    second, found = corrected.second, corrected.combined
    if second is not None and found is not None:
        epoch, channel = np.nonzero(np.isfinite(found.share))
        reason[epoch, second.column[epoch, channel]] = corrected.reason[epoch, channel]
    return reason


def alone_on_their_clocks(corrected: CorrectedRanges, ties: ClockTies) -> Masks:
    """Return the satellites that are the only ones of a clock without a known bias, shape (T, K)."""
    alone = np.zeros(corrected.reason.shape, dtype=bool)
    for g, group in enumerate(corrected.groups):
        used = corrected.reason[:, group] == 0
        lone = (np.count_nonzero(used, axis=1) == 1) & (ties.sigma_m[:, g] >= UNTIED_M)
        alone[:, group] = used & lone[:, None]
    return alone


def satellites_rejected(member: Integers, reason: Bits) -> Integers:
    """Return the number of satellites with a code of which no signal was used, shape (T,).

    Parameters
    ----------
    member : ndarray of int64, shape (M, S)
        `Channels.member`.
    reason : ndarray of int64, shape (T, M)
    """
    of_satellite = member.astype(np.float32)  # small counts are exact, and floats are multiplied in blocks
    seen = ((reason & Reason.NOT_OBSERVED) == 0).astype(np.float32) @ of_satellite > 0
    used = (reason == 0).astype(np.float32) @ of_satellite > 0
    return np.asarray(np.count_nonzero(seen & ~used, axis=1), dtype=np.int64)

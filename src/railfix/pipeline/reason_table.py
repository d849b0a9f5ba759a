"""Reasons brought together: of channels that were never looked at, of lone satellites, counted by satellite."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Bits, Integers, Masks
from railfix.core.reasons import Reason
from railfix.pipeline.corrected_ranges import Prepared
from railfix.positioning.normal_equations import UNTIED_M, ClockTies


def whole_reason(one: Prepared) -> Bits:
    """Reasons of all channels of the observations, those that settings leave out included, shape (T, M)."""
    not_observed = ~np.isfinite(one.observations.code_m) * np.int64(Reason.NOT_OBSERVED)
    reason = np.asarray(not_observed | one.channels.left_out)
    reason[:, one.columns] = one.reason
    return reason


def alone_on_their_clocks(one: Prepared, ties: ClockTies) -> Masks:
    """Satellites that determine their own clock and nothing else, shape (T, K)."""
    alone = np.zeros(one.reason.shape, dtype=bool)
    for g, group in enumerate(one.groups):
        used = one.reason[:, group] == 0
        lone = (np.count_nonzero(used, axis=1) == 1) & (ties.sigma_m[:, g] >= UNTIED_M)
        alone[:, group] = used & lone[:, None]
    return alone


def satellites_refused(member: Integers, reason: Bits) -> Integers:
    """Satellites with a code of which no signal was used, shape (T,).

    Parameters
    ----------
    member : ndarray of int64, shape (M, S)
        `Channels.member`.
    reason : ndarray of int64, shape (T, M)
    """
    seen = ((reason & Reason.NOT_OBSERVED) == 0).astype(np.int64) @ member > 0
    used = (reason == 0).astype(np.int64) @ member > 0
    return np.asarray(np.count_nonzero(seen & ~used, axis=1), dtype=np.int64)

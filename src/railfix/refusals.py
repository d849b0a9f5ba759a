"""Reasons brought together: of channels that were never looked at, of lone satellites, counted by satellite."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railfix.clock_elimination import UNTIED_M, ClockTies
from railfix.preparation import Prepared
from railfix.reasons import Reason

Bits = NDArray[np.int64]


def whole_reason(one: Prepared) -> Bits:
    """Reasons of all channels of the observations, those that settings leave out included, shape (T, M)."""
    not_observed = ~np.isfinite(one.observations.code_m) * np.int64(Reason.NOT_OBSERVED)
    reason = np.asarray(not_observed | one.channels.left_out)
    reason[:, one.columns] = one.reason
    return reason


def alone_on_their_clocks(one: Prepared, ties: ClockTies) -> NDArray[np.bool_]:
    """Satellites that determine their own clock and nothing else, shape (T, K)."""
    alone = np.zeros(one.reason.shape, dtype=bool)
    for g, group in enumerate(one.groups):
        used = one.reason[:, group] == 0
        lone = (np.count_nonzero(used, axis=1) == 1) & (ties.sigma_m[:, g] >= UNTIED_M)
        alone[:, group] = used & lone[:, None]
    return alone


def satellites_refused(member: NDArray[np.int64], reason: Bits) -> NDArray[np.int64]:
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

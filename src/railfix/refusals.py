"""Reasons brought together: of channels that were never looked at, of lone satellites, counted by satellite."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from railfix.clock_elimination import UNTIED_M, ClockTies
from railfix.preparation import Prepared
from railfix.reasons import Reason

Bits = NDArray[np.int64]


def whole_reason(one: Prepared, systems: Sequence[str]) -> Bits:
    """Reasons of all channels of the observations, those that settings leave out included, shape (T, M)."""
    obs = one.observations
    reason = np.where(np.isfinite(obs.code_m), 0, int(Reason.NOT_OBSERVED))
    selected = np.isin(obs.system, systems)
    reason[:, ~selected] |= Reason.SYSTEM_NOT_SELECTED
    reason[:, np.setdiff1d(np.flatnonzero(selected), one.columns)] |= Reason.OTHER_SIGNAL_TAKEN
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


def satellites_refused(satellite: NDArray[np.str_], reason: Bits) -> NDArray[np.int64]:
    """Satellites with a code of which no signal was used, shape (T,)."""
    names, which = np.unique(satellite, return_inverse=True)
    member = (which[:, None] == np.arange(len(names))).astype(np.int64)
    seen = ((reason & Reason.NOT_OBSERVED) == 0).astype(np.int64) @ member > 0
    used = (reason == 0).astype(np.int64) @ member > 0
    return np.asarray(np.count_nonzero(seen & ~used, axis=1), dtype=np.int64)

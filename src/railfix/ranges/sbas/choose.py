"""Whose messages to use where several GEOs are heard."""

from __future__ import annotations

from typing import Literal

import numpy as np

from railfix.ranges.sbas.limits import NOT_MONITORED, SbasLimits
from railfix.ranges.sbas.log import SbasLog
from railfix.ranges.sbas.names import system_name
from railfix.ranges.sbas.tables import SatelliteTables


def best_prn(log: SbasLog, prn: int | Literal["best"], limits: SbasLimits) -> tuple[int, str]:
    """PRN to use, and a sentence that says why.

    Raises
    ------
    ValueError
        The log has no message of the PRN asked for.
    """
    known = ", ".join(str(number) for number in log.prns)
    if prn != "best":
        if prn not in log.prns:
            raise ValueError(f"the log has no SBAS message of PRN {prn}; it has {known}")
        return prn, f"SBAS PRN {prn} was asked for; the log has {known}"
    scores = []
    for number in log.prns:
        fast = SatelliteTables(log.of(number), limits).fast
        usable = int((fast.udrei < NOT_MONITORED).sum())
        satellites = len(np.unique(fast.number[fast.udrei < NOT_MONITORED]))
        scores.append((-usable, number, satellites))
    ordered = sorted(scores)
    told = "; ".join(
        f"{system_name(number)} {number}: {-usable} of {satellites} satellites"
        for usable, number, satellites in ordered
    )
    return ordered[0][1], f"best SBAS PRN by usable fast corrections: {ordered[0][1]} ({told})"

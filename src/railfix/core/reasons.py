"""Why an observation was not used, and what became of an epoch.

A reason is a bit; an observation carries all that applied, 0 means that it was used. A status is
one word an epoch and antenna, decided once, from numbers.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Integers, Strings


class Reason(IntFlag):
    """Why an observation (epoch, channel) was not used. 0 = used."""

    USED = 0
    #: No pseudorange at this epoch.
    NOT_OBSERVED = 1 << 0
    #: The pseudorange cannot be one (not between 10 000 and 100 000 km).
    IMPLAUSIBLE_CODE = 1 << 1
    #: The constellation was not asked for.
    SYSTEM_NOT_SELECTED = 1 << 2
    #: Another signal of the same satellite was taken.
    OTHER_SIGNAL_TAKEN = 1 << 3
    #: No navigation record of the satellite at all.
    NO_EPHEMERIS = 1 << 4
    #: There are records, but none valid at this time.
    EPHEMERIS_TOO_OLD = 1 << 5
    #: The newest valid record says unhealthy.
    UNHEALTHY = 1 << 6
    #: Below the elevation mask.
    ELEVATION_MASK = 1 << 7
    #: The only usable satellite of its clock: it determines that clock and nothing else.
    ALONE_ON_ITS_CLOCK = 1 << 8
    #: A correction of its signal is unknown: its group delay is not broadcast, or it stands at the horizon.
    NO_CORRECTION = 1 << 9
    #: SBAS: its mask does not have the satellite.
    SBAS_NOT_COVERED = 1 << 10
    #: SBAS: a fast or long-term correction, its degradation, or the issue of data that it is for is missing.
    SBAS_NO_CORRECTION = 1 << 11
    #: SBAS: the corrections are too old.
    SBAS_TIMED_OUT = 1 << 12
    #: SBAS: do not use, not monitored, too uncertain, or the GEO itself says that it must not be used.
    SBAS_DO_NOT_USE = 1 << 13
    #: SBAS: the ionosphere where the signal passes is not known.
    SBAS_NO_IONOSPHERE = 1 << 14
    #: Weaker than the absolute floor of C/N0.
    CN0_FLOOR = 1 << 15
    #: Weaker than an open sky gives at its elevation.
    CN0_CURVE = 1 << 16
    #: The code changed otherwise than its Doppler says.
    DOPPLER = 1 << 17
    #: The codes of the two antennas differ otherwise than their spacing says.
    ANTENNA_PAIR = 1 << 18
    #: Excluded by RAIM: its own error against all others is over the limit.
    FAULT_EXCLUDED = 1 << 19


class Status(IntEnum):
    """What became of one epoch of one antenna."""

    #: A position along the line.
    OK = 0
    #: A position, but another place on the line explains the ranges as well.
    AMBIGUOUS = 1
    #: A position, clamped to an end of the map or too far from what the ranges say.
    OFF_MAP = 2
    #: No position: fewer usable satellites than asked for.
    TOO_FEW_SATELLITES = 3
    #: No position: the satellites stand across the track and do not tell where along it.
    UNOBSERVABLE = 4
    #: No position: the iteration did not settle.
    NO_CONVERGENCE = 5
    #: No position: this antenna has no observation at this epoch.
    NO_OBSERVATION = 6
    #: A position, but the ranges contradict each other and no exclusion mends it.
    INCONSISTENT = 7
    #: A position, but the two antennas' positions are not as far apart as the antennas.
    ANTENNAS_DISAGREE = 8
    #: A position, but what its own ranges can vouch for is too wide (`Config.largest_sigma_m`).
    UNCERTAIN = 9

    @property
    def text(self) -> str:
        """The word written to files: ``too_few_satellites``."""
        return self.name.lower()


#: Positions that a check has failed: with coordinates or without, as `Config.failed_checks` says.
CHECK_FAILED: Final = (Status.INCONSISTENT, Status.ANTENNAS_DISAGREE, Status.UNCERTAIN)
#: Statuses that come with coordinates (those of `CHECK_FAILED` unless they are dropped).
POSITIONED: Final = (Status.OK, Status.AMBIGUOUS, Status.OFF_MAP, *CHECK_FAILED)


def reason_text(reason: int) -> str:
    """Names of the bits of one reason, joined by ``+``; ``used`` for 0.

    >>> reason_text(Reason.UNHEALTHY | Reason.ELEVATION_MASK)
    'unhealthy+elevation_mask'
    """
    if reason == 0:
        return "used"
    return "+".join(bit.name.lower() for bit in Reason if bit & reason and bit.name)


def reason_texts(reasons: ArrayLike) -> Strings:
    """`reason_text` of every element of an array."""
    values, inverse = np.unique(np.asarray(reasons), return_inverse=True)
    return np.array([reason_text(int(v)) for v in values])[inverse.reshape(np.shape(reasons))]


def first_reason(reasons: ArrayLike) -> Integers:
    """The lowest set bit of each reason: the first stage that refused the observation."""
    value = np.asarray(reasons, dtype=np.int64)
    return value & -value

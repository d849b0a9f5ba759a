"""Rejection reasons of observations and solution statuses of epochs.

Each reason is one bit. An observation has the bits of all reasons that apply, or 0 if it was used. For each antenna,
every epoch has exactly one status.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Final


class Reason(IntFlag):
    """Reasons for rejecting an observation (epoch, channel); 0 means used."""

    USED = 0
    #: There is no pseudorange at this epoch.
    NOT_OBSERVED = 1 << 0
    #: The pseudorange is implausible: outside 10 000 to 100 000 km.
    IMPLAUSIBLE_CODE = 1 << 1
    #: The constellation is not selected.
    SYSTEM_NOT_SELECTED = 1 << 2
    #: Another signal of the same satellite was selected.
    OTHER_SIGNAL_TAKEN = 1 << 3
    #: The navigation data have no record of the satellite.
    NO_EPHEMERIS = 1 << 4
    #: No record of the satellite is valid at this time.
    EPHEMERIS_TOO_OLD = 1 << 5
    #: The newest valid record flags the satellite or signal as unhealthy.
    UNHEALTHY = 1 << 6
    #: The satellite is below the elevation mask.
    ELEVATION_MASK = 1 << 7
    #: No other satellite of the clock group is usable, so that the range determines only the group's clock.
    ALONE_ON_ITS_CLOCK = 1 << 8
    #: No group delay of the signal is broadcast, or the range has no finite sigma (for example at the horizon).
    NO_CORRECTION = 1 << 9
    #: SBAS: the satellite is not in the PRN mask.
    SBAS_NOT_COVERED = 1 << 10
    #: SBAS: the fast or long-term correction, the degradation, or the navigation record for the correction is missing.
    SBAS_NO_CORRECTION = 1 << 11
    #: SBAS: the corrections have timed out.
    SBAS_TIMED_OUT = 1 << 12
    #: SBAS: the satellite is flagged "do not use" or "not monitored", its UDRE is too large, or the GEO sends message
    #: type 0, "do not use".
    SBAS_DO_NOT_USE = 1 << 13
    #: SBAS: there is no ionospheric delay at the pierce point, or, for SBAS on L5, no code on the second frequency.
    SBAS_NO_IONOSPHERE = 1 << 14
    #: The C/N0 is below the fixed limit for all elevations.
    CN0_FLOOR = 1 << 15
    #: The C/N0 is too far below the open-sky curve at this elevation.
    CN0_CURVE = 1 << 16
    #: The change of the pseudorange disagrees with the Doppler.
    DOPPLER = 1 << 17
    #: The pseudorange difference between the two antennas disagrees with the antenna spacing.
    ANTENNA_PAIR = 1 << 18
    #: Excluded by RAIM: the estimated error of the range exceeds the limit.
    FAULT_EXCLUDED = 1 << 19
    #: Persistent range error: the residuals have had the same sign and size for a minute.
    LASTING_ERROR = 1 << 20
    #: Excluded by the setting `exclude`.
    EXCLUDED_BY_SETTING = 1 << 21
    #: The range error exceeds 100 m, while the other ranges agree; the filter still uses carrier phase and Doppler.
    GROSS_ERROR = 1 << 22


class Status(IntEnum):
    """Solution status of one epoch of one antenna."""

    #: A position along the line.
    OK = 0
    #: A position, but another position on the line fits the ranges equally well, or the probability of an error above
    #: the protection level exceeds the integrity risk.
    AMBIGUOUS = 1
    #: A position, but it is far beyond an end of the map, or too far from the unconstrained position.
    OFF_MAP = 2
    #: No position: fewer usable satellites than `Config.min_satellites`.
    TOO_FEW_SATELLITES = 3
    #: No position: the satellite geometry does not determine the position along the track.
    UNOBSERVABLE = 4
    #: No position: the iteration did not converge.
    NO_CONVERGENCE = 5
    #: No position: this antenna has no observation at this epoch.
    NO_OBSERVATION = 6
    #: A position, but the ranges are inconsistent and no exclusion restores consistency.
    INCONSISTENT = 7
    #: A position, but its distance from the other antenna's position disagrees with the antenna spacing.
    ANTENNAS_DISAGREE = 8
    #: A position, but its single-epoch sigma exceeds `Config.largest_sigma_m`.
    UNCERTAIN = 9
    #: A position, but the 3-D positions of the last minutes are off the line: the map is wrong here, or the train is on
    #: another track.
    MAP_OFFSET = 10
    #: A position that passed every check, but jamming of the signals is suspected.
    JAMMING_SUSPECTED = 11
    #: A position, but the signals may be from a spoofer, so that the position error has no bound.
    SPOOFING_SUSPECTED = 12
    #: A position that was moved to an end of the map, because it was beyond this end by a distance that noise explains.
    MAP_END = 13

    @property
    def text(self) -> str:
        """Name of the status in lower case, as written to files, for example ``too_few_satellites``."""
        return self.name.lower()


#: Statuses of positions that failed a check; `Config.failed_checks` keeps or drops their coordinates.
CHECK_FAILED: Final = (Status.INCONSISTENT, Status.ANTENNAS_DISAGREE, Status.UNCERTAIN, Status.SPOOFING_SUSPECTED)
#: Statuses with coordinates; for a status in `CHECK_FAILED`, `Config.failed_checks` may drop the coordinates.
POSITIONED: Final = (
    Status.OK, Status.AMBIGUOUS, Status.OFF_MAP, Status.MAP_OFFSET, Status.JAMMING_SUSPECTED, Status.MAP_END,
    *CHECK_FAILED,
)  # fmt: skip

"""Names, time-outs and variances of RTCA DO-229D, and the data classes of satellite and ionospheric corrections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, FrozenArrays, Integers, Masks
from railfix.ranges.sbas.limits import TIMEOUT_S

#: PRNs assigned to each system. PRNs 134 and 122, formerly of WAAS, are now KASS and SouthPAN.
_SYSTEMS: Final = {
    "EGNOS": (120, 121, 123, 124, 126, 136),
    "WAAS": (131, 133, 135, 138),
    "MSAS": (129, 137),
    "GAGAN": (127, 128, 132),
    "SDCM": (125, 140, 141),
    "BDSBAS": (130, 143, 144),
    "KASS": (134,),
    "SouthPAN": (122,),
    "ASECNA": (147,),
    "QZSS L1S": tuple(range(183, 192)),
}
_SYSTEM_OF: Final = {prn: name for name, prns in _SYSTEMS.items() for prn in prns}

#: PRNs whose messages are read: SBAS, and QZSS L1-SAIF or L1S.
GEO_PRNS: Final = (*range(120, 159), *range(183, 203))


def system_name(prn: int) -> str:
    """Return the name of the system of a PRN ("MSAS"); "SBAS" for a PRN that is not assigned."""
    return _SYSTEM_OF.get(prn, "SBAS")


def mask_satellite(number: int) -> str:
    """Return the satellite of a PRN mask number (DO-229D, table A-1; QZSS: IS-QZSS L1-SAIF); empty if not assigned."""
    if 1 <= number <= 37:
        return f"G{number:02d}"
    if 38 <= number <= 61:
        return f"R{number - 37:02d}"
    if 120 <= number <= 138:
        return f"S{number - 100:02d}"
    if 193 <= number <= 202:
        return f"J{number - 192:02d}"
    return ""


#: Time-outs of fast corrections [s] for each degradation indicator ai (DO-229D, table A-8).
FAST_TIMEOUT_S: Final[dict[str, tuple[float, ...]]] = {
    "precision": (120, 120, 102, 90, 90, 78, 66, 54, 42, 30, 30, 18, 18, 18, 12, 12),
    "en_route": (180, 180, 153, 135, 135, 117, 99, 81, 63, 45, 45, 27, 27, 27, 18, 18),
}
#: Acceleration of the error of a fast correction [m/s^2] for each degradation indicator ai (DO-229D, table A-8).
FAST_DEGRADATION_MPS2: Final = (
    0.0, 0.00005, 0.00009, 0.00012, 0.00015, 0.00020, 0.00030, 0.00045,
    0.00060, 0.00090, 0.00150, 0.00210, 0.00270, 0.00330, 0.00460, 0.00580,
)  # fmt: skip
#: Variance of fast and long-term corrections [m^2] for each UDREI; 14 and 15 have none (DO-229D, table A-6).
UDRE_VARIANCE_M2: Final = (
    0.0520, 0.0924, 0.1444, 0.2830, 0.4678, 0.8315, 1.2992, 1.8709,
    2.5465, 3.3260, 5.1968, 20.7870, 230.9661, 2078.695,
)  # fmt: skip
#: Variance of a grid point's vertical delay [m^2] for each GIVEI; 15 has none (DO-229D, table A-17).
GIVE_VARIANCE_M2: Final = (
    0.0084, 0.0333, 0.0749, 0.1331, 0.2079, 0.2994, 0.4075, 0.5322,
    0.6735, 0.8315, 1.1974, 1.8709, 3.3260, 20.7870, 187.0826,
)  # fmt: skip
#: Factor on sigma UDRE for each indicator in message type 27 (DO-229D, table A-20).
SERVICE_FACTOR: Final = (1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 20.0, 30.0, 40.0, 50.0, 100.0)
NOT_MONITORED: Final = 14  #: UDREI of a satellite that is not monitored.
DO_NOT_USE: Final = 15  #: UDREI of a satellite that must not be used.
STOP_S: Final = 60.0  #: After a message of type 0, the GEO is not used for this time [s] (DO-229D, A.4.4.1).
#: Messages older than this [s] are not used, even if type 6 renews a fast correction. The limit is the longest time-out
#: except that of service messages, to which the limit does not apply.
OLDEST_S: Final = max(of_mode for kind, both in TIMEOUT_S.items() if kind != "service" for of_mode in both)
#: Message types (stops and masks) that affect later messages, so that stops and masks are kept for twice `OLDEST_S`.
LEANT_ON: Final = (0, 1, 18)
INFLATION_M: Final = 8.0  #: Increase of sigma UDRE where degradation data are missing [m] (DO-229D, J.2.2).


class SatelliteState(IntEnum):
    """State of a satellite: usable (OK), or the first of the following reasons that applies."""

    OK = 0
    GEO_STOPPED = 1  #: Type 0 was received within the last 60 s.
    NO_MASK = 2  #: The PRN mask is missing or has timed out.
    NOT_IN_MASK = 3
    NO_FAST = 4
    DO_NOT_USE = 5  #: UDREI 15.
    NOT_MONITORED = 6  #: UDREI 14.
    TIMED_OUT = 7
    UDREI_TOO_LARGE = 8  #: UDREI above `SbasLimits.largest_udrei`.
    NO_LONG_TERM = 9
    IODE_MISMATCH = 10  #: No navigation record has the long-term correction's issue of data.
    NO_DEGRADATION = 11  #: Degradation data (types 7 and 10, and 28 if the GEO sends it) are missing.
    NO_RANGE_RATE = 12  #: A required range rate cannot be computed from fast corrections.


class IonosphereState(IntEnum):
    """State of the delay at a pierce point: known, or the reason why the delay is unknown."""

    OK = 0
    GEO_STOPPED = 1
    NO_GRID = 2  #: The mask has no cell around the pierce point.
    DO_NOT_USE = 3  #: A required grid point is marked "do not use".
    NOT_MONITORED = 4  #: A required grid point is not monitored, or was never sent.
    TIMED_OUT = 5
    NO_DEGRADATION = 6  #: Type 10 is missing; without it, a delay has no sigma.


def first_that_holds(cases: Sequence[tuple[Masks | np.bool_, int]], otherwise: int) -> Integers:
    """Return the value of the first condition that is true, any shape; `otherwise` where none is."""
    conditions, values = zip(*cases, strict=True)
    return np.asarray(np.select(conditions, values, otherwise), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class SatelliteCorrections(FrozenArrays):
    """Corrections for T epochs and K satellites; NaN or -1 where `state` is not OK, except in `udrei` and `iode`.

    The corrected code is ``code + fast_m``. The corrected satellite position is ``broadcast + position_m`` and the
    corrected satellite clock ``broadcast + clock_s``, both from the record with the issue of data `iode`.
    """

    state: Integers  #: `SatelliteState`, shape (T, K).
    fast_m: Floats  #: Correction to be added to the code, including its range-rate part; shape (T, K).
    rate_mps: Floats  #: Rate of change of `fast_m`, shape (T, K).
    position_m: Floats  #: Correction to be added to the satellite position, shape (T, K, 3).
    clock_s: Floats  #: Correction to be added to the satellite clock, shape (T, K).
    iode: Integers  #: Issue of data of the long-term correction used, -1 if none is used; shape (T, K).
    record: Integers  #: Row of `navigation.kepler` with this issue, -1 without navigation data; shape (T, K).
    udrei: Integers  #: UDREI, -1 where none was received; shape (T, K).
    sigma_udre_m: Floats  #: Sigma of the fast and long-term corrections without degradation, shape (T, K).
    #: Degradation terms (DO-229D, A.4.5.1), shape (T, K). Where `inflated`, `fast_growth_m` is 8 m, other terms are 0.
    fast_growth_m: Floats
    rate_growth_m: Floats
    long_term_growth_m: Floats
    en_route_m: Floats
    inflated: Masks  #: True where degradation data are missing and sigma UDRE is increased by 8 m, shape (T, K).
    rss: Masks  #: True where the degradation terms are combined by root-sum-square (RSS_UDRE of type 10), shape (T, K).
    covariance: Integers  #: Row of the covariance (type 28) in force, -1 if none is in force; shape (T, K).

    def take_satellites(self, which: Integers) -> SatelliteCorrections:
        """Return the corrections of the satellites with the indices `which`."""
        return SatelliteCorrections(**{item.name: getattr(self, item.name)[:, which] for item in fields(self)})

    def sigma_flt_m(self, delta_udre: Floats | float = 1.0) -> Floats:
        """Return the sigma of ranges after fast and long-term corrections, (T, K) [m] (DO-229D, A.4.5.1, J.2.2).

        `delta_udre` is the factor on sigma UDRE (`SbasCorrections.delta_udre`).
        """
        udre = self.sigma_udre_m * delta_udre
        terms = np.stack([udre, self.fast_growth_m, self.rate_growth_m, self.long_term_growth_m, self.en_route_m])
        squares = self.rss & ~self.inflated
        return np.asarray(np.where(squares, np.sqrt((terms**2).sum(axis=0)), terms.sum(axis=0)))


@dataclass(frozen=True, kw_only=True)
class IonosphereDelays(FrozenArrays):
    """Ionospheric delays from the grid, for T epochs and K satellites."""

    state: Integers  #: `IonosphereState`, shape (T, K).
    #: Slant delay on L1 to be subtracted from the code, shape (T, K); NaN where unknown. On other carriers the delay is
    #: (f1/f)^2 times as large.
    delay_m: Floats
    sigma_uire_m: Floats  #: Standard deviation of the slant delay on L1; NaN where unknown; shape (T, K).
    #: Ionospheric pierce point, shape (T, K).
    latitude_deg: Floats
    longitude_deg: Floats
    points: Integers  #: Number of grid points used in the interpolation: 4, 3, or 0; shape (T, K).

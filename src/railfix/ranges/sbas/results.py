"""Corrections of satellites and ionospheric delays at epochs, with their states."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np

from railfix.core.arrays import Floats, Integers, Masks, read_only


class SatelliteState(IntEnum):
    """Whether a satellite may be used, and why not; the first that holds of those listed."""

    OK = 0
    #: Type 0 was received within the last 60 s.
    GEO_STOPPED = 1
    #: There is no PRN mask, or it timed out.
    NO_MASK = 2
    NOT_IN_MASK = 3
    NO_FAST = 4
    #: UDREI 15.
    DO_NOT_USE = 5
    #: UDREI 14.
    NOT_MONITORED = 6
    TIMED_OUT = 7
    #: UDREI above `SbasLimits.largest_udrei`.
    UDREI_TOO_LARGE = 8
    NO_LONG_TERM = 9
    #: No navigation record has the issue of data of the long-term correction.
    IODE_MISMATCH = 10
    #: Degradation data (types 7, 10; 28 where it is sent) are missing.
    NO_DEGRADATION = 11
    #: Two fast corrections that give a rate are not there.
    NO_RANGE_RATE = 12


class IonosphereState(IntEnum):
    """Whether the delay at a pierce point is known, and why not."""

    OK = 0
    GEO_STOPPED = 1
    #: The mask has no cell of grid points around the pierce point.
    NO_GRID = 2
    #: A grid point that is needed must not be used.
    DO_NOT_USE = 3
    #: A grid point that is needed is not monitored, or was never sent.
    NOT_MONITORED = 4
    TIMED_OUT = 5
    #: The delay is there; without type 10 it has no sigma.
    NO_DEGRADATION = 6


class _Frozen:
    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, item.name, read_only(value))


@dataclass(frozen=True, kw_only=True)
class SatelliteCorrections(_Frozen):
    """Corrections of T epochs by K satellites; NaN and -1 where `state` is not OK, but for `udrei` and `iode`.

    The corrected code is ``code + fast_m``, with the satellite at ``broadcast + position_m`` and
    its clock ``broadcast + clock_s``, both of the record with the issue of data `iode`.
    """

    state: Integers  #: `SatelliteState`, shape (T, K).
    fast_m: Floats  #: To be added to the code; the range-rate part is in it; shape (T, K).
    rate_mps: Floats  #: Range-rate correction, shape (T, K).
    position_m: Floats  #: Shape (T, K, 3).
    clock_s: Floats  #: Shape (T, K).
    iode: Integers  #: Issue of data of the long-term correction taken, -1 without one; shape (T, K).
    record: Integers  #: Row of `navigation.kepler` with that issue, -1 without navigation data; shape (T, K).
    udrei: Integers  #: -1 where none was received, shape (T, K).
    sigma_udre_m: Floats  #: Shape (T, K).
    #: Degradation terms (DO-229D, A.4.5.1); 0 where `inflated`; shape (T, K).
    fast_growth_m: Floats
    rate_growth_m: Floats
    long_term_growth_m: Floats
    en_route_m: Floats
    inflated: Masks  #: Degradation data are missing: sigma is that of UDRE plus 8 m; shape (T, K).
    rss: Masks  #: The terms are summed as squares (RSS_UDRE of type 10), shape (T, K).
    covariance: Integers  #: Row of the covariance (type 28) in force, -1 without; shape (T, K).

    def take_satellites(self, which: Integers) -> SatelliteCorrections:
        """The corrections of some satellites, by index."""
        return SatelliteCorrections(**{item.name: getattr(self, item.name)[:, which] for item in fields(self)})

    def sigma_flt_m(self, delta_udre: Floats | float = 1.0) -> Floats:
        """Standard deviation after fast and long-term correction, shape (T, K) [m] (DO-229D, A.4.5.1 and J.2.2).

        Parameters
        ----------
        delta_udre : ndarray, shape (T, K), or float
            Factor on sigma UDRE (`SbasCorrections.delta_udre`).
        """
        udre = self.sigma_udre_m * delta_udre
        terms = np.stack([udre, self.fast_growth_m, self.rate_growth_m, self.long_term_growth_m, self.en_route_m])
        squares = self.rss & ~self.inflated
        return np.asarray(np.where(squares, np.sqrt((terms**2).sum(axis=0)), terms.sum(axis=0)))


@dataclass(frozen=True, kw_only=True)
class IonosphereDelays(_Frozen):
    """Delays of T epochs by K satellites from the grid."""

    state: Integers  #: `IonosphereState`, shape (T, K).
    delay_m: Floats  #: Slant delay on L1, to be taken off the code; other carriers scale by (f1/f)^2; shape (T, K).
    sigma_uire_m: Floats  #: Shape (T, K).
    #: Pierce point, shape (T, K).
    latitude_deg: Floats
    longitude_deg: Floats
    points: Integers  #: Grid points it was interpolated from: 4, 3, or 0; shape (T, K).

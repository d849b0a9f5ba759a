"""Risk budget of the filter's protection level, and kinds of measurement sources that have sub-filters.

The modules `subfilters` and `level` of `railfix.kernels.tracking` compute the sub-filters and the protection level.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Final

import scipy

from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.tracking.chunk import FORGOTTEN
from railfix.tracking.epochs import Kind
from railfix.tracking.limits import TrackingLimits

#: Name of the sensor of each measurement kind from `Kind.WHEEL` on.
SENSORS: Final = {kind: kind.name.lower() for kind in Kind if kind >= Kind.WHEEL}
#: Duration of a constellation fault until users are alerted [s] (ARAIM milestone 3 report: one hour).
CONSTELLATION_FAULT_S: Final = 3600.0
#: A kind of source has no sub-filters if the sum of the fault probabilities of `MOST_SOURCES` such sources is at most
#: this fraction of the risk.
SPARED: Final = 0.1
MOST_SOURCES: Final = 64
#: Risk allocated to the speed bound, as a fraction of the risk of the protection level.
SPEED_SHARE: Final = 0.01


class SourceKind(IntEnum):
    """Kinds of measurement sources that have sub-filters, in the order of `Budget.prior`."""

    SATELLITE = 0
    CONSTELLATION = 1
    SENSOR = 2
    MOTION = 3
    MAP = 4
    BALISE = 5
    SIDE = 6
    ALL_IN_VIEW = 7


#: Kinds of the sources other than satellites, constellations and sensors: all Dopplers, all phases, the codes of all
#: satellites ahead, the codes of all satellites behind, and the map. The sub-filter "all in view" excludes no source.
OTHERS: Final = {
    "doppler": SourceKind.MOTION,
    "phase": SourceKind.MOTION,
    "ahead": SourceKind.SIDE,
    "behind": SourceKind.SIDE,
    "map": SourceKind.MAP,
    "all in view": SourceKind.ALL_IN_VIEW,
}
#: Kind of each source other than a satellite.
KINDS: Final = {
    **dict.fromkeys(ix.CLOCKS, SourceKind.CONSTELLATION),
    **dict.fromkeys(SENSORS.values(), SourceKind.SENSOR),
    **dict.fromkeys((SENSORS[Kind.BALISE], SENSORS[Kind.NEXT_BALISE]), SourceKind.BALISE),
    **OTHERS,
}


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Risk per independent error, fault probabilities, and factors K computed from risk and probabilities."""

    #: Risk per independent error, after subtraction of the fault probabilities of sources without a sub-filter.
    risk: float
    k: float  #: Two-sided normal quantile of the risk.
    #: For each `SourceKind`, probability that a source is faulty or that its past fault still affects the filter; 0 for
    #: kinds without sub-filters.
    prior: tuple[float, ...]
    #: For each `SourceKind`, one-sided normal quantile of risk / prior, which is the smallest factor K of the sigma of
    #: a sub-filter; 0 for kinds without sub-filters.
    k_fault: tuple[float, ...]
    #: Two-sided normal quantile for the speed bound, which has a separate risk: `SPEED_SHARE` times the risk, divided
    #: equally among the sources.
    k_speed: float
    k_speed_fault: tuple[float, ...]  #: For each `SourceKind`, the factor K for the speed bound.


@lru_cache(maxsize=8)
def budget(limits: TrackingLimits) -> Budget:
    """Compute the risk budget of the protection level from the settings.

    A constellation fault is assumed to last for `CONSTELLATION_FAULT_S`, any other fault for the duration of one
    independent error. After its end, a fault still affects the state for `FORGOTTEN` code correlation times.
    """
    risk = limits.level_risk_per_hour / limits.level_samples_per_hour
    remembered_s = FORGOTTEN * constants.CODE_CORRELATION_S
    local = 1.0 + remembered_s * limits.level_samples_per_hour / 3600.0
    of_constellation = (1.0 + remembered_s / CONSTELLATION_FAULT_S) * limits.level_constellation_prior
    others = [limits.level_sensor_prior, limits.level_motion_prior, limits.level_map_prior]
    others += [limits.level_balise_prior, limits.level_side_prior]
    each = [local * limits.level_fault_prior, of_constellation, *(local * prior for prior in others), 0.0]
    exposed = [min(prior, 1.0) for prior in each]
    kept = [prior if MOST_SOURCES * prior > SPARED * risk else 0.0 for prior in exposed]
    risk -= MOST_SOURCES * sum(prior for prior, monitored in zip(exposed, kept, strict=True) if not monitored)
    of_speed = SPEED_SHARE * risk / (MOST_SOURCES + 1)

    def sigmas(share: float) -> tuple[float, ...]:
        return tuple(float(-scipy.special.ndtri(min(share / prior, 0.5))) if prior else 0.0 for prior in kept)

    return Budget(
        risk=risk,
        k=float(-scipy.special.ndtri(0.5 * risk)),
        prior=tuple(kept),
        k_fault=sigmas(risk),
        k_speed=float(-scipy.special.ndtri(0.5 * of_speed)),
        k_speed_fault=sigmas(of_speed),
    )

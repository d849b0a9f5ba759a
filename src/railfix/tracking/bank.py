"""Fault sources with a sub-filter in the protection level of the filtered position, and the risk budget.

`railfix.kernels.tracking.subfilters` has the sub-filters, `railfix.kernels.tracking.level` the level.
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

#: Sensor names by the kind of their rows.
SENSORS: Final = {kind: kind.name.lower() for kind in Kind if kind >= Kind.WHEEL}
#: Time from a constellation fault to the alert of users [s] (ARAIM milestone 3 report: one hour).
CONSTELLATION_FAULT_S: Final = 3600.0
#: A kind needs no sub-filters if the probabilities of so many sources of it sum to less than this fraction of the risk.
SPARED: Final = 0.1
MOST_SOURCES: Final = 64
#: Risk of the speed bound as a fraction of the risk of the position level.
SPEED_SHARE: Final = 0.01


class SourceKind(IntEnum):
    """Kind of a source of measurements that has a sub-filter, in the order of `Budget.prior`."""

    SATELLITE = 0
    CONSTELLATION = 1
    SENSOR = 2
    MOTION = 3
    MAP = 4
    BALISE = 5
    SIDE = 6
    ALL_IN_VIEW = 7


#: Further sources: all Dopplers, all phases, the codes of satellites ahead, of satellites behind, the map; and no
#: source, for all satellites in view.
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
    """Risk of an independent error and fault probabilities, with the factors computed from these."""

    risk: float
    k: float  #: Two-sided normal quantile of the risk: the sigmas that fault-free noise exceeds with this probability.
    #: Probability that a source of each `SourceKind` is faulty or an earlier fault is still in the filter; 0 needs no
    #: sub-filter.
    prior: tuple[float, ...]
    #: One-sided normal quantile of the risk over that probability: the minimum factor of a sub-filter's sigma.
    k_fault: tuple[float, ...]
    #: Two-sided and one-sided quantile for the speed bound, which has the additional fraction `SPEED_SHARE` of the
    #: risk, in equal parts for all sources.
    k_speed: float
    k_speed_fault: tuple[float, ...]


@lru_cache(maxsize=8)
def budget(limits: TrackingLimits) -> Budget:
    """Return the risk of an independent error and the fault probabilities of the sources.

    A source affects the filter as long as its errors stay in the state: for `FORGOTTEN` correlation times after the
    fault. A fault lasts for one independent error, a constellation fault for `CONSTELLATION_FAULT_S`.
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

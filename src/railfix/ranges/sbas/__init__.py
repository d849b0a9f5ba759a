"""SBAS: messages read and decoded, and what they say about satellites and delays (RTCA DO-229D, appendix A)."""

from railfix.ranges.sbas.corrections import SbasCorrections
from railfix.ranges.sbas.limits import SbasLimits
from railfix.ranges.sbas.log import SbasLog
from railfix.ranges.sbas.read import read_sbas
from railfix.ranges.sbas.results import IonosphereDelays, IonosphereState, SatelliteCorrections, SatelliteState
from railfix.ranges.sbas.troposphere import sigma_tropo_m, troposphere_m

__all__ = [
    "IonosphereDelays",
    "IonosphereState",
    "SatelliteCorrections",
    "SatelliteState",
    "SbasCorrections",
    "SbasLimits",
    "SbasLog",
    "read_sbas",
    "sigma_tropo_m",
    "troposphere_m",
]

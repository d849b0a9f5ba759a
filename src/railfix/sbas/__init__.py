"""SBAS: messages read and decoded, and what they say about satellites and delays (RTCA DO-229D, appendix A)."""

from railfix.sbas.corrections import SbasCorrections
from railfix.sbas.limits import SbasLimits
from railfix.sbas.log import SbasLog
from railfix.sbas.read import read_sbas
from railfix.sbas.results import IonosphereDelays, IonosphereState, SatelliteCorrections, SatelliteState
from railfix.sbas.troposphere import sigma_tropo_m, troposphere_m

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

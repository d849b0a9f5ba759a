"""SBAS: messages read and decoded, and the corrections that they give (RTCA DO-229D, appendix A)."""

from railfix.ranges.sbas.corrections import SbasCorrections, SbasState, best_prn
from railfix.ranges.sbas.files import from_receiver, read_sbas
from railfix.ranges.sbas.messages import SbasMessages
from railfix.ranges.sbas.results import IonosphereDelays, IonosphereState, SatelliteCorrections, SatelliteState
from railfix.ranges.sbas.standard import SbasLimits

__all__ = [
    "IonosphereDelays",
    "IonosphereState",
    "SatelliteCorrections",
    "SatelliteState",
    "SbasCorrections",
    "SbasLimits",
    "SbasMessages",
    "SbasState",
    "best_prn",
    "from_receiver",
    "read_sbas",
]

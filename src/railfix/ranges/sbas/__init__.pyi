# The names of `railfix.ranges.sbas`, imported at their first use (lazy-loader).

from .corrections import SbasCorrections, best_prn
from .dfmc import DfmcService
from .files import from_receiver, read_sbas
from .limits import SbasLimits
from .messages import SbasMessages
from .standard import IonosphereDelays, IonosphereState, SatelliteCorrections, SatelliteState
from .state import SbasState

__all__ = [
    "DfmcService",
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

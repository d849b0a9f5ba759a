"""SBAS: messages decoded, and what they say about satellites and the ionosphere (RTCA DO-229D, appendix A)."""

from railfix.sbas.limits import SbasLimits
from railfix.sbas.log import SbasLog
from railfix.sbas.read import read_sbas

__all__ = ["SbasLimits", "SbasLog", "read_sbas"]

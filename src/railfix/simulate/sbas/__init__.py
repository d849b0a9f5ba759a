"""Messages of a simulated SBAS that corrects the simulated errors."""

from railfix.simulate.sbas.settings import SbasSettings

__all__ = ["SbasSettings"]

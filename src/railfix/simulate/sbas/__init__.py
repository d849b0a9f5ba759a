"""Messages of a simulated SBAS that corrects the simulated errors."""

from railfix.simulate.settings import SbasSettings

__all__ = ["SbasSettings"]

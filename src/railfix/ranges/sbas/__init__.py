"""SBAS: messages read and decoded, and the corrections that they give (RTCA DO-229D, appendix A)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

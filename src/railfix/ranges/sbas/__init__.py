"""SBAS: readers and decoders of messages, and corrections computed from the messages (RTCA DO-229D, appendix A)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

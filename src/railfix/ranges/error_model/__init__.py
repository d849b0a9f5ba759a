"""Errors of corrected pseudoranges along a railway, by direction and C/N0: fit, file, use (P1 7)."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

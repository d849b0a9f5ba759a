"""Positions from corrected pseudoranges: normal equations, section search, and fix constrained to the line."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Report on runs: one HTML page with its tables and charts, readable without a network."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

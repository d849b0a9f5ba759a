"""Runs: reading of logs, positioning, and writing and reading of results folders."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

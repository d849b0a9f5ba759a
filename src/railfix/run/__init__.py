"""Runs: reading of logs, positioning, writing of result folders, and reading of these folders."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Positions of a log or stream, epoch by epoch: settings, processor, results."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Motion of the train from on-board sensors: speed, distance, wheel slip, and positions from features of the line."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

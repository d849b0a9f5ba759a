"""Motion of the train from its sensors: speeds, slips, features of the line, two-way ranges."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

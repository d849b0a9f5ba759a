"""Mean C/N0 over elevation of an antenna and receiver: fitted, kept in a small file, looked up."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

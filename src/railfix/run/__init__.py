"""Position logs and write the results: files in, tables of positions out, and the results read back."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

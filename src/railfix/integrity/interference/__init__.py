"""Detection of suspected jamming and spoofing from observations, positions and the receiver's own indicators."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

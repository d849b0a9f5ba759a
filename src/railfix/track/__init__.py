"""Track maps, networks of tracks, vehicles, and antenna trajectories (P1 2.2(1), 3.1(1), 4.2(1))."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Along-track filter of codes, Dopplers, carrier phases and sensor measurements, with a hypothesis per possible branch.

`track` requires epochs and the state after all previous epochs. It returns the positions of these epochs along the
trajectory, and the state after the last epoch. All quantities are numpy arrays.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

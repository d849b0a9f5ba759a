"""Filter along the track from codes, Dopplers, carrier phases and sensors, with hypotheses on the branch.

`track` takes epochs and the state after the previous epochs, and returns positions along the trajectory and the state
after these epochs. All quantities are numpy arrays.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

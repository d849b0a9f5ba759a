"""One filter along the track: codes, Dopplers, carrier phases and sensors, hypotheses over branches.

Plain functions over arrays: `track` takes epochs and the state left by earlier ones and returns places along the
trajectory and the new state.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

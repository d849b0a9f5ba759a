"""Carrier phase combined with code by the observation model of P4: slips, smoothed codes, float ambiguities.

The phase is precise to a few millimetres, up to an unknown constant per arc. `find_slips` detects the ends of arcs,
`smooth_codes` is the Hatch filter, and `phase_positions` estimates positions from code and phase with one ambiguity per
arc.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

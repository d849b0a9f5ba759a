"""Combination of carrier phase and code (P4): cycle slips, smoothed codes, float ambiguities.

The phase is precise to a few millimetres, except for an unknown constant per arc. An arc is a period in which a channel
has neither a cycle slip nor a gap. `find_slips` detects the starts of arcs, `smooth_codes` is the Hatch filter, and
`phase_positions` estimates positions from code and phase with one ambiguity per arc.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

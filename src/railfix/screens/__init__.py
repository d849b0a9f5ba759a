"""Screens: one file each, with its limits, metric, verdict, reason, columns and picture.

A screen measures one quantity in physical units and returns which observations fail. It never re-admits an observation
that another screen rejected; it returns verdicts, which the pipeline applies. `SCREENS` lists them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

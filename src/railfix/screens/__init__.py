"""Screens that test observations and positions. The module of a screen defines its limits, columns and picture.

A screen compares one physical quantity with a limit, and returns verdicts on the observations that fail. The pipeline
applies the verdicts. No screen re-admits an observation that another screen rejected. `SCREENS` lists all screens.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Simulated runs with ground truth: RINEX logs of two antennas of a train on a given or generated line.

`Scenario` has all settings, `load_scenario` reads one from TOML, `write_run` writes the files, `Simulation` returns the
arrays in chunks. The same scenario gives the same numbers. ``railfix simulate`` is the same from the command line.

Atmospheric delays and the rigid body are computed here independently of the packages that the estimators
use, by the same published formulas, so that an error in either causes a position error.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

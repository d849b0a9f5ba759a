"""Simulated runs with ground truth: RINEX logs of two antennas of a train on a given or generated line.

`Scenario` has all settings. `load_scenario` reads a scenario from TOML, `write_run` writes the files of a run, and
`Simulation` returns the arrays in chunks. Identical scenarios produce identical results. The command ``railfix
simulate`` writes the same files.

Antenna positions on the vehicle are computed by a different method than in `railfix.track`, so that a mistake in either
computation shows as a position error.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

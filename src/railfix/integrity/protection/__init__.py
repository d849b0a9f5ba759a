"""Protection level along the track (P1 2.4): a bound that the position error exceeds with at most the stated risk.

Levels are computed from a model of `railfix.integrity.raim`::

    risk = RiskBudget()
    model = linear_model(ranges, trajectory, arc_m)
    got = protection_level(model, systems, risk=risk, n_excluded=n_excluded)
    status = availability(got.level_m, 20.0, consistent=got.consistent)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

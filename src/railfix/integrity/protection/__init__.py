"""Protection level along the track (P1 2.4): a bound on the position error for a stated risk.

Protection levels are computed from a `railfix.integrity.raim.LinearModel`::

    risk = RiskBudget()
    model = linear_model(ranges, trajectory, arc_m)
    got = protection_level(model, systems, risk=risk, n_excluded=n_excluded)
    status = availability(got.level_m, 20.0, consistent=got.consistent)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""RAIM: fault detection, exclusion of up to two satellites, and reliability (P1 2.3(4); P4).

Exclusion and reliability use a `LinearModel` of the position, on the line or in space::

    detection = detect(constrained.wsse, constrained.residual_m, ranges.n_used - ranges.n_clocks - 1, scale=scale)
    failing = np.flatnonzero(detection.detected)
    model = linear_model(ranges.take(failing), trajectory, constrained.arc_m[failing])
    exclusion = exclude(model, scale=scale[failing])
    # solve again without the channels in `exclusion.excluded`, then
    level = reliability(linear_model(ranges, trajectory, constrained.arc_m), scale=scale).protection_level_m

The noise scale multiplies the range sigmas after the fit. The fit itself uses unscaled weights, so that the noise scale
does not change the relative weights of ranges and map error.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

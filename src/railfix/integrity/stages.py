"""RAIM and protection level of positions on the line, from plain arrays: each a stage by hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats, Strings
from railfix.integrity.protection.level import ProtectionLevel, along_track_level
from railfix.integrity.protection.risk import RiskBudget
from railfix.integrity.raim.exclusion import Exclusion, RaimLimits, exclude
from railfix.integrity.raim.model import constrained_model
from railfix.positioning.normal_equations import Ranges
from railfix.track.trajectory import Trajectory


def exclude_faults(
    ranges: Ranges, trajectory: Trajectory, arc_m: Floats, *, scale: ArrayLike = 1.0, limits: RaimLimits | None = None
) -> Exclusion:
    """Test the ranges of each epoch against each other and name up to two faulty satellites.

    Parameters
    ----------
    ranges : Ranges
        Of `railfix.positioning.weighted_ranges`.
    trajectory : Trajectory
    arc_m : ndarray, shape (T,) [m]
        Positions (`Constrained.arc_m` of `railfix.positioning.position_on_line`).
    scale : array_like, shape (T,) or ()
        Noise of the receiver over that of the sigmas.
    limits : RaimLimits, optional

    Returns
    -------
    Exclusion
        Positions without the excluded satellites are those of `position_on_line` with NaN in their codes.
    """
    return exclude(constrained_model(ranges, trajectory, arc_m), limits=limits, scale=scale)


def protection_level(
    ranges: Ranges,
    trajectory: Trajectory,
    arc_m: Floats,
    *,
    satellite: Strings,
    risk: RiskBudget | None = None,
    scale: ArrayLike = 1.0,
    n_excluded: ArrayLike = 0,
) -> ProtectionLevel:
    """Compute the protection level along the line: faults of satellites and constellations, without those of the map.

    Parameters
    ----------
    ranges, trajectory, arc_m, scale
        As for `exclude_faults`, after the exclusions.
    satellite : ndarray of str, shape (M,)
        Names, for the priors of their constellations.
    risk : RiskBudget, optional
    n_excluded : array_like of int, shape (T,) or ()
        Satellites that `exclude_faults` took out.
    """
    model = constrained_model(ranges, trajectory, arc_m)
    systems = [name[0] for name in np.asarray(satellite).tolist()]
    return along_track_level(model, systems, risk=risk, scale=scale, n_excluded=n_excluded)

"""Other places of the line that the ranges leave open at the risk of the protection level.

A level is a distance around one place. Where another branch, the next track or another pass of the line explains the
ranges as well, without a fault or with a fault in any one satellite, the error can be the distance between the two: the
level must reach that far, or the status must name it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from railfix.core.arrays import Floats, Masks
from railfix.integrity.protection import RiskBudget
from railfix.integrity.raim import LinearModel, constrained_model
from railfix.integrity.raim.exclusion import LEAST_REDUNDANCY
from railfix.integrity.raim.model import Compact, compact
from railfix.pipeline.config import Config
from railfix.pipeline.solve import Place
from railfix.positioning.constrained import constrained_position
from railfix.positioning.normal_equations import Ranges
from railfix.track.trajectory import Trajectory


def places_beyond_the_level(
    ranges: Ranges,
    trajectory: Trajectory,
    place: Place,
    model: LinearModel,
    level_m: Floats,
    scale: Floats,
    systems: Sequence[str],
    risk: RiskBudget,
    config: Config,
) -> Masks:
    """Return the epochs whose best other place is open at the level's risk and beyond the level, shape (T,).

    Leaving out satellite i lowers the sum of squares at a place by ``nu_i^2 / S_ii``. The other place is open where it
    fits worse than the best one by no more than noise explains with the risk of a sample over the prior of the
    hypothesis: none, or a fault of one satellite.

    Parameters
    ----------
    ranges : Ranges
    trajectory : Trajectory
    place : Place
        Its `section.other_vertex` is the other place.
    model : LinearModel
        Of the positions.
    level_m : ndarray, shape (T,) [m]
    scale : ndarray, shape (T,)
        Noise scale.
    systems : sequence of str
        Constellation letter of each channel.
    risk : RiskBudget
    config : Config
    """
    beyond = np.zeros(len(ranges), dtype=bool)
    arc, other = place.constrained.arc_m, place.section.other_vertex
    rows = np.flatnonzero((other >= 0) & np.isfinite(arc) & np.isfinite(model.wsse))
    if not len(rows):
        return beyond
    part = ranges.take(rows)
    there = constrained_position(part, trajectory, other[rows], limits=config.constrained)
    elsewhere = constrained_model(part, trajectory, there.arc_m, section=np.maximum(there.section, 0))
    here = model.take(rows)
    at_best, at_other = compact(here), compact(elsewhere)
    variance = np.maximum(scale[rows], 1.0) ** 2
    worse = (elsewhere.wsse - here.wsse) / variance
    without = worse[:, None] - (_drops(at_other) - _drops(at_best)) / variance[:, None]
    prior = risk.prior(systems)[at_best.channel]
    allowed = chdtri(1, np.minimum(risk.risk_per_sample / np.maximum(prior, risk.risk_per_sample), 1.0))
    with np.errstate(invalid="ignore"):
        opened = worse <= chdtri(1, risk.risk_per_sample)
        opened |= (at_best.used & (without <= allowed)).any(axis=1)
        apart = np.linalg.norm(trajectory.at_arc(there.arc_m) - trajectory.at_arc(arc[rows]), axis=1)
        beyond[rows] = opened & (apart > level_m[rows])
    return beyond


def _drops(parts: Compact) -> Floats:
    """Decrease of the sum of squares when each channel is left out, shape (T, n)."""
    share = np.einsum("tii->ti", parts.projector)
    checked = parts.used & (share > LEAST_REDUNDANCY)
    return np.where(checked, parts.residual**2 / np.where(checked, share, 1.0), 0.0)

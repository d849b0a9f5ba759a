"""How far the position moves without a group of satellites: those of one side, or a constellation with one more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.integrity.protection.separation import NO_EFFECT, AllInView, Separations, separations
from railfix.integrity.raim.exclusion import LEAST_REDUNDANCY


@dataclass(frozen=True)
class _Group:
    """A group of channels left out, T epochs."""

    place: Indices  # (T, m) of the group in the compact arrays, and of others where it has fewer
    inverse: Floats  # (T, m, m) S_JJ^+; 0 for others
    square: Floats  # (T,) variance of the distance
    moved: Floats  # (T,)
    response: Floats  # (T, 2) of the distance to the map error
    blind: Masks  # (T,)

    def across(self, projector: Floats) -> Floats:
        """Return what of the rest falls onto the group, ``S S_JJ^+``, shape (T, n, n)."""
        whole, epoch = np.zeros(projector.shape), np.arange(len(projector))[:, None, None]
        whole[epoch, self.place[:, :, None], self.place[:, None, :]] = self.inverse
        return np.asarray(projector @ whole)


def _group(full: AllInView, members: Masks) -> _Group:
    """``S_JJ^+`` of a group of channels, and what leaving it out does.

    Where S_JJ is singular (a clock of the group alone), the direction that no residual shows must move nothing.
    """
    most = max(1, int(np.count_nonzero(members, axis=1).max(initial=0)))
    place = np.argsort(~members, axis=1, kind="stable")[:, :most]
    epoch = np.arange(len(members))[:, None]
    mask = members[epoch, place].astype(np.float64)
    both = mask[:, :, None] * mask[:, None, :]
    gain, residual = full.gain_m[epoch, place] * mask, full.residual[epoch, place]
    values, vectors = np.linalg.eigh(full.projector[epoch[..., None], place[:, :, None], place[:, None, :]] * both)
    some = values > LEAST_REDUNDANCY
    inverse = (vectors * np.where(some, 1.0 / np.where(some, values, 1.0), 0.0)[:, None, :]) @ vectors.swapaxes(1, 2)
    inverse *= both
    hidden = np.einsum("tij,ti->tj", vectors, gain) * ~some
    pull = np.einsum("tij,tj->ti", inverse, gain)
    return _Group(
        place=place,
        inverse=inverse,
        square=(pull * gain).sum(axis=1),
        moved=-(pull * residual).sum(axis=1),
        response=np.einsum("ti,tij->tj", pull, full.map_gain_m[epoch, place]),
        blind=np.sqrt((hidden**2).sum(axis=1)) > NO_EFFECT * np.sqrt(full.variance_m2),
    )


def without_group(full: AllInView, members: Masks) -> Separations:
    """Any group of channels left out whole, K = 1.

    Parameters
    ----------
    full : AllInView
    members : ndarray of bool, shape (T, n)
        Places of the group in the compact arrays; some epochs may have none.
    """
    group = _group(full, members)
    left = None
    if full.by_range:
        left = (full.gain_m - np.einsum("tij,tj->ti", group.across(full.projector), full.gain_m))[:, None]
    return separations(
        full, group.square[:, None], group.response[:, None], group.moved[:, None], left, group.blind[:, None]
    )


def without_constellation_and_one(full: AllInView, members: Masks) -> Separations:
    """A whole constellation left out with each channel of the others, K = n.

    What leaving out the constellation J makes of the projector, the residuals and the gains of the rest,
    ``S - S_.J S_JJ^+ S_J.`` and the like, is what `without_one` needs of it.

    Parameters
    ----------
    all_of : Whole
    members : ndarray of bool, shape (T, n)
        Places of the constellation in the compact arrays; some epochs may have none.
    """
    group = _group(full, members)
    rest, across = full.used & ~members, group.across(full.projector)
    projector, gain = full.projector, full.gain_m
    left_gain = rest * (gain - np.einsum("tij,tj->ti", across, gain))
    left_residual = rest * (full.residual - np.einsum("tij,tj->ti", across, full.residual))
    left_map = rest[..., None] * (full.map_gain_m - across @ full.map_gain_m)
    left_projector = (projector - across @ projector) * (rest[:, :, None] & rest[:, None, :])
    share = np.einsum("tii->ti", left_projector)
    checked = share > LEAST_REDUNDANCY
    weight = np.where(checked, left_gain / np.where(checked, share, 1.0), 0.0)
    left = left_gain[:, None, :] - weight[:, :, None] * left_projector if full.by_range else None
    alone = ~checked & (np.abs(left_gain) > NO_EFFECT * np.sqrt(full.variance_m2)[:, None])
    return separations(
        full,
        np.maximum(group.square[:, None] + weight * left_gain, 0.0),
        group.response[:, None] + weight[..., None] * left_map,
        group.moved[:, None] - weight * left_residual,
        left,
        (alone | group.blind[:, None]) & rest,
    )

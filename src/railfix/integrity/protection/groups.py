"""How far the position moves without a group of satellites: those of one side, or a constellation with one more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.integrity.protection.separation import NO_EFFECT, AllInView, Separations, separations
from railfix.integrity.raim.exclusion import LEAST_REDUNDANCY


@dataclass(frozen=True)
class _Group:
    """Groups of channels, T epochs, left out member by member as in `separation.without_two`.

    Columns are those of the projector, then gain, residual and response to the map error across and up.
    """

    columns: Floats  # (T, n, n + 4) of all channels
    rows: Floats  # (T, m, n + 4) of each member, those before it left out
    scaled: Floats  # (T, m, n + 4) the same over what checks the member
    gone: Floats  # (T, 4) variance of the distance, -distance, its response to the map error across and up
    blind: Masks  # (T,) nothing bounds a fault

    def left(self) -> Floats:
        """Return the columns without the group, shape (T, n, n + 4)."""
        n = self.columns.shape[1]
        return np.asarray(self.columns - self.rows[..., :n].swapaxes(1, 2) @ self.scaled)


def _group(full: AllInView, members: Masks) -> _Group:
    epochs, n = members.shape
    limit = NO_EFFECT * np.sqrt(full.variance_m2)
    place = np.argsort(~members, axis=1, kind="stable")[:, : int(np.count_nonzero(members, axis=1).max(initial=0))]
    columns = np.concatenate(
        [full.projector, full.gain_m[..., None], full.residual[..., None], full.map_gain_m], axis=2
    )
    at = np.arange(epochs)[:, None]
    rows = columns[at, place] * members[at, place][..., None]
    scaled, blind = np.empty_like(rows), np.zeros(epochs, dtype=bool)
    for k in range(place.shape[1]):
        row, later = rows[:, k], rows[:, k + 1 :]
        share = row[at[:, 0], place[:, k]]
        checked = share > LEAST_REDUNDANCY
        blind |= ~checked & (np.abs(row[:, n]) > limit)
        scaled[:, k] = row / np.where(checked, share, np.inf)[:, None]
        later -= np.take_along_axis(later, place[:, None, k, None], axis=2) * scaled[:, k, None]
    return _Group(
        columns=columns,
        rows=rows,
        scaled=scaled,
        gone=np.einsum("tm,tmc->tc", rows[..., n], scaled[..., n:]),
        blind=blind,
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
    left = group.left()[:, None, :, -4] if full.by_range else None
    return separations(full, group.gone[..., None], left, group.blind[:, None])


def without_group_and_one(full: AllInView, members: Masks) -> Separations:
    """A group of channels left out with each channel of the others, K = n; parameters as `without_group`."""
    group, rest, n = _group(full, members), full.used & ~members, full.channel.shape[1]
    left = group.left()
    share = rest * np.einsum("tii->ti", left[..., :n])
    checked = share > LEAST_REDUNDANCY
    own = rest[..., None] * left[..., n:]
    weight = own[..., 0] / np.where(checked, share, np.inf)
    gone = group.gone[..., None] + (weight[..., None] * own).swapaxes(1, 2)
    alone = ~checked & (np.abs(own[..., 0]) > NO_EFFECT * np.sqrt(full.variance_m2)[:, None])
    kept = left[:, None, :, n] - weight[..., None] * left[..., :n] if full.by_range else None
    return separations(full, gone, kept, (alone | group.blind[:, None]) & rest)

"""Linear interpolation of a reference trajectory at other times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks
from railfix.core.timescale import seconds

#: Longest gap of a reference that is interpolated over [s].
LARGEST_GAP_S = 2.5


@dataclass(frozen=True, kw_only=True)
class Bracket:
    """Neighbouring instants of the reference for each of T times."""

    #: The same where a time is one of the reference, shape (T,).
    left: Indices
    right: Indices
    share: Floats  #: 0 at left, 1 at right; shape (T,).
    inside: Masks  #: False before the first, after the last, and in gaps of the reference; shape (T,).

    def of(self, values: Floats) -> Floats:
        """Values of the reference, shape (R,) or (R, n), interpolated linearly; NaN where not inside."""
        across = (-1, *(1,) * (values.ndim - 1))
        between = values[self.left] + self.share.reshape(across) * (values[self.right] - values[self.left])
        return np.where(self.inside.reshape(across), between, np.nan)

    @property
    def nearest(self) -> Indices:
        """Index of the nearer instant, shape (T,)."""
        return np.where(self.share <= 0.5, self.left, self.right)


def bracket(time: Datetimes, reference_time: Datetimes, *, largest_gap_s: float = LARGEST_GAP_S) -> Bracket:
    """Neighbouring instants of a reference, rising and at least two, for each time.

    Raises
    ------
    ValueError
        Fewer than two instants of the reference.
    """
    if len(reference_time) < 2:
        raise ValueError(f"reference_time has {len(reference_time)} instants, at least two were expected")
    last = len(reference_time) - 1
    after = np.searchsorted(reference_time, time, side="left")
    exact = (after <= last) & (reference_time[np.minimum(after, last)] == time)
    right = np.clip(after, 1, last)
    left = right - 1
    step = seconds(reference_time[right] - reference_time[left])
    share = seconds(time - reference_time[left]) / step
    inside = (after > 0) & (after <= last) & (step <= largest_gap_s)
    at = np.minimum(after, last)
    return Bracket(
        left=np.where(exact, at, left),
        right=np.where(exact, at, right),
        share=np.where(exact, 0.0, share),
        inside=inside | exact,
    )

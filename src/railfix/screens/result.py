"""What every screen returns."""

from __future__ import annotations

from dataclasses import dataclass

from railfix.core.arrays import Floats, Masks


@dataclass(frozen=True, kw_only=True)
class Screened:
    """Verdict of one screen, T epochs by M channels.

    Attributes
    ----------
    metric : ndarray, shape (T, M)
        What was measured, in the unit that the screen names; NaN where it cannot judge.
    reject : ndarray of bool, shape (T, M)
        True = rejected. Where the metric is NaN the screen does not reject.
    """

    metric: Floats
    reject: Masks

"""Signal strength against what an open sky gives at the elevation, and an absolute floor (P1 2.3(1)).

Reflected, bent and shaded signals are weak. A limit that is the same for all elevations either lets
bad signals of high satellites pass or loses good ones of low satellites, so P1 measures the mean over
elevation for the antenna and receiver on a day of open sky (`railfix.ranges.cn0_curve`), and refuses what
lies 10 dB-Hz below it; and, for all satellites alike, what lies below 30 dB-Hz (table 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Strings
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.screens.result import Screened

#: What `Cn0Screened.judged_by` says of a channel.
BY_BOTH, BY_CURVE, BY_FLOOR, BY_NOTHING = "curve and floor", "curve", "floor", "nothing"
_WORDS: Final = np.array([BY_NOTHING, BY_FLOOR, BY_CURVE, BY_BOTH])


@dataclass(frozen=True, kw_only=True)
class Cn0Limits:
    """Limits of the screen of signal strength.

    Attributes
    ----------
    deficit_dbhz : float or None [dB-Hz]
        Largest deficit against the mean at the elevation; P1 table 6: 10. None switches the
        curve off.
    floor_dbhz : float or None [dB-Hz]
        Weakest signal used; P1 table 6: 30, for its receivers. C/N0 is measured differently by each
        receiver: 30 refuses over half of the signals of an M8T in a city, where 20 to 25 fits. None
        switches the floor off.
    """

    deficit_dbhz: float | None = 10.0
    floor_dbhz: float | None = 30.0

    def __post_init__(self) -> None:
        if self.deficit_dbhz is not None and not 0.0 < self.deficit_dbhz < np.inf:
            raise ValueError(f"deficit_dbhz must be positive and finite, or None, got {self.deficit_dbhz}")
        if self.floor_dbhz is not None and not 0.0 < self.floor_dbhz < 100.0:
            raise ValueError(f"floor_dbhz must lie between 0 and 100, or be None, got {self.floor_dbhz}")


@dataclass(frozen=True, kw_only=True)
class Cn0Screened:
    """Verdicts on signal strength, two screens with a reason each.

    Attributes
    ----------
    floor : Screened
        The metric is C/N0 [dB-Hz].
    curve : Screened
        The metric is the deficit, mean at the elevation less C/N0 [dB]; NaN where the curve does not
        reach: no curve given, none for the constellation and signal, elevation unknown or below
        the lowest of the curve.
    judged_by : ndarray of str, shape (M,)
        Of each channel "curve and floor", "curve", "floor" or "nothing".
    """

    floor: Screened
    curve: Screened
    judged_by: Strings

    @property
    def note(self) -> str:
        """One sentence on what was used, for the output."""
        if not len(self.judged_by):
            return "C/N0: no channels"
        words, counts = np.unique(self.judged_by, return_counts=True)
        parts = [
            f"{word} on {count} of {len(self.judged_by)} channels" for word, count in zip(words, counts, strict=True)
        ]
        return "C/N0 judged by " + ", ".join(parts)


def cn0_screen(
    cn0_dbhz: ArrayLike,
    elevation_deg: ArrayLike,
    *,
    satellite: Strings,
    signal: Strings,
    limits: Cn0Limits | None = None,
    curve: Cn0Curve | None = None,
) -> Cn0Screened:
    """Refuse signals that are too weak.

    Parameters
    ----------
    cn0_dbhz : array_like, shape (T, M) [dB-Hz]
        NaN where the log does not tell: not judged.
    elevation_deg : array_like, shape (T, M) [deg]
    satellite, signal : ndarray of str, shape (M,)
    limits : Cn0Limits, optional
    curve : Cn0Curve, optional
        Without one the floor alone judges, and `judged_by` says so.

    Returns
    -------
    Cn0Screened
        At the limit exactly a signal is used.
    """
    limits = limits or Cn0Limits()
    cn0 = np.asarray(cn0_dbhz, dtype=np.float64)
    elevation = np.asarray(elevation_deg, dtype=np.float64)
    deficit = np.full(cn0.shape, np.nan)
    by_curve = np.zeros(len(satellite), dtype=np.int64)
    if curve is not None and limits.deficit_dbhz is not None:
        deficit = curve.mean_dbhz(elevation, satellite=satellite, signal=signal) - cn0
        by_curve += curve.covers(satellite, signal)
    none = np.zeros(cn0.shape, dtype=bool)
    return Cn0Screened(
        floor=Screened(metric=cn0, reject=none if limits.floor_dbhz is None else cn0 < limits.floor_dbhz),
        curve=Screened(metric=deficit, reject=none if limits.deficit_dbhz is None else deficit > limits.deficit_dbhz),
        judged_by=_WORDS[2 * by_curve + (limits.floor_dbhz is not None)],
    )

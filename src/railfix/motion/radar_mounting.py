"""A moved mounting of the radar, by a step of the ratio of its speeds to those by satellites.

The speed of a radar that looks down at the angle alpha is wrong by ``tan(alpha)`` times the error of the angle: 1.7 %
a degree at 45 degrees (P2 3.1).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.timescale import seconds
from railfix.motion.samples import RadarSpeeds

#: The ratio is taken over windows of this length [ns] with so many speeds, of a train faster than this [m/s].
_WINDOW_NS: Final = 30_000_000_000
_LEAST_SPEEDS: Final = 10
#: A speed of the radar belongs to one by satellites that is so near [s].
_NEAR_S: Final = 0.15
_MOVING_MPS: Final = 3.0
#: Windows before a step that it is a step from, at least and at most, and windows after it that show it.
_LEAST_BEFORE: Final = 5
_MOST_BEFORE: Final = 20
_AFTER: Final = 3
#: Least step that is told, and how many times the scatter of the windows.
_STEP: Final = 0.01
_SCATTERS: Final = 5.0
_LEAST_SCATTER: Final = 0.001


@dataclass(frozen=True)
class MountingStep:
    """The radar's speeds over those by satellites, less 1, before and from an instant on."""

    time: np.datetime64
    before: float
    after: float

    @property
    def sentence(self) -> str:
        """What to say of it."""
        at = np.datetime_as_string(self.time, unit="s")
        after, before = (f"{round(100.0 * share, 1) + 0.0:+.1f} %" for share in (self.after, self.before))
        return (
            f"radar: from {at} on its speeds are {after} off those by satellites, {before} before; has its mounting "
            "moved?"
        )


@dataclass(kw_only=True)
class RadarMounting:
    """Ratios by window of GPS time, taken in order of time; nothing grows with the length of a session.

    Attributes
    ----------
    ratio : deque of float
        Of the last windows.
    window : deque of int
        Their numbers since the epoch of the clock.
    """

    ratio: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_BEFORE + _AFTER))
    window: deque[int] = field(default_factory=lambda: deque(maxlen=_MOST_BEFORE + _AFTER))
    _open: int = -1
    _sums: Floats = field(default_factory=lambda: np.zeros(3))

    def take(self, time: Datetimes, radar_mps: Floats, right_mps: Floats) -> list[MountingStep]:
        """Take speeds of both at the same instants, later than those before; return the steps that they show.

        Parameters
        ----------
        time : ndarray of datetime64[ns], shape (N,)
        radar_mps, right_mps : ndarray, shape (N,) [m/s]
            NaN where nothing was measured.
        """
        use = np.isfinite(radar_mps) & (np.abs(right_mps) > _MOVING_MPS)
        radar, right = np.abs(radar_mps[use]), np.abs(right_mps[use])
        windows, row = np.unique(time[use].astype(np.int64) // _WINDOW_NS, return_inverse=True)
        weights = (np.ones(len(right)), radar * right, right * right)
        sums = np.stack([np.bincount(row, weight, minlength=len(windows)) for weight in weights], axis=-1)
        found = []
        for window, of_window in zip(windows.tolist(), sums, strict=True):
            if window != self._open:
                found += self._closed()
                self._open, self._sums = window, np.zeros(3)
            self._sums = self._sums + of_window
        return found

    def take_samples(self, radar: RadarSpeeds, time: Datetimes, right_mps: Floats) -> list[MountingStep]:
        """Take speeds by satellites with the radar's own that are nearest to each; see `take`."""
        if not len(radar):
            return []
        after = np.clip(np.searchsorted(radar.time, time), 1, max(len(radar) - 1, 1))
        late = np.abs(seconds(radar.time[np.minimum(after, len(radar) - 1)] - time))
        early = np.abs(seconds(time - radar.time[after - 1]))
        nearest = np.where(late < early, np.minimum(after, len(radar) - 1), after - 1)
        near = np.minimum(late, early) <= _NEAR_S
        return self.take(time, np.where(near, radar.speed_mps[nearest], np.nan), right_mps)

    def _closed(self) -> list[MountingStep]:
        """End a window; a step it completes."""
        count, product, square = self._sums.tolist()
        if count < _LEAST_SPEEDS:
            return []
        self.ratio.append(product / square - 1.0)
        self.window.append(self._open)
        if len(self.ratio) < _LEAST_BEFORE + _AFTER:
            return []
        ratios = np.array(self.ratio)
        before, after = ratios[:-_AFTER], ratios[-_AFTER:]
        middle = float(np.median(before))
        scatter = max(1.4826 * float(np.median(np.abs(before - middle))), _LEAST_SCATTER)
        apart = after - middle
        if not (np.abs(apart).min() > max(_STEP, _SCATTERS * scatter) and abs(np.sign(apart).sum()) == _AFTER):
            return []
        begin = np.datetime64(self.window[-_AFTER] * _WINDOW_NS, "ns")
        for _ in range(len(ratios) - _AFTER):  # what comes next is held against what is now
            self.ratio.popleft()
            self.window.popleft()
        return [MountingStep(begin, middle, float(np.median(after)))]

"""Detection of a radar's scale step or missing speeds, by comparison with speeds from satellite Dopplers."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.nearest_times import nearest_rows
from railfix.motion.samples import RadarSpeeds

_WINDOW_NS: Final = 30_000_000_000  #: Length of the windows over which the ratio of the speeds is computed [ns].
_LEAST_SPEEDS: Final = 10  #: Windows with fewer compared speeds are not used.
#: Largest time difference between a radar speed and the satellite-derived speed with which it is compared [ns].
_NEAR_NS: Final = 150_000_000
_MOVING_MPS: Final = 3.0  #: Lowest speed of the train at which speeds are compared [m/s].
_LEAST_BEFORE: Final = 5  #: Minimum number of windows required before a step.
_MOST_BEFORE: Final = 20  #: Maximum number of windows used before a step.
_AFTER: Final = 3  #: Number of windows used after a step.
_SILENT: Final = 2  #: An alarm is raised after this number of consecutive windows without radar speeds.
_STEP: Final = 0.01  #: Smaller steps of the ratio of the speeds are not reported.
_SCATTERS: Final = 5.0  #: Steps smaller than this multiple of the scatter before the step are not reported.
_LEAST_SCATTER: Final = 0.001  #: Lower bound of the scatter of the ratio before a step.


@dataclass(frozen=True, kw_only=True)
class RadarAlarm:
    """Alarm raised by the comparison of radar speeds with satellite-derived speeds."""

    #: "mounting": the ratio of the speeds has a step. "silent": there is no radar speed while the train moves.
    kind: Literal["mounting", "silent"]
    time: np.datetime64  #: Start of the first window with the fault.
    #: Ratio of the radar speed to the satellite-derived speed, minus 1, before and after a step; NaN if "silent".
    before: float = float("nan")
    after: float = float("nan")

    @property
    def sentence(self) -> str:
        """Text of the alarm for the user."""
        at = np.datetime_as_string(self.time, unit="s")
        if self.kind == "silent":
            return f"radar: no speed since {at} while the train moves; check whether snow or dirt covers the radar"
        after, before = (f"{round(100.0 * share, 1) + 0.0:+.1f} %" for share in (self.after, self.before))
        return (
            f"radar: from {at} on, its speeds differ from satellite-derived speeds by {after} ({before} before); "
            "check the mounting of the radar"
        )


@dataclass(kw_only=True)
class RadarWatch:
    """Ratios of radar speed to satellite-derived speed in the last windows."""

    #: Ratio of the radar speed to the satellite-derived speed, minus 1, in each window.
    ratio: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_BEFORE + _AFTER))
    #: Index of each window, counted from 1970.
    window: deque[int] = field(default_factory=lambda: deque(maxlen=_MOST_BEFORE + _AFTER))
    silent: int = 0  #: Number of consecutive windows without a radar speed.
    _open: int = -1
    _sums: Floats = field(default_factory=lambda: np.zeros(4))

    def take(self, time: Datetimes, radar_mps: Floats, right_mps: Floats) -> list[RadarAlarm]:
        """Process new radar speeds and satellite-derived speeds, and return the resulting alarms.

        All arrays have shape (N,). `time` must be later than all previous times. `right_mps` are the satellite-derived
        speeds. Missing speeds are NaN.
        """
        moving = np.abs(right_mps) > _MOVING_MPS
        heard = np.isfinite(radar_mps[moving])
        radar, right = np.abs(np.nan_to_num(radar_mps[moving])), np.abs(right_mps[moving])
        windows, row = np.unique(time[moving].astype(np.int64) // _WINDOW_NS, return_inverse=True)
        weights = (np.ones(len(right)), heard, heard * radar * right, heard * right * right)
        sums = np.stack([np.bincount(row, weight, minlength=len(windows)) for weight in weights], axis=-1)
        found = []
        for window, of_window in zip(windows.tolist(), sums, strict=True):
            if window != self._open:
                found += self._close()
                self._open, self._sums = window, np.zeros(4)
            self._sums = self._sums + of_window
        return found

    def take_samples(self, radar: RadarSpeeds, time: Datetimes, right_mps: Floats) -> list[RadarAlarm]:
        """Add satellite-derived speeds, each with the radar speed nearest in time, and return the resulting alarms."""
        row = nearest_rows(radar.time, time, within_ns=_NEAR_NS)
        return self.take(time, np.append(radar.speed_mps, np.nan)[row], right_mps)

    def _close(self) -> list[RadarAlarm]:
        """Close the open window, and return the alarms that this window raises."""
        moving, count, product, square = self._sums.tolist()
        if moving >= _LEAST_SPEEDS:
            self.silent = self.silent + 1 if count == 0 else 0
            if self.silent == _SILENT:
                return [RadarAlarm(kind="silent", time=np.datetime64((self._open - _SILENT + 1) * _WINDOW_NS, "ns"))]
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
        for _ in range(len(ratios) - _AFTER):  # later windows are compared only with windows after the step
            self.ratio.popleft()
            self.window.popleft()
        return [RadarAlarm(kind="mounting", time=begin, before=middle, after=float(np.median(after)))]

"""Alarms for a radar with a scale step or without output, by comparison with satellite (Doppler) speeds."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.timescale import nearest_rows
from railfix.motion.samples import RadarSpeeds

#: The ratio is computed over windows of this length [ns] with this many speeds, of a train faster than this [m/s].
_WINDOW_NS: Final = 30_000_000_000
_LEAST_SPEEDS: Final = 10
_NEAR_NS: Final = 150_000_000  #: Largest time between the speeds that are compared [ns].
_MOVING_MPS: Final = 3.0
#: Windows before a step that are compared, at least and at most, and windows after it.
_LEAST_BEFORE: Final = 5
_MOST_BEFORE: Final = 20
_AFTER: Final = 3
_SILENT: Final = 2  #: Windows without a speed that are reported.
#: Least reported step, absolute and as a multiple of the scatter of the windows.
_STEP: Final = 0.01
_SCATTERS: Final = 5.0
_LEAST_SCATTER: Final = 0.001


@dataclass(frozen=True, kw_only=True)
class RadarAlarm:
    """Comparison of the radar's speeds with satellite speeds."""

    kind: Literal["mounting", "silent"]  #: A step of the ratio of the speeds; no speed while the train moves.
    time: np.datetime64  #: Start of the alarm.
    #: Ratio less 1 before a step and after it.
    before: float = float("nan")
    after: float = float("nan")

    @property
    def sentence(self) -> str:
        """Note for the user."""
        at = np.datetime_as_string(self.time, unit="s")
        if self.kind == "silent":
            return f"radar: from {at} on it has no speed while the train moves; is it covered, by snow or dirt?"
        after, before = (f"{round(100.0 * share, 1) + 0.0:+.1f} %" for share in (self.after, self.before))
        return (
            f"radar: from {at} on its speeds are {after} off those by satellites, {before} before; has its mounting "
            "moved?"
        )


@dataclass(kw_only=True)
class RadarWatch:
    """Ratios by window of GPS time, added in order of time; memory does not grow with the length of a session."""

    #: Ratios of the last windows.
    ratio: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_BEFORE + _AFTER))
    #: Window numbers since the epoch of the clock.
    window: deque[int] = field(default_factory=lambda: deque(maxlen=_MOST_BEFORE + _AFTER))
    silent: int = 0  #: Consecutive windows without a speed.
    _open: int = -1
    _sums: Floats = field(default_factory=lambda: np.zeros(4))

    def take(self, time: Datetimes, radar_mps: Floats, right_mps: Floats) -> list[RadarAlarm]:
        """Add speeds of both at the same later instants (NaN: not measured); return the alarms that they raise."""
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
        """Add satellite speeds, each with the nearest radar speed; see `take`."""
        row = nearest_rows(radar.time, time, within_ns=_NEAR_NS)
        return self.take(time, np.append(radar.speed_mps, np.nan)[row], right_mps)

    def _close(self) -> list[RadarAlarm]:
        """End a window; return the alarm that it completes, if any."""
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
        for _ in range(len(ratios) - _AFTER):  # the next windows are compared with these
            self.ratio.popleft()
            self.window.popleft()
        return [RadarAlarm(kind="mounting", time=begin, before=middle, after=float(np.median(after)))]

"""Likely causes where every position of a log is off the line: time tags, heights, another place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss.observations import Observations
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.locate import locate
from railfix.pipeline.received import Received
from railfix.track.trajectory import Trajectory

#: Epochs that are tried, and how near the line a position is on it, in plan [m].
_EPOCHS: Final = 5
_ON_LINE_M: Final = 150.0
#: Positions so far above or below the line have another cause than errors of ranges [m].
_HEIGHT_M: Final = 30.0
#: Seconds between GPS time and UTC since 2017; BeiDou time is 14 s behind GPS time.
_LEAP_S: Final = 18
_BEIDOU_S: Final = 14
#: Hours between time zones that are tried.
_HOURS: Final = 14
_FEET: Final = 0.3048


def likely_cause(observations: Observations, received: Received, config: Config, line: Trajectory) -> str:
    """Return why the positions of a log may lie off the line, in a clause; "" where nothing was found.

    Conventional positions of some epochs are compared with the line: in height, and with the time tags shifted by leap
    seconds and by whole hours.
    """
    step = max(len(observations) // _EPOCHS, 1)
    few = observations[: step * _EPOCHS : step]
    as_tagged = _offset_m(few, received, config, line)
    if as_tagged is not None and as_tagged[0] < _ON_LINE_M:
        return _cause_in_height(*as_tagged[1:]) if abs(as_tagged[1]) > _HEIGHT_M else ""
    for shift_s in _shifts_s():
        shifted = replace(few, time=few.time + np.timedelta64(shift_s, "s"))
        offset = _offset_m(shifted, received, config, line)
        if offset is not None and offset[0] < _ON_LINE_M:
            return (
                f"with time tags {_duration(abs(shift_s))} {'later' if shift_s > 0 else 'earlier'} its positions lie "
                "on the line: are the tags UTC or local time, or is the time system in its header wrong?"
            )
    if as_tagged is None:
        return ""
    return f"its positions lie {as_tagged[0]:,.0f} m beside the line: is this the right track?"


def _shifts_s() -> Iterator[int]:
    """Give shifts of time tags that mistakes make, the smallest first [s]."""
    for seconds in (_LEAP_S, _BEIDOU_S):
        yield from (seconds, -seconds)
    for hours in range(1, _HOURS + 1):
        for sign in (-1, 1):
            yield from (sign * hours * 3600, sign * hours * 3600 + _LEAP_S, sign * hours * 3600 - _LEAP_S)


def _offset_m(
    observations: Observations, received: Received, config: Config, line: Trajectory
) -> tuple[float, float, float] | None:
    """Return the offset of the positions from the line in plan and height, and the line's height [m]."""
    ecef: Floats = locate(observations, received, config, ChannelBook(config)).ecef_m
    if not np.isfinite(ecef[:, 0]).any():
        return None
    place = np.nanmedian(ecef, axis=0)
    arc, _ = line.nearest(place[None])
    height = float(geodetic_from_ecef(place)[2])
    of_line = float(geodetic_from_ecef(line.at_arc(arc)[0])[2])
    # moved to the height of the line, where it may be of any height
    level = place * (1.0 + (of_line - height) / float(np.linalg.norm(place)))
    return float(line.nearest(level[None])[1][0]), height - of_line, of_line


def _cause_in_height(above_m: float, of_line_m: float) -> str:
    """Say that the line is too high or too low, and which unit explains it."""
    height = of_line_m + above_m
    feet = abs(of_line_m * _FEET - height) < abs(above_m) / 4.0
    hint = "are the heights of the map in feet?" if feet else "is the height datum of the map the right one?"
    return f"its positions lie {abs(above_m):.0f} m {'above' if above_m > 0.0 else 'below'} the line: {hint}"


def _duration(seconds: int) -> str:
    hours, rest = divmod(seconds + _LEAP_S, 3600)
    rest -= _LEAP_S
    return " ".join([*([f"{hours} h"] if hours else []), *([f"{rest:+d} s" if hours else f"{rest} s"] if rest else [])])

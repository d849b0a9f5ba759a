"""Assemble the reference from the smoothed positions: instants kept and left out, and their standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.timescale import seconds
from railfix.io.reference_log import AntennaReference
from railfix.reference.fixes import Fixes
from railfix.reference.settings import ReferenceSettings
from railfix.reference.smoother import Evidence, SmoothedReference
from railfix.track.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Gap between two good fixes that are further apart than the log's usual step."""

    start: np.datetime64
    end: np.datetime64
    length_s: float
    bridged: bool


@dataclass(frozen=True, kw_only=True)
class Built:
    """Reference of one antenna, with its fixes and gaps."""

    reference: AntennaReference
    fixes: Fixes  #: Every row of the position log with its reasons for rejection.
    gaps: tuple[Gap, ...]
    #: Instants without a reference by reason: ``before_first_fix``, ``after_last_fix``, ``long_gap``, ``uncertain``.
    left_out: dict[str, int]
    bridged_by: dict[str, int]  #: Bridged instants by the sensors that measured there.
    facts: dict[str, Any]  #: Estimated and used parameters, as plain values.


def assembled(
    evidence: Evidence,
    smoothed: SmoothedReference,
    fixes: Fixes,
    excess: Floats,
    *,
    trajectory: Trajectory,
    settings: ReferenceSettings,
    facts: dict[str, Any],
) -> Built:
    """The reference of one antenna from everything known of it.

    At a fix the reference is the fix's own place on the track; between fixes it is the smoothed one. Errors that fixes
    have in common the smoother cannot see, so a bridged instant has them on top of its own; and where a gap does not
    close within its standard deviation, the larger counts. `excess`, shape (G - 1,): from each of the G good fixes to
    the next, closing error over its standard deviation; 1 where noise explains it.
    """
    time, good = evidence.time, fixes.good
    at = np.flatnonzero(np.isfinite(evidence.fix_m))
    is_fix = np.zeros(len(time), dtype=np.bool_)
    is_fix[at] = True
    after = np.clip(np.searchsorted(at, np.arange(len(time))), 1, len(at) - 1)
    length = seconds(time[at[after]] - time[at[after - 1]])
    t = seconds(time - time[0])
    common = np.interp(t, t[at], evidence.fix_sigma_m[at])
    sigma = np.where(is_fix, common, np.hypot(smoothed.sigma_m * excess[after - 1], common))
    arc = np.where(is_fix, evidence.fix_m, smoothed.arc_m)
    long = ~is_fix & (length > settings.max_gap_s)
    uncertain = ~is_fix & ~long & (sigma > settings.max_sigma_m)
    keep = np.flatnonzero(~long & ~uncertain)
    reference = AntennaReference(
        time=time[keep],
        ecef_m=trajectory.at_arc(arc[keep]),
        chainage_m=trajectory.chainage_at(arc[keep]),
        speed_mps=smoothed.speed_mps[keep],
        sigma_m=sigma[keep],
        source=np.where(is_fix[keep], "rtk", "bridged"),
        environment=np.full(len(keep), ""),
    )
    usual = float(np.median(seconds(np.diff(fixes.time))))
    step = seconds(np.diff(fixes.time[good]))
    gaps = tuple(
        Gap(
            start=fixes.time[good[i]],
            end=fixes.time[good[i + 1]],
            length_s=float(step[i]),
            bridged=bool(step[i] <= settings.max_gap_s),
        )
        for i in np.flatnonzero(step > 1.5 * usual).tolist()
    )
    return Built(
        reference=reference,
        fixes=fixes,
        gaps=gaps,
        left_out={
            "before_first_fix": int((fixes.time < time[0]).sum()),
            "after_last_fix": int((fixes.time > time[-1]).sum()),
            "long_gap": int(long.sum()),
            "uncertain": int(uncertain.sum()),
        },
        bridged_by=_name_bridges(evidence, keep[~is_fix[keep]]),
        facts=facts,
    )


def _name_bridges(evidence: Evidence, rows: Indices) -> dict[str, int]:
    """Bridged instants by the sensors that have a number there, or a second or so from there."""
    t = seconds(evidence.time - evidence.time[0])
    measured = {
        "doppler": np.isfinite(evidence.doppler_mps),
        "pulses": np.isfinite(evidence.wheel_m),
        "acceleration": np.append(np.isfinite(evidence.acceleration_mps2), np.False_),
    }
    code = np.zeros(len(rows), dtype=np.int64)
    for i, mask in enumerate(measured.values()):
        code |= _near(t[mask], t[rows]).astype(np.int64) << i
    counts = {}
    for c in np.unique(code).tolist():
        name = " and ".join(name for i, name in enumerate(measured) if c >> i & 1) or "nothing"
        counts[name] = int((code == c).sum())
    return counts


def _near(known_s: Floats, at_s: Floats) -> Masks:
    """Return whether one of the known instants, rising, is within `_NEAR_S` of each."""
    if not len(known_s):
        return np.zeros(len(at_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(known_s, at_s), 0, len(known_s) - 1)
    before = np.maximum(after - 1, 0)
    return np.asarray(np.minimum(np.abs(known_s[after] - at_s), np.abs(known_s[before] - at_s)) <= _NEAR_S)


#: Sensors of 1 Hz measure everywhere, up to a missing epoch [s].
_NEAR_S: Final = 1.5

"""Build the reference positions of a run: check RTK fixes, match the fixes to the track, and bridge gaps.

1. The positions of each antenna are checked one by one, against the other antenna, and against the track (`fixes`).
2. The Dopplers are solved for the speed along the track at positions interpolated between fixes.
3. The distance between fixes is compared with the measured distance travelled; fixes that disagree are rejected.
4. All measurements are smoothed (`smoother`). The Dopplers are then solved at the smoothed positions, and all
   measurements are smoothed again (`_ROUNDS` rounds).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.errors import MismatchError, NoPositionError
from railfix.core.nearest_times import nearest_rows
from railfix.core.timescale import seconds
from railfix.io.position_log import PositionLog
from railfix.io.reference_log import Acceleration, Pulses
from railfix.positioning.doppler_speed import Dopplers, DopplerSpeed, doppler_speed
from railfix.reference.fixes import Fixes, ReferenceSettings, judge_alone, judge_pair, judge_place, judge_travel
from railfix.reference.smoother import (
    SAME_INSTANT_NS,
    WINDOWS,
    Built,
    Closings,
    Evidence,
    SmoothedReference,
    assemble_reference,
    closings,
    instants,
    lasting_error_mps,
    slip_m,
    smooth,
)
from railfix.reference.wheel_distance import Wheel, estimate_wheel
from railfix.track.trajectory import TRACK_AS_PATH, Trajectory

#: Two successive speeds are integrated to a distance only if they are at most this time apart [s].
LONGEST_STEP_S: Final = 2.5
#: Variance of the distance travelled in an interval longer than `LONGEST_STEP_S` [m2].
UNKNOWN_M2: Final = 1e8


@dataclass(frozen=True, kw_only=True)
class Speeds:
    """Speeds of one antenna along its path, at instants in order of time."""

    time: Datetimes
    speed_mps: Floats
    sigma_mps: Floats

    def way(self, time: Datetimes) -> tuple[Floats, Floats]:
        """Return the distance travelled up to each time [m], and the variance of this distance due to white noise [m2].

        The speeds are integrated by the trapezoidal rule. Both values are NaN outside the time span of the speeds.
        """
        if len(self.time) < 2:
            return np.full(len(time), np.nan), np.full(len(time), np.nan)
        known, at = seconds(self.time - self.time[0]), seconds(time - self.time[0])
        step = np.diff(known)
        way = np.cumsum(step * (self.speed_mps[1:] + self.speed_mps[:-1]) / 2.0)
        white = step**2 * (self.sigma_mps[1:] ** 2 + self.sigma_mps[:-1] ** 2) / 2.0
        variance = np.cumsum(np.where(step > LONGEST_STEP_S, UNKNOWN_M2, white))
        ways = [np.interp(at, known, np.append(0.0, v), left=np.nan, right=np.nan) for v in (way, variance)]
        return ways[0], ways[1]


def _known_speeds(time: Datetimes, speed_mps: Floats, sigma_mps: Floats) -> Speeds:
    rows = np.flatnonzero(np.isfinite(speed_mps))
    return Speeds(time=time[rows], speed_mps=speed_mps[rows], sigma_mps=sigma_mps[rows])


def combine_speeds(time: Datetimes, sources: Sequence[Speeds]) -> tuple[Floats, Floats]:
    """Return the mean speed, weighted by inverse variances, and its sigma, shapes (N,). Both are NaN where no source
    has a speed.
    """
    weight, total = np.zeros(len(time)), np.zeros(len(time))
    for source in sources:
        at = nearest_rows(time, source.time, within_ns=SAME_INSTANT_NS)
        rows = np.flatnonzero(at >= 0)
        w = source.sigma_mps[rows] ** -2.0
        np.add.at(weight, at[rows], w)
        np.add.at(total, at[rows], w * source.speed_mps[rows])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0, total / weight, np.nan), np.where(weight > 0, weight**-0.5, np.nan)


#: For each antenna: its speeds at the instants with a Doppler solution, and the Doppler solution of all instants.
SolvedSpeeds = Mapping[str, tuple[Speeds, DopplerSpeed]]

#: Number of rounds of Doppler solution and smoothing; the first round assumes a constant speed between fixes.
_ROUNDS: Final = 3
_MOVED: Final = 4.0  #: Two fixes determine the direction of travel if they are more than this number of sigmas apart.
_TELLING: Final = 2.0  #: Closing errors up to this number of standard deviations count as noise.


@dataclass(frozen=True, kw_only=True)
class ReferenceData:
    """Measurements from which a reference is built."""

    logs: Mapping[str, PositionLog]  #: Position logs by antenna ("front", "rear").
    trajectories: Mapping[str, Trajectory]  #: Trajectory of each antenna that has positions or Dopplers.
    dopplers: Mapping[str, Dopplers] = field(default_factory=dict)  #: Dopplers by antenna; may be empty.
    pulses: Pulses | None = None
    acceleration: Acceleration | None = None
    facing: int = 1  #: 1 if the vehicle's front faces rising chainage, -1 if it faces falling chainage.
    distance_m: float = float("nan")  #: Distance between the two antennas on the vehicle; NaN if unknown.


def build_references(data: ReferenceData, settings: ReferenceSettings | None = None) -> dict[str, Built]:
    """Return the reference positions of every antenna that has a position log.

    Raise NoPositionError if an antenna has fewer than two good fixes. Raise MismatchError if there are two position
    logs without a distance between the antennas, or if pulses or accelerations have no time in common with the fixes.
    """
    settings = settings or ReferenceSettings()
    judged = {name: judge_alone(log, settings) for name, log in data.logs.items()}
    if len(judged) == 2:
        if not np.isfinite(data.distance_m):
            raise MismatchError(
                "two position logs require a vehicle file, from which the antennas' distance is known; name a vehicle"
            )
        others = reversed(list(judged.values()))
        judged = {
            name: judge_pair(fixes, other, data.distance_m, settings)
            for (name, fixes), other in zip(judged.items(), others, strict=True)
        }
    return {name: _ReferenceBuilder(name, data, settings).built(fixes) for name, fixes in judged.items()}


class _ReferenceBuilder:
    """Builder of the reference of one antenna."""

    def __init__(self, name: str, data: ReferenceData, settings: ReferenceSettings) -> None:
        self.name, self.data, self.settings = name, data, settings
        self.trajectory = data.trajectories[name]

    def built(self, fixes: Fixes) -> Built:
        """Return the reference, built from fixes that were checked one by one and against the other antenna."""
        fixes = judge_place(fixes, self.trajectory, self.settings)
        good = self._good(fixes)
        speeds = self._speeds(fixes.time[good], fixes.arc_m[good])
        wheel = None
        if (pulses := self.data.pulses) is not None:
            _check_time(pulses.path, pulses.time, fixes.time[good])
            wheel = estimate_wheel(pulses, self.settings.pulse_m, fixes.time[good], fixes.arc_m[good])
        if self.data.acceleration is not None:
            _check_time(self.data.acceleration.path, self.data.acceleration.time, fixes.time[good])
        judged, (settings, _) = fixes, self._calibrate(speeds, wheel, fixes)
        fixes = judge_travel(judged, lambda time: self._travel(time, speeds, wheel, judged, settings), settings)
        good = self._good(fixes)
        span = fixes.time[(fixes.time >= fixes.time[good[0]]) & (fixes.time <= fixes.time[good[-1]])]
        time = instants(np.unique(span), [d.time for d in self._sources().values()])
        at = np.searchsorted(time, fixes.time[good])
        place = np.interp(_since(time, time), _since(fixes.time[good], time), fixes.arc_m[good])
        for _ in range(_ROUNDS if self.data.dopplers else 1):
            speeds = self._speeds(time, place)
            settings, calibrated = self._calibrate(speeds, wheel, fixes)
            evidence = self._evidence(time, at, fixes, good, speeds, wheel, place)
            smoothed = smooth(evidence, settings)
            place = np.clip(smoothed.arc_m, 0.0, self.trajectory.arc_m[-1])
        facts = self._facts(speeds, wheel, smoothed, calibrated)
        excess = self._excess(speeds, wheel, smoothed, time, fixes, settings)
        return assemble_reference(
            evidence,
            replace(smoothed, arc_m=place),
            fixes,
            excess,
            trajectory=self.trajectory,
            settings=self.settings,
            facts=facts,
        )

    def _excess(
        self,
        speeds: SolvedSpeeds,
        wheel: Wheel | None,
        smoothed: SmoothedReference,
        time: Datetimes,
        fixes: Fixes,
        settings: ReferenceSettings,
    ) -> Floats:
        """Return the closing error of each gap, in standard deviations of the most accurate sensor.

        The closing error is the distance that the sensor measured across the gap, minus the distance between the fixes
        at both ends. Values within the noise are replaced by 1.
        """
        good = fixes.good
        fix_time, moved = fixes.time[good], np.diff(fixes.arc_m[good])
        variance = np.full(len(moved), np.inf)
        closing = np.zeros(len(moved))
        duration, both = seconds(np.diff(fix_time)), fixes.sigma_m[good[1:]] ** 2 + fixes.sigma_m[good[:-1]] ** 2
        joined = self._join(speeds)
        if len(joined.time) > 1:
            way, white = (np.diff(part) for part in joined.way(fix_time))
            tau = settings.doppler_bias_s
            lasting = 2.0 * tau**2 * (duration / tau - 1.0 + np.exp(-duration / tau)) * settings.doppler_bias_mps**2
            variance, closing = np.nan_to_num(white + lasting + both, nan=np.inf), np.nan_to_num(way - moved)
        if wheel is not None:
            scale = np.interp(_since(fix_time, time), _since(time, time), smoothed.wheel_scale)[1:]
            way = np.diff(wheel.distance_m(fix_time, self._hint(fix_time, joined, fixes))) * (1.0 - scale)
            own = settings.slip_m**2 * np.abs(way) + 2.0 * wheel.reading_sigma_m**2 + both
            better = own < variance
            closing = np.where(better, way - moved, closing)
            variance = np.where(better, own, variance)
        missed = np.abs(closing) / np.sqrt(variance)
        return np.where(missed > _TELLING, missed, 1.0)

    def _calibrate(
        self, speeds: SolvedSpeeds, wheel: Wheel | None, fixes: Fixes
    ) -> tuple[ReferenceSettings, dict[str, Any]]:
        """Return the settings with sensor errors estimated from the fixes, and the source of each value."""
        settings, sources, good = self.settings, {}, fixes.good
        joined = self._join(speeds)
        if len(joined.time) > 1:
            misclosures = self._closings(fixes, *joined.way(fixes.time[good]))
            settings = settings.replaced(doppler_bias_mps=lasting_error_mps(misclosures, settings))
            sources["doppler"] = {
                "lasting_error_mps": settings.doppler_bias_mps,
                "lasting_error_from": _name_source(misclosures),
            }
        if wheel is not None:
            way = wheel.distance_m(fixes.time[good], self._hint(fixes.time[good], joined, fixes))
            misclosures = self._closings(fixes, way, np.full(len(way), 0.0), reading_m=wheel.reading_sigma_m)
            settings = settings.replaced(slip_m=slip_m(misclosures, settings))
            sources["pulses"] = {"slip_m": settings.slip_m, "slip_from": _name_source(misclosures)}
        return settings, sources

    def _closings(self, fixes: Fixes, way: Floats, variance: Floats, *, reading_m: float = 0.0) -> Closings:
        good = fixes.good
        sigma = np.hypot(fixes.sigma_m[good], reading_m)
        return closings(
            fixes.time[good], way, variance, fixes.arc_m[good], sigma, window_s=self.settings.doppler_bias_s
        )

    def _good(self, fixes: Fixes) -> Indices:
        good = fixes.good
        if len(good) < 2:
            rejected = ", ".join(f"{count} {what}" for what, count in fixes.counts().items() if count)
            rejected = f" ({rejected})" if rejected else ""
            path = "without a vehicle file the track itself is taken as the antenna's path"
            causes = [path] if TRACK_AS_PATH in self.trajectory.notes else []
            message = f"{self.name}: fewer than two good fixes{rejected}; no reference can be made"
            raise NoPositionError("; ".join([message, *causes, *self.data.logs[self.name].notes]))
        return good

    def _sources(self) -> Mapping[str, Dopplers]:
        """Return the Dopplers of this antenna, and of the other antenna if the vehicle's geometry is known."""
        tied = self.trajectory.body_chainage_m is not None
        return {name: d for name, d in self.data.dopplers.items() if name == self.name or tied}

    def _speeds(self, time: Datetimes, place_m: Floats) -> SolvedSpeeds:
        """Return Doppler speeds of every receiver, computed at positions along this antenna's path."""
        speeds_of = {}
        for name, dopplers in self._sources().items():
            t = _since(dopplers.time, time)
            arc = np.interp(t, _since(time, time), place_m, left=np.nan, right=np.nan)
            path = self.data.trajectories[name]
            if name != self.name:
                arc = path.arc_of_body(self.trajectory.body_at(arc))
            section, _ = path.segment_at(arc)
            tangent = np.where(np.isfinite(arc)[:, None], path.tangent[section], np.nan)
            solved = doppler_speed(dopplers, path.at_arc(arc), tangent, limits=self.settings.doppler)
            speeds_of[name] = (_known_speeds(dopplers.time, solved.speed_mps, solved.sigma_mps), solved)
        return speeds_of

    def _join(self, speeds: SolvedSpeeds) -> Speeds:
        """Return the combined speeds of all receivers; empty if there are no speeds."""
        own = [part for part, _ in speeds.values()]
        time = np.unique(np.concatenate([np.empty(0, dtype="datetime64[ns]"), *(part.time for part in own)]))
        if len(own) > 1:
            apart = np.diff(time, prepend=time[:1] - np.timedelta64(1, "s")) > np.timedelta64(20, "ms")
            time = time[apart]
        return _known_speeds(time, *combine_speeds(time, own))

    def _travel(
        self, time: Datetimes, speeds: SolvedSpeeds, wheel: Wheel | None, fixes: Fixes, settings: ReferenceSettings
    ) -> tuple[Floats, Floats]:
        """Return the distance travelled up to each time and its variance, from the wheel or else from Dopplers."""
        joined = self._join(speeds)
        if wheel is not None:
            way = wheel.distance_m(time, self._hint(time, joined, fixes))
            step = np.abs(np.diff(way, prepend=way[:1]))
            return way, np.cumsum(settings.slip_m**2 * np.nan_to_num(step))
        way, white = joined.way(time)
        lasting = 2.0 * settings.doppler_bias_s * settings.doppler_bias_mps**2 * _since(time, time)
        return way, white + lasting

    def _hint(self, time: Datetimes, joined: Speeds, fixes: Fixes) -> Floats:
        """Return speeds that show the direction of travel, from Dopplers or, if none, from close successive fixes."""
        good = fixes.good
        fix_time, fix_m = fixes.time[good], fixes.arc_m[good]
        step = seconds(np.diff(fix_time))
        moved, both = np.diff(fix_m), np.hypot(fixes.sigma_m[good[1:]], fixes.sigma_m[good[:-1]])
        slope = np.where((step <= LONGEST_STEP_S) & (np.abs(moved) > _MOVED * both), moved / step, np.nan)
        section = np.searchsorted(fix_time, time, side="right") - 1
        inside = (section >= 0) & (section < len(slope))
        hint = np.where(inside, slope[np.clip(section, 0, len(slope) - 1)], np.nan)
        if len(joined.time):
            row = nearest_rows(joined.time, time, within_ns=SAME_INSTANT_NS)
            hint = np.where(row >= 0, joined.speed_mps[np.maximum(row, 0)], hint)
        return np.asarray(hint)

    def _evidence(
        self,
        time: Datetimes,
        at: Indices,
        fixes: Fixes,
        good: Indices,
        speeds: SolvedSpeeds,
        wheel: Wheel | None,
        place_m: Floats,
    ) -> Evidence:
        blank = np.full(len(time), np.nan)
        fix, sigma, way = blank.copy(), blank.copy(), blank
        fix[at], sigma[at] = fixes.arc_m[good], fixes.sigma_m[good]
        doppler, doppler_sigma = combine_speeds(time, [part for part, _ in speeds.values()])
        if wheel is not None:
            way = wheel.distance_m(time, self._hint(time, self._join(speeds), fixes))
        acceleration = np.full(len(time) - 1, np.nan)
        if self.data.acceleration is not None:
            acceleration = self.data.facing * self.data.acceleration.mean_over(time)
            if self.data.acceleration.kind == "specific_force":
                middle = (place_m[1:] + place_m[:-1]) / 2.0
                section, _ = self.trajectory.segment_at(middle)
                climb = np.einsum("ki,ki->k", self.trajectory.tangent[section], self.trajectory.up[section])
                acceleration = acceleration - GRAVITY_MPS2 * climb
        return Evidence(
            time=time,
            fix_m=fix,
            fix_sigma_m=sigma,
            doppler_mps=doppler,
            doppler_sigma_mps=doppler_sigma,
            wheel_m=way,
            wheel_sigma_m=0.0 if wheel is None else wheel.reading_sigma_m,
            acceleration_mps2=acceleration,
        )

    def _facts(
        self,
        speeds: SolvedSpeeds,
        wheel: Wheel | None,
        smoothed: SmoothedReference,
        sources: Mapping[str, Mapping[str, Any]],
    ) -> dict[str, Any]:
        """Return the estimated parameters, as plain values for ``reference.json``."""
        facts: dict[str, Any] = {"doppler": None, "pulses": None, "acceleration": None}
        if speeds:
            facts["doppler"] = {
                "receivers": {
                    name: {
                        "epochs": len(part.time),
                        "sigma_p50_mps": float(np.median(part.sigma_mps)) if len(part.time) else None,
                        "noise_scale": solved.scale,
                        "rejected": int(solved.rejected.sum()),
                        "used": int(solved.used.sum()),
                    }
                    for name, (part, solved) in speeds.items()
                },
                **sources.get("doppler", {}),
            }
        if wheel is not None:
            facts["pulses"] = {
                "pulse_m": wheel.pulse_m,
                "pulse_m_from": wheel.source,
                "kind": wheel.pulses.kind,
                "direction": "from the table" if wheel.pulses.signed else "from Dopplers and fixes",
                "scale_correction": -float(smoothed.wheel_scale[-1]),
                **sources["pulses"],
            }
        if self.data.acceleration is not None:
            facts["acceleration"] = {"kind": self.data.acceleration.kind, "facing": self.data.facing}
        return facts


def _name_source(misclosures: Closings) -> str:
    return f"closing errors of {len(misclosures)} windows" if len(misclosures) >= WINDOWS else "settings"


def _check_time(path: str, time: Datetimes, fix_time: Datetimes) -> None:
    if time[-1] < fix_time[0] or time[0] > fix_time[-1]:
        raise MismatchError(
            f"{path}: data from {time[0]} to {time[-1]} and fixes from {fix_time[0]} to {fix_time[-1]} have no time "
            "in common; use a table of the same run, in GPS time"
        )


def _since(time: Datetimes, origin: Datetimes) -> Floats:
    return seconds(time - origin[0])

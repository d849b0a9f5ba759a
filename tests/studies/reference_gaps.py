"""Errors of the bridged reference: half of the fixes of real recordings taken away in gaps of 5 to 60 s.

Run ``python tests/studies/reference_gaps.py`` with the recordings beside the checkout. The inertial reference of a
recording, once a second, plays the fixes; the map is made from it. For each gap length L the fixes of every second
stretch of L seconds are removed, at four phases, and the reference is built from the rest. Each bridged instant
is then compared with the inertial reference, along the map.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

import paths
import recordings_truth
from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.timescale import seconds, timedelta
from railfix.evaluate import along_track_error, interpolate_reference
from railfix.io import read_navigation, read_observations
from railfix.io.position_log import PositionLog
from railfix.pipeline.config import DEFAULT_SIGNALS
from railfix.positioning.doppler_speed import Dopplers, doppler_speed, dopplers_of_log
from railfix.reference import Pulses, ReferenceData, ReferenceSettings, build_references
from railfix.reference.fixes import match
from railfix.track.trajectory import Trajectory
from recordings_score import trajectory_of

LENGTHS_S: Final = (5, 10, 20, 30, 60)
PHASES: Final = 4
#: Gaps of a minute are a little longer where a fix is missing beside them.
SETTINGS: Final = ReferenceSettings(max_gap_s=90.0)


@dataclass(frozen=True)
class Recording:
    """Fixes once a second, the map, and what bridges."""

    name: str
    truth: tuple[Datetimes, Floats]
    log: PositionLog
    trajectory: Trajectory
    dopplers: Dopplers | None = None
    pulses: Pulses | None = None

    def true(self, time: Datetimes) -> Floats:
        """Places at instants."""
        return interpolate_reference(time, *self.truth)

    def data(self, keep: Masks, bridge: str) -> ReferenceData:
        """The recording with some of its fixes."""
        log = replace(
            self.log,
            time=self.log.time[keep],
            ecef_m=self.log.ecef_m[keep],
            quality=self.log.quality[keep],
            sigma_m=self.log.sigma_m[keep],
            line=self.log.line[keep],
        )
        return ReferenceData(
            logs={"front": log},
            trajectories={"front": self.trajectory},
            dopplers={"front": self.dopplers} if self.dopplers is not None and bridge == "doppler" else {},
            pulses=self.pulses if bridge == "odometry" else None,
        )


@dataclass(frozen=True)
class Errors:
    """Errors of bridged places along the map; and the share of the instants in gaps that are given out."""

    error_m: Floats
    sigma_m: Floats
    share: float

    @property
    def ratio(self) -> float:
        """Root of the mean of the squared errors over their own standard deviations."""
        return float(np.sqrt(np.mean((self.error_m / self.sigma_m) ** 2)))


def _log(time: Datetimes, ecef: Floats, first: np.datetime64, last: np.datetime64) -> PositionLog:
    """One position a second between two instants."""
    span = (time >= first) & (time <= last)
    time, ecef = time[span], ecef[span]
    whole = np.flatnonzero(np.diff(np.floor(seconds(time - time[0]) + 1e-3), prepend=-1.0) > 0)
    count = len(whole)
    return PositionLog(
        path="truth",
        time=time[whole],
        ecef_m=ecef[whole],
        quality=np.ones(count, dtype=np.int64),
        sigma_m=np.full((count, 3), np.nan),
        line=np.arange(count),
    )


def gsdc(data: Path) -> Recording:
    folder = data / "kinematic" / "gsdc_pixel5_a"
    return _with_dopplers("gsdc", data, folder / "Pixel5_a.21o", folder / "hour1180.21n")


def urbannav(data: Path) -> Recording:
    folder = data / "kinematic" / "urbannav_tst"
    return _with_dopplers("urbannav", data, folder / "20210517.light-urban.tste.ublox.f9p.obs", folder / "hksc137c.nav")


def _with_dopplers(name: str, data: Path, observations: Path, navigation: Path) -> Recording:
    time, ecef = recordings_truth.TRUTHS[name](data)
    dopplers = dopplers_of_log(
        read_observations(observations),
        read_navigation([navigation]),
        systems=("G", "J", "E", "C", "R"),
        signals=DEFAULT_SIGNALS,
    )
    return Recording(
        name,
        (time, ecef),
        _log(time, ecef, dopplers.time[0], dopplers.time[-1]),
        trajectory_of(time, ecef),
        dopplers=dopplers,
    )


def smartloc(data: Path) -> Recording:
    """The odometer tells speeds, 5 Hz; their sum plays its distance."""
    time, ecef = recordings_truth.TRUTHS["smartloc"](data)
    rows = [
        [float(x) for x in line.split()[1:3]]
        for line in (data / "kinematic" / "smartloc_berlin" / "Berlin_Potsdamer_Platz_Input.txt")
        .read_text()
        .splitlines()
        if line.startswith("odom3")
    ]
    clock, speed = np.array(rows).T
    way = np.concatenate([[0.0], np.cumsum(np.diff(clock) * (speed[1:] + speed[:-1]) / 2.0)])
    pulses = Pulses(
        path="odometer",
        time=recordings_truth.SMARTLOC_START + timedelta(clock),
        count=way,
        kind="distance",
        signed=False,
    )
    return Recording(
        "smartloc", (time, ecef), _log(time, ecef, time[0], time[-1]), trajectory_of(time, ecef), pulses=pulses
    )


RECORDINGS: Final = {"gsdc": (gsdc, "doppler"), "urbannav": (urbannav, "doppler"), "smartloc": (smartloc, "odometry")}


def bridged(recording: Recording, length_s: float, bridge: str, settings: ReferenceSettings = SETTINGS) -> Errors:
    """Errors of the bridged instants of one gap length, all phases together."""
    parts, given, asked = [], 0, 0
    t = seconds(recording.log.time - recording.log.time[0])
    for phase in range(PHASES):
        shifted = t + phase * 2.0 * length_s / PHASES
        keep = (shifted % (2.0 * length_s)) >= length_s - 1e-6
        if bridge == "interpolation":
            parts.append(_interpolated(recording, keep))
            continue
        built = build_references(recording.data(keep, bridge), settings)["front"]
        reference = built.reference
        rows = np.flatnonzero(reference.source == "bridged")
        arc = recording.trajectory.arc_at_chainage(reference.chainage_m[rows])
        error = along_track_error(arc, recording.true(reference.time[rows]), recording.trajectory)
        seen = np.isfinite(error)
        parts.append(np.stack([error[seen], reference.sigma_m[rows][seen]]))
        given += len(rows)
        asked += len(rows) + built.left_out["long_gap"] + built.left_out["uncertain"]
    error, sigma = np.concatenate(parts, axis=1)
    return Errors(error, sigma, given / asked if asked else 1.0)


def _interpolated(recording: Recording, keep: Masks) -> Floats:
    """The yardstick: an even run between the places of the fixes on the map."""
    built = build_references(recording.data(keep, "nothing"), SETTINGS)["front"]
    good = built.fixes.good
    origin = recording.log.time[0]
    removed = np.flatnonzero(~keep)
    arc = np.interp(
        seconds(recording.log.time[removed] - origin),
        seconds(built.fixes.time[good] - origin),
        built.fixes.arc_m[good],
        left=np.nan,
        right=np.nan,
    )
    gap = np.searchsorted(built.fixes.time[good], recording.log.time[removed])
    inside = (gap > 0) & (gap < len(good))
    step = np.full(len(removed), np.inf)
    step[inside] = seconds(built.fixes.time[good][gap[inside]] - built.fixes.time[good][gap[inside] - 1])
    arc = np.where(step <= SETTINGS.max_gap_s, arc, np.nan)
    error = along_track_error(arc, recording.log.ecef_m[removed], recording.trajectory)
    seen = np.isfinite(error)
    return np.stack([error[seen], np.full(int(seen.sum()), np.nan)])


def row(recording: Recording, length_s: int, bridge: str) -> str:
    """One line of the table."""
    errors = bridged(recording, length_s, bridge)
    size = np.abs(errors.error_m)
    told = f"{np.median(errors.sigma_m):8.2f} {errors.ratio:12.2f}" if np.isfinite(errors.sigma_m).all() else ""
    what = f"{recording.name:9s} {length_s:4d} {bridge:13s} {len(size):6d} {100 * errors.share:6.1f}"
    return f"{what} {np.median(size):8.3f} {np.percentile(size, 95):8.3f} {size.max():8.2f} {told}".rstrip()


def truth_steps(recording: Recording, *, over_m: float = 0.2) -> tuple[int, int, float]:
    """Epochs at which the inertial reference steps against the odometer, of how many, and the largest step [m]."""
    time, ecef = recording.truth
    limits = {"lateral_m": 1.0, "height_m": 2.0, "max_speed_mps": 50.0}
    arc, *_ = match(time, ecef, recording.trajectory, **limits)
    if recording.pulses is None:
        raise ValueError(f"{recording.name} has no odometer")
    step = np.abs(np.diff(arc - recording.pulses.at(time)))
    return int((step > over_m).sum()), len(step), float(np.nanmax(step))


def speed_errors(recording: Recording) -> tuple[Floats, Floats]:
    """Errors of the Doppler speeds of a recording in motion [m/s], and their standard deviations.

    Against the inertial reference's positions, differenced; the direction is that reference's own motion.
    """
    if recording.dopplers is None:
        raise ValueError(f"{recording.name} has no Dopplers")
    time, ecef = recording.truth
    at = recording.dopplers.time
    velocity = interpolate_reference(at, time, np.gradient(ecef, seconds(time - time[0]), axis=0))
    speed = np.linalg.norm(velocity, axis=1)
    tangent = np.where((speed > 1.0)[:, None], velocity / np.maximum(speed, 1.0)[:, None], np.nan)
    found = doppler_speed(recording.dopplers, recording.true(at), tangent)
    seen = np.isfinite(found.speed_mps)
    return (found.speed_mps - speed)[seen], found.sigma_mps[seen]


def main(arguments: Sequence[str] = ()) -> int:
    data = paths.DATA
    if not data.is_dir():
        print(f"the real recordings are not at {data}", file=sys.stderr)
        return 1
    print("recording gap s bridge         epochs given % p50 m    p95 m    max m  sigma m  error/sigma")
    notes: list[str] = []
    for name, (make, bridge) in RECORDINGS.items():
        if arguments and name not in arguments:
            continue
        recording = make(data)
        for length in LENGTHS_S:
            for way in (bridge, "nothing", "interpolation"):
                print(row(recording, length, way), flush=True)
        if recording.pulses is not None:
            count, of, largest = truth_steps(recording)
            told = f"steps against the odometer by over 0.2 m at {count} of {of} epochs, by {largest:.2f} m at most"
            notes.append(f"{name}: the inertial reference {told}")
        if recording.dopplers is not None:
            error, sigma = speed_errors(recording)
            size = np.abs(error)
            told = f"p50 {np.median(size):.3f} p95 {np.percentile(size, 95):.3f} max {size.max():.2f} m/s"
            notes.append(f"{name}: Doppler speed in motion, {len(size)} epochs: {told}, sigma {np.median(sigma):.3f}")
    print("\n".join(notes))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

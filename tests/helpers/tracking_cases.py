"""Epochs of a filter whose truth is known: a bent line, satellites at rest in the sky, errors put in by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from railfix.core.geodesy import ecef_from_geodetic, enu_axes, range_with_rotation
from railfix.core.timescale import timedelta
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import GnssEpochs, Line, SensorEpochs

START = np.datetime64("2026-03-01T06:00:00", "ns")
LATITUDE, LONGITUDE = 35.68, 139.77
#: A point of the lines, and the direction of their beginning there.
ORIGIN_M = (
    ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0),
    np.array([0.5, np.sqrt(0.75), 0.0]) @ enu_axes(np.array(LATITUDE), np.array(LONGITUDE)),
)
#: Azimuth and elevation of the satellites [deg], by name.
SKY = {
    "G01": (10.0, 70.0), "G02": (75.0, 30.0), "G03": (130.0, 45.0), "G04": (200.0, 25.0), "G05": (265.0, 55.0),
    "G06": (320.0, 35.0), "E01": (40.0, 50.0), "E02": (110.0, 20.0), "E03": (220.0, 65.0), "E04": (300.0, 22.0),
}  # fmt: skip


def bent_line(length_m: float = 3000.0, *, turn_deg: float = 60.0) -> Trajectory:
    """A level line, straight for a third, then turning, points every 10 m."""
    s = np.arange(0.0, length_m + 1.0, 10.0)
    bearing = np.radians(30.0 + turn_deg * np.clip((s - length_m / 3) / (length_m / 3), 0.0, 1.0))
    east = np.concatenate([[0.0], np.cumsum(np.sin(bearing[:-1]) * 10.0)])
    north = np.concatenate([[0.0], np.cumsum(np.cos(bearing[:-1]) * 10.0)])
    origin = ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0)
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    points = origin + east[:, None] * axes[0] + north[:, None] * axes[1]
    return Trajectory.from_antenna_path(Track.from_ecef(points))


def corner_line(length_m: float = 1200.0, *, turn_m: float = 10.0) -> Trajectory:
    """A level line that turns by 90 degrees within `turn_m` every 600 m, points every 5 m; a square from 2400 m on."""
    s = np.arange(0.0, length_m, 5.0)
    corners = np.arange(600.0, length_m, 600.0)
    bearing = np.radians(30.0 + 90.0 * np.clip((s[:, None] - corners) / turn_m, 0.0, 1.0).sum(axis=1))
    east, north = (np.concatenate([[0.0], np.cumsum(f(bearing) * 5.0)]) for f in (np.sin, np.cos))
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    return Trajectory.from_antenna_path(
        Track.from_ecef(ORIGIN_M[0] + east[:, None] * axes[0] + north[:, None] * axes[1])
    )


@dataclass(frozen=True)
class Ride:
    """Epochs with their truth."""

    epochs: GnssEpochs
    arc_m: np.ndarray
    speed_mps: np.ndarray
    trajectory: Trajectory

    @property
    def line(self) -> Line:
        return Line(self.trajectory)


def ride(
    seconds: int = 120,
    *,
    trajectory: Trajectory | None = None,
    start_m: float = 200.0,
    rate_hz: float = 1.0,
    noise: float = 0.0,
    code_sigma_m: float = 2.0,
    seed: int = 0,
    speed_mps: Callable[[np.ndarray], np.ndarray] = lambda t: np.clip(0.5 * (t - 10.0), 0.0, 15.0),
) -> Ride:
    """From rest with 0.5 m/s2 up to 15 m/s; `noise` scales white errors of the sizes that the filter assumes."""
    trajectory = trajectory or bent_line()
    random = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    speed = speed_mps(t)
    whole = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) / rate_hz)])
    arc = start_m + whole
    line = Line(trajectory)
    place, axes = line.at(arc)
    enu = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    azimuth, elevation = np.radians(np.array(list(SKY.values()))).T
    up = np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], -1)
    sat = place[0] + 2.3e7 * up @ enu
    sats = np.broadcast_to(sat, (len(t), *sat.shape))
    distance, _ = range_with_rotation(sats, place[:, None, :])
    clock = 1500.0 + 30.0 * t
    offset = np.where(np.char.startswith(list(SKY), "E"), 6.0, 0.0)
    step = 1e-3
    ahead, _ = range_with_rotation(sats, place[:, None, :] + step * speed[:, None, None] * axes[:, None, 0])
    shape = distance.shape
    code_error = noise * code_sigma_m * 0.5 * random.normal(size=shape)
    phase_error = noise * 0.01 * random.normal(size=shape)
    doppler_error = noise * 0.05 * random.normal(size=shape)
    names = np.array(list(SKY))
    epochs = GnssEpochs(
        time=START + timedelta(t),
        satellite=names,
        signal=np.full(len(names), "1C"),
        clock=names.astype("<U1"),
        sat_ecef_m=sats,
        sat_velocity_mps=np.zeros((*shape, 3)),
        code_m=distance + clock[:, None] + offset + code_error,
        code_sigma_m=np.full(shape, code_sigma_m),
        phase_m=distance + clock[:, None] + 77.0 + phase_error,
        phase_joined=np.ones(shape, dtype=bool),
        rate_mps=(ahead - distance) / step + 30.0 + doppler_error,
        cn0_dbhz=np.full(shape, 45.0),
        off_map=np.zeros(shape[0], dtype=bool),
    )
    return Ride(epochs, arc, speed, trajectory)


def without_epochs(epochs: GnssEpochs, mask: np.ndarray) -> GnssEpochs:
    """The same with nothing measured at some epochs."""
    blank = {name: np.where(mask[:, None], np.nan, getattr(epochs, name)) for name in ("code_m", "phase_m", "rate_mps")}
    return replace(epochs, **blank)


def reflected(ride: Ride, epoch: int, *, satellites: int = 3) -> GnssEpochs:
    """Two epochs with one satellite, and one with a few that agree on rest 20 m back: reflected by one wall."""
    line, epochs = ride.line, ride.epochs
    code, phase, rate = (np.array(values) for values in (epochs.code_m, epochs.phase_m, epochs.rate_mps))
    joined = np.array(epochs.phase_joined)
    for values in (code, phase, rate):
        values[epoch - 2 : epoch, 1:] = np.nan
        values[epoch, satellites:] = np.nan
    place, _ = line.at(ride.arc_m[[epoch]] - 20.0)
    direct, _ = line.at(ride.arc_m[[epoch]])
    away, near = (range_with_rotation(epochs.sat_ecef_m[[epoch]], p[:, None, :])[0][0] for p in (place, direct))
    code[epoch] += away - near
    rate[epoch] = np.where(np.isfinite(rate[epoch]), 30.0, np.nan)
    joined[epoch : epoch + 2] = False
    return replace(epochs, code_m=code, phase_m=phase, rate_mps=rate, phase_joined=joined)


def with_codes_behind(ride: Ride, metres: float, until_m: float) -> GnssEpochs:
    """Codes of a place so far behind, up to an arc length."""
    here, there = (ride.line.at(ride.arc_m - behind)[0] for behind in (0.0, metres))
    away, near = (range_with_rotation(ride.epochs.sat_ecef_m, place[:, None, :])[0] for place in (there, here))
    code = ride.epochs.code_m + np.where(ride.arc_m < until_m, 1.0, 0.0)[:, None] * (away - near)
    return replace(ride.epochs, code_m=code)


def part(epochs: GnssEpochs, which: slice) -> GnssEpochs:
    """Some epochs."""
    per_epoch = ("time", "sat_ecef_m", "sat_velocity_mps", "code_m", "code_sigma_m", "phase_m", "phase_joined")
    values = {name: getattr(epochs, name)[which] for name in (*per_epoch, "rate_mps", "cn0_dbhz", "off_map")}
    return replace(epochs, **values)


def wheel(ride: Ride, *, scale: float = 0.0) -> SensorEpochs:
    """Way of a wheel too short by a share."""
    way = np.concatenate([[np.nan], np.diff(ride.arc_m)]) / (1.0 + scale)
    return SensorEpochs(wheel_m=way, wheel_sigma_m=np.full(len(way), 0.02))

"""Errors common to all receivers nearby: satellites, ionosphere, troposphere, faults.

They depend on time and the receiver's position alone, so the two antennas of the train and a reference
station beside the line share them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from railfix.core.arrays import Floats
from railfix.core.constants import EARTH_ROTATION_RATE
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import KeplerRecords
from railfix.simulate.constellation import newest_record, record_state
from railfix.simulate.errors.processes import GaussMarkov, satellite_key
from railfix.simulate.errors.settings import ErrorSettings, SatelliteErrorSettings, SatelliteFault

#: Radius of the Earth and height of the layer that the residual ionosphere lies in [km] (DO-229D, A.4.4.10).
_EARTH_KM: Final = 6378.1363
_LAYER_KM: Final = 350.0
#: Spacing of the nodes between which the axes of an orbit are interpolated [s]; they turn by half a degree.
_AXES_S: Final = 60.0
#: Streams of random numbers: clock, three axes, group delay, ionosphere, troposphere.
_CLOCK, _AXIS, _DELAY, _IONOSPHERE, _TROPOSPHERE = 10, 11, 14, 15, 16


def ionosphere_mapping(elevation_deg: Floats) -> Floats:
    """Slant over vertical delay of a thin layer 350 km up (DO-229D, A.4.4.10.4)."""
    return 1.0 / np.sqrt(1.0 - (_EARTH_KM / (_EARTH_KM + _LAYER_KM) * np.cos(np.radians(elevation_deg))) ** 2)


def troposphere_mapping(elevation_deg: Floats) -> Floats:
    """Slant over zenith delay (DO-229D, A.4.2.4)."""
    return 1.001 / np.sqrt(0.002001 + np.sin(np.radians(elevation_deg)) ** 2)


def pierce_point_km(
    latitude_deg: Floats, longitude_deg: Floats, elevation_deg: Floats, azimuth_deg: Floats, origin_deg: Floats
) -> Floats:
    """North and east of where a signal passes the layer from a place on the ground, shape (..., 2) [km].

    Distances are those on the ground below (DO-229D, A.4.4.10.1); `origin_deg` is (latitude, longitude).
    """
    elevation, azimuth = np.radians(elevation_deg), np.radians(azimuth_deg)
    latitude = np.radians(latitude_deg)
    psi = np.pi / 2.0 - elevation - np.arcsin(_EARTH_KM / (_EARTH_KM + _LAYER_KM) * np.cos(elevation))
    below = np.arcsin(np.sin(latitude) * np.cos(psi) + np.cos(latitude) * np.sin(psi) * np.cos(azimuth))
    turn = np.arcsin(np.sin(psi) * np.sin(azimuth) / np.cos(below))
    east = (np.radians(longitude_deg - origin_deg[1]) + turn + np.pi) % (2.0 * np.pi) - np.pi
    north = below - np.radians(origin_deg[0])
    return _EARTH_KM * np.stack([north, east * np.cos(np.radians(origin_deg[0]))], axis=-1)


class CommonErrors:
    """Errors of satellites and atmosphere as functions of time and place.

    Second 0 is `start`, GPS time; the vertical ionosphere is given at `origin_deg`, latitude and longitude; the
    broadcast orbits of the `records` give the directions radial, along and cross; S satellites.
    """

    def __init__(
        self,
        settings: ErrorSettings,
        *,
        seed: int,
        start: np.datetime64,
        duration_s: float,
        origin_deg: tuple[float, float],
        records: KeplerRecords,
        satellites: Sequence[str],
    ) -> None:
        self._settings, self._seed, self._start, self._duration_s = settings, seed, start, duration_s
        self._origin_deg, self._records = np.array(origin_deg), records
        self._satellites = tuple(satellites)

    @cached_property
    def active(self) -> bool:
        """Whether `path_m` or `ionosphere_m` can differ from 0."""
        atmosphere = self._settings.ionosphere.vertical_sigma_m, self._settings.ionosphere.gradient_mm_per_km
        return any((*atmosphere, self._settings.troposphere.zenith_sigma_m, self._clocks, self._orbits))

    def _columns(self, letter: str) -> list[int]:
        return [k for k, name in enumerate(self._satellites) if name[0] == letter]

    def _of_satellites(self, stream: int, sigma: str, time: str) -> list[tuple[list[int], GaussMarkov]]:
        """Processes of each constellation that has this error, with the columns of its satellites."""
        found = []
        for letter, table in sorted(self._settings.satellites.items()):
            columns = self._columns(letter)
            if columns and getattr(table, sigma) > 0.0:
                keys = [(self._seed, stream, *satellite_key(self._satellites[k])) for k in columns]
                process = GaussMarkov(
                    keys, sigma=getattr(table, sigma), time_s=getattr(table, time), duration_s=self._duration_s
                )
                found.append((columns, process))
        return found

    @cached_property
    def _clocks(self) -> list[tuple[list[int], GaussMarkov]]:
        return self._of_satellites(_CLOCK, "clock_sigma_m", "clock_time_s")

    @cached_property
    def _orbits(self) -> list[tuple[int, list[int], GaussMarkov]]:
        names = ("radial_sigma_m", "along_sigma_m", "cross_sigma_m")
        return [
            (axis, columns, process)
            for axis, name in enumerate(names)
            for columns, process in self._of_satellites(_AXIS + axis, name, "orbit_time_s")
        ]

    @cached_property
    def _axes(self) -> CubicSpline[np.float64]:
        """Radial, along and cross of each satellite in the Earth-fixed frame, shape (T, S, axis, xyz)."""
        nodes = np.arange(-2.0, self._duration_s / _AXES_S + 3.0) * _AXES_S
        time = self._start + timedelta(nodes)
        axes = np.empty((len(nodes), len(self._satellites), 3, 3))
        for k, name in enumerate(self._satellites):
            row = newest_record(self._records, name, time)
            since_toe = seconds(time - self._records.toe[row])
            place, after, before = (
                record_state(self._records, row, since_toe + dt, since_toe)[0] for dt in (0.0, 0.5, -0.5)
            )
            velocity = after - before + np.cross([0.0, 0.0, EARTH_ROTATION_RATE], place)
            radial = place / np.linalg.norm(place, axis=-1, keepdims=True)
            cross = np.cross(radial, velocity)
            cross /= np.linalg.norm(cross, axis=-1, keepdims=True)
            axes[:, k] = np.stack([radial, np.cross(cross, radial), cross], axis=1)
        return CubicSpline(nodes, axes, axis=0)

    @cached_property
    def _vertical(self) -> GaussMarkov:
        atmosphere = self._settings.ionosphere
        key = (self._seed, _IONOSPHERE)
        return GaussMarkov(
            [key], sigma=atmosphere.vertical_sigma_m, time_s=atmosphere.vertical_time_s, duration_s=self._duration_s
        )

    @cached_property
    def _zenith(self) -> GaussMarkov:
        atmosphere = self._settings.troposphere
        key = (self._seed, _TROPOSPHERE)
        return GaussMarkov(
            [key], sigma=atmosphere.zenith_sigma_m, time_s=atmosphere.zenith_time_s, duration_s=self._duration_s
        )

    def orbit_error_m(self, time_s: Floats) -> Floats:
        """True minus broadcast position, shape (T, S, 3) [m], in the Earth-fixed frame."""
        error = np.zeros((len(time_s), len(self._satellites), 3))
        if self._orbits:
            axes = self._axes(time_s)
            for axis, columns, process in self._orbits:
                error[:, columns] += process.at(time_s)[..., None] * axes[:, columns, axis]
        return error

    def clock_error_m(self, time_s: Floats) -> Floats:
        """True minus broadcast clock of each satellite, shape (T, S) [m]; a clock that is ahead shortens the code."""
        error = np.zeros((len(time_s), len(self._satellites)))
        for columns, process in self._clocks:
            error[:, columns] += process.at(time_s)
        return error

    def path_m(self, time_s: Floats, sight: Floats, elevation_deg: Floats) -> Floats:
        """Orbit, clock and troposphere together, what they add to the ranges, shape (T, S) [m].

        At T times after the start; `sight`, shape (T, S, 3): unit vectors from the receiver to the satellites.
        """
        added = -self.clock_error_m(time_s)
        if self._orbits:
            added += np.einsum("tsi,tsi->ts", self.orbit_error_m(time_s), sight)
        if self._settings.troposphere.zenith_sigma_m > 0.0:
            added += self._zenith.at(time_s) * troposphere_mapping(elevation_deg)
        return added

    def ionosphere_m(
        self,
        time_s: Floats,
        latitude_deg: Floats,
        longitude_deg: Floats,
        elevation_deg: Floats,
        azimuth_deg: Floats,
    ) -> Floats:
        """Ionospheric delay on L1 beyond the model, shape (T, S) [m]; positions of shape (T, 1) [deg]."""
        atmosphere = self._settings.ionosphere
        vertical = np.zeros(np.shape(elevation_deg))
        if atmosphere.vertical_sigma_m > 0.0:
            vertical += self._vertical.at(time_s)
        if atmosphere.gradient_mm_per_km > 0.0:
            apart = pierce_point_km(latitude_deg, longitude_deg, elevation_deg, azimuth_deg, self._origin_deg)
            direction = np.radians(atmosphere.gradient_azimuth_deg)
            vertical += 1e-3 * atmosphere.gradient_mm_per_km * (apart @ [np.cos(direction), np.sin(direction)])
        return np.asarray(vertical * ionosphere_mapping(elevation_deg))

    def group_delay_m(self, satellites: Sequence[str], signals: Sequence[str]) -> Floats:
        """Constant error of each channel's code, shape (M,) [m]."""
        none = SatelliteErrorSettings()
        return np.array(
            [
                self._settings.satellites.get(name[0], none).group_delay_sigma_m
                * np.random.default_rng(
                    [self._seed, _DELAY, *satellite_key(name), *(ord(c) for c in signal)]
                ).standard_normal()
                for name, signal in zip(satellites, signals, strict=True)
            ]
        )

    def fault_m(self, time_s: Floats, satellites: Sequence[str]) -> tuple[Floats, Floats]:
        """Range errors of satellites' faults [m] and their rates [m/s], shapes (T, M)."""
        return fault_m(self._settings.faults, time_s, satellites)


def fault_m(faults: Sequence[SatelliteFault], time_s: Floats, satellites: Sequence[str]) -> tuple[Floats, Floats]:
    """Range errors of faults [m] and their rates [m/s], shapes (T, M), at seconds after the start."""
    names = np.asarray(satellites)
    added, rate = np.zeros((2, len(time_s), len(names)))
    for fault in faults:
        since = time_s - fault.start_s
        on = (since >= 0.0) & (time_s < (np.inf if fault.end_s is None else fault.end_s))
        affected = names == fault.satellite
        added[:, affected] += np.where(on, fault.step_m + fault.ramp_mps * since, 0.0)[:, None]
        rate[:, affected] += np.where(on, fault.ramp_mps, 0.0)[:, None]
    return added, rate

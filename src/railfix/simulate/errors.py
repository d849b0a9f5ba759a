"""Satellite and atmospheric errors, which are common to all nearby receivers, and the random processes that model
errors.

A Gauss-Markov process is drawn exactly at nodes and interpolated by cubics through four nodes (Catmull and Rom 1974).
Interpolation reduces the variance by less than 1 %; the reduction is compensated on average. The values do not depend
on the chunks in which a run is simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from railfix.core.arrays import Floats
from railfix.core.constants import EARTH_ROTATION_RATE
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import KeplerRecords
from railfix.ranges.atmosphere import thin_shell_obliquity
from railfix.ranges.sbas.ionosphere import EARTH_RADIUS_KM, pierce_point
from railfix.ranges.sbas.troposphere import rtca_mapping
from railfix.simulate.constellation import newest_record, record_state
from railfix.simulate.settings import ErrorSettings, SatelliteErrorSettings, SatelliteFault

_NODES_A_TIME: Final = 32  #: Number of interpolation nodes per correlation time.
#: Minimum number of interpolation nodes before the start of the run.
_BEFORE: Final = 3
#: Errors are also drawn for the first of these durations before the run and for the second after the run [s], because
#: clock biases shift instants beyond the start and the end of the run.
_ROOM_S: Final = (0.1, 1.0)


def satellite_key(satellite: str) -> tuple[int, int]:
    """Return two numbers that identify a satellite in a seed, so that the satellite's errors do not depend on other
    satellites.
    """
    return ord(satellite[0]), int(satellite[1:])


class Interpolated:
    """C functions of time, given by values (K, C) at K evenly spaced nodes; the interpolated slope is continuous.

    The function `nodes_before` returns the number of nodes before the start of the run.
    """

    def __init__(self, nodes: Floats, spacing_s: float) -> None:
        self._nodes = nodes
        self._spacing_s = spacing_s
        self._before = nodes_before(spacing_s)

    def _place(self, time_s: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Return the values at the four nodes around each time, (T, C), and the elapsed fraction of the interval, (T,
        1).
        """
        place = np.asarray(time_s, dtype=np.float64) / self._spacing_s + self._before
        cell = np.floor(place).astype(np.intp)
        if cell.size and (cell.min() < 1 or cell.max() > len(self._nodes) - 3):
            raise ValueError("a time is outside the run for which the errors were drawn")
        a, b, c, d = (self._nodes[cell + k] for k in (-1, 0, 1, 2))
        return a, b, c, d, (place - cell)[:, None]

    def at(self, time_s: Floats) -> Floats:
        """Return the values, shape (T, C), at times counted from the start of the run, shape (T,) [s].

        Raise ValueError if a time is outside the run and its margins.
        """
        a, b, c, d, u = self._place(time_s)
        return np.asarray(b + u / 2.0 * ((c - a) + u * (2.0 * a - 5.0 * b + 4.0 * c - d + u * (3.0 * (b - c) + d - a))))

    def rate(self, time_s: Floats) -> Floats:
        """Return the rates of change per second, shape (T, C), at times from the start of the run, shape (T,) [s]."""
        a, b, c, d, u = self._place(time_s)
        slope = (c - a) + u * (2.0 * (2.0 * a - 5.0 * b + 4.0 * c - d) + 3.0 * u * (3.0 * (b - c) + d - a))
        return np.asarray(slope / 2.0 / self._spacing_s)


def nodes_before(spacing_s: float) -> int:
    """Return the number of nodes before the start of the run."""
    return max(_BEFORE, int(np.ceil(_ROOM_S[0] / spacing_s)) + 1)


def node_count(duration_s: float, spacing_s: float) -> int:
    """Return the number of nodes for a run of a given duration, with the margins before and after the run."""
    return nodes_before(spacing_s) + int(np.ceil((duration_s + _ROOM_S[1]) / spacing_s)) + 4


class GaussMarkov(Interpolated):
    """Independent Gauss-Markov processes of first order; each key is the seed of one process.

    `sigma` is the standard deviation and `time_s` the correlation time. The values do not depend on `duration_s`; a
    longer duration only adds later values.
    """

    def __init__(self, keys: Sequence[Sequence[int]], *, sigma: float, time_s: float, duration_s: float) -> None:
        from scipy.signal import (
            lfilter,
        )  # imported here, because the import takes 0.4 s, and reading a scenario does not need it

        spacing = time_s / _NODES_A_TIME
        rho = float(np.exp(-1.0 / _NODES_A_TIME))
        count = node_count(duration_s, spacing)
        white = np.stack([np.random.default_rng(list(key)).standard_normal(count) for key in keys], axis=1)
        white[1:] *= np.sqrt(1.0 - rho**2)
        nodes = sigma / _interpolate_sigma(rho) * np.asarray(lfilter([1.0], [1.0, -rho], white, axis=0))
        super().__init__(nodes, spacing)


def _interpolate_sigma(rho: float) -> float:
    """Return the RMS that an interpolated process has between nodes if its RMS at the nodes is 1."""
    u = (np.arange(200) + 0.5) / 200.0
    weight = 0.5 * np.stack(
        [-u + 2 * u**2 - u**3, 2 - 5 * u**2 + 3 * u**3, u + 4 * u**2 - 3 * u**3, -(u**2) + u**3], axis=-1
    )
    lag = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    return float(np.sqrt(np.einsum("ni,ij,nj->n", weight, rho**lag, weight).mean()))


class ClockWalk(Interpolated):
    """Variation of a receiver clock [m] by random walks of the bias [m / sqrt(s)] and of the drift [m/s / sqrt(s)]."""

    def __init__(
        self, key: Sequence[int], *, walk: float, frequency_walk: float, interval_s: float, duration_s: float
    ) -> None:
        count = node_count(duration_s, interval_s)
        white = np.random.default_rng(list(key)).standard_normal((count, 2)) * np.sqrt(interval_s)
        start = nodes_before(interval_s)
        drift = np.cumsum(frequency_walk * white[:, 0])
        bias = np.cumsum(walk * white[:, 1])
        drift, bias = drift - drift[start], bias - bias[start]
        # The drift is linear between nodes, so it is integrated by the trapezoid rule.
        turned = np.concatenate([[0.0], np.cumsum((drift[1:] + drift[:-1]) / 2.0)]) * interval_s
        bias = bias + turned - turned[start]
        super().__init__(bias[:, None], interval_s)


_COSINES: Final = 64  #: Number of cosines whose sum is a `RandomFunction`.


@dataclass(frozen=True, kw_only=True)
class RandomFunction:
    """Realisation of a stationary, nearly Gaussian random function, a sum of W cosines."""

    amplitude: float  #: Amplitude of the cosines.
    frequency: Floats  #: Angular frequencies [rad per unit of the variable], shape (W,).
    phase: Floats  #: Phases [rad], shape (W,).

    @classmethod
    def smooth(cls, rng: np.random.Generator, *, sigma: float, correlation: float) -> Self:
        """Return a function of standard deviation `sigma` with the correlation exp(-d^2 / (2 correlation^2))."""
        return cls._draw(rng, sigma, rng.normal(0.0, 1.0 / correlation, _COSINES))

    @classmethod
    def periodic(cls, rng: np.random.Generator, *, sigma: float, period: float) -> Self:
        """Return an oscillation with standard deviation `sigma`, mean period `period` and relative bandwidth 15 %."""
        return cls._draw(rng, sigma, 2.0 * np.pi / period * (1.0 + 0.15 * rng.normal(0.0, 1.0, _COSINES)))

    @classmethod
    def _draw(cls, rng: np.random.Generator, sigma: float, frequency: Floats) -> Self:
        phase = rng.uniform(0.0, 2.0 * np.pi, _COSINES)
        return cls(amplitude=sigma * float(np.sqrt(2.0 / _COSINES)), frequency=frequency, phase=phase)

    def at(self, x: ArrayLike) -> Floats:
        """Return the values of the function at positions or times `x`, with the shape of `x`."""
        where = np.asarray(x, dtype=np.float64)
        if self.amplitude == 0.0:
            return np.zeros(where.shape)
        total = np.zeros(where.shape)
        for frequency, phase in zip(self.frequency, self.phase, strict=True):
            total += np.cos(frequency * where + phase)
        return self.amplitude * total


#: Spacing of the nodes between which the radial, along-track and cross-track axes of an orbit are interpolated [s]; in
#: this time, the axes turn by half a degree.
_AXES_S: Final = 60.0
#: Seeds of random streams: satellite clocks, orbit errors (11 to 13, one for each axis), group delays, ionosphere,
#: troposphere.
_CLOCK, _AXIS, _DELAY, _IONOSPHERE, _TROPOSPHERE = 10, 11, 14, 15, 16


class CommonErrors:
    """Satellite and atmospheric errors as functions of position and of the time since `start`."""

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
        """Whether at least one of the errors `path_m` and `ionosphere_m` can differ from 0."""
        atmosphere = self._settings.ionosphere.vertical_sigma_m, self._settings.ionosphere.gradient_mm_per_km
        return any((*atmosphere, self._settings.troposphere.zenith_sigma_m, self._clocks, self._orbits))

    def _of_satellites(self, stream: int, sigma: str, time: str) -> list[tuple[list[int], GaussMarkov]]:
        """Return, for each constellation, the columns of the constellation's satellites and the process of one error.

        `sigma` and `time` are the names of the error's settings; constellations with a sigma of 0 are left out.
        """
        found = []
        for letter, table in sorted(self._settings.satellites.items()):
            columns = [k for k, name in enumerate(self._satellites) if name[0] == letter]
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
        """Radial, along-track and cross-track unit vectors in the Earth-fixed frame, shape (T, S, axis, xyz)."""
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
        return self._process(_IONOSPHERE, atmosphere.vertical_sigma_m, atmosphere.vertical_time_s)

    @cached_property
    def _zenith(self) -> GaussMarkov:
        atmosphere = self._settings.troposphere
        return self._process(_TROPOSPHERE, atmosphere.zenith_sigma_m, atmosphere.zenith_time_s)

    def _process(self, stream: int, sigma_m: float, time_s: float) -> GaussMarkov:
        return GaussMarkov([(self._seed, stream)], sigma=sigma_m, time_s=time_s, duration_s=self._duration_s)

    def orbit_error_m(self, time_s: Floats) -> Floats:
        """Return the true minus the broadcast satellite positions, shape (T, S, 3) ECEF [m]."""
        error = np.zeros((len(time_s), len(self._satellites), 3))
        if self._orbits:
            axes = self._axes(time_s)
            for axis, columns, process in self._orbits:
                error[:, columns] += process.at(time_s)[..., None] * axes[:, columns, axis]
        return error

    def clock_error_m(self, time_s: Floats) -> Floats:
        """Return the true minus the broadcast satellite clocks, shape (T, S) [m]; a fast clock shortens the code."""
        error = np.zeros((len(time_s), len(self._satellites)))
        for columns, process in self._clocks:
            error[:, columns] += process.at(time_s)
        return error

    def path_m(self, time_s: Floats, sight: Floats, elevation_deg: Floats) -> Floats:
        """Return the sum of the range errors due to orbit, clock and troposphere, shape (T, S) [m].

        `sight` are the unit vectors from receiver to satellite, shape (T, S, 3).
        """
        added = -self.clock_error_m(time_s)
        if self._orbits:
            added += np.einsum("tsi,tsi->ts", self.orbit_error_m(time_s), sight)
        if self._settings.troposphere.zenith_sigma_m > 0.0:
            added += self._zenith.at(time_s) * rtca_mapping(elevation_deg)
        return added

    def ionosphere_m(
        self, time_s: Floats, latitude_deg: Floats, longitude_deg: Floats, elevation_deg: Floats, azimuth_deg: Floats
    ) -> Floats:
        """Return the part of the ionospheric L1 delay that the broadcast model lacks, shape (T, S) [m].

        The receiver's latitudes and longitudes have shape (T, 1) [deg].
        """
        atmosphere = self._settings.ionosphere
        vertical = np.zeros(np.shape(elevation_deg))
        if atmosphere.vertical_sigma_m > 0.0:
            vertical += self._vertical.at(time_s)
        if atmosphere.gradient_mm_per_km > 0.0:
            pierced = pierce_point(latitude_deg[:, 0], longitude_deg[:, 0], elevation_deg, azimuth_deg)
            north, east = pierced[0] - self._origin_deg[0], (pierced[1] - self._origin_deg[1] + 180.0) % 360.0 - 180.0
            east *= np.cos(np.radians(self._origin_deg[0]))
            direction = np.radians(atmosphere.gradient_azimuth_deg)
            apart_km = EARTH_RADIUS_KM * np.radians(north * np.cos(direction) + east * np.sin(direction))
            vertical += 1e-3 * atmosphere.gradient_mm_per_km * apart_km
        return np.asarray(vertical * thin_shell_obliquity(elevation_deg))

    def group_delay_m(self, satellites: Sequence[str], signals: Sequence[str]) -> Floats:
        """Return the constant group-delay error of the code of each channel, shape (M,) [m]."""
        delays = []
        for name, signal in zip(satellites, signals, strict=True):
            rng = np.random.default_rng([self._seed, _DELAY, *satellite_key(name), *(ord(c) for c in signal)])
            settings = self._settings.satellites.get(name[0], SatelliteErrorSettings())
            delays.append(settings.group_delay_sigma_m * rng.standard_normal())
        return np.array(delays)


def fault_m(faults: Sequence[SatelliteFault], time_s: Floats, satellites: Sequence[str]) -> tuple[Floats, Floats]:
    """Return the range errors due to faults [m] and the rates of these errors [m/s] at times from the start, (T, M)."""
    names = np.asarray(satellites)
    added, rate = np.zeros((2, len(time_s), len(names)))
    for fault in faults:
        since = time_s - fault.start_s
        on = (since >= 0.0) & (time_s < (np.inf if fault.end_s is None else fault.end_s))
        affected = names == fault.satellite
        added[:, affected] += np.where(on, fault.step_m + fault.ramp_mps * since, 0.0)[:, None]
        rate[:, affected] += np.where(on, fault.ramp_mps, 0.0)[:, None]
    return added, rate

"""Simulated observations of all receivers, composed of ranges, clocks, delays, errors and noise.

Ionospheric delays follow Klobuchar's model (IS-GPS-200, 20.3.3.5.2.5); tropospheric delays follow Saastamoinen's model
for the standard atmosphere with 70 % relative humidity. A receiver that applies these models corrects the delays
exactly, unless the scenario scales the delays or adds errors to them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.geodesy import elevation_azimuth, geodetic_from_ecef
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.joined_observations import signals_by_system
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import ObservationHeader, Observations
from railfix.gnss.orbits.prepared_records import group_delay_s
from railfix.ranges.atmosphere import klobuchar_delay_m, saastamoinen_delay_m
from railfix.simulate.alignment import Alignment, build_alignment
from railfix.simulate.constellation import SatelliteTable, links, newest_record, simulate_navigation
from railfix.simulate.environment import Environment
from railfix.simulate.environment.settings import CN0_SECOND_DB, Disturbances, SightGeometry
from railfix.simulate.errors import CommonErrors, fault_m
from railfix.simulate.motion import AntennaTruth, BodyMotion, Motion, antenna_truth, build_motion
from railfix.simulate.receiver import Receiver, ReceiverClocks, list_signals
from railfix.simulate.scenario import ANTENNAS, Scenario

CN0_STEP_DBHZ: Final = 0.25  #: Resolution of the reported C/N0 [dB-Hz].
CHUNK_EPOCHS: Final = 2000  #: Number of epochs in a chunk.
_LOOK_S: Final = 60.0  #: Interval at which satellite elevations are compared with the cutoff [s].
_RATE_S: Final = 0.005  #: Range rates are computed from differences over twice this time [s].
_SIGMA_AT_DBHZ: Final = 45.0  #: C/N0 to which the sigmas of `ReceiverSettings` refer [dB-Hz].
_BEST_DBHZ: Final = 50.0  #: C/N0 above which the noise is constant [dB-Hz].


@dataclass(frozen=True, kw_only=True)
class Piece:
    """Ground truth and observations of one receiver for T epochs and M channels."""

    observations: Observations
    geometry: SightGeometry  #: True positions of the antenna, and directions to the satellites.
    clock_m: Floats  #: Receiver clock bias times the speed of light, shape (T,).
    code_sigma_m: Floats  #: Standard deviation of the code noise, shape (T, M).
    clean_code_m: Floats  #: Codes without noise and without disturbances, shape (T, M).
    error_m: Floats  #: Error in `clean_code_m` due to `Scenario.errors`, not corrected by models, shape (T, M).


class Simulation:
    """Simulation of a scenario: line, motion, satellites, and observations in chunks.

    The constructor raises the exceptions that `build_alignment`, `build_motion` and `simulate_navigation` raise.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.line: Alignment = build_alignment(scenario.line)
        self.motion: Motion = build_motion(self.line, scenario)
        self.body: BodyMotion = BodyMotion(scenario, self.motion)
        self.environment = Environment(
            scenario.environment,
            line_length_m=self.line.length_m,
            seed=scenario.place_seed,
            clear_cn0_dbhz=(scenario.receiver.cn0_horizon_dbhz, scenario.receiver.cn0_rise_db),
        )
        place = () if scenario.environment.empty else (self.environment,)
        self.disturbances: tuple[Disturbances, ...] = (*place, *scenario.multipath)
        self.navigation: Navigation = simulate_navigation(scenario)
        self.clocks = ReceiverClocks(scenario)

    def time(self, first: int = 0, last: int | None = None) -> Datetimes:
        """Return the time tags (GPS time) of the epochs from `first` up to but excluding `last`, by default of all."""
        last = self.scenario.epochs if last is None else last
        return np.asarray(self.scenario.start + np.arange(first, last) * self.scenario.interval)

    @cached_property
    def satellites(self) -> tuple[str, ...]:
        """Names of the S satellites of `channels`, sorted."""
        return tuple(sorted({name for name, _ in self.channels}))

    @cached_property
    def satellite_table(self) -> SatelliteTable:
        """Positions and clocks of `satellites` over the run."""
        return SatelliteTable(self.navigation.kepler, self.satellites, self.scenario.start, self.time()[-1])

    @cached_property
    def common_errors(self) -> CommonErrors:
        """Satellite and atmospheric errors of `satellites`."""
        return self.compute_errors(self.satellites)

    def compute_errors(self, satellites: Sequence[str]) -> CommonErrors:
        """Return the errors of satellites and atmosphere; a satellite's errors do not depend on other satellites."""
        scenario = self.scenario
        return CommonErrors(
            scenario.errors,
            seed=scenario.seed,
            start=scenario.start,
            duration_s=scenario.duration_s,
            origin_deg=self.origin_deg,
            records=self.navigation.kepler,
            satellites=satellites,
        )

    @cached_property
    def origin_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the first point of the line [deg]."""
        latitude, longitude, _ = geodetic_from_ecef(self.line.at(np.zeros(1)))
        return float(latitude[0]), float(longitude[0])

    def truth(self, antenna: str, seconds_s: Floats) -> tuple[AntennaTruth, Floats]:
        """Return the true positions of an antenna or station at times after the start [s], and the speeds [m/s]."""
        if antenna not in ANTENNAS:
            return self._station_truth(antenna, len(seconds_s)), np.zeros(len(seconds_s))
        return self.body_truth(getattr(self.scenario.vehicle, antenna), seconds_s)

    def _station_truth(self, name: str, count: int) -> AntennaTruth:
        """Return the position of a reference station, repeated for a number of instants."""
        station = next(item for item in self.scenario.stations if item.name == name)
        at = np.full(count, station.chainage_m)
        place = self.line.point_beside(at, station.lateral_m, station.height_m)
        return AntennaTruth(ecef_m=place, chainage_m=at, forward=self.line.tangent_at(at))

    def body_truth(self, offset_m: tuple[float, float, float], seconds_s: Floats) -> tuple[AntennaTruth, Floats]:
        """Return the true positions of a point of the body at times after the start [s], and the speeds [m/s]."""
        middle, speed = self.motion.at(seconds_s)
        roll, pitch = self.body.roll_rad(seconds_s, speed), self.body.pitch_rad(seconds_s, speed)
        return antenna_truth(self.line, self.scenario.vehicle, offset_m, middle, roll, pitch), speed

    @cached_property
    def channels(self) -> tuple[tuple[str, str], ...]:
        """Satellite and signal of each channel, for the satellites above the cutoff at some time of the run."""
        scenario = self.scenario
        looks = np.append(np.arange(0.0, scenario.duration_s, _LOOK_S), scenario.duration_s)
        tags = scenario.start + timedelta(looks)
        place = self.truth(ANTENNAS[0], looks)[0].ecef_m
        names = []
        for satellite in sorted({str(s) for s in self.navigation.kepler.satellite}):
            link = links(self.navigation.kepler, satellite, tags, np.zeros(len(tags)), place)
            elevation, _ = elevation_azimuth(link.satellite_ecef_m[:, None, :], place)
            if elevation.max() > scenario.sky.cutoff_deg - 0.5:
                names.append(satellite)
        return tuple((name, signal) for name in names for signal in list_signals(name[0], scenario.receiver))

    def header(self, antenna: str) -> ObservationHeader:
        """Return the header of the log of a receiver.

        The approximate position of an antenna is rounded to 100 m, the position of a reference station to 0.1 mm.
        """
        place = self.truth(antenna, np.zeros(1))[0].ecef_m[0]
        return ObservationHeader(
            version=3.04,
            marker=f"MADE {antenna.upper()}",
            receiver="SIMULATED",
            antenna="SIMULATED",
            approximate_ecef_m=np.round(place, -2 if antenna in ANTENNAS else 4),
            interval_s=self.scenario.interval_s,
            leap_seconds=self.navigation.leap_seconds,
            signals=signals_by_system(*np.array(self.channels, dtype=np.str_).reshape(-1, 2).T),
        )

    def pieces(self, antenna: str, *, chunk_epochs: int = CHUNK_EPOCHS) -> Iterator[Piece]:
        """Yield ground truth and observations of a receiver in chunks; the values do not depend on `chunk_epochs`."""
        receiver = Receiver(
            self.scenario,
            antenna,
            self.header(antenna),
            channels=self.channels,
            satellites=self.satellites,
            common_errors=self.common_errors,
        )
        for first in range(0, self.scenario.epochs, chunk_epochs):
            yield _piece(self, receiver, self.time(first, min(first + chunk_epochs, self.scenario.epochs)))

    def observations(self, antenna: str) -> Iterator[Observations]:
        """Return an iterator over the observations of a receiver in chunks."""
        return (piece.observations for piece in self.pieces(antenna))


@dataclass(frozen=True, kw_only=True)
class _Instant:
    """Directions and delays of the signals of S satellites at T epochs, shapes (T, S), without receiver clock."""

    elevation_deg: Floats
    azimuth_deg: Floats
    path_m: Floats  #: Range + tropospheric delay + `path_error_m` - satellite clock.
    ionosphere_m: Floats  #: Ionospheric delay on L1, including `ionosphere_error_m`.
    path_error_m: Floats  #: Sum of the errors of orbit, satellite clock and troposphere.
    ionosphere_error_m: Floats  #: Part of the ionospheric delay on L1 that the model lacks.


def _instant(simulation: Simulation, time: Datetimes, late_s: Floats, antenna_ecef_m: Floats) -> _Instant:
    """Return directions and delays of the signals that arrive at the antenna `late_s` before the time tags."""
    scale, navigation = simulation.scenario.sky, simulation.navigation
    found = simulation.satellite_table.links(time, late_s, antenna_ecef_m)
    sky = found.satellite_ecef_m
    elevation, azimuth = elevation_azimuth(sky, antenna_ecef_m)
    latitude, longitude, height = geodetic_from_ecef(antenna_ecef_m)
    # Below the horizon, no signal is tracked, but the delays must be finite.
    raised = np.maximum(elevation, 1.0)
    troposphere = saastamoinen_delay_m(latitude, height, raised)
    ionosphere = klobuchar_delay_m(
        time, latitude, longitude, raised, azimuth, navigation.klobuchar["G"], np.array(FREQUENCY_L1)
    )
    distance = found.range_m - SPEED_OF_LIGHT * found.clock_s
    errors = simulation.common_errors
    path_error, ionosphere_error = np.zeros((2, *distance.shape))
    if errors.active:
        when = seconds(time - simulation.scenario.start) - late_s
        sight = sky - antenna_ecef_m[:, None, :]
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        path_error = errors.path_m(when, sight, raised)
        ionosphere_error = errors.ionosphere_m(when, latitude[:, None], longitude[:, None], raised, azimuth)
    return _Instant(
        elevation_deg=elevation,
        azimuth_deg=azimuth,
        path_m=distance + scale.troposphere_scale * troposphere + path_error,
        ionosphere_m=scale.ionosphere_scale * ionosphere + ionosphere_error,
        path_error_m=path_error,
        ionosphere_error_m=ionosphere_error,
    )


def _geometry(simulation: Simulation, antenna: str, time: Datetimes) -> tuple[SightGeometry, _Instant, Floats, Floats]:
    """Return geometry and delays of all satellites at T epochs, and the rates of path and ionospheric delay [m/s].

    The rates are computed from differences over 10 ms.
    """
    late = simulation.clocks.bias_s(antenna, tags := seconds(time - simulation.scenario.start))
    truth, speed = simulation.truth(antenna, tags - late)
    now = _instant(simulation, time, late, truth.ecef_m)
    before, after = (
        _instant(simulation, time, late - d, simulation.truth(antenna, tags - late + d)[0].ecef_m)
        for d in (-_RATE_S, _RATE_S)
    )
    _, heading = elevation_azimuth((truth.ecef_m + truth.forward)[:, None, :], truth.ecef_m)
    geometry = SightGeometry(
        antenna=antenna,
        time=time,
        satellite=np.array(simulation.satellites),
        signal=np.full(len(simulation.satellites), ""),
        chainage_m=truth.chainage_m,
        speed_mps=speed,
        antenna_ecef_m=truth.ecef_m,
        heading_deg=heading[:, 0],
        elevation_deg=now.elevation_deg,
        azimuth_deg=now.azimuth_deg,
    )
    path_rate = (after.path_m - before.path_m) / (2.0 * _RATE_S)
    return geometry, now, path_rate, (after.ionosphere_m - before.ionosphere_m) / (2.0 * _RATE_S)


def _piece(simulation: Simulation, receiver: Receiver, time: Datetimes) -> Piece:
    """Return the ground truth and observations of a receiver at the next epochs."""
    scenario, settings = simulation.scenario, simulation.scenario.receiver
    by_satellite, now, path_rate, ionosphere_rate = _geometry(simulation, receiver.antenna, time)
    column, scale, wavelength = receiver.column, receiver.scale, receiver.wavelength_m
    geometry = replace(
        by_satellite,
        satellite=receiver.names,
        signal=receiver.signals,
        elevation_deg=by_satellite.elevation_deg[:, column],
        azimuth_deg=by_satellite.azimuth_deg[:, column],
    )
    tags = seconds(time - scenario.start)
    ionosphere = scale * now.ionosphere_m[:, column]
    clock = SPEED_OF_LIGHT * simulation.clocks.bias_s(receiver.antenna, tags)
    # Errors that are equal in code and phase, and the rate of these errors.
    fault, fault_rate = _faults(simulation, receiver, tags)
    extra = fault + receiver.offset_m + receiver.offset_drift_mps * tags[:, None]
    extra_rate = fault_rate + receiver.offset_drift_mps
    path = now.path_m[:, column] + clock[:, None] + extra
    kepler = simulation.navigation.kepler
    delay = SPEED_OF_LIGHT * np.stack(
        [group_delay_s(kepler, g)[newest_record(kepler, n, time)] for n, g in simulation.channels], axis=1
    )
    code = path + ionosphere + delay + receiver.group_delay_error_m
    error = now.path_error_m[:, column] + scale * now.ionosphere_error_m[:, column]
    drift = simulation.clocks.rate_mps(receiver.antenna, tags)[:, None] + extra_rate
    doppler = -(path_rate[:, column] - scale * ionosphere_rate[:, column] + drift) / wavelength
    noise = receiver.white(len(time))
    sine = np.sin(np.radians(np.maximum(geometry.elevation_deg, 1.0)))
    cn0 = settings.cn0_horizon_dbhz + settings.cn0_rise_db * sine + CN0_SECOND_DB * receiver.second
    cn0 = cn0 + receiver.cn0_offset_db + settings.cn0_sigma_dbhz * noise[:, :, 3] + receiver.carried.cn0_db(len(time))
    added_code, added_phase, added_doppler, cn0 = _disturb(simulation, receiver, geometry, cn0)
    cn0 = np.round(cn0 / CN0_STEP_DBHZ) * CN0_STEP_DBHZ
    weak = 10.0 ** ((_SIGMA_AT_DBHZ - np.minimum(cn0, _BEST_DBHZ)) / 20.0)
    sigma = settings.code_sigma_m * weak / sine
    grown = weak if scenario.errors.noise.weak_signals == "all" else 1.0
    bad = ~_is_tracked(now.elevation_deg, scenario)[:, column] | np.isnan(added_code) | receiver.tracking.too_weak(cn0)
    tracked = receiver.tracking.follow(bad)
    added_code = receiver.smoothing.next(added_code, tracked.lost)
    phase = path - ionosphere + added_phase + settings.phase_sigma_m * grown * noise[:, :, 1]
    doppler = doppler + added_doppler + settings.doppler_sigma_hz * grown * noise[:, :, 2]
    observations = Observations(
        time=time,
        satellite=receiver.names,
        signal=receiver.signals,
        code_m=np.where(tracked.lost, np.nan, code + added_code + sigma * receiver.carried.code(noise[:, :, 0])),
        phase_cycles=np.where(tracked.lost, np.nan, phase / wavelength + (receiver.ambiguity + tracked.slip_cycles)),
        doppler_hz=np.where(tracked.lost, np.nan, doppler),
        cn0_dbhz=np.where(tracked.lost, np.nan, cn0),
        loss_of_lock=tracked.loss_of_lock,
        break_before=np.zeros(len(time), dtype=np.bool_),
        header=receiver.header,
    )
    return Piece(
        observations=observations,
        geometry=geometry,
        clock_m=clock,
        code_sigma_m=sigma,
        clean_code_m=code,
        error_m=error + extra + receiver.group_delay_error_m,
    )


def _disturb(
    simulation: Simulation, receiver: Receiver, geometry: SightGeometry, cn0_dbhz: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the disturbances of code [m], phase [m] and Doppler [Hz], and the disturbed C/N0, shape (T, M) each.

    Reference stations have no disturbances.
    """
    code, phase, doppler = np.zeros((3, *cn0_dbhz.shape))
    for source in simulation.disturbances if receiver.antenna in ANTENNAS else ():
        more = source(geometry)
        code, phase = code + more.code_m, phase + more.phase_m
        doppler, cn0_dbhz = doppler + more.doppler_hz, cn0_dbhz + more.cn0_db
    return code, phase, doppler, cn0_dbhz


def _faults(simulation: Simulation, receiver: Receiver, tag_s: Floats) -> tuple[Floats, Floats]:
    """Return range errors due to faults of satellites and of the station [m], and their rates [m/s], (T, M)."""
    names = receiver.names.tolist()
    fault, rate = fault_m(simulation.scenario.errors.faults, tag_s, names)
    for station in simulation.scenario.stations:
        if station.name == receiver.antenna and station.faults:
            own, own_rate = fault_m(station.faults, tag_s, names)
            fault, rate = fault + own, rate + own_rate
    return fault, rate


def _is_tracked(elevation_deg: Floats, scenario: Scenario) -> Masks:
    """Return whether satellites are above the cutoff and among the `satellites_at_most` highest ones, shape (T, S)."""
    tracked = elevation_deg >= scenario.sky.cutoff_deg
    most = scenario.sky.satellites_at_most
    if most is not None and most < elevation_deg.shape[1]:
        lowest = np.sort(elevation_deg, axis=1)[:, -most][:, None]
        tracked &= elevation_deg >= lowest
    return np.asarray(tracked)

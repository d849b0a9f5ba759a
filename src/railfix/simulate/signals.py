"""Observations of the two receivers: ranges, clocks, delays, noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.constants import CARRIER_FREQUENCY, FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.epochs import ObservationHeader, Observations
from railfix.geodesy import elevation_azimuth, geodetic_from_ecef
from railfix.navigation import KeplerRecords, Navigation
from railfix.simulate.alignment import Alignment, made_alignment
from railfix.simulate.body import AntennaTruth, antenna_truth
from railfix.simulate.constellation import made_navigation
from railfix.simulate.delays import ionosphere_m, troposphere_m
from railfix.simulate.disturbance import Geometry
from railfix.simulate.motion import Motion, shuttle
from railfix.simulate.satellites import links, newest_record
from railfix.simulate.scenario import ANTENNAS, Scenario
from railfix.timescale import seconds

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

#: Signals of each constellation, the first one first.
SIGNALS: Final = {"G": ("1C", "2L"), "J": ("1C", "2L"), "E": ("1C", "7Q"), "C": ("2I", "6I")}
#: C/N0 at elevation el [dB-Hz]: a + b sin(el); the second signal is weaker.
CN0_HORIZON_DBHZ: Final = 34.0
CN0_RISE_DBHZ: Final = 16.0
CN0_SECOND_DB: Final = -3.0
#: Receivers report C/N0 in steps [dB-Hz].
CN0_STEP_DBHZ: Final = 0.25
#: Epochs that are simulated at once.
CHUNK_EPOCHS: Final = 2000
#: Spacing of the instants at which it is looked which satellites rise during the run [s].
_LOOK_S: Final = 60.0
#: Half the interval of the difference that gives range rates [s].
_RATE_S: Final = 0.005


@dataclass(frozen=True, kw_only=True)
class Piece:
    """Truth and observations of one antenna for some epochs.

    Attributes
    ----------
    observations : Observations
    geometry : Geometry
        Where antenna and satellites truly are.
    clock_m : ndarray, shape (T,) [m]
        Receiver clock times the speed of light.
    code_sigma_m : ndarray, shape (T, M) [m]
        Standard deviation of the noise in the codes.
    clean_code_m : ndarray, shape (T, M) [m]
        The codes without noise and without disturbances.
    """

    observations: Observations
    geometry: Geometry
    clock_m: Floats
    code_sigma_m: Floats
    clean_code_m: Floats


class Simulation:
    """A scenario worked out: line, motion, sky, and pieces of observations.

    Parameters
    ----------
    scenario : Scenario

    Attributes
    ----------
    scenario : Scenario
    line : Alignment
    motion : Motion
        Of the vehicle's middle.
    navigation : Navigation
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.line: Alignment = made_alignment(scenario.line)
        margin = scenario.run.end_margin_m
        self.motion: Motion = shuttle(margin, self.line.length_m - margin, scenario.duration_s, scenario.run)
        self.navigation: Navigation = made_navigation(scenario)

    def time(self, first: int = 0, last: int | None = None) -> Times:
        """Time tags of epochs `first` to before `last`, GPS time."""
        last = self.scenario.epochs if last is None else last
        return np.asarray(self.scenario.start + np.arange(first, last) * self.scenario.interval)

    def clock_s(self, antenna: str, tag_s: Floats) -> Floats:
        """Bias of a receiver's clock, tag minus GPS time, at tags counted from the start, shape (T,) [s]."""
        settings = self.scenario.receiver
        bias, drift = settings.clock_bias_s, settings.clock_drift
        if antenna != ANTENNAS[0] and settings.clocks == "separate":
            bias, drift = -0.61 * bias, 0.83 * drift
        value = bias + drift * tag_s
        return value - np.rint(value * 1e3) * 1e-3 if settings.clock_steps == "millisecond" else value

    def clock_drift(self, antenna: str) -> float:
        """Drift of a receiver's clock [s/s]."""
        settings = self.scenario.receiver
        return settings.clock_drift * (0.83 if antenna != ANTENNAS[0] and settings.clocks == "separate" else 1.0)

    def truth(self, antenna: str, seconds_s: Floats) -> tuple[AntennaTruth, Floats]:
        """True place of an antenna at seconds after the start, and the train's speed [m/s]."""
        middle, speed = self.motion.at(seconds_s)
        vehicle = self.scenario.vehicle
        return antenna_truth(self.line, vehicle, getattr(vehicle, antenna), middle), speed

    @cached_property
    def channels(self) -> tuple[tuple[str, str], ...]:
        """Satellite and signal of each channel: satellites above the cutoff at any time of the run."""
        scenario = self.scenario
        looks = np.append(np.arange(0.0, scenario.duration_s, _LOOK_S), scenario.duration_s)
        tags = scenario.start + np.round(looks * 1e9).astype("timedelta64[ns]")
        place = self.truth(ANTENNAS[0], looks)[0].ecef_m
        names = []
        for satellite in sorted({str(s) for s in self.navigation.kepler.satellite}):
            link = links(self.navigation.kepler, satellite, tags, np.zeros(len(tags)), place)
            elevation, _ = elevation_azimuth(link.satellite_ecef_m[:, None, :], place)
            if elevation.max() > scenario.sky.cutoff_deg - 0.5:
                names.append(satellite)
        count = scenario.receiver.signals_per_satellite
        return tuple((name, signal) for name in names for signal in SIGNALS[name[0]][:count])

    def header(self, antenna: str) -> ObservationHeader:
        """Header of an antenna's log; the approximate position is rounded to 100 m."""
        place = self.truth(antenna, np.zeros(1))[0].ecef_m[0]
        return ObservationHeader(
            version=3.04,
            marker=f"MADE {antenna.upper()}",
            receiver="SIMULATED",
            antenna="SIMULATED",
            approximate_ecef_m=np.round(place, -2),
            interval_s=float(self.scenario.interval / np.timedelta64(1, "s")),
            leap_seconds=self.navigation.leap_seconds,
            signals={
                s: tuple(sorted({g for name, g in self.channels if name[0] == s}))
                for s in sorted({name[0] for name, _ in self.channels})
            },
        )

    def pieces(self, antenna: str, *, chunk_epochs: int = CHUNK_EPOCHS) -> Iterator[Piece]:
        """Truth and observations of one antenna, piece by piece; any cutting gives the same numbers.

        Parameters
        ----------
        antenna : {"front", "rear"}
        chunk_epochs : int
        """
        rng = np.random.default_rng([self.scenario.seed, 2, ANTENNAS.index(antenna)])
        satellites, column = np.unique([name for name, _ in self.channels], return_inverse=True)
        # Whole cycles that the phases are off, one number a channel.
        ambiguity = rng.integers(-2_000_000, 2_000_000, len(self.channels)).astype(np.float64)
        header = self.header(antenna)
        for first in range(0, self.scenario.epochs, chunk_epochs):
            time = self.time(first, min(first + chunk_epochs, self.scenario.epochs))
            noise = rng.standard_normal((len(time), len(self.channels), 4))
            yield _piece(self, antenna, time, satellites, column, ambiguity, noise, header)

    def observations(self, antenna: str) -> Iterator[Observations]:
        """Observations of one antenna, piece by piece."""
        return (piece.observations for piece in self.pieces(antenna))


@dataclass(frozen=True, kw_only=True)
class _Instant:
    """Clean quantities of S satellites at T instants: shapes (T, S).

    `path_m` is the distance with the troposphere, less the satellite clock; `ionosphere_m` is on L1.
    """

    elevation_deg: Floats
    azimuth_deg: Floats
    path_m: Floats
    ionosphere_m: Floats


def _instant(
    simulation: Simulation, time: Times, late_s: Floats, antenna_ecef_m: Floats, satellites: NDArray[np.str_]
) -> _Instant:
    """Signals that arrive at the antenna `late_s` before the tags."""
    scale, navigation = simulation.scenario.sky, simulation.navigation
    found = [links(navigation.kepler, name, time, late_s, antenna_ecef_m) for name in satellites.tolist()]
    sky = np.stack([link.satellite_ecef_m for link in found], axis=1)
    elevation, azimuth = elevation_azimuth(sky, antenna_ecef_m)
    latitude, longitude, height = (part[:, None] for part in geodetic_from_ecef(antenna_ecef_m))
    # Far below the horizon nothing is tracked; the formulas only have to stay finite there.
    raised = np.maximum(elevation, 1.0)
    troposphere = troposphere_m(latitude, height, raised)
    ionosphere = ionosphere_m(
        navigation.klobuchar["G"],
        seconds(time - time.astype("datetime64[D]"))[:, None],
        latitude,
        longitude,
        raised,
        azimuth,
        frequency_hz=FREQUENCY_L1,
    )
    distance = np.stack([link.range_m - SPEED_OF_LIGHT * link.clock_s for link in found], axis=1)
    return _Instant(
        elevation_deg=elevation,
        azimuth_deg=azimuth,
        path_m=distance + scale.troposphere_scale * troposphere,
        ionosphere_m=scale.ionosphere_scale * ionosphere,
    )


def _geometry(
    simulation: Simulation, antenna: str, time: Times, satellites: NDArray[np.str_]
) -> tuple[Geometry, _Instant, Floats, Floats]:
    """Geometry by satellite, the instant of the epochs, and the rates of path and ionosphere [m/s].

    Rates are differences over a hundredth of a second of the true motion; the clock's steps are left out.
    """
    late = simulation.clock_s(antenna, tags := seconds(time - simulation.scenario.start))
    truth, speed = simulation.truth(antenna, tags - late)
    now = _instant(simulation, time, late, truth.ecef_m, satellites)
    before, after = (
        _instant(simulation, time, late - d, simulation.truth(antenna, tags - late + d)[0].ecef_m, satellites)
        for d in (-_RATE_S, _RATE_S)
    )
    _, heading = elevation_azimuth((truth.ecef_m + truth.forward)[:, None, :], truth.ecef_m)
    geometry = Geometry(
        antenna=antenna,
        time=time,
        satellite=satellites,
        signal=np.full(len(satellites), ""),
        chainage_m=truth.chainage_m,
        speed_mps=speed,
        antenna_ecef_m=truth.ecef_m,
        heading_deg=heading[:, 0],
        elevation_deg=now.elevation_deg,
        azimuth_deg=now.azimuth_deg,
    )
    path_rate = (after.path_m - before.path_m) / (2.0 * _RATE_S)
    return geometry, now, path_rate, (after.ionosphere_m - before.ionosphere_m) / (2.0 * _RATE_S)


def group_delay_s(records: KeplerRecords, satellite: str, signal: str, time: Times) -> Floats:
    """What a signal's code is late by against the broadcast clock, shape (T,) [s].

    GPS and QZSS: TGD on L1, scaled by (f1/f)^2 on L2 (IS-GPS-200, 20.3.3.3.3.2). Galileo I/NAV: BGD E5b/E1
    likewise (OS SIS ICD, 5.1.5). BeiDou: TGD1 on B1I, none on B3I, which the clock refers to.
    """
    row = newest_record(records, satellite, time)
    letter = satellite[0]
    frequency = CARRIER_FREQUENCY[letter]
    if letter == "C":
        return np.where(signal[0] == "2", records.group_delay_1_s[row], 0.0)
    delay = records.group_delay_2_s if letter == "E" else records.group_delay_1_s
    return np.asarray(delay[row] * (frequency["1"] / frequency[signal[0]]) ** 2)


def _piece(
    simulation: Simulation,
    antenna: str,
    time: Times,
    satellites: NDArray[np.str_],
    column: NDArray[np.intp],
    ambiguity: Floats,
    noise: Floats,
    header: ObservationHeader,
) -> Piece:
    scenario, receiver = simulation.scenario, simulation.scenario.receiver
    by_satellite, now, path_rate, ionosphere_rate = _geometry(simulation, antenna, time, satellites)
    names, signals = (np.array(part) for part in zip(*simulation.channels, strict=True))
    geometry = replace(
        by_satellite,
        satellite=names,
        signal=signals,
        elevation_deg=now.elevation_deg[:, column],
        azimuth_deg=now.azimuth_deg[:, column],
    )
    frequency = np.array([CARRIER_FREQUENCY[n[0]][g[0]] for n, g in simulation.channels])
    wavelength = SPEED_OF_LIGHT / frequency
    scale = (FREQUENCY_L1 / frequency) ** 2
    ionosphere = scale * now.ionosphere_m[:, column]
    clock = SPEED_OF_LIGHT * simulation.clock_s(antenna, seconds(time - scenario.start))
    path = now.path_m[:, column] + clock[:, None]
    delay = SPEED_OF_LIGHT * np.stack(
        [group_delay_s(simulation.navigation.kepler, n, g, time) for n, g in simulation.channels], axis=1
    )
    code = path + ionosphere + delay
    drift = SPEED_OF_LIGHT * simulation.clock_drift(antenna)
    doppler = -(path_rate[:, column] - scale * ionosphere_rate[:, column] + drift) / wavelength
    sine = np.sin(np.radians(np.maximum(geometry.elevation_deg, 1.0)))
    second = np.array([g != SIGNALS[n[0]][0] for n, g in simulation.channels])
    cn0 = CN0_HORIZON_DBHZ + CN0_RISE_DBHZ * sine + CN0_SECOND_DB * second
    cn0 = cn0 + receiver.cn0_sigma_dbhz * noise[:, :, 3]
    added_code, added_phase, added_doppler = np.zeros((3, *code.shape))
    for source in scenario.multipath:
        extra = source(geometry)
        added_code, added_phase = added_code + extra.code_m, added_phase + extra.phase_m
        added_doppler, cn0 = added_doppler + extra.doppler_hz, cn0 + extra.cn0_db
    cn0 = np.round(cn0 / CN0_STEP_DBHZ) * CN0_STEP_DBHZ
    sigma = receiver.code_sigma_m * 10.0 ** ((45.0 - np.minimum(cn0, 50.0)) / 20.0) / sine
    lost = ~_tracked(now.elevation_deg, scenario)[:, column] | np.isnan(added_code)
    phase = path - ionosphere + added_phase + receiver.phase_sigma_m * noise[:, :, 1]
    observations = Observations(
        time=time,
        satellite=names,
        signal=signals,
        code_m=np.where(lost, np.nan, code + added_code + sigma * noise[:, :, 0]),
        phase_cycles=np.where(lost, np.nan, phase / wavelength + ambiguity),
        doppler_hz=np.where(lost, np.nan, doppler + added_doppler + receiver.doppler_sigma_hz * noise[:, :, 2]),
        cn0_dbhz=np.where(lost, np.nan, cn0),
        loss_of_lock=np.zeros(code.shape, dtype=np.uint8),
        break_before=np.zeros(len(time), dtype=np.bool_),
        header=header,
    )
    return Piece(observations=observations, geometry=geometry, clock_m=clock, code_sigma_m=sigma, clean_code_m=code)


def _tracked(elevation_deg: Floats, scenario: Scenario) -> NDArray[np.bool_]:
    """Satellites that a receiver tracks, shape (T, S)."""
    tracked = elevation_deg >= scenario.sky.cutoff_deg
    most = scenario.sky.satellites_at_most
    if most is not None and most < elevation_deg.shape[1]:
        lowest = np.sort(elevation_deg, axis=1)[:, -most][:, None]
        tracked &= elevation_deg >= lowest
    return np.asarray(tracked)

"""Settings of a simulated run; the defaults resemble P1's experiment (table 1, antennas 18.2 m apart)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from railfix.core.errors import SettingsError
from railfix.simulate.environment.settings import CN0_HORIZON_DBHZ, CN0_RISE_DB, Disturbances, EnvironmentSettings
from railfix.simulate.line_file import LineSettings
from railfix.simulate.settings import (
    SYSTEMS,
    ErrorSettings,
    Finite,
    GpsTime,
    NotNegative,
    Positive,
    SatelliteFault,
    SbasSettings,
    ScenarioSettings,
    Seed,
    SensorSettings,
    Three,
    beyond_start,
)

ANTENNAS: Final = ("front", "rear")  #: Antennas of the vehicle, in the order in which their files are written.
#: Names of the files of a run; reference stations must have other names.
_FILES: Final = (*ANTENNAS, "nav", "track", "vehicle", "truth", "sections", "scenario", "readme", "sbas")
LONGEST_S: Final = 8.64e6  #: A run must not be longer than this [s]: 100 days.


class Station(ScenarioSettings):
    """Station at which the train stops."""

    at_m: NotNegative  #: Chainage at which the middle of the vehicle stops.
    dwell_s: NotNegative = 30.0
    name: str = ""


class SpeedLimit(ScenarioSettings):
    """Speed limit that applies while the middle of the vehicle is on a part of the line."""

    from_m: Finite
    to_m: Finite
    limit_mps: Positive

    _forward = field_validator("to_m")(beyond_start)


class RunSettings(ScenarioSettings):
    """Motion of the train, which waits, then runs from stop to stop and back until the end of the run."""

    cruise_mps: Positive = 40.0 / 3.6  #: Cruising speed, which is not reached on short legs.
    acceleration_mps2: Positive = 0.7
    deceleration_mps2: Positive = 0.8
    first_stand_s: NotNegative = 15.0  #: Duration of the standstill at the start of the run.
    stand_s: NotNegative = 10.0  #: Duration of the standstill at each end of the line, if no stations are given.
    #: The middle of the vehicle stops at this distance from an end of the line before the train reverses.
    end_margin_m: NotNegative = 20.0
    #: Stops in order of chainage, including the first and the last; without stations, the train runs from end to end.
    stations: tuple[Station, ...] = ()

    limits: tuple[SpeedLimit, ...] = ()
    #: The speed in curves is limited so that the cant deficiency does not exceed this; None for no limit in curves.
    cant_deficiency_m: Positive | None = None
    jerk_mps3: Positive | None = None  #: Upper limit of the jerk; None for no limit.
    #: Direction of the first leg. The front of the vehicle points to rising chainage in either direction of travel.
    direction: Literal["rising", "falling"] = "rising"
    at_end: Literal["return", "stand"] = "return"  #: Behaviour after the last stop: reverse, or stay at standstill.

    @field_validator("stations")
    @classmethod
    def _apart(cls, stations: tuple[Station, ...]) -> tuple[Station, ...]:
        places = [station.at_m for station in stations]
        if len(places) == 1 or any(b - a < 10.0 for a, b in pairwise(places)):
            raise ValueError(f"must be two or more, in ascending order and at least 10 m apart, got {places}")
        return stations


class VehicleSettings(ScenarioSettings):
    """Vehicle; antenna positions are (along, across to the right, above the rail tops) in metres.

    The origin is midway between the bogie centres at the height of the rail tops; the front points in the direction of
    rising chainage. Cant is measured between the contact points of a wheelset, which are the gauge plus 70 mm apart.
    """

    name: str = "simulated test car"
    bogie_distance_m: Positive = 13.8
    gauge_m: Positive = 1.067
    front: Three = (9.1, 0.25, 3.95)
    rear: Three = (-9.1, 0.25, 3.95)
    length_m: Positive = 23.2  #: Overall length; the middle of the vehicle is midway between the bogies.
    #: Standard deviation of the random roll at 20 m/s and more; at lower speeds, it is proportional to the speed. The
    #: vehicle file does not contain this value, because it is unknown in practice.
    sway_sigma_deg: NotNegative = 0.0
    sway_period_s: Positive = 1.5  #: Mean period of the roll.
    #: Standard deviation of the random pitch at 20 m/s and more; at lower speeds, it is proportional to the speed.
    pitch_sigma_deg: NotNegative = 0.0
    pitch_period_s: Positive = 1.0  #: Mean period of the random pitch, and period of the suspension.
    #: Pitch under constant acceleration, positive if the front rises when the train accelerates toward rising chainage.
    #: The pitch is the response of a damped oscillator with the period `pitch_period_s`.
    pitch_deg_per_mps2: Finite = 0.0


class SkySettings(ScenarioSettings):
    """Satellites and atmosphere."""

    #: Letters of the constellations: G (30 satellites in 6 planes), J (3 inclined geosynchronous, 1 geostationary), E
    #: (24 in 3 planes), C (24 in 3 planes, 3 inclined geosynchronous); with `nav`, only these constellations of the
    #: file are used.
    systems: str = "GJE"
    #: RINEX navigation file used instead of simulated satellites; in a scenario file, relative to the scenario file.
    nav: str | None = None
    cutoff_deg: float = Field(default=5.0, ge=0.0, lt=90.0)  #: Satellites below this elevation are not tracked.
    #: Satellites whose records in force during the run are marked unhealthy.
    unhealthy: tuple[str, ...] = ("G02",)
    #: At most this number of satellites is tracked at an epoch: those with the highest elevations; None for no limit.
    satellites_at_most: Annotated[int, Field(ge=1)] | None = None
    ionosphere_scale: NotNegative = 1.0  #: Factor on modelled ionospheric delays; 1 leaves no residual error.
    troposphere_scale: NotNegative = 1.0  #: Factor on modelled tropospheric delays; 1 leaves no residual error.

    @field_validator("systems")
    @classmethod
    def _letters(cls, systems: str) -> str:
        if not systems or set(systems) - set(SYSTEMS) or len(set(systems)) < len(systems):
            raise ValueError(f"must have letters of {SYSTEMS!r} only, each at most once")
        return systems

    @model_validator(mode="after")
    def _healthy_file(self) -> SkySettings:
        if self.nav is not None and self.unhealthy:
            raise ValueError("unhealthy is for simulated satellites; with a navigation file, give an empty list")
        return self


class ReceiverSettings(ScenarioSettings):
    """Receivers: clocks, and noise that is white in time and independent between channels.

    The standard deviation of a code is ``code_sigma_m * 10^(-(min(C/N0, 50) - 45) / 20) / sin(elevation)`` with the
    C/N0 written to the log.
    """

    #: Number of observed signals per satellite, each with code, phase, Doppler and C/N0.
    signals_per_satellite: Literal[1, 2] = 1
    #: Second signals. "L2" stands for L2C, E5b and B3I. "L5" stands for L5, E5a and B2a; BeiDou satellites then have
    #: B1C instead of B1I, and B-CNAV1 records instead of D1 records.
    second: Literal["L2", "L5"] = "L2"
    code_sigma_m: NotNegative = 0.5  #: Standard deviation of the code noise at the zenith and 45 dB-Hz.
    phase_sigma_m: NotNegative = 0.002  #: Standard deviation of the carrier-phase noise.
    doppler_sigma_hz: NotNegative = 0.05  #: Standard deviation of the Doppler noise.
    cn0_sigma_dbhz: NotNegative = 0.7  #: Standard deviation of the C/N0 noise.
    #: Time constant of a low-pass filter of the code's multipath error, which simulates carrier smoothing and restarts
    #: when a signal is acquired; 0 for no filter.
    code_smoothing_s: NotNegative = 0.0
    cn0_horizon_dbhz: Finite = CN0_HORIZON_DBHZ  #: C/N0 of an unobstructed signal at the horizon.
    #: C/N0 at the zenith minus C/N0 at the horizon; the increase is proportional to the sine of the elevation.
    cn0_rise_db: Finite = CN0_RISE_DB
    cn0_satellite_sigma_db: NotNegative = 0.0  #: Standard deviation of constant C/N0 differences between satellites.
    clocks: Literal["separate", "common"] = "separate"  #: The two receivers have separate clocks, or one clock.
    #: Clock bias of the front receiver at the start; biases of other receivers with separate clocks are fixed multiples
    #: of this bias.
    clock_bias_s: float = Field(default=1.2e-4, gt=-0.01, lt=0.01)
    #: Clock drift of the front receiver [s/s]; for other receivers it is multiplied by the same factors as the bias.
    clock_drift: Finite = 2.0e-7
    #: With "millisecond", the receivers step their clocks by whole milliseconds, so that the bias stays within 0.5 ms.
    clock_steps: Literal["none", "millisecond"] = "none"

    @property
    def has_l5(self) -> bool:
        """Whether the receivers observe two signals per satellite, L1 and L5 or their equivalents."""
        return self.signals_per_satellite == 2 and self.second == "L5"


class ReferenceStation(ScenarioSettings):
    """Receiver near the line under an open sky, with its own clock and noise."""

    #: Name of the station and of its log: a lower-case letter, then lower-case letters, digits and hyphens.
    name: str = Field(default="station", pattern="^[a-z][a-z0-9-]*$")
    chainage_m: Finite = 0.0
    lateral_m: Finite = 50.0  #: Distance of the antenna to the right of the track axis.
    height_m: Finite = 10.0  #: Height of the antenna above the rails.
    faults: tuple[SatelliteFault, ...] = ()  #: Range errors of satellites that affect only this receiver.


class Scenario(ScenarioSettings):
    """Settings of one simulated run."""

    seed: Seed = 20_240_305  #: Seed of all random numbers except for the line and the structures along it.
    start: GpsTime = np.datetime64("2024-03-05T03:10:00", "ns")  #: First time tag, GPS time.
    duration_s: float = Field(default=200.0, gt=0.0, le=LONGEST_S)
    rate_hz: float = Field(default=10.0, gt=0.0, le=1000.0)  #: Epochs per second; 1 / rate is a multiple of 100 ns.
    line: LineSettings = LineSettings()
    run: RunSettings = RunSettings()
    vehicle: VehicleSettings = VehicleSettings()
    sky: SkySettings = SkySettings()
    receiver: ReceiverSettings = ReceiverSettings()
    #: Satellite, atmospheric and receiver errors in addition to the noise of `receiver`; none by default.
    errors: ErrorSettings = ErrorSettings()
    environment: EnvironmentSettings = EnvironmentSettings()  #: Structures along the line; none by default.
    #: Seed of the structures along the line, so that runs with different seeds pass the same structures.
    place_seed: Seed = 1
    sensors: SensorSettings | None = None  #: On-board sensors in addition to the receivers; None for no sensors.
    stations: tuple[ReferenceStation, ...] = ()  #: Reference stations whose observations are also written.
    sbas: SbasSettings | None = None  #: SBAS that broadcasts corrections of the simulated errors; None for no SBAS.
    #: Further disturbances of the signals, set only in Python; they are neither in `describe` nor in scenario files.
    multipath: tuple[Disturbances, ...] = Field(default=(), exclude=True)

    @field_validator("stations")
    @classmethod
    def _distinct_names(cls, stations: tuple[ReferenceStation, ...]) -> tuple[ReferenceStation, ...]:
        names = [*_FILES, *(station.name for station in stations)]
        if len(set(names)) < len(names):
            raise ValueError(f"must have names that differ from each other and from {', '.join(_FILES)}")
        return stations

    @model_validator(mode="after")
    def _receivers_of_l5(self) -> Scenario:
        if self.sbas is not None and self.sbas.band == "L5" and not self.receiver.has_l5:
            raise ValueError('sbas.band = "L5" needs receiver.signals_per_satellite = 2 and receiver.second = "L5"')
        return self

    @model_validator(mode="after")
    def _whole_epochs(self) -> Scenario:
        if abs(1e7 / self.rate_hz - round(1e7 / self.rate_hz)) > 1e-6:
            raise ValueError(f"1 / rate_hz must be a multiple of 100 ns, got rate_hz {self.rate_hz}")
        if self.epochs < 1:
            raise ValueError("duration_s times rate_hz is less than one epoch")
        if not np.isnan(self.line.length_m) and (problem := self._room_problem(self.line.length_m)):
            raise ValueError(problem)
        return self

    def check_room(self, length_m: float) -> None:
        """Raise SettingsError if the vehicle or a station is beyond an end of a line of the given length [m]."""
        if problem := self._room_problem(length_m):
            raise SettingsError(problem)

    def _room_problem(self, length_m: float) -> str:
        """Return the reason why the train does not fit on a line of the given length [m]; empty if it fits."""
        margin, stations = self.run.end_margin_m, self.run.stations
        reach = max(abs(v) for v in (self.vehicle.front[0], self.vehicle.rear[0], self.vehicle.bogie_distance_m / 2.0))
        if length_m <= 2.0 * margin or margin < reach + 1.0:
            return (
                f"run.end_margin_m is {margin} m; expected at least {reach + 1.0:g} m (the vehicle extends {reach:g} m "
                f"from its middle) and less than half of the line length of {length_m:g} m"
            )
        outside = [item.at_m for item in stations if not margin <= item.at_m <= length_m - margin]
        if outside:
            return (
                f"run.stations: {outside[0]} m lies within {margin} m of an end of the line or beyond it; "
                f"the line is {length_m:g} m long"
            )
        return ""

    @property
    def epochs(self) -> int:
        """Number of epochs, duration times rate."""
        return round(self.duration_s * self.rate_hz)

    @property
    def interval_s(self) -> float:
        """Interval between two epochs [s]."""
        return float(self.interval / np.timedelta64(1, "s"))

    @property
    def receivers(self) -> tuple[str, ...]:
        """Names of all receivers: the antennas, then the reference stations."""
        return (*ANTENNAS, *(station.name for station in self.stations))

    @property
    def interval(self) -> np.timedelta64:
        """Interval between two epochs."""
        return np.timedelta64(round(1e7 / self.rate_hz) * 100, "ns")

    def describe(self) -> dict[str, Any]:
        """Return all settings by dotted name; elements of a list have their number, from 1, in the name."""
        return _flatten("", self.model_dump() | {"start": str(self.start)})


def _flatten(name: str, value: Any) -> dict[str, Any]:
    if isinstance(value, tuple) and any(isinstance(part, Mapping) for part in value):
        value = {str(k): part for k, part in enumerate(value, 1)}
    if not isinstance(value, Mapping) or not value:
        return {name: value}
    inner = [_flatten(f"{name}.{key}" if name else key, part) for key, part in value.items()]
    return {key: part for table in inner for key, part in table.items()}

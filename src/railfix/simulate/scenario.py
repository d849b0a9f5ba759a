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

ANTENNAS: Final = ("front", "rear")  #: Antennas of the vehicle, in the order in which they are written.
#: Names of other files of a run.
_FILES: Final = (*ANTENNAS, "nav", "track", "vehicle", "truth", "sections", "scenario", "readme", "sbas")
LONGEST_S: Final = 8.64e6  #: Longest run, a hundred days; longer series are split into several runs [s].


class Station(ScenarioSettings):
    """Where the train stops."""

    at_m: NotNegative  #: Chainage of the vehicle's middle.
    dwell_s: NotNegative = 30.0
    name: str = ""


class SpeedLimit(ScenarioSettings):
    """Highest speed of the vehicle's middle on a part of the line."""

    from_m: Finite
    to_m: Finite
    limit_mps: Positive

    _forward = field_validator("to_m")(beyond_start)


class RunSettings(ScenarioSettings):
    """Motion of the train: it waits, then runs from stop to stop and back, until the end of the run."""

    #: Accelerations are constant. Where a leg is too short the cruising speed is not reached.
    cruise_mps: Positive = 40.0 / 3.6
    acceleration_mps2: Positive = 0.7
    deceleration_mps2: Positive = 0.8
    #: Standing times at the start of the run, and at each end without a station.
    first_stand_s: NotNegative = 15.0
    stand_s: NotNegative = 10.0
    #: Distance from the vehicle's middle to the ends of the line where the train turns.
    end_margin_m: NotNegative = 20.0
    #: Stops by rising chainage, the first and the last included; without any the train runs from end to end.
    stations: tuple[Station, ...] = ()

    limits: tuple[SpeedLimit, ...] = ()
    #: Curves are run at the speed whose equilibrium cant is the curve's cant plus this; None: no limit by curves.
    cant_deficiency_m: Positive | None = None
    jerk_mps3: Positive | None = None  #: Largest jerk; None: unlimited jerk.
    #: Direction of the first leg. The vehicle's front points to rising chainage in either direction of running.
    direction: Literal["rising", "falling"] = "rising"
    at_end: Literal["return", "stand"] = "return"  #: After the last stop.

    @field_validator("stations")
    @classmethod
    def _apart(cls, stations: tuple[Station, ...]) -> tuple[Station, ...]:
        places = [station.at_m for station in stations]
        if len(places) == 1 or any(b - a < 10.0 for a, b in pairwise(places)):
            raise ValueError(f"must be two or more, rising by 10 m or more; they are at {places}")
        return stations


class VehicleSettings(ScenarioSettings):
    """The vehicle, in metres; antennas as (along, across to the right, above the rail tops).

    The origin is midway between the bogie centres at the height of the rail tops; the front points in the direction of
    rising chainage. Cant is measured between the wheels' contact points, 70 mm wider than the gauge.
    """

    name: str = "simulated test car"
    bogie_distance_m: Positive = 13.8
    gauge_m: Positive = 1.067
    front: Three = (9.1, 0.25, 3.95)
    rear: Three = (-9.1, 0.25, 3.95)
    length_m: Positive = 23.2  #: Distance over the ends, which are equally far from the middle between the bogies.
    #: Roll of the body about its forward axis at 20 m/s and more, in proportion to the speed below that. Not in the
    #: vehicle's file, as it is unknown in practice.
    sway_sigma_deg: NotNegative = 0.0
    sway_period_s: Positive = 1.5
    #: Random pitch of the body on its suspension at 20 m/s and more, in proportion to the speed below that.
    pitch_sigma_deg: NotNegative = 0.0
    pitch_period_s: Positive = 1.0
    #: Pitch under a constant acceleration, positive where the front rises when the train accelerates toward rising
    #: chainage; it follows the acceleration as a damped oscillator of `pitch_period_s`.
    pitch_deg_per_mps2: Finite = 0.0


class SkySettings(ScenarioSettings):
    """Satellites and atmosphere."""

    #: Letters out of G (30 satellites in 6 planes), J (3 inclined, 1 over the equator), E (24 in 3 planes), C (24 in 3
    #: planes and 3 inclined geosynchronous; no GEO); or the constellations of the file.
    systems: str = "GJE"
    #: A RINEX navigation file instead of the simulated satellites; in a scenario file relative to that file.
    nav: str | None = None
    cutoff_deg: float = Field(default=5.0, ge=0.0, lt=90.0)  #: Elevation below which no signal is tracked.
    #: Satellites whose newer records are unhealthy, while the record before the run is healthy.
    unhealthy: tuple[str, ...] = ("G02",)
    #: Largest number of satellites tracked, the highest ones of each epoch.
    satellites_at_most: Annotated[int, Field(ge=1)] | None = None
    #: Delays in the ranges as multiples of the models'; 1 leaves no error after correction.
    ionosphere_scale: NotNegative = 1.0
    troposphere_scale: NotNegative = 1.0

    @field_validator("systems")
    @classmethod
    def _letters(cls, systems: str) -> str:
        if not systems or set(systems) - set(SYSTEMS) or len(set(systems)) < len(systems):
            raise ValueError(f"must be letters out of {SYSTEMS!r}, each once")
        return systems

    @model_validator(mode="after")
    def _healthy_file(self) -> SkySettings:
        if self.nav is not None and self.unhealthy:
            raise ValueError("unhealthy is for simulated satellites; with a navigation file give an empty list")
        return self


class ReceiverSettings(ScenarioSettings):
    """Receivers: clocks, and noise that is white in time and independent between channels.

    The standard deviation of a code is ``code_sigma_m * 10^(-(min(C/N0, 50) - 45) / 20) /
    sin(elevation)`` with the C/N0 that is written.
    """

    signals_per_satellite: Literal[1, 2] = 1  #: 1 gives four observables per satellite, 2 gives eight.
    #: Second signals: L2C, E5b, B3I; or L5, E5a and B2a, with B1C instead of B1I and B-CNAV1 instead of D1.
    second: Literal["L2", "L5"] = "L2"
    #: 0 switches that noise off.
    code_sigma_m: NotNegative = 0.5
    phase_sigma_m: NotNegative = 0.002
    doppler_sigma_hz: NotNegative = 0.05
    cn0_sigma_dbhz: NotNegative = 0.7
    #: Time constant with which the code follows its multipath error while locked, as with carrier smoothing.
    code_smoothing_s: NotNegative = 0.0
    #: C/N0 of an unobstructed signal at the horizon, and its rise in proportion to the sine of the elevation.
    cn0_horizon_dbhz: Finite = CN0_HORIZON_DBHZ
    cn0_rise_db: Finite = CN0_RISE_DB
    cn0_satellite_sigma_db: NotNegative = 0.0  #: Constant difference of each satellite's C/N0.
    clocks: Literal["separate", "common"] = "separate"  #: Whether the two receivers run on one clock by hardware.
    #: Clock of the front receiver at the start [s], and [s/s]; a separate rear clock has other values of this size.
    clock_bias_s: float = Field(default=1.2e-4, gt=-0.01, lt=0.01)
    clock_drift: Finite = 2.0e-7
    #: "millisecond" steps a clock that is off by over half a millisecond back by a whole millisecond.
    clock_steps: Literal["none", "millisecond"] = "none"

    @property
    def has_l5(self) -> bool:
        """Whether two signals of a satellite are L1 and L5, or their equivalents."""
        return self.signals_per_satellite == 2 and self.second == "L5"


class ReferenceStation(ScenarioSettings):
    """Receiver near the line under an open sky, with its own clock and noise."""

    #: Name of its log; small letters, digits and hyphens.
    name: str = Field(default="station", pattern="^[a-z][a-z0-9-]*$")
    #: Position: along the line, to the right of the track's axis, above the rails.
    chainage_m: Finite = 0.0
    lateral_m: Finite = 50.0
    height_m: Finite = 10.0
    faults: tuple[SatelliteFault, ...] = ()  #: Faults of this receiver alone, by satellite.


class Scenario(ScenarioSettings):
    """One run."""

    seed: Seed = 20_240_305  #: The same scenario gives the same numbers.
    start: GpsTime = np.datetime64("2024-03-05T03:10:00", "ns")  #: First time tag, GPS time.
    #: Duration and rate; their product is the number of epochs. The interval must be a multiple of 100 ns.
    duration_s: float = Field(default=200.0, gt=0.0, le=LONGEST_S)
    rate_hz: float = Field(default=10.0, gt=0.0, le=1000.0)
    #: Settings of the parts.
    line: LineSettings = LineSettings()
    run: RunSettings = RunSettings()
    vehicle: VehicleSettings = VehicleSettings()
    sky: SkySettings = SkySettings()
    receiver: ReceiverSettings = ReceiverSettings()
    #: Errors of satellites, atmosphere and receivers beyond the noise of `receiver`; none by default.
    errors: ErrorSettings = ErrorSettings()
    environment: EnvironmentSettings = EnvironmentSettings()  #: Structures along the line; none by default.
    #: Seed of the structures along the line, so that runs of other seeds pass the same structures.
    place_seed: Seed = 1
    sensors: SensorSettings | None = None  #: Sensors on board besides the receivers.
    #: Reference stations whose observations are written in addition to the train's.
    stations: tuple[ReferenceStation, ...] = ()
    sbas: SbasSettings | None = None  #: SBAS that corrects the simulated errors, and that the train receives.
    #: Further disturbances of the signals, from Python only; not in `describe` nor in scenario files.
    multipath: tuple[Disturbances, ...] = Field(default=(), exclude=True)

    @field_validator("stations")
    @classmethod
    def _distinct_names(cls, stations: tuple[ReferenceStation, ...]) -> tuple[ReferenceStation, ...]:
        names = [*_FILES, *(station.name for station in stations)]
        if len(set(names)) < len(names):
            raise ValueError(f"must have different names, none of {', '.join(_FILES)}")
        return stations

    @model_validator(mode="after")
    def _receivers_of_l5(self) -> Scenario:
        if self.sbas is not None and self.sbas.band == "L5" and not self.receiver.has_l5:
            raise ValueError('sbas.band = "L5" needs receiver.signals_per_satellite = 2 and receiver.second = "L5"')
        return self

    @model_validator(mode="after")
    def _whole_epochs(self) -> Scenario:
        if abs(1e7 / self.rate_hz - round(1e7 / self.rate_hz)) > 1e-6:
            raise ValueError(f"rate_hz must give an interval of whole 100 ns, got {self.rate_hz}")
        if self.epochs < 1:
            raise ValueError("duration_s times rate_hz is less than one epoch")
        if not np.isnan(self.line.length_m) and (problem := self._room_problem(self.line.length_m)):
            raise ValueError(problem)
        return self

    def check_room(self, length_m: float) -> None:
        """Raise SettingsError where the vehicle or a station would be beyond an end of a line of this length."""
        if problem := self._room_problem(length_m):
            raise SettingsError(problem)

    def _room_problem(self, length_m: float) -> str:
        """Return the sentence on why the train does not stay within a line of this length; empty where it does."""
        margin, stations = self.run.end_margin_m, self.run.stations
        reach = max(abs(v) for v in (self.vehicle.front[0], self.vehicle.rear[0], self.vehicle.bogie_distance_m / 2.0))
        if length_m <= 2.0 * margin or margin < reach + 1.0:
            return (
                f"run.end_margin_m is {margin} m; expected at least {reach + 1.0:g} m, for the vehicle extends "
                f"{reach:g} m from its middle, and less than half of the line, which is {length_m:g} m long"
            )
        outside = [item.at_m for item in stations if not margin <= item.at_m <= length_m - margin]
        if outside:
            return (
                f"run.stations: {outside[0]} m lies within {margin} m of an end of the line or beyond, "
                f"which is {length_m:g} m long"
            )
        return ""

    @property
    def epochs(self) -> int:
        """Number of epochs."""
        return round(self.duration_s * self.rate_hz)

    @property
    def interval_s(self) -> float:
        """Time between two epochs [s]."""
        return float(self.interval / np.timedelta64(1, "s"))

    @property
    def receivers(self) -> tuple[str, ...]:
        """Names of all receivers: the antennas, then the reference stations."""
        return (*ANTENNAS, *(station.name for station in self.stations))

    @property
    def interval(self) -> np.timedelta64:
        """Time between two epochs."""
        return np.timedelta64(round(1e7 / self.rate_hz) * 100, "ns")

    def describe(self) -> dict[str, Any]:
        """Return all settings as plain values, by their dotted names; elements of a list by their number, from 1."""
        return _flatten("", self.model_dump() | {"start": str(self.start)})


def _flatten(name: str, value: Any) -> dict[str, Any]:
    if isinstance(value, tuple) and any(isinstance(part, Mapping) for part in value):
        value = {str(k): part for k, part in enumerate(value, 1)}
    if not isinstance(value, Mapping) or not value:
        return {name: value}
    inner = [_flatten(f"{name}.{key}" if name else key, part) for key, part in value.items()]
    return {key: part for table in inner for key, part in table.items()}

"""What is simulated: every choice with its default, in frozen dataclasses.

The defaults are the shipped demonstration run: a made test line about like P1's (table 1: 756 m,
189 points, 2 to 3 m apart in curves and at most about 20 m on straights), a train of P1's
dimensions (antennas 18.2 m apart) and a made sky. Nothing in it exists.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass
from itertools import pairwise
from typing import Any, Final, Literal

import numpy as np

from railfix.core.errors import SettingsError
from railfix.simulate.disturbance import Disturbances
from railfix.simulate.environment.settings import EnvironmentSettings
from railfix.simulate.errors.settings import ErrorSettings
from railfix.simulate.line_settings import LineSettings
from railfix.simulate.sensors.settings import SensorSettings
from railfix.simulate.setting_checks import require_not_negative, require_one_of, require_positive

#: Antennas of the vehicle, in the order in which they are written.
ANTENNAS: Final = ("front", "rear")
#: Constellations that can be made.
SYSTEMS: Final = "GJEC"


@dataclass(frozen=True, kw_only=True)
class Station:
    """Where the train stops.

    Attributes
    ----------
    at_m : float
        Chainage of the vehicle's middle.
    dwell_s : float
    name : str
    """

    at_m: float
    dwell_s: float = 30.0
    name: str = ""

    def __post_init__(self) -> None:
        require_not_negative(self, "at_m", "dwell_s")


@dataclass(frozen=True, kw_only=True)
class SpeedLimit:
    """Highest speed of the vehicle's middle on a part of the line.

    Attributes
    ----------
    from_m, to_m, limit_mps : float
    """

    from_m: float
    to_m: float
    limit_mps: float

    def __post_init__(self) -> None:
        require_positive(self, "limit_mps")
        if not self.to_m > self.from_m:
            raise SettingsError(f"SpeedLimit.to_m must lie beyond from_m of {self.from_m}, got {self.to_m}")


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """How the train runs: it stands, runs from stop to stop, and comes back, until the time is up.

    Attributes
    ----------
    cruise_mps, acceleration_mps2, deceleration_mps2 : float
        Accelerating and braking are even. Where a leg is too short the cruising speed is not reached.
    first_stand_s, stand_s : float
        Standing at the start of the run, and at each end where no station says otherwise.
    end_margin_m : float
        Distance from the vehicle's middle to the ends of the line where the train turns.
    stations : tuple of Station
        Stops by rising chainage, the first and the last included; without any the train runs from end to end.
    limits : tuple of SpeedLimit
    cant_deficiency_m : float or None
        Curves are run at the speed whose equilibrium cant is the curve's cant and this; None: curves do not limit.
    direction : {"rising", "falling"}
        Of the first way. The vehicle's front points to rising chainage either way.
    at_end : {"return", "stand"}
        What the train does after its last stop.
    """

    cruise_mps: float = 40.0 / 3.6
    acceleration_mps2: float = 0.7
    deceleration_mps2: float = 0.8
    first_stand_s: float = 15.0
    stand_s: float = 10.0
    end_margin_m: float = 20.0
    stations: tuple[Station, ...] = ()
    limits: tuple[SpeedLimit, ...] = ()
    cant_deficiency_m: float | None = None
    direction: Literal["rising", "falling"] = "rising"
    at_end: Literal["return", "stand"] = "return"

    def __post_init__(self) -> None:
        require_positive(self, "cruise_mps", "acceleration_mps2", "deceleration_mps2")
        require_not_negative(self, "first_stand_s", "stand_s", "end_margin_m")
        require_one_of(self, "direction", ("rising", "falling"))
        require_one_of(self, "at_end", ("return", "stand"))
        if self.cant_deficiency_m is not None:
            require_positive(self, "cant_deficiency_m")
        places = [station.at_m for station in self.stations]
        if len(places) == 1 or any(b - a < 10.0 for a, b in pairwise(places)):
            raise SettingsError(f"RunSettings.stations must be two or more, rising by 10 m or more, got {places}")


@dataclass(frozen=True, kw_only=True)
class VehicleSettings:
    """The vehicle, in metres; antennas as (along, across to the right, above the rail tops).

    The origin lies midway between the bogie centres at the height of the rail tops; the front points
    in the direction of rising chainage. Cant is measured between the wheels' contact points,
    70 mm wider than the gauge.

    Attributes
    ----------
    name : str
    bogie_distance_m, gauge_m : float
    front, rear : tuple of float
    sway_sigma_deg, sway_period_s : float
        Swaying of the body about its forward axis at 20 m/s and more, in proportion to the speed below that;
        one for both antennas. Not in the vehicle's file: nobody knows it.
    """

    name: str = "made test car"
    bogie_distance_m: float = 13.8
    gauge_m: float = 1.067
    front: tuple[float, float, float] = (9.1, 0.25, 3.95)
    rear: tuple[float, float, float] = (-9.1, 0.25, 3.95)
    sway_sigma_deg: float = 0.0
    sway_period_s: float = 1.5

    def __post_init__(self) -> None:
        require_positive(self, "bogie_distance_m", "gauge_m", "sway_period_s")
        require_not_negative(self, "sway_sigma_deg")


@dataclass(frozen=True, kw_only=True)
class SkySettings:
    """Satellites and atmosphere.

    Attributes
    ----------
    systems : str
        Letters out of G (30 satellites in 6 planes), J (3 inclined, 1 over the equator), E (24 in 3
        planes), C (24 in 3 planes and 3 inclined geosynchronous; no GEO); or those of the file.
    nav : str or None
        A RINEX navigation file in place of the made satellites; in a scenario file relative to that file.
    cutoff_deg : float
        Below this elevation nothing is tracked.
    unhealthy : tuple of str
        Satellites whose newer records say unhealthy, while the record before the run says healthy.
    satellites_at_most : int or None
        Only that many, the highest of each epoch, are tracked.
    ionosphere_scale, troposphere_scale : float
        Delays in the ranges as multiples of the models'; 1 leaves no error after correction.
    """

    systems: str = "GJE"
    nav: str | None = None
    cutoff_deg: float = 5.0
    unhealthy: tuple[str, ...] = ("G02",)
    satellites_at_most: int | None = None
    ionosphere_scale: float = 1.0
    troposphere_scale: float = 1.0

    def __post_init__(self) -> None:
        if not self.systems or set(self.systems) - set(SYSTEMS) or len(set(self.systems)) < len(self.systems):
            raise SettingsError(
                f"SkySettings.systems must be letters out of {SYSTEMS!r}, each once, got {self.systems!r}"
            )
        if not 0.0 <= self.cutoff_deg < 90.0:
            raise SettingsError(f"SkySettings.cutoff_deg must lie in [0, 90), got {self.cutoff_deg}")
        if self.satellites_at_most is not None and self.satellites_at_most < 1:
            raise SettingsError(f"SkySettings.satellites_at_most must be at least 1, got {self.satellites_at_most}")
        if self.nav is not None and self.unhealthy:
            raise SettingsError(
                "SkySettings.unhealthy is for the made satellites; with a navigation file give an empty list"
            )
        require_not_negative(self, "ionosphere_scale", "troposphere_scale")


@dataclass(frozen=True, kw_only=True)
class ReceiverSettings:
    """Receivers: clocks, and noise that is white in time and independent between channels.

    The standard deviation of a code is ``code_sigma_m * 10^(-(min(C/N0, 50) - 45) / 20) /
    sin(elevation)`` with the C/N0 that is written.

    Attributes
    ----------
    signals_per_satellite : {1, 2}
        1 gives four observables a satellite, 2 gives eight.
    code_sigma_m, phase_sigma_m, doppler_sigma_hz, cn0_sigma_dbhz : float
        0 switches that noise off.
    clocks : {"separate", "common"}
        Whether the two receivers run on one clock by hardware.
    clock_bias_s, clock_drift : float
        Of the front receiver at the start [s], and [s/s]; a separate rear clock has other values of
        this size.
    clock_steps : {"none", "millisecond"}
        "millisecond" puts a clock that is over half a millisecond off back by a whole one.
    """

    signals_per_satellite: Literal[1, 2] = 1
    code_sigma_m: float = 0.5
    phase_sigma_m: float = 0.002
    doppler_sigma_hz: float = 0.05
    cn0_sigma_dbhz: float = 0.7
    clocks: Literal["separate", "common"] = "separate"
    clock_bias_s: float = 1.2e-4
    clock_drift: float = 2.0e-7
    clock_steps: Literal["none", "millisecond"] = "none"

    def __post_init__(self) -> None:
        require_not_negative(self, "code_sigma_m", "phase_sigma_m", "doppler_sigma_hz", "cn0_sigma_dbhz")
        require_one_of(self, "signals_per_satellite", (1, 2))
        require_one_of(self, "clocks", ("separate", "common"))
        require_one_of(self, "clock_steps", ("none", "millisecond"))
        if not abs(self.clock_bias_s) < 0.01:
            raise SettingsError(f"ReceiverSettings.clock_bias_s must lie within 10 ms, got {self.clock_bias_s}")


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """One run.

    Attributes
    ----------
    seed : int
        The same scenario gives the same numbers.
    start : datetime64
        First time tag, GPS time.
    duration_s, rate_hz : float
        Number of epochs is their product; the interval must be a whole number of 100 ns.
    line, run, vehicle, sky, receiver
        Settings of the parts.
    errors : ErrorSettings
        What satellites, atmosphere and receivers are off by beyond the noise of `receiver`; nothing by default.
    sensors : SensorSettings or None
        Sensors on board besides the receivers.
    environment : EnvironmentSettings
        What stands along the line; nothing by default.
    place_seed : int
        Of what is drawn along the line, so that runs of other seeds pass the same place.
    multipath : tuple of Disturbances
        More that is added to the clean signals, from Python only; not in `describe` nor in scenario files.
    """

    seed: int = 20_240_305
    start: np.datetime64 = field(default_factory=lambda: np.datetime64("2024-03-05T03:10:00", "ns"))
    duration_s: float = 200.0
    rate_hz: float = 10.0
    line: LineSettings = field(default_factory=LineSettings)
    run: RunSettings = field(default_factory=RunSettings)
    vehicle: VehicleSettings = field(default_factory=VehicleSettings)
    sky: SkySettings = field(default_factory=SkySettings)
    receiver: ReceiverSettings = field(default_factory=ReceiverSettings)
    errors: ErrorSettings = field(default_factory=ErrorSettings)
    environment: EnvironmentSettings = field(default_factory=EnvironmentSettings)
    place_seed: int = 1
    sensors: SensorSettings | None = None
    multipath: tuple[Disturbances, ...] = ()

    def __post_init__(self) -> None:
        require_not_negative(self, "seed", "place_seed")
        require_positive(self, "duration_s", "rate_hz")
        if abs(1e7 / self.rate_hz - round(1e7 / self.rate_hz)) > 1e-6:
            raise SettingsError(f"Scenario.rate_hz must give an interval of whole 100 ns, got {self.rate_hz}")
        if self.epochs < 1:
            raise SettingsError("Scenario.duration_s times rate_hz is less than one epoch")
        if np.isnat(self.start):
            raise SettingsError("Scenario.start must be a time, got NaT")
        if not np.isnan(self.line.length_m):
            self.check_room(self.line.length_m)

    def check_room(self, length_m: float) -> None:
        """Whether the train runs within a line of this length.

        Raises
        ------
        SettingsError
            The vehicle or a station would stand beyond an end.
        """
        margin, stations = self.run.end_margin_m, self.run.stations
        reach = max(abs(v) for v in (self.vehicle.front[0], self.vehicle.rear[0], self.vehicle.bogie_distance_m / 2.0))
        if length_m <= 2.0 * margin or margin < reach + 1.0:
            raise SettingsError(
                f"RunSettings.end_margin_m of {margin} m does not keep the vehicle "
                f"({reach} m either way) on a line of {length_m:g} m"
            )
        outside = [item.at_m for item in stations if not margin <= item.at_m <= length_m - margin]
        if outside:
            raise SettingsError(
                f"RunSettings.stations: {outside[0]} m lies within {margin} m of an end of the line or beyond, "
                f"which is {length_m:g} m long"
            )

    @property
    def epochs(self) -> int:
        """Number of epochs."""
        return round(self.duration_s * self.rate_hz)

    @property
    def interval(self) -> np.timedelta64:
        """Time between two epochs."""
        return np.timedelta64(round(1e7 / self.rate_hz) * 100, "ns")

    def describe(self) -> dict[str, Any]:
        """All settings as plain values, by their dotted names; those of a list by their number, from 1."""
        flat: dict[str, Any] = {}
        for item in fields(self):
            if item.name != "multipath":
                _flatten(item.name, getattr(self, item.name), flat)
        return flat


def _flatten(name: str, value: Any, flat: dict[str, Any]) -> None:
    if is_dataclass(value):
        for item in fields(value):
            _flatten(f"{name}.{item.name}", getattr(value, item.name), flat)
    elif isinstance(value, dict) and value:
        for key, inner in value.items():
            _flatten(f"{name}.{key}", inner, flat)
    elif isinstance(value, tuple) and any(is_dataclass(inner) for inner in value):
        for k, inner in enumerate(value, 1):
            _flatten(f"{name}.{k}", inner, flat)
    else:
        flat[name] = str(value) if isinstance(value, np.datetime64) else value

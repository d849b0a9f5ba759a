"""What is simulated: every choice with its default, in frozen dataclasses.

The defaults are the shipped demonstration run: a made test line about like P1's (table 1: 756 m,
189 points, 2 to 3 m apart in curves and at most about 20 m on straights), a train of P1's
dimensions (antennas 18.2 m apart) and a made sky. Nothing in it exists.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final, Literal

import numpy as np

from railfix.errors import SettingsError
from railfix.simulate.disturbance import Disturbances
from railfix.simulate.errors.settings import ErrorSettings
from railfix.simulate.sensors.settings import SensorSettings

#: Antennas of the vehicle, in the order in which they are written.
ANTENNAS: Final = ("front", "rear")
#: Constellations that can be made.
SYSTEMS: Final = "GJEC"


def _positive(table: Any, *names: str) -> None:
    for name in names:
        if not getattr(table, name) > 0:
            raise SettingsError(f"{type(table).__name__}.{name} must be positive, got {getattr(table, name)!r}")


def _not_negative(table: Any, *names: str) -> None:
    for name in names:
        if not getattr(table, name) >= 0:
            raise SettingsError(f"{type(table).__name__}.{name} must not be negative, got {getattr(table, name)!r}")


@dataclass(frozen=True, kw_only=True)
class LineSettings:
    """The line: where the pattern of P1's test line begins and how it is sampled.

    Attributes
    ----------
    name : str
    length_m : float
        The pattern, 756 m long, is repeated (every second time mirrored) and cut off here.
    latitude_deg, longitude_deg, height_m : float
        First point; ellipsoidal height. An invented place.
    azimuth_deg : float
        Direction of the line at its first point.
    kilometrage_start_m : float
        The line's own marking at its first point; it rises with the length.
    straight_spacing_m, curve_spacing_m : float
        Largest spacing of the map's points; curves include their transitions.
    """

    name: str = "made test line"
    length_m: float = 756.0
    latitude_deg: float = 35.05
    longitude_deg: float = 135.45
    height_m: float = 162.0
    azimuth_deg: float = 63.0
    kilometrage_start_m: float = 12_340.0
    straight_spacing_m: float = 20.0
    curve_spacing_m: float = 2.32

    def __post_init__(self) -> None:
        _positive(self, "length_m", "straight_spacing_m", "curve_spacing_m")
        if self.length_m < 100.0:
            raise SettingsError(f"LineSettings.length_m must be at least 100 m for a train to run, got {self.length_m}")
        if not abs(self.latitude_deg) < 80.0:
            raise SettingsError(f"LineSettings.latitude_deg must lie within 80 degrees, got {self.latitude_deg}")


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """How the train shuttles: it stands, runs to the far end, stands, and comes back, until the time is up.

    Attributes
    ----------
    cruise_mps, acceleration_mps2, deceleration_mps2 : float
        Accelerating and braking are even. Where a leg is too short the cruising speed is not reached.
    first_stand_s, stand_s : float
        Standing at the start of the run, and at each end.
    end_margin_m : float
        Distance from the vehicle's middle to the ends of the line where the train turns.
    """

    cruise_mps: float = 40.0 / 3.6
    acceleration_mps2: float = 0.7
    deceleration_mps2: float = 0.8
    first_stand_s: float = 15.0
    stand_s: float = 10.0
    end_margin_m: float = 20.0

    def __post_init__(self) -> None:
        _positive(self, "cruise_mps", "acceleration_mps2", "deceleration_mps2")
        _not_negative(self, "first_stand_s", "stand_s", "end_margin_m")


@dataclass(frozen=True, kw_only=True)
class VehicleSettings:
    """The vehicle, in metres; antennas as (along, across to the right, above the rail tops).

    The origin lies midway between the bogie centres at the height of the rail tops; the front points
    in the direction of rising chainage. Cant is measured between the wheels' contact points,
    70 mm wider than the gauge.
    """

    name: str = "made test car"
    bogie_distance_m: float = 13.8
    gauge_m: float = 1.067
    front: tuple[float, float, float] = (9.1, 0.25, 3.95)
    rear: tuple[float, float, float] = (-9.1, 0.25, 3.95)

    def __post_init__(self) -> None:
        _positive(self, "bogie_distance_m", "gauge_m")


@dataclass(frozen=True, kw_only=True)
class SkySettings:
    """Satellites and atmosphere.

    Attributes
    ----------
    systems : str
        Letters out of G (30 satellites in 6 planes), J (3 inclined, 1 over the equator), E (24 in 3
        planes), C (24 in 3 planes and 3 inclined geosynchronous; no GEO).
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
        _not_negative(self, "ionosphere_scale", "troposphere_scale")


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
        _not_negative(self, "code_sigma_m", "phase_sigma_m", "doppler_sigma_hz", "cn0_sigma_dbhz")
        _one_of(self, "signals_per_satellite", (1, 2))
        _one_of(self, "clocks", ("separate", "common"))
        _one_of(self, "clock_steps", ("none", "millisecond"))
        if not abs(self.clock_bias_s) < 0.01:
            raise SettingsError(f"ReceiverSettings.clock_bias_s must lie within 10 ms, got {self.clock_bias_s}")


def _one_of(table: Any, name: str, allowed: Sequence[object]) -> None:
    if getattr(table, name) not in allowed:
        raise SettingsError(f"{type(table).__name__}.{name} must be one of {allowed}, got {getattr(table, name)!r}")


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
    multipath : sequence of Disturbances
        What is added to the clean signals; none yet by default.
    errors : ErrorSettings
        What satellites, atmosphere and receivers are off by beyond the noise of `receiver`; nothing by default.
    sensors : SensorSettings or None
        Sensors on board besides the receivers.
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
    multipath: tuple[Disturbances, ...] = ()
    errors: ErrorSettings = field(default_factory=ErrorSettings)
    sensors: SensorSettings | None = None

    def __post_init__(self) -> None:
        _not_negative(self, "seed")
        _positive(self, "duration_s", "rate_hz")
        if abs(1e7 / self.rate_hz - round(1e7 / self.rate_hz)) > 1e-6:
            raise SettingsError(f"Scenario.rate_hz must give an interval of whole 100 ns, got {self.rate_hz}")
        if self.epochs < 1:
            raise SettingsError("Scenario.duration_s times rate_hz is less than one epoch")
        if np.isnat(self.start):
            raise SettingsError("Scenario.start must be a time, got NaT")
        room = self.line.length_m - 2.0 * self.run.end_margin_m
        reach = max(abs(v) for v in (self.vehicle.front[0], self.vehicle.rear[0], self.vehicle.bogie_distance_m / 2.0))
        if room <= 0.0 or self.run.end_margin_m < reach + 1.0:
            raise SettingsError(
                f"RunSettings.end_margin_m of {self.run.end_margin_m} m does not keep the vehicle "
                f"({reach} m either way) on a line of {self.line.length_m} m"
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
        """All settings as plain values, by their dotted names."""
        flat: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in ("errors", "sensors"):
                # Only what is not at its default of no error.
                usual = {"errors": ErrorSettings, "sensors": SensorSettings}[item.name]()
                for inner in fields(value) if value is not None else ():
                    if item.name == "sensors" or getattr(value, inner.name) != getattr(usual, inner.name):
                        flat[f"{item.name}.{inner.name}"] = getattr(value, inner.name)
            elif hasattr(value, "__dataclass_fields__"):
                flat |= {f"{item.name}.{inner.name}": getattr(value, inner.name) for inner in fields(value)}
            elif item.name != "multipath":
                flat[item.name] = str(value) if item.name == "start" else value
        return flat

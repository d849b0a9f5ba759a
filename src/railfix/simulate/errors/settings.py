"""Which errors are put into the signals; nothing by default, so that a receiver's corrections leave nothing.

Plain values in frozen dataclasses, so that a TOML table reads into them. A Gauss-Markov process has a
standard deviation and a correlation time: its autocorrelation is ``sigma^2 exp(-|lag| / time)``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from railfix.core.errors import SettingsError
from railfix.simulate.noise import NoiseSettings, TrackingSettings
from railfix.simulate.setting_checks import (
    require_finite,
    require_interval,
    require_not_negative,
    require_positive,
)

#: Constellations that errors can be given for.
_LETTERS = "GJEC"


@dataclass(frozen=True, kw_only=True)
class SatelliteErrorSettings:
    """Errors of the broadcast message, each satellite of a constellation its own.

    Attributes
    ----------
    clock_sigma_m, clock_time_s : float
        Gauss-Markov error of the clock, in metres of range.
    radial_sigma_m, along_sigma_m, cross_sigma_m : float
        Gauss-Markov errors of the place, true minus broadcast.
    orbit_time_s : float
        Their correlation time.
    group_delay_sigma_m : float
        Constant of each satellite and signal, in the code alone.
    """

    clock_sigma_m: float = 0.0
    clock_time_s: float = 3600.0
    radial_sigma_m: float = 0.0
    along_sigma_m: float = 0.0
    cross_sigma_m: float = 0.0
    orbit_time_s: float = 7200.0
    group_delay_sigma_m: float = 0.0

    def __post_init__(self) -> None:
        require_not_negative(
            self, "clock_sigma_m", "radial_sigma_m", "along_sigma_m", "cross_sigma_m", "group_delay_sigma_m"
        )
        require_positive(self, "clock_time_s", "orbit_time_s")


@dataclass(frozen=True, kw_only=True)
class IonosphereErrorSettings:
    """What the ionosphere is more than the model (times `SkySettings.ionosphere_scale`), on L1.

    Attributes
    ----------
    vertical_sigma_m, vertical_time_s : float
        Gauss-Markov vertical delay over the first point of the line.
    gradient_mm_per_km : float
        Growth of the vertical delay from there with the distance of the pierce point.
    gradient_azimuth_deg : float
        Direction in which it grows.
    """

    vertical_sigma_m: float = 0.0
    vertical_time_s: float = 1800.0
    gradient_mm_per_km: float = 0.0
    gradient_azimuth_deg: float = 0.0

    def __post_init__(self) -> None:
        require_not_negative(self, "vertical_sigma_m", "gradient_mm_per_km")
        require_positive(self, "vertical_time_s")
        require_finite(self, "gradient_azimuth_deg")


@dataclass(frozen=True, kw_only=True)
class TroposphereErrorSettings:
    """What the troposphere is more than the model (times `SkySettings.troposphere_scale`).

    Attributes
    ----------
    zenith_sigma_m, zenith_time_s : float
        Gauss-Markov zenith delay.
    """

    zenith_sigma_m: float = 0.0
    zenith_time_s: float = 7200.0

    def __post_init__(self) -> None:
        require_not_negative(self, "zenith_sigma_m")
        require_positive(self, "zenith_time_s")


@dataclass(frozen=True, kw_only=True)
class SatelliteFault:
    """A satellite whose ranges go wrong for a while, without a word in its message.

    Attributes
    ----------
    satellite : str
        "G07".
    start_s, end_s : float
        Seconds after the start of the run; an end of None is the end of the run.
    step_m : float
        Added to code and phase from the start on.
    ramp_mps : float
        Growth of the error from the start on.
    """

    satellite: str
    start_s: float
    end_s: float | None = None
    step_m: float = 0.0
    ramp_mps: float = 0.0

    def __post_init__(self) -> None:
        if re.fullmatch(f"[{_LETTERS}][0-9]{{2}}", self.satellite) is None:
            raise SettingsError(f"SatelliteFault.satellite must be a name like 'G07', got {self.satellite!r}")
        require_interval(self)
        require_finite(self, "step_m", "ramp_mps")


@dataclass(frozen=True, kw_only=True)
class ClockWalkSettings:
    """Wander of a receiver's clock about its even drift, as metres of range.

    Attributes
    ----------
    walk_m_per_sqrt_s : float
        Random walk of the bias: standard deviation after one second.
    frequency_walk_mps_per_sqrt_s : float
        Random walk of the drift: standard deviation after one second.
    """

    walk_m_per_sqrt_s: float = 0.0
    frequency_walk_mps_per_sqrt_s: float = 0.0

    def __post_init__(self) -> None:
        require_not_negative(self, "walk_m_per_sqrt_s", "frequency_walk_mps_per_sqrt_s")


@dataclass(frozen=True, kw_only=True)
class InterSystemSettings:
    """What a receiver measures a whole constellation too long, in code, phase and Doppler.

    Attributes
    ----------
    offset_m : float
        At the start of the run.
    drift_mps : float
    rear_difference_m : float
        The rear receiver has so much more, whether its clock is common or not.
    """

    offset_m: float = 0.0
    drift_mps: float = 0.0
    rear_difference_m: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self, "offset_m", "drift_mps", "rear_difference_m")


@dataclass(frozen=True, kw_only=True)
class ErrorSettings:
    """All errors of satellites, atmosphere and receivers; none by default.

    Attributes
    ----------
    satellites : dict of str to SatelliteErrorSettings
        By the letter of the constellation.
    ionosphere : IonosphereErrorSettings
    troposphere : TroposphereErrorSettings
    faults : tuple of SatelliteFault
    clock : ClockWalkSettings
        Both receivers alike; one walk where `ReceiverSettings.clocks` is "common".
    intersystem : dict of str to InterSystemSettings
        By the letter of the constellation.
    noise : NoiseSettings
        What the receivers' noise is beyond the white one of `ReceiverSettings`.
    tracking : TrackingSettings
    """

    satellites: dict[str, SatelliteErrorSettings] = field(default_factory=dict)
    ionosphere: IonosphereErrorSettings = field(default_factory=IonosphereErrorSettings)
    troposphere: TroposphereErrorSettings = field(default_factory=TroposphereErrorSettings)
    faults: tuple[SatelliteFault, ...] = ()
    clock: ClockWalkSettings = field(default_factory=ClockWalkSettings)
    intersystem: dict[str, InterSystemSettings] = field(default_factory=dict)
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)

    def __post_init__(self) -> None:
        for name in ("satellites", "intersystem"):
            strange = sorted(set(getattr(self, name)) - set(_LETTERS))
            if strange:
                raise SettingsError(f"ErrorSettings.{name} goes by letters out of {_LETTERS!r}, got {strange[0]!r}")

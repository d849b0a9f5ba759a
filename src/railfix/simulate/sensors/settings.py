"""Which sensors the vehicle carries besides its antennas, and their errors; a sensor named without errors has none."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

from railfix.core.errors import SettingsError
from railfix.simulate.setting_checks import (
    require_finite,
    require_interval,
    require_not_negative,
    require_positive,
    require_share,
)

Three = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class SlipInterval:
    """The tachometer's wheel turns faster or slower than it rolls.

    Attributes
    ----------
    start_s, end_s : float
        Seconds after the start of the run.
    ratio : float
        Most of (wheel speed - train speed) / train speed, in the middle of the interval, from and to 0
        by half a sine: positive slips (spins), negative slides, -1 locks the wheel.
    """

    start_s: float
    end_s: float
    ratio: float

    def __post_init__(self) -> None:
        require_interval(self)
        if not self.ratio >= -1.0:
            raise SettingsError(f"SlipInterval.ratio must be at least -1 (a locked wheel), got {self.ratio}")


@dataclass(frozen=True, kw_only=True)
class DrawnSlips:
    """Slips and slides that the seed decides.

    Attributes
    ----------
    slip_chance, slide_chance : float
        Of each acceleration and each braking of the run to have one.
    ratio : float
        Largest ratio, see `SlipInterval`; drawn evenly between a fifth of it and all.
    duration_s : float
        Longest; drawn evenly between a fifth of it and all, and never longer than the acceleration.
    """

    slip_chance: float = 0.0
    slide_chance: float = 0.0
    ratio: float = 0.3
    duration_s: float = 3.0

    def __post_init__(self) -> None:
        require_share(self, "slip_chance", "slide_chance", "ratio")
        require_positive(self, "duration_s")


@dataclass(frozen=True, kw_only=True)
class TachometerSettings:
    """Pulses of a wheel.

    Attributes
    ----------
    pulses_per_turn : int
    wheel_diameter_m : float
        As the vehicle's papers say.
    diameter_error_m : float
        True minus papers.
    resolution_s : float
        Of the pulses' times; 0: a nanosecond.
    jitter_s : float
        Standard deviation of a pulse's time.
    lowest_mps : float
        No pulses come below this speed of the wheel.
    slips : tuple of SlipInterval
        In order, apart from each other.
    drawn_slips : DrawnSlips
    """

    pulses_per_turn: int = 60
    wheel_diameter_m: float = 0.86
    diameter_error_m: float = 0.0
    resolution_s: float = 0.0
    jitter_s: float = 0.0
    lowest_mps: float = 0.0
    slips: tuple[SlipInterval, ...] = ()
    drawn_slips: DrawnSlips = field(default_factory=DrawnSlips)

    def __post_init__(self) -> None:
        require_positive(self, "pulses_per_turn", "wheel_diameter_m")
        require_not_negative(self, "resolution_s", "jitter_s", "lowest_mps")
        if not abs(self.diameter_error_m) < 0.5 * self.wheel_diameter_m:
            raise SettingsError(
                f"TachometerSettings.diameter_error_m must be small beside the diameter, got {self.diameter_error_m}"
            )
        for before, after in pairwise(self.slips):
            if after.start_s < before.end_s:
                raise SettingsError(
                    f"TachometerSettings.slips must be in order and apart, got one from {after.start_s} s "
                    f"after one to {before.end_s} s"
                )


@dataclass(frozen=True, kw_only=True)
class InertialSettings:
    """Three accelerometers and three gyroscopes fixed to the body: forward, right, down.

    Attributes
    ----------
    rate_hz : float
    along_m, across_m, up_m : float
        Place in the body, as the antennas'.
    accel_bias_mps2, gyro_bias_radps : (float, float, float)
        Constant.
    accel_drift_sigma_mps2, accel_drift_time_s : float
        Gauss-Markov part of each bias.
    gyro_drift_sigma_radps, gyro_drift_time_s : float
    gyro_drift_walk_radps_per_sqrt_s : float
        Random walk of each gyroscope's bias, from 0 at the start.
    velocity_walk_mps_per_sqrt_s, angle_walk_rad_per_sqrt_s : float
        White noise, as the random walk that its integral makes.
    accel_scale, gyro_scale : (float, float, float)
        Measured over true, less 1.
    misalignment_rad : (float, float, float)
        Small turns of the box about forward, right and down.
    accel_resolution_mps2, gyro_resolution_radps : float
        Step of the numbers; 0: none.
    """

    rate_hz: float = 100.0
    along_m: float = 0.0
    across_m: float = 0.0
    up_m: float = 1.0
    accel_bias_mps2: Three = (0.0, 0.0, 0.0)
    gyro_bias_radps: Three = (0.0, 0.0, 0.0)
    accel_drift_sigma_mps2: float = 0.0
    accel_drift_time_s: float = 1000.0
    gyro_drift_sigma_radps: float = 0.0
    gyro_drift_time_s: float = 1000.0
    gyro_drift_walk_radps_per_sqrt_s: float = 0.0
    velocity_walk_mps_per_sqrt_s: float = 0.0
    angle_walk_rad_per_sqrt_s: float = 0.0
    accel_scale: Three = (0.0, 0.0, 0.0)
    gyro_scale: Three = (0.0, 0.0, 0.0)
    misalignment_rad: Three = (0.0, 0.0, 0.0)
    accel_resolution_mps2: float = 0.0
    gyro_resolution_radps: float = 0.0

    def __post_init__(self) -> None:
        require_positive(self, "rate_hz", "accel_drift_time_s", "gyro_drift_time_s")
        require_finite(self, "along_m", "across_m", "up_m", "accel_bias_mps2", "gyro_bias_radps")
        require_finite(self, "accel_scale", "gyro_scale", "misalignment_rad")
        require_not_negative(
            self, "accel_drift_sigma_mps2", "gyro_drift_sigma_radps", "gyro_drift_walk_radps_per_sqrt_s",
            "velocity_walk_mps_per_sqrt_s", "angle_walk_rad_per_sqrt_s",
            "accel_resolution_mps2", "gyro_resolution_radps",
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Dropout:
    """A radar that sees nothing (snow on its antenna, P2 3.2).

    Attributes
    ----------
    start_s, end_s : float
        Seconds after the start of the run.
    """

    start_s: float
    end_s: float

    def __post_init__(self) -> None:
        require_interval(self)


@dataclass(frozen=True, kw_only=True)
class RadarSettings:
    """A Doppler radar that looks at the track (P2 3.1).

    Attributes
    ----------
    rate_hz : float
    bias_mps : float
    scale : float
        Measured over true, less 1: a mounting angle that is off.
    noise_sigma_mps : float
        White.
    sway_ratio_sigma, sway_time_s : float
        Gauss-Markov part of the scale: the body's pitching.
    lowest_mps, highest_mps : float
        Nothing is measured outside.
    dropouts : tuple of Dropout
    dropouts_per_hour, dropout_duration_s : float
        Drawn ones: mean number, mean duration (both exponential).
    """

    rate_hz: float = 10.0
    bias_mps: float = 0.0
    scale: float = 0.0
    noise_sigma_mps: float = 0.0
    sway_ratio_sigma: float = 0.0
    sway_time_s: float = 0.5
    lowest_mps: float = 0.0
    highest_mps: float = 200.0 / 3.6
    dropouts: tuple[Dropout, ...] = ()
    dropouts_per_hour: float = 0.0
    dropout_duration_s: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, "rate_hz", "sway_time_s", "highest_mps", "dropout_duration_s")
        require_finite(self, "bias_mps", "scale")
        require_not_negative(self, "noise_sigma_mps", "sway_ratio_sigma", "lowest_mps", "dropouts_per_hour")


@dataclass(frozen=True, kw_only=True)
class SensorSettings:
    """Sensors of the vehicle; None: it has none of that kind.

    Attributes
    ----------
    tachometer : TachometerSettings or None
    inertial : InertialSettings or None
    radar : RadarSettings or None
    """

    tachometer: TachometerSettings | None = field(default_factory=TachometerSettings)
    inertial: InertialSettings | None = field(default_factory=InertialSettings)
    radar: RadarSettings | None = field(default_factory=RadarSettings)

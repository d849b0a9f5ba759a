"""Settings of the vehicle's sensors besides its receivers; a sensor without given errors has none."""

from __future__ import annotations

from itertools import pairwise

from pydantic import Field, field_validator, model_validator

from railfix.simulate.setting_types import (
    Finite,
    Interval,
    NotNegative,
    Positive,
    ScenarioSettings,
    Share,
    Three,
)


class SlipInterval(Interval):
    """Slip or slide of the tachometer's wheel.

    Attributes
    ----------
    start_s, end_s : float
        Seconds after the start of the run.
    ratio : float
        Largest (wheel speed - train speed) / train speed, in the middle of the interval, from and to 0
        by half a sine: positive slips (spins), negative slides, -1 locks the wheel.
    """

    end_s: Finite
    ratio: float = Field(ge=-1.0, allow_inf_nan=False)


class DrawnSlips(ScenarioSettings):
    """Slips and slides drawn at random.

    Attributes
    ----------
    slip_chance, slide_chance : float
        Probability of a slip in each acceleration, of a slide in each braking of the run.
    ratio : float
        Largest ratio, see `SlipInterval`; uniform between a fifth of it and all.
    duration_s : float
        Longest; uniform between a fifth of it and all, and never longer than the acceleration.
    """

    slip_chance: Share = 0.0
    slide_chance: Share = 0.0
    ratio: Share = 0.3
    duration_s: Positive = 3.0


class TachometerSettings(ScenarioSettings):
    """Tachometer on one wheel.

    Attributes
    ----------
    pulses_per_turn : int
    wheel_diameter_m : float
        Nominal.
    diameter_error_m : float
        True minus nominal.
    resolution_s : float
        Of the pulses' times; 0: a nanosecond.
    jitter_s : float
        Standard deviation of a pulse's time.
    lowest_mps : float
        No pulses come below this speed of the wheel.
    tooth_sigma : float
        Standard deviation of each tooth's place as a share of the spacing of the teeth; the same every turn.
    lost_chance, doubled_chance : float
        Probability that a pulse is not seen, and that it is followed by a second one before the next tooth.
    slips : tuple of SlipInterval
        In order, without overlap.
    drawn_slips : DrawnSlips
    """

    pulses_per_turn: int = Field(default=60, gt=0)
    wheel_diameter_m: Positive = 0.86
    diameter_error_m: Finite = 0.0
    resolution_s: NotNegative = 0.0
    jitter_s: NotNegative = 0.0
    lowest_mps: NotNegative = 0.0
    tooth_sigma: float = Field(default=0.0, ge=0.0, le=0.2)
    lost_chance: Share = 0.0
    doubled_chance: Share = 0.0
    slips: tuple[SlipInterval, ...] = ()
    drawn_slips: DrawnSlips = DrawnSlips()

    @field_validator("slips")
    @classmethod
    def _in_order(cls, slips: tuple[SlipInterval, ...]) -> tuple[SlipInterval, ...]:
        for before, after in pairwise(slips):
            if after.start_s < before.end_s:
                raise ValueError(f"must be in order; one from {after.start_s} s follows one to {before.end_s} s")
        return slips

    @model_validator(mode="after")
    def _small_error(self) -> TachometerSettings:
        if not abs(self.diameter_error_m) < 0.5 * self.wheel_diameter_m:
            raise ValueError(f"diameter_error_m must be small beside the diameter, got {self.diameter_error_m}")
        return self


class InertialSettings(ScenarioSettings):
    """Three accelerometers and three gyroscopes fixed to the body: forward, right, down.

    Attributes
    ----------
    rate_hz : float
    along_m, across_m, up_m : float
        Position in the body, as the antennas'.
    accel_bias_mps2, gyro_bias_radps : (float, float, float)
        Constant.
    accel_drift_sigma_mps2, accel_drift_time_s : float
        Gauss-Markov part of each bias.
    gyro_drift_sigma_radps, gyro_drift_time_s : float
    gyro_drift_walk_radps_per_sqrt_s : float
        Random walk of each gyroscope's bias, from 0 at the start.
    velocity_walk_mps_per_sqrt_s, angle_walk_rad_per_sqrt_s : float
        White noise, as the random walk of its integral.
    accel_scale, gyro_scale : (float, float, float)
        Scale errors: measured over true, less 1.
    misalignment_rad : (float, float, float)
        Small rotations of the unit about forward, right and down.
    accel_resolution_mps2, gyro_resolution_radps : float
        Quantisation step; 0: none.
    vibration_sigma_mps2, vibration_sigma_radps : float
        Vibration of the body at 20 m/s and more, of each axis, in proportion to the speed below that.
    vibration_hz : float
        Its mean frequency; the relative bandwidth is 15 percent. Frequencies above half of `rate_hz` are aliased.
    """

    rate_hz: Positive = 100.0
    along_m: Finite = 0.0
    across_m: Finite = 0.0
    up_m: Finite = 1.0
    accel_bias_mps2: Three = (0.0, 0.0, 0.0)
    gyro_bias_radps: Three = (0.0, 0.0, 0.0)
    accel_drift_sigma_mps2: NotNegative = 0.0
    accel_drift_time_s: Positive = 1000.0
    gyro_drift_sigma_radps: NotNegative = 0.0
    gyro_drift_time_s: Positive = 1000.0
    gyro_drift_walk_radps_per_sqrt_s: NotNegative = 0.0
    velocity_walk_mps_per_sqrt_s: NotNegative = 0.0
    angle_walk_rad_per_sqrt_s: NotNegative = 0.0
    accel_scale: Three = (0.0, 0.0, 0.0)
    gyro_scale: Three = (0.0, 0.0, 0.0)
    misalignment_rad: Three = (0.0, 0.0, 0.0)
    accel_resolution_mps2: NotNegative = 0.0
    gyro_resolution_radps: NotNegative = 0.0
    vibration_sigma_mps2: NotNegative = 0.0
    vibration_sigma_radps: NotNegative = 0.0
    vibration_hz: Positive = 12.0


class Dropout(Interval):
    """Interval in which the radar measures nothing (snow on its antenna, P2 3.2).

    Attributes
    ----------
    start_s, end_s : float
        Seconds after the start of the run.
    """

    end_s: Finite


class RadarSettings(ScenarioSettings):
    """Doppler radar that looks at the track (P2 3.1).

    Attributes
    ----------
    rate_hz : float
    bias_mps : float
    scale : float
        Measured over true, less 1: an error of the mounting angle.
    noise_sigma_mps : float
        White.
    sway_ratio_sigma, sway_time_s : float
        Gauss-Markov part of the scale, as pitching of the body causes.
    lowest_mps, highest_mps : float
        Range of speeds that are measured.
    dropouts : tuple of Dropout
    dropouts_per_hour, dropout_duration_s : float
        Drawn dropouts: mean number, mean duration (both exponential).
    """

    rate_hz: Positive = 10.0
    bias_mps: Finite = 0.0
    scale: Finite = 0.0
    noise_sigma_mps: NotNegative = 0.0
    sway_ratio_sigma: NotNegative = 0.0
    sway_time_s: Positive = 0.5
    lowest_mps: NotNegative = 0.0
    highest_mps: Positive = 200.0 / 3.6
    dropouts: tuple[Dropout, ...] = ()
    dropouts_per_hour: NotNegative = 0.0
    dropout_duration_s: Positive = 5.0


class GroundUnit(ScenarioSettings):
    """Ranging unit beside the track.

    Attributes
    ----------
    name : str
    chainage_m, lateral_m, height_m : float
        Position: along the line, to the right of the track's axis, above the rails.
    delay_bias_m : float
        Error of the constant answering delay, as range.
    """

    name: str = Field(min_length=1)
    chainage_m: Finite
    lateral_m: Finite = 3.0
    height_m: Finite = 3.0
    delay_bias_m: Finite = 0.0


class RangingSettings(ScenarioSettings):
    """Two-way ranging to units beside the track (P2, table 3: every 200 ms, about 100 m; 3.3: sigma 0.19 to 0.24 m).

    Attributes
    ----------
    units : tuple of GroundUnit
    interval_s : float
    reach_m : float
        Largest range that is measured.
    along_m, across_m, up_m : float
        Position of the vehicle's unit, as the antennas'.
    noise_sigma_m : float
        White in time.
    multipath_sigma_m, multipath_cell_m : float
        Error that depends on the position alone, independent from cell to cell of this length along the line.
    echo_chance, echo_delay_m : float
        Share of the cells where an echo hides the direct path, and the mean of its exponential excess.
    lost_chance : float
        Probability that an answer is lost.
    """

    units: tuple[GroundUnit, ...] = ()
    interval_s: Positive = 0.2
    reach_m: Positive = 100.0
    along_m: Finite = 9.0
    across_m: Finite = 0.0
    up_m: Finite = 3.0
    noise_sigma_m: NotNegative = 0.0
    multipath_sigma_m: NotNegative = 0.0
    multipath_cell_m: Positive = 0.25
    echo_chance: Share = 0.0
    echo_delay_m: NotNegative = 0.8
    lost_chance: Share = 0.0

    @field_validator("units")
    @classmethod
    def _names_differ(cls, units: tuple[GroundUnit, ...]) -> tuple[GroundUnit, ...]:
        names = [unit.name for unit in units]
        if len(set(names)) < len(names):
            raise ValueError(f"must have different names; they are {names}")
        return units


class Balise(ScenarioSettings):
    """Balise in the track.

    Attributes
    ----------
    name : str
        Identity.
    chainage_m : float
    """

    name: str = Field(min_length=1)
    chainage_m: Finite


class BaliseSettings(ScenarioSettings):
    """Balises and their reader on the vehicle.

    Attributes
    ----------
    balises : tuple of Balise
    spacing_m : float
        Others are so far apart from each other and the beginning of the line, named B001 and on; 0 for none.
    along_m : float
        Place of the reader along the body, as the antennas'.
    noise_sigma_m : float
        Error of a reading along the line.
    missed : tuple of str
        Balises that are not read.
    wrong : mapping of str to str
        Balises that are read with another identity.
    missed_chance, wrong_chance : float
        The same by chance, the identity being that of another balise.
    """

    balises: tuple[Balise, ...] = ()
    spacing_m: NotNegative = 0.0
    along_m: Finite = 0.0
    noise_sigma_m: NotNegative = 0.0
    missed: tuple[str, ...] = ()
    wrong: dict[str, str] = Field(default_factory=dict)
    missed_chance: Share = 0.0
    wrong_chance: Share = 0.0


class SensorSettings(ScenarioSettings):
    """Sensors of the vehicle; None: no sensor of that kind.

    Attributes
    ----------
    tachometer : TachometerSettings or None
    inertial : InertialSettings or None
    radar : RadarSettings or None
    ranging : RangingSettings or None
    balises : BaliseSettings or None
    """

    tachometer: TachometerSettings | None = TachometerSettings()
    inertial: InertialSettings | None = InertialSettings()
    radar: RadarSettings | None = RadarSettings()
    ranging: RangingSettings | None = None
    balises: BaliseSettings | None = None

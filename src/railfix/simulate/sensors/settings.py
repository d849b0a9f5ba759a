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
    """Slip or slide of the tachometer's wheel."""

    end_s: Finite
    #: Largest (wheel speed - train speed) / train speed, in the middle of the interval, from and to 0 by half a sine:
    #: positive slips (spins), negative slides, -1 locks the wheel.
    ratio: float = Field(ge=-1.0, allow_inf_nan=False)


class DrawnSlips(ScenarioSettings):
    """Slips and slides drawn at random."""

    #: Probability of a slip in each acceleration, of a slide in each braking of the run.
    slip_chance: Share = 0.0
    slide_chance: Share = 0.0
    ratio: Share = 0.3  #: Largest ratio, see `SlipInterval`; uniform between a fifth of it and all.
    #: Longest; uniform between a fifth of it and all, and never longer than the acceleration.
    duration_s: Positive = 3.0


class TachometerSettings(ScenarioSettings):
    """Tachometer on one wheel."""

    pulses_per_turn: int = Field(default=60, gt=0)
    wheel_diameter_m: Positive = 0.86  #: Nominal.
    diameter_error_m: Finite = 0.0  #: True minus nominal.
    resolution_s: NotNegative = 0.0  #: Of the pulses' times; 0: a nanosecond.
    jitter_s: NotNegative = 0.0  #: Standard deviation of a pulse's time.
    lowest_mps: NotNegative = 0.0  #: No pulses come below this speed of the wheel.
    #: Standard deviation of each tooth's place as a share of the spacing of the teeth; the same every turn.
    tooth_sigma: float = Field(default=0.0, ge=0.0, le=0.2)
    #: Probability that a pulse is not seen, and that it is followed by a second one before the next tooth.
    lost_chance: Share = 0.0
    doubled_chance: Share = 0.0
    slips: tuple[SlipInterval, ...] = ()  #: In order, without overlap.
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
    """Three accelerometers and three gyroscopes fixed to the body: forward, right, down."""

    rate_hz: Positive = 100.0
    #: Position in the body, as the antennas'.
    along_m: Finite = 0.0
    across_m: Finite = 0.0
    up_m: Finite = 1.0
    #: Constant.
    accel_bias_mps2: Three = (0.0, 0.0, 0.0)
    gyro_bias_radps: Three = (0.0, 0.0, 0.0)
    #: Gauss-Markov part of each bias.
    accel_drift_sigma_mps2: NotNegative = 0.0
    accel_drift_time_s: Positive = 1000.0

    gyro_drift_sigma_radps: NotNegative = 0.0
    gyro_drift_time_s: Positive = 1000.0
    gyro_drift_walk_radps_per_sqrt_s: NotNegative = 0.0  #: Random walk of each gyroscope's bias, from 0 at the start.
    #: White noise, as the random walk of its integral.
    velocity_walk_mps_per_sqrt_s: NotNegative = 0.0
    angle_walk_rad_per_sqrt_s: NotNegative = 0.0
    #: Scale errors: measured over true, less 1.
    accel_scale: Three = (0.0, 0.0, 0.0)
    gyro_scale: Three = (0.0, 0.0, 0.0)
    misalignment_rad: Three = (0.0, 0.0, 0.0)  #: Small rotations of the unit about forward, right and down.
    #: Quantisation step; 0: none.
    accel_resolution_mps2: NotNegative = 0.0
    gyro_resolution_radps: NotNegative = 0.0
    #: Vibration of the body at 20 m/s and more, of each axis, in proportion to the speed below that.
    vibration_sigma_mps2: NotNegative = 0.0
    vibration_sigma_radps: NotNegative = 0.0
    #: Its mean frequency; the relative bandwidth is 15 percent. Frequencies above half of `rate_hz` are aliased.
    vibration_hz: Positive = 12.0


class Dropout(Interval):
    """Interval in which the radar measures nothing (snow on its antenna, P2 3.2)."""

    end_s: Finite


class RadarSettings(ScenarioSettings):
    """Doppler radar that looks at the track (P2 3.1)."""

    rate_hz: Positive = 10.0
    bias_mps: Finite = 0.0
    scale: Finite = 0.0  #: Measured over true, less 1: an error of the mounting angle.
    noise_sigma_mps: NotNegative = 0.0  #: White.
    #: Gauss-Markov part of the scale, as pitching of the body causes.
    sway_ratio_sigma: NotNegative = 0.0
    sway_time_s: Positive = 0.5
    #: Range of speeds that are measured.
    lowest_mps: NotNegative = 0.0
    highest_mps: Positive = 200.0 / 3.6

    dropouts: tuple[Dropout, ...] = ()
    #: Drawn dropouts: mean number, mean duration (both exponential).
    dropouts_per_hour: NotNegative = 0.0
    dropout_duration_s: Positive = 5.0


class GroundUnit(ScenarioSettings):
    """Ranging unit beside the track."""

    name: str = Field(min_length=1)
    #: Position: along the line, to the right of the track's axis, above the rails.
    chainage_m: Finite
    lateral_m: Finite = 3.0
    height_m: Finite = 3.0
    delay_bias_m: Finite = 0.0  #: Error of the constant answering delay, as range.


class RangingSettings(ScenarioSettings):
    """Two-way ranging to units beside the track (P2, table 3: every 200 ms, about 100 m; 3.3: sigma 0.19 to 0.24 m)."""

    units: tuple[GroundUnit, ...] = ()
    interval_s: Positive = 0.2
    reach_m: Positive = 100.0  #: Largest range that is measured.
    #: Position of the vehicle's unit, as the antennas'.
    along_m: Finite = 9.0
    across_m: Finite = 0.0
    up_m: Finite = 3.0
    noise_sigma_m: NotNegative = 0.0  #: White in time.
    #: Error that depends on the position alone, independent from cell to cell of this length along the line.
    multipath_sigma_m: NotNegative = 0.0
    multipath_cell_m: Positive = 0.25
    #: Share of the cells where an echo hides the direct path, and the mean of its exponential excess.
    echo_chance: Share = 0.0
    echo_delay_m: NotNegative = 0.8
    lost_chance: Share = 0.0  #: Probability that an answer is lost.

    @field_validator("units")
    @classmethod
    def _names_differ(cls, units: tuple[GroundUnit, ...]) -> tuple[GroundUnit, ...]:
        names = [unit.name for unit in units]
        if len(set(names)) < len(names):
            raise ValueError(f"must have different names; they are {names}")
        return units


class Balise(ScenarioSettings):
    """Balise in the track."""

    name: str = Field(min_length=1)  #: Identity.
    chainage_m: Finite


class BaliseSettings(ScenarioSettings):
    """Balises and their reader on the vehicle."""

    balises: tuple[Balise, ...] = ()
    #: Others are so far apart from each other and the beginning of the line, named B001 and on; 0 for none.
    spacing_m: NotNegative = 0.0
    along_m: Finite = 0.0  #: Place of the reader along the body, as the antennas'.
    noise_sigma_m: NotNegative = 0.0  #: Error of a reading along the line.
    missed: tuple[str, ...] = ()  #: Balises that are not read.
    wrong: dict[str, str] = Field(default_factory=dict)  #: Balises that are read with another identity.
    #: The same by chance, the identity being that of another balise.
    missed_chance: Share = 0.0
    wrong_chance: Share = 0.0


class SensorSettings(ScenarioSettings):
    """Sensors of the vehicle; None: no sensor of that kind."""

    tachometer: TachometerSettings | None = TachometerSettings()
    inertial: InertialSettings | None = InertialSettings()
    radar: RadarSettings | None = RadarSettings()
    ranging: RangingSettings | None = None
    balises: BaliseSettings | None = None

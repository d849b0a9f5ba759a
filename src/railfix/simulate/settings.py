"""Settings of the simulated errors, sensors and SBAS, and common types of settings; no errors by default."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from itertools import pairwise
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    field_validator,
    model_validator,
)

from railfix.core.settings import Settings
from railfix.core.timescale import gps_time

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]  #: A probability or a fraction.
#: Three components along the axes of the body.
Three = tuple[Finite, Finite, Finite]
Seed = Annotated[int, Field(ge=0)]
SYSTEMS = "GJEC"  #: Letters of the constellations that are simulated.


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] <= pair[1]:
        raise ValueError("must be two numbers, the smaller number first")
    return pair


def beyond_start(to_m: float, info: ValidationInfo) -> float:
    """Return the end of a part of the line.

    Raise ValueError if the end is not beyond the start `from_m`.
    """
    if to_m <= info.data.get("from_m", -np.inf):
        raise ValueError(f"must lie beyond from_m of {info.data['from_m']}")
    return to_m


def at_least(least: float) -> AfterValidator:
    """Return a validator of a pair of lengths, of which the smaller must be at least `least` [m]."""

    def check(pair: tuple[float, float]) -> tuple[float, float]:
        if pair[0] < least:
            raise ValueError(f"the smaller number must be at least {least:g} m")
        return pair

    return AfterValidator(check)


#: Lower and upper limit of a uniform distribution.
Between = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_rising)]
AngleBetween = Annotated[tuple[Finite, Finite], AfterValidator(_rising)]


def _gps_time(value: Any) -> np.datetime64:
    """Return the GPS time that a TOML time, a string or a datetime64 represents.

    Raise ValueError for other values.
    """
    with suppress(ValueError):
        if isinstance(value, str | datetime | np.datetime64) and not np.isnat(time := gps_time(value)):
            return time
    raise ValueError("must be a time such as 2024-03-05T03:10:00, in GPS time without a zone")


def _toml_time(time: np.datetime64) -> datetime | str:
    """Return a time as a TOML time if it is a whole number of microseconds, otherwise as text."""
    rounded = datetime.fromisoformat(str(time.astype("datetime64[us]")))
    return rounded if np.datetime64(rounded) == time else str(time)


#: GPS time to the nanosecond.
GpsTime = Annotated[np.datetime64, PlainValidator(_gps_time), PlainSerializer(_toml_time)]


class ScenarioSettings(Settings):
    """Base of the settings of the simulator, in which the word "none" represents None, because TOML has no None."""

    @model_validator(mode="before")
    @classmethod
    def _none(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        optional = {name for name, field in cls.model_fields.items() if type(None) in get_args(field.annotation)}
        return {key: None if key in optional and value == "none" else value for key, value in values.items()}


class Interval(ScenarioSettings):
    """Time interval within a run."""

    start_s: Finite  #: Start of the interval, as time after the start of the run.
    #: End of the interval, as time after the start of the run; None for the end of the run.
    end_s: Annotated[float, Field(allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _forward(self) -> Interval:
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s must be after start_s, got start_s = {self.start_s}, end_s = {self.end_s}")
        return self


System = Annotated[str, Field(pattern=f"^[{SYSTEMS}]$")]  #: Letter of a constellation.


class SatelliteErrorSettings(ScenarioSettings):
    """Standard deviations and correlation times of broadcast errors, independent for each satellite."""

    clock_sigma_m: NotNegative = 0.0  #: Standard deviation of the Gauss-Markov clock error, in metres of range.
    clock_time_s: Positive = 3600.0  #: Correlation time of the clock error.
    #: Standard deviation of the Gauss-Markov radial orbit error, true minus broadcast.
    radial_sigma_m: NotNegative = 0.0
    along_sigma_m: NotNegative = 0.0  #: Standard deviation of the Gauss-Markov along-track orbit error.
    cross_sigma_m: NotNegative = 0.0  #: Standard deviation of the Gauss-Markov cross-track orbit error.
    orbit_time_s: Positive = 7200.0  #: Correlation time of the orbit errors.
    #: Standard deviation of the group-delay errors, constants of each satellite and signal that affect only codes.
    group_delay_sigma_m: NotNegative = 0.0


class IonosphereErrorSettings(ScenarioSettings):
    """Ionospheric delay on L1 in addition to `SkySettings.ionosphere_scale` times the model delay."""

    #: Standard deviation of the Gauss-Markov vertical L1 delay, added to the model, at the first point of the line.
    vertical_sigma_m: NotNegative = 0.0
    vertical_time_s: Positive = 1800.0  #: Correlation time of the added vertical delay.
    #: Increase of the vertical delay per distance between the pierce point and the first point of the line.
    gradient_mm_per_km: NotNegative = 0.0
    gradient_azimuth_deg: Finite = 0.0  #: Azimuth in which the vertical delay increases.


class TroposphereErrorSettings(ScenarioSettings):
    """Tropospheric delay in addition to `SkySettings.troposphere_scale` times the model delay."""

    zenith_sigma_m: NotNegative = 0.0  #: Standard deviation of the added zenith delay; Gauss-Markov process.
    zenith_time_s: Positive = 7200.0  #: Correlation time of the added zenith delay.


class SatelliteFault(Interval):
    """Range error of a satellite in a time interval, without a warning in its navigation message."""

    satellite: str = Field(pattern=f"^[{SYSTEMS}][0-9]{{2}}$")  #: Name of the satellite, such as "G07".
    step_m: Finite = 0.0  #: Error of code and phase at the start of the interval.
    ramp_mps: Finite = 0.0  #: Rate at which the error changes after the start of the interval.


class ClockWalkSettings(ScenarioSettings):
    """Random walks of a receiver clock in addition to its constant drift, in metres of range."""

    walk_m_per_sqrt_s: NotNegative = 0.0  #: Standard deviation, after one second, of the random walk of the bias.
    #: Standard deviation, after one second, of the random walk of the drift.
    frequency_walk_mps_per_sqrt_s: NotNegative = 0.0


class InterSystemSettings(ScenarioSettings):
    """Inter-system bias of the receivers for one constellation, in code, phase and Doppler."""

    offset_m: Finite = 0.0  #: Inter-system bias at the start of the run.
    drift_mps: Finite = 0.0  #: Drift of the inter-system bias.
    #: Bias of the rear minus bias of the front receiver, whether their clocks are common or separate.
    rear_difference_m: Finite = 0.0


class NoiseSettings(ScenarioSettings):
    """Time-correlated receiver noise; the standard deviations are in `ReceiverSettings`."""

    code_correlated_share: Share = 0.0  #: Time-correlated fraction of the code noise variance.
    #: Correlation time of the correlated code noise: 1 / (4 B) for a code loop of noise bandwidth B, 1 s for 0.25 Hz.
    code_correlation_time_s: Positive = 1.0
    #: Standard deviation of the Gauss-Markov variation of C/N0, independent for each channel.
    cn0_wander_sigma_db: NotNegative = 0.0
    cn0_wander_time_s: Positive = 10.0  #: Correlation time of the C/N0 variation.
    #: Observables whose noise depends on C/N0: only codes, or also phase and Doppler. If C/N0 is 20 dB lower, the noise
    #: of these observables is 10 times as large; the sigmas of `ReceiverSettings` refer to 45 dB-Hz.
    weak_signals: Literal["code", "all"] = "code"


class TrackingSettings(ScenarioSettings):
    """Loss of lock and re-acquisition."""

    threshold_dbhz: NotNegative | None = None  #: A signal with a lower C/N0 is lost; None for no limit.
    #: A signal that was lost because of its C/N0 is trackable again from this C/N0 on; None means `threshold_dbhz`.
    reacquisition_dbhz: NotNegative | None = None
    reacquisition_s: NotNegative = 0.0  #: A lost signal remains absent for this time after it is trackable again.
    #: With "after_loss", the phase changes by a random number of whole cycles at each loss of lock, and bit 0 of the
    #: loss-of-lock indicator is set at the first epoch after the loss.
    slips: Literal["none", "after_loss"] = "none"


class ErrorSettings(ScenarioSettings):
    """Satellite, atmospheric and receiver errors; none by default."""

    #: Satellite errors by the letter of the constellation.
    satellites: dict[System, SatelliteErrorSettings] = Field(default_factory=dict)

    ionosphere: IonosphereErrorSettings = IonosphereErrorSettings()
    troposphere: TroposphereErrorSettings = TroposphereErrorSettings()
    faults: tuple[SatelliteFault, ...] = ()
    #: Random walks of the receiver clocks; the antennas share one walk if `ReceiverSettings.clocks` is "common".
    clock: ClockWalkSettings = ClockWalkSettings()
    #: Inter-system biases by the letter of the constellation.
    intersystem: dict[System, InterSystemSettings] = Field(default_factory=dict)
    noise: NoiseSettings = NoiseSettings()
    tracking: TrackingSettings = TrackingSettings()


class SlipInterval(Interval):
    """Slip or slide of the tachometer wheel."""

    end_s: Finite
    #: (Wheel speed - train speed) / train speed in the middle of the interval, positive for a slip, negative for a
    #: slide, -1 for a locked wheel. Over the interval, the ratio follows half a sine wave.
    ratio: float = Field(ge=-1.0, allow_inf_nan=False)


class DrawnSlips(ScenarioSettings):
    """Slips and slides drawn at random."""

    slip_chance: Share = 0.0  #: Probability of a slip in each acceleration phase of the run.
    slide_chance: Share = 0.0  #: Probability of a slide in each braking phase of the run.
    #: Largest magnitude of the ratio of `SlipInterval`; ratios are uniformly distributed between a fifth of this value
    #: and the full value.
    ratio: Share = 0.3
    #: Largest duration; durations are uniformly distributed between a fifth of this value and the full value, and at
    #: most the duration of the phase.
    duration_s: Positive = 3.0


class TachometerSettings(ScenarioSettings):
    """Tachometer on one wheel."""

    pulses_per_turn: int = Field(default=60, gt=0)
    wheel_diameter_m: Positive = 0.86  #: Nominal wheel diameter.
    diameter_error_m: Finite = 0.0  #: True minus nominal wheel diameter.
    resolution_s: NotNegative = 0.0  #: Resolution of the pulse times; 0 for one nanosecond.
    jitter_s: NotNegative = 0.0  #: Standard deviation of the white noise of the pulse times.
    lowest_mps: NotNegative = 0.0  #: Below this wheel speed, no pulses are sent.
    #: Standard deviation of the position errors of the teeth, which repeat every turn, as a fraction of tooth spacing.
    tooth_sigma: float = Field(default=0.0, ge=0.0, le=0.2)
    lost_chance: Share = 0.0  #: Probability that a pulse is not detected.
    doubled_chance: Share = 0.0  #: Probability that a pulse is followed by a second pulse before the next tooth.
    slips: tuple[SlipInterval, ...] = ()  #: Specified slips and slides, in order of time.
    drawn_slips: DrawnSlips = DrawnSlips()

    @field_validator("slips")
    @classmethod
    def _in_order(cls, slips: tuple[SlipInterval, ...]) -> tuple[SlipInterval, ...]:
        for before, after in pairwise(slips):
            if after.start_s < before.end_s:
                raise ValueError(f"must not overlap: slip from {after.start_s} s, previous slip to {before.end_s} s")
        return slips

    @model_validator(mode="after")
    def _small_error(self) -> TachometerSettings:
        if not abs(self.diameter_error_m) < 0.5 * self.wheel_diameter_m:
            raise ValueError(f"diameter_error_m must be less than half the diameter, got {self.diameter_error_m}")
        return self


class InertialSettings(ScenarioSettings):
    """Three accelerometers and three gyroscopes fixed to the body, with the axes forward, right and down."""

    rate_hz: Positive = 100.0  #: Sampling rate.
    along_m: Finite = 0.0  #: Position of the unit in the body along the forward axis, as for the antennas.
    across_m: Finite = 0.0  #: Position of the unit in the body to the right.
    up_m: Finite = 1.0  #: Height of the unit above the rail tops.
    accel_bias_mps2: Three = (0.0, 0.0, 0.0)  #: Constant biases of the accelerometers.
    gyro_bias_radps: Three = (0.0, 0.0, 0.0)  #: Constant biases of the gyroscopes.
    #: Standard deviation of the Gauss-Markov part of each accelerometer bias.
    accel_drift_sigma_mps2: NotNegative = 0.0
    accel_drift_time_s: Positive = 1000.0  #: Correlation time of the Gauss-Markov accelerometer biases.
    #: Standard deviation of the Gauss-Markov part of each gyroscope bias.
    gyro_drift_sigma_radps: NotNegative = 0.0
    gyro_drift_time_s: Positive = 1000.0  #: Correlation time of the Gauss-Markov gyroscope biases.
    #: Standard deviation, after one second, of the random walk of each gyroscope bias; the walk begins at 0.
    gyro_drift_walk_radps_per_sqrt_s: NotNegative = 0.0
    velocity_walk_mps_per_sqrt_s: NotNegative = 0.0  #: White noise of the accelerometers, as velocity random walk.
    angle_walk_rad_per_sqrt_s: NotNegative = 0.0  #: White noise of the gyroscopes, as angle random walk.
    accel_scale: Three = (0.0, 0.0, 0.0)  #: Scale-factor errors of the accelerometers, measured / true - 1.
    gyro_scale: Three = (0.0, 0.0, 0.0)  #: Scale-factor errors of the gyroscopes, measured / true - 1.
    misalignment_rad: Three = (0.0, 0.0, 0.0)  #: Rotation of the unit relative to the body, as a rotation vector.
    accel_resolution_mps2: NotNegative = 0.0  #: Quantisation step of the accelerometers; 0 for no quantisation.
    gyro_resolution_radps: NotNegative = 0.0  #: Quantisation step of the gyroscopes; 0 for no quantisation.
    #: Standard deviation of the vibration on each accelerometer axis at 20 m/s and more; at lower speeds, it is
    #: proportional to the speed.
    vibration_sigma_mps2: NotNegative = 0.0
    #: Standard deviation of the vibration on each gyroscope axis at 20 m/s and more; at lower speeds, it is
    #: proportional to the speed.
    vibration_sigma_radps: NotNegative = 0.0
    #: Mean frequency of the vibration, with a relative bandwidth of 15 %. Frequencies above half of `rate_hz` are
    #: aliased.
    vibration_hz: Positive = 12.0


class Dropout(Interval):
    """Interval without radar measurements, for example due to snow on the antenna (P2, section 3.2)."""

    end_s: Finite


class RadarSettings(ScenarioSettings):
    """Doppler radar directed at the track (P2, section 3.1)."""

    rate_hz: Positive = 10.0
    bias_mps: Finite = 0.0
    scale: Finite = 0.0  #: Scale-factor error, measured / true - 1, for example due to the mounting angle.
    noise_sigma_mps: NotNegative = 0.0  #: Standard deviation of the white noise.
    #: Standard deviation of the Gauss-Markov part of the scale-factor error; this part is due to pitching of the body.
    sway_ratio_sigma: NotNegative = 0.0
    sway_time_s: Positive = 0.5  #: Correlation time of the Gauss-Markov part of the error.
    lowest_mps: NotNegative = 0.0  #: Lower speeds are not measured.
    highest_mps: Positive = 200.0 / 3.6  #: Higher speeds are not measured.

    dropouts: tuple[Dropout, ...] = ()  #: Specified dropouts.
    dropouts_per_hour: NotNegative = 0.0  #: Mean number of random dropouts; the time between them is exponential.
    dropout_duration_s: Positive = 5.0  #: Mean of the exponentially distributed durations of random dropouts.


class GroundUnit(ScenarioSettings):
    """Ranging unit near the track."""

    name: str = Field(min_length=1)
    chainage_m: Finite
    lateral_m: Finite = 3.0  #: Distance of the unit to the right of the track axis.
    height_m: Finite = 3.0  #: Height of the unit above the rails.
    delay_bias_m: Finite = 0.0  #: Range error caused by an error of the constant response delay.


class RangingSettings(ScenarioSettings):
    """Two-way ranging to units near the track (P2, table 3: 5 Hz, about 100 m; section 3.3: sigma 0.19 to 0.24 m)."""

    units: tuple[GroundUnit, ...] = ()
    interval_s: Positive = 0.2
    reach_m: Positive = 100.0  #: Longer ranges are not measured.
    along_m: Finite = 9.0  #: Position of the vehicle's unit along the forward axis, as for the antennas.
    across_m: Finite = 0.0  #: Position of the vehicle's unit to the right.
    up_m: Finite = 3.0  #: Height of the vehicle's unit above the rail tops.
    noise_sigma_m: NotNegative = 0.0  #: Standard deviation of the white noise.
    #: Standard deviation of the multipath error: constant in a cell along the line, independent between cells.
    multipath_sigma_m: NotNegative = 0.0
    multipath_cell_m: Positive = 0.25  #: Length of a cell along the line.
    echo_chance: Share = 0.0  #: Fraction of the cells in which an echo is measured instead of the direct path.
    echo_delay_m: NotNegative = 0.8  #: Mean of the exponentially distributed excess path of an echo.
    lost_chance: Share = 0.0  #: Probability that a ground unit's response is lost.

    @field_validator("units")
    @classmethod
    def _names_differ(cls, units: tuple[GroundUnit, ...]) -> tuple[GroundUnit, ...]:
        names = [unit.name for unit in units]
        if len(set(names)) < len(names):
            raise ValueError(f"must have different names; they are {names}")
        return units


class Balise(ScenarioSettings):
    """Balise in the track."""

    name: str = Field(min_length=1)  #: Identity of the balise.
    chainage_m: Finite


class BaliseSettings(ScenarioSettings):
    """Balises and their reader on the vehicle."""

    balises: tuple[Balise, ...] = ()
    #: Spacing of additional balises along the line, named B001, B002 and so on; 0 for no additional balises.
    spacing_m: NotNegative = 0.0
    along_m: Finite = 0.0  #: Position of the reader in the body along the forward axis, as for the antennas.
    noise_sigma_m: NotNegative = 0.0  #: Standard deviation of the position error of a reading along the line.
    missed: tuple[str, ...] = ()  #: Names of balises that are not read.
    wrong: dict[str, str] = Field(default_factory=dict)  #: For a balise name, the wrong identity that is read.
    missed_chance: Share = 0.0  #: Probability that a balise is never read.
    wrong_chance: Share = 0.0  #: Probability that a balise is always read with the identity of another balise.


class SensorSettings(ScenarioSettings):
    """On-board sensors; None means that the vehicle lacks the sensor."""

    tachometer: TachometerSettings | None = TachometerSettings()
    inertial: InertialSettings | None = InertialSettings()
    radar: RadarSettings | None = RadarSettings()
    ranging: RangingSettings | None = None
    balises: BaliseSettings | None = None


class SbasSettings(ScenarioSettings):
    """SBAS that corrects GPS and the ionosphere on L1, or ionosphere-free codes of GPS, Galileo and BeiDou on L5."""

    band: Literal["L1", "L5"] = "L1"  #: L5 requires receivers with ``signals_per_satellite = 2, second = "L5"``.
    prn: Annotated[int, Field(ge=120, le=158)] = 137
    latency_s: NotNegative = 4.0  #: Time from the instant to which a correction refers to the first bit of its message.
    udrei: Annotated[int, Field(ge=0, le=13)] = 5  #: With band L1, UDREI that is sent for all satellites.
    givei: Annotated[int, Field(ge=0, le=14)] = 9  #: GIVEI that is sent for all grid points.
    dfrei: Annotated[int, Field(ge=0, le=14)] = 5  #: With band L5, DFREI that is sent for all satellites.
    clock_sigma_m: NotNegative = 0.0  #: Standard deviation of the white error of each clock correction.
    orbit_sigma_m: NotNegative = 0.0  #: Standard deviation of the white error of each axis of an orbit correction.
    delay_sigma_m: NotNegative = 0.0  #: Standard deviation of the white error of each grid delay.
    #: The mask has the grid points whose latitude and longitude differ from the start of the line by at most this.
    grid_radius_deg: Positive = 25.0
    alert_m: Positive = 10.0  #: A satellite with a larger range error due to a fault is set to "do not use".
    alert_s: NotNegative = 6.0  #: Time from a range error above `alert_m` to the first "do not use".
    lost_chance: Share = 0.0  #: Probability that a message is not received.
    #: The messages begin this time before the run, so that all corrections are available when the run starts.
    lead_s: NotNegative = 300.0

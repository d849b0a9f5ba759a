"""Settings of the simulator's errors and sensors, none by default, and common types of settings."""

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
#: Three components, forward, right and down.
Three = tuple[Finite, Finite, Finite]
Seed = Annotated[int, Field(ge=0)]
SYSTEMS = "GJEC"  #: Letters of the constellations that are simulated.


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] <= pair[1]:
        raise ValueError("must be two numbers, the smaller one first")
    return pair


def beyond_start(to_m: float, info: ValidationInfo) -> float:
    """Validate the end of a part of the line, whose start is `from_m`."""
    if to_m <= info.data.get("from_m", -np.inf):
        raise ValueError(f"must lie beyond from_m of {info.data['from_m']}")
    return to_m


def at_least(least: float) -> AfterValidator:
    """Return the validator of a range of lengths that must begin at this length [m]."""

    def check(pair: tuple[float, float]) -> tuple[float, float]:
        if pair[0] < least:
            raise ValueError(f"must begin at {least:g} m or more")
        return pair

    return AfterValidator(check)


#: Least and greatest value of a uniform distribution.
Between = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_rising)]
AngleBetween = Annotated[tuple[Finite, Finite], AfterValidator(_rising)]


def _gps_time(value: Any) -> np.datetime64:
    """Return the GPS time of a TOML time, a text or a datetime64."""
    with suppress(ValueError):
        if isinstance(value, str | datetime | np.datetime64) and not np.isnat(time := gps_time(value)):
            return time
    raise ValueError("must be a time as 2024-03-05T03:10:00, GPS time without a zone")


def _toml_time(time: np.datetime64) -> datetime | str:
    """Return a TOML time where microseconds are enough, else text."""
    rounded = datetime.fromisoformat(str(time.astype("datetime64[us]")))
    return rounded if np.datetime64(rounded) == time else str(time)


#: GPS time to the nanosecond.
GpsTime = Annotated[np.datetime64, PlainValidator(_gps_time), PlainSerializer(_toml_time)]


class ScenarioSettings(Settings):
    """Base of the simulator's settings: the word "none" represents None, which TOML lacks."""

    @model_validator(mode="before")
    @classmethod
    def _none(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        optional = {name for name, field in cls.model_fields.items() if type(None) in get_args(field.annotation)}
        return {key: None if key in optional and value == "none" else value for key, value in values.items()}


class Interval(ScenarioSettings):
    """Part of a run."""

    #: Seconds after the start of the run; an end of None is the end of the run.
    start_s: Finite
    end_s: Annotated[float, Field(allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _forward(self) -> Interval:
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s must be after start_s, got start_s = {self.start_s}, end_s = {self.end_s}")
        return self


System = Annotated[str, Field(pattern=f"^[{SYSTEMS}]$")]  #: Letter of a constellation.


class SatelliteErrorSettings(ScenarioSettings):
    """Errors of the broadcast message, independent for each satellite of a constellation."""

    #: Gauss-Markov error of the clock, in metres of range.
    clock_sigma_m: NotNegative = 0.0
    clock_time_s: Positive = 3600.0
    #: Gauss-Markov errors of the position, true minus broadcast.
    radial_sigma_m: NotNegative = 0.0
    along_sigma_m: NotNegative = 0.0
    cross_sigma_m: NotNegative = 0.0
    orbit_time_s: Positive = 7200.0  #: Correlation time of these errors.
    group_delay_sigma_m: NotNegative = 0.0  #: Group delay, constant for each satellite and signal, in the code alone.


class IonosphereErrorSettings(ScenarioSettings):
    """Ionospheric delay on L1 beyond the model (times `SkySettings.ionosphere_scale`)."""

    #: Gauss-Markov vertical delay over the first point of the line.
    vertical_sigma_m: NotNegative = 0.0
    vertical_time_s: Positive = 1800.0
    #: Growth of the vertical delay from there with the distance of the pierce point.
    gradient_mm_per_km: NotNegative = 0.0
    gradient_azimuth_deg: Finite = 0.0  #: Direction in which it grows.


class TroposphereErrorSettings(ScenarioSettings):
    """Tropospheric delay beyond the model (times `SkySettings.troposphere_scale`)."""

    #: Gauss-Markov zenith delay.
    zenith_sigma_m: NotNegative = 0.0
    zenith_time_s: Positive = 7200.0


class SatelliteFault(Interval):
    """Satellite whose ranges are faulty for a time, without a warning in its message."""

    satellite: str = Field(pattern=f"^[{SYSTEMS}][0-9]{{2}}$")  #: "G07".
    step_m: Finite = 0.0  #: Added to code and phase from the start on.
    ramp_mps: Finite = 0.0  #: Growth of the error from the start on.


class ClockWalkSettings(ScenarioSettings):
    """Random walks of a receiver's clock about its constant drift, in metres of range."""

    walk_m_per_sqrt_s: NotNegative = 0.0  #: Random walk of the bias: standard deviation after one second.
    frequency_walk_mps_per_sqrt_s: NotNegative = 0.0  #: Random walk of the drift: standard deviation after one second.


class InterSystemSettings(ScenarioSettings):
    """Inter-system bias of the receivers for one constellation, in code, phase and Doppler."""

    offset_m: Finite = 0.0  #: At the start of the run.
    drift_mps: Finite = 0.0
    #: Bias of the rear receiver less the front receiver's, for common and separate clocks.
    rear_difference_m: Finite = 0.0


class NoiseSettings(ScenarioSettings):
    """Time-correlated receiver noise; the sigmas are set in `ReceiverSettings`."""

    code_correlated_share: Share = 0.0  #: Fraction of the code noise's variance, in [0, 1], that is correlated in time.
    #: Its correlation time: a code loop of noise bandwidth B has 1 / (4 B), 1 s at 0.25 Hz.
    code_correlation_time_s: Positive = 1.0
    #: Gauss-Markov variation of C/N0, independent for each channel.
    cn0_wander_sigma_db: NotNegative = 0.0
    cn0_wander_time_s: Positive = 10.0
    #: Observables whose noise grows as C/N0 falls: the code alone, or phase and Doppler by the same law (10 times as
    #: noisy for 20 dB less; their sigmas are those at 45 dB-Hz).
    weak_signals: Literal["code", "all"] = "code"


class TrackingSettings(ScenarioSettings):
    """Loss of lock and re-acquisition."""

    threshold_dbhz: NotNegative | None = None  #: A signal weaker than this is lost; None: no signal is too weak.
    #: A signal lost below the threshold is tracked again from this C/N0 on; None: from the threshold on.
    reacquisition_dbhz: NotNegative | None = None
    reacquisition_s: NotNegative = 0.0  #: A lost signal is absent for this time after it could be tracked again.
    #: "after_loss": the phase returns with another number of whole cycles, and its first epoch has bit 0 of the
    #: loss-of-lock indicator set.
    slips: Literal["none", "after_loss"] = "none"


class ErrorSettings(ScenarioSettings):
    """All errors of satellites, atmosphere and receivers; none by default."""

    #: By the letter of the constellation.
    satellites: dict[System, SatelliteErrorSettings] = Field(default_factory=dict)

    ionosphere: IonosphereErrorSettings = IonosphereErrorSettings()
    troposphere: TroposphereErrorSettings = TroposphereErrorSettings()
    faults: tuple[SatelliteFault, ...] = ()
    #: Clock of both receivers; one random walk where `ReceiverSettings.clocks` is "common".
    clock: ClockWalkSettings = ClockWalkSettings()
    intersystem: dict[System, InterSystemSettings] = Field(default_factory=dict)  #: By the letter of the constellation.
    noise: NoiseSettings = NoiseSettings()
    tracking: TrackingSettings = TrackingSettings()


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
    #: Longest duration; drawn uniformly between a fifth of it and all of it, at most the duration of the acceleration.
    duration_s: Positive = 3.0


class TachometerSettings(ScenarioSettings):
    """Tachometer on one wheel."""

    pulses_per_turn: int = Field(default=60, gt=0)
    wheel_diameter_m: Positive = 0.86  #: Nominal.
    diameter_error_m: Finite = 0.0  #: True minus nominal.
    resolution_s: NotNegative = 0.0  #: Noise of the pulses' times; 0: a nanosecond.
    jitter_s: NotNegative = 0.0  #: Standard deviation of a pulse's time.
    lowest_mps: NotNegative = 0.0  #: No pulses come below this speed of the wheel.
    #: Standard deviation of each tooth's position as a fraction of the spacing of the teeth; the same every turn.
    tooth_sigma: float = Field(default=0.0, ge=0.0, le=0.2)
    #: Probability that a pulse is not detected, and that it is followed by a second one before the next tooth.
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
            raise ValueError(f"diameter_error_m must be small compared with the diameter, got {self.diameter_error_m}")
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
    #: Mean frequency of the vibration; the relative bandwidth is 15 percent. Frequencies above half of `rate_hz` are
    #: aliased.
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
    #: Gauss-Markov part of the scale, as caused by pitching of the body.
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
    """Ranging unit near the track."""

    name: str = Field(min_length=1)
    #: Position: along the line, to the right of the track's axis, above the rails.
    chainage_m: Finite
    lateral_m: Finite = 3.0
    height_m: Finite = 3.0
    delay_bias_m: Finite = 0.0  #: Error of the constant answering delay, as range.


class RangingSettings(ScenarioSettings):
    """Two-way ranging to units near the track (P2, table 3: every 200 ms, about 100 m; 3.3: sigma 0.19 to 0.24 m)."""

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
    #: Fraction of the cells in which an echo hides the direct path, and the mean of its exponential excess.
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
    #: Further balises at this spacing from the beginning of the line on, named B001 and so on; 0 for none.
    spacing_m: NotNegative = 0.0
    along_m: Finite = 0.0  #: Position of the reader along the body, like the antennas'.
    noise_sigma_m: NotNegative = 0.0  #: Error of a reading along the line.
    missed: tuple[str, ...] = ()  #: Balises that are not read.
    wrong: dict[str, str] = Field(default_factory=dict)  #: Balises that are read with another identity.
    #: Probability of a reading with the identity of another balise.
    missed_chance: Share = 0.0
    wrong_chance: Share = 0.0


class SensorSettings(ScenarioSettings):
    """Sensors of the vehicle; None: no sensor of that kind."""

    tachometer: TachometerSettings | None = TachometerSettings()
    inertial: InertialSettings | None = InertialSettings()
    radar: RadarSettings | None = RadarSettings()
    ranging: RangingSettings | None = None
    balises: BaliseSettings | None = None


class SbasSettings(ScenarioSettings):
    """SBAS that corrects GPS and the ionosphere, or on L5 ionosphere-free codes of GPS and Galileo."""

    band: Literal["L1", "L5"] = "L1"  #: L5 needs receivers with ``signals_per_satellite = 2, second = "L5"``.
    prn: Annotated[int, Field(ge=120, le=158)] = 137
    latency_s: NotNegative = 4.0  #: Corrections are computed for this time before the first bit of their message.
    #: Indicators of the accuracy of all satellites and grid points, as sent.
    udrei: Annotated[int, Field(ge=0, le=13)] = 5
    givei: Annotated[int, Field(ge=0, le=14)] = 9
    dfrei: Annotated[int, Field(ge=0, le=14)] = 5  #: The indicator on L5.
    #: Errors of the service's own estimates: white, of each fast correction, each axis, each grid delay.
    clock_sigma_m: NotNegative = 0.0
    orbit_sigma_m: NotNegative = 0.0
    delay_sigma_m: NotNegative = 0.0
    #: Grid points within this distance from the line's first point, in latitude and longitude, are in the mask.
    grid_radius_deg: Positive = 25.0
    #: A fault larger than this sets the satellite to "do not use" after this time.
    alert_m: Positive = 10.0
    alert_s: NotNegative = 6.0
    lost_chance: Share = 0.0  #: Probability that a message is not received.
    #: Time by which the messages precede the run, so that all corrections are available at its start.
    lead_s: NotNegative = 300.0

"""Settings of the errors in the signals; none by default, so that a receiver's corrections are exact.

A Gauss-Markov process has a standard deviation and a correlation time: its autocorrelation is
``sigma^2 exp(-|lag| / time)``.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from railfix.simulate.setting_types import SYSTEMS, Finite, Interval, NotNegative, Positive, ScenarioSettings, Share

#: Letter of a constellation.
System = Annotated[str, Field(pattern=f"^[{SYSTEMS}]$")]


class SatelliteErrorSettings(ScenarioSettings):
    """Errors of the broadcast message, independent for each satellite of a constellation."""

    #: Gauss-Markov error of the clock, in metres of range.
    clock_sigma_m: NotNegative = 0.0
    clock_time_s: Positive = 3600.0
    #: Gauss-Markov errors of the position, true minus broadcast.
    radial_sigma_m: NotNegative = 0.0
    along_sigma_m: NotNegative = 0.0
    cross_sigma_m: NotNegative = 0.0
    orbit_time_s: Positive = 7200.0  #: Their correlation time.
    group_delay_sigma_m: NotNegative = 0.0  #: Constant of each satellite and signal, in the code alone.


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
    """Satellite whose ranges are wrong for a time, without a warning in its message."""

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
    #: Bias of the rear receiver less that of the front receiver, whether their clock is common or not.
    rear_difference_m: Finite = 0.0


class NoiseSettings(ScenarioSettings):
    """Time-correlated receiver noise; the sigmas are those of `ReceiverSettings`."""

    code_correlated_share: Share = 0.0  #: Share of the code noise's variance, in [0, 1], that is correlated in time.
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
    #: Of both receivers; one walk where `ReceiverSettings.clocks` is "common".
    clock: ClockWalkSettings = ClockWalkSettings()
    intersystem: dict[System, InterSystemSettings] = Field(default_factory=dict)  #: By the letter of the constellation.
    noise: NoiseSettings = NoiseSettings()
    tracking: TrackingSettings = TrackingSettings()

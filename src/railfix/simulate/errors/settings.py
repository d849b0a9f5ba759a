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
    """Errors of the broadcast message, independent for each satellite of a constellation.

    Attributes
    ----------
    clock_sigma_m, clock_time_s : float
        Gauss-Markov error of the clock, in metres of range.
    radial_sigma_m, along_sigma_m, cross_sigma_m : float
        Gauss-Markov errors of the position, true minus broadcast.
    orbit_time_s : float
        Their correlation time.
    group_delay_sigma_m : float
        Constant of each satellite and signal, in the code alone.
    """

    clock_sigma_m: NotNegative = 0.0
    clock_time_s: Positive = 3600.0
    radial_sigma_m: NotNegative = 0.0
    along_sigma_m: NotNegative = 0.0
    cross_sigma_m: NotNegative = 0.0
    orbit_time_s: Positive = 7200.0
    group_delay_sigma_m: NotNegative = 0.0


class IonosphereErrorSettings(ScenarioSettings):
    """Ionospheric delay on L1 beyond the model (times `SkySettings.ionosphere_scale`).

    Attributes
    ----------
    vertical_sigma_m, vertical_time_s : float
        Gauss-Markov vertical delay over the first point of the line.
    gradient_mm_per_km : float
        Growth of the vertical delay from there with the distance of the pierce point.
    gradient_azimuth_deg : float
        Direction in which it grows.
    """

    vertical_sigma_m: NotNegative = 0.0
    vertical_time_s: Positive = 1800.0
    gradient_mm_per_km: NotNegative = 0.0
    gradient_azimuth_deg: Finite = 0.0


class TroposphereErrorSettings(ScenarioSettings):
    """Tropospheric delay beyond the model (times `SkySettings.troposphere_scale`).

    Attributes
    ----------
    zenith_sigma_m, zenith_time_s : float
        Gauss-Markov zenith delay.
    """

    zenith_sigma_m: NotNegative = 0.0
    zenith_time_s: Positive = 7200.0


class SatelliteFault(Interval):
    """Satellite whose ranges are wrong for a time, without a warning in its message.

    Attributes
    ----------
    satellite : str
        "G07".
    step_m : float
        Added to code and phase from the start on.
    ramp_mps : float
        Growth of the error from the start on.
    """

    satellite: str = Field(pattern=f"^[{SYSTEMS}][0-9]{{2}}$")
    step_m: Finite = 0.0
    ramp_mps: Finite = 0.0


class ClockWalkSettings(ScenarioSettings):
    """Random walks of a receiver's clock about its constant drift, in metres of range.

    Attributes
    ----------
    walk_m_per_sqrt_s : float
        Random walk of the bias: standard deviation after one second.
    frequency_walk_mps_per_sqrt_s : float
        Random walk of the drift: standard deviation after one second.
    """

    walk_m_per_sqrt_s: NotNegative = 0.0
    frequency_walk_mps_per_sqrt_s: NotNegative = 0.0


class InterSystemSettings(ScenarioSettings):
    """Inter-system bias of the receivers for one constellation, in code, phase and Doppler.

    Attributes
    ----------
    offset_m : float
        At the start of the run.
    drift_mps : float
    rear_difference_m : float
        Bias of the rear receiver less that of the front receiver, whether their clock is common or not.
    """

    offset_m: Finite = 0.0
    drift_mps: Finite = 0.0
    rear_difference_m: Finite = 0.0


class NoiseSettings(ScenarioSettings):
    """Time-correlated receiver noise; the sigmas are those of `ReceiverSettings`.

    Attributes
    ----------
    code_correlated_share : float
        Share of the code noise's variance, in [0, 1], that is correlated in time.
    code_correlation_time_s : float
        Its correlation time: a code loop of noise bandwidth B has 1 / (4 B), 1 s at 0.25 Hz.
    cn0_wander_sigma_db, cn0_wander_time_s : float
        Gauss-Markov variation of C/N0, independent for each channel.
    weak_signals : {"code", "all"}
        Observables whose noise grows as C/N0 falls: the code alone, or phase and Doppler by the same law
        (10 times as noisy for 20 dB less; their sigmas are those at 45 dB-Hz).
    """

    code_correlated_share: Share = 0.0
    code_correlation_time_s: Positive = 1.0
    cn0_wander_sigma_db: NotNegative = 0.0
    cn0_wander_time_s: Positive = 10.0
    weak_signals: Literal["code", "all"] = "code"


class TrackingSettings(ScenarioSettings):
    """Loss of lock and re-acquisition.

    Attributes
    ----------
    threshold_dbhz : float or None
        A signal weaker than this is lost; None: no signal is too weak.
    reacquisition_dbhz : float or None
        A signal lost below the threshold is tracked again from this C/N0 on; None: from the threshold on.
    reacquisition_s : float
        A lost signal is absent for this time after it could be tracked again.
    slips : {"none", "after_loss"}
        "after_loss": the phase returns with another number of whole cycles, and its first epoch
        has bit 0 of the loss-of-lock indicator set.
    """

    threshold_dbhz: NotNegative | None = None
    reacquisition_dbhz: NotNegative | None = None
    reacquisition_s: NotNegative = 0.0
    slips: Literal["none", "after_loss"] = "none"


class ErrorSettings(ScenarioSettings):
    """All errors of satellites, atmosphere and receivers; none by default.

    Attributes
    ----------
    satellites : dict of str to SatelliteErrorSettings
        By the letter of the constellation.
    ionosphere : IonosphereErrorSettings
    troposphere : TroposphereErrorSettings
    faults : tuple of SatelliteFault
    clock : ClockWalkSettings
        Of both receivers; one walk where `ReceiverSettings.clocks` is "common".
    intersystem : dict of str to InterSystemSettings
        By the letter of the constellation.
    noise : NoiseSettings
    tracking : TrackingSettings
    """

    satellites: dict[System, SatelliteErrorSettings] = Field(default_factory=dict)
    ionosphere: IonosphereErrorSettings = IonosphereErrorSettings()
    troposphere: TroposphereErrorSettings = TroposphereErrorSettings()
    faults: tuple[SatelliteFault, ...] = ()
    clock: ClockWalkSettings = ClockWalkSettings()
    intersystem: dict[System, InterSystemSettings] = Field(default_factory=dict)
    noise: NoiseSettings = NoiseSettings()
    tracking: TrackingSettings = TrackingSettings()

"""Noise of a receiver that goes on in time, what it loses and finds again, and the state carried between pieces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from railfix.simulate.setting_checks import (
    require_not_negative,
    require_one_of,
    require_positive,
    require_share,
)


@dataclass(frozen=True, kw_only=True)
class NoiseSettings:
    """What the noise is beyond the white one of `ReceiverSettings`, whose sigmas it keeps.

    Attributes
    ----------
    code_correlated_share : float
        Share of the code noise's variance, in [0, 1], that is correlated in time.
    code_correlation_time_s : float
        Its correlation time: a code loop of noise bandwidth B has 1 / (4 B), 1 s at 0.25 Hz.
    cn0_wander_sigma_db, cn0_wander_time_s : float
        Gauss-Markov wander of C/N0, each channel its own.
    weak_signals : {"code", "all"}
        What a lower C/N0 makes noisier: the code alone, or phase and Doppler by the same law
        (10 times as noisy for 20 dB less; their sigmas are those at 45 dB-Hz).
    """

    code_correlated_share: float = 0.0
    code_correlation_time_s: float = 1.0
    cn0_wander_sigma_db: float = 0.0
    cn0_wander_time_s: float = 10.0
    weak_signals: Literal["code", "all"] = "code"

    def __post_init__(self) -> None:
        require_share(self, "code_correlated_share")
        require_not_negative(self, "cn0_wander_sigma_db")
        require_positive(self, "code_correlation_time_s", "cn0_wander_time_s")
        require_one_of(self, "weak_signals", ("code", "all"))


@dataclass(frozen=True, kw_only=True)
class TrackingSettings:
    """When a receiver loses a signal, and how it finds it again.

    Attributes
    ----------
    threshold_dbhz : float or None
        A signal weaker than this is lost; None: no signal is too weak.
    reacquisition_s : float
        A signal that was lost, for whatever reason, is absent so much longer.
    slips : {"none", "after_loss"}
        "after_loss": the phase comes back with another number of whole cycles, and its first epoch
        has bit 0 of the loss-of-lock indicator set.
    """

    threshold_dbhz: float | None = None
    reacquisition_s: float = 0.0
    slips: Literal["none", "after_loss"] = "none"

    def __post_init__(self) -> None:
        require_not_negative(self, "reacquisition_s")
        if self.threshold_dbhz is not None:
            require_not_negative(self, "threshold_dbhz")
        require_one_of(self, "slips", ("none", "after_loss"))

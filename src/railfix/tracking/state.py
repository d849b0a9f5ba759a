"""State of the filter, with hypotheses that are Gaussian distributions of the same unknowns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Records, record_of
from railfix.tracking.epochs import Previous

#: Bounds of an unknown speed [m/s].
ANY_SPEED: Final = (-np.inf, np.inf)


@dataclass(frozen=True, kw_only=True)
class Monitors:
    """Scalars of the state: adapted parameters, and indicators of contradictory measurements."""

    weak_motion_s: float = 0.0  #: Time for which the mean weight of Dopplers and phases has been low [s].
    weak_code_s: float = 0.0  #: Time for which the mean weight of codes has been low [s].
    #: Logarithm of the ratio of the estimated Doppler variance to the variance assumed in `TrackingLimits`.
    log_doppler_scale: float = 0.0
    log_phase_scale: float = 0.0  #: Log of the ratio of the estimated to the assumed variance of phase changes.
    #: Exponentially weighted mean of the position shifts that codes imply, in standard deviations.
    code_shift: float = 0.0
    code_shift_variance: float = 0.0  #: Variance of `code_shift`.
    #: Logarithm (at least 0) of the ratio of the variance of map lengths to the assumed variance.
    map_log_variance: float = 0.0
    #: Cumulative sum of contradictions between velocity and line (`kernels.tracking.monitors`).
    contradiction: float = 0.0
    #: One minus the recent mean weight of Dopplers and phases; 0 where a sensor measures the speed.
    motion_misfit: float = 0.0
    step_s: float = 0.0  #: Time for which the codes have implied another position than the estimate [s].
    level_hold_s: float = 0.0  #: Remaining time for which all protection levels are withheld [s].
    #: Remaining time for which the protection level along the line is withheld [s], because the probability of other
    #: positions exceeded the risk.
    ambiguity_hold_s: float = 0.0
    branch_s: float = 0.0  #: Time since the start of the hypotheses [s].
    branch_m: float = 0.0  #: Distance travelled since the start of the hypotheses [m].
    distance_since_code_m: float = 0.0  #: Distance travelled since codes were last used [m].
    direction: float = 0.0  #: Sign of the last speed whose direction was known.
    #: Bounds of the speed that follow from earlier speeds (`railfix.kernels.tracking.model.narrow_speed_range`). With
    #: several hypotheses, the bounds are infinite.
    least_speed_mps: float = ANY_SPEED[0]
    most_speed_mps: float = ANY_SPEED[1]
    #: Time from `TrackState.origin` to the last epoch with used measurements; NaN before the first such epoch.
    measured_s: float = np.nan
    #: Time from `TrackState.origin` to the last epoch with used codes; -inf to use the next codes at once.
    coded_s: float = -np.inf


@dataclass(frozen=True, kw_only=True)
class Bank:
    """B sub-filters of the most probable hypothesis, each of which excludes one source of measurements."""

    #: Name of each excluded source: a satellite ("G05"), a constellation by its clock letter ("G"), a sensor ("wheel"),
    #: or a key of `railfix.tracking.bank.OTHERS` ("doppler").
    without: tuple[str, ...]
    mean: Floats  #: Means of the unknowns, shape (B, N).
    covariance: Floats  #: Covariances of the unknowns, shape (B, N, N).
    #: Time for which each sub-filter has been inconsistent with its own measurements, shape (B,).
    contradicted_s: Floats


#: Record type of the state's scalars: the fields of `Monitors` and the number of hypotheses.
MONITORS: Final = record_of(dict.fromkeys(Monitors.__dataclass_fields__, float) | {"hypotheses": np.intp})
#: Record type of a hypothesis, apart from mean and covariance.
HYPOTHESIS: Final = record_of({
    "log_probability": float,  # logarithm of the probability
    "log_code": float,  # part of `log_probability` due to codes (`railfix.kernels.tracking.hypotheses`)
    "log_least": float,  # recent minimum of `log_probability`: the stored minimum rises slowly (`constants.LEAST_RISE`)
    # Recent code evidence for one of several laps that the map cannot distinguish (`constants.RECENT_S`).
    "log_recent": float,
    "origin_m": float,  # arc length at the start of the hypothesis [m]
})  # fmt: skip


@dataclass(kw_only=True)
class TrackState:
    """State after an epoch, with H hypotheses of N unknowns. Arrays are replaced, never modified in place."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Time of the last epoch.
    origin: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Time of the first epoch.
    #: Means of the unknowns, shape (H, N), in the units of `railfix.kernels.tracking.index`.
    mean: Floats = field(default_factory=lambda: np.empty((0, ix.SATELLITES)))
    #: Covariances of the unknowns, shape (H, N, N).
    covariance: Floats = field(default_factory=lambda: np.empty((0, ix.SATELLITES, ix.SATELLITES)))
    hypothesis: Records = field(default_factory=lambda: np.empty(0, dtype=HYPOTHESIS))  #: Records, shape (H,).
    #: Satellites whose errors are in the state, shape (N - ix.SATELLITES,).
    satellite: Strings = field(default_factory=lambda: np.empty(0, dtype="<U3"))
    #: Time at which each satellite was last observed, shape (N - ix.SATELLITES,).
    seen: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))
    #: Mean normalised code innovation of each satellite, shape (N - ix.SATELLITES,) (`kernels.tracking.adaptation`).
    code_bias: Floats = field(default_factory=lambda: np.empty(0))
    #: True for receiver clocks that have been observed, shape (len(ix.CLOCKS),).
    offset_known: Masks = field(default_factory=lambda: np.zeros(len(ix.CLOCKS), dtype=np.bool_))
    previous: Previous | None = None
    monitors: Monitors = field(default_factory=Monitors)
    bank: Bank | None = None  #: Sub-filters; None if protection levels are off.

    @property
    def hypotheses(self) -> int:
        """Number of hypotheses."""
        return len(self.hypothesis)

    def reset(self) -> None:
        """Reset hypotheses, sub-filters, clocks and adapted parameters; keep the hold times of protection levels."""
        width = ix.SATELLITES + len(self.satellite)
        self.mean, self.covariance = np.empty((0, width)), np.empty((0, width, width))
        self.hypothesis = self.hypothesis[:0]
        self.offset_known = np.zeros(len(ix.CLOCKS), dtype=np.bool_)
        self.code_bias = np.zeros(len(self.satellite))
        self.monitors = Monitors(
            level_hold_s=self.monitors.level_hold_s,
            ambiguity_hold_s=self.monitors.ambiguity_hold_s,
            measured_s=self.monitors.measured_s,
        )
        self.bank = None

    def rearrange(self, kept: Indices, new: tuple[str, ...]) -> None:
        """Keep the errors of the satellites at the indices `kept`, and append the errors of the satellites `new`."""
        index = np.concatenate([np.arange(ix.SATELLITES), ix.SATELLITES + kept]).astype(np.intp)
        self.mean, self.covariance = _rearrange(self.mean, self.covariance, index, len(new))
        if self.bank is not None:
            mean, covariance = _rearrange(self.bank.mean, self.bank.covariance, index, len(new))
            self.bank = replace(self.bank, mean=mean, covariance=covariance)
        self.satellite = np.array([*self.satellite[kept].tolist(), *new], dtype=np.str_)
        self.code_bias = np.concatenate([self.code_bias[kept], np.zeros(len(new))])
        unseen = np.full(len(new), np.datetime64("NaT", "ns"), dtype="datetime64[ns]")
        self.seen = np.concatenate([self.seen[kept], unseen])


def _rearrange(mean: Floats, covariance: Floats, index: Indices, new: int) -> tuple[Floats, Floats]:
    """Return means and covariances of the unknowns `index` and of `new` further satellite errors of unit variance."""
    old = len(index)
    means, covariances = np.zeros((len(mean), old + new)), np.zeros((len(mean), old + new, old + new))
    means[:, :old], covariances[:, :old, :old] = mean[:, index], covariance[:, index[:, None], index]
    diagonal = np.arange(old, old + new)
    covariances[:, diagonal, diagonal] = 1.0
    return means, covariances

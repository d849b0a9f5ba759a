"""State of the filter: hypotheses side by side, each a Gaussian over the same unknowns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks, Strings
from railfix.kernels.tracking.index import CLOCKS, OFFSETS, SATELLITES, StateIndex
from railfix.kernels.tracking.layout import record_of
from railfix.tracking.epochs import Previous

__all__ = [
    "ANY_SPEED",
    "CLOCKS",
    "HYPOTHESIS",
    "MONITORS",
    "OFFSETS",
    "SATELLITES",
    "Bank",
    "Monitors",
    "StateIndex",
    "TrackState",
]

#: Bounds of the speed where nothing is known of it [m/s].
ANY_SPEED: Final = (-np.inf, np.inf)


@dataclass(frozen=True, kw_only=True)
class Monitors:
    """Scalars of the state: what it has adapted to, and what contradicts it."""

    #: How long the mean weights of motion and of codes have been low [s].
    weak_motion_s: float = 0.0
    weak_code_s: float = 0.0
    #: Logarithms of the variances of Dopplers and of phases against those of the limits.
    log_doppler_scale: float = 0.0
    log_phase_scale: float = 0.0
    #: Mean of the shifts that codes imply over the last epochs, in standard deviations, and its variance.
    code_shift: float = 0.0
    code_shift_variance: float = 0.0
    #: Logarithm of the variance of lengths along the map against that of the limits, at least 0.
    map_log_variance: float = 0.0
    #: Sum of the contradictions of the velocity (`railfix.kernels.tracking.monitors`).
    across: float = 0.0
    #: One less the mean weight of Dopplers and phases lately; 0 where a sensor measures the speed.
    motion_misfit: float = 0.0
    step_s: float = 0.0  #: How long all codes have implied another place [s].
    #: For how long the level is held back still, and that along the line, as other places were more probable than the
    #: risk [s].
    level_hold_s: float = 0.0
    ambiguity_hold_s: float = 0.0
    #: Time and distance since the hypotheses began [s, m].
    branch_s: float = 0.0
    branch_m: float = 0.0
    distance_since_code_m: float = 0.0  #: Distance since codes were used [m].
    direction: float = 0.0  #: Sign of the last speed with a direction.
    #: Speeds that are possible after those measured so far (`railfix.kernels.tracking.model.narrow_speed_range`); no
    #: bounds while there are several hypotheses [m/s].
    least_speed_mps: float = ANY_SPEED[0]
    most_speed_mps: float = ANY_SPEED[1]


@dataclass(frozen=True, kw_only=True)
class Bank:
    """Sub-filters of the most probable hypothesis, each without one source: B Gaussians over the same unknowns."""

    #: A satellite ("G05"), a constellation by the letter of its clock ("G"), a sensor ("wheel"), or one of
    #: `railfix.tracking.bank.OTHERS` ("doppler").
    without: tuple[str, ...]
    mean: Floats  #: Shape (B, N).
    covariance: Floats  #: Shape (B, N, N).
    contradicted_s: Floats  #: How long the measurements of each have contradicted it [s]; shape (B,).


@dataclass(kw_only=True)
class TrackState:
    """State after an epoch: H hypotheses of N unknowns. Its arrays are never written to."""

    time: np.datetime64  #: Of the last epoch; NaT before the first.
    mean: Floats  #: Units of `StateIndex`; shape (H, N).
    covariance: Floats  #: Shape (H, N, N).
    log_probability: Floats  #: Shape (H,).
    origin_m: Floats  #: Arc length at which each hypothesis began [m]; shape (H,).
    satellite: Strings  #: Satellites whose errors are in the state; shape (N - SATELLITES,).
    seen: np.ndarray[tuple[int, ...], np.dtype[np.datetime64]]  #: When each was last measured; shape (N - SATELLITES,).
    offset_known: Masks  #: Clocks that have had an observation; shape (len(CLOCKS),).
    previous: Previous | None
    measured: np.datetime64  #: Last epoch with measurements that the filter used.
    #: Last epoch whose codes counted (`TrackingLimits.code_period_s`); NaT where the next ones do.
    coded: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    #: Part of `log_probability` that the codes gave (`railfix.kernels.tracking.hypotheses`); shape (H,).
    log_code: Floats = field(default_factory=lambda: np.empty(0))
    #: Least logarithm of the probability lately: it rises with time (`railfix.kernels.tracking.constants.LEAST_RISE`);
    #: shape (H,).
    log_least: Floats = field(default_factory=lambda: np.empty(0))
    #: Evidence of the codes lately against laps within the error of the map (`RECENT_S` there); no probability;
    #: shape (H,).
    log_recent: Floats = field(default_factory=lambda: np.empty(0))
    #: Mean innovation of each satellite's codes over their standard deviation
    #: (`railfix.kernels.tracking.adaptation`); shape (N - SATELLITES,).
    code_bias: Floats = field(default_factory=lambda: np.empty(0))
    monitors: Monitors = field(default_factory=Monitors)
    bank: Bank | None = None  #: None without levels.

    @property
    def hypotheses(self) -> int:
        """Number of hypotheses."""
        return len(self.log_probability)

    @classmethod
    def empty(cls) -> TrackState:
        """Return the state before the first epoch."""
        return cls(
            time=np.datetime64("NaT", "ns"),
            mean=np.empty((0, SATELLITES)),
            covariance=np.empty((0, SATELLITES, SATELLITES)),
            log_probability=np.empty(0),
            origin_m=np.empty(0),
            satellite=np.empty(0, dtype="<U3"),
            seen=np.empty(0, dtype="datetime64[ns]"),
            offset_known=np.zeros(len(CLOCKS), dtype=np.bool_),
            previous=None,
            measured=np.datetime64("NaT", "ns"),
        )

    def reset(self) -> None:
        """Restart: no hypothesis, no sub-filter, no clock known, nothing adapted; the level stays held back."""
        width = SATELLITES + len(self.satellite)
        self.mean, self.covariance = np.empty((0, width)), np.empty((0, width, width))
        self.log_probability = self.log_code = self.log_least = self.log_recent = self.origin_m = np.empty(0)
        self.offset_known = np.zeros(len(CLOCKS), dtype=np.bool_)
        self.code_bias = np.zeros(len(self.satellite))
        held = self.monitors
        self.monitors = Monitors(level_hold_s=held.level_hold_s, ambiguity_hold_s=held.ambiguity_hold_s)
        self.coded = np.datetime64("NaT", "ns")
        self.bank = None

    def rearrange(self, kept: Indices, new: tuple[str, ...]) -> None:
        """Keep the errors of some satellites, and begin those of new ones.

        Parameters
        ----------
        kept : ndarray of int
            Among `satellite`.
        new : tuple of str
        """
        index = np.concatenate([np.arange(SATELLITES), SATELLITES + kept]).astype(np.intp)
        self.mean, self.covariance = _rearrange(self.mean, self.covariance, index, len(new))
        if self.bank is not None:
            mean, covariance = _rearrange(self.bank.mean, self.bank.covariance, index, len(new))
            self.bank = replace(self.bank, mean=mean, covariance=covariance)
        self.satellite = np.array([*self.satellite[kept].tolist(), *new], dtype=np.str_)
        self.code_bias = np.concatenate([self.code_bias[kept], np.zeros(len(new))])
        unseen = np.full(len(new), np.datetime64("NaT", "ns"), dtype="datetime64[ns]")
        self.seen = np.concatenate([self.seen[kept], unseen])


#: What each hypothesis has beside its Gaussian, and the scalars of the state, as the recursion takes them: fields of
#: these names. Times are seconds since the first epoch of a chunk.
HYPOTHESIS: Final = record_of(
    dict.fromkeys(("log_probability", "log_code", "log_least", "log_recent", "origin_m"), float)
)
MONITORS: Final = record_of(
    dict.fromkeys((*Monitors.__dataclass_fields__, "measured_s", "coded_s"), float) | {"hypotheses": np.intp}
)


def _rearrange(mean: Floats, covariance: Floats, index: Indices, new: int) -> tuple[Floats, Floats]:
    """Gaussians over some of their unknowns and so many new errors of satellites."""
    count, old, width = len(mean), len(index), len(index) + new
    means, covariances = np.zeros((count, width)), np.zeros((count, width, width))
    means[:, :old] = mean[:, index]
    covariances[:, :old, :old] = covariance[:, index[:, None], index]
    diagonal = np.arange(old, width)
    covariances[:, diagonal, diagonal] = 1.0
    return means, covariances

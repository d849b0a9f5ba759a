"""State of the filter: hypotheses side by side, each a Gaussian over the same unknowns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks, Strings
from railfix.tracking.epochs import Previous

#: Letters of the receiver clocks of codes, in the order of their offsets in the state.
CLOCKS: Final = ("G", "E", "C", "R", "I")


class StateIndex(IntEnum):
    """Place of each unknown in the state; offsets of the clocks and satellites' errors come after."""

    #: Arc length, speed, acceleration along the trajectory [m, m/s, m/s2].
    ARC = 0
    SPEED = 1
    ACCELERATION = 2
    #: Arc length at the epoch before [m].
    PREVIOUS_ARC = 3
    #: Change of the clock of the carrier phases since the epoch before [m].
    PHASE_CLOCK = 4
    #: Drift of that clock [m/s].
    DRIFT = 5
    #: Error of the map to the right and up [m].
    MAP_RIGHT = 6
    MAP_UP = 7
    #: Clock of the codes at this epoch [m].
    CODE_CLOCK = 8
    #: Error of the map's displacement since the epoch before: right, up, along [m].
    STEP_RIGHT = 9
    STEP_UP = 10
    MAP_LENGTH_ERROR = 11
    #: Share that the wheel's way is too short by.
    WHEEL = 12
    #: Offset of the accelerometer [m/s2].
    FORCE_OFFSET = 13
    #: Share that the radar's speed is too low by.
    RADAR = 14
    #: Time-correlated error of the speed by Dopplers [m/s].
    DOPPLER_SPEED = 15
    #: Displacement along the line by errors of the codes that last minutes (orbits, ionosphere) [m].
    CODE_PLACE = 16
    #: Speed at the epoch before [m/s].
    PREVIOUS_SPEED = 17


#: First offset of the clocks.
OFFSETS: Final = len(StateIndex)
#: First error of a satellite.
SATELLITES: Final = OFFSETS + len(CLOCKS)
#: Bounds of the speed where nothing is known of it [m/s].
ANY_SPEED: Final = (-np.inf, np.inf)
#: Unknowns that start again at every epoch: clock of the codes, displacements of the map.
FRESH: Final = slice(StateIndex.CODE_CLOCK, StateIndex.MAP_LENGTH_ERROR + 1)


@dataclass(frozen=True, kw_only=True)
class Bank:
    """Sub-filters beside the most probable hypothesis, each without one source: B Gaussians over the same unknowns."""

    #: A satellite ("G05"), a constellation by the letter of its clock ("G"), or a sensor ("wheel").
    without: tuple[str, ...]
    mean: Floats  #: Shape (B, N).
    covariance: Floats  #: Shape (B, N, N).
    weak_s: Floats  #: How long the measurements of each have contradicted it; shape (B,).

    @classmethod
    def empty(cls, width: int) -> Bank:
        """No sub-filter, for so many unknowns."""
        return cls(without=(), mean=np.empty((0, width)), covariance=np.empty((0, width, width)), weak_s=np.empty(0))


@dataclass(kw_only=True)
class TrackState:
    """State after an epoch: H hypotheses of N unknowns. Its arrays are never written to."""

    time: np.datetime64  #: Of the last epoch; NaT before the first.
    mean: Floats  #: Shape (H, N).
    covariance: Floats  #: Shape (H, N, N).
    log_probability: Floats  #: Shape (H,).
    origin_m: Floats  #: Arc length at which each hypothesis began; shape (H,).
    satellite: Strings  #: Satellites whose errors are in the state; shape (N - SATELLITES,).
    seen: np.ndarray[tuple[int, ...], np.dtype[np.datetime64]]  #: When each was last measured; shape (N - SATELLITES,).
    offset_known: Masks  #: Clocks that have had an observation; shape (len(CLOCKS),).
    previous: Previous | None
    measured: np.datetime64  #: Last epoch with measurements that the filter used.
    #: Last epoch whose codes counted (`TrackingLimits.code_period_s`); NaT where the next ones do.
    coded: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    #: How long the mean weights of motion and codes have been low [s].
    weak_motion_s: float = 0.0
    weak_code_s: float = 0.0
    #: Logarithm of the variance of Dopplers and of phases against that of the limits.
    log_scale: tuple[float, float] = (0.0, 0.0)
    #: Mean of the shifts that codes imply over the last epochs, and its variance.
    code_shift: tuple[float, float] = (0.0, 0.0)
    #: Logarithm of the variance of lengths along the map against that of the limits, at least 0.
    map_log_variance: float = 0.0
    #: Part of `log_probability` that the codes gave (`railfix.kernels.tracking.branches`); shape (H,).
    log_code: Floats = field(default_factory=lambda: np.empty(0))
    #: Mean innovation of each satellite's codes (`railfix.kernels.tracking.learning`); shape (N - SATELLITES,).
    code_bias: Floats = field(default_factory=lambda: np.empty(0))
    #: Least logarithm of the probability lately: it rises with time (`railfix.kernels.tracking.constants.LEAST_RISE`);
    #: shape (H,).
    log_least: Floats = field(default_factory=lambda: np.empty(0))
    #: Evidence of the codes lately against laps within the error of the map (`RECENT_S` there); no probability;
    #: shape (H,).
    log_recent: Floats = field(default_factory=lambda: np.empty(0))
    across: float = 0.0  #: Sum of the contradictions of the velocity (`railfix.kernels.tracking.monitors`).
    #: How long all codes have implied another place, how long the level is withheld still, and how long that along
    #: the line, as other places of it were more probable than the risk.
    step_s: float = 0.0
    withheld_s: float = 0.0
    open_s: float = 0.0
    motion_misfit: float = 0.0  #: One less the mean weight of Dopplers and phases lately; 0 with a speed by a sensor.
    #: Time and distance since the hypotheses began.
    branch_s: float = 0.0
    branch_m: float = 0.0
    bank: Bank | None = None  #: None without levels.
    distance_since_code_m: float = 0.0
    direction: float = 0.0  #: Sign of the last speed with a direction.
    #: Speeds that are possible after those measured so far (`railfix.kernels.tracking.prediction`); no bounds while
    #: there are several hypotheses.
    speed_range_mps: tuple[float, float] = ANY_SPEED

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
        """Restart: no hypothesis, no sub-filter, no clock known, nothing learnt of noise and map."""
        width = SATELLITES + len(self.satellite)
        self.mean, self.covariance = np.empty((0, width)), np.empty((0, width, width))
        self.log_probability = self.log_code = self.log_least = self.log_recent = self.origin_m = np.empty(0)
        self.branch_s = self.branch_m = self.across = self.step_s = self.motion_misfit = 0.0
        self.offset_known = np.zeros(len(CLOCKS), dtype=np.bool_)
        self.code_bias = np.zeros(len(self.satellite))
        self.weak_motion_s = self.weak_code_s = self.distance_since_code_m = self.direction = 0.0
        self.code_shift = self.log_scale = (0.0, 0.0)
        self.map_log_variance = 0.0
        self.speed_range_mps = ANY_SPEED
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


def _rearrange(mean: Floats, covariance: Floats, index: Indices, new: int) -> tuple[Floats, Floats]:
    """Gaussians over some of their unknowns and so many new errors of satellites."""
    count, old, width = len(mean), len(index), len(index) + new
    means, covariances = np.zeros((count, width)), np.zeros((count, width, width))
    means[:, :old] = mean[:, index]
    covariances[:, :old, :old] = covariance[:, index[:, None], index]
    diagonal = np.arange(old, width)
    covariances[:, diagonal, diagonal] = 1.0
    return means, covariances

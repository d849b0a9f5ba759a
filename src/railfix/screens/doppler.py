"""Change of the pseudorange against the Doppler (P1 2.3(2), figure 4, table 6: 1.5 m).

A pseudorange that changes by more than the mean of two Dopplers times interval and wavelength has jumped; a constant
multipath error is not detected. A step of the receiver clock moves all pseudoranges alike: the median over a
constellation removes it, and the interval is corrected by it beforehand (4 ms times 800 m/s are 3.2 m).

P1 ran at 0.1 s. Over longer intervals the limit grows with the noise that two codes do not share, ``sqrt(1 - exp(-dt /
correlation_s))``, the change of acceleration, ``jerk dt^3 / 12``, and the noise of the Doppler, ``sigma dt``. The mode
of the limit is "fixed" (P1's limit), "receiver" (`factor` times the scale of the receiver's own changes, the median
over the satellites averaged over the epochs), or "sigma" (`factor` times the sigma of each code, widest for weak
satellites; in urban recordings at 1 Hz it finds a quarter of the bad codes at the same loss). No mode is below P1's
limit.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Datetimes, Floats, Strings, copy_with, freeze_arrays, medians, read_only
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.ranges.corrected import AntennaRanges
from railfix.screens.base import ObservationPicture, ObservationScreen, ScreenColumn, Screened, ScreenSetup, Verdict
from railfix.screens.medians import clock_medians

_MEDIAN_NORMAL: Final = 0.674_489_750_196_081_7  #: Median of the absolute value of a unit normal variable.
_FINEST_M: Final = 1e-3  #: Smallest change used for the receiver's scale [m].
_LEAST_CHANGES: Final = 5  #: Minimum number of changes for the scale of an epoch.


class DopplerLimits(Settings):
    """Limits of the Doppler screen."""

    #: Limit scaled by the receiver's noise, fixed as in P1, or scaled by the code sigmas; see the module.
    mode: Literal["fixed", "receiver", "sigma"] = "receiver"
    #: Largest change against the Doppler up to `short_interval_s`; P1 table 6: 1.5.
    step_m: float = Field(default=1.5, gt=0.0, allow_inf_nan=False)
    #: Twice P1's interval of 0.1 s, so that one lost epoch has no effect.
    short_interval_s: float = Field(default=0.2, gt=0.0, allow_inf_nan=False)
    #: Time over which the receiver smooths its codes. 1 s gives 2.9 m at 1 s.
    correlation_s: float = Field(default=1.0, gt=0.0, allow_inf_nan=False)
    #: Largest jerk of the vehicle; trains stay below 1 [m/s^3].
    jerk_mps3: float = Field(default=1.0, ge=0.0, allow_inf_nan=False)
    #: Modes "receiver" and "sigma": standard deviations.
    factor: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Mode "sigma": standard deviation of a range rate from the Doppler.
    doppler_sigma_mps: float = Field(default=0.1, ge=0.0, allow_inf_nan=False)
    #: Mode "receiver": weight of the fixed limit in the estimate of the scale, in epochs.
    prior_epochs: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Longest interval over which the screen is run.
    longest_interval_s: float = Field(default=2.5, gt=0.0, allow_inf_nan=False)
    #: Time for which a satellite stays rejected after a jump; 0 rejects only the epochs of the jumps out and back,
    #: which is exactly P1's test.
    hold_s: float = Field(default=2.0, ge=0.0, allow_inf_nan=False)
    least_satellites: int = Field(default=3, ge=3)  #: Number of satellites of one clock required to eliminate its step.
    #: Treatment of a suspected satellite: its sigma is increased by the size of the jump
    #: (`railfix.screens.suspicion_sigma_m`), or it is rejected, as in P1. With few satellites, a rejection can weaken
    #: the geometry so much that an error of a few metres becomes a hundred; a lower weight does not.
    verdict: Literal["weigh", "reject"] = "weigh"


def doppler_limit_m(interval_s: ArrayLike, *, limits: DopplerLimits | None = None) -> Floats:
    """Return the limit of mode "fixed" at an interval [m]: 1.50 up to 0.2 s, 2.88 at 1 s, 3.94 at 2 s.

    ``step sqrt((1 - exp(-dt / correlation)) / (1 - exp(-short / correlation))) + jerk dt^3 / 12``, with dt at least
    `short_interval_s` in the first term; the second term applies only above it.
    """
    limits = limits or DopplerLimits()
    interval = np.asarray(interval_s, dtype=np.float64)
    return np.asarray(limits.step_m * _growth(interval, limits) + _jerk_m(interval, limits))


def _growth(interval: Floats, limits: DopplerLimits) -> Floats:
    """Return the noise of a change relative to the short interval."""
    long = np.expm1(-np.maximum(interval, limits.short_interval_s) / limits.correlation_s)
    return np.asarray(np.sqrt(long / np.expm1(-limits.short_interval_s / limits.correlation_s)))


def _jerk_m(interval: Floats, limits: DopplerLimits) -> Floats:
    return np.where(interval > limits.short_interval_s, limits.jerk_mps3 * interval**3 / 12.0, 0.0)


def expected_limit_m(interval_s: Floats, sigma_m: Floats, *, limits: DopplerLimits) -> Floats:
    """Limit of mode "sigma", shape (T, M) [m], from sigmas of the codes with the previous epoch, shape (T + 1, M)."""
    interval = interval_s[:, None]
    fresh = -np.expm1(-interval / limits.correlation_s)
    noise = (sigma_m[1:] ** 2 + sigma_m[:-1] ** 2) * fresh + (limits.doppler_sigma_mps * interval) ** 2
    # NaN is preserved: a satellite without a sigma is not tested
    return np.asarray(np.maximum(limits.step_m, limits.factor * np.sqrt(noise)) + _jerk_m(interval, limits))


def receiver_limit_m(
    interval_s: Floats, metric_m: Floats, sum_log: float, weight: float, *, limits: DopplerLimits
) -> tuple[Floats, float, float]:
    """Return the limit of mode "receiver", shape (T,) [m], and sum and number of the log scales so far.

    The scale refers to the short interval: the changes of an epoch are divided by the growth of the noise. For a dozen
    satellites it is a tenth to a seventh too small (their own median is subtracted; logarithms are averaged, so that an
    epoch full of multipath does not dominate).
    """
    growth = _growth(interval_s, limits)
    shown = medians(np.abs(metric_m)) / _MEDIAN_NORMAL / growth
    counts = (np.isfinite(metric_m).sum(axis=1) >= _LEAST_CHANGES) & np.isfinite(shown)
    logs = np.where(counts, np.log(np.maximum(np.where(counts, shown, 1.0), _FINEST_M)), 0.0)
    # running sums continue from the state, so that chunk boundaries have no effect
    sums = np.concatenate([[sum_log], logs]).cumsum()[1:]
    weights = np.concatenate([[weight], counts]).cumsum()[1:]
    prior = limits.prior_epochs
    scale = np.exp((sums + prior * np.log(limits.step_m / limits.factor)) / (weights + prior))
    limit = np.maximum(limits.step_m, limits.factor * scale) * growth + _jerk_m(interval_s, limits)
    return limit, float(sums[-1]), float(weights[-1])


_NS: Final = 1e9


@dataclass(frozen=True, kw_only=True)
class DopplerScreened(Screened):
    """Verdict of the Doppler screen; the metric is P1's, from one epoch to the next [m]; limits have shape (T, M)."""

    #: Code offset of a suspected satellite since before the jump, otherwise 0, NaN as the metric; shape (T, M).
    level_m: Floats


@dataclass(frozen=True, kw_only=True)
class DopplerState:
    """Last epoch, and the satellites under suspicion at that epoch; shapes (M,)."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: NaT before the first epoch.
    #: Channels; the next chunk may have different ones.
    satellite: Strings = field(default_factory=lambda: np.empty(0, dtype="<U3"))
    signal: Strings = field(default_factory=lambda: np.empty(0, dtype="<U2"))
    #: NaN where absent.
    code_m: Floats = field(default_factory=lambda: np.empty(0))
    doppler_hz: Floats = field(default_factory=lambda: np.empty(0))
    code_sigma_m: Floats = field(default_factory=lambda: np.empty(0))
    level_m: Floats = field(default_factory=lambda: np.empty(0))  #: Code offset, as in `DopplerScreened`.
    #: Time of the jump, NaT where not suspected.
    since: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))
    #: Sum of the receiver's log scales, and number of epochs in the sum (mode "receiver").
    scale_sum: float = 0.0
    scale_epochs: float = 0.0

    def __post_init__(self) -> None:
        freeze_arrays(self)


class DopplerChannels(NamedTuple):
    """Channels, shape (M,) each; the carrier [Hz] is NaN where unknown: not tested."""

    satellite: Strings
    signal: Strings
    frequency_hz: ArrayLike


def doppler_screen(
    time: ArrayLike,
    code_m: ArrayLike,
    doppler_hz: ArrayLike,
    *,
    channels: DopplerChannels,
    break_before: ArrayLike | None = None,
    code_sigma_m: ArrayLike | None = None,
    limits: DopplerLimits | None = None,
    state: DopplerState | None = None,
) -> tuple[DopplerScreened, DopplerState]:
    """Reject pseudoranges whose change differs from that of their Doppler (P1 2.3(2); table 6: 1.5 m).

    The metric is ``(code_k - code_{k-1}) + lambda (D_k + D_{k-1}) / 2 dt`` less its median over the
    channels of one receiver clock (GPS and QZSS share one).

    A single difference does not show which of its two epochs is faulty. A satellite that jumps beyond the limit is
    suspected and rejected, and its jumps are summed to an offset. When the offset is back within the limit, the
    satellite is used again at once (its jump back is beyond the limit, and not rejected). If this does not happen
    within `hold_s`, the new offset is accepted. A passing reflection thus costs its own epochs, and the end of a
    reflection present from the first epoch on costs `hold_s` of good epochs.

    Parameters
    ----------
    time : array_like of datetime64[ns], shape (T,)
    code_m, doppler_hz : array_like, shape (T, M) [m], [Hz]
        NaN where absent. Implausible codes (0, 1e9) must be left out by the caller.
    break_before : array_like of bool, shape (T,), optional
        Epochs before which no difference is formed.
    code_sigma_m : array_like, shape (T, M) [m], optional
        Noise of the codes, required by mode "sigma", in which a code with NaN is not tested.
    state : DopplerState, optional
        State after the previous chunk.

    Returns
    -------
    DopplerScreened
        NaN metric, and no rejection, where there is no previous epoch within `longest_interval_s`, where the satellite
        lacks code or Doppler at either epoch, and where its clock has fewer than `least_satellites` satellites. A
        suspicion ends at such an epoch, because the offset is lost.
    DopplerState
        State for the next chunk.

    Raises
    ------
    ValueError
        Mode "sigma" without `code_sigma_m`.
    """
    limits, (satellite, signal, frequency_hz) = limits or DopplerLimits(), channels
    when = np.asarray(time, dtype="datetime64[ns]")
    code, doppler = np.asarray(code_m, dtype=np.float64), np.asarray(doppler_hz, dtype=np.float64)
    if code_sigma_m is None and limits.mode == "sigma":
        raise ValueError("mode 'sigma' needs code_sigma_m")
    sigma = np.full(code.shape, np.nan) if code_sigma_m is None else np.asarray(code_sigma_m, dtype=np.float64)
    before = _align(state or DopplerState(), satellite, signal)
    if not len(when):
        nothing = np.empty(code.shape)
        empty = DopplerScreened(metric=nothing, reject=nothing.astype(bool), limit=nothing, level_m=nothing)
        return empty, state or DopplerState()
    codes, dopplers, sigmas = (
        np.concatenate([first[None], rest])
        for first, rest in ((before.code_m, code), (before.doppler_hz, doppler), (before.code_sigma_m, sigma))
    )
    interval = _intervals(when, before.time, break_before, limits)
    rate = -SPEED_OF_LIGHT / np.asarray(frequency_hz, dtype=np.float64) * (dopplers[1:] + dopplers[:-1]) / 2.0
    metric = _jumps(codes[1:] - codes[:-1], rate, interval, satellite, least=limits.least_satellites)
    limit, sum_log, weight = _limit_m(interval, metric, sigmas, before, limits)
    metric = np.where(np.isnan(limit), np.nan, metric)
    limit = np.where(np.isnan(metric), np.nan, limit)
    reject, level, since = kernels.screens.suspicions(
        when.astype(np.int64), metric, limit, before.level_m, before.since.astype(np.int64), int(limits.hold_s * _NS)
    )
    after = copy_with(
        before, time=when[-1], satellite=satellite, signal=signal, code_m=read_only(code[-1].copy()),
        doppler_hz=read_only(doppler[-1].copy()), code_sigma_m=read_only(sigma[-1].copy()),
        level_m=read_only(level[-1].copy()), since=read_only(since.astype("datetime64[ns]")),
        scale_sum=sum_log, scale_epochs=weight,
    )  # fmt: skip
    return DopplerScreened(metric=metric, reject=reject, limit=limit, level_m=level), after


def _align(state: DopplerState, satellite: Strings, signal: Strings) -> DopplerState:
    """Return the state on the channels of this chunk; other channels have no observation in it."""
    if state.satellite.tobytes() == satellite.tobytes() and state.signal.tobytes() == signal.tobytes():
        return state
    row = {key: i for i, key in enumerate(zip(state.satellite.tolist(), state.signal.tolist(), strict=True))}
    found = np.array([row.get(key, -1) for key in zip(satellite.tolist(), signal.tolist(), strict=True)], dtype=int)
    names = ("code_m", "doppler_hz", "code_sigma_m", "level_m")
    aligned: dict[str, Any] = {name: np.append(getattr(state, name), np.nan)[found] for name in names}
    since = np.append(state.since, np.datetime64("NaT", "ns"))[found]
    return replace(state, satellite=satellite, signal=signal, since=since, **aligned)


def _intervals(time: Datetimes, last: np.datetime64, break_before: ArrayLike | None, limits: DopplerLimits) -> Floats:
    """Return the interval before each epoch by the time tags, shape (T,) [s]; NaN where no difference may be formed."""
    every = np.concatenate([np.array([last], dtype="datetime64[ns]"), time])
    interval = seconds(every[1:] - every[:-1])
    possible = (interval > 0.0) & (interval <= limits.longest_interval_s)
    if break_before is not None:
        possible &= ~np.asarray(break_before, dtype=bool)
    return np.where(possible, interval, np.nan)


def _jumps(change: Floats, rate: Floats, interval: Floats, satellite: Strings, *, least: int) -> Floats:
    """Return the change of the codes against the Dopplers, the clock eliminated, shape (T, M) [m]."""
    raw = change - rate * interval[:, None]
    # a step of the receiver clock is not elapsed time
    passed = interval[:, None] - clock_medians(raw, satellite) / SPEED_OF_LIGHT
    raw = change - rate * passed
    return np.asarray(raw - clock_medians(raw, satellite, least=least))


def _limit_m(
    interval: Floats, metric: Floats, sigmas: Floats, before: DopplerState, limits: DopplerLimits
) -> tuple[Floats, float, float]:
    """Return the limit of each change, shape (T, M) or (T, 1) [m], and the sums of the receiver's scale."""
    total, epochs = before.scale_sum, before.scale_epochs
    if limits.mode == "sigma":
        return expected_limit_m(interval, sigmas, limits=limits), total, epochs
    if limits.mode == "receiver":
        row, total, epochs = receiver_limit_m(interval, metric, total, epochs, limits=limits)
    else:
        row = doppler_limit_m(interval, limits=limits)
    return row[:, None], total, epochs


class DopplerScreen(ObservationScreen[DopplerLimits]):
    """Change of the pseudorange against the Doppler."""

    name = "doppler"
    limits = DopplerLimits()
    needs = "the Doppler of three satellites of a constellation at successive epochs"
    columns = (
        ScreenColumn(
            name="metric_doppler_m",
            meaning="screen `doppler`: pseudorange change against its Doppler since the previous epoch",
            verdict="doppler",
        ),
        ScreenColumn(
            name="limit_doppler_m",
            meaning="screen `doppler`: limit of that change",
            verdict="doppler",
            field="limit",
        ),
    )
    observation_pictures = (
        ObservationPicture(
            "doppler", "pseudorange against Doppler", "change of the pseudorange less Doppler [m]", "metric_doppler_m",
            Reason.DOPPLER, "limit_doppler_m",
        ),
    )  # fmt: skip

    def judge(
        self, antenna: AntennaRanges, limits: DopplerLimits, setup: ScreenSetup, state: Any
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdict on a chunk, and the state with the satellites under suspicion."""
        screened, after = doppler_screen(
            antenna.time, np.where((antenna.reason & int(Reason.IMPLAUSIBLE_CODE)) == 0, antenna.code_m, np.nan),
            antenna.doppler_hz, channels=DopplerChannels(antenna.satellite, antenna.signal, antenna.frequency_hz),
            break_before=antenna.break_before, code_sigma_m=antenna.sigma_m, limits=limits, state=state,
        )  # fmt: skip
        error = np.fmax(np.abs(screened.level_m), screened.limit) if limits.verdict == "weigh" else None
        return (Verdict(name="doppler", reason=Reason.DOPPLER, screened=screened, error_m=error),), after


SCREEN = DopplerScreen()

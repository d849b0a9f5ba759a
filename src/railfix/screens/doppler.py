"""Comparison of the pseudorange change between epochs with the Doppler (P1 2.3(2), figure 4, table 6: 1.5 m).

A pseudorange has jumped if its change differs from the change computed from the Dopplers at both epochs. A constant
multipath error is not detected. A step of the receiver clock changes all pseudoranges equally, and is removed by
subtraction of the median over a constellation. Before that, the interval between the epochs is corrected for the clock
step: at a range rate of 800 m/s, a step of 4 ms changes the range by 3.2 m.

P1 uses epochs 0.1 s apart. Over longer intervals the limit grows, because the uncorrelated part of the noise grows as
``sqrt(1 - exp(-dt / correlation_s))``, and a change of acceleration adds ``jerk dt^3 / 12``. The limit has three modes,
and is never smaller than P1's limit. In mode "fixed" it is P1's limit. In mode "receiver" it is `factor` times the
noise scale of the receiver, estimated from its pseudorange changes. In mode "sigma" it is `factor` times the standard
deviation of each pseudorange change, with the Doppler noise ``sigma dt`` included. In urban recordings at 1 Hz the mode
"sigma" rejects a quarter of the faulty and a quarter of the fault-free pseudoranges.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix import kernels
from railfix.core.array_functions import medians
from railfix.core.arrays import Datetimes, Floats, Strings, copy_with, freeze_arrays, read_only
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.ranges.corrected import AntennaRanges
from railfix.screens.base import ObservationPicture, ObservationScreen, ScreenColumn, Screened, ScreenSetup, Verdict
from railfix.screens.medians import clock_medians

_MEDIAN_NORMAL: Final = 0.674_489_750_196_081_7  #: Median of the absolute value of a unit normal variable.
_FINEST_M: Final = 1e-3  #: Lower bound of the noise scale of one epoch, so that its logarithm is finite [m].
_LEAST_CHANGES: Final = 5  #: Minimum number of pseudorange changes to estimate the noise scale of one epoch.


class DopplerLimits(Settings):
    """Limits of the Doppler screen."""

    #: How the limit is determined: fixed as in P1, scaled by the receiver's noise, or scaled by the pseudorange sigmas.
    mode: Literal["fixed", "receiver", "sigma"] = "receiver"
    #: For intervals up to `short_interval_s`: largest accepted code change minus Doppler change; P1 table 6: 1.5.
    step_m: float = Field(default=1.5, gt=0.0, allow_inf_nan=False)
    #: Interval up to which the limit is constant. The default allows for one lost epoch at P1's interval of 0.1 s.
    short_interval_s: float = Field(default=0.2, gt=0.0, allow_inf_nan=False)
    #: Time over which the receiver smooths its pseudoranges. With 1 s, the limit of the mode "fixed" is 2.9 m for
    #: epochs that are 1 s apart.
    correlation_s: float = Field(default=1.0, gt=0.0, allow_inf_nan=False)
    #: Largest jerk of the vehicle [m/s^3]; trains stay below 1.
    jerk_mps3: float = Field(default=1.0, ge=0.0, allow_inf_nan=False)
    #: Ratio of the limit to the noise, for modes "receiver" and "sigma".
    factor: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Standard deviation of a range rate from the Doppler, for mode "sigma".
    doppler_sigma_mps: float = Field(default=0.1, ge=0.0, allow_inf_nan=False)
    #: Weight of the fixed limit in the estimate of the noise scale, as a number of epochs, for mode "receiver".
    prior_epochs: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Longest interval between two epochs that are compared.
    longest_interval_s: float = Field(default=2.5, gt=0.0, allow_inf_nan=False)
    #: Longest time for which a satellite remains suspected after a jump. With 0, only the epochs of the jump and of the
    #: jump back are affected, as in P1.
    hold_s: float = Field(default=2.0, ge=0.0, allow_inf_nan=False)
    #: Minimum number of satellites with the same receiver clock for a test.
    least_satellites: int = Field(default=3, ge=3)
    #: Treatment of a suspected satellite: its sigma is increased ("weigh"), or it is rejected ("reject"), as in P1. The
    #: increase follows from the size of the jump (`railfix.screens.suspicion_sigma_m`). With few satellites, a
    #: rejection can weaken the geometry so much that a position error grows from a few metres to a hundred metres.
    verdict: Literal["weigh", "reject"] = "weigh"


def doppler_limit_m(interval_s: ArrayLike, *, limits: DopplerLimits | None = None) -> Floats:
    """Return the limit [m] of mode "fixed" for an interval between epochs. By default it is 1.50 m up to 0.2 s, 2.88 m
    at 1 s and 3.94 m at 2 s.

    The limit is ``step sqrt((1 - exp(-dt / correlation)) / (1 - exp(-short / correlation))) + jerk dt^3 / 12``. In the
    first term dt is at least `short_interval_s`; the second term is 0 up to `short_interval_s`.
    """
    limits = limits or DopplerLimits()
    interval = np.asarray(interval_s, dtype=np.float64)
    return np.asarray(limits.step_m * _growth(interval, limits) + _jerk_m(interval, limits))


def _growth(interval: Floats, limits: DopplerLimits) -> Floats:
    """Return the noise of a pseudorange change relative to the noise of a change over `short_interval_s`."""
    long = np.expm1(-np.maximum(interval, limits.short_interval_s) / limits.correlation_s)
    return np.asarray(np.sqrt(long / np.expm1(-limits.short_interval_s / limits.correlation_s)))


def _jerk_m(interval: Floats, limits: DopplerLimits) -> Floats:
    return np.where(interval > limits.short_interval_s, limits.jerk_mps3 * interval**3 / 12.0, 0.0)


def expected_limit_m(interval_s: Floats, sigma_m: Floats, *, limits: DopplerLimits) -> Floats:
    """Return the limit of mode "sigma", shape (T, M) [m].

    `interval_s` has shape (T,). `sigma_m` are the pseudorange sigmas of T + 1 epochs, the first of which precedes the
    chunk. The limit is NaN where the sigma of either epoch is NaN.
    """
    interval = interval_s[:, None]
    fresh = -np.expm1(-interval / limits.correlation_s)
    noise = (sigma_m[1:] ** 2 + sigma_m[:-1] ** 2) * fresh + (limits.doppler_sigma_mps * interval) ** 2
    # np.maximum keeps NaN, so that a satellite without a sigma is not tested
    return np.asarray(np.maximum(limits.step_m, limits.factor * np.sqrt(noise)) + _jerk_m(interval, limits))


def receiver_limit_m(
    interval_s: Floats, metric_m: Floats, sum_log: float, weight: float, *, limits: DopplerLimits
) -> tuple[Floats, float, float]:
    """Return the limit of mode "receiver", shape (T,) [m], and sum and number of the logarithms of noise scales.

    The noise scale of an epoch is the median over the satellites of the absolute metric, scaled to `short_interval_s`.
    The logarithms of the scales are averaged over the epochs, so that an epoch with large multipath errors does not
    dominate. With a dozen satellites, the scale is too small by a tenth to a seventh, because the subtracted median was
    computed from the same changes.
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
    """Verdict of the Doppler screen; the metric is code change minus Doppler change [m] (P1); shapes (T, M)."""

    #: Offset of a suspected pseudorange from its value before the jump; 0 if not suspected; NaN without a metric.
    level_m: Floats


@dataclass(frozen=True, kw_only=True)
class DopplerState:
    """Observations and suspected satellites at the last epoch; shapes (M,)."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: NaT before the first epoch.
    #: Satellite and signal of each channel; the next chunk may have different channels.
    satellite: Strings = field(default_factory=lambda: np.empty(0, dtype="<U3"))
    signal: Strings = field(default_factory=lambda: np.empty(0, dtype="<U2"))
    #: Observations at the last epoch, NaN where absent.
    code_m: Floats = field(default_factory=lambda: np.empty(0))
    doppler_hz: Floats = field(default_factory=lambda: np.empty(0))
    code_sigma_m: Floats = field(default_factory=lambda: np.empty(0))
    level_m: Floats = field(default_factory=lambda: np.empty(0))  #: Pseudorange offset, as in `DopplerScreened`.
    #: Time of the jump; NaT where the satellite is not suspected.
    since: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))
    scale_sum: float = 0.0  #: Sum of the logarithms of the epochs' noise scales (mode "receiver").
    scale_epochs: float = 0.0  #: Number of epochs in `scale_sum`.

    def __post_init__(self) -> None:
        freeze_arrays(self)


class DopplerChannels(NamedTuple):
    """Satellites, signals and carrier frequencies, shape (M,); a channel of unknown frequency (NaN) is not tested."""

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
    """Reject pseudoranges whose change between epochs disagrees with the Doppler (P1 2.3(2), table 6: 1.5 m).

    The metric is ``(code_k - code_{k-1}) + lambda (D_k + D_{k-1}) / 2 dt`` minus its median over the channels of one
    receiver clock (GPS and QZSS share a clock).

    A single difference does not show which of its two epochs is faulty. A satellite whose metric exceeds the limit is
    suspected and rejected, and its offset is the sum of the metric over the following epochs. As soon as the offset is
    within the limit, the satellite is used again, although the jump back exceeds the limit. If the offset is not within
    the limit after `hold_s`, the new pseudorange is accepted. A temporary reflection is therefore rejected only while
    it lasts. When a reflection that was present from the first epoch ends, good epochs are rejected for `hold_s`.

    Parameters
    ----------
    time : array_like of datetime64[ns], shape (T,)
    code_m, doppler_hz : array_like, shape (T, M) [m], [Hz]
        NaN where absent. The caller must replace implausible pseudoranges (0, 1e9) by NaN.
    break_before : array_like of bool, shape (T,), optional
        True at epochs that are not compared with the previous epoch.
    code_sigma_m : array_like, shape (T, M) [m], optional
        Standard deviation of the pseudoranges, required by mode "sigma". Where it is NaN, no test is made.
    state : DopplerState, optional
        State after the previous chunk.

    Returns
    -------
    DopplerScreened
        The metric is NaN, and nothing is rejected, where there is no previous epoch within `longest_interval_s`, where
        the satellite lacks pseudorange or Doppler at either epoch, or where fewer than `least_satellites` satellites
        have the same receiver clock. A suspicion ends at such an epoch, because the offset is no longer known.
    DopplerState
        State for the next chunk.

    Raises
    ------
    ValueError
        The mode is "sigma", and `code_sigma_m` is missing.
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
    """Return the state, reordered to the channels of this chunk; NaN and NaT for channels new in the chunk."""
    if state.satellite.tobytes() == satellite.tobytes() and state.signal.tobytes() == signal.tobytes():
        return state
    row = {key: i for i, key in enumerate(zip(state.satellite.tolist(), state.signal.tolist(), strict=True))}
    found = np.array([row.get(key, -1) for key in zip(satellite.tolist(), signal.tolist(), strict=True)], dtype=int)
    names = ("code_m", "doppler_hz", "code_sigma_m", "level_m")
    aligned: dict[str, Any] = {name: np.append(getattr(state, name), np.nan)[found] for name in names}
    since = np.append(state.since, np.datetime64("NaT", "ns"))[found]
    return replace(state, satellite=satellite, signal=signal, since=since, **aligned)


def _intervals(time: Datetimes, last: np.datetime64, break_before: ArrayLike | None, limits: DopplerLimits) -> Floats:
    """Return the time since the previous epoch, shape (T,) [s]; NaN where the two epochs must not be compared."""
    every = np.concatenate([np.array([last], dtype="datetime64[ns]"), time])
    interval = seconds(every[1:] - every[:-1])
    possible = (interval > 0.0) & (interval <= limits.longest_interval_s)
    if break_before is not None:
        possible &= ~np.asarray(break_before, dtype=bool)
    return np.where(possible, interval, np.nan)


def _jumps(change: Floats, rate: Floats, interval: Floats, satellite: Strings, *, least: int) -> Floats:
    """Return pseudorange changes, minus the Doppler-derived changes and the receiver clock step, shape (T, M) [m]."""
    raw = change - rate * interval[:, None]
    # subtract the step of the receiver clock from the difference of the time tags
    passed = interval[:, None] - clock_medians(raw, satellite) / SPEED_OF_LIGHT
    raw = change - rate * passed
    return np.asarray(raw - clock_medians(raw, satellite, least=least))


def _limit_m(
    interval: Floats, metric: Floats, sigmas: Floats, before: DopplerState, limits: DopplerLimits
) -> tuple[Floats, float, float]:
    """Return the limit, shape (T, M) or (T, 1) [m], and sum and number of the logarithms of noise scales."""
    total, epochs = before.scale_sum, before.scale_epochs
    if limits.mode == "sigma":
        return expected_limit_m(interval, sigmas, limits=limits), total, epochs
    if limits.mode == "receiver":
        row, total, epochs = receiver_limit_m(interval, metric, total, epochs, limits=limits)
    else:
        row = doppler_limit_m(interval, limits=limits)
    return row[:, None], total, epochs


class DopplerScreen(ObservationScreen[DopplerLimits]):
    """Screen of the pseudorange change between epochs, by comparison with the Doppler."""

    name = "doppler"
    limits = DopplerLimits()
    needs = "the Doppler of three satellites of a constellation at successive epochs"
    columns = (
        ScreenColumn(
            name="metric_doppler_m",
            meaning="screen `doppler`: pseudorange change since the previous epoch minus the Doppler-derived change",
            verdict="doppler",
        ),
        ScreenColumn(
            name="limit_doppler_m",
            meaning="screen `doppler`: limit of `metric_doppler_m`",
            verdict="doppler",
            field="limit",
        ),
    )
    observation_pictures = (
        ObservationPicture(
            "doppler", "pseudorange against Doppler", "code change minus Doppler change [m]", "metric_doppler_m",
            Reason.DOPPLER, "limit_doppler_m",
        ),
    )  # fmt: skip

    def judge(
        self, antenna: AntennaRanges, limits: DopplerLimits, setup: ScreenSetup, state: Any
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdict on a chunk, and the state after its last epoch."""
        screened, after = doppler_screen(
            antenna.time, np.where((antenna.reason & int(Reason.IMPLAUSIBLE_CODE)) == 0, antenna.code_m, np.nan),
            antenna.doppler_hz, channels=DopplerChannels(antenna.satellite, antenna.signal, antenna.frequency_hz),
            break_before=antenna.break_before, code_sigma_m=antenna.sigma_m, limits=limits, state=state,
        )  # fmt: skip
        error = np.fmax(np.abs(screened.level_m), screened.limit) if limits.verdict == "weigh" else None
        return (Verdict(name="doppler", reason=Reason.DOPPLER, screened=screened, error_m=error),), after


SCREEN = DopplerScreen()

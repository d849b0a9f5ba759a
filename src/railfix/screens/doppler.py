"""Change of the pseudorange against the Doppler (P1 2.3(2), figure 4, table 6: 1.5 m).

Over a short interval the range changes by the mean of the two Dopplers times interval and
wavelength. The Doppler is little affected by multipath, so a pseudorange that changes otherwise has
jumped. The screen detects *changes*: it cannot detect a constant multipath error.

Receiver clock. A step of the clock moves all pseudoranges alike, and the median over the satellites
of a constellation removes it. A step also falsifies the interval: time tags are those of the
receiver's clock, so between two tags ``dt - step`` has really passed, and 4 ms times a range rate of
800 m/s are 3.2 m that differ from satellite to satellite. The interval is therefore corrected by the
step that the codes themselves show, before the Doppler is applied.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings, freeze_arrays
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.core.timescale import seconds
from railfix.screens.base import (
    AntennaRanges,
    ObservationScreen,
    RunTables,
    ScreenColumn,
    Screened,
    ScreenPicture,
    ScreenSetup,
    Verdict,
)
from railfix.screens.doppler_limits import DopplerLimits, doppler_limit_m, expected_limit_m, receiver_limit_m
from railfix.screens.pairs import clock_medians

_NS: Final = 1e9


@dataclass(frozen=True, kw_only=True)
class DopplerScreened(Screened):
    """Verdict of the Doppler screen; the metric is P1's, from one epoch to the next [m]."""

    limit_m: Floats  #: NaN where the metric is, shape (T, M).
    #: How far a suspected satellite stands from the level it had before its jump, 0 where it is not suspected, NaN
    #: where the metric is; shape (T, M).
    level_m: Floats


def _none(kind: str) -> Strings:
    return np.empty(0, dtype=kind)


@dataclass(frozen=True, kw_only=True)
class DopplerState:
    """The last epoch seen, and the satellites under suspicion then; shapes (M,)."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: NaT before the first epoch.
    #: Channels; those of the next chunk may be others.
    satellite: Strings = field(default_factory=lambda: _none("<U3"))
    signal: Strings = field(default_factory=lambda: _none("<U2"))
    #: NaN where absent.
    code_m: Floats = field(default_factory=lambda: np.empty(0))
    doppler_hz: Floats = field(default_factory=lambda: np.empty(0))
    code_sigma_m: Floats = field(default_factory=lambda: np.empty(0))
    level_m: Floats = field(default_factory=lambda: np.empty(0))  #: See `DopplerScreened`.
    #: Time of the jump, NaT where not suspected.
    since: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))
    #: Sum of the logarithms of the receiver's scale, and how many epochs are in it (mode "receiver").
    scale_sum: float = 0.0
    scale_epochs: float = 0.0

    def __post_init__(self) -> None:
        freeze_arrays(self)


class DopplerChannels(NamedTuple):
    """Channels, shape (M,) each; the carrier [Hz] is NaN where unknown: not judged."""

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
    """Reject pseudoranges whose change differs from that of their Doppler.

    The metric is ``(code_k - code_{k-1}) + lambda (D_k + D_{k-1}) / 2 dt`` less its median over the
    channels of one receiver clock (GPS and QZSS share one).

    A single difference does not show which of its two epochs is faulty. A satellite that jumps beyond the
    limit is suspected and rejected, and its jumps are summed to a level. When the level is back within the
    limit, the satellite is used again at once (its jump back is beyond the limit, and not rejected). When
    `hold_s` has passed without that, the new level is taken as correct. So a passing reflection costs its own
    epochs, and the end of a reflection present from the first epoch on costs `hold_s` of good ones.

    Parameters
    ----------
    time : array_like of datetime64[ns], shape (T,)
    code_m, doppler_hz : array_like, shape (T, M) [m], [Hz]
        NaN where absent. Implausible codes (0, 1e9) must be left out by the caller.
    break_before : array_like of bool, shape (T,), optional
        Nothing is differenced across the step into these epochs.
    code_sigma_m : array_like, shape (T, M) [m], optional
        Noise of the codes, asked for by mode "sigma"; NaN there: not judged.
    state : DopplerState, optional
        Left by the chunk before.

    Returns
    -------
    DopplerScreened
        NaN metric, and no rejection, where there is no epoch before within `longest_interval_s`, where
        the satellite lacks code or Doppler at either epoch, and where its clock has fewer than
        `least_satellites` satellites. A suspicion ends there: the level is lost.
    DopplerState
        To be passed on with the next chunk.

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
        empty = DopplerScreened(metric=nothing, reject=nothing.astype(bool), limit_m=nothing, level_m=nothing)
        return empty, state or DopplerState()
    codes, dopplers, sigmas = (
        np.vstack([first, rest])
        for first, rest in (
            (before.code_m, code),
            (before.doppler_hz, doppler),
            (before.code_sigma_m, sigma),
        )
    )
    interval = _intervals(when, before.time, break_before, limits)
    rate = -SPEED_OF_LIGHT / np.asarray(frequency_hz, dtype=np.float64) * (dopplers[1:] + dopplers[:-1]) / 2.0
    metric = _jumps(np.diff(codes, axis=0), rate, interval, satellite, least=limits.least_satellites)
    limit, sum_log, weight = _limit_m(interval, metric, sigmas, before, limits)
    metric = np.where(np.isnan(limit), np.nan, metric)
    limit = np.where(np.isnan(metric), np.nan, limit)
    reject, level, since = suspicions(
        when.astype(np.int64), metric, limit, before.level_m, before.since.astype(np.int64), int(limits.hold_s * _NS)
    )
    after = DopplerState(
        time=when[-1], satellite=satellite, signal=signal, code_m=code[-1].copy(), doppler_hz=doppler[-1].copy(),
        code_sigma_m=sigma[-1].copy(), level_m=level[-1].copy(), since=since.astype("datetime64[ns]"),
        scale_sum=sum_log, scale_epochs=weight,
    )  # fmt: skip
    return DopplerScreened(metric=metric, reject=reject, limit_m=limit, level_m=level), after


def _align(state: DopplerState, satellite: Strings, signal: Strings) -> DopplerState:
    """The state on the channels of this chunk; channels that left have no observation in it anyway."""
    if state.satellite.tobytes() == satellite.tobytes() and state.signal.tobytes() == signal.tobytes():
        return state
    row = {key: i for i, key in enumerate(zip(state.satellite.tolist(), state.signal.tolist(), strict=True))}
    found = np.array([row.get(key, -1) for key in zip(satellite.tolist(), signal.tolist(), strict=True)], dtype=int)
    known = found >= 0

    def moved(values: Floats) -> Floats:
        return np.where(known, np.append(values, np.nan)[found], np.nan)

    never = np.datetime64("NaT", "ns")
    return DopplerState(
        time=state.time,
        satellite=satellite,
        signal=signal,
        code_m=moved(state.code_m),
        doppler_hz=moved(state.doppler_hz),
        code_sigma_m=moved(state.code_sigma_m),
        level_m=moved(state.level_m),
        since=np.where(known, np.append(state.since, never)[found], never),
        scale_sum=state.scale_sum,
        scale_epochs=state.scale_epochs,
    )


def _intervals(time: Datetimes, last: np.datetime64, break_before: ArrayLike | None, limits: DopplerLimits) -> Floats:
    """Interval into each epoch by the tags, shape (T,) [s]; NaN where nothing may be differenced."""
    interval = seconds(np.diff(np.concatenate([[last], time])))
    possible = (interval > 0.0) & (interval <= limits.longest_interval_s)
    if break_before is not None:
        possible &= ~np.asarray(break_before, dtype=bool)
    return np.where(possible, interval, np.nan)


def _jumps(change: Floats, rate: Floats, interval: Floats, satellite: Strings, *, least: int) -> Floats:
    """Change of the codes against the Dopplers, the clock taken out, shape (T, M) [m]."""
    raw = change - rate * interval[:, None]
    # the receiver clock's step is not elapsed time
    passed = interval[:, None] - clock_medians(raw, satellite) / SPEED_OF_LIGHT
    raw = change - rate * passed
    return np.asarray(raw - clock_medians(raw, satellite, least=least))


def _limit_m(
    interval: Floats, metric: Floats, sigmas: Floats, before: DopplerState, limits: DopplerLimits
) -> tuple[Floats, float, float]:
    """Limit of each change, shape (T, M) [m], and the sums of the receiver's scale."""
    total, epochs = before.scale_sum, before.scale_epochs
    if limits.mode == "sigma":
        return expected_limit_m(interval, sigmas, limits=limits), total, epochs
    if limits.mode == "receiver":
        row, total, epochs = receiver_limit_m(interval, metric, total, epochs, limits=limits)
    else:
        row = doppler_limit_m(interval, limits=limits)
    return np.broadcast_to(row[:, None], metric.shape), total, epochs


def suspicions(
    time_ns: Integers, metric: Floats, limit: Floats, level_before: Floats, since_before: Integers, hold_ns: int
) -> tuple[Masks, Floats, Integers]:
    """Follow the levels of satellites after jumps; a loop over jumps only.

    Levels are summed from the jump on, one after the other, so that a cut between does not show.

    Parameters
    ----------
    time_ns : ndarray of int64, shape (T,)
    metric, limit : ndarray, shape (T, M) [m], in C order
    level_before : ndarray, shape (M,) [m]
        Of the satellites that are under suspicion already.
    since_before : ndarray of int64, shape (M,) [ns]
        Start of the suspicion; NaT as a number for none.

    Returns
    -------
    reject : ndarray of bool, shape (T, M)
    level : ndarray, shape (T, M) [m]
        0 without suspicion, NaN without a metric.
    since : ndarray of int64, shape (M,) [ns]
        Start of the suspicions at the end.
    """
    never = np.iinfo(np.int64).min
    reject = np.zeros(metric.shape, dtype=bool)
    level = np.where(np.isnan(metric), np.nan, 0.0)
    since = np.full(metric.shape[1], never)
    jumped = np.abs(metric) > limit
    carried = since_before != never
    for m in np.flatnonzero(jumped.any(axis=0) | carried).tolist():
        starts = np.flatnonzero(jumped[:, m])
        blind = np.flatnonzero(np.isnan(metric[:, m]))
        k, start, old = 0, int(since_before[m]), float(level_before[m])
        if not carried[m]:
            k, start, old = int(starts[0]), int(time_ns[starts[0]]), 0.0
        while True:
            known = int(blind[i]) if (i := int(np.searchsorted(blind, k))) < len(blind) else len(time_ns)
            held = int(np.searchsorted(time_ns, start + hold_ns, side="right"))
            end = min(known, held)
            levels = np.cumsum(np.concatenate([[old], metric[k:end, m]]))[1:]
            back = np.flatnonzero(np.abs(levels) <= limit[k:end, m])
            stop = k + int(back[0]) if len(back) else end
            reject[k:stop, m] = True
            level[k:stop, m] = levels[: stop - k]
            if stop == len(time_ns):
                since[m] = start
                break
            # the epoch of coming back is not judged again; the one after the hold is
            i = int(np.searchsorted(starts, stop + 1 if len(back) else stop))
            if i == len(starts):
                break
            k, old = int(starts[i]), 0.0
            start = int(time_ns[k])
    return reject, level, since


class DopplerScreen(ObservationScreen[DopplerLimits]):
    """Change of the pseudorange against the Doppler."""

    name = "doppler"
    limits = DopplerLimits()
    needs = "the Doppler of three satellites of a constellation at successive epochs"
    columns = (
        ScreenColumn(
            name="metric_doppler_m",
            meaning="screen `doppler`: change of the pseudorange against its Doppler since the epoch before",
            verdict="doppler",
        ),
        ScreenColumn(
            name="limit_doppler_m",
            meaning="screen `doppler`: limit on the size of that",
            verdict="doppler",
            field="limit_m",
        ),
    )

    def judge(
        self,
        antenna: AntennaRanges,
        limits: DopplerLimits,
        setup: ScreenSetup,  # noqa: ARG002
        state: Any,
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdict on a chunk, and the last epoch with the satellites under suspicion."""
        screened, after = doppler_screen(
            antenna.time,
            np.where((antenna.reason & Reason.IMPLAUSIBLE_CODE) == 0, antenna.code_m, np.nan),
            antenna.doppler_hz,
            channels=DopplerChannels(antenna.satellite, antenna.signal, antenna.frequency_hz),
            break_before=antenna.break_before,
            code_sigma_m=antenna.sigma_m,
            limits=limits,
            state=state,
        )
        error = np.fmax(np.abs(screened.level_m), screened.limit_m) if limits.verdict == "weigh" else None
        return (Verdict(name="doppler", reason=Reason.DOPPLER, screened=screened, error_m=error),), after

    def pictures(self, tables: RunTables, limits: DopplerLimits) -> Iterator[tuple[str, ScreenPicture]]:  # noqa: ARG002
        """Yield the changes against their limits."""
        yield (
            "doppler",
            ScreenPicture(
                title="pseudorange against Doppler",
                label="change of the pseudorange less Doppler [m]",
                metric=tables.channels("metric_doppler_m"),
                reject=tables.rejected(Reason.DOPPLER),
                limit=tables.channels("limit_doppler_m"),
            ),
        )


SCREEN = DopplerScreen()

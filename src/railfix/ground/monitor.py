"""Monitor of the reference triangle: suspension of satellite positioning, a latched stop, release by hand.

A pure state machine: `advance` takes the state and one sample, and returns the new state with the orders to be sent.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
import polars as pl
from pydantic import Field

from railfix.core.errors import SettingsError
from railfix.core.settings import Settings, option
from railfix.ground.station_fixes import StationFixes
from railfix.ground.triangle import SIDES, STOPPING, TriangleLimits, TriangleResult, TriangleVerdict, compare_triangle


class Order(Enum):
    """Order of the monitor to the trains, in the order they are sent."""

    #: Satellite positioning is suspended: positions from it count no more.
    SUSPEND = "suspend satellite positioning"
    #: Trains that depend on it stop.
    STOP = "stop"
    #: Satellite positioning may be used.
    RESUME = "resume satellite positioning"


class MonitorLimits(Settings):
    """Times of the monitor."""

    #: A set of three fixes is late after this time; with the period of the fixes below the time to alert of 6 s.
    late_s: float = option("Time after which three fixes are late.", 3.0, name="--late", metavar="S", gt=0, le=5.0)
    #: Time after a stop in which `GROUND_LOST` is replaced by a more exact cause: an error that grows takes one fix out
    #: of its circle before the others.
    settle_s: float = Field(default=10.0, ge=0)
    healthy_s: float = Field(default=300.0, gt=0)  #: Healthy time before a stop can be released.


@dataclass(frozen=True, kw_only=True)
class MonitorState:
    """State of the monitor."""

    stopped: bool = True  #: True before the first healthy period was released, and from a stop to its release.
    cause: TriangleVerdict | None = None  #: TriangleVerdict that stopped the trains; None at the start.
    receiver: int = -1  #: Receiver that the cause names, -1 where it names none.
    since_s: float = 0.0  #: When the stop was given.
    complete_s: float = 0.0  #: Time of the last set of three fixes.
    healthy_since_s: float | None = None  #: Start of the present healthy time.
    warning: int = -1  #: Receiver that drifts inside its circle, -1 where none does.


def advance(
    state: MonitorState, now_s: float, verdict: TriangleVerdict | None, *, receiver: int = -1, limits: MonitorLimits
) -> tuple[MonitorState, tuple[Order, ...]]:
    """Return the state after a sample, and the orders to be sent.

    Parameters
    ----------
    state : MonitorState
    now_s : float [s]
        Clock of the monitor, which never runs backwards (monotonic).
    verdict : TriangleVerdict or None
        Of the newest fixes; None where nothing has come since.
    receiver : int
        Receiver that the verdict names.
    limits : MonitorLimits

    Raises
    ------
    ValueError
        The clock ran backwards.
    """
    if now_s < state.complete_s:
        raise ValueError(f"the clock of the monitor ran back from {state.complete_s} s to {now_s} s")
    absent = verdict in (None, TriangleVerdict.MONITOR_LOST, TriangleVerdict.JAMMING)
    if absent:
        state = replace(state, healthy_since_s=None)
        if now_s - state.complete_s <= limits.late_s:
            return state, ()
        return _stop(state, now_s, verdict or TriangleVerdict.MONITOR_LOST, -1, limits)
    assert verdict is not None
    state = replace(state, complete_s=now_s, warning=receiver if verdict is TriangleVerdict.RECEIVER_DRIFTING else -1)
    if verdict in STOPPING:
        return _stop(replace(state, healthy_since_s=None), now_s, verdict, receiver, limits)
    if verdict is not TriangleVerdict.HEALTHY:
        return replace(state, healthy_since_s=None), ()
    since = now_s if state.healthy_since_s is None else state.healthy_since_s
    return replace(state, healthy_since_s=since), ()


def _stop(
    state: MonitorState, now_s: float, cause: TriangleVerdict, receiver: int, limits: MonitorLimits
) -> tuple[MonitorState, tuple[Order, ...]]:
    if state.stopped and state.cause is not None:
        if state.cause is TriangleVerdict.GROUND_LOST and now_s - state.since_s <= limits.settle_s:
            return replace(state, cause=cause, receiver=receiver), ()
        return state, ()  # latched with its cause
    return replace(state, stopped=True, cause=cause, receiver=receiver, since_s=now_s), (Order.SUSPEND, Order.STOP)


def release(
    state: MonitorState, now_s: float, *, limits: MonitorLimits
) -> tuple[MonitorState, tuple[Order, ...], str | None]:
    """Return the state after a release by hand, the orders, and the reason of a rejected release.

    A stop is released after `MonitorLimits.healthy_s` of uninterrupted healthy fixes, the last of them not late.
    """
    if not state.stopped:
        return state, (), "there is no stop to release"
    healthy = 0.0 if state.healthy_since_s is None else now_s - state.healthy_since_s
    if healthy < limits.healthy_s or now_s - state.complete_s > limits.late_s:
        return state, (), f"healthy for {healthy:.0f} s of the {limits.healthy_s:.0f} s before a release"
    return replace(state, stopped=False, cause=None, receiver=-1), (Order.RESUME,), None


@dataclass(frozen=True, kw_only=True)
class MonitoredLog:
    """Result of the monitor over a log."""

    fixes: StationFixes
    triangle: TriangleResult
    #: Orders to the trains, with the cause and the receiver it names.
    orders: tuple[tuple[np.datetime64, Order, TriangleVerdict, int], ...]

    def table(self) -> pl.DataFrame:
        """One row an epoch: verdict, receiver, errors of the fixes and of the sides."""
        triangle = self.triangle
        columns: dict[str, object] = {
            "time_gpst": self.fixes.time,
            "verdict": [TriangleVerdict(value).name.lower() for value in triangle.verdict],
            "receiver": triangle.receiver,
            "n_satellites": self.fixes.n_satellites,
        }
        for k in range(3):
            columns[f"error_{k}_m"] = triangle.error_m[:, k]
        for k, (a, b) in enumerate(SIDES):
            columns[f"side_{a}{b}_m"] = triangle.side_error_m[:, k]
            columns[f"distance_{a}{b}_m"] = triangle.distance_error_m[:, k]
            columns[f"bearing_{a}{b}_deg"] = triangle.bearing_error_deg[:, k]
        return pl.DataFrame(columns).fill_nan(None)


def monitor_log(
    fixes: StationFixes, *, limits: TriangleLimits | None = None, times: MonitorLimits | None = None
) -> MonitoredLog:
    """Run the monitor over fixes in order of time, released at the start.

    SettingsError: when the sides of the triangle are too short for the limits.
    """
    limits, times = limits or TriangleLimits(), times or MonitorLimits()
    triangle = _compare(fixes, limits)
    seconds = (fixes.time - fixes.time[0]) / np.timedelta64(1, "s")
    state, orders = MonitorState(stopped=False), []
    for k, now in enumerate(seconds.tolist()):
        verdict = TriangleVerdict(int(triangle.verdict[k]))
        state, given = advance(state, now, verdict, receiver=int(triangle.receiver[k]), limits=times)
        orders += [(fixes.time[k], order, state.cause or verdict, state.receiver) for order in given]
    # one stop, latched: its cause may have become more exact after the orders
    orders = [(time, order, state.cause or cause, state.receiver) for time, order, cause, _ in orders]
    return MonitoredLog(fixes=fixes, triangle=triangle, orders=tuple(orders))


def draw_triangle(path: Path, log: MonitoredLog, *, limits: TriangleLimits) -> None:
    """Draw the fixes about their points, and the errors of fixes and sides over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), layout="constrained")
    grid = figure.add_gridspec(3, 3, height_ratios=[1.2, 1, 1])
    colours = ("#0b6e99", "#b3541e", "#3d7a3d")
    minutes = (log.fixes.time - log.fixes.time[0]) / np.timedelta64(1, "m")
    for k, colour in enumerate(colours):
        axes = figure.add_subplot(grid[0, k])
        offset = log.fixes.fixes_m[:, k] - log.fixes.points_m[k]
        axes.plot(*offset.T, ".", color=colour, markersize=2)
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        axes.plot(limits.radius_m * np.sin(turn), limits.radius_m * np.cos(turn), color="0.4", linewidth=0.8)
        axes.set(aspect="equal", xlabel="east [m]", ylabel="north [m]", title=f"receiver {k}")
    rows = (
        ("error of the fix [m]", log.triangle.error_m, limits.radius_m, [f"receiver {k}" for k in range(3)]),
        ("error of the side [m]", log.triangle.side_error_m, limits.side_m, [f"side {a}-{b}" for a, b in SIDES]),
    )
    for row, (label, values, limit, names) in enumerate(rows, start=1):
        axes = figure.add_subplot(grid[row, :])
        for k, colour in enumerate(colours):
            axes.plot(minutes, values[:, k], color=colour, linewidth=0.8, label=names[k])
        axes.axhline(limit, color="0.2", linestyle="--", linewidth=0.8, label="limit")
        for time, order, cause, _ in log.orders:
            if order is Order.STOP:
                at = (time - log.fixes.time[0]) / np.timedelta64(1, "m")
                axes.axvline(at, color="#a4161a", label=f"stop: {cause.name.lower()}")
        axes.set(ylabel=label, xlabel="time since the first epoch [min]", ylim=(0.0, None))
        axes.legend(loc="upper left", ncols=5, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


@dataclass(kw_only=True)
class LiveMonitor:
    """Monitor of fixes as they arrive, one epoch at a time."""

    limits: TriangleLimits
    times: MonitorLimits
    state: MonitorState = field(default_factory=lambda: MonitorState(stopped=False))

    def judge(self, fixes: StationFixes, now_s: float) -> tuple[MonitoredLog, tuple[Order, ...]]:
        """Take one epoch; return it judged, and the orders to be sent; SettingsError as `monitor_log`."""
        triangle = _compare(fixes, self.limits)
        verdict, receiver = TriangleVerdict(int(triangle.verdict[0])), int(triangle.receiver[0])
        self.state, orders = advance(self.state, now_s, verdict, receiver=receiver, limits=self.times)
        return MonitoredLog(fixes=fixes, triangle=triangle, orders=()), orders

    def silent(self, now_s: float) -> tuple[Order, ...]:
        """Take that nothing has come since the last epoch; return the orders to be sent where it is late."""
        if now_s - self.state.complete_s <= self.times.late_s:
            return ()
        self.state, orders = advance(self.state, now_s, None, limits=self.times)
        return orders


def _compare(fixes: StationFixes, limits: TriangleLimits) -> TriangleResult:
    try:
        return compare_triangle(fixes.points_m, fixes.fixes_m, limits=limits, cn0_fallen=fixes.cn0_fallen)
    except ValueError as error:
        raise SettingsError(str(error)) from None

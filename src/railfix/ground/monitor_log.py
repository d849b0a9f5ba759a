"""Monitor of three recorded logs: verdict of each epoch, stops, and a picture of the triangle over time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from railfix.core.errors import SettingsError
from railfix.ground.monitor import MonitorLimits, MonitorState, Order, advance
from railfix.ground.station_fixes import StationFixes
from railfix.ground.triangle import SIDES, TriangleLimits, TriangleResult, TriangleVerdict, compare_triangle


@dataclass(frozen=True, kw_only=True)
class MonitoredLog:
    """Result of the monitor over a log.

    Attributes
    ----------
    fixes : StationFixes
    triangle : TriangleResult
    orders : tuple of (datetime64, Order, TriangleVerdict, int)
        Orders to the trains, with the cause and the receiver it names.
    """

    fixes: StationFixes
    triangle: TriangleResult
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

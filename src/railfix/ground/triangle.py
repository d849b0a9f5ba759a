"""Reference triangle: verdict on satellite positioning from three fixes at known points, and monitor of the verdicts.

In P3, each fix must lie inside a circle of allowable error around its known point. In addition, the vectors between
neighbouring fixes (distance and bearing) are compared with the vectors between the points. P3 treats a fix inside its
circle as the point itself, so that a drift inside the circle cannot be detected. Here, the vectors are computed between
raw fixes. Errors common to the three receivers cancel in these vectors. The limit for the vectors can therefore be far
below the radius, so that a drift inside the circle is detected.

The monitor is a pure state machine: `advance` takes the state and one sample, and returns the new state and the orders
to be sent. Once satellite positioning has been suspended, trains remain stopped until a release by hand.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum
from pathlib import Path
from typing import Final, Self

import numpy as np
import polars as pl
from pydantic import Field, model_validator

from railfix.core.arrays import Codes, Floats, FrozenArrays, Integers, Masks
from railfix.core.errors import SettingsError
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.ground.fixes_at_stations import StationFixes

#: Pair of receivers at the ends of each side of the triangle.
SIDES: Final = ((0, 1), (1, 2), (2, 0))
#: Seconds of a year of 365.25 days.
YEAR_S: Final = 31_557_600.0


class TriangleVerdict(IntEnum):
    """Verdict on a set of three fixes; `ONE_RECEIVER` and all higher values stop the trains."""

    #: Every fix is inside its circle, and every side within its limit.
    HEALTHY = 0
    #: Every fix is inside its circle, but one side, or both sides at one receiver, are above the limit: a warning.
    RECEIVER_DRIFTING = 1
    #: One fix is outside its circle, and both sides at this fix, but not the third side, are above the limit.
    ONE_RECEIVER = 2
    #: All fixes are outside their circles, and all sides within their limits, as after a satellite fault or jamming.
    SATELLITES_OR_JAMMING = 3
    #: The fixes coincide, as if the three receivers tracked the same false signal.
    SPOOFING = 4
    #: Any other combination: the ground side cannot determine the cause.
    GROUND_LOST = 5
    #: A fix is absent.
    MONITOR_LOST = 6
    #: A fix is absent, and the C/N0 of all three receivers has fallen.
    JAMMING = 7


#: Verdicts that stop the trains.
STOPPING: Final = frozenset(verdict for verdict in TriangleVerdict if verdict >= TriangleVerdict.ONE_RECEIVER)


class TriangleLimits(Settings):
    """Limits of the triangle."""

    #: Radius of the circle of allowable error. An error common to all receivers is not detected up to this size, and
    #: must be part of the error budget of the trains.
    radius_m: float = option("Radius of the circle of allowable error.", 12.0, name="--radius", metavar="M", gt=0)
    #: A side is above its limit if the vectors between its fixes and between its points differ by more than this [m].
    side_m: float = option("Largest error of the vector between two fixes.", 6.0, name="--side", metavar="M", gt=0)

    @model_validator(mode="after")
    def _side_within_twice_the_radius(self) -> Self:
        if self.side_m > 2.0 * self.radius_m:
            raise ValueError(
                "side_m must be at most twice radius_m: two fixes inside their circles cannot differ by more"
            )
        return self


def limits_for_false_stops(
    sigma_m: float, own_sigma_m: float, *, stops_per_year: float, independent_s: float = 100.0
) -> TriangleLimits:
    """Return the limits that lead to an accepted number of false stops per year.

    The length of a horizontal error of standard deviation sigma per axis is Rayleigh distributed:
    ``P(e > R) = exp(-R^2 / (2 sigma^2))``. Half of the false stops are allotted to the three circles, half to the
    three sides. A year has ``YEAR_S / independent_s`` independent samples.

    Parameters
    ----------
    sigma_m : float [m]
        Standard deviation of a fix per axis.
    own_sigma_m : float [m]
        Standard deviation per axis of the part of the error that is not common to all receivers. The error of a side is
        the difference between these parts of two receivers.
    stops_per_year : float
        Accepted number of false stops per year.
    independent_s : float [s]
        Time after which the error of a fix is independent of its earlier errors.

    Raises
    ------
    ValueError
        An argument is not positive, `own_sigma_m` exceeds `sigma_m`, or the rate is higher than the samples allow.
    """
    if not (0.0 < own_sigma_m <= sigma_m and stops_per_year > 0.0 and independent_s > 0.0):
        raise ValueError("0 < own_sigma_m <= sigma_m, stops_per_year > 0 and independent_s > 0 were expected")
    probability = stops_per_year * independent_s / YEAR_S / 6.0
    if probability >= 0.1:
        raise ValueError(f"{stops_per_year} stops per year are too many: no limits exist for this number")
    factor = float(np.sqrt(-2.0 * np.log(probability)))
    return TriangleLimits(
        radius_m=factor * sigma_m, side_m=min(factor * np.sqrt(2.0) * own_sigma_m, 2.0 * factor * sigma_m)
    )


@dataclass(frozen=True, kw_only=True)
class TriangleResult(FrozenArrays):
    """Comparison of T sets of fixes with the reference triangle."""

    error_m: Floats  #: Horizontal distance of each fix from its known point; NaN without a fix; shape (T, 3).
    side_error_m: Floats  #: Length of the deviation of the vector between two fixes, by side (`SIDES`); shape (T, 3).
    distance_error_m: Floats  #: Distance between two fixes minus the known distance, by side (`SIDES`); shape (T, 3).
    bearing_error_deg: Floats  #: Bearing between two fixes minus the known bearing, in [-180, 180); shape (T, 3).
    verdict: Codes  #: `TriangleVerdict`, shape (T,).
    receiver: Integers  #: Receiver that the verdict names, -1 if it names none; shape (T,).


def compare_triangle(
    points_m: Floats, fixes_m: Floats, *, limits: TriangleLimits, cn0_fallen: Masks | None = None
) -> TriangleResult:
    """Compare fixes with the reference triangle.

    Parameters
    ----------
    points_m : ndarray, shape (3, 2) [m]
        East and north coordinates of the known points, relative to any origin.
    fixes_m : ndarray, shape (T, 3, 2) [m]
        Raw fixes in the frame of `points_m`, from the same satellites at each epoch; NaN for an absent fix.
    cn0_fallen : ndarray of bool, shape (T, 3), optional
        Whether the C/N0 of a receiver has fallen.

    Raises
    ------
    ValueError
        A side of the triangle is too short for the limits: it is not longer than ``2 radius_m + side_m``.
    """
    first, second = np.array(SIDES).T
    side = points_m[second] - points_m[first]
    shortest = float(np.hypot(side[:, 0], side[:, 1]).min())
    if not shortest > 2.0 * limits.radius_m + limits.side_m:
        raise ValueError(
            f"the shortest side of the triangle is {shortest:.1f} m; more than two radii plus the limit of the sides, "
            f"{2.0 * limits.radius_m + limits.side_m:.1f} m, was expected"
        )
    offset = fixes_m - points_m
    measured = fixes_m[:, second] - fixes_m[:, first]
    error, side_error = np.hypot(*np.moveaxis(offset, -1, 0)), np.hypot(*np.moveaxis(measured - side, -1, 0))
    apart = np.hypot(*np.moveaxis(measured, -1, 0))
    # comparisons with NaN are False: an absent fix is outside its circle, and its sides are above the limit
    inside, small = error <= limits.radius_m, side_error <= limits.side_m
    coincide = (apart <= limits.side_m).all(axis=1)
    fallen = np.zeros(error.shape, dtype=bool) if cn0_fallen is None else cn0_fallen
    verdict, receiver = _verdicts(
        np.isfinite(error).all(axis=1), inside, small, coincide, np.asarray(fallen.all(axis=1))
    )
    turned = np.degrees(np.arctan2(measured[..., 0], measured[..., 1]) - np.arctan2(side[:, 0], side[:, 1]))
    return TriangleResult(
        error_m=error,
        side_error_m=side_error,
        distance_error_m=apart - np.hypot(side[:, 0], side[:, 1]),
        bearing_error_deg=(turned + 180.0) % 360.0 - 180.0,
        verdict=verdict,
        receiver=receiver,
    )


def _verdicts(
    present: Masks, inside: Masks, small: Masks, coincide: Masks, all_fallen: Masks
) -> tuple[Codes, Integers]:
    """Return the verdict on each set of fixes and the receiver that it names, shape (T,) each."""
    outside = (~inside).sum(axis=1)
    # a receiver i is named if both sides at this receiver exceed their limit, and the third side does not
    alone = np.stack([~small[:, i] & ~small[:, i - 1] & small[:, i - 2] for i in range(3)], axis=1)
    named = np.where(alone.any(axis=1), alone.argmax(axis=1), -1)
    own_outside = np.take_along_axis(~inside, np.maximum(named, 0)[:, None], axis=1)[:, 0] & (named >= 0)
    verdict = np.select(
        [
            ~present & all_fallen,
            ~present,
            (outside == 0) & small.all(axis=1),
            # with noise, a drift exceeds the limit at one side before it exceeds the limit at the other side
            (outside == 0) & ((named >= 0) | (small.sum(axis=1) == 2)),
            (outside == 1) & own_outside,
            (outside == 3) & small.all(axis=1),
            (outside >= 2) & coincide,
        ],
        [
            TriangleVerdict.JAMMING,
            TriangleVerdict.MONITOR_LOST,
            TriangleVerdict.HEALTHY,
            TriangleVerdict.RECEIVER_DRIFTING,
            TriangleVerdict.ONE_RECEIVER,
            TriangleVerdict.SATELLITES_OR_JAMMING,
            TriangleVerdict.SPOOFING,
        ],
        TriangleVerdict.GROUND_LOST,
    ).astype(np.int8)
    names_one = np.isin(verdict, [TriangleVerdict.RECEIVER_DRIFTING, TriangleVerdict.ONE_RECEIVER])
    return verdict, np.where(names_one, named, -1).astype(np.int64)


class Order(Enum):
    """Orders of the monitor to the trains, in the sequence in which they are sent."""

    #: Suspend satellite positioning: its positions are no longer used.
    SUSPEND = "suspend satellite positioning"
    #: Stop trains that depend on satellite positioning.
    STOP = "stop"
    #: Resume the use of satellite positioning.
    RESUME = "resume satellite positioning"


#: Time after a stop in which the cause `GROUND_LOST` may be replaced by a more exact cause [s]. This is needed because
#: a growing error moves one fix out of its circle before the other fixes.
_SETTLE_S: Final = 10.0


class MonitorLimits(Settings):
    """Times of the monitor."""

    #: Fixes count as late when this time has passed since the last complete set of three fixes. The sum of this time
    #: and the period of the fixes must not exceed the time to alert of 6 s.
    late_s: float = option("Longest time without all three fixes.", 3.0, name="--late", metavar="S", gt=0, le=5.0)
    healthy_s: float = Field(default=300.0, gt=0)  #: Time of uninterrupted healthy fixes before a stop can be released.


@dataclass(frozen=True, kw_only=True)
class MonitorState:
    """State of the monitor."""

    stopped: bool = True  #: Whether trains are stopped; true at the start, and from a stop until its release.
    cause: TriangleVerdict | None = None  #: Verdict that stopped the trains; None before a stop and after its release.
    receiver: int = -1  #: Receiver that the cause names; -1 if the cause names none.
    since_s: float = 0.0  #: Time of the last stop [s].
    complete_s: float = 0.0  #: Time of the last complete set of three fixes [s].
    #: Start time of the present series of healthy fixes [s]; None if the newest fixes are not healthy.
    healthy_since_s: float | None = None
    #: Verdict on the newest incomplete set of fixes; None if the newest set is complete or no set has been judged.
    absent: TriangleVerdict | None = None


def advance(
    state: MonitorState, now_s: float, verdict: TriangleVerdict | None, *, receiver: int = -1, limits: MonitorLimits
) -> tuple[MonitorState, tuple[Order, ...]]:
    """Return the state of the monitor after a sample, and the orders to be sent.

    Parameters
    ----------
    state : MonitorState
    now_s : float [s]
        Clock of the monitor, which never runs backwards (monotonic).
    verdict : TriangleVerdict or None
        Verdict on the newest fixes; None without new fixes.
    receiver : int
        Receiver that the verdict names, -1 if the verdict names none.
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
        state = replace(state, healthy_since_s=None, absent=verdict or state.absent)
        if now_s - state.complete_s <= limits.late_s:
            return state, ()
        return _stop(state, now_s, state.absent or TriangleVerdict.MONITOR_LOST, -1)
    assert verdict is not None
    state = replace(state, complete_s=now_s, absent=None)
    if verdict in STOPPING:
        return _stop(replace(state, healthy_since_s=None), now_s, verdict, receiver)
    if verdict is not TriangleVerdict.HEALTHY:
        return replace(state, healthy_since_s=None), ()
    since = now_s if state.healthy_since_s is None else state.healthy_since_s
    return replace(state, healthy_since_s=since), ()


def _stop(
    state: MonitorState, now_s: float, cause: TriangleVerdict, receiver: int
) -> tuple[MonitorState, tuple[Order, ...]]:
    if state.stopped and state.cause is not None:
        if state.cause is TriangleVerdict.GROUND_LOST and now_s - state.since_s <= _SETTLE_S:
            return replace(state, cause=cause, receiver=receiver), ()
        return state, ()  # the stop is latched with its cause
    return replace(state, stopped=True, cause=cause, receiver=receiver, since_s=now_s), (Order.SUSPEND, Order.STOP)


def release(
    state: MonitorState, now_s: float, *, limits: MonitorLimits
) -> tuple[MonitorState, tuple[Order, ...], str | None]:
    """Return the state after a release by hand, the orders to be sent, and the reason if the release is rejected.

    A stop can be released after `MonitorLimits.healthy_s` of uninterrupted healthy fixes, if the last fixes are not
    late.
    """
    if not state.stopped:
        return state, (), "there is no stop to release"
    if (age_s := now_s - state.complete_s) > limits.late_s:
        return state, (), f"the last fixes are {age_s:.1f} s old; a release requires fixes within {limits.late_s:g} s"
    healthy = 0.0 if state.healthy_since_s is None else now_s - state.healthy_since_s
    if healthy < limits.healthy_s:
        return state, (), f"fixes are healthy for {healthy:.0f} s; a release requires {limits.healthy_s:.0f} s"
    return replace(state, stopped=False, cause=None, receiver=-1), (Order.RESUME,), None


@dataclass(frozen=True, kw_only=True)
class MonitoredLog:
    """Result of monitoring a log."""

    fixes: StationFixes
    triangle: TriangleResult
    #: Orders to the trains: time, order, cause, and the receiver that the cause names (-1 if the cause names none).
    orders: tuple[tuple[np.datetime64, Order, TriangleVerdict, int], ...]

    def table(self) -> pl.DataFrame:
        """Return one row per epoch: verdict, receiver, errors of the fixes and of the sides."""
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


@dataclass(kw_only=True)
class Monitor:
    """Monitor of fixes in order of time, processed in blocks of any number of epochs.

    Trains are not stopped at the start.
    """

    limits: TriangleLimits
    times: MonitorLimits
    state: MonitorState = field(default_factory=lambda: MonitorState(stopped=False))
    begun: bool = False

    def begin(self, now_s: float) -> None:
        """Begin at a clock time [s]; the first fixes must arrive within `MonitorLimits.late_s` after this time."""
        self.state, self.begun = replace(self.state, complete_s=now_s), True

    def judge(self, fixes: StationFixes, now_s: float | None = None) -> MonitoredLog:
        """Process fixes at a clock time, by default at their time tags; return the verdicts and the orders to be sent.

        Trains are stopped if fixes are late, in logs as well as in streams. Each order is returned with the cause that
        is known after the last fix, because later fixes may make the cause more exact. Raise SettingsError if the sides
        of the triangle are too short for the limits.
        """
        triangle, orders = judge_fixes(fixes, self.limits), []
        seconds = fixes.time.astype("datetime64[ns]").astype(np.int64) / 1e9
        for k, second in enumerate(seconds.tolist()):
            now, verdict = second if now_s is None else now_s, TriangleVerdict(int(triangle.verdict[k]))
            if not self.begun:
                self.begin(now)
            late, receiver = self.silent(now), int(triangle.receiver[k])
            self.state, given = advance(self.state, now, verdict, receiver=receiver, limits=self.times)
            orders += [(fixes.time[k], order) for order in (*late, *given)]
        cause = self.state.cause or TriangleVerdict.HEALTHY
        latched = tuple((time, order, cause, self.state.receiver) for time, order in orders)
        return MonitoredLog(fixes=fixes, triangle=triangle, orders=latched)

    def silent(self, now_s: float) -> tuple[Order, ...]:
        """Advance to a time without new fixes; return the orders to be sent if fixes are late."""
        if now_s - self.state.complete_s <= self.times.late_s:
            return ()
        self.state, orders = advance(self.state, now_s, None, limits=self.times)
        return orders


def draw_triangle(path: Path, log: MonitoredLog, *, limits: TriangleLimits) -> None:
    """Draw the fixes around their points, and the errors of fixes and sides over time, into a picture file."""
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


def judge_fixes(fixes: StationFixes, limits: TriangleLimits) -> TriangleResult:
    """Compare fixes with the triangle of their points.

    Raise SettingsError if the sides of the triangle are too short for the limits.
    """
    try:
        return compare_triangle(fixes.points_m, fixes.fixes_m, limits=limits, cn0_fallen=fixes.cn0_fallen)
    except ValueError as error:
        raise SettingsError(str(error)) from None

"""Monitor of the reference triangle: suspension of satellite positioning, a latched stop, release by hand.

A pure state machine: `advance` takes the state and one sample, and returns the new state with the orders to be sent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from pydantic import Field

from railfix.core.settings import Settings, option
from railfix.ground.triangle import STOPPING, TriangleVerdict


class Order(Enum):
    """Order of the monitor to the trains, in the order they are sent."""

    #: Satellite positioning is suspended: positions from it count no more.
    SUSPEND = "suspend satellite positioning"
    #: Trains that depend on it stop.
    STOP = "stop"
    #: Satellite positioning may be used.
    RESUME = "resume satellite positioning"


class MonitorLimits(Settings):
    """Times of the monitor.

    Attributes
    ----------
    late_s : float [s]
        A set of three fixes is late after this time; with the period of the fixes below the time to alert of 6 s.
    settle_s : float [s]
        Time after a stop in which `GROUND_LOST` is replaced by a more exact cause: an error that grows takes one fix
        out of its circle before the others.
    healthy_s : float [s]
        Healthy time before a stop can be released.
    """

    late_s: float = option("Time after which three fixes are late.", 3.0, name="--late", metavar="S", gt=0, le=5.0)
    settle_s: float = Field(default=10.0, ge=0)
    healthy_s: float = Field(default=300.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class MonitorState:
    """State of the monitor.

    Attributes
    ----------
    stopped : bool
        True before the first healthy period was released, and from a stop to its release.
    cause : TriangleVerdict or None
        TriangleVerdict that stopped the trains; None at the start.
    receiver : int
        Receiver that the cause names, -1 where it names none.
    since_s : float [s]
        When the stop was given.
    complete_s : float [s]
        Time of the last set of three fixes.
    healthy_since_s : float or None [s]
        Start of the present healthy time.
    warning : int
        Receiver that drifts inside its circle, -1 where none does.
    """

    stopped: bool = True
    cause: TriangleVerdict | None = None
    receiver: int = -1
    since_s: float = 0.0
    complete_s: float = 0.0
    healthy_since_s: float | None = None
    warning: int = -1


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

"""Balises and virtual balises: readings as measurements of the filter, and the passing of each balise.

The interval of a passing is the time during which ``|m - s| <= L``, with the arc length m of the balise, the filter's
position s and the protection level L of that position. If the position error is within L, the train passes the balise
during this interval, in either direction of travel.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Integers, join_rows
from railfix.core.settings import Settings
from railfix.core.timescale import seconds, timedelta
from railfix.motion.samples import BaliseReadings, ListedBalises
from railfix.track.passes import short_distance_m
from railfix.track.trajectory import Trajectory
from railfix.tracking import BaliseEpochs, Tracked

#: Readings of one balise within this time belong to one passing [s]; a train at rest repeats its reading.
AGAIN_S: Final = 60.0


class BaliseLimits(Settings):
    """Position of the balise reader on the vehicle, and accuracy of readings."""

    #: Distance by which the reader is ahead of the vehicle's middle or, without vehicle file, ahead of the antenna.
    ahead_m: float = 0.0
    #: Minimum standard deviation, along the line, of the position from a balise reading: SUBSET-036 requires 1 m for
    #: safety-related use.
    sigma_m: float = Field(default=1.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class BaliseState:
    """Last balise read before a chunk."""

    balise: str = ""  #: Identity of the balise; blank before the first balise has been read.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    turn: int = 1  #: Column (0 or 1) of the balise in `railfix.tracking.BaliseEpochs`.


def arcs_of_balises(listed: ListedBalises, trajectory: Trajectory, limits: BaliseLimits) -> Floats:
    """Return the antenna's arc lengths at which the reader is over each balise, shape (M,) [m]; NaN beyond the path."""
    reader = listed.chainage_m - trajectory.front_sign * limits.ahead_m
    along = trajectory.chainage_m if trajectory.body_chainage_m is None else trajectory.body_chainage_m
    return np.interp(reader, along, trajectory.arc_m, left=np.nan, right=np.nan)


def balise_epochs(
    readings: BaliseReadings,
    edges: Datetimes,
    listed: ListedBalises,
    trajectory: Trajectory,
    state: BaliseState,
    limits: BaliseLimits,
) -> tuple[BaliseEpochs, BaliseState]:
    """Assign each reading to the next epoch; return the measured balise positions, and the state for the next chunk.

    Unlisted balises and readings repeated within `AGAIN_S` are left out. Successive balises alternate between two
    columns. Each column is left out by one sub-filter, which a wrong balise in this column does not affect. `edges` has
    the epoch before the chunk and the epochs of the chunk, shape (T + 1,).
    """
    found = BaliseEpochs.none(len(edges) - 1)
    index, arc = listed.find_index(readings.balise), arcs_of_balises(listed, trajectory, limits)
    epoch = np.searchsorted(edges, readings.time, side="left") - 1
    known = (index >= 0) & (epoch >= 0) & (epoch < len(edges) - 1)
    known[known] = np.isfinite(arc[index[known]])
    for k in np.flatnonzero(known):  # loop over a few balises
        balise, time = str(readings.balise[k]), readings.time[k]
        if balise == state.balise and seconds(time - state.time) < AGAIN_S:
            continue
        state = BaliseState(balise=balise, time=time, turn=1 - state.turn)
        at = (epoch[k], state.turn)
        own = max(float(np.nan_to_num(readings.sigma_m[k])), limits.sigma_m)
        found.time[at], found.place_m[at] = time, arc[index[k]]
        found.sigma_m[at] = np.hypot(own, listed.sigma_m[index[k]])
    return found, state


#: Possible verdicts on a passing or a reading.
VIRTUAL, READ, MISSING, CONTRADICTS, NOT_LISTED = range(5)
VERDICTS: Final = ("virtual", "read", "missing", "contradicts", "not_listed")
#: Odometer accuracy by SUBSET-041 5.2.1.1: a constant [m], plus a fraction of the distance since the last balise read.
ODOMETER_M, ODOMETER_SHARE = 5.0, 0.05
#: Longest interval over which a passing is interpolated, or a reading is assigned to an epoch or a passing [s].
_APART_S: Final = 2.0
#: A reading is wrong if the positions of balise and filter differ by more than this number of sigmas of the difference.
_CONTRADICTION_SIGMAS: Final = 5.0
_NEVER: Final = np.datetime64("NaT", "ns")
#: Fields of `railfix.tracking.Tracked` that the search for passings uses at each epoch.
_VALUES: Final = ("arc_m", "speed_mps", "sigma_m", "level_m", "amount_m")


@dataclass(frozen=True, kw_only=True)
class Passing:
    """Passing of a listed point, or wrong reading of a balise."""

    balise: str
    #: Index in `VERDICTS`: virtual balise; balise passed with a reading; balise passed without a reading; reading that
    #: contradicts the filter; reading of an unlisted balise.
    verdict: int
    chainage_m: float  #: Listed chainage; NaN if unlisted.
    time: np.datetime64  #: Time of the passing according to the filter; time of the reading if the reading is wrong.
    earliest: np.datetime64 = _NEVER  #: Earliest possible time of the passing; NaT for a wrong reading.
    latest: np.datetime64 = _NEVER  #: Latest possible time of the passing; NaT for a wrong reading.
    read: np.datetime64 = _NEVER  #: Time of the reading; NaT without a reading.
    read_error_m: float = float("nan")  #: Balise position minus filter position at the reading.
    here: str = ""  #: For a contradicting reading, the listed balise nearest to the filter's position.
    speed_mps: float = float("nan")  #: Speed at the passing or reading.
    sigma_m: float = float("nan")  #: Standard deviation of the filter's position at `time`.
    level_m: float = float("nan")  #: Protection level of the filter's position at `time`.
    amount_m: float = float("nan")  #: Over- and under-reading amount of the filter's position at `time`.
    odometer_m: float = float("nan")  #: Odometer accuracy by SUBSET-041, for a reset at the last balise.


@dataclass(frozen=True, kw_only=True)
class PassingState:
    """State of the search for passings after a chunk, for M balises and virtual balises."""

    time: Datetimes  #: Time of the last epoch with a position; shape (1,), or (0,) without one.
    values: Floats  #: `_VALUES` at the last epoch with a position; shape (1, 5), or (0, 5) without one.
    #: Side of each balise on which the train was last known to be: -1 before it, 1 beyond it, 0 unknown; shape (M,).
    side: Integers
    since: Datetimes  #: Time at which the train left the side given in `side`, shape (M,).
    over: Datetimes  #: Time at which the filter's position was last over the balise, shape (M,).
    over_values: Floats  #: `_VALUES` and odometer accuracy at the time `over`; shape (M, 6).
    read: Datetimes  #: Time of the last correct reading of each balise, shape (M,).
    #: Readings that are later than the last epoch; they are compared with the filter's positions in the next chunk.
    waiting: BaliseReadings = field(default_factory=BaliseReadings)
    #: Time and filter position [m] at each correct reading of the last `_APART_S` and at the preceding correct reading.
    right: tuple[tuple[np.datetime64, float], ...] = ()

    @classmethod
    def empty(cls, places: int) -> PassingState:
        """Return the state before the first epoch."""
        since, over, read = np.full((3, places), _NEVER)
        return cls(
            time=np.empty(0, dtype="datetime64[ns]"), values=np.empty((0, len(_VALUES))),
            side=np.zeros(places, dtype=np.int64), since=since, over=over,
            over_values=np.full((places, len(_VALUES) + 1), np.nan), read=read,
        )  # fmt: skip


def find_passings(
    tracked: Tracked,
    listed: ListedBalises,
    trajectory: Trajectory,
    readings: BaliseReadings,
    state: PassingState | None,
    limits: BaliseLimits,
) -> tuple[tuple[Passing, ...], PassingState]:
    """Return the passings that ended in a chunk, the wrong readings of the chunk, and the state for the next chunk.

    `listed` has balises and virtual balises; `readings` has the balise readings since the previous chunk.
    """
    state = state or PassingState.empty(len(listed))
    own = trajectory.arc_at_chainage(listed.chainage_m)
    arcs = np.where(listed.virtual, own, arcs_of_balises(listed, trajectory, limits))
    rows = np.flatnonzero(np.isfinite(tracked.arc_m))
    values = np.stack([getattr(tracked, name)[rows] for name in _VALUES], axis=1)
    time, values = np.concatenate([state.time, tracked.time[rows]]), np.concatenate([state.values, values])
    readings = join_rows([state.waiting, readings])
    if not len(time):
        return (), replace(state, waiting=readings)
    state, wrong = _judge(readings, listed, arcs, trajectory.turn_m, time, values, state, limits)
    passed, state = _pass(listed, arcs, trajectory.turn_m, time, values, state)
    found = sorted([*wrong, *passed], key=lambda passing: passing.time)
    earlier = [k for k, (at, _) in enumerate(state.right) if seconds(time[-1] - at) > _APART_S]
    right = state.right[earlier[-1] if earlier else 0 :]
    return tuple(found), replace(state, time=time[-1:], values=values[-1:], right=right)


def _judge(
    readings: BaliseReadings,
    listed: ListedBalises,
    arcs_m: Floats,
    turn_m: float,
    time: Datetimes,
    values: Floats,
    state: PassingState,
    limits: BaliseLimits,
) -> tuple[PassingState, list[Passing]]:
    """Add the correct readings to the state; return the state and the wrong readings."""
    wrong: list[Passing] = []
    read, right = state.read.copy(), list(state.right)
    heard = readings.time <= time[-1]
    index = listed.find_index(readings.balise)
    for k in np.flatnonzero(heard):  # loop over a few balises
        at, mark, balise = readings.time[k], int(index[k]), str(readings.balise[k])
        row = min(int(np.searchsorted(time, at)), len(time) - 1)
        arc, speed, sigma, level, amount = values[row]
        place = arc - speed * float(seconds(time[row] - at))
        near = abs(float(seconds(time[row] - at))) <= _APART_S
        own = Passing(
            balise=balise, verdict=NOT_LISTED, chainage_m=float("nan"), time=at, read=at, speed_mps=speed,
            sigma_m=sigma, level_m=level, amount_m=amount, odometer_m=_odometer(place, at, right),
        )  # fmt: skip
        if mark < 0:
            wrong.append(own)
        elif near:
            error = float(short_distance_m(arcs_m[mark] - place, turn_m))
            spread = np.sqrt(sigma**2 + np.fmax(readings.sigma_m[k], limits.sigma_m) ** 2 + listed.sigma_m[mark] ** 2)
            if abs(error) <= _CONTRADICTION_SIGMAS * spread:
                read[mark] = at
                right.append((at, place))
                continue
            real = np.where(listed.virtual, np.nan, np.abs(short_distance_m(arcs_m - place, turn_m)))
            here = "" if np.isnan(real).all() else str(listed.name[np.nanargmin(real)])
            chainage = float(listed.chainage_m[mark])
            wrong.append(replace(own, verdict=CONTRADICTS, chainage_m=chainage, read_error_m=error, here=here))
    return replace(state, read=read, waiting=readings.take(~heard), right=tuple(right)), wrong


def _odometer(place_m: float, time: np.datetime64, right: Sequence[tuple[np.datetime64, float]]) -> float:
    """Return the accuracy [m] of an odometer reset at the last correct balise reading; NaN before the first reading."""
    before = [place for at, place in right if seconds(time - at) > _APART_S]
    return ODOMETER_M + ODOMETER_SHARE * abs(place_m - before[-1]) if before else float("nan")


def _pass(
    listed: ListedBalises, arcs_m: Floats, turn_m: float, time: Datetimes, values: Floats, state: PassingState
) -> tuple[list[Passing], PassingState]:
    """Return the passings that ended in a chunk, and the state after the chunk."""
    level = np.where(np.isfinite(values[:, 3]), values[:, 3], np.inf)[:, None]
    ahead = short_distance_m(arcs_m - values[:, :1], turn_m)
    far = np.abs(ahead) > 0.25 * turn_m
    side = np.where(far, 0, np.where(ahead > level, -1, np.where(ahead < -level, 1, 0)))
    crossed = np.zeros(ahead.shape, dtype=np.bool_)
    crossed[1:] = ((ahead[1:] < 0.0) != (ahead[:-1] < 0.0)) & ~far[1:]
    changed = np.zeros(ahead.shape, dtype=np.bool_)
    changed[1:] = (side[1:] != side[:-1]) | crossed[1:] | (far[1:] != far[:-1])
    sure, since, over, over_values = state.side.copy(), state.since.copy(), state.over.copy(), state.over_values.copy()
    if not len(state.time):
        sure[:] = side[0]
    found: list[Passing] = []
    for row, mark in np.argwhere(changed):  # a few per passing
        before, after = ahead[row - 1, mark], ahead[row, mark]
        if far[row, mark]:
            sure[mark] = 0
            continue

        def instant(first: float, last: float, k: int = int(row)) -> np.datetime64:
            """Return the time of a zero crossing between two epochs; if unknown, the time of the earlier epoch."""
            span = float(seconds(time[k] - time[k - 1]))
            known = np.isfinite(first - last) and first != last and span <= _APART_S
            return np.datetime64(time[k - 1] + timedelta(span * first / (first - last) if known else 0.0))

        if crossed[row, mark]:
            over[mark] = instant(before, after)
            nearer = values[row if abs(after) < abs(before) else row - 1]
            over_values[mark] = [*nearer, _odometer(nearer[0], over[mark], state.right)]
        left, entered = side[row - 1, mark], side[row, mark]
        if left and left != entered:
            since[mark] = instant(-left * before - level[row - 1, 0], -left * after - level[row, 0])
        if entered and sure[mark] == -entered and not np.isnat(over[mark]):
            first, last = entered * before + level[row - 1, 0], entered * after + level[row, 0]
            known = np.isfinite(first) and seconds(time[row] - time[row - 1]) <= _APART_S
            latest = instant(first, last) if known else time[row]
            read = READ if seconds(state.read[mark] - since[mark]) >= -_APART_S else MISSING
            _, speed, sigma, bound, amount, odometer = over_values[mark].tolist()
            found.append(Passing(
                balise=str(listed.name[mark]), verdict=VIRTUAL if listed.virtual[mark] else read,
                chainage_m=float(listed.chainage_m[mark]), time=over[mark], earliest=since[mark], latest=latest,
                read=state.read[mark] if read == READ else _NEVER, speed_mps=speed, sigma_m=sigma, level_m=bound,
                amount_m=amount, odometer_m=odometer,
            ))  # fmt: skip
        if entered:
            sure[mark], over[mark] = entered, _NEVER
    return found, replace(state, side=sure, since=since, over=over, over_values=over_values)


def balise_notes(antenna: str, passings: Iterable[Passing]) -> list[str]:
    """Return a sentence on each missed balise and each wrong reading."""
    notes = []
    for passing in passings:
        at, name = str(passing.time)[:21], f"{antenna}: balise {passing.balise}"
        if passing.verdict == MISSING:
            early, late = str(passing.earliest)[:21], str(passing.latest)[11:21]
            notes.append(
                f"{name} at chainage {passing.chainage_m:.1f} m was passed between {early} and {late} without a reading"
            )
        elif passing.verdict == CONTRADICTS:
            which = f", next to {passing.here}" if passing.here and passing.here != passing.balise else ""
            notes.append(
                f"{name}, read at {at}, contradicts the filter: it is listed at {passing.chainage_m:.1f} m, but the "
                f"train was {abs(passing.read_error_m):.1f} m from that point (sigma {passing.sigma_m:.1f} m){which}; "
                "the identity of the balise, or its position in the list, is wrong"
            )
        elif passing.verdict == NOT_LISTED:
            notes.append(f"{name}, read at {at}, is not listed on this line; the reading is not used")
    return notes

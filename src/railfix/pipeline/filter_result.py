"""What the filter along the track takes from single epochs, returns, and passes on; epochs that wait for others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Masks, join_rows
from railfix.core.tables import NotebookTable, median_text, plural, time_span_text
from railfix.core.timescale import seconds
from railfix.integrity.interference import Suspicion, WheelSigns, WheelState
from railfix.pipeline.balises import Passing, PassingState
from railfix.pipeline.sensed_motion import SensedMotion
from railfix.pipeline.sensor_epochs import SensorLimits, SensorState
from railfix.positioning.antenna_rows import OnDemand
from railfix.positioning.carrier import CycleSlipState
from railfix.positioning.map_offset import MapOffsetLimits, beyond_threshold
from railfix.screens import FilteredMotion
from railfix.tracking import (
    BackwardInformation,
    GnssEpochs,
    Line,
    SensorEpochs,
    Step,
    Tracked,
    TrackingLimits,
    TrackState,
    smooth_steps,
    track,
)
from railfix.tracking.levels import LevelState
from railfix.tracking.result import is_bounded
from railfix.tracking.state import StateIndex

if TYPE_CHECKING:
    from railfix.pipeline.results import AntennaResult


#: Without codes for so long the place is that of the sensors [s].
_OUTAGE_S: Final = 2.0
#: Positions that must agree before codes count again.
_AGREEING: Final = 3
#: Standard deviation of a distance by the sensors since the beginning of a stretch, as a share.
_DISTANCE_SHARE: Final = 0.01
#: Least standard deviation of a single epoch at the end of a tunnel [m]: multipath of the portal.
_LEAST_SIGMA_M: Final = 2.0
_NEVER: Final = np.datetime64("NaT", "ns")


@dataclass(frozen=True, kw_only=True)
class ReturnState:
    """What one chunk leaves to the next."""

    time: np.datetime64 = _NEVER  #: Last epoch whose codes counted; NaT before the first.
    #: Coasted place at the last epoch and its standard deviation; NaN where no sensor gives a distance.
    place_m: float = float("nan")
    sigma_m: float = float("nan")
    distance_m: float = 0.0  #: Since the filter's own place.
    returned: np.datetime64 = _NEVER  #: First epoch with codes after the outage; NaT without.
    agreeing: int = 0  #: Positions in a row that agreed since.


def gated_codes(
    time: Datetimes,
    observed: Masks,
    distance_m: Floats,
    place_m: Floats,
    sigma_m: Floats,
    state: ReturnState,
    line: Line,
    limits: SensorLimits,
) -> tuple[Masks, ReturnState]:
    """Return the epochs whose codes do not count yet, shape (T,), and the state to pass on.

    After an outage the position of each epoch by itself is compared with the place coasted on the sensors: codes count
    again with the third in a row that lies within `SensorLimits.return_sigmas` of both standard deviations together,
    and after `SensorLimits.return_s` in any case. Where no sensor gives a distance nothing is refused.

    Shape (T,): `observed`, epochs with codes; `distance_m`, by the sensors since the epoch before; `place_m`, `sigma_m`
    of each epoch by itself; NaN where there is none. `state` has the place of the filter at the epoch before the first.
    """
    refused = np.zeros(len(time), dtype=np.bool_)
    distances = state.distance_m + np.cumsum(distance_m)
    coasted = state.place_m + np.cumsum(distance_m)
    spread = np.sqrt(state.sigma_m**2 + (_DISTANCE_SHARE * distances) ** 2 + np.maximum(sigma_m, _LEAST_SIGMA_M) ** 2)
    fits = np.abs(line.nearest_m(place_m, coasted) - coasted) <= limits.return_sigmas * spread
    last, returned, agreeing = state.time, state.returned, state.agreeing
    steps = seconds(np.diff(time, prepend=last if not np.isnat(last) else time[:1]))
    if np.isnat(returned) and observed.all() and steps.max(initial=0.0) < _OUTAGE_S:
        last, observed = time[-1] if len(time) else last, observed[:0]
    for k in observed.nonzero()[0].tolist():
        out = not np.isnat(last) and (not np.isnat(returned) or float(seconds(time[k] - last)) >= _OUTAGE_S)
        if out and np.isfinite(coasted[k]):
            returned = time[k] if np.isnat(returned) else returned
            agreeing = agreeing + 1 if fits[k] else 0
            refused[k] = agreeing < _AGREEING and float(seconds(time[k] - returned)) <= limits.return_s
        if not refused[k]:
            last, returned, agreeing = time[k], _NEVER, 0
    if not len(time):
        return refused, state
    return refused, replace(
        state,
        time=last,
        place_m=float(coasted[-1]),
        distance_m=float(distances[-1]),
        returned=returned,
        agreeing=agreeing,
    )


@dataclass(frozen=True, kw_only=True)
class OffMapState:
    """State of the test after a chunk."""

    off: bool = False  #: The train was off the map at the last epoch.
    known: bool = False  #: A position has been tested; the first one of a log decides alone.
    #: First of the last positions in a row that contradict `off`; NaT where the last one agrees with it.
    since: np.datetime64 = _NEVER


def off_map_epochs(
    time: Datetimes, on_map: Masks, off_map: Masks, state: OffMapState, *, least_s: float
) -> tuple[Masks, OffMapState]:
    """Return the epochs at which the train is off the map, shape (T,), and the state to pass on.

    It leaves the map once all positions of the last `least_s` are off it, and returns once all of that time are on it:
    a single position can be off the map by reflected signals, or on it by chance. The first position of a log decides
    alone. `on_map`, `off_map`: positions that the ranges fit, and that they contradict, shape (T,).
    """
    off, known, since = state.off, state.known, state.since
    result = np.full(len(time), off)
    judged = (on_map | off_map).nonzero()[0]
    states = off_map[judged]
    edges = [0, *((states[1:] != states[:-1]).nonzero()[0] + 1).tolist(), len(judged)]
    for first, end in pairwise(edges) if len(judged) else ():
        run, says = judged[first:end], bool(states[first])
        if known and says == off:
            since = _NEVER
            continue
        since = time[run[0]] if np.isnat(since) else since
        enough = run[seconds(time[run] - since) >= least_s] if known else run
        if len(enough):
            result[enough[0] :] = says
            off, known, since = says, True, _NEVER
    return result, OffMapState(off=off, known=known, since=since)


#: Epochs whose covariances are in memory at a time.
_EPOCHS: Final = 300


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What the filter was given for some epochs."""

    epochs: GnssEpochs
    sensors: SensorEpochs
    before: TrackState | None  #: State before them.


@dataclass(frozen=True, kw_only=True)
class SmoothedTrack:
    """Places of T epochs by everything measured before and after them."""

    time: Datetimes  #: Shape (T,).
    #: Shape (T,).
    arc_m: Floats
    sigma_m: Floats
    speed_mps: Floats  #: Shape (T,).


def smooth(backward: Iterable[Replay], line: Line, limits: TrackingLimits) -> SmoothedTrack:
    """Return the places of all epochs from what the filter was given, the last first."""
    parts: list[SmoothedTrack] = []
    later: BackwardInformation | None = None
    for replay in backward:
        for epochs, before in reversed(_pieces(replay, line, limits)):
            trace: list[Step] = []
            track(epochs, line, before, limits=limits, sensors=replay.sensors, trace=trace)
            found, later = smooth_steps(trace, before or TrackState.empty(), later, limits)
            arc = found.arc_m + line.round_m(found.arc_m)
            parts.append(SmoothedTrack(time=epochs.time, arc_m=arc, sigma_m=found.sigma_m, speed_mps=found.speed_mps))
    nothing = np.empty(0)
    empty = SmoothedTrack(time=nothing.astype("M8[ns]"), arc_m=nothing, sigma_m=nothing, speed_mps=nothing)
    return join_rows([*reversed(parts), empty])


def _pieces(replay: Replay, line: Line, limits: TrackingLimits) -> list[tuple[GnssEpochs, TrackState | None]]:
    """Short pieces and the states before them; those with sensors are short already."""
    size = len(replay.epochs)
    sensed = any(getattr(replay.sensors, f.name) is not None for f in fields(SensorEpochs) if f.name != "wheel_sign")
    if size <= _EPOCHS or sensed:
        return [(replay.epochs, replay.before)] if size else []
    state, pieces = replay.before, []
    for first in range(0, size, _EPOCHS):
        epochs = replay.epochs.take(slice(first, first + _EPOCHS))
        pieces.append((epochs, state))
        _, state = track(epochs, line, state, limits=limits)
    return pieces


@dataclass(frozen=True, kw_only=True)
class FilterFix:
    """Place by the filter at its last epoch: what the place by the wheel restarts from every few seconds."""

    time: np.datetime64
    #: NaN where the filter has not decided on a place.
    arc_m: float
    sigma_m: float
    speed_mps: float

    def arc_at(self, time: np.datetime64) -> float:
        """Place at a time nearby [m]."""
        return self.arc_m + self.speed_mps * float(seconds(time - self.time))


@dataclass(frozen=True, kw_only=True)
class SingleEpochs:
    """Results of single epochs that the filter along the track uses, shape (T,) each."""

    noise_scale: Floats  #: Noise of the receiver's codes against their sigmas.
    #: Position: after an outage codes count again when it agrees with the place that the sensors carried.
    arc_m: Floats
    sigma_m: Floats
    near_ecef_m: Floats  #: 3-D position without the line, shape (T, 3).
    off_map: Masks  #: The train is away from the line: `railfix.pipeline.filter_result`.
    map_offset: Masks  #: 3-D positions of the last minutes lie beside or above the line.
    spoofed: Masks  #: Spoofing is suspected.


def single_epochs(result: AntennaResult, off_map: Masks, limits: MapOffsetLimits) -> SingleEpochs:
    """Return what the filter uses of the results of single epochs; `off_map` as in `SingleEpochs`."""
    return SingleEpochs(
        noise_scale=result.noise_scale,
        arc_m=result.arc_m,
        sigma_m=result.own_sigma_m,
        near_ecef_m=result.conventional_ecef_m,
        off_map=off_map,
        map_offset=beyond_threshold(result.map_offset, limits),
        spoofed=np.zeros(len(result), dtype=bool)
        if result.interference is None
        else result.interference.suspicion == Suspicion.SPOOFING_SUSPECTED,
    )


@dataclass(frozen=True, kw_only=True)
class FilterState(NotebookTable):
    """State of the filter along the track of one antenna after a chunk."""

    line: Line | None = None  #: The trajectory as the filter sees it, made once.
    slips: CycleSlipState | None = None  #: Of the carrier phases.
    track: TrackState | None = None
    level: LevelState = field(default_factory=LevelState)  #: Of the filter that gives the levels.
    sensors: SensorState = field(default_factory=SensorState.empty)
    #: Place of the filter at the last epoch, and at the last one before the present stretch.
    fixed: FilterFix | None = None
    anchor: FilterFix | None = None

    gate: ReturnState = field(default_factory=ReturnState)
    #: Of the comparison of distances by the wheel with those of single epochs, and of the filter.
    wheel: WheelState = field(default_factory=WheelState)
    pulled: WheelState = field(default_factory=WheelState)
    #: Last epoch at which places or speeds of the two antennas disagreed.
    disagreed: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    passings: PassingState | None = None  #: Of balises and virtual ones.

    def __repr__(self) -> str:
        if self.track is None or not self.track.hypotheses:
            return "<FilterState: no place yet>"
        return f"<FilterState: {plural(self.track.hypotheses, 'place')}, the most probable at {self._place()} m>"

    def _place(self) -> str:
        """Return the most probable place with its standard deviation."""
        track = self.track
        if track is None:
            return ""
        best = int(np.argmax(track.log_probability))
        place, variance = track.mean[best, StateIndex.ARC], track.covariance[best, StateIndex.ARC, StateIndex.ARC]
        return f"{place:,.1f} ± {np.sqrt(variance):.1f}"


#: Fields of results that are computed together.
COORDINATES: Final = ("latitude_deg", "longitude_deg", "height_m")


@dataclass(frozen=True, kw_only=True)
class AlongTrack(NotebookTable, OnDemand):
    """Positions of one antenna by the filter along the track, T epochs."""

    #: Places along the antenna's trajectory, and what measured them; channels as `AntennaResult.columns`.
    tracked: Tracked
    #: Shape (T,).
    chainage_m: Floats
    kilometrage_m: Floats
    ecef_m: Floats  #: Shape (T, 3).
    #: Shape (T,).
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    direction: Codes  #: 1 toward rising chainage, -1 toward falling, 0 where the speed does not tell; shape (T,).
    standstill: Masks  #: Shape (T,).
    sensed: SensedMotion  #: Motion since the epoch before and the line under the body, by wheel and inertial unit.
    #: Distance from the place of the other antenna less that of the antennas; NaN where it was not looked at; shape
    #: (T,).
    spacing_error_m: Floats
    wheel: WheelSigns | None = None  #: Distances by satellites against those of the wheel; None without a wheel.
    replay: tuple[Replay, ...] = ()  #: What the filter was given, to smooth it (`railfix.pipeline.filter_result`).
    passings: tuple[Passing, ...] = ()  #: Balises and virtual ones that were passed, and readings that are wrong.

    @property
    def time(self) -> Datetimes:
        """Time tags, shape (T,)."""
        return self.tracked.time

    @property
    def motion(self) -> FilteredMotion:
        """Places and speeds, for the comparison with those of another antenna."""
        found = self.tracked
        return FilteredMotion(self.chainage_m, found.sigma_m, found.speed_mps, found.speed_sigma_mps)

    def __len__(self) -> int:
        return len(self.tracked)

    def __repr__(self) -> str:
        return f"<AlongTrack: {self.status_text()}, {time_span_text(self.time)}>"

    def status_text(self) -> str:
        """Return how many epochs have a place with a bound: ``1,890 of 2,000 epochs tracking or coasting``."""
        return f"{int(is_bounded(self.tracked.status).sum()):,} of {plural(self, 'epoch')} tracking or coasting"

    def summary(self) -> dict[str, str]:
        """Return the medians of sigma and level in metres, as texts."""
        tracked = self.tracked
        return {"median sigma [m]": median_text(tracked.sigma_m), "median level [m]": median_text(tracked.level_m)}

"""The filter along the track: epochs in, places along the trajectory and the state for the next epochs out.

`railfix.kernels.tracking.layout` has the arrays, `railfix.kernels.tracking.recursion` the recursion over them. It works
on the unknowns that are in use; the state has all of them.
"""

from __future__ import annotations

from functools import lru_cache
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, copy_with
from railfix.core.timescale import seconds
from railfix.kernels.tracking import layout
from railfix.tracking import bank
from railfix.tracking.chunk import Chunk, finish_chunk, prepare_chunk
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.handover import Handover
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.result import Tracked, TrackStatus
from railfix.tracking.search import Sought, seek
from railfix.tracking.smoother import Step
from railfix.tracking.state import SATELLITES, StateIndex, TrackState
from railfix.tracking.velocity import singer

if TYPE_CHECKING:
    from collections.abc import Callable

#: Satellites come and go: the unknowns in use are chosen again after so many epochs.
_EPOCHS: Final = 512
_ANSWERS: Final = itemgetter(*layout.Outputs._fields)
#: Least `map_branch_m` in standard deviations of the map across.
_BRANCH_SIGMAS: Final = 3.0


class Recursion:
    """A chunk as the kernel takes it.

    Parameters
    ----------
    chunk : Chunk
    line : Line
    sensors : SensorEpochs
    limits : TrackingLimits
    result : Tracked
        Written to.
    levels : bool
        Whether there are sub-filters.
    """

    def __init__(
        self,
        chunk: Chunk,
        line: Line,
        sensors: SensorEpochs,
        limits: TrackingLimits,
        result: Tracked,
        *,
        levels: bool,
    ) -> None:
        self.kernel = _kernel()
        self.chunk, self.line, self.limits, self.result = chunk, line, limits, result
        self.levels = levels
        interval, singers = np.unique(chunk.interval_s, return_inverse=True)
        matrices = [singer(float(dt), limits.acceleration_mps2, limits.acceleration_s) for dt in interval]
        values: dict[str, Any] = _columns(sensors, chunk.time)
        self.sensed = np.isfinite(values["sensor"]).any(axis=0)
        values |= vars(chunk) | {
            "time_s": seconds(chunk.time - chunk.time[0]),
            "begins": chunk.apart | chunk.off_map,
            "singer": singers.reshape(-1).astype(np.intp),
            "step": [step for step, _ in matrices],
            "noise": [noise for _, noise in matrices],
        }
        # writable copies, row by row: one type of arrays for the compiler
        arrays = {name: np.array(values[name], order="C") for name in layout.Epochs._fields if name != "unsigned"}
        self.epochs = layout.Epochs(**arrays, unsigned=sensors.wheel_sign == "unknown")
        self.course = layout.LineArrays(**line.written)
        branch_m = max(limits.map_branch_m, _BRANCH_SIGMAS * line.sigma_plan_m)
        self.parameters = _parameters(limits, branch_m)
        self.answers = layout.Outputs(*_ANSWERS(vars(result)))

    def advance(self, state: TrackState, first: int, trace: list[Step] | None) -> tuple[int, bool]:
        """Do epochs from `first` on and change the state; return the next, and whether places have to be sought there.

        One at a time where the smoother needs something of each.
        """
        if trace is not None:
            return self._advance_traced(state, first, trace)
        last = min(first + _EPOCHS, len(self.chunk.time))
        handed = Handover(self, state, first, last)
        done = handed.run(layout.WHOLE)
        if done > first:
            handed.take_back(state, first, done)
        return done, done < last

    def _advance_traced(self, state: TrackState, epoch: int, trace: list[Step]) -> tuple[int, bool]:
        handed = Handover(self, state, epoch, epoch + 1, every=True)
        if handed.run(layout.WHOLE) == epoch:
            return epoch, True
        parents = Sought(lost=False, parent=np.arange(state.hypotheses), splits=None)
        self._take_back_traced(state, epoch, handed, parents, trace)
        return epoch + 1, False

    def search(self, state: TrackState, epoch: int, trace: list[Step] | None) -> None:
        """Do an epoch before which places have to be sought."""
        chunk, every = self.chunk, trace is not None
        if state.hypotheses:
            handed = Handover(self, state, epoch, epoch + 1, every=every)
            handed.run(layout.PREDICTION)
            handed.take_back_prediction(state, epoch)
        else:
            state.code_bias = np.where(chunk.fresh[epoch], 0.0, state.code_bias)
        found = seek(state, chunk, epoch, self.line, self.limits)
        state.time = chunk.time[epoch]
        if not state.hypotheses:
            if trace is not None:
                trace.append(Step.without_place(state, float(chunk.interval_s[epoch])))
            return
        if found.lost:
            state.bank = None
        handed = Handover(self, state, epoch, epoch + 1, every=every, predicted=True)
        handed.run(layout.REST_LOST if found.lost else layout.REST)
        if trace is None:
            handed.take_back(state, epoch, epoch + 1)
        else:
            self._take_back_traced(state, epoch, handed, found, trace)

    def _take_back_traced(
        self, state: TrackState, epoch: int, handed: Handover, found: Sought, trace: list[Step]
    ) -> None:
        """Take an epoch back, and add what the smoother needs of it."""
        hypotheses = state.hypotheses
        updated, cut = handed.collect_update(state, epoch)
        cut[:, SATELLITES + self.chunk.fresh[epoch].nonzero()[0]] = True
        handed.take_back(state, epoch, epoch + 1)
        step = Step(
            dt=float(self.chunk.interval_s[epoch]), cut=cut, satellite=state.satellite, parent=found.parent,
            splits=found.splits, updated=updated,
        )  # fmt: skip
        if hypotheses > 1:
            step.choose(handed.work.kept[: state.hypotheses])
        step.mean, step.covariance = state.mean, state.covariance
        trace.append(step)


def _kernel() -> Callable[..., int]:
    """Return the compiled recursion; numba is imported here, for what runs no filter does without."""
    from railfix.kernels.tracking.recursion import advance

    return advance


def _columns(sensors: SensorEpochs, time: Datetimes) -> dict[str, Floats]:
    """Measurements of the wheel, radar, force, place, balises and ranges and their standard deviations by column."""
    ranges, epochs = sensors.ranges, len(time)
    units = 0 if ranges is None else ranges.range_m.shape[1]
    value, sigma = np.full((epochs, layout.RANGE_ROW + units), np.nan), np.ones((epochs, layout.RANGE_ROW + units))
    for column, (values, sigmas) in enumerate(
        (
            (sensors.wheel_m, sensors.wheel_sigma_m),
            (sensors.radar_m, sensors.radar_sigma_m),
            (sensors.force_mps2, sensors.force_sigma_mps2),
            (sensors.place_m, sensors.place_sigma_m),
        )
    ):
        if values is not None and sigmas is not None:
            value[:, column], sigma[:, column] = values, sigmas
    unit, age, lever = np.zeros((epochs, units, 3)), np.zeros((epochs, 3 + units)), np.zeros(3)
    if sensors.balises is not None:
        own = slice(layout.PLACE_ROW + 1, layout.RANGE_ROW)
        value[:, own], sigma[:, own] = sensors.balises.place_m, sensors.balises.sigma_m
        age[:, 1:3] = np.where(np.isfinite(value[:, own]), seconds(time[:, None] - sensors.balises.time), 0.0)
    if ranges is not None:
        value[:, layout.RANGE_ROW :], sigma[:, layout.RANGE_ROW :] = ranges.range_m, ranges.sigma_m
        unit, age[:, 3:], lever = ranges.unit_ecef_m, ranges.age_s, ranges.lever_m
    return {
        "sensor": value, "sensor_sigma": sigma, "range_unit_ecef_m": unit, "sensor_age_s": age, "lever_m": lever
    }  # fmt: skip


@lru_cache(maxsize=8)
def _parameters(limits: TrackingLimits, branch_m: float) -> layout.Parameters:
    """Return the settings as the kernel takes them."""
    budget = bank.budget(limits)
    given: dict[str, Any] = {
        "degrees": tuple(limits.tails),
        "map_branch_m": branch_m,
        "level_risk": budget.risk,
        "level_k": budget.k,
        "level_k_speed": budget.k_speed,
    }
    names = layout.Parameters._fields
    return layout.Parameters(**{name: given[name] if name in given else getattr(limits, name) for name in names})


def track(
    epochs: GnssEpochs,
    line: Line,
    state: TrackState | None = None,
    *,
    limits: TrackingLimits | None = None,
    sensors: SensorEpochs | None = None,
    levels: bool = False,
    trace: list[Step] | None = None,
) -> tuple[Tracked, TrackState]:
    """Return places along the trajectory, each from its own and earlier epochs.

    The recursion is compiled (`railfix.kernels.tracking.recursion`); with ``NUMBA_DISABLE_JIT=1`` in the environment
    the same code runs as plain Python, for a debugger.

    Parameters
    ----------
    epochs : GnssEpochs
        T epochs in rising time; those without any measurement are predicted.
    line : Line
    state : TrackState, optional
        Left by the epochs before; None at the start.
    limits : TrackingLimits, optional
    sensors : SensorEpochs, optional
    levels : bool
        Whether a bank of sub-filters gives a level at every epoch (`railfix.tracking.levels`: at a lower rate).
    trace : list of Step, optional
        Gets what the smoother needs of each epoch (`railfix.tracking.smoother`).

    Returns
    -------
    Tracked
    TrackState
        Epochs one by one with the state handed on give the same numbers as all at once.
    """
    limits, sensors = limits or TrackingLimits(), sensors or SensorEpochs()
    state = TrackState.empty() if state is None else copy_with(state)
    result = Tracked.empty(epochs.time, len(epochs.satellite))
    if len(epochs):
        chunk = prepare_chunk(epochs, state, limits)
        recursion = Recursion(chunk, line, sensors, limits, result, levels=levels)
        epoch, sought = 0, False
        while epoch < len(epochs):
            lost = not np.isfinite(state.mean[:, StateIndex.ARC]).all()
            if lost or chunk.apart[epoch] or chunk.off_map[epoch]:
                state.reset()
            if chunk.off_map[epoch]:
                state.time, result.status[epoch] = chunk.time[epoch], TrackStatus.OFF_MAP
                if trace is not None:
                    trace.append(Step.without_place(state, float(chunk.interval_s[epoch])))
                epoch += 1
                continue
            if state.hypotheses and not sought:
                epoch, sought = recursion.advance(state, epoch, trace)
            else:
                recursion.search(state, epoch, trace)
                epoch, sought = epoch + 1, False
        finish_chunk(chunk, epochs, state, limits)
    np.add(result.arc_m, line.round_m(result.arc_m), out=result.arc_m)
    return result, state

"""Signs of interference (`railfix.integrity.interference`) in the ranges and positions of a chunk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Bits, Bytes, Codes, Floats, Indices, Integers, Masks, copy_with, read_only
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.epoch_rows import join_epochs, take_epochs
from railfix.core.notebook import NotebookTable
from railfix.core.reasons import Reason, Status
from railfix.core.timescale import GPS_EPOCH
from railfix.integrity.interference import (
    CAUSES,
    HeldState,
    InterferenceLimits,
    MotionSigns,
    MotionSignState,
    PowerSigns,
    PowerState,
    Sign,
    Suspicion,
    hold_signs,
    motion_signs,
    power_signs,
    suspicion,
)
from railfix.integrity.interference.motion import MotionFit, fit_motion
from railfix.integrity.interference.range_fits import MotionInputs
from railfix.pipeline.solution import Solution
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.search_index import SearchIndex
from railfix.ranges.corrected import CorrectedRanges

#: Rejection reasons of ranges that contradict other ranges; spoofed ranges can have these reasons.
_CONTRADICTED: Final = int(
    Reason.FAULT_EXCLUDED | Reason.LASTING_ERROR | Reason.GROSS_ERROR | Reason.ALONE_ON_ITS_CLOCK
)
#: Rejection reasons that count as individual errors if only few satellites have them.
_WRONG_ALONE: Final = int(Reason.FAULT_EXCLUDED | Reason.LASTING_ERROR | Reason.GROSS_ERROR)
#: Errors of more satellites than this are not individual errors; a spoofer's consistent position affects more.
_MOST_WRONG: Final = 2
#: Gross errors of more satellites of one clock than this are not individual errors.
_MOST_GROSS: Final = 4
_NOT_ITS_SIGNAL: Final = int(Reason.OTHER_SIGNAL_TAKEN)
#: Position statuses that are replaced if spoofing is suspected.
_UNDER_SPOOFING: Final = np.isin(np.arange(len(Status)), [
    Status.OK, Status.AMBIGUOUS, Status.OFF_MAP, Status.INCONSISTENT, Status.ANTENNAS_DISAGREE, Status.UNCERTAIN,
    Status.MAP_OFFSET, Status.MAP_END,
])  # fmt: skip
#: Statuses of positions that failed a check of their ranges.
_FAILED: Final = np.isin(np.arange(len(Status)), [
    Status.OFF_MAP, Status.INCONSISTENT, Status.MAP_OFFSET, Status.NO_CONVERGENCE,
])  # fmt: skip
_IN_DOUBT: Final = _FAILED | (np.arange(len(Status)) == Status.UNCERTAIN)
#: For each suspicion: a mask of the statuses that it replaces, and the new status.
_STATUS_BY_CAUSE: Final = (
    (Suspicion.JAMMING_SUSPECTED, np.arange(len(Status)) == Status.OK, Status.JAMMING_SUSPECTED),
    (Suspicion.SPOOFING_SUSPECTED, _UNDER_SPOOFING, Status.SPOOFING_SUSPECTED),
    (Suspicion.TIME_TAGS, _UNDER_SPOOFING, Status.INCONSISTENT),
    (Suspicion.LEFT_MAP, _UNDER_SPOOFING, Status.OFF_MAP),
)
#: Interval between the checks for interference [ns].
_SECOND_NS: Final = 1_000_000_000
#: Origin of GPS seconds [ns]: 5 ms before the start of GPS time, because a time tag may be slightly early.
_FIRST_NS: Final = int(GPS_EPOCH.astype(np.int64)) - 5_000_000


@dataclass(frozen=True, kw_only=True)
class InterferenceState:
    """State of the interference signs after a chunk."""

    power: PowerState = field(default_factory=PowerState)
    motion: MotionSignState = field(default_factory=MotionSignState)
    held: HeldState = field(default_factory=HeldState)
    second: int = -1  #: GPS second of the last checked epoch; -1 before the first.
    broken: bool = False  #: True after a data break since the last checked epoch.
    alarm: int = 0  #: Receiver alarms since the last checked epoch.
    latest: Interference | None = None  #: Result at the last checked epoch.


@dataclass(frozen=True, kw_only=True, repr=False)
class Interference(NotebookTable):
    """Signs of interference at T epochs."""

    causes: Bits  #: `Sign` bits, shape (T,); each stays set for a release time after its sign ends.
    power: PowerSigns
    motion: MotionSigns

    @property
    def suspicion(self) -> Codes:
        """`Suspicion` of each epoch, shape (T,)."""
        return suspicion(self.causes)


def _motion_inputs(
    corrected: CorrectedRanges, single: Solution, antennas: AntennaRows, rows: Indices, broken: Masks
) -> MotionInputs:
    """Return inputs for the signs of interference in motion, at selected epochs. `corrected` has the rejection reasons
    of all stages; `broken` marks data breaks since the previous selected epoch.
    """
    code, reason = corrected.code_m[rows], corrected.reason[rows]
    consistent, off_line, antenna = single.consistent_ecef_m[rows], np.empty(len(rows)), np.empty(len(rows), np.intp)
    near = np.where(np.isnan(consistent), single.point.ecef_m[rows], consistent)
    first = 0
    lines: list[SearchIndex] = []
    for index, own in antennas.split(rows):
        part = slice(first, first := first + len(own))
        antenna[part] = len(lines)
        lines.append(index)
        arc, offset = index.trajectory.nearest(near[part])
        inside = (arc > 0.0) & (arc < index.trajectory.arc_m[-1]) & np.isfinite(consistent[part, 0])
        off_line[part] = np.where(inside, offset, np.nan)
    usable = (reason & ~_CONTRADICTED) == 0
    # errors that cannot be attributed to single satellites may be due to a spoofer or to the time tags
    named = _named_as_wrong(reason, corrected.channels.groups) & ~corrected.unsure[rows, None]
    return MotionInputs(
        time=corrected.time[rows], break_before=broken, channel=corrected.channels.names,
        group=corrected.channels.clock_number,
        near_ecef_m=near, sat_ecef_m=corrected.satellites.position_ecef_m[rows],
        sat_velocity_mps=corrected.satellites.velocity_ecef_mps[rows],
        code_m=np.where(((reason & _NOT_ITS_SIGNAL) == 0) & ~named, code, np.nan),
        rate_mps=-SPEED_OF_LIGHT / corrected.frequency_hz * corrected.doppler_hz[rows],
        corrected_code_m=corrected.corrected_code_m[rows], sigma_m=corrected.sigma_m[rows],
        used=usable & ~named, named=usable & named, noise_scale=single.noise_scale[rows],
        clock_offset_m=single.ties.offset_m[rows], clock_sigma_m=single.ties.sigma_m[rows], off_line_m=off_line,
        doubted=corrected.unsure[rows] | _IN_DOUBT[single.status[rows]] | named.any(axis=1), antenna=antenna,
        lines=tuple(lines),
    )  # fmt: skip


def _named_as_wrong(reason: Bits, groups: Sequence[slice]) -> Masks:
    """Return a mask (T, K) of individual errors; False if as many satellites have errors as under spoofing."""
    wrong, gross = (reason & _WRONG_ALONE) != 0, (reason & int(Reason.GROSS_ERROR)) != 0
    named = wrong & (wrong.sum(axis=1, keepdims=True) <= _MOST_WRONG)
    for group in groups:
        named[:, group] |= gross[:, group] & (gross[:, group].sum(axis=1, keepdims=True) <= _MOST_GROSS)
    return np.asarray(named)


def _find_interference(
    cn0: Floats,
    gain: Floats,
    alarm: Bytes,
    failed: Masks,
    inputs: MotionInputs,
    fitted: MotionFit,
    state: InterferenceState,
    limits: InterferenceLimits,
) -> tuple[Interference, InterferenceState]:
    """Return the interference at selected epochs of one antenna, and the state for the next chunk.

    `cn0` is the C/N0 of the codes, shape (T, K). `gain` is the front-end gain. `alarm` has the receiver alarms since
    the previous epoch, and `failed` marks positions that failed a check.
    """
    power, power_state = power_signs(inputs.time, inputs.channel, cn0, gain, state.power, limits)
    motion, motion_state = motion_signs(inputs, state.motion, limits, fitted)
    signs = _signs(alarm, failed, power, motion, limits)
    hold, release = _times(limits)
    _, stays, held_state = hold_signs(inputs.time, signs, state.held, hold_s=hold, release_s=release)
    causes = (stays * np.array([int(cause) for cause in CAUSES])).sum(axis=1, dtype=np.int64)
    after = replace(state, power=power_state, motion=motion_state, held=held_state)
    return Interference(causes=causes, power=power, motion=motion), after


def _signs(alarm: Bytes, failed: Masks, power: PowerSigns, motion: MotionSigns, limits: InterferenceLimits) -> Masks:
    """Return the signs of each epoch before holding times are applied, shape (T, causes)."""
    sigmas = limits.jump_sigmas
    by_cause = {
        Sign.RECEIVER_JAMMING: (alarm & 1) != 0,
        Sign.CN0_FALL: (power.fall_db >= limits.fall_db) & (power.spread_db <= limits.spread_db),
        Sign.GAIN_FALL: power.gain_fall >= limits.gain_fall,
        Sign.RECEIVER_SPOOFING: (alarm & 2) != 0,
        Sign.EQUAL_CN0: power.difference_db <= limits.equal_db,
        Sign.CLOCK_JUMP: (np.abs(motion.clock_jump_m) >= limits.clock_jump_m)
        | ((motion.drift_jump_mps >= limits.drift_jump_mps) & (motion.drift_jump_sigmas >= sigmas)),
        Sign.SPEED_JUMP: (motion.speed_jump_mps >= limits.speed_jump_mps) & (motion.speed_jump_sigmas >= sigmas),
        Sign.POSITION_JUMP: (motion.position_jump_m >= limits.position_jump_m)
        & (motion.position_jump_sigmas >= sigmas),
        Sign.CONSTELLATIONS_PART: motion.part_sigmas >= limits.part_sigmas,
        Sign.WHEEL_PARTS: np.zeros(len(alarm), dtype=np.bool_),  # set by the filter along the track
        Sign.LEFT_MAP: (motion.off_line_m >= limits.off_map_m) & (motion.off_line_sigmas >= sigmas),
        Sign.TIME_TAGS: (np.abs(motion.tag_error_s) >= limits.tag_error_s)
        & (motion.tag_error_sigmas >= limits.tag_sigmas),
        Sign.CONTRADICTED: failed,
    }
    return np.array([by_cause[cause] for cause in CAUSES]).T


@lru_cache
def _times(limits: InterferenceLimits) -> tuple[Floats, Floats]:
    """Return the holding and release times of all causes [s]."""
    hold = {
        Sign.CN0_FALL: limits.hold_s, Sign.GAIN_FALL: limits.hold_s, Sign.EQUAL_CN0: limits.hold_s,
        Sign.LEFT_MAP: limits.hold_s, Sign.CONSTELLATIONS_PART: limits.part_hold_s,
        Sign.CONTRADICTED: limits.contradicted_s,
    }  # fmt: skip
    release = {Suspicion.SPOOFING_SUSPECTED: limits.spoofing_release_s, Suspicion.CONTRADICTED: 0.0}
    kinds = suspicion(np.array(CAUSES, dtype=np.int64)).tolist()
    return (
        read_only(np.array([hold.get(cause, 0.0) for cause in CAUSES])),
        read_only(np.array([release.get(Suspicion(kind), limits.jamming_release_s) for kind in kinds])),
    )


class _Due(NamedTuple):
    """Epochs of one antenna at which interference is checked: the first epoch of each second."""

    rows: Indices  #: Indices of these epochs among the rows of all antennas, shape (n,).
    group: Indices  #: Number of checked epochs up to each epoch of the antenna, shape (T,).
    #: Receiver alarms between checked epochs: before each checked epoch and after the last, shape (n + 1,). `broken`
    #: has the data breaks in the same intervals.
    alarm: Bytes
    broken: Masks
    last: int  #: GPS second of the last epoch of the chunk.


def _due(second: Integers, rows: slice, alarms: Bytes, breaks: Masks, state: InterferenceState) -> _Due:
    """Return the epochs of one antenna at which interference is checked; `second` has the GPS seconds, shape (T,)."""
    due = np.empty(len(second), dtype=np.bool_)
    due[:1], due[1:] = second[:1] != state.second, second[1:] != second[:-1]
    group = due.cumsum()
    count = int(group[-1]) + 1 if len(group) else 1
    alarm, broken = np.zeros(count, dtype=np.uint8), np.zeros(count, dtype=np.bool_)
    alarm[0], broken[0] = state.alarm, state.broken
    # epochs after a checked epoch belong to the next checked epoch
    np.bitwise_or.at(alarm, group - due, alarms)
    np.logical_or.at(broken, group - due, breaks)
    last = int(second[-1]) if len(second) else state.second
    return _Due(due.nonzero()[0] + (rows.start or 0), group, alarm, broken, last)


def _on_all_epochs(
    due: _Due, found: Interference | None, state: InterferenceState
) -> tuple[Interference, InterferenceState]:
    """Return the interference of each epoch of one antenna: the result of the first epoch of the same second."""
    known = [each for each in (state.latest, found) if each is not None]
    if len(due.group) == 1:
        every = latest = known[-1]
    else:
        row = due.group - (state.latest is None)
        every = join_epochs(known)
        every, latest = take_epochs(every, row), take_epochs(every, row[-1:])
    count = len(due.rows)
    after = copy_with(
        state, second=due.last, alarm=int(due.alarm[count]), broken=bool(due.broken[count]), latest=latest
    )
    return every, after


def with_statuses(status: Codes, suspected: Sequence[Codes]) -> Codes:
    """Return the statuses of positions (T,); interference statuses replace the statuses that they outrank.

    `suspected` has the `Suspicion` of each antenna's epochs; it is empty if the check is off.
    """
    if not suspected:
        return status
    kind = np.concatenate(suspected)
    for cause, outranked, by_cause in _STATUS_BY_CAUSE:
        status = np.where((kind == int(cause)) & outranked[status], np.int8(by_cause), status)
    return status


def judge_interference(
    corrected: CorrectedRanges,
    single: Solution,
    antennas: AntennaRows,
    states: list[InterferenceState],
    limits: InterferenceLimits,
) -> tuple[Sequence[Interference | None], list[InterferenceState]]:
    """Return the interference and the new state of each antenna; None where `InterferenceLimits.use` is off.

    Interference is checked at the first epoch of each second, and the result applies to all epochs of the second. A
    break or an alarm between two checks is taken into account in the second check.
    """
    if limits.use == "off":
        return [None] * len(states), states
    second = (corrected.time.astype(np.int64) - _FIRST_NS) // _SECOND_NS
    alarms, breaks = corrected.observations.receiver_alarm, corrected.break_before
    due = antennas.apart(lambda _, rows, own: _due(second[rows], rows, alarms[rows], breaks[rows], own), states)
    rows = np.concatenate([own.rows for own in due])
    broken = np.concatenate([own.broken[:-1] for own in due])
    if any(len(own.rows) or not len(own.group) for own in due):
        inputs = _motion_inputs(corrected, single, antennas, rows, broken)
        fitted = fit_motion(inputs, limits)
    other_signal = (corrected.reason & _NOT_ITS_SIGNAL) != 0
    cn0 = np.where(other_signal | np.isnan(corrected.code_m), np.nan, corrected.cn0_dbhz)
    gain = corrected.observations.front_end_gain
    found: list[Interference] = []
    after: list[InterferenceState] = []
    first = 0
    for own, state in zip(due, states, strict=True):
        new, at = None, slice(first, first := first + len(own.rows))
        if len(own.rows) or not len(own.group):
            new, state = _find_interference(
                cn0[own.rows], gain[own.rows], own.alarm[:-1], _FAILED[single.status[own.rows]], inputs.take(at),
                fitted.take(at), state, limits,
            )  # fmt: skip
        if len(own.group):
            new, state = _on_all_epochs(own, new, state)
        assert new is not None, "the first epoch is always checked"
        found.append(new)
        after.append(state)
    return found, after

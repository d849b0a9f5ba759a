"""Interference of each epoch: the signs of `railfix.integrity.interference` on the ranges and positions of a chunk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Bits, Bytes, Codes, Floats, Indices, Masks, changed, read_only
from railfix.core.constants import SPEED_OF_LIGHT
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
    held,
    motion_signs,
    power_signs,
    suspicion,
)
from railfix.integrity.interference.motion import MotionInputs
from railfix.positioning.antenna_rows import AntennaRows, joined, rows_of

if TYPE_CHECKING:
    from railfix.pipeline.corrected_ranges import CorrectedRanges
    from railfix.pipeline.filter_result import AlongTrack
    from railfix.pipeline.results import AntennaResult
    from railfix.pipeline.solution import Solution
    from railfix.positioning.section_search import SearchIndex

#: Reasons given because ranges contradict others: those of a spoofer do.
_CONTRADICTED: Final = int(Reason.FAULT_EXCLUDED | Reason.LASTING_ERROR | Reason.ALONE_ON_ITS_CLOCK)
_NOT_ITS_SIGNAL: Final = int(Reason.OTHER_SIGNAL_TAKEN)
#: Statuses of positions that spoofing outranks, and those that jamming does.
_UNDER_SPOOFING: Final = np.isin(np.arange(len(Status)), [
    Status.OK, Status.AMBIGUOUS, Status.OFF_MAP, Status.INCONSISTENT, Status.ANTENNAS_DISAGREE, Status.UNCERTAIN,
    Status.MAP_OFFSET,
])  # fmt: skip
#: Interference is looked for once so long; tags may be so much before the whole second.
_SECOND, _TAG = np.timedelta64(1, "s"), np.timedelta64(5, "ms")


@dataclass(frozen=True, kw_only=True)
class InterferenceState:
    """State of the signs after a chunk."""

    power: PowerState = field(default_factory=PowerState)
    motion: MotionSignState = field(default_factory=MotionSignState)
    held: HeldState = field(default_factory=HeldState)
    second: int = -1  #: GPS second of the last epoch that was looked at.
    #: Break and the receiver's alarms since then.
    broken: bool = False
    alarm: int = 0
    latest: Interference | None = None  #: Of that epoch.


@dataclass(frozen=True, kw_only=True)
class Interference:
    """Interference of T epochs."""

    causes: Bits  #: `Sign` bits, each for as long as its time of release; shape (T,).
    power: PowerSigns
    motion: MotionSigns

    @property
    def suspicion(self) -> Codes:
        """`Suspicion` of each epoch, shape (T,)."""
        return suspicion(self.causes)


def find_interference(
    corrected: CorrectedRanges,
    solution: Solution,
    rows: Indices,
    heard: tuple[Bytes, Masks],
    index: SearchIndex,
    state: InterferenceState,
    limits: InterferenceLimits,
) -> tuple[Interference, InterferenceState]:
    """Return the interference of some epochs of one antenna, whose ranges have all reasons, and the state to pass on.

    `heard`: alarms of the receiver and breaks since the epoch before, of each.
    """
    (alarm, broken), time, reason = heard, corrected.time[rows], corrected.reason[rows]
    channel, code = corrected.channels.names, corrected.code_m[rows]
    taken = (reason & _NOT_ITS_SIGNAL) == 0
    cn0 = np.where(taken & np.isfinite(code), corrected.cn0_dbhz[rows], np.nan)
    power, power_state = power_signs(
        time, channel, cn0, corrected.observations.front_end_gain[rows], state.power, limits
    )
    clocks = list(corrected.clocks)
    near = solution.point.ecef_m[rows]
    arc, offset = index.trajectory.nearest(near)
    inside = (arc > 0.0) & (arc < index.trajectory.arc_m[-1])
    motion, motion_state = motion_signs(
        MotionInputs(
            time=time,
            break_before=broken,
            channel=channel,
            group=np.array([clocks.index(letter) for letter in corrected.channels.clock.tolist()], dtype=np.intp),
            near_ecef_m=near,
            sat_ecef_m=corrected.satellites.position_ecef_m[rows],
            sat_velocity_mps=corrected.satellites.velocity_ecef_mps[rows],
            code_m=np.where(taken, code, np.nan),
            rate_mps=-SPEED_OF_LIGHT / corrected.frequency_hz * corrected.doppler_hz[rows],
            corrected_code_m=corrected.corrected_code_m[rows],
            sigma_m=corrected.sigma_m[rows],
            used=(reason & ~_CONTRADICTED) == 0,
            noise_scale=solution.noise_scale[rows],
            clock_offset_m=solution.ties.offset_m[rows],
            clock_sigma_m=solution.ties.sigma_m[rows],
            off_line_m=np.where(inside, offset, np.nan),
        ),
        state.motion,
        limits,
    )
    signs = _signs(alarm, power, motion, limits)
    hold, release = _times(limits)
    _, stays, held_state = held(time, signs, state.held, hold_s=hold, release_s=release)
    causes = (stays * np.array([int(cause) for cause in CAUSES])).sum(axis=1, dtype=np.int64)
    after = replace(state, power=power_state, motion=motion_state, held=held_state)
    return Interference(causes=causes, power=power, motion=motion), after


def _signs(alarm: Bytes, power: PowerSigns, motion: MotionSigns, limits: InterferenceLimits) -> Masks:
    """Return which signs the epochs show by themselves, shape (T, causes)."""
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
        Sign.WHEEL_PARTS: np.zeros(len(alarm), dtype=np.bool_),  # `with_wheel`, after the filter
        Sign.LEFT_MAP: (motion.off_line_m >= limits.off_map_m) & (motion.off_line_sigmas >= sigmas),
    }
    return np.stack([by_cause[cause] for cause in CAUSES], axis=1)


@lru_cache
def _times(limits: InterferenceLimits) -> tuple[Floats, Floats]:
    """Return times of holding and of release by cause [s]."""
    hold = {
        Sign.CN0_FALL: limits.hold_s, Sign.GAIN_FALL: limits.hold_s, Sign.EQUAL_CN0: limits.hold_s,
        Sign.LEFT_MAP: limits.hold_s, Sign.CONSTELLATIONS_PART: limits.part_hold_s,
    }  # fmt: skip
    release = {
        Suspicion.JAMMING_SUSPECTED: limits.jamming_release_s,
        Suspicion.SPOOFING_SUSPECTED: limits.spoofing_release_s,
    }
    kinds = suspicion(np.array(CAUSES, dtype=np.int64)).tolist()
    return (
        read_only(np.array([hold.get(cause, 0.0) for cause in CAUSES])),
        read_only(np.array([release[Suspicion(kind)] for kind in kinds])),
    )


def _once_a_second(
    corrected: CorrectedRanges,
    solution: Solution,
    index: SearchIndex,
    rows: slice,
    state: InterferenceState,
    limits: InterferenceLimits,
) -> tuple[Interference, InterferenceState]:
    """Return the interference of the epochs of one antenna, `rows`: looked for at the first epoch of each second.

    The others have what was found there; a break or an alarm between counts at the next one.
    """
    time = corrected.time[rows]
    if not len(time):
        nothing = np.empty(0, np.uint8), np.empty(0, np.bool_)
        return find_interference(corrected, solution, np.empty(0, np.intp), nothing, index, state, limits)
    second = (time - GPS_EPOCH + _TAG) // _SECOND
    due = second != np.concatenate([[state.second], second[:-1]])
    group = np.cumsum(due)
    alarm, broken = np.zeros(group[-1] + 2, dtype=np.uint8), np.zeros(group[-1] + 2, dtype=np.bool_)
    alarm[0], broken[0] = state.alarm, state.broken
    # what came after a due epoch belongs to the next one
    np.bitwise_or.at(alarm, group - due, corrected.observations.receiver_alarm[rows])
    np.logical_or.at(broken, group - due, corrected.break_before[rows])
    at = np.flatnonzero(due)
    found, after = [], state
    if len(at):
        heard, at = (alarm[:-2], broken[:-2]), at + (rows.start or 0)
        own, after = find_interference(corrected, solution, at, heard, index, state, limits)
        found = [own]
    known = found if state.latest is None else [state.latest, *found]
    every = joined(known)
    row = group - (state.latest is None)
    after = changed(
        after, second=int(second[-1]), alarm=int(alarm[group[-1]]), broken=bool(broken[group[-1]]),
        latest=rows_of(every, row[-1:]),
    )  # fmt: skip
    return rows_of(every, row), after


def with_statuses(status: Codes, kind: Codes) -> Codes:
    """Return the statuses of positions with those of interference where they outrank, shape (T,)."""
    jammed = (kind == Suspicion.JAMMING_SUSPECTED) & (status == Status.OK)
    spoofed = (kind == Suspicion.SPOOFING_SUSPECTED) & _UNDER_SPOOFING[status]
    status = np.where(jammed, np.int8(Status.JAMMING_SUSPECTED), status)
    return np.where(spoofed, np.int8(Status.SPOOFING_SUSPECTED), status)


def with_wheel(results: Mapping[str, AntennaResult], fusion: Mapping[str, AlongTrack]) -> dict[str, AntennaResult]:
    """Return the results of single epochs with the sign of the wheel, which the filter along the track gives."""
    after = dict(results)
    for name, tracked in fusion.items():
        result, wheel = results[name], tracked.wheel
        found = result.interference
        if wheel is None or found is None or not wheel.parted.any():
            continue
        found = replace(found, causes=np.where(wheel.parted, found.causes | int(Sign.WHEEL_PARTS), found.causes))
        status = with_statuses(result.status, found.suspicion)
        after[name] = changed(result, interference=found, status=status)
    return after


def judge_interference(
    corrected: CorrectedRanges,
    solution: Solution,
    antennas: AntennaRows,
    states: list[InterferenceState],
    limits: InterferenceLimits,
) -> tuple[Solution, list[InterferenceState]]:
    """Return positions with interference and its statuses, and the new state of each antenna."""
    if limits.use == "off":
        return solution, states

    def of_antenna(index: SearchIndex, rows: slice, state: InterferenceState) -> tuple[Interference, InterferenceState]:
        return _once_a_second(corrected, solution, index, rows, state, limits)

    found, after = antennas.each_with_state(of_antenna, states)
    status = with_statuses(solution.status, found.suspicion)
    return changed(solution, status=status, interference=found), after

"""Positions along the line from code and phase of the current and earlier epochs.

The state between epochs is the normal matrix of the ambiguities of the active arcs. Process noise is added to the
ambiguities at multiples of `PhaseLimits.hop_s`. When an arc begins, the previous arc of its channel is eliminated, so
that the state never has more arcs than channels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks
from railfix.core.timescale import GPS_EPOCH, seconds
from railfix.positioning.carrier.ambiguities import (
    FORGET_S,
    FREE_AMBIGUITY_M,
    ArcAmbiguities,
    PhaseLimits,
    PhasePositions,
    assemble_positions,
    count_repeats,
    fix_integers,
    inverse_of_arcs,
    number_hops,
    prepare_start,
)
from railfix.positioning.carrier.continuity import NO_ARC, decode_channel
from railfix.positioning.carrier.observation_model import (
    IntegerChannels,
    Phases,
    linearise,
    own_clock,
    own_unknowns,
    reduce,
    shift_phases,
)
from railfix.positioning.range_arrays import Ranges
from railfix.track.trajectory import Trajectory

SEGMENT_EPOCHS: Final = 64  #: Largest number of epochs computed together.


@dataclass(frozen=True, kw_only=True)
class Memory:
    """Information on A active arcs from all epochs so far."""

    #: Time of the last epoch, NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    arc_id: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))  #: Number of each arc, shape (A,).
    #: Time of the last phase of each arc, shape (A,).
    seen: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))
    first_m: Floats = field(default_factory=lambda: np.empty(0))  #: First value of each ambiguity, shape (A,).
    matrix: Floats = field(default_factory=lambda: np.empty((0, 0)))  #: Normal matrix, shape (A, A) [1/m^2].
    #: Right-hand sides for the observations and for map errors of 1 m across and in height, shape (A, 3) [1/m].
    right: Floats = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, kw_only=True)
class PhaseState:
    """One `Memory` per linearisation pass; empty before the first epoch."""

    memories: tuple[Memory, ...] = ()


def phase_positions(
    time: Datetimes,
    ranges: Ranges,
    phases: Phases,
    trajectory: Trajectory,
    arc_m_start: Floats,
    state: PhaseState | None = None,
    *,
    limits: PhaseLimits | None = None,
) -> tuple[PhasePositions, PhaseState]:
    """Compute the position of each epoch of a chunk from the observations up to the epoch.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    ranges : Ranges
        Corrected codes with weights, satellite positions, clock groups and inter-system biases.
    phases : Phases
        Corrected phases with arc numbers (`number_arcs`). Only the newest arc of a channel is active.
    trajectory : Trajectory
    arc_m_start : ndarray, shape (T,) [m]
        Initial position of each epoch, which is the constrained position from codes alone. Epochs with NaN are not
        used.
    state : PhaseState, optional
    limits : PhaseLimits, optional

    Returns
    -------
    PhasePositions
    PhaseState
        State for the next chunk. The division into chunks changes the positions by less than 1e-9 m.
    """
    limits = limits or PhaseLimits()
    memories = state.memories if state and state.memories else (Memory(),) * limits.passes
    if len(memories) != limits.passes:
        raise ValueError(f"the state has {len(memories)} passes, the limits require {limits.passes}")
    started = np.isfinite(arc_m_start)
    ranges, phases, arc = prepare_start(ranges, phases, trajectory, arc_m_start)
    cuts = _cuts(number_hops(time, limits))
    integers, phases = phases.integers, replace(phases, integers=None)  # integers are fixed only in the last pass
    after: list[Memory] = []
    pieces: list[PhasePositions] = []
    for number, before in enumerate(memories, 1):
        if number == len(memories):
            phases = replace(phases, integers=integers)
        pieces, places, memory = [], [], before
        for rows in cuts:
            start = arc[rows], started[rows]
            piece, place, memory = _segment(
                time[rows], ranges.take(rows), phases.take(rows), start, trajectory, memory, limits
            )
            pieces.append(piece)
            places.append(place)
        after.append(memory)
        arc = np.concatenate(places)
    return _join(pieces), PhaseState(memories=tuple(after))


def _cuts(hop: Integers) -> list[Indices]:
    """Divide epochs into segments: at most `SEGMENT_EPOCHS` epochs, all in the same time step of the random walk."""
    blocks = np.arange(0, len(hop), SEGMENT_EPOCHS)
    starts = np.union1d(np.flatnonzero(np.diff(hop)) + 1, blocks)
    return np.split(np.arange(len(hop)), starts[1:])


def _segment(
    time: Datetimes,
    ranges: Ranges,
    phases: Phases,
    start: tuple[Floats, Masks],
    trajectory: Trajectory,
    memory: Memory,
    limits: PhaseLimits,
) -> tuple[PhasePositions, Floats, Memory]:
    """Return one segment's positions, the arc lengths for the next linearisation, and the memory after the segment."""
    arc_m, started = start
    used = phases.weight > 0
    lin = linearise(ranges, phases, trajectory, arc_m, clocks=limits.clocks)
    memory = _walk(memory, time, limits)
    before = np.asarray([memory.time], dtype="datetime64[ns]")
    ids, first, column = np.unique(phases.arc_id[used], return_index=True, return_inverse=True)
    rows = np.nonzero(used)[0]
    known = np.isin(ids, memory.arc_id)
    first_m, begin = lin.phase_m[used][first], np.where(known, -1, rows[first])
    first_m[known] = memory.first_m[np.searchsorted(memory.arc_id, ids[known])]
    base = np.zeros(used.shape)
    base[used] = first_m[column]
    lin = shift_phases(lin, base)
    matrix, right = reduce(lin)

    # segments are cut at the starts of arcs, so that matrix sizes do not depend on the division into segments
    parts = []
    for part in np.split(np.arange(len(time)), np.unique(begin[begin > 0])):
        new = np.isin(begin, part[:1])
        memory = _with_arcs(memory, ids[new], first_m[new])
        arc_id = np.where(used[part], phases.arc_id[part], NO_ARC)
        value, covariance, arcs, memory = _ambiguities(matrix[part], right[part], arc_id, memory, held=own_clock(lin))
        parts.append((value, covariance))
    value, covariance = (np.concatenate(each) for each in zip(*parts, strict=True))
    fixes = _fix_epochs((base, value, covariance), phases, trajectory, limits)
    repeats = count_repeats(np.concatenate([before, time]), limits)[1:]
    own = own_unknowns(lin, value, covariance, trajectory, repeats=repeats)
    arc = np.clip(arc_m + own.step_m, 0.0, trajectory.arc_m[-1])
    ambiguity = base + value[..., 0], np.diagonal(covariance, axis1=1, axis2=2)
    piece = assemble_positions(arc, started, own, lin, ambiguity, arcs, fixes, limits)
    if len(time):
        last = np.zeros(len(ids), dtype=np.intp)
        np.maximum.at(last, column, rows)
        seen = memory.seen.copy()
        here = np.isin(memory.arc_id, ids)
        seen[here] = time[last[np.isin(ids, memory.arc_id)]]
        memory = replace(memory, time=time[-1], seen=seen)
    return piece, arc, memory


def _ambiguities(
    matrix: Floats, right: Floats, arc_id: Integers, memory: Memory, *, held: bool
) -> tuple[Floats, Floats, ArcAmbiguities, Memory]:
    """Return corrections to the ambiguities' first values and the covariances for each epoch; also arcs and memory.

    The corrections have the shape (T, M, 3), the covariances (T, M, M). The ambiguities are computed from the normal
    equations of the epoch and all earlier epochs. Arcs and memory refer to the time after the last epoch. If `held` is
    true, the mean of the ambiguities is zero (`inverse_of_arcs`).
    """
    count, row = len(memory.arc_id), np.arange(len(arc_id))[:, None]
    # channels without a phase are collected in an extra row and column
    index = np.where(arc_id == NO_ARC, count, np.searchsorted(memory.arc_id, arc_id))
    if (np.append(memory.arc_id, NO_ARC)[index] != arc_id).any():
        raise ValueError("an arc has phases after the start of a newer arc of its channel; assign arcs by number_arcs")
    own = np.zeros((len(arc_id), count + 1, count + 4))
    own[row[:, None], index[:, :, None], index[:, None, :]] = matrix
    own[row, index, count + 1 :] = right
    own = np.delete(own[:, :count], count, axis=2)
    carried = np.concatenate([memory.matrix, memory.right], axis=1)
    # with cumsum, the order of the additions does not depend on the division into chunks
    sums = np.cumsum(np.concatenate([carried[None], own]), axis=0)
    after = replace(memory, matrix=sums[-1, :, :count], right=sums[-1, :, count:])
    level = np.zeros((len(arc_id), count + 1))
    level[row, index] = held
    covariance, value = np.zeros((len(arc_id), count + 1, count + 1)), np.zeros((len(arc_id), count + 1, 3))
    covariance[:, :count, :count] = inverse_of_arcs(sums[1:, :, :count], level[:, :count])
    value[:, :count] = covariance[:, :count, :count] @ sums[1:, :, count:]
    arcs = ArcAmbiguities(
        arc_id=memory.arc_id, ambiguity_m=memory.first_m + value[-1:, :count, 0].sum(axis=0),
        covariance_m2=covariance[-1:, :count, :count].sum(axis=0),
    )  # fmt: skip
    return value[row, index], covariance[row[:, None], index[:, :, None], index[:, None, :]], arcs, after


def _fix_epochs(
    floats: tuple[Floats, Floats, Floats], phases: Phases, trajectory: Trajectory, limits: PhaseLimits
) -> tuple[Integers, Floats]:
    """Fix the ambiguities of each epoch in place; return `PhasePositions.n_fixed` and `PhasePositions.integer_risk`.

    `floats` has three items: first values of the ambiguities (T, M); corrections to the first values, and changes of
    the ambiguities for map errors of 1 m (T, M, 3); covariances (T, M, M).
    """
    first, value, covariance = floats
    count, risk = np.zeros(len(value), dtype=np.int64), np.full(len(value), np.nan)
    integers = phases.integers
    if integers is None:
        return count, risk
    for k, weight in enumerate(phases.weight):
        used = np.flatnonzero(weight > 0)
        both = np.ix_(used, used)
        whole = value[k, used]
        whole[:, 0] += first[k, used]
        fixed = fix_integers(
            whole, covariance[k][both], weight[used],
            IntegerChannels(wavelength_m=integers.wavelength_m[used], group=integers.group[used]),
            (trajectory.sigma_plan_m, trajectory.sigma_height_m),
            largest_risk=limits.integer_risk, no_integer_prior=limits.no_integer_prior,
        )  # fmt: skip
        value[k, used], covariance[k][both] = fixed.value_m, fixed.covariance_m2
        value[k, used, 0] -= first[k, used]
        count[k], risk[k] = fixed.count, fixed.risk
    return count, risk


def _with_arcs(memory: Memory, ids: Integers, first_m: Floats) -> Memory:
    """Add new arcs to the memory, whose arcs are sorted by number, and eliminate older arcs of the same channels."""
    if not len(ids):
        return memory
    memory = _without(memory, np.isin(decode_channel(memory.arc_id), decode_channel(ids)))
    arc_id = np.concatenate([memory.arc_id, ids])
    order = np.argsort(arc_id)
    count, old = len(arc_id), len(memory.arc_id)
    matrix, right = np.zeros((count, count)), np.zeros((count, 3))
    matrix[:old, :old], right[:old] = memory.matrix, memory.right
    never = np.full(count - old, np.datetime64("NaT", "ns"))
    return replace(
        memory,
        arc_id=arc_id[order],
        seen=np.concatenate([memory.seen, never])[order],
        first_m=np.concatenate([memory.first_m, first_m])[order],
        matrix=matrix[np.ix_(order, order)],
        right=right[order],
    )


def _walk(memory: Memory, time: Datetimes, limits: PhaseLimits) -> Memory:
    """Return the memory at the time step that contains `time`, without expired arcs and with added process noise."""
    if not len(time) or not len(memory.arc_id):
        return memory
    before, now = number_hops(np.array([memory.time, time[0]]), limits)
    if now == before:
        return memory
    begin = GPS_EPOCH + np.timedelta64(int(now) * round(limits.hop_s * 1e9), "ns")
    memory = _without(memory, seconds(begin - memory.seen) > FORGET_S)
    variance = limits.drift_m**2 * float(now - before) * limits.hop_s
    # (Lambda^-1 + v I)^-1 = (I + v Lambda)^-1 Lambda; the second expression exists even if Lambda is singular
    both = np.concatenate([memory.matrix, memory.right], axis=1)
    both = np.linalg.solve(np.eye(len(both)) + variance * memory.matrix, both)
    matrix, right = both[:, : len(both)], both[:, len(both) :]
    return replace(memory, matrix=0.5 * (matrix + matrix.T), right=right)


def _without(memory: Memory, ends: Masks) -> Memory:
    """Return the memory after eliminating the arcs marked by `ends`; the information on the other arcs is unchanged."""
    runs = ~ends
    if runs.all():
        return memory
    inner = memory.matrix[np.ix_(ends, ends)]
    inner = inner + np.eye(len(inner)) * FREE_AMBIGUITY_M**-2.0
    across = memory.matrix[np.ix_(runs, ends)]
    both = np.linalg.solve(inner, np.concatenate([across.T, memory.right[ends]], axis=1))
    size = np.count_nonzero(runs)
    return replace(
        memory,
        arc_id=memory.arc_id[runs],
        seen=memory.seen[runs],
        first_m=memory.first_m[runs],
        matrix=memory.matrix[np.ix_(runs, runs)] - across @ both[:, :size],
        right=memory.right[runs] - across @ both[:, size:],
    )


def _join(pieces: list[PhasePositions]) -> PhasePositions:
    """Concatenate segments; `arcs` are the arcs of the last segment."""
    arrays: dict[str, Any] = {
        item.name: np.concatenate([getattr(p, item.name) for p in pieces])
        for item in fields(PhasePositions)
        if item.name not in ("arcs", "iterations")
    }
    return replace(pieces[-1], **arrays)

"""Code and phase over a run of epochs in one least squares: the definition that `phase_positions` is held against."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks
from railfix.positioning.carrier import PhaseLimits, PhasePositions, Phases
from railfix.positioning.carrier.ambiguities import (
    ArcAmbiguities,
    assemble_positions,
    count_repeats,
    inverse_of_arcs,
    number_hops,
    prepare_start,
)
from railfix.positioning.carrier.observation_model import (
    Linearised,
    linearise,
    own_clock,
    own_unknowns,
    reduce,
    shift_phases,
)
from railfix.positioning.range_arrays import Ranges
from railfix.track.trajectory import Trajectory

#: Last step along the line [m], and linearisations at most.
TOLERANCE_M, MAX_ITERATIONS = 1e-7, 8


def phase_run(
    time: Datetimes,
    ranges: Ranges,
    phases: Phases,
    trajectory: Trajectory,
    arc_m_start: Floats,
    *,
    limits: PhaseLimits | None = None,
) -> PhasePositions:
    """Positions of a run of epochs, all observations of the run in one least squares.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    ranges : Ranges
        T epochs: corrected codes with their weights, satellites, clocks, ties between clocks.
    phases : Phases
    trajectory : Trajectory
    arc_m_start : ndarray, shape (T,) [m]
        Where each epoch starts from (the constrained position of codes alone); NaN leaves it out.
    limits : PhaseLimits, optional

    Returns
    -------
    PhasePositions
        Memory: T x M x M and A x A numbers for A arcs; cut long logs into runs of minutes.
    """
    limits = limits or PhaseLimits()
    started = np.isfinite(arc_m_start)
    ranges, phases, arc = prepare_start(ranges, phases, trajectory, arc_m_start)
    used = phases.weight > 0
    # Row-major: the first place of an arc is its first epoch.
    walk = _walk(number_hops(time, limits), used, phases.arc_id, limits)
    first, column, count = walk.first, walk.column, len(walk.arc_id)
    index = np.full(used.shape, count, dtype=np.intp)
    index[used] = column
    base = np.zeros(count + 1)
    iteration = 0
    while True:
        lin = linearise(ranges, phases, trajectory, arc, clocks=limits.clocks)
        if iteration == 0:
            base[:count] = lin.phase_m[used][first]
        lin = shift_phases(lin, base[index])
        value, covariance = _solved(lin, index, walk.links)
        among = covariance[index[:, :, None], index[:, None, :]]
        own = own_unknowns(lin, value[index], among, trajectory, repeats=count_repeats(time, limits))
        after = np.clip(arc + own.step_m, 0.0, trajectory.arc_m[-1])
        step = float(np.abs(after - arc)[started].max(initial=0.0))
        arc, iteration = after, iteration + 1
        if step <= TOLERANCE_M or iteration >= MAX_ITERATIONS:
            break
    total = base + value[:, 0]
    arcs = ArcAmbiguities(arc_id=walk.arc_id, ambiguity_m=total[:count], covariance_m2=covariance[:count, :count])
    fixes = np.zeros(len(arc), dtype=np.int64), np.full(len(arc), np.nan)
    ambiguity = (total[index], np.diagonal(covariance)[index])
    return replace(assemble_positions(arc, started, own, lin, ambiguity, arcs, fixes, limits), iterations=iteration)


@dataclass(frozen=True)
class _Walk:
    """Unknowns of a run: one a stretch of an arc inside a hop, linked to the next of its arc.

    `first` is the place of each arc's first value among the used phases, `column` the unknown of
    each of them, `links` the information of the random walk between unknowns, shape (A, A).
    """

    arc_id: Integers
    first: Indices
    column: Indices
    links: Floats


def _walk(hop: Integers, used: Masks, arc_id: Integers, limits: PhaseLimits) -> _Walk:
    """Unknowns of the arcs' ambiguities, and what the walk between them says."""
    when = np.broadcast_to(hop[:, None], used.shape)[used] if limits.drift_m > 0.0 else np.zeros(used.sum(), np.int64)
    # Row-major: the first place of an arc is its first epoch.
    pairs = np.stack([arc_id[used], when], axis=1)
    stretches, column = np.unique(pairs, axis=0, return_inverse=True)
    ids, first = np.unique(arc_id[used], return_index=True)
    links = np.zeros((len(stretches), len(stretches)))
    next_one = np.flatnonzero(stretches[1:, 0] == stretches[:-1, 0])
    if limits.drift_m > 0.0:
        steps = (stretches[next_one + 1, 1] - stretches[next_one, 1]) * limits.hop_s
        weight = 1.0 / (limits.drift_m**2 * steps)
        for one, two, sign in ((0, 0, 1), (1, 1, 1), (0, 1, -1), (1, 0, -1)):
            np.add.at(links, (next_one + one, next_one + two), sign * weight)
    return _Walk(
        arc_id=stretches[:, 0],
        first=first[np.searchsorted(ids, stretches[:, 0])],
        column=column.reshape(-1),
        links=links,
    )


def _solved(lin: Linearised, index: Indices, links: Floats) -> tuple[Floats, Floats]:
    """Ambiguities less their first values with their responses to the map, and their covariance.

    Shapes (A + 1, 3) and (A + 1, A + 1): the last one stands for channels without a phase.
    """
    (own_matrix, own_right), count = reduce(lin), len(links)
    matrix = np.zeros((count + 1, count + 1))
    right = np.zeros((count + 1, 3))
    np.add.at(matrix, (index[:, :, None], index[:, None, :]), own_matrix)
    np.add.at(right, index, own_right)
    matrix[:-1, :-1] += links
    matrix[-1], matrix[:, -1], right[-1] = 0.0, 0.0, 0.0
    held = np.append(np.ones(count), 0.0) if own_clock(lin) else np.zeros(count + 1)
    covariance = inverse_of_arcs(matrix, held)
    return covariance @ right, covariance

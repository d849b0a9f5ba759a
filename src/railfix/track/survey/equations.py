"""Observation equations of a survey, linearised about approximate positions of the runs and the line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.sparse as sp

from railfix.core.arrays import Floats, Indices
from railfix.core.geodesy import range_with_rotation
from railfix.track.survey.passes import Ties
from railfix.track.survey.runs import CLIMB_MPS2, RunSignals, SurveyLimits, SurveyRun

#: Standard deviation of the pseudo-observation that shifts of the line have the second difference 0 [m]. For shifts
#: across the line, `_CORNER_M` times the squared turn [rad^2] is added, because such shifts bend the line at a corner.
_BEND_M: Final = 0.05
_CORNER_M: Final = 5.0


@dataclass(frozen=True, kw_only=True)
class ReferenceLine:
    """Line of J points before the adjustment."""

    ecef_m: Floats  #: ECEF positions of the points, shape (J, 3).
    across: Floats  #: Unit vectors across the line, along which points are adjusted, shape (J, 3).
    up: Floats  #: Upward unit vectors, along which points are adjusted, shape (J, 3).
    closed: bool = False  #: Whether the last point is joined to the first point.

    def __len__(self) -> int:
        return len(self.ecef_m)


@dataclass(frozen=True, kw_only=True)
class Equations:
    """Equations of n observations with `size` rows each; each row is divided by its standard deviation."""

    matrix: sp.csr_array  #: Design matrix, shape (n * size, unknowns).
    value: Floats  #: Observed values, shape (n * size,).
    size: int  #: Number of rows per observation.
    share: Floats  #: Weight of each observation; 1 if its error is independent, shape (n,).
    robust: bool = True  #: Whether outliers are down-weighted.
    scaled: bool = False  #: Whether standard deviations are scaled to agree with the residuals.


@dataclass(frozen=True, kw_only=True)
class RunColumns:
    """Columns of the unknowns of one run."""

    row: Indices  #: For each row of the run, the first of the three columns of its coordinates.
    offset: int  #: First of the three columns of the run's offset.
    clock: Indices  #: Column of the receiver clock error at each row.
    further: Indices  #: Columns of the clock offsets of groups 1, 2, ... (`RunSignals.clock`).
    step: Indices  #: For each step between two rows, the column of the receiver clock's change.

    @classmethod
    def from_first(cls, run: SurveyRun, first: int) -> RunColumns:
        """Assign columns to a run's unknowns, beginning with the column `first`."""
        count, signals = len(run), run.signals
        offset = first + 3 * count
        rows, further = (0, 0) if signals is None else (count, int(signals.clock.max(initial=0)))
        clock = offset + 3 + np.arange(rows)
        return cls(
            row=first + 3 * np.arange(count),
            offset=offset,
            clock=clock,
            further=offset + 3 + rows + np.arange(further),
            step=offset + 3 + rows + further + np.arange(max(rows - 1, 0)),
        )

    @property
    def end(self) -> int:
        """Next column after the run's columns."""
        return self.offset + 3 + len(self.clock) + len(self.further) + len(self.step)


def _matrix(size: int, unknowns: int, parts: Sequence[tuple[Indices, Floats]]) -> sp.csr_array:
    """Build a sparse matrix from parts.

    A part consists of one column index per observation, shape (n,), and the coefficients in this column, shape (n,
    size).
    """
    count = len(parts[0][0])
    row = np.arange(count * size)
    rows = np.concatenate([row for _ in parts])
    columns = np.concatenate([np.repeat(column, size) for column, _ in parts])
    values = np.concatenate([coefficient.ravel() for _, coefficient in parts])
    return sp.csr_array((values, (rows, columns)), shape=(count * size, unknowns))


def _point(first: Indices, factor: Floats) -> list[tuple[Indices, Floats]]:
    """Return parts of `_matrix` for coordinates in three columns, the first of which is `first`."""
    return [(first + axis, factor[:, :, axis]) for axis in range(3)]


def position_equations(
    run: SurveyRun, columns: RunColumns, axes: Floats, origin: Floats, share: Floats, unknowns: int
) -> Equations:
    """Return the equations of positions; a position is the sum of the row's coordinates and the run's offset."""
    rows = np.flatnonzero(np.isfinite(run.ecef_m).all(axis=1))
    white = axes[None] / run.sigma_m[rows][:, :, None]
    value = np.einsum("nij,nj->ni", white, run.ecef_m[rows] - origin)
    parts = [*_point(columns.row[rows], white), *_point(np.full(len(rows), columns.offset), white)]
    return Equations(
        matrix=_matrix(3, unknowns, parts), value=value.ravel(), size=3, share=share[rows], scaled=True
    )  # fmt: skip


def code_equations(
    signals: RunSignals, columns: RunColumns, near: Floats, origin: Floats, share: Floats, unknowns: int
) -> Equations:
    """Return the equations of pseudoranges.

    Unknowns are the coordinates, the run's offset, the row's clock error, and clock offsets of other constellations.
    """
    row, sigma = signals.row, signals.sigma_m
    distance, sight = range_with_rotation(signals.sat_ecef_m, near[row] + origin)
    white = (-sight / sigma[:, None])[:, None, :]
    rest = signals.code_m - distance
    value = (rest - _group_medians(rest, row)) / sigma + np.einsum("mij,mj->m", white, near[row])
    one = (1.0 / sigma)[:, None]
    parts = [
        *_point(columns.row[row], white),
        *_point(np.full(len(row), columns.offset), white),
        (columns.clock[row], one),
    ]
    for number, column in enumerate(columns.further.tolist(), start=1):
        parts.append((np.full(len(row), column), np.where((signals.clock == number)[:, None], one, 0.0)))
    return Equations(matrix=_matrix(1, unknowns, parts), value=value, size=1, share=share[row], scaled=True)


def change_equations(
    signals: RunSignals, columns: RunColumns, near: Floats, origin: Floats, share: Floats, unknowns: int
) -> list[Equations]:  # fmt: skip
    """Return the equations of range changes from carrier phase or, where the phase was lost, from Doppler.

    Unknowns are the coordinates of both rows, and the change of the clock error between both rows.
    """
    step, sigma = signals.step, signals.change_sigma_m
    before, sight_before = range_with_rotation(signals.before_ecef_m, near[step] + origin)
    after, sight_after = range_with_rotation(signals.after_ecef_m, near[step + 1] + origin)
    first, last = (sight_before / sigma[:, None])[:, None, :], (-sight_after / sigma[:, None])[:, None, :]
    rest = signals.change_m - after + before
    value = (rest - _group_medians(rest, step)) / sigma
    value += np.einsum("mij,mj->m", first, near[step]) + np.einsum("mij,mj->m", last, near[step + 1])
    parts = [*_point(columns.row[step], first), *_point(columns.row[step + 1], last)]
    parts.append((columns.step[step], (1.0 / sigma)[:, None]))
    matrix = _matrix(1, unknowns, parts)
    return [
        Equations(matrix=matrix[kind], value=value[kind], size=1, share=independent[kind], scaled=by_doppler)
        for by_doppler, independent in ((False, np.ones(len(step))), (True, share[step + 1]))
        for kind in (np.flatnonzero(signals.by_doppler == by_doppler),)
    ]


def _group_medians(value: Floats, group: Indices) -> Floats:
    """Return the median of each value's group.

    Subtracting the median, an approximate clock error, leaves only a small clock error to be estimated.
    """
    order = np.lexsort((value, group))
    first = np.searchsorted(group[order], np.arange(int(group.max(initial=-1)) + 2))
    middle = np.minimum((first[:-1] + first[1:]) // 2, len(value) - 1)
    return np.asarray(value[order[middle]][group])


def motion_equations(
    run: SurveyRun, columns: RunColumns, axes: Floats, limits: SurveyLimits, unknowns: int
) -> Equations:  # fmt: skip
    """Return the pseudo-observations of smooth motion: small velocity changes between successive steps."""
    dt = np.diff(run.seconds)
    rows = np.arange(1, len(run) - 1)
    mean = 0.5 * (dt[:-1] + dt[1:])
    sigma = np.array([limits.acceleration_mps2, limits.acceleration_mps2, CLIMB_MPS2]) * np.sqrt(mean)[:, None]
    white = axes[None] / sigma[:, :, None]
    before, after = white / dt[:-1, None, None], white / dt[1:, None, None]
    parts = [
        *_point(columns.row[rows - 1], before),
        *_point(columns.row[rows], -before - after),
        *_point(columns.row[rows + 1], after),
    ]
    return Equations(
        matrix=_matrix(3, unknowns, parts), value=np.zeros(3 * len(rows)), size=3, share=np.ones(len(rows))
    )


def offset_equations(run: SurveyRun, columns: RunColumns, axes: Floats, unknowns: int) -> Equations:
    """Return the prior of a run's offset: mean 0, and the standard deviation of the common error of all positions."""
    plan, height = run.common_sigma_m
    white = (axes / np.array([plan, plan, height])[:, None])[None]
    parts = _point(np.array([columns.offset]), white)
    return Equations(
        matrix=_matrix(3, unknowns, parts), value=np.zeros(3), size=3, share=np.ones(1), robust=False
    )  # fmt: skip


def tie_equations(
    line: ReferenceLine, ties: Ties, runs: Sequence[RunColumns], start: int, origin: Floats, limits: SurveyLimits,
    unknowns: int,
) -> Equations:  # fmt: skip
    """Return the equations of passes, in which a run's distance from the line is an error correlated along the line."""
    share = np.full(len(ties.point), min(1.0, limits.spacing_m / max(limits.correlation_m, 1e-9)))
    white = np.stack([line.across[ties.point], line.up[ties.point]], axis=1) / limits.apart_m
    first = np.array([columns.row[0] for columns in runs])[ties.run]
    parts = []
    for k in range(ties.row.shape[1]):
        parts += _point(first + 3 * ties.row[:, k], white * ties.weight[:, k, None, None])
    for axis in range(2):
        coefficient = np.zeros((len(ties.point), 2))
        coefficient[:, axis] = -1.0 / limits.apart_m
        parts.append((start + 2 * ties.point + axis, coefficient))
    value = np.einsum("mij,mj->mi", white, line.ecef_m[ties.point] - origin)
    return Equations(matrix=_matrix(2, unknowns, parts), value=value.ravel(), size=2, share=share)


def bend_equations(line: ReferenceLine, start: int, unknowns: int) -> Equations:
    """Return the pseudo-observations by which the line bends almost as the reference line does."""
    count = len(line)
    middle = np.arange(count) if line.closed else np.arange(1, count - 1)
    neighbours = line.across[(middle - 1) % count], line.across[(middle + 1) % count]
    turn = np.linalg.norm(neighbours[1] - neighbours[0], axis=1)
    sigma = np.stack([_BEND_M + _CORNER_M * turn**2, np.full(len(middle), _BEND_M)], axis=1)
    parts = []
    for shift, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
        for axis in range(2):
            coefficient = np.zeros((len(middle), 2))
            coefficient[:, axis] = factor / sigma[:, axis]
            parts.append((start + 2 * ((middle + shift) % count) + axis, coefficient))
    return Equations(
        matrix=_matrix(2, unknowns, parts), value=np.zeros(2 * len(middle)), size=2, share=np.ones(len(middle))
    )

"""Ranges used by the interference tests, and least-squares fits to these ranges."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.positioning.search_index import SearchIndex

_TURN: Final = EARTH_ROTATION_RATE / SPEED_OF_LIGHT
_RIDGE: Final = 1e-9  #: Weight of a loose prior on each unknown, for numerical conditioning.


class MotionInputs(NamedTuple):
    """Ranges of K channels at T epochs, and the lines of the antennas."""

    time: Datetimes  #: Shape (T,).
    break_before: Masks  #: True where an epoch is not compared with the previous epoch, shape (T,).
    channel: Strings  #: Satellite and signal, shape (K,).
    group: Indices  #: Index of each channel's receiver clock, shape (K,).
    near_ecef_m: Floats  #: Approximate position with errors up to some kilometres, shape (T, 3); NaN if unknown.
    sat_ecef_m: Floats  #: Satellite positions, shape (T, K, 3).
    sat_velocity_mps: Floats  #: Satellite velocities, shape (T, K, 3).
    code_m: Floats  #: Observed pseudoranges, shape (T, K).
    rate_mps: Floats  #: Range rates from Dopplers (``-lambda D``), shape (T, K).
    corrected_code_m: Floats  #: Corrected pseudoranges, shape (T, K).
    sigma_m: Floats  #: Standard deviations of the corrected pseudoranges, shape (T, K).
    used: Masks  #: Channels without a rejection reason, shape (T, K).
    named: Masks  #: Channels whose only rejection reason is a fault of their satellite, shape (T, K).
    noise_scale: Floats  #: Ratio of the receiver's range standard deviation to `sigma_m`, shape (T,).
    clock_offset_m: Floats  #: Known offsets of the receiver clocks, shape (T, G).
    clock_sigma_m: Floats  #: Standard deviations of the clock offsets, shape (T, G).
    #: Lateral distance of the 3-D position from the line, shape (T,); NaN beyond an end of the line.
    off_line_m: Floats
    #: True for epochs with faulty codes or with a position that failed a check, shape (T,).
    doubted: Masks
    antenna: Indices  #: Index of each epoch's antenna in `lines`, shape (T,).
    lines: tuple[SearchIndex, ...]  #: Line of each antenna.

    def take(self, rows: slice | Indices) -> MotionInputs:
        """Return the inputs of selected epochs."""
        own = {
            n: values if n in ("channel", "group", "lines") else values[rows] for n, values in self._asdict().items()
        }
        return MotionInputs(**own)

    def nearest_on_lines(self) -> tuple[Floats, Floats]:
        """Return the line vertices nearest to `near_ecef_m`, (T, 3), and their lateral and vertical axes, (T, 2, 3)."""
        point, axes = np.full(self.near_ecef_m.shape, np.nan), np.full((len(self.time), 2, 3), np.nan)
        for number, line in enumerate(self.lines):
            rows = np.flatnonzero((self.antenna == number) & np.isfinite(self.near_ecef_m[:, 0]))
            vertex = np.asarray(line.tree.query(self.near_ecef_m[rows])[1], dtype=np.intp)
            path = line.trajectory
            point[rows], axes[rows] = path.ecef_m[vertex], path.get_axes(np.minimum(vertex, len(path) - 2))[:, 1:]
        return point, axes


def clock_columns(inputs: MotionInputs) -> Floats:
    """Return the design columns of the receiver clocks, shape (K, G)."""
    return np.asarray(inputs.group[:, None] == np.arange(inputs.group.max(initial=-1) + 1), dtype=np.float64)


def misfit_at(inputs: MotionInputs) -> tuple[Floats, Floats, Floats]:
    """Return approximate positions (T, 3), unit vectors to satellites (T, K, 3) and codes minus distances (T, K)."""
    near = inputs.near_ecef_m
    to_satellite = inputs.sat_ecef_m - near[:, None, :]
    distance = np.linalg.norm(to_satellite, axis=2)
    turn = inputs.sat_ecef_m[..., 0] * near[:, None, 1] - inputs.sat_ecef_m[..., 1] * near[:, None, 0]
    return near, to_satellite / distance[..., None], inputs.corrected_code_m - distance - _TURN * turn


def fit_epochs(design: Floats, value: Floats, weight: Floats, *, least: int) -> tuple[Floats, Floats, Floats]:
    """Return weighted least-squares solutions, covariances and noise scales of single epochs.

    Solutions and noise scales are NaN where the redundancy is below `least`, or where the position is undetermined.
    """
    has = (weight > 0) & np.isfinite(value) & np.isfinite(design).all(axis=2)
    rows = np.where(has[..., None], design, 0.0)
    y, w = np.where(has, value, 0.0), np.where(has, weight, 0.0)
    weighted = rows * w[..., None]
    normal = rows.swapaxes(1, 2) @ weighted
    unknown = np.diagonal(normal, axis1=1, axis2=2) > 0.0
    size = design.shape[2]
    ridge = np.where(unknown, _RIDGE, 1.0)
    covariance = np.linalg.inv(normal + ridge[:, :, None] * np.eye(size))
    solution = (covariance @ (weighted * y[..., None]).sum(axis=1)[..., None])[..., 0]
    left = y - (rows @ solution[..., None])[..., 0]
    freedom = has.sum(axis=1) - unknown.sum(axis=1)
    redundant = (freedom >= least) & unknown[:, :3].all(axis=1)
    scale = np.sqrt((w * left**2).sum(axis=1) / np.maximum(freedom, 1))
    return np.where(redundant[:, None], solution, np.nan), covariance, np.where(redundant, scale, np.nan)

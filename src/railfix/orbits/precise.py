"""Satellites from a precise ephemeris: polynomials through its positions, straight lines through its clocks."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.navigation import PreciseEphemeris
from railfix.timescale import seconds

Floats = NDArray[np.float64]

#: Points of the interpolation polynomial (order 10), as is the custom for 15-minute positions.
_POINTS: Final = 11


def precise_state(
    ephemeris: PreciseEphemeris, column: NDArray[np.intp], time: NDArray[np.datetime64], offset_s: Floats
) -> tuple[Floats, Floats, Floats]:
    """States of satellites at ``time + offset``.

    Parameters
    ----------
    ephemeris : PreciseEphemeris
        At least 11 epochs.
    column : ndarray of int, shape (n,)
        Satellite's column; -1 where it is not in the ephemeris.
    time : ndarray of datetime64[ns], shape (n,)
    offset_s : ndarray, shape (n,) [s]

    Returns
    -------
    position_ecef_m, velocity_ecef_mps : ndarray, shape (n, 3)
        NaN where a node is missing or the time lies outside the file.
    clock_s : ndarray, shape (n,) [s]
        As given, plus the relativistic -2 r.v / c^2 that SP3 clocks leave out.
    """
    nodes = ephemeris.time
    if len(nodes) < _POINTS:
        raise ValueError(f"a precise ephemeris needs at least {_POINTS} epochs, got {len(nodes)}")
    right = np.searchsorted(nodes, time, side="right")
    begin = np.clip(right - (_POINTS + 1) // 2, 0, len(nodes) - _POINTS)
    index = begin[:, None] + np.arange(_POINTS)
    at = seconds(nodes[index] - time[:, None]) - offset_s[:, None]
    place = ephemeris.position_ecef_m[index, column[:, None]]
    # Nodes turned into the frame of the instant asked for: the orbit is smooth there.
    angle = EARTH_ROTATION_RATE * at
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack(
        [cos * place[..., 0] - sin * place[..., 1], sin * place[..., 0] + cos * place[..., 1], place[..., 2]], axis=-1
    )
    weight, slope = _lagrange_at_zero(at)
    position = np.einsum("np,npi->ni", weight, turned)
    velocity = np.einsum("np,npi->ni", slope, turned)
    velocity[:, 0] += EARTH_ROTATION_RATE * position[:, 1]
    velocity[:, 1] -= EARTH_ROTATION_RATE * position[:, 0]
    inside = (column >= 0) & (right > 0) & ((right < len(nodes)) | (time == nodes[-1]))
    position[~inside] = np.nan
    velocity[~inside] = np.nan

    left = np.clip(right - 1, 0, len(nodes) - 2)
    step = seconds(nodes[left + 1] - nodes[left])
    part = (seconds(time - nodes[left]) + offset_s) / step
    before, after = ephemeris.clock_s[left, column], ephemeris.clock_s[left + 1, column]
    inertial = velocity + EARTH_ROTATION_RATE * np.stack(
        [-position[:, 1], position[:, 0], np.zeros(len(position))], axis=-1
    )
    relativity = -2.0 * np.einsum("ni,ni->n", position, inertial) / SPEED_OF_LIGHT**2
    clock = before + part * (after - before) + relativity
    return position, velocity, np.where(inside, clock, np.nan)


def _lagrange_at_zero(nodes: Floats) -> tuple[Floats, Floats]:
    """Weights of the value and of the slope at 0 of the polynomial through nodes, shape (n, P)."""
    points = nodes.shape[1]
    weight, slope = np.empty(nodes.shape), np.empty(nodes.shape)
    for i in range(points):
        others = np.delete(np.arange(points), i)
        gap = nodes[:, i, None] - nodes[:, others]
        factor = -nodes[:, others] / gap
        weight[:, i] = factor.prod(axis=1)
        parts = [np.delete(factor, k, axis=1).prod(axis=1) / gap[:, k] for k in range(points - 1)]
        slope[:, i] = np.sum(parts, axis=0)
    return weight, slope

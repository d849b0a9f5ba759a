"""Satellite states from a precise ephemeris: polynomial interpolation of positions, linear of clocks."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.timescale import seconds
from railfix.gnss.navigation import PreciseEphemeris

#: Points of the interpolation polynomial (order 12). With positions every 15 minutes it is within 3 mm on the two
#: Galileo satellites in elliptic orbits, where the usual 11 points err by 17 mm near perigee, and within a
#: micrometre elsewhere; in the first and last interval of a file up to 0.7 m on these two (0.05 mm elsewhere).
POINTS: Final = 13
#: Epochs further apart than this many times the usual interval are a gap, within which there is no state.
_GAP: Final = 1.5
_BLOCK: Final = 4096  #: Number of states computed at once, so that the arrays stay in the cache.


def precise_clock_s(ephemeris: PreciseEphemeris, column: Indices, time: Datetimes, offset_s: Floats) -> Floats:
    """Interpolate the clocks of the file linearly at ``time + offset``, shape (n,) [s]."""
    left = np.clip(np.searchsorted(ephemeris.time, time, side="right") - 1, 0, len(ephemeris.time) - 2)
    step = seconds(ephemeris.time[left + 1] - ephemeris.time[left])
    part = (seconds(time - ephemeris.time[left]) + offset_s) / step
    before, after = ephemeris.clock_s[left, column], ephemeris.clock_s[left + 1, column]
    return np.asarray(before + part * (after - before))


def precise_state(
    ephemeris: PreciseEphemeris, column: Indices, time: Datetimes, offset_s: Floats
) -> tuple[Floats, Floats, Floats]:
    """Compute positions and velocities (3, n), and clocks (n,) of satellites at ``time + offset``.

    `column` is -1 where a satellite is not in the ephemeris of at least `POINTS` epochs; `offset_s` a fraction of a
    second. NaN where a node is missing or the time lies outside the file or in a gap. The clock has the relativistic -2
    r.v / c^2 that SP3 clocks do not contain.
    """
    if len(ephemeris.time) < POINTS:
        raise ValueError(f"a precise ephemeris needs at least {POINTS} epochs, got {len(ephemeris.time)}")
    position, velocity, clock = np.empty((3, len(time))), np.empty((3, len(time))), np.empty(len(time))
    longest_s = _GAP * float(np.median(seconds(np.diff(ephemeris.time))))
    for begin in range(0, len(time), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        block = _state(ephemeris, longest_s, column[part], time[part], offset_s[part])
        position[:, part], velocity[:, part], clock[part] = block
    return position, velocity, clock


def _state(
    ephemeris: PreciseEphemeris, longest_s: float, column: Indices, time: Datetimes, offset_s: Floats
) -> tuple[Floats, Floats, Floats]:
    nodes = ephemeris.time
    right = np.searchsorted(nodes, time, side="right")
    begin = np.clip(right - (POINTS + 1) // 2, 0, len(nodes) - POINTS)
    windows, which = np.unique(begin, return_inverse=True)
    index = windows + np.arange(POINTS)[:, None]
    since = seconds(nodes[index] - nodes[windows])
    # Rotate the nodes into the Earth-fixed frame of the first node, an inertial frame, in which the orbit is smooth.
    place = np.moveaxis(ephemeris.position_ecef_m[index], -1, 0)
    rotated = np.stack(_rotate(EARTH_ROTATION_RATE * since[..., None], place))
    own = seconds(time - nodes[begin]) + offset_s
    weight, slope = _lagrange_at_zero(since[:, which] - own, _node_products(since)[:, which])
    chosen = rotated[:, :, which, column]
    position = np.stack(_rotate(-EARTH_ROTATION_RATE * own, _sum(weight * chosen)))
    velocity = np.stack(_rotate(-EARTH_ROTATION_RATE * own, _sum(slope * chosen)))
    velocity[0] += EARTH_ROTATION_RATE * position[1]
    velocity[1] -= EARTH_ROTATION_RATE * position[0]

    # r.v is the same with the Earth-fixed velocity: the difference of the velocities is perpendicular to r.
    relativity = -2.0 * _sum_axis0(position * velocity) / SPEED_OF_LIGHT**2
    clock = precise_clock_s(ephemeris, column, time, offset_s) + relativity
    left = np.clip(right - 1, 0, len(nodes) - 2)
    outside = (column < 0) | (right == 0) | ((right == len(nodes)) & (time != nodes[-1]))
    outside |= seconds(nodes[left + 1] - nodes[left]) > longest_s
    position[:, outside], velocity[:, outside], clock[outside] = np.nan, np.nan, np.nan
    return position, velocity, clock


def _sum(terms: Floats) -> Floats:
    """Sum over the nodes (axis 1) in a fixed order, for reproducible rounding."""
    total = terms[:, 0].copy()
    for i in range(1, terms.shape[1]):
        total += terms[:, i]
    return total


def _sum_axis0(terms: Floats) -> Floats:
    return np.asarray(terms[0] + terms[1] + terms[2])


def _rotate(angle: Floats, vector: Floats) -> tuple[Floats, Floats, Floats]:
    """Rotate vectors, components first, about the Earth's axis."""
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1], vector[2]


def _node_products(since_s: Floats) -> Floats:
    """Compute the products of the differences of each node to the others of its window, shape (P, windows)."""
    difference = since_s[:, None] - since_s[None]
    difference[np.arange(POINTS), np.arange(POINTS)] = 1.0
    return np.asarray(difference.prod(axis=1))


def _lagrange_at_zero(nodes: Floats, node_products: Floats) -> tuple[Floats, Floats]:
    """Compute the Lagrange weights of value and slope at 0 of the polynomial through nodes, shape (P, n).

    Products of ``-node`` over all nodes but one, and their derivatives, from the products before
    and after that one, over the products of the differences.
    """
    points = len(nodes)
    start = (np.ones(nodes.shape[1]), np.zeros(nodes.shape[1]))
    before, after = [start], [start]
    for i in range(points - 1):
        value, rate = before[-1]
        before.append((-nodes[i] * value, value - nodes[i] * rate))
        value, rate = after[-1]
        j = points - 1 - i
        after.append((-nodes[j] * value, value - nodes[j] * rate))
    weight, slope = np.empty(nodes.shape), np.empty(nodes.shape)
    for i in range(points):
        (p, p_rate), (q, q_rate) = before[i], after[points - 1 - i]
        weight[i], slope[i] = p * q / node_products[i], (p_rate * q + p * q_rate) / node_products[i]
    return weight, slope

"""Signals reflected twice, by the walls on both sides of the line."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats
from railfix.simulate.environment.antenna import circular_reflection, cross_polar_gain
from railfix.simulate.environment.diffraction import edge_amplitude, roughness_loss
from railfix.simulate.environment.settings import AntennaSettings
from railfix.simulate.environment.structures import Strips
from railfix.simulate.environment.walls import Rays, in_front, shadow, wall_met

_LEAST: float = 0.05


def second_reflection(
    rows: tuple[Strips, ...], rays: Rays, antenna: AntennaSettings | None
) -> tuple[Floats, Floats, Floats]:
    """Amplitude, extra path [m] and growth [m/m] of signals reflected by the nearest rows of both sides, shapes (N,).

    The signal passes over the walls of the satellite's side, is reflected by the opposite row, then by the
    satellite's own side, and reaches the antenna from there. Twice mirrored, the antenna's image lies
    ``2 (d_A + d_B)`` away on the opposite side, so the extra path is ``2 (d_A + d_B) |u_y|`` with the distances of
    both walls, which are taken as parallel to the line.
    """
    row = rows[0]
    side = (rays.y > 0.0).astype(np.intp)
    lateral = np.maximum(np.abs(rays.y), _LEAST)
    own = wall_met(row, side, rays.chainage_m, np.zeros_like(lateral), rays.x, lateral)
    near = row.value["distance_m"][own]
    far = near / lateral
    v = in_front(row, own, rays, rays.chainage_m + far * rays.x, far * rays.z, far, lateral)
    amplitude = row.value["reflection"][own] * edge_amplitude(-v)
    opposite = wall_met(row, 1 - side, rays.chainage_m + far * rays.x, -near, rays.x, lateral)
    away = row.value["distance_m"][opposite]
    far = (2.0 * near + away) / lateral
    v = in_front(row, opposite, rays, rays.chainage_m + far * rays.x, far * rays.z, far, lateral)
    amplitude = amplitude * row.value["reflection"][opposite] * edge_amplitude(-v)
    for wall in (own, opposite):
        amplitude = amplitude * roughness_loss(row.value["roughness_m"][wall], lateral, rays.wavelength_m)
    if antenna is not None:
        right, left = circular_reflection(lateral, antenna.wall_permittivity)
        cross = 2.0 * right * left * cross_polar_gain(rays.z, antenna)
        amplitude = amplitude * np.sqrt((right**2 + left**2) ** 2 + cross**2)
    image = -np.sign(rays.y) * 2.0 * (near + away)
    for other in rows:
        amplitude = amplitude * edge_amplitude(shadow(other, rays, y0=image))
    growth = 2.0 * (row.value["slope"][own] + row.value["slope"][opposite]) * lateral
    seen = (np.abs(rays.y) > _LEAST) & (near > 0.5) & (away > 0.5)
    return np.where(seen, amplitude, 0.0), 2.0 * (near + away) * lateral, growth

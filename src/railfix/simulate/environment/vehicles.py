"""Obstruction by vehicles: trains or road vehicles on parallel tracks, and equipment on the vehicle's own roof."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.simulate.environment.diffraction import edge_amplitude, per_metre
from railfix.simulate.environment.settings import NeighbourSettings, RoofEquipment
from railfix.simulate.environment.walls import FREE_V, Rays

_LEAST: float = 1e-3
#: Sign of the lateral component of rays toward a side.
_SIDE: Final = {"right": 1.0, "left": -1.0}


def neighbour_clearance(settings: NeighbourSettings, rays: Rays, time_s: Floats) -> Floats:
    """Fresnel parameter of the vehicles on a parallel track, positive where they are in the way, shape (N,).

    They follow each other at a constant headway and speed, so their places are a function of time alone, on any scale
    that is the same for all calls. Rays to the other side pass.
    """
    lateral = np.maximum(np.abs(rays.y), _LEAST)
    far = settings.lateral_m / lateral
    spacing = settings.spacing_m
    place = np.remainder(rays.chainage_m + far * rays.x - settings.speed_mps * time_s, spacing)
    # Distance inside of the nearest end of the vehicle, negative in a gap.
    ends = np.where(
        place < settings.length_m,
        np.minimum(place, settings.length_m - place),
        -np.minimum(place - settings.length_m, spacing - place),
    )
    level = lateral / np.sqrt(np.maximum(1.0 - rays.z**2, 1e-9))
    rise = lateral / np.sqrt(lateral**2 + rays.z**2)
    top = (settings.height_m - rays.height_m - far * rays.z) * rise
    v = np.minimum(top, ends * level) * per_metre(far, rays.wavelength_m)
    return np.where(rays.y * _SIDE[settings.side] > 0.0, v, FREE_V)


def neighbour_reflection(settings: NeighbourSettings, rays: Rays, time_s: Floats) -> tuple[Floats, Floats, Floats]:
    """Amplitude, extra path [m] and growth [m/m] of reflections by the sides of vehicles on a parallel track."""
    v = neighbour_clearance(settings, replace(rays, y=-rays.y), time_s)
    amplitude = settings.reflection * np.where(rays.y * _SIDE[settings.side] < 0.0, edge_amplitude(-v), 0.0)
    return amplitude, 2.0 * settings.lateral_m * np.abs(rays.y), np.zeros(len(rays.x))


def equipment_amplitude(equipment: tuple[RoofEquipment, ...], rays: Rays) -> Floats:
    """Amplitude left of the direct signal by equipment on the vehicle's own roof, shape (N,)."""
    amplitude = np.ones(len(rays.x))
    for part in equipment:
        along = np.maximum(np.abs(rays.x), _LEAST)
        far = abs(part.ahead_m) / along
        rise = along / np.sqrt(along**2 + rays.z**2)
        aside = along / np.sqrt(np.maximum(1.0 - rays.z**2, 1e-9))
        margin = np.minimum(
            (part.above_antenna_m - far * rays.z) * rise, (part.half_width_m - far * np.abs(rays.y)) * aside
        )
        v = margin * per_metre(far, rays.wavelength_m)
        amplitude = amplitude * np.where(rays.x * part.ahead_m > 0.0, edge_amplitude(v), 1.0)
    return amplitude

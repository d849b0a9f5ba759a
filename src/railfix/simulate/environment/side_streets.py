"""Obstacles beside the line: side streets, trees, vehicles that pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.simulate.environment.diffraction import edge_amplitude, per_metre, roughness_loss
from railfix.simulate.environment.settings import NeighbourSettings, RoofEquipment, SideStreetSettings
from railfix.simulate.environment.structures import Strips
from railfix.simulate.environment.walls import FREE_V, Rays, wall_met

#: Least lateral and longitudinal component of a direction that is computed.
_LEAST: float = 0.02


@dataclass(frozen=True, kw_only=True)
class SideStreets:
    """Side streets on one side of the line, n of them, by rising chainage."""

    #: Chainages of the street's edges; the walls stand there; shape (n,).
    start_m: Floats
    end_m: Floats
    #: Distance of the street's mouth from the track's axis, and length of the street's walls; shape (n,).
    front_m: Floats
    depth_m: Floats
    #: Height of the reflecting walls and of the walls across the street, and amplitude that they reflect; shape (n,).
    height_m: Floats
    opposite_m: Floats
    reflection: Floats


def side_streets(settings: SideStreetSettings, *, first_m: float, last_m: float, seed: int, side: int) -> SideStreets:
    """Side streets of one side between two chainages, drawn from the settings."""
    rng = np.random.default_rng([seed, 7104, side])
    rows, at = [], first_m + rng.uniform() * settings.spacing_m[1]
    while at < last_m:
        width = rng.uniform(*settings.width_m)
        pairs = (settings.front_m, settings.depth_m, settings.height_m, settings.opposite_m, settings.reflection)
        rows.append([at, at + width, *(rng.uniform(*pair) for pair in pairs)])
        at += width + rng.uniform(*settings.spacing_m)
    columns = np.array(rows, dtype=np.float64).reshape(-1, 7).T
    return SideStreets(**dict(zip(SideStreets.__dataclass_fields__, columns, strict=True)))


def street_reflections(
    streets: tuple[SideStreets, ...], rays: Rays, *, candidates: int, roughness_m: float
) -> list[tuple[Floats, Floats, Floats, Floats]]:
    """Amplitude, extra path [m], growth [m/m] and cosine of incidence of each candidate street, shapes (N,).

    A satellite behind the train is reflected by a wall ahead that faces it, and the other way round: with the wall's
    plane at a distance D along the line and u the direction to the satellite, the extra path is ``2 D |u_x|``; the
    ray meets the wall ``D |u_y| / |u_x|`` to the side. It must meet the wall within the street, seen through the
    street's mouth, and come in over the walls across the street. The streets are those on the left and on the right;
    `candidates` of them are tried for each ray, from the first that the ray can meet on.
    """
    along, lateral = np.maximum(np.abs(rays.x), _LEAST), np.maximum(np.abs(rays.y), _LEAST)
    ahead = np.where(rays.x < 0.0, 1.0, -1.0)
    found = []
    for k in range(candidates):
        amplitude, extra, growth = np.zeros((3, len(rays.x)))
        for side, street in enumerate(streets):
            if not len(street.start_m):
                continue
            rows = np.flatnonzero((rays.y > 0.0) == (side == 1))
            reach = float(street.front_m.min()) * along[rows] / lateral[rows]
            chainage = rays.chainage_m[rows]
            # The wall ahead stands at the far edge of its street, the wall behind at the near one.
            forward = np.searchsorted(street.end_m, chainage + reach) + k
            backward = np.searchsorted(street.start_m, chainage - reach) - 1 - k
            number = np.where(ahead[rows] > 0.0, forward, backward)
            there = (number >= 0) & (number < len(street.start_m))
            number = np.clip(number, 0, len(street.start_m) - 1)
            wall = np.where(ahead[rows] > 0.0, street.end_m[number], street.start_m[number])
            distance = np.maximum(np.abs(wall - chainage), 1.0)
            far = distance / along[rows]
            aside, height = far * lateral[rows], rays.height_m + far * rays.z[rows]
            front, width = street.front_m[number], street.end_m[number] - street.start_m[number]
            top = street.height_m[number]
            inside = np.minimum(aside - front, front + street.depth_m[number] - aside) * along[rows]
            # Through the mouth: where the ray leaves the street it is at most the street's width before the wall.
            mouth = (width - distance * (1.0 - front / np.maximum(aside, front))) * lateral[rows]
            over = height + rays.z[rows] * width / along[rows] - street.opposite_m[number]
            margin = np.minimum(np.minimum(inside, mouth), np.minimum(top - height, over))
            v = margin * per_metre(far, rays.wavelength_m[rows])
            rough = roughness_loss(np.full(len(rows), roughness_m), along[rows], rays.wavelength_m[rows])
            strength = street.reflection[number] * rough * edge_amplitude(-v)
            amplitude[rows] = np.where(there & (margin > -5.0), strength, 0.0)
            extra[rows] = 2.0 * distance * along[rows]
            growth[rows] = -2.0 * ahead[rows] * along[rows]
        found.append((amplitude, extra, growth, along))
    return found


#: Width of the edge of a crown over which the loss rises [m].
_EDGE_M: float = 0.5
_LEAST_TREE: float = 1e-3


def foliage(row: Strips, rays: Rays) -> tuple[Floats, Floats, Floats]:
    """Amplitude left by the crowns of a row of trees, and amplitude and extra path [m] of their scatter, shapes (N,).

    The loss is the specific attenuation times the way through the crown, taken as long as the crown is wide, and at
    most `most_db` (ITU-R P.833-9, 2.1: the loss saturates); what is lost is partly scattered forward.
    """
    side = (rays.y > 0.0).astype(np.intp)
    lateral = np.maximum(np.abs(rays.y), _LEAST_TREE)
    tree = wall_met(row, side, rays.chainage_m, np.zeros_like(lateral), rays.x, lateral)
    value = {name: column[tree] for name, column in row.value.items()}
    far = value["distance_m"] / lateral
    height = rays.height_m + far * rays.z
    place = rays.chainage_m + far * rays.x
    inside = np.minimum(
        np.minimum(place - row.start_m[tree], row.end_m[tree] - place),
        np.minimum(value["height_m"] - height, height - value["crown_m"]),
    )
    share = np.clip(0.5 + inside / _EDGE_M, 0.0, 1.0)
    way = (row.end_m[tree] - row.start_m[tree]) / np.sqrt(np.maximum(1.0 - rays.z**2, 0.04))
    loss_db = np.minimum(value["attenuation_db_per_m"] * way, value["most_db"]) * share
    left = 10.0 ** (-loss_db / 20.0)
    return left, value["scatter"] * (1.0 - left), 0.5 * way * (1.0 + rays.x)


_LEAST_VEHICLE: float = 1e-3
#: Sign of the lateral component of rays toward a side.
_SIDE: Final = {"right": 1.0, "left": -1.0}


def neighbour_clearance(settings: NeighbourSettings, rays: Rays, time_s: Floats) -> Floats:
    """Fresnel parameter of the vehicles on a parallel track, positive where they are in the way, shape (N,).

    They follow each other at a constant headway and speed, so their places are a function of time alone, on any scale
    that is the same for all calls. Rays to the other side pass.
    """
    lateral = np.maximum(np.abs(rays.y), _LEAST_VEHICLE)
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
        along = np.maximum(np.abs(rays.x), _LEAST_VEHICLE)
        far = abs(part.ahead_m) / along
        rise = along / np.sqrt(along**2 + rays.z**2)
        aside = along / np.sqrt(np.maximum(1.0 - rays.z**2, 1e-9))
        margin = np.minimum(
            (part.above_antenna_m - far * rays.z) * rise, (part.half_width_m - far * np.abs(rays.y)) * aside
        )
        v = margin * per_metre(far, rays.wavelength_m)
        amplitude = amplitude * np.where(rays.x * part.ahead_m > 0.0, edge_amplitude(v), 1.0)
    return amplitude

"""Reflections by walls along side streets, square to the line: far away, ahead of the train or behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats
from railfix.simulate.environment.diffraction import edge_amplitude, per_metre, roughness_loss
from railfix.simulate.environment.settings import SideStreetSettings
from railfix.simulate.environment.walls import Rays

#: Least lateral and longitudinal component of a direction that is computed.
_LEAST: float = 0.02


@dataclass(frozen=True, kw_only=True)
class SideStreets:
    """Side streets on one side of the line, n of them, by rising chainage.

    Attributes
    ----------
    start_m, end_m : ndarray, shape (n,) [m]
        Chainages of the street's edges; the walls stand there.
    front_m, depth_m : ndarray, shape (n,) [m]
        Distance of the street's mouth from the track's axis, and length of the street's walls.
    height_m, opposite_m, reflection : ndarray, shape (n,)
        Height of the reflecting walls and of the walls across the street, and amplitude that they reflect.
    """

    start_m: Floats
    end_m: Floats
    front_m: Floats
    depth_m: Floats
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

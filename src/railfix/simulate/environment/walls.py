"""Vertical walls along the line, side streets, trees, vehicles: shadowing and specular reflection.

Frame of the antenna: x along the line (rising chainage), y to the right, z up; the line is assumed straight near it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, RowArrays
from railfix.simulate.environment.correlator import (
    circular_reflection,
    cross_polar_gain,
    edge_amplitude,
    per_metre,
    roughness_loss,
)
from railfix.simulate.environment.settings import AntennaSettings, NeighbourSettings, RoofEquipment, SideStreetSettings
from railfix.simulate.environment.structures import Strips

FREE_V: Final = -99.0  #: Fresnel parameter of an unobstructed ray.
_LEAST_LATERAL: Final = 1e-3  #: Least component of a direction: rays along the line meet no wall, tree or vehicle.


@dataclass(frozen=True, kw_only=True)
class Rays(RowArrays):
    """N directions to satellites from one antenna's positions."""

    chainage_m: Floats  #: Shape (N,).
    height_m: float  #: Height of the antenna over the rails.
    #: Unit vector to the satellite, shape (N,).
    x: Floats
    y: Floats
    z: Floats
    wavelength_m: Floats  #: Shape (N,).


def _slants(across: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return sines of the angles at which rays pass a level edge and a vertical one, by their component across both."""
    size = np.abs(across)
    return size / np.sqrt(across**2 + z**2), size / np.sqrt(np.maximum(1.0 - z**2, 1e-9))


def wall_met(row: Strips, side: Indices, x0: Floats, lateral0: Floats, along: Floats, lateral: Floats) -> Indices:
    """Return the index of the wall that a horizontal ray meets, starting from the distance of the wall abeam."""
    distance = row.value["distance_m"]
    slant = along / lateral
    wall = row.nearest(side, x0)
    for _ in range(2):
        wall = row.nearest(side, x0 + (distance[wall] - lateral0) * slant)
    return wall


def in_front(row: Strips, wall: Indices, rays: Rays, x: Floats, z: Floats, far_m: Floats, across: Floats) -> Floats:
    """Return the Fresnel parameter of a ray at a wall with level top and vertical ends, positive inside its outline."""
    scale = per_metre(far_m, rays.wavelength_m)
    rise, level = _slants(across, rays.z)
    top = (row.value["height_m"][wall] - rays.height_m - z) * rise
    ends = np.minimum(x - row.start_m[wall], row.end_m[wall] - x) * level
    return np.minimum(top, ends) * scale


def shadow(row: Strips, rays: Rays, *, x0: Floats | float = 0.0, y0: Floats | float = 0.0) -> Floats:
    """Return the Fresnel parameter of the walls of a row that obstruct the satellites from `x0`, `y0`, shape (N,)."""
    side = (rays.y > 0.0).astype(np.intp)
    lateral = np.maximum(np.abs(rays.y), _LEAST_LATERAL)
    begin = np.where(rays.y > 0.0, 1.0, -1.0) * y0
    start = rays.chainage_m + x0
    wall = wall_met(row, side, start, begin, rays.x, lateral)
    slope = row.value["slope"][wall]
    middle = 0.5 * (row.start_m[wall] + row.end_m[wall])
    far = (row.value["distance_m"][wall] + (start - middle) * slope - begin) / np.maximum(
        lateral - rays.x * slope, _LEAST_LATERAL
    )
    v = in_front(row, wall, rays, start + far * rays.x, far * rays.z, far, lateral)
    return np.where(far > 0.0, np.maximum(v, FREE_V), FREE_V)


@dataclass(frozen=True, kw_only=True)
class Reflections:
    """Reflections by one row of walls, shapes (N,)."""

    amplitude: Floats  #: 0 where the wall is absent or too small.
    extra_m: Floats  #: Excess over the direct path.
    rate: Floats  #: Growth of the excess with the antenna's chainage [m/m].
    #: Mirror image of the antenna, from the antenna.
    x_m: Floats
    y_m: Floats
    #: Horizontal direction of arrival.
    back_x: Floats
    back_y: Floats
    cosine: Floats  #: Cosine of the angle of incidence from the wall's normal.


def reflections(row: Strips, rays: Rays) -> Reflections:
    """Mirror each satellite in the row on the other side: extra path 2 D (-n . u), n the normal of its plane."""
    sign = np.where(rays.y > 0.0, -1.0, 1.0)
    lateral = np.maximum(np.abs(rays.y), _LEAST_LATERAL)
    wall = wall_met(row, (sign > 0.0).astype(np.intp), rays.chainage_m, np.zeros_like(lateral), rays.x, lateral)
    slope = row.value["slope"][wall]
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    sine = slope * cosine
    middle = 0.5 * (row.start_m[wall] + row.end_m[wall])
    distance = (row.value["distance_m"][wall] + (rays.chainage_m - middle) * slope) * cosine
    # Normal (-sine, cosine) in (x, lateral); the satellite is at (x, -lateral).
    facing = sine * rays.x + cosine * lateral
    back_x = rays.x - 2.0 * facing * sine
    back = -lateral + 2.0 * facing * cosine
    seen = (distance > 0.5) & (facing > 0.01) & (back > 0.01)
    far = np.where(seen, distance / np.maximum(facing, 0.01), 1.0)
    v = in_front(row, wall, rays, rays.chainage_m + far * back_x, far * rays.z, far, back)
    strength = row.value["reflection"][wall] * roughness_loss(row.value["roughness_m"][wall], facing, rays.wavelength_m)
    return Reflections(
        amplitude=np.where(seen, strength * edge_amplitude(-v), 0.0),
        extra_m=2.0 * distance * facing,
        rate=2.0 * sine * facing,
        x_m=-2.0 * distance * sine,
        y_m=sign * 2.0 * distance * cosine,
        back_x=back_x,
        back_y=sign * back,
        cosine=np.maximum(facing, 0.0),
    )


def roof_amplitude(row: Strips, rays: Rays) -> Floats:
    """Return the amplitude left by the level roofs of a row, shape (N,)."""
    side = (rays.y > 0.0).astype(np.intp)
    least = np.maximum(rays.z, 0.02)
    # Roofs of one row are nearly always at one height: the roof overhead gives the first guess.
    roof = row.nearest(side, rays.chainage_m)
    for _ in range(2):
        far = (row.value["height_m"][roof] - rays.height_m) / least
        roof = row.nearest(side, rays.chainage_m + far * rays.x)
    far = (row.value["height_m"][roof] - rays.height_m) / least
    x, lateral = rays.chainage_m + far * rays.x, far * np.abs(rays.y)
    inner = row.value["inner_m"][roof]
    # A roof over the track has no edge in its middle.
    across = np.minimum(np.where(inner > 0.0, lateral - inner, 1e3), row.value["outer_m"][roof] - lateral)
    along = np.minimum(x - row.start_m[roof], row.end_m[roof] - x)
    scale = per_metre(far, rays.wavelength_m)
    outward = across * rays.z / np.sqrt(rays.y**2 + rays.z**2 + 1e-12)
    onward = along * rays.z / np.sqrt(rays.x**2 + rays.z**2 + 1e-12)
    v = scale * np.minimum(outward, onward)
    over = far > 0.0
    return np.where(over, np.maximum(edge_amplitude(v), np.where(v > 0.0, row.value["through"][roof], 0.0)), 1.0)


_LEAST_TWICE: Final = 0.05  #: Path of rays that are reflected twice.


def second_reflection(
    rows: tuple[Strips, ...], rays: Rays, antenna: AntennaSettings | None
) -> tuple[Floats, Floats, Floats]:
    """Reflect by both sides: amplitude, extra path ``2 (d_A + d_B) |u_y|`` [m] and growth [m/m], shapes (N,)."""
    row = rows[0]
    side = (rays.y > 0.0).astype(np.intp)
    lateral = np.maximum(np.abs(rays.y), _LEAST_TWICE)
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
    seen = (np.abs(rays.y) > _LEAST_TWICE) & (near > 0.5) & (away > 0.5)
    return np.where(seen, amplitude, 0.0), 2.0 * (near + away) * lateral, growth


_LEAST_SIDE: Final = 0.02  #: Lower limit of the lateral and longitudinal components of a direction.


@dataclass(frozen=True, kw_only=True)
class SideStreets:
    """Side streets on one side of the line, n of them, by rising chainage."""

    #: Chainages of the street's edges, where the walls are; shape (n,).
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
    """Return the side streets of one side between two chainages, drawn from the settings."""
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
    """Amplitude, extra path ``2 D |u_x|`` [m], growth [m/m] and cosine of incidence of the reflection of each candidate
    street, by a wall across at a distance D along the line, shapes (N,).
    """
    along, lateral = np.maximum(np.abs(rays.x), _LEAST_SIDE), np.maximum(np.abs(rays.y), _LEAST_SIDE)
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
            # The wall ahead is at the far edge of its street, the wall behind at the near edge.
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


_EDGE_M: Final = 0.5  #: Width of the edge of a crown over which the loss rises [m].


def foliage(row: Strips, rays: Rays) -> tuple[Floats, Floats, Floats]:
    """Amplitude left by trees, amplitude and extra path [m] of their scatter, shapes (N,) (ITU-R P.833-9, 2.1)."""
    side = (rays.y > 0.0).astype(np.intp)
    lateral = np.maximum(np.abs(rays.y), _LEAST_LATERAL)
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


_SIDE: Final = {"right": 1.0, "left": -1.0}  #: Sign of the lateral component of rays toward a side.


def neighbour_clearance(settings: NeighbourSettings, rays: Rays, time_s: Floats) -> Floats:
    """Return the Fresnel parameter of the vehicles on a parallel track, positive where obstructing, shape (N,)."""
    lateral = np.maximum(np.abs(rays.y), _LEAST_LATERAL)
    far = settings.lateral_m / lateral
    spacing = settings.spacing_m
    place = np.remainder(rays.chainage_m + far * rays.x - settings.speed_mps * time_s, spacing)
    # Distance inside of the nearest end of the vehicle, negative in a gap.
    ends = np.where(
        place < settings.length_m,
        np.minimum(place, settings.length_m - place),
        -np.minimum(place - settings.length_m, spacing - place),
    )
    rise, level = _slants(lateral, rays.z)
    top = (settings.height_m - rays.height_m - far * rays.z) * rise
    v = np.minimum(top, ends * level) * per_metre(far, rays.wavelength_m)
    return np.where(rays.y * _SIDE[settings.side] > 0.0, v, FREE_V)


def neighbour_reflection(settings: NeighbourSettings, rays: Rays, time_s: Floats) -> tuple[Floats, Floats, Floats]:
    """Return amplitude, extra path [m] and growth [m/m] of reflections by the sides of vehicles on a parallel track."""
    v = neighbour_clearance(settings, replace(rays, y=-rays.y), time_s)
    amplitude = settings.reflection * np.where(rays.y * _SIDE[settings.side] < 0.0, edge_amplitude(-v), 0.0)
    return amplitude, 2.0 * settings.lateral_m * np.abs(rays.y), np.zeros(len(rays.x))


def equipment_amplitude(equipment: tuple[RoofEquipment, ...], rays: Rays) -> Floats:
    """Return the remaining amplitude of the direct signal after equipment on the vehicle's own roof, shape (N,)."""
    amplitude = np.ones(len(rays.x))
    for part in equipment:
        along = np.maximum(np.abs(rays.x), _LEAST_LATERAL)
        far = abs(part.ahead_m) / along
        rise, aside = _slants(along, rays.z)
        margin = np.minimum(
            (part.above_antenna_m - far * rays.z) * rise, (part.half_width_m - far * np.abs(rays.y)) * aside
        )
        v = margin * per_metre(far, rays.wavelength_m)
        amplitude = amplitude * np.where(rays.x * part.ahead_m > 0.0, edge_amplitude(v), 1.0)
    return amplitude

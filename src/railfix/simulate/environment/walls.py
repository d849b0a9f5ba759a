"""Shadowing and specular reflection by vertical walls along the line, side streets, trees and vehicles.

Coordinates are relative to the antenna: x along the line (rising chainage), y to the right, z up. The line is assumed
to be straight near the antenna.
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
#: Smaller lateral components of rays are replaced by this, which avoids division by zero for rays parallel to a wall.
_LEAST_LATERAL: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class Rays(RowArrays):
    """N directions from positions of an antenna to satellites."""

    chainage_m: Floats  #: Chainage of the antenna, shape (N,).
    height_m: float  #: Height of the antenna above the rails.
    x: Floats  #: Component x of the unit vector to the satellite, shape (N,).
    y: Floats  #: Component y of the unit vector to the satellite, shape (N,).
    z: Floats  #: Component z of the unit vector to the satellite, shape (N,).
    wavelength_m: Floats  #: Wavelength of the signal, shape (N,).


def _slants(across: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return the sines of the angles between rays and a horizontal edge, and between rays and a vertical edge.

    `across` is the component of the ray's unit vector perpendicular to the plane of the two edges.
    """
    size = np.abs(across)
    return size / np.sqrt(across**2 + z**2), size / np.sqrt(np.maximum(1.0 - z**2, 1e-9))


def wall_met(row: Strips, side: Indices, x0: Floats, lateral0: Floats, along: Floats, lateral: Floats) -> Indices:
    """Return the index of the wall of a row that a ray meets in plan, shape (N,).

    The ray starts at the chainage `x0` and lateral distance `lateral0`, with direction components `along` and
    `lateral`. The wall is found by iteration, starting with the distance of the wall abeam.
    """
    distance = row.value["distance_m"]
    slant = along / lateral
    wall = row.nearest(side, x0)
    for _ in range(2):
        wall = row.nearest(side, x0 + (distance[wall] - lateral0) * slant)
    return wall


def in_front(row: Strips, wall: Indices, rays: Rays, x: Floats, z: Floats, far_m: Floats, across: Floats) -> Floats:
    """Return the Fresnel parameter of rays at walls with level top and vertical ends, positive inside the outline.

    `x` is the chainage and `z` the height above the antenna at which the ray meets the plane of the wall, `far_m` is
    the distance from the antenna, and `across` the component of the ray perpendicular to the wall.
    """
    scale = per_metre(far_m, rays.wavelength_m)
    rise, level = _slants(across, rays.z)
    top = (row.value["height_m"][wall] - rays.height_m - z) * rise
    ends = np.minimum(x - row.start_m[wall], row.end_m[wall] - x) * level
    return np.minimum(top, ends) * scale


def shadow(row: Strips, rays: Rays, *, x0: Floats | float = 0.0, y0: Floats | float = 0.0) -> Floats:
    """Return the Fresnel parameter of the walls of a row on the side of the satellites, positive in the shadow, (N,).

    The rays start at the point (`x0`, `y0`) relative to the antenna. The parameter is at least `FREE_V`.
    """
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
    """Reflections of N rays by one row of walls, shapes (N,)."""

    amplitude: Floats  #: Amplitude of the reflection; nearly 0 where the wall is absent or too small.
    extra_m: Floats  #: Path of the reflection minus path of the direct signal.
    rate: Floats  #: Growth of the extra path with the chainage of the antenna [m/m].
    x_m: Floats  #: Coordinate x of the mirror image of the antenna, relative to the antenna.
    y_m: Floats  #: Coordinate y of the mirror image of the antenna, relative to the antenna.
    back_x: Floats  #: Component x of the unit vector from the antenna toward the reflected signal.
    back_y: Floats  #: Component y of the unit vector from the antenna toward the reflected signal.
    cosine: Floats  #: Cosine of the angle of incidence from the normal of the wall.


def reflections(row: Strips, rays: Rays) -> Reflections:
    """Return the reflections of signals by a row of walls on the side opposite the satellites.

    The extra path is 2 D (-n . u) with the distance D of the wall, the normal n of the wall and the unit vector u to
    the satellite.
    """
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
    """Return the ratio of the amplitudes of signals with and without the level roofs of a row, shape (N,)."""
    side = (rays.y > 0.0).astype(np.intp)
    least = np.maximum(rays.z, 0.02)
    # Roofs of a row mostly have the same height, so the roof overhead is a good first approximation.
    roof = row.nearest(side, rays.chainage_m)
    for _ in range(2):
        far = (row.value["height_m"][roof] - rays.height_m) / least
        roof = row.nearest(side, rays.chainage_m + far * rays.x)
    far = (row.value["height_m"][roof] - rays.height_m) / least
    x, lateral = rays.chainage_m + far * rays.x, far * np.abs(rays.y)
    inner = row.value["inner_m"][roof]
    # A roof over the track (inner_m = 0) has no inner edge.
    across = np.minimum(np.where(inner > 0.0, lateral - inner, 1e3), row.value["outer_m"][roof] - lateral)
    along = np.minimum(x - row.start_m[roof], row.end_m[roof] - x)
    scale = per_metre(far, rays.wavelength_m)
    outward = across * rays.z / np.sqrt(rays.y**2 + rays.z**2 + 1e-12)
    onward = along * rays.z / np.sqrt(rays.x**2 + rays.z**2 + 1e-12)
    v = scale * np.minimum(outward, onward)
    over = far > 0.0
    return np.where(over, np.maximum(edge_amplitude(v), np.where(v > 0.0, row.value["through"][roof], 0.0)), 1.0)


_LEAST_TWICE: Final = 0.05  #: Rays with a smaller lateral component have no second reflection.


def second_reflection(
    rows: tuple[Strips, ...], rays: Rays, antenna: AntennaSettings | None
) -> tuple[Floats, Floats, Floats]:
    """Return amplitude, extra path [m] and growth [m/m] of signals reflected twice, once on each side; shapes (N,).

    The extra path is ``2 (d_A + d_B) |u_y|`` with the distances d_A and d_B of the first wall row on each side.
    """
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


#: For reflections by side streets, smaller lateral and longitudinal components of rays are replaced by this.
_LEAST_SIDE: Final = 0.02


@dataclass(frozen=True, kw_only=True)
class SideStreets:
    """n side streets on one side of the line, in ascending order of chainage."""

    start_m: Floats  #: Chainage of the near wall, shape (n,).
    end_m: Floats  #: Chainage of the far wall, shape (n,).
    front_m: Floats  #: Distance of the mouth of the street from the track axis, shape (n,).
    depth_m: Floats  #: Length of the walls of the street, shape (n,).
    height_m: Floats  #: Height of the reflecting wall above the rails, shape (n,).
    opposite_m: Floats  #: Height of the opposite wall of the street above the rails, shape (n,).
    reflection: Floats  #: Amplitude reflection coefficient, shape (n,).


def side_streets(settings: SideStreetSettings, *, first_m: float, last_m: float, seed: int, side: int) -> SideStreets:
    """Return the side streets on one side (0 left, 1 right) between two chainages, drawn from the seed."""
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
    """Return the reflections by the walls of side streets, one per candidate street.

    A reflection has amplitude, extra path [m], growth [m/m] and cosine of incidence, of shape (N,). The extra path is
    ``2 D |u_x|`` for a wall perpendicular to the line at a distance D along the line.
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
            # The ray must pass through the mouth of the street: there, its distance from the wall must be less than the
            # street's width.
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


_EDGE_M: Final = 0.5  #: At the edge of a crown, the loss increases from 0 to its full value over this distance [m].


def foliage(row: Strips, rays: Rays) -> tuple[Floats, Floats, Floats]:
    """Return the effect of a row of trees on the side of the satellites, shapes (N,) (ITU-R P.833-9, 2.1).

    The results are the amplitude factor of the direct signal, and amplitude and extra path [m] of the scattered signal.
    """
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


_SIDE: Final = {"right": 1.0, "left": -1.0}  #: Sign of the coordinate y on each side of the line.


def neighbour_clearance(settings: NeighbourSettings, rays: Rays, time_s: Floats) -> Floats:
    """Return the Fresnel parameter of vehicles on a parallel track, positive where they obstruct, shape (N,).

    `time_s` is the time of day, which determines the positions of the vehicles.
    """
    lateral = np.maximum(np.abs(rays.y), _LEAST_LATERAL)
    far = settings.lateral_m / lateral
    spacing = settings.spacing_m
    place = np.remainder(rays.chainage_m + far * rays.x - settings.speed_mps * time_s, spacing)
    # Distance to the nearest end of a vehicle, positive beside the vehicle, negative in a gap between vehicles.
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
    """Return amplitude, extra path [m] and growth [m/m] of reflections by vehicles on a parallel track, shapes (N,)."""
    v = neighbour_clearance(settings, replace(rays, y=-rays.y), time_s)
    amplitude = settings.reflection * np.where(rays.y * _SIDE[settings.side] < 0.0, edge_amplitude(-v), 0.0)
    return amplitude, 2.0 * settings.lateral_m * np.abs(rays.y), np.zeros(len(rays.x))


def equipment_amplitude(equipment: tuple[RoofEquipment, ...], rays: Rays) -> Floats:
    """Return the factor by which equipment on the roof reduces the amplitude of the direct signal, shape (N,)."""
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

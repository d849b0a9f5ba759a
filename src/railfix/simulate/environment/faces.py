"""Rays and upright faces along the line: shadows behind them, mirror images in them.

Frame of the antenna: x along the line (rising chainage), y to the right, z up; about one antenna the
line is taken as straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.simulate.environment.place import Strips
from railfix.simulate.environment.waves import edge_amplitude, per_metre, roughness_loss

#: Fresnel parameter where nothing is in the way.
FREE_V: Final = -99.0
#: Lateral part of a direction is at least this: rays along the line meet no face.
_LEAST_LATERAL: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class Rays:
    """N directions to satellites from one antenna's places.

    Attributes
    ----------
    chainage_m : ndarray, shape (N,)
    height_m : float
        Of the antenna over the rails.
    x, y, z : ndarray, shape (N,)
        Unit vector to the satellite.
    wavelength_m : ndarray, shape (N,)
    """

    chainage_m: Floats
    height_m: float
    x: Floats
    y: Floats
    z: Floats
    wavelength_m: Floats

    def take(self, rows: Indices) -> Rays:
        """Some of them."""
        return Rays(
            chainage_m=self.chainage_m[rows],
            height_m=self.height_m,
            x=self.x[rows],
            y=self.y[rows],
            z=self.z[rows],
            wavelength_m=self.wavelength_m[rows],
        )


def _met(row: Strips, side: Indices, x0: Floats, lateral0: Floats, along: Floats, lateral: Floats) -> Indices:
    """Index of the face that a level ray meets: from (x0, lateral0), growing by (along, lateral).

    Faces stand at various distances, so the place is found twice: with the distance of the face
    abeam, then with that of the face found.
    """
    distance = row.value["distance_m"]
    slant = along / lateral
    found = row.nearest(side, x0)
    for _ in range(2):
        found = row.nearest(side, x0 + (distance[found] - lateral0) * slant)
    return found


def _in_front(row: Strips, face: Indices, rays: Rays, x: Floats, z: Floats, far_m: Floats, across: Floats) -> Floats:
    """Fresnel parameter of a ray at a face: positive inside its outline.

    `across` is the lateral part of the ray's direction; the top edge is level, the ends are upright.
    """
    scale = per_metre(far_m, rays.wavelength_m)
    rise = np.abs(across) / np.sqrt(across**2 + rays.z**2)
    level = np.abs(across) / np.sqrt(np.maximum(1.0 - rays.z**2, 1e-9))
    top = (row.value["height_m"][face] - rays.height_m - z) * rise
    ends = np.minimum(x - row.start_m[face], row.end_m[face] - x) * level
    return np.minimum(top, ends) * scale


def shadow(row: Strips, rays: Rays, *, x0: Floats | float = 0.0, y0: Floats | float = 0.0) -> Floats:
    """Fresnel parameter of the faces of a row in the way to the satellites, shape (N,).

    Parameters
    ----------
    row : Strips
    rays : Rays
    x0, y0 : ndarray or float [m]
        Where the rays begin, from the antenna: a mirror image of it.
    """
    side = (rays.y > 0.0).astype(np.intp)
    lateral = np.maximum(np.abs(rays.y), _LEAST_LATERAL)
    begin = np.where(rays.y > 0.0, 1.0, -1.0) * y0
    start = rays.chainage_m + x0
    face = _met(row, side, start, begin, rays.x, lateral)
    slope = row.value["slope"][face]
    middle = 0.5 * (row.start_m[face] + row.end_m[face])
    far = (row.value["distance_m"][face] + (start - middle) * slope - begin) / np.maximum(
        lateral - rays.x * slope, _LEAST_LATERAL
    )
    v = _in_front(row, face, rays, start + far * rays.x, far * rays.z, far, lateral)
    return np.where(far > 0.0, np.maximum(v, FREE_V), FREE_V)


@dataclass(frozen=True, kw_only=True)
class Mirrored:
    """Reflections by one row of faces, shapes (N,).

    Attributes
    ----------
    amplitude : ndarray
        0 where the face is absent or too small.
    extra_m : ndarray [m]
        By which the path is longer than the direct one.
    rate : ndarray
        By which that grows with the antenna's way along the line [m/m].
    x_m, y_m : ndarray [m]
        Mirror image of the antenna, from the antenna.
    back_x, back_y : ndarray
        Direction from which the reflection comes.
    far_m : ndarray [m]
        From the antenna to the place of reflection.
    """

    amplitude: Floats
    extra_m: Floats
    rate: Floats
    x_m: Floats
    y_m: Floats
    back_x: Floats
    back_y: Floats
    far_m: Floats


def mirrored(row: Strips, rays: Rays) -> Mirrored:
    """Reflection of each satellite in the row on the other side of the line.

    Extra path 2 D (-n . u) with D the distance from the antenna to the face's plane and n its normal
    away from the antenna (image method).
    """
    sign = np.where(rays.y > 0.0, -1.0, 1.0)
    lateral = np.maximum(np.abs(rays.y), _LEAST_LATERAL)
    face = _met(row, (sign > 0.0).astype(np.intp), rays.chainage_m, np.zeros_like(lateral), rays.x, lateral)
    slope = row.value["slope"][face]
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    sine = slope * cosine
    middle = 0.5 * (row.start_m[face] + row.end_m[face])
    distance = (row.value["distance_m"][face] + (rays.chainage_m - middle) * slope) * cosine
    # Normal (-sine, cosine) in (x, lateral); the satellite stands at (x, -lateral).
    facing = sine * rays.x + cosine * lateral
    back_x = rays.x - 2.0 * facing * sine
    back = -lateral + 2.0 * facing * cosine
    seen = (distance > 0.5) & (facing > 0.01) & (back > 0.01)
    far = np.where(seen, distance / np.maximum(facing, 0.01), 1.0)
    v = _in_front(row, face, rays, rays.chainage_m + far * back_x, far * rays.z, far, back)
    strength = row.value["reflection"][face] * roughness_loss(row.value["roughness_m"][face], facing, rays.wavelength_m)
    return Mirrored(
        amplitude=np.where(seen, strength * edge_amplitude(-v), 0.0),
        extra_m=2.0 * distance * facing,
        rate=2.0 * sine * facing,
        x_m=-2.0 * distance * sine,
        y_m=sign * 2.0 * distance * cosine,
        back_x=back_x,
        back_y=sign * back,
        far_m=far,
    )


def roof_amplitude(row: Strips, rays: Rays) -> Floats:
    """Amplitude left by the level roofs of a row, shape (N,)."""
    side = (rays.y > 0.0).astype(np.intp)
    least = np.maximum(rays.z, 0.02)
    # Roofs of one row are at one height nearly always: the one overhead gives the first guess.
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

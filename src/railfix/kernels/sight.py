"""Distance and direction to a satellite, with Earth rotation (`railfix.core.geodesy.range_with_rotation`)."""

from __future__ import annotations

import math

from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.kernels.compiling import inner

TURN = EARTH_ROTATION_RATE / SPEED_OF_LIGHT


@inner
def sight(sx: float, sy: float, sz: float, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return the range of a satellite at (sx, sy, sz) from (x, y, z) [m], and the unit vector to the satellite."""
    dx, dy, dz = sx - x, sy - y, sz - z
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    inverse = 1.0 / distance
    return distance + TURN * (sx * y - sy * x), dx * inverse, dy * inverse, dz * inverse

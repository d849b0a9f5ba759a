"""Attenuation and scatter by rows of trees."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats
from railfix.simulate.environment.structures import Strips
from railfix.simulate.environment.walls import Rays, wall_met

#: Width of the edge of a crown over which the loss rises [m].
_EDGE_M: float = 0.5
_LEAST: float = 1e-3


def foliage(row: Strips, rays: Rays) -> tuple[Floats, Floats, Floats]:
    """Amplitude left by the crowns of a row of trees, and amplitude and extra path [m] of their scatter, shapes (N,).

    The loss is the specific attenuation times the way through the crown, taken as long as the crown is wide, and at
    most `most_db` (ITU-R P.833-9, 2.1: the loss saturates); what is lost is partly scattered forward.
    """
    side = (rays.y > 0.0).astype(np.intp)
    lateral = np.maximum(np.abs(rays.y), _LEAST)
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

"""A made-up run with multipath: walls beside the line, that hide some satellites and reflect them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from railfix.simulate import Scenario, write_run
from railfix.simulate.environment.settings import Disturbance, SightGeometry


@dataclass(frozen=True, kw_only=True)
class Wall:
    """A wall beside the line, another one across the line that reflects.

    Attributes
    ----------
    first_m, last_m : float [m]
        Chainage of its ends.
    side_deg : float
        Direction of the wall from the vehicle's forward axis.
    away_m : float
        Distance of the reflecting wall, opposite.
    top_deg : float
        Elevation up to which satellites behind the wall are hidden.
    loss_db : float
        By which the reflection is weaker.
    """

    first_m: float
    last_m: float
    side_deg: float
    away_m: float
    top_deg: float
    loss_db: float

    def __call__(self, geometry: SightGeometry) -> Disturbance:
        """The reflection in place of the hidden signal: its detour, and its loss."""
        elevation = np.radians(geometry.elevation_deg)
        behind = np.radians(geometry.azimuth_deg - geometry.heading_deg[:, None] - self.side_deg)
        facing = np.cos(behind)
        inside = (geometry.chainage_m >= self.first_m) & (geometry.chainage_m <= self.last_m)
        hidden = inside[:, None] & (facing > 0.3) & (geometry.elevation_deg < self.top_deg)
        zero = np.zeros(hidden.shape)
        return Disturbance(
            code_m=np.where(hidden, 2.0 * self.away_m * np.cos(elevation) * facing, 0.0),
            phase_m=zero,
            doppler_hz=zero,
            cn0_db=np.where(hidden, -self.loss_db, 0.0),
        )


WALLS: Final = (
    Wall(first_m=90.0, last_m=150.0, side_deg=90.0, away_m=9.0, top_deg=55.0, loss_db=7.0),
    Wall(first_m=230.0, last_m=245.0, side_deg=-90.0, away_m=25.0, top_deg=65.0, loss_db=9.0),
    Wall(first_m=330.0, last_m=420.0, side_deg=-90.0, away_m=15.0, top_deg=50.0, loss_db=6.0),
    Wall(first_m=520.0, last_m=535.0, side_deg=90.0, away_m=40.0, top_deg=70.0, loss_db=11.0),
    Wall(first_m=600.0, last_m=680.0, side_deg=70.0, away_m=20.0, top_deg=60.0, loss_db=8.0),
)


def write_walls(folder: Path) -> dict[str, Path]:
    """The shipped run with `WALLS`, as files."""
    return write_run(Scenario(multipath=WALLS), folder, packing="plain", command="tests/studies/multipath_run.py")

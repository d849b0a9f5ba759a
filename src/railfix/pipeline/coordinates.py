"""Coordinates of positions along a trajectory, computed at their first use."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from railfix.core.arrays import Floats
from railfix.core.geodesy import geodetic_from_ecef
from railfix.track.track import interpolate_kilometrage
from railfix.track.trajectory import Trajectory


class LineCoordinates:
    """Base of dataclasses with arc lengths `arc_m` of T epochs on a trajectory; NaN at epochs without a position."""

    if TYPE_CHECKING:  # fields of the dataclass

        @property
        def trajectory(self) -> Trajectory:
            """Trajectory of the antenna."""

        @property
        def arc_m(self) -> Floats:
            """Arc lengths of the positions, shape (T,) [m]."""

    @cached_property
    def chainage_m(self) -> Floats:
        """Chainage of the vehicle point to which the trajectory refers, shape (T,) [m]."""
        return self.trajectory.chainage_at(self.arc_m)

    @cached_property
    def kilometrage_m(self) -> Floats:
        """Kilometrage as marked on the line, shape (T,) [m]; NaN where the map has none."""
        line = self.trajectory
        return interpolate_kilometrage(self.chainage_m, line.chainage_m, line.kilometrage_m)

    @cached_property
    def ecef_m(self) -> Floats:
        """Position of the antenna, shape (T, 3) [m]."""
        return self.trajectory.at_arc(self.arc_m)

    @cached_property
    def geodetic(self) -> tuple[Floats, Floats, Floats]:
        """Latitude, longitude [deg] and ellipsoidal height [m] of the antenna, shape (T,) each."""
        return geodetic_from_ecef(self.ecef_m)

    @property
    def latitude_deg(self) -> Floats:
        """Latitude of the antenna, WGS 84, shape (T,) [deg]."""
        return self.geodetic[0]

    @property
    def longitude_deg(self) -> Floats:
        """Longitude of the antenna, WGS 84, shape (T,) [deg]."""
        return self.geodetic[1]

    @property
    def height_m(self) -> Floats:
        """Height of the antenna above the ellipsoid, shape (T,) [m]."""
        return self.geodetic[2]

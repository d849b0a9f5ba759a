"""Trajectories of roof antennas on a vehicle with two bogies (P1 3.1(1)).

The origin of the vehicle frame is midway between the bogie centres at the height of the rail tops. ``along_m`` points
toward the vehicle's front, ``across_m`` to the right, and ``up_m`` perpendicular to the floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from railfix.core.arrays import Floats
from railfix.core.errors import MismatchError, SettingsError, check_type
from railfix.core.geodesy import axes_at, enu_axes
from railfix.core.settings import Settings
from railfix.core.settings_files import load_settings
from railfix.core.staged_files import FilePath
from railfix.track.curves import centre_curve, with_breaks
from railfix.track.map_from_positions import ANTENNA_PATH
from railfix.track.track import Track
from railfix.track.trajectory import Trajectory, joins_m

Reference = Literal["antenna", "centre", "front_bogie", "rear_bogie"]

#: Distance between the contact points of an axle's wheels, minus the gauge; about the width of a rail head [m].
RAIL_HEAD_M: Final = 0.070
PATH_TOLERANCE_M: Final = 0.004  #: Largest deviation of the antenna's path from the chord between two points [m].
_INNER: Final = np.array([0.25, 0.5, 0.75])  #: Fractions of a segment where chord and antenna path are compared.
#: Shortest segment of the antenna's path [m].
_SHORTEST_M: Final = 0.25
_MAX_ITERATIONS: Final = 200
_CONVERGED_M: Final = 1e-7  #: Iterations end when the result changes by less than this value [m].


class AntennaOffset(Settings):
    """Position of the phase centre of one antenna in the vehicle frame [m]."""

    model_config = ConfigDict(strict=True)
    along_m: float = Field(ge=-30.0, le=30.0)
    across_m: float = Field(default=0.0, ge=-2.5, le=2.5)
    up_m: float = Field(ge=0.0, le=8.0)


class Vehicle(Settings):
    """Vehicle dimensions and antennas, as in a vehicle file (TOML)."""

    model_config = ConfigDict(strict=True)
    name: str = "vehicle"
    bogie_distance_m: float = Field(gt=0.5, le=30.0)  #: Straight distance between the two bogie centres.
    #: Track gauge. Cant is measured over the distance between the contact points, `gauge_m` + `RAIL_HEAD_M`.
    gauge_m: float = Field(default=1.067, ge=0.5, le=2.0)
    facing: Literal["rising", "falling"] = "rising"  #: Whether the front points to rising or falling chainage.
    #: Length of the vehicle over buffers or couplers; None if unknown.
    length_m: float | None = Field(default=None, gt=0.0, le=1000.0)
    #: Distance from the midpoint between the bogies to the front end; if None, half of `length_m`.
    front_end_m: float | None = Field(default=None, ge=0.0, le=1000.0)
    antennas: dict[Literal["front", "rear"], AntennaOffset] = Field(min_length=1)  #: Positions of the antennas by name.

    @property
    def contact_spacing_m(self) -> float:
        """Distance between the contact points of the two wheels of an axle [m]."""
        return self.gauge_m + RAIL_HEAD_M

    @property
    def ends_m(self) -> tuple[float | None, float | None]:
        """Distances from the midpoint between the bogies forward to the front end, and back to the rear end [m].

        The values are None where unknown.
        """
        if self.length_m is None:
            return self.front_end_m, None
        front = self.length_m / 2.0 if self.front_end_m is None else self.front_end_m
        return front, self.length_m - front

    @model_validator(mode="after")
    def _front_end_on_vehicle(self) -> Self:
        if self.length_m is not None and self.front_end_m is not None and self.front_end_m > self.length_m:
            raise ValueError("front_end_m must be at most length_m, so that the bogies' midpoint is between the ends")
        return self


def read_vehicle(path: FilePath) -> Vehicle:
    """Read a vehicle file (TOML).

    Raise InputFileError if the file is missing or not TOML, and SettingsError if a key is unknown, missing or out of
    range.
    """
    return load_settings(Vehicle, path, what="a vehicle file")


@dataclass(frozen=True, kw_only=True)
class Body:
    """Positions and attitudes of the car body at n chainages.

    The axes are defined for a vehicle that faces rising chainage.
    """

    lower_m: Floats  #: Lower of the chainages of the two bogie centres, shape (n,).
    upper_m: Floats  #: Higher of the chainages of the two bogie centres, shape (n,).
    origin: Floats  #: ECEF position midway between the bogie centres, shape (n, 3) [m].
    #: Unit vectors in ECEF along the body's axes forward, right and up, shape (n, 3) each.
    forward: Floats
    right: Floats
    up: Floats
    roll_rad: Floats  #: Roll to the right, shape (n,).


class _VehicleLine:
    """Centreline and roll due to cant, as functions of chainage; a closed line continues beyond its ends."""

    def __init__(self, track: Track, contact_spacing_m: float) -> None:
        self.chainage = track.chainage_m
        self.points = track.ecef_m
        step = np.diff(self.chainage)
        if not (step > 0).all():
            i = int(np.argmin(step))
            raise ValueError(f"points {i} and {i + 1} of the track are equal")
        self.curve = centre_curve(track)
        cant, self.notes = _sign_cant(track)
        if (np.abs(cant) >= contact_spacing_m).any():
            raise MismatchError(
                f"{track.name}: a cant of {np.abs(cant).max():g} m exceeds the width of the track; it may be in mm"
            )
        self.ramps = with_breaks(track.chainage_m, np.arcsin(cant / contact_spacing_m))
        self.joins = joins_m(self.chainage, self.points)

    @property
    def open_ends(self) -> tuple[bool, bool]:
        """Return whether the line is open at its start, and at its end."""
        return bool(np.isnan(self.joins[0])), bool(np.isnan(self.joins[1]))

    def at(self, chainage: Floats) -> Floats:
        """Return ECEF points, shape (n, 3) [m]; at an open end, the last segment is extended straight."""
        points = self._straight_on(chainage)
        before, after = self.joins
        ends = (
            (chainage < 0.0, before, self.points[0], before + chainage),
            (chainage > self.chainage[-1], after, self.points[-1], after + chainage - self.chainage[-1]),
        )
        for beyond, join, end, there in ends:
            if not np.isnan(join) and beyond.any():
                gap = end - self._straight_on(np.array([join]))
                points[beyond] = self._straight_on(there[beyond]) + gap
        return points

    def _straight_on(self, chainage: Floats) -> Floats:
        return self.curve.at(chainage)

    def roll_at(self, chainage: Floats) -> Floats:
        """Return the roll due to cant, shape (n,) [rad]; it is constant beyond an open end."""
        before, after = self.joins
        last = self.chainage[-1]
        open_start, open_end = self.open_ends
        there = np.where((chainage < 0.0) & (not open_start), before + chainage, chainage)
        there = np.where((chainage > last) & (not open_end), after + chainage - last, there)
        return np.interp(there, *self.ramps)


def _sign_cant(track: Track) -> tuple[Floats, tuple[str, ...]]:
    """Return the cant, positive for roll to the right, shape (V,) [m], and notes.

    The sign follows from the map's radius or, where the map has no radius, from the bend of the points. On straight
    track, the sign follows from the nearest curve. Raise MismatchError if there is cant but no curve.
    """
    cant = np.where(np.isnan(track.cant_m), 0.0, track.cant_m)
    canted = cant != 0.0
    notes: list[str] = []
    if np.isnan(track.cant_m).all():
        notes.append("the track map has no cant: the body is assumed upright in curves")
    elif np.isnan(track.cant_m).any():
        notes.append(f"cant is assumed to be 0 at {int(np.isnan(track.cant_m).sum())} points where the map has none")
    if not canted.any():
        return cant, tuple(notes)
    with np.errstate(divide="ignore"):
        side = np.where(np.isfinite(track.radius_m), np.sign(track.radius_m), 0.0)
    if (canted & np.isnan(track.radius_m)).any():
        side = np.where(np.isnan(track.radius_m), _side_of_bends(track), side)
        notes.append("where the map has no radius, the side of the cant is taken from the bend of the centreline")
    curved = np.flatnonzero(side)
    if not curved.size:
        raise MismatchError(
            f"{track.name}: the track has cant but no curve, so the side of the cant is unknown; give radius_m"
        )
    place = np.interp(track.chainage_m, track.chainage_m[curved], np.arange(curved.size))
    side = np.where(side == 0.0, side[curved[np.rint(place).astype(np.intp)]], side)
    return cant * side, tuple(notes)


def _side_of_bends(track: Track) -> Floats:
    """Return the direction of curves, shape (V,): 1 to the right, -1 to the left, 0 on straight track."""
    steps = np.diff(track.ecef_m, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    up = enu_axes(track.latitude_deg, track.longitude_deg)[1:-1, 2]
    turn = np.einsum("vi,vi->v", np.cross(steps[1:], steps[:-1]), up)
    return np.concatenate([[0.0], np.where(np.abs(turn) > 1e-5, np.sign(turn), 0.0), [0.0]])


def _bogies(line: _VehicleLine, middle: Floats, distance_m: float, track: Track) -> tuple[Floats, Floats]:
    """Return the chainages of both bogies [m], which are symmetric about `middle` and have a chord of `distance_m`."""
    half = np.full(len(middle), distance_m / 2.0)
    active = np.arange(len(middle))
    for _ in range(_MAX_ITERATIONS):
        chord = np.linalg.norm(line.at(middle[active] + half[active]) - line.at(middle[active] - half[active]), axis=1)
        missing = distance_m - chord
        half[active] += missing / 2.0
        active = active[np.abs(missing) > _CONVERGED_M]
        if not active.size:
            return middle - half, middle + half
    raise MismatchError(
        f"{track.name}: the line turns back on itself near chainage {middle[active[0]]:.1f} m, "
        f"where no bogie distance of {distance_m:g} m fits"
    )


def _pose(line: _VehicleLine, track: Track, vehicle: Vehicle, middle: Floats) -> Body:
    lower, upper = _bogies(line, middle, vehicle.bogie_distance_m, track)
    first, second = line.at(lower), line.at(upper)
    origin = (first + second) / 2.0
    forward = (second - first) / np.linalg.norm(second - first, axis=1, keepdims=True)
    gravity_up = axes_at(origin)[:, 2]
    level_right = np.cross(forward, gravity_up)
    level_right /= np.linalg.norm(level_right, axis=1, keepdims=True)
    level_up = np.cross(level_right, forward)
    roll = (line.roll_at(lower) + line.roll_at(upper)) / 2.0
    cos, sin = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return Body(
        lower_m=lower,
        upper_m=upper,
        origin=origin,
        forward=forward,
        right=cos * level_right - sin * level_up,
        up=cos * level_up + sin * level_right,
        roll_rad=roll,
    )


def _place(body: Body, vehicle: Vehicle, offset: AntennaOffset) -> Floats:
    """Return the ECEF positions of the antenna, shape (n, 3) [m]."""
    sign = 1.0 if vehicle.facing == "rising" else -1.0
    return np.asarray(
        body.origin + sign * offset.along_m * body.forward + sign * offset.across_m * body.right + offset.up_m * body.up
    )


def _abeam(line: _VehicleLine, body: Body, antenna: Floats, along_m: float) -> Floats:
    """Return the chainage [m] where the centreline crosses the antenna's plane normal to `body.forward`."""
    chainage = (body.lower_m + body.upper_m) / 2.0 + along_m
    for _ in range(_MAX_ITERATIONS):
        ahead = np.einsum("vi,vi->v", line.at(chainage) - antenna, body.forward)
        chainage -= ahead
        if np.abs(ahead).max() < _CONVERGED_M:
            return chainage
    raise MismatchError("the line bends so sharply that no point of the line is abeam the antenna")


def _refine(line: _VehicleLine, track: Track, vehicle: Vehicle, offset: AntennaOffset) -> Floats:
    """Return chainages of the body's middle at which the antenna's path is computed [m].

    These are the chainages of the track's points, and further chainages where the path would deviate from a chord by
    more than `PATH_TOLERANCE_M`.
    """
    half = _end_halves(line, track, vehicle)
    first, last = half[0], line.chainage[-1] - half[1]
    if not last - first > 0.0:
        raise MismatchError(
            f"{track.name}: the track is {line.chainage[-1]:.1f} m long, too short for a vehicle with "
            f"{vehicle.bogie_distance_m:g} m between its bogies"
        )
    inner = line.chainage[(line.chainage > first + 0.1) & (line.chainage < last - 0.1)]
    middle = np.concatenate([[first], inner, [last]])
    fine = np.zeros(len(middle) - 1, dtype=np.bool_)
    while True:
        places = _place(_pose(line, track, vehicle, middle), vehicle, offset)
        long = ~fine & (np.diff(middle) > 2.0 * _SHORTEST_M)
        at = np.flatnonzero(long)
        if not at.size:
            return middle
        centre = (middle[at] + middle[at + 1]) / 2.0
        inner = (middle[at, None] + (middle[at + 1] - middle[at])[:, None] * _INNER).ravel()
        true = _place(_pose(line, track, vehicle, inner), vehicle, offset).reshape(len(at), len(_INNER), 3)
        chord = places[at + 1] - places[at]
        chord /= np.linalg.norm(chord, axis=1, keepdims=True)
        off = true - places[at, None]
        off -= np.einsum("vki,vi->vk", off, chord)[..., None] * chord[:, None]
        bent = np.linalg.norm(off, axis=2).max(axis=1) > PATH_TOLERANCE_M
        fine[at[~bent]] = True
        fine = np.insert(fine, at[bent], False)
        middle = np.insert(middle, at[bent] + 1, centre[bent])


def _end_halves(line: _VehicleLine, track: Track, vehicle: Vehicle) -> tuple[float, float]:
    """Return the distance [m] from each end of the track to the body's middle when a bogie is at this end.

    The distance is 0 at an end where a closed track continues.
    """
    first, last = 0.0, line.chainage[-1]
    half = np.where(line.open_ends, vehicle.bogie_distance_m / 2.0, 0.0)
    for _ in range(_MAX_ITERATIONS):
        middle = np.array([first + half[0], last - half[1]])
        lower, upper = _bogies(line, middle, vehicle.bogie_distance_m, track)
        short = np.where(line.open_ends, [first - lower[0], upper[1] - last], 0.0)
        half += short
        if np.abs(short).max() < _CONVERGED_M:
            break
    return float(half[0]), float(half[1])


def antenna_trajectory(
    track: Track, vehicle: Vehicle, antenna: Literal["front", "rear"] = "front", *, reference: Reference = "antenna"
) -> Trajectory:
    """Compute the trajectory of a roof antenna of a vehicle on the track.

    Both bogie centres are on the centreline, with the bogie distance as chord. At each bogie, the track rolls by
    ``asin(cant / contact spacing)`` toward the inside of the curve; the body rolls by the mean of both rolls (P1
    3.1(1)). The forward axis of the body joins the bogie centres. The up axis is perpendicular to the forward axis, and
    rotated from the vertical by the roll. The path begins and ends where a bogie reaches an end of the track. On a
    closed track, the path is closed: it begins and ends where the body's middle is at the ends of the map.

    Parameters
    ----------
    track : Track
    vehicle : Vehicle
    antenna : {"front", "rear"}
    reference : {"antenna", "centre", "front_bogie", "rear_bogie"}
        Point of the vehicle to which the chainage refers: the centreline point abeam the antenna, the middle between
        the bogies, or the centre of the bogie at the vehicle's front or rear. Beyond the ends of the track, the
        centreline is extended straight.

    Returns
    -------
    Trajectory
        Path with one point for each track point that the body's middle passes, and further points that keep the path
        within `PATH_TOLERANCE_M` of its chords.

    Raises
    ------
    SettingsError
        The vehicle has no such antenna.
    MismatchError
        Track and vehicle do not match: the track is shorter than the vehicle, bends too sharply, has
        cant of unknown side, or is itself the path of an antenna.
    """
    check_type(track, Track, "track")
    check_type(vehicle, Vehicle, "vehicle")
    if ANTENNA_PATH in track.provenance.notes:
        raise MismatchError(f"{track.name}: {ANTENNA_PATH}; use it without a vehicle file")
    if antenna not in vehicle.antennas:
        raise SettingsError(
            f"vehicle {vehicle.name!r} has no antenna {antenna!r}; it has {', '.join(vehicle.antennas)}"
        )
    offset = vehicle.antennas[antenna]
    line = _VehicleLine(track, vehicle.contact_spacing_m)
    middle = _refine(line, track, vehicle, offset)
    body = _pose(line, track, vehicle, middle)
    places = _place(body, vehicle, offset)
    rising = vehicle.facing == "rising"
    chainage = {
        "antenna": lambda: _abeam(line, body, places, offset.along_m if rising else -offset.along_m),
        "centre": lambda: middle,
        "front_bogie": lambda: body.upper_m if rising else body.lower_m,
        "rear_bogie": lambda: body.lower_m if rising else body.upper_m,
    }[reference]()
    if not (np.diff(chainage) > 0).all():
        i = int(np.argmin(np.diff(chainage)))
        raise MismatchError(
            f"{track.name}: the line bends so sharply near chainage {chainage[i]:.1f} m that the antenna moves back"
        )
    cant = np.interp(chainage, track.chainage_m, np.where(np.isnan(track.cant_m), 0.0, track.cant_m))
    return Trajectory(
        name=f"{vehicle.name} {antenna}",
        ecef_m=places,
        chainage_m=chainage,
        kilometrage_m=track.kilometrage_at(chainage),
        cant_m=np.full_like(cant, np.nan) if np.isnan(track.cant_m).all() else cant,
        roll_deg=np.degrees(body.roll_rad),
        reference=reference,
        body_chainage_m=middle,
        facing=vehicle.facing,
        antenna_ahead_m=offset.along_m,
        front_end_m=vehicle.ends_m[0],
        rear_end_m=vehicle.ends_m[1],
        contact_m=vehicle.contact_spacing_m,
        sigma_plan_m=track.sigma_plan_m,
        sigma_height_m=track.sigma_height_m,
        notes=(*line.notes, *track.provenance.notes),
    )

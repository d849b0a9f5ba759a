"""3-D centreline of a railway line with curve attributes (P1 2.2(1), 4.1(3)).

A curve to the right, seen in the direction of rising chainage, has a positive radius. Cant is the height of the outer
rail above the inner rail. Points are at the middle between the tops of the rails.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats, Indices, Integers, Masks, freeze_arrays, read_only
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.core.notebook import NotebookTable, plural

SIGMA_PLAN_M = 0.30  #: Standard deviation of an aerial survey's centreline in plan [m] (P1 4.1(3)).
SIGMA_HEIGHT_M = 0.60  #: Standard deviation of the centreline's height, about twice `SIGMA_PLAN_M` [m] (P1 4.1(3)).
#: Note on a section that is joined in reverse order; the section's name precedes it.
BACKWARDS = "is used against the order of its points"
UNNAMED = "not named (WGS 84 assumed)"  #: `Provenance.crs` of a map that names no reference system.
#: The kilometrage has a break in a segment if the change of kilometrage differs from the length of the segment by more
#: than this value plus a twentieth of the length [m].
KILOMETRAGE_BREAK_M = 1.0
HEIGHTS_M = (-1000.0, 9000.0)  #: Range of accepted ellipsoidal heights, including tunnels below the sea [m].
ANOTHER_PLACE_M = 100_000.0  #: A log and a map farther apart than this count as from different regions [m].


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a track map, copied to every output."""

    files: tuple[str, ...] = ()  #: Files from which the map was read.
    crs: str = "EPSG:4979"  #: Coordinate reference system of the files; `UNNAMED` if the files do not name it.
    frame: str = "EPSG:4979"  #: Geographic CRS of the coordinates of the track; see `railfix.track.frames`.
    height_datum_asked: str = ""  #: Height datum given by the user, "ellipsoidal" or "orthometric"; "" if not given.
    height_datum_used: str = "ellipsoidal"  #: Height datum with which the heights were read.
    geoid: str = ""  #: Geoid model by which orthometric heights were converted to ellipsoidal heights; "" if not used.
    notes: tuple[str, ...] = ()  #: Notes that are copied to every result computed with this map.


class TrackFields(TypedDict, total=False):
    """Optional fields of `Track`: attributes of shape (V,), sections, accuracy, and origin."""

    name: str
    kilometrage_m: ArrayLike | None
    cant_m: ArrayLike | None
    radius_m: ArrayLike | None
    gradient_permille: ArrayLike | None
    section: ArrayLike | None
    sections: tuple[str, ...]
    sigma_plan_m: float
    sigma_height_m: float
    provenance: Provenance | None


@dataclass(frozen=True, kw_only=True)
class Track(NotebookTable):
    """Centreline of a route of V points, in the order of the route."""

    name: str
    latitude_deg: Floats  #: Geodetic latitude in `Provenance.frame`, shape (V,).
    longitude_deg: Floats  #: Longitude in `Provenance.frame`, shape (V,).
    height_m: Floats  #: Ellipsoidal height of the middle between the rail tops, shape (V,).
    #: Kilometrage of the line, shape (V,). It may jump or decrease, and is NaN where unknown.
    kilometrage_m: Floats
    cant_m: Floats  #: Height of the outer rail above the inner rail, shape (V,); NaN where unknown.
    #: Horizontal radius, shape (V,), positive in a right curve, seen toward rising chainage. The radius is infinite on
    #: straight track, and NaN where unknown.
    radius_m: Floats
    gradient_permille: Floats  #: Gradient, positive if the line rises with chainage; NaN if unknown; shape (V,).
    section: Integers  #: Index of each point's section in `sections`, shape (V,).
    sections: tuple[str, ...] = ("track",)  #: Files or features that were joined to form the route, in order.
    sigma_plan_m: float = SIGMA_PLAN_M  #: Standard deviation of the map across the line.
    sigma_height_m: float = SIGMA_HEIGHT_M  #: Standard deviation of the map in height.
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        shape = (len(self.latitude_deg),)
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray) and value.shape != shape:
                raise ValueError(f"{item.name} has shape {value.shape}, expected {shape}")
        freeze_arrays(self)
        if shape[0] < 2:
            raise ValueError(f"a track needs at least two points, got {shape[0]}")
        place = np.stack([self.latitude_deg, self.longitude_deg, self.height_m])
        if not np.isfinite(place).all():
            raise ValueError("latitude_deg, longitude_deg and height_m must be finite")
        if (np.abs(place[:2]) > [[90.0], [360.0]]).any() or (place[2] < -1e5).any():
            raise ValueError(
                "a point is not a position on the Earth; latitude, longitude [deg] and height [m] were expected"
            )
        if not (self.sigma_plan_m > 0 and self.sigma_height_m > 0):
            raise ValueError("sigma_plan_m and sigma_height_m must be positive")

    @classmethod
    def from_geodetic(
        cls, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike, **attributes: Unpack[TrackFields]
    ) -> Track:
        """Create a track from latitudes, longitudes and ellipsoidal heights in WGS 84, shape (V,) each.

        `attributes` are fields of `TrackFields`; point attributes default to NaN. Raise TypeError for other names.
        """
        if unknown := attributes.keys() - TrackFields.__annotations__.keys():
            raise TypeError(f"unknown attributes of a track: {', '.join(sorted(unknown))}")
        latitude = np.array(latitude_deg, dtype=np.float64)

        def floats(values: ArrayLike | None) -> Floats:
            return np.full(latitude.shape, np.nan) if values is None else np.array(values, dtype=np.float64)

        section = attributes.get("section")
        return cls(
            name=attributes.get("name", "track"),
            latitude_deg=latitude,
            longitude_deg=floats(longitude_deg),
            height_m=floats(height_m),
            kilometrage_m=floats(attributes.get("kilometrage_m")),
            cant_m=floats(attributes.get("cant_m")),
            radius_m=floats(attributes.get("radius_m")),
            gradient_permille=floats(attributes.get("gradient_permille")),
            section=np.array(np.zeros(latitude.shape) if section is None else section, dtype=np.int64),
            sections=attributes.get("sections", ("track",)),
            sigma_plan_m=attributes.get("sigma_plan_m", SIGMA_PLAN_M),
            sigma_height_m=attributes.get("sigma_height_m", SIGMA_HEIGHT_M),
            provenance=attributes.get("provenance") or Provenance(),
        )

    @classmethod
    def from_ecef(cls, ecef_m: ArrayLike, **attributes: Unpack[TrackFields]) -> Track:
        """Create a track from ECEF points, shape (V, 3) [m]. The attributes are described in `from_geodetic`."""
        return cls.from_geodetic(*geodetic_from_ecef(ecef_m), **attributes)

    def __len__(self) -> int:
        return len(self.latitude_deg)

    def __repr__(self) -> str:
        marking = self.kilometrage_m[np.isfinite(self.kilometrage_m)] / 1e3
        kilometrage = f", kilometrage {marking[0]:.3f} to {marking[-1]:.3f} km" if marking.size else ""
        return f'<Track "{self.name}": {plural(self, "point")}, {self.chainage_m[-1]:,.0f} m{kilometrage}>'

    @cached_property
    def ecef_m(self) -> Floats:
        """ECEF coordinates of the points, shape (V, 3) [m]."""
        return read_only(ecef_from_geodetic(self.latitude_deg, self.longitude_deg, self.height_m))

    @cached_property
    def chainage_m(self) -> Floats:
        """Length of the polyline from its first point to each point, shape (V,) [m]."""
        steps = np.linalg.norm(np.diff(self.ecef_m, axis=0), axis=1)
        return read_only(np.concatenate([[0.0], np.cumsum(steps)]))

    def kilometrage_at(self, chainage_m: ArrayLike) -> Floats:
        """Interpolate the kilometrage at chainages; see `interpolate_kilometrage`."""
        return interpolate_kilometrage(chainage_m, self.chainage_m, self.kilometrage_m)


def kilometrage_breaks(chainage_m: Floats, kilometrage_m: Floats) -> Masks:
    """Return a mask of the segments in which the kilometrage has a break, shape (V - 1,).

    At a break, the segment length and the change of kilometrage differ by more than `KILOMETRAGE_BREAK_M` plus a
    twentieth of the length.
    """
    return _jumps(np.diff(chainage_m), np.diff(kilometrage_m))


def _jumps(length_m: Floats, change_m: Floats) -> Masks:
    """Return a mask of the segments that have a break, as defined in `kilometrage_breaks`."""
    return np.asarray(np.abs(np.abs(change_m) - length_m) > KILOMETRAGE_BREAK_M + 0.05 * length_m)


def interpolate_kilometrage(chainage_m: ArrayLike, known_chainage_m: Floats, known_kilometrage_m: Floats) -> Floats:
    """Interpolate the kilometrage at chainages of any shape.

    The result is NaN where the chainage is NaN, and where an end of the segment has no kilometrage. The interpolation
    is linear between two points, with linear extrapolation beyond the ends of the line. In a segment with a break, the
    kilometrage continues from the nearer end of the segment; it rises or falls as in the track adjacent to this end.
    """
    at = np.asarray(chainage_m, dtype=np.float64)
    last = len(known_chainage_m) - 2
    index: Indices = np.minimum(np.maximum(known_chainage_m.searchsorted(at, side="right") - 1, 0), last)
    start, end = known_chainage_m[index], known_chainage_m[index + 1]
    before, after = known_kilometrage_m[index], known_kilometrage_m[index + 1]
    length = np.where(end > start, end - start, 1.0)
    linear = before + (at - start) / length * (after - before)
    broken = _jumps(end - start, after - before)
    if not broken.any():
        return linear
    left, right = _running_direction(known_kilometrage_m, kilometrage_breaks(known_chainage_m, known_kilometrage_m))
    extrapolated = np.where(
        at - start < end - at, before + left[index] * (at - start), after - right[index + 1] * (end - at)
    )
    return np.where(broken, extrapolated, linear)


def _running_direction(kilometrage_m: Floats, broken: Masks) -> tuple[Floats, Floats]:
    """Return the direction of the kilometrage before and after each point, 1 if rising and -1 if falling."""
    sign = np.sign(np.diff(kilometrage_m))
    usable = ~broken & np.isfinite(sign) & (sign != 0)
    if not usable.any():
        rising = np.ones(len(kilometrage_m))
        return rising, rising
    places = np.flatnonzero(usable)
    points = np.arange(len(kilometrage_m))
    before = places[np.clip(np.searchsorted(places, points, side="left") - 1, 0, len(places) - 1)]
    after = places[np.clip(np.searchsorted(places, points, side="left"), 0, len(places) - 1)]
    return sign[before], sign[after]

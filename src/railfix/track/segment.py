"""One segment of a route as read from a file."""

from __future__ import annotations

from dataclasses import dataclass, replace

from railfix.core.arrays import Floats
from railfix.track.track import BACKWARDS

#: `Segment.height_datum` of a segment without heights; they are NaN, or come from a second source.
NO_HEIGHTS = "none"
#: Optional attributes of each point of a map.
ATTRIBUTES = ("kilometrage_m", "cant_m", "radius_m", "gradient_permille")

#: Names by which files of ERA RINF are known that have no tracks, in small letters, and what is said of them.
RINF_NAMES = ("sectionofline", "operationalpoint", "solopstart", "uniqueopid", "uopid", "opstart")
RINF_SECTIONS = (
    "sections of line and operational points of ERA RINF have no geometry of tracks; export the register's topology as "
    "RDF (.ttl, .rdf, .nt, .jsonld)"
)


@dataclass(frozen=True, kw_only=True)
class MapReading:
    """Options for reading a map file: those of `railfix.track.read_track` of the same names."""

    crs: str | None = None
    height_datum: str | None = None
    geoid: str | None = None
    duplicates: str = "reject"
    sigma_plan_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Points of one file or feature, with ellipsoidal heights, or NaN where the file has none (`NO_HEIGHTS`)."""

    source: str  #: The file, or the file and the feature in it.
    file: str  #: The file alone.
    #: Shape (n,).
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    #: NaN where the file has none, shape (n,).
    kilometrage_m: Floats
    cant_m: Floats
    radius_m: Floats
    gradient_permille: Floats
    #: Of the file, and the geoid used.
    crs: str
    height_datum: str
    geoid: str
    metadata: dict[str, str]  #: Name, accuracy and origin, where the file has them.
    frame: str = "EPSG:4979"  #: Geographic CRS of the coordinates here.
    notes: tuple[str, ...] = ()

    def reversed(self) -> Segment:
        """Return the segment in the opposite direction; the signs of radius and gradient change."""
        turned = {
            name: getattr(self, name)[::-1] for name in ("latitude_deg", "longitude_deg", "height_m", *ATTRIBUTES)
        }
        turned |= {name: -turned[name] for name in ("radius_m", "gradient_permille")}
        return replace(
            self,
            **turned,
            notes=(*self.notes, f"{self.source} {BACKWARDS}"),
        )

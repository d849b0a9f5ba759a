"""Segments of track that are read from files and joined to a route (P1 4.2(1))."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, TypedDict

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track.georeference import NEGLIGIBLE_M, EllipsoidalHeights, Georeference
from railfix.track.track import BACKWARDS, SIGMA_HEIGHT_M, SIGMA_PLAN_M, UNNAMED, Provenance, Track

NO_HEIGHTS = "none"  #: `Segment.height_datum` of a segment without heights.
#: Names of the optional attributes of map points.
ATTRIBUTES = ("kilometrage_m", "cant_m", "radius_m", "gradient_permille")

#: Column names, in lower case, by which ERA RINF files without track geometry are recognised.
RINF_NAMES = ("sectionofline", "operationalpoint", "solopstart", "uniqueopid", "uopid", "opstart")
#: Error message for ERA RINF files without track geometry.
RINF_SECTIONS = (
    "sections of line and operational points of ERA RINF have no geometry of tracks; export the register's topology as "
    "RDF (.ttl, .rdf, .nt, .jsonld)"
)


class MapOptions(TypedDict, total=False):
    """Keyword arguments for `MapReading`."""

    crs: str | None
    height_datum: str | None
    geoid: str | None
    duplicates: str
    sigma_plan_m: float | None


@dataclass(frozen=True, kw_only=True)
class MapReading:
    """Options for reading a map file; they are arguments of `railfix.track.read_track`."""

    crs: str | None = None
    height_datum: str | None = None
    geoid: str | None = None
    duplicates: str = "merge"
    sigma_plan_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Points of one file or feature; the heights are ellipsoidal, or NaN if the file has no heights (`NO_HEIGHTS`)."""

    source: str  #: Name of the file, followed by the name of the feature if the file has several features.
    file: str  #: Name of the file.
    #: Coordinates of the points in `frame`, shape (n,).
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    #: Attributes of the points as in `Track`, shape (n,); NaN where the file has no value.
    kilometrage_m: Floats
    cant_m: Floats
    radius_m: Floats
    gradient_permille: Floats
    crs: str  #: CRS of the file.
    height_datum: str  #: Height datum of the file.
    geoid: str  #: Geoid with which the heights were converted.
    metadata: dict[str, str]  #: Name, accuracy and origin of the segment, if stated in the file.
    frame: str = "EPSG:4979"  #: Geographic CRS of the coordinates of the segment.
    #: Standard deviation of the datum transformation in plan; NaN if unknown. The standard deviation of the map
    #: includes it (`sigma_of_files`).
    datum_plan_m: float = 0.0
    datum_height_m: float = 0.0  #: Standard deviation of the datum transformation in height; NaN if unknown.
    notes: tuple[str, ...] = ()
    nodes: tuple[str, ...] = ()  #: OpenStreetMap node ids of the points; empty if the file has no node ids.

    def reverse(self) -> Segment:
        """Return the segment in the opposite direction; radius and gradient change their signs."""
        names = ("latitude_deg", "longitude_deg", "height_m", *ATTRIBUTES)
        turned = {name: getattr(self, name)[::-1] for name in names}
        turned |= {name: -turned[name] for name in ("radius_m", "gradient_permille")}
        return replace(
            self, **turned, notes=(*self.notes, f"{self.source} {BACKWARDS}"), nodes=tuple(reversed(self.nodes))
        )


def make_segment(
    place: Georeference,
    heights: EllipsoidalHeights | None,
    *,
    source: str,
    file: str,
    crs: str | None,
    metadata: dict[str, str],
    notes: tuple[str, ...] = (),
    attributes: Mapping[str, Floats] = MappingProxyType({}),
) -> Segment:
    """Create a segment from coordinates in plan, heights, and attributes.

    `heights` is None for a segment without heights. Attributes that are not given are NaN.
    """
    absent = np.full(len(place.latitude_deg), np.nan)
    of_points: dict[str, Any] = {**dict.fromkeys(ATTRIBUTES, absent), **attributes}
    above = heights or EllipsoidalHeights(height_m=absent, datum=NO_HEIGHTS)
    return Segment(
        source=source, file=file, latitude_deg=place.latitude_deg, longitude_deg=place.longitude_deg,
        height_m=above.height_m, crs=crs or UNNAMED, frame=place.frame, height_datum=above.datum, geoid=above.geoid,
        datum_plan_m=place.accuracy_m, datum_height_m=above.accuracy_m, metadata=metadata,
        notes=(*notes, *place.notes, *above.notes), **of_points,
    )  # fmt: skip


SAME_POINT_M = 0.05  #: Distance below which the ends of two segments count as the same point [m].
MAX_GAP_M = 1.0  #: Gaps between segments up to this length are bridged by a straight line [m].


def _ends(segments: Sequence[Segment]) -> Floats:
    """Return the ECEF positions of each segment's first and last point, shape (n, 2, 3) [m]."""
    columns = ("latitude_deg", "longitude_deg", "height_m")
    ends = np.array([[getattr(s, name)[[0, -1]] for name in columns] for s in segments])
    return ecef_from_geodetic(ends[:, 0], ends[:, 1], np.nan_to_num(ends[:, 2]))


#: Largest accepted fraction of points at which the line turns by more than 90 degrees, as where trains reverse.
_MOST_BACK: Final = 0.05


def check_order(segments: Iterable[Segment]) -> None:
    """Raise InputFileError if the points of a segment are not in order along a line."""
    for segment in segments:
        points = ecef_from_geodetic(segment.latitude_deg, segment.longitude_deg, np.zeros(len(segment.latitude_deg)))
        steps = np.diff(points, axis=0)
        back = int(np.count_nonzero(np.einsum("ij,ij->i", steps[1:], steps[:-1]) < 0.0))
        if back > max(_MOST_BACK * len(points), 3):
            raise InputFileError(
                segment.source,
                f"the direction turns by more than 90 degrees at {back} of {len(points)} points, so the points are not "
                "in the order of the line; sort them (railfix map check shows where)",
            )


def orient(segments: Sequence[Segment], *, max_gap_m: float = MAX_GAP_M) -> list[Segment]:
    """Return the segments in the same order, reversed where necessary so that each begins where the previous one ends.

    Raise InputFileError if a gap is wider than `max_gap_m`.
    """
    gap = first_gap(segments, max_gap_m=max_gap_m)
    if gap is not None:
        k, size = gap
        raise InputFileError(
            segments[k].source,
            f"neither end of it meets the end of {segments[k - 1].source}: the gap is {size:.2f} m (limit "
            f"{max_gap_m:g} m); give the segments in the order of the route, or make a route of a network with "
            "'railfix map route'",
        )
    turned = _turn(_ends(segments), max_gap_m)
    return [s.reverse() if backwards else s for s, backwards in zip(segments, turned, strict=True)]


def _turn(ends: Floats, max_gap_m: float) -> list[bool]:
    """Return, for each segment, whether it must be reversed to continue the line; `ends` has shape (n, 2, 3)."""
    turned = [False] * len(ends)
    if len(ends) > 1:
        distance = np.linalg.norm(ends[0][:, None] - ends[1][None, :], axis=-1).min(axis=1)
        turned[0] = bool(distance[0] < distance[1] and distance[1] > max_gap_m)
    for k in range(1, len(ends)):
        gaps = np.linalg.norm(ends[k] - ends[k - 1][0 if turned[k - 1] else 1], axis=-1)
        turned[k] = bool(gaps[1] < gaps[0])
    return turned


def first_gap(segments: Sequence[Segment], *, max_gap_m: float = MAX_GAP_M) -> tuple[int, float] | None:
    """Return the index of the first segment that does not meet the previous segment, and the gap [m]; if all segments
    meet, None instead of both.

    Segments meet if the gap between their ends is at most `max_gap_m`.
    """
    ends = _ends(segments)
    backwards = np.array(_turn(ends, max_gap_m), dtype=np.intp)
    rows = np.arange(1, len(ends))
    size = np.linalg.norm(ends[rows, backwards[1:]] - ends[rows - 1, 1 - backwards[:-1]], axis=-1)
    wide = np.flatnonzero(~(size <= max_gap_m))
    return (int(wide[0]) + 1, float(size[wide[0]])) if len(wide) else None


def join(
    segments: Sequence[Segment],
    *,
    name: str | None = None,
    height_datum_asked: str | None = None,
    max_gap_m: float = MAX_GAP_M,
    sigma_height_m: float | None = None,
) -> Track:
    """Join segments to one track.

    A point shared by two segments is kept once. Attributes of this point are taken from the earlier segment or, where
    it lacks them, from the later segment. Raise InputFileError if segments do not meet, and MismatchError if their
    frames differ.
    """
    pieces = orient(segments, max_gap_m=max_gap_m)
    ends = _ends(pieces)
    kept: list[dict[str, Floats]] = []
    for k, piece in enumerate(pieces):
        columns = {key: getattr(piece, key) for key in ("latitude_deg", "longitude_deg", "height_m", *ATTRIBUTES)}
        if k and np.linalg.norm(ends[k, 0] - ends[k - 1, 1]) < SAME_POINT_M:
            for key in ATTRIBUTES:
                if np.isnan(kept[-1][key][-1]):
                    kept[-1][key] = np.append(kept[-1][key][:-1], columns[key][0])
            columns = {key: values[1:] for key, values in columns.items()}
        kept.append(columns)
    joined = {key: np.concatenate([columns[key] for columns in kept]) for key in kept[0]}
    return Track.from_geodetic(
        joined["latitude_deg"],
        joined["longitude_deg"],
        joined["height_m"],
        name=name or pieces[0].metadata.get("name") or Path(pieces[0].source).stem,
        **{key: joined[key] for key in ATTRIBUTES},
        section=np.repeat(np.arange(len(pieces)), [len(columns["height_m"]) for columns in kept]),
        sections=tuple(piece.source for piece in pieces),
        sigma_plan_m=sigma_of_files(pieces, "sigma_plan_m", SIGMA_PLAN_M),
        sigma_height_m=sigma_of_files(pieces, "sigma_height_m", SIGMA_HEIGHT_M)
        if sigma_height_m is None
        else sigma_height_m,
        provenance=Provenance(
            files=_unique(piece.file for piece in pieces),
            crs=", ".join(_unique(piece.crs for piece in pieces)),
            frame=one_frame(pieces),
            height_datum_asked=height_datum_asked or "",
            height_datum_used=", ".join(_unique(piece.height_datum for piece in pieces)),
            geoid=", ".join(_unique(piece.geoid for piece in pieces if piece.geoid)),
            notes=_unique(note for piece in pieces for note in piece.notes),
        ),
    )


def one_frame(pieces: Sequence[Segment]) -> str:
    """Return the common reference frame of all pieces; raise MismatchError if their frames differ."""
    frames = {piece.frame: piece.source for piece in pieces}
    if len(frames) > 1:
        what = "; ".join(f"{source} in {frame}" for frame, source in frames.items())
        raise MismatchError(f"the pieces of the route are in different reference frames: {what}; convert them to one")
    return pieces[0].frame


def _unique(values: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(values))


def sigma_of_files(pieces: Sequence[Segment], key: str, default: float) -> float:
    """Return the largest standard deviation of the pieces [m], each with the error of its datum transformation.

    Without this error, the standard deviation of a piece is the metadata entry `key` of its file, or `default` if the
    file has no such entry. Raise InputFileError if an entry is not a positive number.
    """
    sigmas: list[float] = []
    for piece in pieces:
        stated = default
        if key in piece.metadata:
            try:
                stated = float(piece.metadata[key])
            except ValueError:
                message = f"{key} is {piece.metadata[key]!r}; a number in metres was expected"
                raise InputFileError(piece.source, message) from None
            if not 0.0 < stated < np.inf:
                raise InputFileError(piece.source, f"{key} is {stated:g}; a positive number was expected")
        datum = piece.datum_plan_m if key == "sigma_plan_m" else piece.datum_height_m
        sigmas.append(float(np.hypot(stated, datum)) if datum >= NEGLIGIBLE_M else stated)
    return max(sigmas, default=default)

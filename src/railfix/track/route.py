"""Joining of segments to a route (P1 4.2(1))."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track.segment import ATTRIBUTES, Segment
from railfix.track.track import SIGMA_HEIGHT_M, SIGMA_PLAN_M, Provenance, Track

#: Ends of two segments nearer than this are the same point [m].
SAME_POINT_M = 0.05
#: Widest gap between the ends of two segments that is bridged by a straight line [m].
MAX_GAP_M = 1.0


def _ends(segment: Segment) -> Floats:
    """Return first and last point, shape (2, 3) [m]."""
    i = [0, -1]
    return ecef_from_geodetic(segment.latitude_deg[i], segment.longitude_deg[i], segment.height_m[i])


def orient(segments: Sequence[Segment], *, max_gap_m: float = MAX_GAP_M) -> list[Segment]:
    """Orient segments so that each begins where the one before ends.

    Parameters
    ----------
    segments : sequence of Segment
        In the order of the route; the first is reversed only where its start, not its end, meets the second.
    max_gap_m : float [m]

    Raises
    ------
    InputFileError
        Two neighbours are further apart than `max_gap_m` in any orientation.
    """
    pieces = list(segments)
    if len(pieces) > 1:
        first, second = _ends(pieces[0]), _ends(pieces[1])
        distance = np.linalg.norm(first[:, None] - second[None, :], axis=-1).min(axis=1)
        if distance[0] < distance[1] and distance[1] > max_gap_m:
            pieces[0] = pieces[0].reversed()
    for k in range(1, len(pieces)):
        here = _ends(pieces[k - 1])[1]
        gaps = np.linalg.norm(_ends(pieces[k]) - here, axis=-1)
        if gaps.min() > max_gap_m:
            raise InputFileError(
                pieces[k].source,
                f"neither end meets the end of {pieces[k - 1].source}: the gap is {gaps.min():.2f} m, the limit "
                f"{max_gap_m:g} m; give the segments in the order of the route",
            )
        if gaps[1] < gaps[0]:
            pieces[k] = pieces[k].reversed()
    return pieces


def join(
    segments: Sequence[Segment],
    *,
    name: str | None = None,
    height_datum_asked: str | None = None,
    max_gap_m: float = MAX_GAP_M,
    sigma_plan_m: float | None = None,
    sigma_height_m: float | None = None,
) -> Track:
    """Join segments in the order of the route to one track; a shared point is kept once.

    The shared point has the attributes of the earlier segment, and those of the later one where the
    earlier has none.
    """
    pieces = orient(segments, max_gap_m=max_gap_m)
    kept: list[dict[str, Floats]] = []
    for k, piece in enumerate(pieces):
        columns = {key: getattr(piece, key) for key in ("latitude_deg", "longitude_deg", "height_m", *ATTRIBUTES)}
        if k and np.linalg.norm(_ends(piece)[0] - _ends(pieces[k - 1])[1]) < SAME_POINT_M:
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
        sigma_plan_m=_sigma(pieces, "sigma_plan_m", sigma_plan_m, SIGMA_PLAN_M),
        sigma_height_m=_sigma(pieces, "sigma_height_m", sigma_height_m, SIGMA_HEIGHT_M),
        provenance=Provenance(
            files=_unique(piece.file for piece in pieces),
            crs=", ".join(_unique(piece.crs for piece in pieces)),
            frame=_one_frame(pieces),
            height_datum_asked=height_datum_asked or "",
            height_datum_used=", ".join(_unique(piece.height_datum for piece in pieces)),
            geoid=", ".join(_unique(piece.geoid for piece in pieces if piece.geoid)),
            notes=_unique(note for piece in pieces for note in piece.notes),
        ),
    )


def _one_frame(pieces: Sequence[Segment]) -> str:
    """The frame of all pieces; pieces in two frames would be joined with a step of up to 2 m."""
    frames = {piece.frame: piece.source for piece in pieces}
    if len(frames) > 1:
        what = "; ".join(f"{source} in {frame}" for frame, source in frames.items())
        raise MismatchError(f"the pieces of the route are in different reference frames: {what}; convert them to one")
    return pieces[0].frame


def _unique(values: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(values))


def _sigma(pieces: Sequence[Segment], key: str, given: float | None, default: float) -> float:
    """Return the accuracy given, else the worst of the files, else the default of P1 4.1(3)."""
    if given is not None:
        return given
    stated: list[float] = []
    for piece in pieces:
        if key in piece.metadata:
            try:
                stated.append(float(piece.metadata[key]))
            except ValueError:
                message = f"{key} is {piece.metadata[key]!r}; a number in metres was expected"
                raise InputFileError(piece.source, message) from None
            if not 0.0 < stated[-1] < np.inf:
                raise InputFileError(piece.source, f"{key} is {stated[-1]:g}; a positive number was expected")
    return max(stated, default=default)

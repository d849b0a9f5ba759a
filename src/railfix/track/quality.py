"""Quality checks of a track map: spacing, mid-chord deviation, kinks, duplicates, kilometrage, gradient and cant.

The checks are necessary because a map error affects all satellites alike, so that no screen of the observations can
detect the error (P1 2.2(1), 4.1(3)).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Masks
from railfix.core.errors import check_type
from railfix.core.notebook import NotebookTable, plural
from railfix.core.settings import Settings
from railfix.track.geometry import Geometry, compute_geometry, mean_gradients
from railfix.track.track import BACKWARDS, HEIGHTS_M, Track, kilometrage_breaks

Severity = Literal["error", "warning"]
_COARSE_DEG: Final = 1e-5  #: Multiples of this count as rounded coordinates [deg]; rounding errors are up to 0.6 m.
_LEAST_CANT_M: Final = 5e-4  #: If the largest cant of a map is below this [m], the unit of the cant must be wrong.
_NEAR_DUPLICATE_M: Final = 0.10  #: Spacing below which two points are reported as one point measured twice [m].
_CURVED_1PM: Final = 1 / 3000  #: Curvature below which the track counts as straight [1/m].
_ADVERSE_M: Final = 0.005  #: The sign of a cant with at most this absolute value is not checked [m].
_CENTIMETRE_M: Final = 0.01  #: Distance between chord and arc for which `needed_spacing_m` is computed [m].
#: A point is a kink if the direction changes by more than this angle and the radius is below `least_radius_m`.
_KINK_DEG: Final = 3.0
_SHARP_KINK_DEG: Final = 15.0  #: Change of direction up to which a kink is a warning; a sharper kink is an error.
#: Largest accepted distance of a point above or below the line through its neighbours.
_HEIGHT_SPIKE_M: Final = 0.50
#: Largest accepted difference of the stated gradient from the gradient of the heights, over `_GRADIENT_WINDOW_M`.
_GRADIENT_DIFFERENCE_PERMILLE: Final = 5.0
_GRADIENT_WINDOW_M: Final = 100.0


class MapLimits(Settings):
    """Limits of a track map; a value equal to its limit passes."""

    #: Largest accepted distance between chord and arc in mid-segment (P1 4.1(3)).
    mid_chord_m: float = Field(default=0.30, gt=0)
    spacing_m: float = Field(default=50.0, gt=0)  #: Longest accepted segment; P1 2.2(1): tens of metres on straights.
    #: A longer segment is reported as a gap, because a point is wrong or a part of the line is missing.
    gap_m: float = Field(default=2000.0, gt=0)
    least_radius_m: float = Field(default=60.0, gt=0)  #: Smallest radius that a railway vehicle can pass.
    gradient_permille: float = Field(default=60.0, gt=0)  #: Largest accepted gradient of a segment.
    cant_m: float = Field(default=0.20, gt=0)  #: Largest accepted absolute value of the cant.


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Map fault in a range of consecutive points or segments."""

    severity: Severity
    kind: str  #: Kind of the fault: a key of `_FAULTS`, without the prefix "small ".
    first: int  #: Index of the first point of the range.
    last: int  #: Index of the last point of the range.
    chainage_m: float  #: Chainage of the first point.
    kilometrage_m: float  #: Kilometrage of the first point; NaN if unknown.
    value: float  #: Worst value in the range; NaN if the fault has no value.
    limit: float  #: Limit of the value; NaN if the fault has no limit.
    sentence: str  #: Message to the user: location and description of the fault.


@dataclass(frozen=True, kw_only=True, repr=False)
class TrackQuality(NotebookTable):
    """Quality report of a track map."""

    track: Track
    limits: MapLimits
    geometry: Geometry  #: Geometry of the track that was checked.
    findings: tuple[Finding, ...]  #: Faults found: first the errors, then the warnings, each in order of chainage.

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that make the map unusable."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that should be reviewed."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")


def check_track(track: Track, *, limits: MapLimits | None = None) -> TrackQuality:
    """Check the quality of a map; duplicate points are found only if the map was read with ``duplicates="keep"``."""
    check_type(track, Track, "track")
    limits = limits or MapLimits()
    geometry = compute_geometry(track)
    findings = [
        *_spacing(track, geometry, limits),
        *_shape(track, geometry, limits),
        *_kilometrage(track),
        *_heights(track, geometry, limits),
        *_attributes(track, geometry, limits),
    ]
    findings.sort(key=lambda finding: (finding.severity != "error", finding.chainage_m))
    return TrackQuality(track=track, limits=limits, geometry=geometry, findings=tuple(findings))


def error_note(quality: TrackQuality) -> tuple[str, ...]:
    """Return a note with the number of map errors and the description of the first one; empty without errors."""
    if not quality.errors:
        return ()
    return (
        f"map check: {plural(quality.errors, 'error')}, {plural(quality.warnings, 'warning')}; the first error is "
        f"{quality.errors[0].sentence}; see railfix map check",
    )


#: Severity and description of each kind of fault; ``{value}`` is the worst value, ``{limit}`` its limit.
_FAULTS: Final[dict[str, tuple[Severity, str]]] = {
    "duplicate": ("warning", "the same point is repeated; other commands ignore the repetition"),
    "near duplicate": ("warning", "points only {value:.3f} m apart (limit {limit:g} m)"),
    "rounded": (
        "warning",
        "latitude and longitude have at most five decimals: points may be off by 0.6 m or more; give seven decimals",
    ),
    "gap": (
        "error",
        "points {value:.0f} m apart (limit {limit:g} m); a point is wrong, or a piece of the line is missing",
    ),
    "spacing": ("warning", "points {value:.1f} m apart (limit {limit:g} m); a curve in between would be missed"),
    "mid-chord": ("error", "the chord deviates from the arc by {value:.3f} m (limit {limit:g} m); add points"),
    "kink": ("warning", "the direction turns by {value:.1f} degrees at one point (limit {limit:g})"),
    "kilometrage break": (
        "warning",
        "the kilometrage changes by {value:.4g} m, which is not the distance; check whether it is in metres",
    ),
    "kilometrage reversal": ("warning", "the kilometrage reverses its direction"),
    "kilometrage absent": ("warning", "the map has no kilometrage here"),
    "height": (
        "error",
        "a height of {value:,.0f} m is impossible; check whether it is in millimetres or means a missing height",
    ),
    "gradient": ("warning", "the gradient from the heights is {value:.1f} per mille (limit {limit:g})"),
    "height spike": (
        "error",
        "the height deviates from the line through its neighbours by {value:.2f} m (limit {limit:g} m)",
    ),
    "gradient attribute": (
        "warning",
        "gradient_permille is {value:.1f} per mille off the heights' gradient (limit {limit:g}); rising is positive",
    ),
    "cant": ("error", "cant of {value:.3f} m (limit {limit:g} m); check whether the column is in millimetres"),
    "small cant": (
        "error",
        "the largest cant is {value:.2g} m; check whether the column is in metres instead of millimetres",
    ),
    "cant side": (
        "error",
        "cant of {value:.3f} m is negative in curves; cant is the height of the outer rail above the inner rail, "
        "positive in left and right curves",
    ),
    "radius": ("error", "radius of {value:.1f} m (limit {limit:g} m)"),
    "radius side": (
        "error",
        "radius_m has the wrong sign for the curve of the points; in the order of the file, right is positive",
    ),
}


def _runs(
    track: Track,
    mask: Masks,
    fault: str,
    values: Floats | None = None,
    limit: float = np.nan,
    *,
    severity: Severity | None = None,
) -> Iterator[Finding]:
    """Yield a finding for each range of consecutive True values in a mask over V points or V - 1 segments."""
    usual, text = _FAULTS[fault]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    over = 1 if len(mask) == len(track) - 1 else 0
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        worst = np.nan
        if values is not None:
            part = values[first:end]
            worst = float(part[np.nanargmax(np.abs(part))])
        last = end - 1 + over
        start_m, end_m = track.chainage_m[first], track.chainage_m[last]
        where = f"at {start_m:.1f} m" + (f" to {end_m:.1f} m" if end_m > start_m else "")
        yield Finding(
            severity=severity or usual,
            kind=fault.removeprefix("small "),
            first=first,
            last=last,
            chainage_m=float(start_m),
            kilometrage_m=float(track.kilometrage_m[first]),
            value=worst,
            limit=limit,
            sentence=f"{where}: {text.format(value=worst, limit=limit)}",
        )


def _spacing(track: Track, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    spacing = geometry.spacing_m
    yield from _runs(track, spacing == 0.0, "duplicate")
    near = (spacing > 0.0) & (spacing < _NEAR_DUPLICATE_M)
    yield from _runs(track, near, "near duplicate", spacing, _NEAR_DUPLICATE_M)
    degrees = np.stack([track.latitude_deg, track.longitude_deg]) / _COARSE_DEG
    rounded = bool((np.abs(degrees - np.round(degrees)) < 1e-4).all())
    yield from _runs(track, np.full(len(track), rounded), "rounded")
    yield from _runs(track, spacing > limits.gap_m, "gap", spacing, limits.gap_m)
    wide = (spacing > limits.spacing_m) & (spacing <= limits.gap_m)
    yield from _runs(track, wide, "spacing", spacing, limits.spacing_m)


def _shape(track: Track, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    with np.errstate(invalid="ignore"):
        deviation = np.abs(geometry.mid_chord_m)
        yield from _runs(track, deviation > limits.mid_chord_m, "mid-chord", deviation, limits.mid_chord_m)
        turn = np.abs(geometry.turn_deg)
        sharp = np.radians(turn) > geometry.reach_m / limits.least_radius_m
        kink = sharp & (turn > _KINK_DEG)
        too_sharp = turn > _SHARP_KINK_DEG
    yield from _runs(track, kink & too_sharp, "kink", turn, _SHARP_KINK_DEG, severity="error")
    yield from _runs(track, kink & ~too_sharp, "kink", turn, _KINK_DEG)


def _cant_side(track: Track, geometry: Geometry) -> Iterator[Finding]:
    """Yield a finding for each curve with negative cant.

    The findings are errors if all left curves or all right curves have negative cant. Otherwise they are warnings,
    because negative cant is usual in turnouts.
    """
    of_points = np.where(np.abs(geometry.point_curvature) > _CURVED_1PM, np.sign(geometry.point_curvature), 0.0)
    of_map = np.where(np.isinf(track.radius_m), 0.0, np.sign(track.radius_m))
    side = np.where(np.isnan(track.radius_m), of_points, of_map)
    curved = (side != 0.0) & (np.abs(track.cant_m) > _ADVERSE_M)
    negative = curved & (track.cant_m < 0.0)
    sides = [curved & (side == of) for of in (1.0, -1.0)]
    signed = any(own.any() and negative[own].all() for own in sides)
    yield from _runs(track, negative, "cant side", track.cant_m, severity="error" if signed else "warning")


def needed_spacing_m(quality: TrackQuality) -> float:
    """Return the point spacing [m] at which all chords are within 1 cm of the arc; infinite on straight track."""
    geometry = quality.geometry
    bend = np.where(np.isnan(geometry.map_curvature), geometry.point_curvature, geometry.map_curvature)
    sharpest = float(np.nanmax(np.abs(bend), initial=0.0))
    return float(np.sqrt(8.0 * _CENTIMETRE_M / sharpest)) if sharpest > 0.0 else np.inf


def _kilometrage(track: Track) -> Iterator[Finding]:
    kilometrage = track.kilometrage_m
    if np.isnan(kilometrage).all():
        return
    broken = kilometrage_breaks(track.chainage_m, kilometrage)
    change = np.diff(kilometrage)
    of_length = float(np.diff(track.chainage_m)[broken].sum() / track.chainage_m[-1])
    yield from _runs(track, broken, "kilometrage break", change, severity="error" if of_length > 0.5 else None)
    direction = np.where(broken | (change == 0.0), np.nan, np.sign(change))
    known = np.flatnonzero(np.isfinite(direction))
    turned = np.zeros(len(track), dtype=np.bool_)
    turned[known[1:][np.diff(direction[known]) != 0.0]] = True
    yield from _runs(track, turned, "kilometrage reversal")
    yield from _runs(track, np.isnan(kilometrage), "kilometrage absent")


def _heights(track: Track, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    impossible = (track.height_m < HEIGHTS_M[0]) | (track.height_m > HEIGHTS_M[1])
    yield from _runs(track, impossible, "height", track.height_m)
    gradient, spike = geometry.gradient_permille, geometry.height_spike_m
    with np.errstate(invalid="ignore"):
        steep = np.abs(gradient) > limits.gradient_permille
        yield from _runs(track, steep, "gradient", gradient, limits.gradient_permille)
        yield from _runs(track, np.abs(spike) > _HEIGHT_SPIKE_M, "height spike", spike, _HEIGHT_SPIKE_M)
        attribute, from_heights = mean_gradients(track, window_m=_GRADIENT_WINDOW_M)
        difference = attribute - from_heights
        wrong = np.abs(difference) > _GRADIENT_DIFFERENCE_PERMILLE
        yield from _runs(track, wrong, "gradient attribute", difference, _GRADIENT_DIFFERENCE_PERMILLE)


def _attributes(track: Track, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    cant = np.abs(track.cant_m)
    with np.errstate(invalid="ignore"):
        yield from _runs(track, cant > limits.cant_m, "cant", track.cant_m, limits.cant_m)
        yield from _cant_side(track, geometry)
        small = (cant > 0.0) & (np.nanmax(cant, initial=0.0) < _LEAST_CANT_M)
        yield from _runs(track, small, "small cant", track.cant_m)
        sharp = np.abs(track.radius_m) < limits.least_radius_m
        radius = np.where(np.isfinite(track.radius_m), track.radius_m, 0.0)
        yield from _runs(track, sharp, "radius", radius, limits.least_radius_m)
        opposite = geometry.map_curvature * geometry.point_curvature < 0.0
        opposite &= (np.abs(geometry.map_curvature) > _CURVED_1PM) & (np.abs(geometry.point_curvature) > _CURVED_1PM)
    yield from _runs(track, opposite, "radius side")


def section_spans(track: Track) -> list[tuple[float, float]]:
    """Return the chainages of the first and the last point of each section [m].

    The chainages decrease if the section was joined in reverse order.
    """
    ends = [0.0, *track.chainage_m[np.flatnonzero(np.diff(track.section, append=len(track.sections)))].tolist()]
    backwards = [f"{source} {BACKWARDS}" in track.provenance.notes for source in track.sections]
    spans = zip(ends[:-1], ends[1:], backwards, strict=True)
    return [(end, begin) if back else (begin, end) for begin, end, back in spans]

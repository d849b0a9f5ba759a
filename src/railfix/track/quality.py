"""Quality checks of a track map: spacing, mid-chord deviation, kinks, duplicates, kilometrage, gradient, cant.

A map error affects all satellites alike, so no screen of the observations detects it (P1 2.2(1), 4.1(3)).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Masks
from railfix.core.settings import Settings
from railfix.core.tables import plural
from railfix.track.track import HEIGHTS_M, Geometry, Track, geometry_of, kilometrage_breaks, windowed_gradients

Severity = Literal["error", "warning"]
_COARSE_DEG: Final = 1e-5  #: Coordinates rounded to this are up to half of it off [deg]: 0.6 m.
_LEAST_CANT_M: Final = 5e-4  #: Cant of less than this everywhere was meant to be in another unit [m].
_NEAR_DUPLICATE_M: Final = 0.10  #: Points nearer than this are the same point measured twice.
#: A turn at a point of more than this and sharper than `least_radius_m` is a kink.
_KINK_DEG: Final = 3.0
_SHARP_KINK_DEG: Final = 15.0  #: A kink of more than this is an error, else a warning.
#: Largest deviation of the height of a point from the line through its neighbours.
_HEIGHT_SPIKE_M: Final = 0.50
#: Largest difference of the gradient attribute from the heights, over `gradient_window_m`.
_GRADIENT_DIFFERENCE_PERMILLE: Final = 5.0
_GRADIENT_WINDOW_M: Final = 100.0


class MapLimits(Settings):
    """Limits of a track map; a value on the limit passes."""

    mid_chord_m: float = Field(default=0.30, gt=0)  #: Chord from arc at the middle of a segment (P1 4.1(3): 0.30 m).
    spacing_m: float = Field(default=50.0, gt=0)  #: Longest segment (P1 2.2(1): some tens of metres on straight track).
    #: A segment longer than this is a point that does not belong to the line, or a missing piece of it.
    gap_m: float = Field(default=2000.0, gt=0)
    least_radius_m: float = Field(default=60.0, gt=0)  #: Smallest radius that a railway vehicle can pass.
    gradient_permille: float = Field(default=60.0, gt=0)  #: Steepest segment.
    cant_m: float = Field(default=0.20, gt=0)  #: Largest absolute cant.


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One fault of the map at a range of neighbouring points or segments."""

    severity: Severity
    kind: str
    #: First and last point of the range.
    first: int
    last: int
    #: Of the first point; the kilometrage may be NaN.
    chainage_m: float
    kilometrage_m: float
    #: The worst value and its limit; NaN for faults without a number.
    value: float
    limit: float

    sentence: str


@dataclass(frozen=True, kw_only=True)
class TrackQuality:
    """Quality report of a track map.

    Attributes
    ----------
    track : Track
    limits : MapLimits
    geometry : Geometry
        Spacing, turns, mid-chord deviations and gradients that were checked.
    findings : tuple of Finding
        In order of chainage, errors first.
    """

    track: Track
    limits: MapLimits
    geometry: Geometry
    findings: tuple[Finding, ...]

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that make the map unusable."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that should be reviewed."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")


def check_track(track: Track, *, limits: MapLimits | None = None) -> TrackQuality:
    """Check the quality of a track map.

    Parameters
    ----------
    track : Track
        Read with ``duplicates="keep"`` so that duplicates are findings instead of an error.
    limits : MapLimits, optional

    Returns
    -------
    TrackQuality
    """
    limits = limits or MapLimits()
    geometry = geometry_of(track)
    report = _Report(track)
    findings = [
        *_spacing(report, geometry, limits),
        *_shape(report, geometry, limits),
        *_kilometrage(report, track),
        *_heights(report, track, geometry, limits),
        *_attributes(report, track, geometry, limits),
    ]
    findings.sort(key=lambda finding: (finding.severity != "error", finding.chainage_m))
    return TrackQuality(track=track, limits=limits, geometry=geometry, findings=tuple(findings))


def error_note(quality: TrackQuality) -> tuple[str, ...]:
    """A note on the errors of a map, with the first one; none without errors."""
    if not quality.errors:
        return ()
    return (
        f"map check: {plural(quality.errors, 'error')}, {plural(quality.warnings, 'warning')}; the first error "
        f"{quality.errors[0].sentence}; see railfix map check",
    )


#: Severity and sentence of each fault; ``{value}`` is the worst one, ``{limit}`` its limit.
_FAULTS: Final[dict[str, tuple[Severity, str]]] = {
    "duplicate": ("error", "the same point twice or more; remove the repetition"),
    "near duplicate": ("warning", "points only {value:.3f} m apart (limit {limit:g} m)"),
    "rounded": (
        "warning",
        "latitude and longitude have five decimals or fewer, so that points are up to 0.6 m off; seven were expected",
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
        "the kilometrage changes by {value:.4g} m, which is not the distance; metres were expected",
    ),
    "kilometrage reversal": ("warning", "the kilometrage reverses its direction"),
    "kilometrage absent": ("warning", "the map has no kilometrage here"),
    "height": (
        "error",
        "a height of {value:,.0f} m, where no railway is; is it in millimetres, or does it mean that there is none?",
    ),
    "gradient": ("warning", "the gradient of the heights is {value:.1f} per mille (limit {limit:g})"),
    "height spike": (
        "error",
        "the height deviates from the line through its neighbours by {value:.2f} m (limit {limit:g} m)",
    ),
    "gradient attribute": (
        "warning",
        "gradient_permille differs from the heights by {value:.1f} per mille (limit {limit:g}); rising is positive",
    ),
    "cant": ("error", "cant of {value:.3f} m (limit {limit:g} m); the column is in millimetres"),
    "small cant": (
        "error",
        "cant of {value:.2g} m, and nowhere more; is it in metres, where millimetres were expected?",
    ),
    "radius": ("error", "radius of {value:.1f} m (limit {limit:g} m)"),
    "radius side": (
        "error",
        "radius_m has the opposite sign of the bend of the points; right is positive in the direction of the file",
    ),
}


class _Report:
    """Converter of masks over points or segments to findings, one for each range of neighbours."""

    def __init__(self, track: Track) -> None:
        self.track = track

    def runs(
        self,
        mask: Masks,
        fault: str,
        values: Floats | None = None,
        limit: float = np.nan,
        *,
        severity: Severity | None = None,
    ) -> Iterator[Finding]:
        """Yield findings of a fault of `_FAULTS` for a mask over V points or V - 1 segments."""
        track = self.track
        usual, text = _FAULTS[fault]
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
        over = 1 if len(mask) == len(track) - 1 else 0
        for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            worst = np.nan
            if values is not None:
                part = values[first:end]
                worst = float(part[np.nanargmax(np.abs(part))])
            last = end - 1 + over
            where = f"at {track.chainage_m[first]:.1f} m" + (
                f" to {track.chainage_m[last]:.1f} m" if track.chainage_m[last] > track.chainage_m[first] else ""
            )
            yield Finding(
                severity=severity or usual,
                kind=fault.removeprefix("small "),
                first=first,
                last=last,
                chainage_m=float(track.chainage_m[first]),
                kilometrage_m=float(track.kilometrage_m[first]),
                value=worst,
                limit=limit,
                sentence=f"{where}: {text.format(value=worst, limit=limit)}",
            )


def _spacing(report: _Report, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    spacing = geometry.spacing_m
    yield from report.runs(spacing == 0.0, "duplicate")
    near = (spacing > 0.0) & (spacing < _NEAR_DUPLICATE_M)
    yield from report.runs(near, "near duplicate", spacing, _NEAR_DUPLICATE_M)
    degrees = np.stack([report.track.latitude_deg, report.track.longitude_deg]) / _COARSE_DEG
    rounded = bool((np.abs(degrees - np.round(degrees)) < 1e-4).all())
    yield from report.runs(np.full(len(report.track), rounded), "rounded")
    yield from report.runs(spacing > limits.gap_m, "gap", spacing, limits.gap_m)
    wide = (spacing > limits.spacing_m) & (spacing <= limits.gap_m)
    yield from report.runs(wide, "spacing", spacing, limits.spacing_m)


def _shape(report: _Report, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    with np.errstate(invalid="ignore"):
        deviation = np.abs(geometry.mid_chord_m)
        yield from report.runs(deviation > limits.mid_chord_m, "mid-chord", deviation, limits.mid_chord_m)
        turn = np.abs(geometry.turn_deg)
        sharp = np.radians(turn) > geometry.reach_m / limits.least_radius_m
        kink = sharp & (turn > _KINK_DEG)
        too_sharp = turn > _SHARP_KINK_DEG
    yield from report.runs(kink & too_sharp, "kink", turn, _SHARP_KINK_DEG, severity="error")
    yield from report.runs(kink & ~too_sharp, "kink", turn, _KINK_DEG)


def _kilometrage(report: _Report, track: Track) -> Iterator[Finding]:
    kilometrage = track.kilometrage_m
    if np.isnan(kilometrage).all():
        return
    broken = kilometrage_breaks(track.chainage_m, kilometrage)
    change = np.diff(kilometrage)
    of_length = float(np.diff(track.chainage_m)[broken].sum() / track.chainage_m[-1])
    yield from report.runs(broken, "kilometrage break", change, severity="error" if of_length > 0.5 else None)
    direction = np.where(broken | (change == 0.0), np.nan, np.sign(change))
    known = np.flatnonzero(np.isfinite(direction))
    turned = np.zeros(len(track), dtype=np.bool_)
    turned[known[1:][np.diff(direction[known]) != 0.0]] = True
    yield from report.runs(turned, "kilometrage reversal")
    yield from report.runs(np.isnan(kilometrage), "kilometrage absent")


def _heights(report: _Report, track: Track, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    impossible = (track.height_m < HEIGHTS_M[0]) | (track.height_m > HEIGHTS_M[1])
    yield from report.runs(impossible, "height", track.height_m)
    gradient, spike = geometry.gradient_permille, geometry.height_spike_m
    with np.errstate(invalid="ignore"):
        steep = np.abs(gradient) > limits.gradient_permille
        yield from report.runs(steep, "gradient", gradient, limits.gradient_permille)
        yield from report.runs(np.abs(spike) > _HEIGHT_SPIKE_M, "height spike", spike, _HEIGHT_SPIKE_M)
        attribute, from_heights = windowed_gradients(track, window_m=_GRADIENT_WINDOW_M)
        difference = attribute - from_heights
        wrong = np.abs(difference) > _GRADIENT_DIFFERENCE_PERMILLE
        yield from report.runs(wrong, "gradient attribute", difference, _GRADIENT_DIFFERENCE_PERMILLE)


def _attributes(report: _Report, track: Track, geometry: Geometry, limits: MapLimits) -> Iterator[Finding]:
    cant = np.abs(track.cant_m)
    with np.errstate(invalid="ignore"):
        yield from report.runs(cant > limits.cant_m, "cant", track.cant_m, limits.cant_m)
        small = (cant > 0.0) & (np.nanmax(cant, initial=0.0) < _LEAST_CANT_M)
        yield from report.runs(small, "small cant", track.cant_m)
        sharp = np.abs(track.radius_m) < limits.least_radius_m
        radius = np.where(np.isfinite(track.radius_m), track.radius_m, 0.0)
        yield from report.runs(sharp, "radius", radius, limits.least_radius_m)
        opposite = geometry.map_curvature * geometry.point_curvature < 0.0
        opposite &= (np.abs(geometry.map_curvature) > 1 / 3000) & (np.abs(geometry.point_curvature) > 1 / 3000)
    yield from report.runs(opposite, "radius side")

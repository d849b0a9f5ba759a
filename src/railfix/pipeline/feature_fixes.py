"""Positions from features of the line, such as curves, that the vehicle body has passed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Integers
from railfix.motion.features import (
    HALF_LENGTH_M,
    SCALE_SIGMA,
    Feature,
    LineSeries,
    LocatedFeature,
    line_series,
    locate,
    map_features,
)
from railfix.pipeline.passed_features import SLOWEST_MPS, FeatureState, PassedFeature, RateSeries
from railfix.track import Track
from railfix.track.curves import curved_line
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line

#: A feature is compared only if the profile has at least this number of points, spaced one metre, without a break.
_LEAST_POINTS: Final = 30


@dataclass(frozen=True, kw_only=True)
class LineFeatures:
    """Gradient, curvature and ordered features of a line; arc lengths are along the line."""

    series: LineSeries
    features: tuple[Feature, ...]
    antenna_m: Floats  #: Arc lengths of the vertices of the antenna's trajectory, shape (V,).
    body_m: Floats  #: Arc length of the body's middle on the line when the antenna is at each vertex, shape (V,).
    line: Line  #: Computes distances, also across the join of a closed line.

    @classmethod
    def of(cls, track: Track, trajectory: Trajectory) -> LineFeatures:
        """Compute the features of a track for the vehicle body that carries an antenna."""
        line = curved_line(track)
        series = line_series(line)
        body = trajectory.chainage_m if trajectory.body_chainage_m is None else trajectory.body_chainage_m
        inside = np.clip(body, line.chainage_m[0], line.chainage_m[-1])
        return cls(
            series=series, features=tuple(map_features(series)), antenna_m=np.asarray(trajectory.arc_m),
            body_m=line.arc_at_chainage(inside) + body - inside, line=Line(line),
        )  # fmt: skip

    def body_at(self, antenna_m: Floats) -> Floats:
        """Return the arc length of the body's middle when the antenna is at an arc length of its trajectory [m]."""
        return np.interp(antenna_m, self.antenna_m, self.body_m)


#: Minimum standard deviation of a position from a feature, due to the map and the body's motion on the bogies [m].
_FEATURE_SIGMA_M: Final = 0.5


@dataclass(frozen=True)
class TrackFeatures:
    """Features of a track for the vehicle body that carries an antenna, computed at the first call of `locate`."""

    track: Track
    trajectory: Trajectory

    @cached_property
    def line(self) -> LineFeatures:
        """Features of the track."""
        return LineFeatures.of(self.track, self.trajectory)

    def locate(
        self, rates: RateSeries, facing: float, sigma_m: float, state: FeatureState, *, noise: tuple[float, float]
    ) -> tuple[tuple[PassedFeature, ...], FeatureState]:
        """Return the accepted features that the train has passed, and the new state (`feature_fixes`)."""
        fixes, after = feature_fixes(rates, self.line, facing, sigma_m, state, noise=noise)
        least = (SCALE_SIGMA * HALF_LENGTH_M) ** 2 + _FEATURE_SIGMA_M**2
        found = (
            PassedFeature(fix.tick, fix.correction_m, float(np.sqrt(fix.located.sigma_m**2 + least)))
            for fix in fixes
            if fix.located.verdict == "accepted"
        )
        return tuple(found), after


@dataclass(frozen=True, kw_only=True)
class FeatureFix:
    """Verdict on one feature."""

    tick: int  #: First tick (index) at which the body's middle is `HALF_LENGTH_M` beyond the feature.
    feature: Feature
    located: LocatedFeature

    @property
    def correction_m(self) -> float:
        """Position from the feature minus wheel position [m]; NaN unless the feature is accepted."""
        return self.located.arc_m - self.feature.arc_m


class _Stretch(NamedTuple):
    """Consecutive usable ticks from `first` on, with heading and pitch at each whole metre since the last break."""

    first: int
    sense: float  #: Direction of travel: 1 toward rising arc length, else -1.
    distance_m: Floats  #: Wheel distance at all ticks of the chunk; index 0 is the tick before the chunk.
    body_m: Floats  #: Position of the body's middle at each tick from `first` on.
    #: Position `HALF_LENGTH_M` behind the body's middle at each tick; features up to this position are compared.
    behind_m: Floats
    metre: Integers
    heading_rad: Floats
    pitch_rad: Floats

    def shift_m(self, tick: int) -> float:
        """Return the position of the body's middle minus the wheel distance at a tick."""
        return float(self.body_m[tick - self.first] - self.distance_m[tick + 1])


def _fix_feature(
    feature: Feature,
    stretch: _Stretch,
    line: LineFeatures,
    noise: tuple[float, tuple[float, float]],
    facing: float,
    last: tuple[float, float, float] | None,
) -> FeatureFix | None:
    """Compare a stretch's profile with a feature; `noise` has the sigmas of wheel position, gradient and curvature."""
    tick = stretch.first + int(np.argmax(stretch.sense * (stretch.behind_m - feature.arc_m) >= 0.0))
    shift, distance = stretch.shift_m(tick), stretch.distance_m[tick + 1]
    # Signs of the profile are for rising arc length. For a reversing or turned vehicle, the sign of the pitch changes,
    # but the sign of the heading does not.
    passed = np.flatnonzero(stretch.sense * (stretch.metre - distance) <= 0.0)[:: int(stretch.sense)]
    place = np.asarray(stretch.metre[passed] + shift, dtype=np.float64)
    profile = (place, stretch.heading_rad[passed], facing * stretch.pitch_rad[passed])
    before = None
    if last is not None:
        covered = feature.arc_m - shift - last[2]
        # on a closed line the last feature may lie before the join
        nearest = line.line.nearest_m(np.array(last[0]), np.array(feature.arc_m - covered))
        before = (float(nearest), last[1], covered)
    located = _compare(profile, feature, line, noise[0], before, noise[1])
    return None if located is None else FeatureFix(tick=tick, feature=feature, located=located)


def feature_fixes(
    rates: RateSeries,
    line: LineFeatures,
    facing: float,
    sigma_m: float,
    state: FeatureState,
    *,
    noise: tuple[float, float],
) -> tuple[list[FeatureFix], FeatureState]:
    """Return verdicts on the features that the train has passed, and the state for the next chunk.

    A feature is compared as soon as the body's middle is `HALF_LENGTH_M` beyond it. Ticks with slip or a speed of at
    most 1 m/s are breaks, which restart the integration of heading and pitch. `facing` is 1 if the front points to
    rising arc length, else -1; `sigma_m` is the standard deviation of the wheel position; `noise` has the standard
    deviations of gradient and curvature over one metre.
    """
    distances = np.concatenate([[0.0], rates.distance_m]) + state.distance_m
    heading, pitch = (
        np.concatenate([[0.0], np.cumsum(turns)]) + begin
        for turns, begin in zip((rates.turned_rad, rates.climbed_rad), state.angles, strict=True)
    )
    usable = rates.rolls & (np.abs(rates.speed_mps) > SLOWEST_MPS) & np.isfinite(heading[1:] + pitch[1:])
    fixes: list[FeatureFix] = []
    metre, headings, pitches = state.metre, state.heading_rad, state.pitch_rad
    kept, last, done = int(2.5 * HALF_LENGTH_M), state.last, state.done_m
    breaks = np.flatnonzero(~usable)
    # each stretch of usable ticks ends at an unusable tick
    edges = np.concatenate([[-1], breaks, [len(usable)]])
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if begin >= 0:
            metre, headings, pitches = metre[:0], headings[:0], pitches[:0]
        if end - begin < 2:
            continue
        rows = slice(begin + 1, end + 1)  # tick k has row k + 1; row begin + 1 is the tick before the stretch
        distance = distances[rows]
        whole = _whole_metres(distance)
        if len(metre) and len(whole) and whole[0] != metre[-1] + np.sign(distance[-1] - distance[0]):
            metre, headings, pitches = metre[:0], headings[:0], pitches[:0]
        rising = distance if distance[-1] >= distance[0] else distance[::-1]
        turned, climbed = (v[rows] if distance[-1] >= distance[0] else v[rows][::-1] for v in (heading, pitch))
        metre = np.concatenate([metre, whole])
        headings = np.concatenate([headings, np.interp(whole, rising, turned)])
        pitches = np.concatenate([pitches, np.interp(whole, rising, climbed)])
        body = line.body_at(rates.arc_m[begin + 1 : end])
        if not np.isfinite(body[-1]) or len(metre) < _LEAST_POINTS:
            continue
        sense = 1.0 if metre[-1] > metre[0] else -1.0
        behind = body - sense * HALF_LENGTH_M
        passed = float(behind[-1])
        stretch = _Stretch(begin + 1, sense, distances, body, behind, metre, headings, pitches)
        known = done if done == done else float(behind[0])
        for feature in line.features[:: int(sense)]:
            if not 0.0 < sense * (feature.arc_m - known) <= sense * (passed - known):
                continue
            fix = _fix_feature(feature, stretch, line, (sigma_m, noise), facing, last)
            if fix is None:
                continue
            fixes.append(fix)
            if fix.located.verdict == "accepted":
                last = (fix.located.arc_m, fix.located.sigma_m, feature.arc_m - stretch.shift_m(fix.tick))
        # a feature is not compared twice after a backward correction of the position
        done = passed if not sense * (passed - done) < 0.0 or abs(passed - done) > HALF_LENGTH_M else done
    metre, headings, pitches = metre[-kept:], headings[-kept:], pitches[-kept:]
    angles = (float(np.nan_to_num(heading[-1])), float(np.nan_to_num(pitch[-1])))
    return fixes, replace(
        state, distance_m=float(distances[-1]), angles=angles, metre=metre, heading_rad=headings, pitch_rad=pitches,
        last=last, done_m=done,
    )  # fmt: skip


def _whole_metres(distance_m: Floats) -> Integers:
    """Return the whole metres between the first value and the last, in the order of travel."""
    first, last = float(distance_m[0]), float(distance_m[-1])
    if last >= first:
        return np.arange(np.floor(first) + 1, np.floor(last) + 1).astype(np.int64)
    return np.arange(np.ceil(first) - 1, np.ceil(last) - 1, -1).astype(np.int64)


def _compare(
    profile: tuple[Floats, Floats, Floats],
    feature: Feature,
    line: LineFeatures,
    sigma_m: float,
    last: tuple[float, float, float] | None,
    noise: tuple[float, float],
) -> LocatedFeature | None:
    """Return the verdict on one feature; None unless the train passed the whole feature without a break.

    `profile` has arc lengths, headings and pitches at whole metres.
    """
    arc_m, heading_rad, pitch_rad = profile
    about = arc_m - feature.arc_m
    near = np.flatnonzero(np.abs(about) <= HALF_LENGTH_M)
    if len(near) < 1.8 * HALF_LENGTH_M or len(near) < 3:
        return None
    heading, pitch = heading_rad[near], pitch_rad[near]
    measured = LineSeries(
        arc_m=np.asarray(about[near][1:-1], dtype=np.float64),
        gradient=np.tan(pitch[1:-1]),
        curvature_1pm=0.5 * (heading[2:] - heading[:-2]),
    )
    return locate(measured, line.series, feature.arc_m, sigma_m, quantity=feature.quantity, noise=noise, last=last)

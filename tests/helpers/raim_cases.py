"""Made cases for RAIM and levels: ranges along a straight line with just the errors that the model assumes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

import synthetic
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.integrity.raim import LinearModel, linear_model
from railfix.integrity.raim.position_model import _model
from railfix.positioning.normal_equations import Constrained, point_position, position_on_line
from railfix.positioning.range_arrays import InterSystemBiases, Ranges
from railfix.ranges.channels import clock_groups
from railfix.track import Track
from railfix.track.trajectory import Trajectory

#: Offsets of the clocks that made cases have [m].
CLOCK_OFFSET_M = (0.0, 12.0, -30.0, 5.0)


def point_model(ranges: Ranges, ecef_m: np.ndarray) -> LinearModel:
    """3-D positions: east, north and up unknown, the horizontal ones wanted (P4's horizontal form)."""
    latitude, longitude, _ = geodetic_from_ecef(ecef_m)
    return _model(ranges, ecef_m, enu_axes(latitude, longitude), np.zeros((3, 3)), unknowns=3)


def straight(length_m: float = 2000.0) -> Trajectory:
    """A line to the north-east, points every 20 m."""
    s = np.arange(0.0, length_m + 1.0, 20.0)
    return Trajectory.from_antenna_path(
        Track.from_ecef(synthetic.enu_to_ecef(np.stack([0.6 * s, 0.8 * s, 0.002 * s], axis=1)))
    )


LINE = straight()


def made(
    arc_m: np.ndarray,
    systems: str,
    *,
    seed: int,
    faults_m: Mapping[int, float] | None = None,
    tie_sigma_m: tuple[float, ...] | None = None,
    noise: float = 1.0,
    sat_ecef_m: np.ndarray | None = None,
    sigma_m: np.ndarray | None = None,
) -> Ranges:
    """Ranges with just the noise, the map error and the clock offsets that the model assumes, read-only."""
    rng = np.random.default_rng(seed)
    shape = (len(arc_m), len(systems))
    sat = synthetic.satellites(rng, *shape[:1], systems) if sat_ecef_m is None else sat_ecef_m
    sigma = rng.uniform(0.5, 3.0, shape) if sigma_m is None else np.broadcast_to(sigma_m, shape)
    groups = clock_groups(list(systems))
    section = LINE.segment_at(arc_m)[0]
    place = LINE.at_arc(arc_m)
    place = place + rng.normal(0.0, LINE.sigma_plan_m, (len(arc_m), 1)) * LINE.across[section]
    place = place + rng.normal(0.0, LINE.sigma_height_m, (len(arc_m), 1)) * LINE.up[section]
    code = synthetic.travelled_range(sat, place[:, None, :]) + 3.0e4 + noise * sigma * rng.normal(size=shape)
    ties = None
    if tie_sigma_m is not None:
        tie_sigma = np.broadcast_to(np.array(tie_sigma_m[: len(groups)]), (len(arc_m), len(groups)))
        offset = np.broadcast_to(np.array(CLOCK_OFFSET_M[: len(groups)]), tie_sigma.shape)
        ties = InterSystemBiases(offset_m=offset, sigma_m=tie_sigma)
        drawn = offset + np.minimum(tie_sigma, 100.0) * rng.normal(size=tie_sigma.shape)
    else:
        drawn = np.broadcast_to(np.array(CLOCK_OFFSET_M[: len(groups)]), (len(arc_m), len(groups)))
    for g, group in enumerate(groups):
        code[:, group] += drawn[:, g, None]
    for channel, size in (faults_m or {}).items():
        code[:, channel] += size
    weight = 1.0 / sigma**2
    for array in (sat, code, weight):
        array.flags.writeable = False
    return Ranges(sat_ecef_m=sat, code_m=code, weight=weight, groups=groups, ties=ties)


def only(ranges: Ranges, channels: list[int]) -> Ranges:
    """Weight left to some channels."""
    weight = np.zeros_like(ranges.weight)
    weight[:, channels] = ranges.weight[:, channels]
    weight.flags.writeable = False
    return Ranges(
        sat_ecef_m=ranges.sat_ecef_m, code_m=ranges.code_m, weight=weight, groups=ranges.groups, ties=ranges.ties
    )


def solved(ranges: Ranges, arc_m: np.ndarray) -> tuple[Constrained, LinearModel]:
    """Position on the line, started near the truth, and its model."""
    got = position_on_line(ranges, LINE, np.argmin(np.abs(LINE.arc_m - arc_m[:, None]), axis=1))
    return got, linear_model(ranges, LINE, got.arc_m, section=got.section)


def in_space(ranges: Ranges) -> LinearModel:
    """Model of the 3-D position."""
    point = point_position(ranges, np.broadcast_to(LINE.ecef_m[0], (len(ranges), 3)))
    return point_model(ranges, point.ecef_m)

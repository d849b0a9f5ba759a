"""Positions of one antenna: section search, constrained fix, its linear model, validation of the conventional position.

The checks that single-point programs make of each position (RTKLIB: `valsol` of pntpos.c). A position that fails one
keeps its coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from railfix.core.arrays import Codes, Floats, Indices, Integers
from railfix.integrity.raim import RaimLimits, detect
from railfix.integrity.raim.model import LinearModel, model_on_line
from railfix.pipeline.config import Config
from railfix.pipeline.results import patched
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.constrained import Constrained, constrained_position
from railfix.positioning.normal_equations import Ranges, inverse_3x3, normal_equations
from railfix.positioning.section_search import SearchIndex, Section, search
from railfix.positioning.single_point import SinglePoint, SinglePointLimits, single_point


@dataclass(frozen=True, kw_only=True)
class Place:
    """Positions of one antenna from one set of ranges, T epochs."""

    point: SinglePoint  #: 3-D position without the map.
    section: Section  #: Best-fitting vertex of the trajectory.
    constrained: Constrained  #: Position on the line.


def place_on_line(ranges: Ranges, index: SearchIndex, point: SinglePoint, config: Config) -> Place:
    """Return section and constrained position of the epochs that have `Config.min_satellites`.

    Parameters
    ----------
    ranges : Ranges
    index : SearchIndex
    point : SinglePoint
        3-D position from the same ranges.
    config : Config
    """
    section = search(ranges, index, point, limits=config.section)
    vertex = np.where(ranges.n_used >= config.min_satellites, section.vertex, -1)
    constrained = constrained_position(ranges, index.trajectory, vertex, limits=config.constrained)
    return Place(point=point, section=section, constrained=constrained)


def solved_again(ranges: Ranges, index: SearchIndex, place: Place, epochs: Indices, config: Config) -> Place:
    """Return positions of which those of some epochs of one antenna are solved again, from other ranges."""
    part = ranges.take(epochs)
    point = single_point(part, place.point.ecef_m[epochs], limits=config.single_point)
    solved = place_on_line(part, index, point, config)
    return Place(
        point=patched(place.point, epochs, solved.point),
        section=patched(place.section, epochs, solved.section),
        constrained=patched(place.constrained, epochs, solved.constrained),
    )


def line_model(ranges: Ranges, antennas: AntennaRows, constrained: Constrained) -> LinearModel:
    """Return the model of positions on the line (`constrained_model`); NaN in the epochs without one."""
    section = np.maximum(constrained.section, 0)
    axes = antennas.each(lambda index, rows: index.trajectory.axes_of(section[rows]))
    place = antennas.at_arc(constrained.arc_m)
    return model_on_line(ranges, place, axes, antennas.sigma_plan_m, antennas.sigma_height_m)


def redundancy_of(ranges: Ranges) -> Integers:
    """Return the number of ranges beyond the clocks and the distance along the line, shape (T,)."""
    return np.asarray(ranges.n_used - ranges.n_clocks - 1, dtype=np.int64)


class PointStatus(IntEnum):
    """Result of the validation of a conventional position."""

    #: Both checks passed; residuals without a redundant range pass.
    VALID = 0
    #: There is no position.
    NO_POSITION = 1
    #: The residuals exceed what noise explains.
    RESIDUALS = 2
    #: The dilution of precision is over its limit.
    DILUTION = 3


def validate_point(point: SinglePoint, ranges: Ranges, noise_scale: Floats, *, limits: SinglePointLimits) -> Codes:
    """Return the `PointStatus` of each position, shape (T,).

    Parameters
    ----------
    point : SinglePoint
        Every constellation with a clock of its own.
    ranges : Ranges
        From which it was computed.
    noise_scale : ndarray, shape (T,)
        Standard deviation of this receiver's ranges over the sigmas of the weights.
    limits : SinglePointLimits
    """
    test = detect(
        point.wsse,
        point.residual_m,
        ranges.n_used - ranges.n_clocks - 3,
        scale=noise_scale,
        limits=RaimLimits(false_alarm=limits.false_alarm),
    )
    located = np.asarray(np.isfinite(point.ecef_m).all(axis=1))
    over = np.zeros(len(ranges), dtype=np.bool_)
    over[located] = ~(position_dilution(ranges.take(located), point.ecef_m[located]) <= limits.dilution_limit)
    conditions = [~located, test.detected, over]
    return np.select(conditions, [PointStatus.NO_POSITION, PointStatus.RESIDUALS, PointStatus.DILUTION]).astype(np.int8)


def position_dilution(ranges: Ranges, ecef_m: Floats) -> Floats:
    """Return the position dilution of precision, every constellation with a clock of its own, shape (T,).

    Root of the trace of the position's covariance for ranges of unit sigma; NaN where the geometry is singular.
    """
    alike = replace(ranges, weight=(ranges.weight > 0).astype(np.float64))
    inverse = inverse_3x3(normal_equations(alike, ecef_m).matrix)
    return np.asarray(np.sqrt(np.einsum("tii->t", inverse)))

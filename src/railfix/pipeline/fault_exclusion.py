"""RAIM at work: positions without the satellites that do not agree with the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.integrity.raim import LinearModel, Outcome, constrained_model, detect, exclude, reliability, worst_channel
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import without
from railfix.pipeline.results import Raim, patched
from railfix.pipeline.solve import Place, place_on_line, redundancy_of
from railfix.positioning.constrained import Constrained
from railfix.positioning.normal_equations import Ranges
from railfix.positioning.section_search import SearchIndex
from railfix.positioning.single_point import single_point
from railfix.track.trajectory import Trajectory


def fault_free(
    ranges: Ranges, index: SearchIndex, place: Place, scale: Floats, config: Config
) -> tuple[Ranges, Place, Raim]:
    """RAIM: where a fault is detected and its satellites are found, the position without them."""
    limits, constrained = config.raim, place.constrained
    found = detect(constrained.wsse, constrained.residual_m, redundancy_of(ranges), limits=limits, scale=scale)
    raim = Raim(
        outcome=np.where(found.testable, Outcome.PASSED, Outcome.UNTESTABLE).astype(np.int8),
        statistic=found.statistic,
        threshold=found.threshold,
        excluded=np.zeros(ranges.code_m.shape, dtype=bool),
        own_error_m=np.full(ranges.code_m.shape, np.nan),
        protection_level_m=np.full(len(ranges), np.nan),
    )
    failing = np.flatnonzero(found.detected)
    if "raim" not in config.screens:
        raim.outcome[:] = Outcome.UNTESTABLE
        return ranges, place, raim
    if not len(failing):
        return ranges, place, raim
    arc, section = constrained.arc_m[failing], constrained.section[failing]
    model = constrained_model(ranges.take(failing), index.trajectory, arc, section=section)
    exclusion = exclude(model, limits=limits, scale=scale[failing])
    raim.outcome[failing] = exclusion.outcome
    raim.excluded[failing], raim.own_error_m[failing] = exclusion.excluded, exclusion.own_error_m
    left = exclusion.outcome == Outcome.UNRESOLVED
    _from_elsewhere(ranges, index, place, raim, failing[left], model.take(np.flatnonzero(left)), scale, config)
    again = failing[raim.excluded[failing].any(axis=1)]
    if len(again):
        ranges = without(ranges, raim.excluded)
        part = ranges.take(again)
        rest = single_point(part, place.point.ecef_m[again], limits=config.single_point)
        mended = place_on_line(part, index, rest, config)
        constrained = mended.constrained
        # Without the fault the best section can be another one: is the rest of one mind there too?
        once_more = detect(
            constrained.wsse, constrained.residual_m, redundancy_of(part), limits=limits, scale=scale[again]
        )
        raim.outcome[again[once_more.detected]] = Outcome.UNRESOLVED
        place = Place(
            point=patched(place.point, again, mended.point),
            section=patched(place.section, again, mended.section),
            constrained=patched(place.constrained, again, mended.constrained),
        )
    return ranges, place, raim


def _from_elsewhere(
    ranges: Ranges,
    index: SearchIndex,
    place: Place,
    raim: Raim,
    stuck: Indices,
    model: LinearModel,
    scale: Floats,
    config: Config,
) -> None:
    """Try unresolved epochs once more from where they are without their worst satellite; written into `raim`.

    A large fault on a curve moves the position to a place where the line runs another way, and
    what is linear there is not where the train is.
    """
    if not len(stuck):
        return
    worst = worst_channel(model)
    one = np.zeros((len(stuck), ranges.code_m.shape[1]), dtype=bool)
    one[np.arange(len(stuck)), worst] = True
    whole = ranges.take(stuck)
    part = without(whole, one)
    point = single_point(part, place.point.ecef_m[stuck], limits=config.single_point)
    rest = place_on_line(part, index, point, config).constrained
    there = constrained_model(whole, index.trajectory, rest.arc_m, section=rest.section)
    exclusion = exclude(there, limits=config.raim, scale=scale[stuck])
    found = np.flatnonzero(exclusion.excluded.any(axis=1))
    raim.outcome[stuck[found]] = exclusion.outcome[found]
    raim.excluded[stuck[found]] = exclusion.excluded[found]
    raim.own_error_m[stuck[found]] = exclusion.own_error_m[found]


def protected(
    ranges: Ranges, trajectory: Trajectory, constrained: Constrained, raim: Raim, scale: Floats, config: Config
) -> Raim:
    """RAIM with the protection level of what is left, where no fault is left in it."""
    model = constrained_model(ranges, trajectory, constrained.arc_m, section=constrained.section)
    level = reliability(model, limits=config.raim, scale=scale).protection_level_m
    faulty = np.isin(raim.outcome, [Outcome.INSEPARABLE, Outcome.UNRESOLVED])
    return replace(raim, protection_level_m=np.where(faulty, np.nan, level))

"""ARAIM levels of the positions on the line and, beside them, of 3-D positions from the same ranges."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Floats, Masks, changed
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.integrity.protection.araim import AraimGeometry, AraimResult, araim_levels
from railfix.integrity.protection.support import IntegritySupport
from railfix.pipeline.level_stage import level_scale
from railfix.positioning.antenna_rows import AntennaRows

if TYPE_CHECKING:
    from railfix.pipeline.config import Config
    from railfix.pipeline.corrected_ranges import CorrectedRanges
    from railfix.pipeline.solution import Solution

#: Unknowns of the position.
_SPACE: Final = 3


def with_araim(
    corrected: CorrectedRanges,
    solution: Solution,
    antennas: AntennaRows,
    support: IntegritySupport | None,
    config: Config,
) -> Solution:
    """Return the positions with ARAIM levels, where there is an integrity support message.

    Integrity: URA of the message, atmosphere of `Config.nominal` and the noise of the ranges by its scale; accuracy and
    thresholds: URE in place of URA.

    Parameters
    ----------
    corrected : CorrectedRanges
        With all reasons.
    solution : Solution
    antennas : AntennaRows
    support : IntegritySupport or None
    config : Config
    """
    if support is None:
        return solution
    place = np.where(np.isfinite(solution.arc_m)[:, None], antennas.at_arc(solution.arc_m), np.nan)
    sight, clocks, channels = _sight(corrected, place)
    stated = support.arrays(corrected.satellite[channels].tolist())
    air = config.nominal.replaced(satellite_sigma_m=0.0).sigma_m(corrected.elevation_deg[:, channels])
    noise = level_scale(solution.noise_scale, config)[:, None] * corrected.sigma_m[:, channels]
    if config.error_model is not None:
        noise = np.fmax(noise, corrected.bound_sigma_m[:, channels])
    used = (corrected.reason[:, channels] == 0) & np.isfinite(place[:, :1])
    integrity, accuracy = (
        np.where(used, np.sqrt(sigma**2 + air**2 + noise**2), np.nan)
        for sigma in (stated.sigma_ura_m, stated.sigma_ure_m)
    )
    letters = np.array([name[0] for name in corrected.satellite[channels].tolist()], dtype=np.str_)
    named = [letter for letter in stated.constellation_prior if (letters == letter).any()]
    ranges = AraimGeometry(
        design=np.concatenate([-sight, np.broadcast_to(clocks, (len(place), *clocks.shape))], axis=2),
        sigma_int_m=integrity,
        sigma_acc_m=accuracy,
        bias_m=np.broadcast_to(np.nan_to_num(stated.bias_m), integrity.shape),
        prior=np.nan_to_num(stated.prior),
        together=np.array([letters == letter for letter in named], dtype=bool).reshape(len(named), len(letters)),
        together_prior=np.array([stated.constellation_prior[letter] for letter in named]),
    )
    budget = config.araim
    near = np.nan_to_num(place, nan=1e6)
    axes = antennas.each(
        lambda index, rows: index.trajectory.axes_of(np.maximum(solution.place.constrained.section[rows], 0))
    )
    on_line = with_map(_turned(ranges, axes), antennas.sigma_plan_m, antennas.sigma_height_m, budget.map_prior)
    horizontal = budget.phmi_horizontal / 2.0, budget.false_alarm_horizontal / 2.0
    return changed(
        solution,
        araim=AraimResult(
            along=araim_levels(on_line, [budget.phmi_along], [budget.false_alarm_along], budget),
            space=araim_levels(
                _turned(ranges, enu_axes(*geodetic_from_ecef(near)[:2])),
                [horizontal[0], horizontal[0], budget.phmi_vertical],
                [horizontal[1], horizontal[1], budget.false_alarm_vertical],
                budget,
            ),
        ),
    )


def _sight(corrected: CorrectedRanges, place: Floats) -> tuple[Floats, Floats, Masks]:
    """Return unit vectors (T, M, 3) and columns of the clocks (M, G) of the M channels that are used at any epoch."""
    channels = (corrected.reason == 0).any(axis=0)
    to_satellite = corrected.satellites.position_ecef_m[:, channels] - place[:, None, :]
    distance = np.linalg.norm(to_satellite, axis=2, keepdims=True)
    clock = corrected.channels.clock[channels]
    clocks = np.array([clock == letter for letter in dict.fromkeys(clock.tolist())], dtype=np.float64)
    return to_satellite / distance, clocks.reshape(-1, len(clock)).T, channels


def _turned(geometry: AraimGeometry, axes: Floats) -> AraimGeometry:
    """Return the geometry with the position along other axes, rows of shape (T, 3, 3)."""
    design = geometry.design.copy()
    design[..., :_SPACE] = design[..., :_SPACE] @ axes.swapaxes(1, 2)
    return changed(geometry, design=design)


def with_map(geometry: AraimGeometry, plan_m: float, height_m: float, prior: float) -> AraimGeometry:
    """Return the geometry on a line, axes along, across and up, with the map as two more observations.

    Parameters
    ----------
    geometry : AraimGeometry
    plan_m, height_m : float [m]
        Standard deviations of the map across and up.
    prior : float
        Probability that both are wrong.
    """
    epochs, ranges, unknowns = geometry.design.shape
    rows = np.zeros((epochs, 2, unknowns))
    rows[:, 0, 1] = rows[:, 1, 2] = 1.0
    sigma, nothing = np.broadcast_to(np.array([plan_m, height_m]), (epochs, 2)), np.zeros((epochs, 2))
    together = np.zeros((len(geometry.together) + 1, ranges + 2), dtype=bool)
    together[:-1, :-2], together[-1, -2:] = geometry.together, True
    return AraimGeometry(
        design=np.concatenate([geometry.design, rows], axis=1),
        sigma_int_m=np.concatenate([geometry.sigma_int_m, sigma], axis=1),
        sigma_acc_m=np.concatenate([geometry.sigma_acc_m, sigma], axis=1),
        bias_m=np.concatenate([geometry.bias_m, nothing], axis=1),
        prior=np.concatenate([geometry.prior, np.zeros(2)]),
        together=together,
        together_prior=np.append(geometry.together_prior, prior),
    )

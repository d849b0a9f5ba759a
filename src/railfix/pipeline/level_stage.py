"""Protection levels of single-epoch positions, and ARAIM levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Codes, Floats, Masks, copy_with
from railfix.core.constants import SUPPORTED_SIDE_PRIOR
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.reasons import CHECK_FAILED, Status
from railfix.integrity.fault_exclusion import RaimResult
from railfix.integrity.protection import (
    Cause,
    LevelStatus,
    ProtectionLevel,
    RiskBudget,
    availability,
    protection_level,
)
from railfix.integrity.protection.araim import AraimGeometry, AraimResult, SatelliteSupport, araim_levels
from railfix.integrity.protection.open_places import places_beyond_the_level
from railfix.integrity.protection.solution_separation import MapDeviation, RangeBounds
from railfix.integrity.raim import LinearModel, linear_model
from railfix.kernels.tracking.constants import AHEAD
from railfix.pipeline.config import Config
from railfix.pipeline.fault_stage import CheckedPositions
from railfix.pipeline.solution import ProtectionResult, Solution
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.line_fix import LineFix
from railfix.positioning.map_offset import MapOffset
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.corrected import CorrectedRanges

#: Kinds of protection levels. With SBAS, which covers satellite faults, the hypotheses are local faults only.
#: Otherwise, they also include satellite faults (solution separation).
KINDS: Final[tuple[str, str]] = ("sbas", "separation")


#: True for each status that makes the protection level an alarm; the index is the status number.
_ALARMING: Final = np.array(
    [status in (*CHECK_FAILED, Status.OFF_MAP, Status.MAP_OFFSET) for status in range(max(Status) + 1)]
)

#: Basis of a level: fault priors measured on the line, or assumed. For an indicative level no hourly risk is claimed.
BASES: Final[tuple[str, str]] = ("measured", "indicative")


def choose_basis(config: Config) -> str:
    """Return the entry of `BASES` for the protection levels of a run."""
    return BASES[0] if config.risk.priors == "measured" else BASES[1]


def prior_basis_text(facts: Mapping[str, Any]) -> str:
    """Return a sentence on whether a run's fault priors (`level_facts`) were measured, and supported by data."""
    words = {
        "indicative": "indicative: priors of faults are assumed, not measured on this line; no hourly risk is claimed",
        "measured": "priors of local faults are measured on this line, risk.map_prior is assumed",
    }
    side = facts.get("side_prior")
    text = words.get(str(facts.get("basis")), "not recorded")
    measured = facts.get("basis") == "measured" and side != 0
    if isinstance(side, int | float) and side < SUPPORTED_SIDE_PRIOR and not measured:
        text += (
            f"; no data supports a probability as small as {side:g} that the satellites of one side of the track are "
            f"faulty together (risk.side_prior; hours in simulated cities support {SUPPORTED_SIDE_PRIOR:g})"
        )
    return text


def choose_kind(config: Config) -> str:
    """Return the entry of `KINDS` for the levels of a run."""
    return KINDS[0] if config.sbas else KINDS[1]


def level_facts(config: Config) -> dict[str, Any]:
    """Return the assumptions of the levels of a run as plain values; empty if the levels are off."""
    if config.protection == "off":
        return {}
    risk = get_risk_budget(config)
    sigmas = (
        "noise settings, multiplied by the receiver's estimated noise scale of at least 1; "
        "the tails of the range errors are not bounded"
    )
    return {
        "kind": choose_kind(config),
        "basis": choose_basis(config),
        "priors": risk.priors,
        "sigmas": sigmas if config.error_model is None else str(config.error_model),
        "alarm_limit_m": config.alarm_limit_m,
        "risk_per_hour": risk.risk_per_hour,
        "samples_per_hour": risk.samples_per_hour,
        "risk_per_sample": risk.risk_per_sample,
        "k_of_whole_risk": round(risk.sample_k, 3),
        "satellite_prior": dict(risk.satellite_prior),
        "local_prior": risk.local_prior,
        "map_prior": risk.map_prior,
        "side_prior": risk.side_prior,
        "false_alarm": risk.false_alarm,
    }


def get_risk_budget(config: Config) -> RiskBudget:
    """Return the risk budget in use; with SBAS, which covers satellite faults, it has local faults only."""
    return config.risk if choose_kind(config) == "separation" else config.local_risk


def level_scale(scale: Floats, config: Config) -> Floats:
    """Return the levels' noise scale, shape (T,). Only with an error model and without SBAS, it may be below 1."""
    return np.maximum(scale, 1.0) if config.error_model is None or config.sbas else scale


def level_stage(
    corrected: CorrectedRanges,
    ranges: Ranges,
    checked: CheckedPositions,
    antennas: AntennaRows,
    offset: MapOffset,
    config: Config,
) -> tuple[ProtectionResult | None, Masks]:
    """Return protection levels (None if off), and whether another possible position is beyond the level, shape (T,)."""
    fix, model, raim, scale, *_ = checked
    if config.protection != "on" or config.carrier in ("float", "fixed"):
        return None, np.zeros(len(ranges), dtype=bool)
    section = np.maximum(fix.constrained.section, 0)
    heading = antennas.each(lambda index, rows: index.trajectory.heading_deg[section[rows]])
    sides = late_sides(corrected.azimuth_deg, corrected.elevation_deg, heading, config.risk)
    systems = [name[0] for name in corrected.satellite.tolist()]
    overbound = None if config.error_model is None else RangeBounds(corrected.bound_sigma_m, corrected.bias_m)
    level = protection_levels(model, systems, offset, raim, scale, sides, config, overbound=overbound)
    bounding = (model, scale)
    if config.error_model is not None:
        sigma = np.maximum(corrected.bound_sigma_m, scale[:, None] * corrected.sigma_m)
        bounding = overbound_model(sigma, ranges, antennas, fix)
    beyond = np.where(fix.section.excess > config.section.threshold, level.level.level_m, np.nan)
    open_elsewhere = places_beyond_the_level(
        antennas, fix.constrained.arc_m, bounding[0], beyond, bounding[1], systems, get_risk_budget(config), sides
    )
    return level, open_elsewhere


def protection_levels(
    model: LinearModel,
    systems: Sequence[str],
    offset: MapOffset,
    raim: RaimResult,
    scale: Floats,
    sides: Masks,
    config: Config,
    *,
    overbound: RangeBounds | None = None,
) -> ProtectionResult:
    """Return the protection levels of a chunk, from the linear model of the positions on the line.

    If the measured map offset exceeds one sigma, the excess is added to the level as a bias. The hypothesis of a wrong
    map covers undetected offsets. Small residuals do not reduce a level: `level_scale` limits the noise scale, and
    sigmas are at least those of the error model. `scale` has shape (T,). `sides` is the result of `late_sides`.
    """
    covariance = np.where(raim.faulty[:, None, None], np.nan, model.covariance_m2)
    level = protection_level(
        replace(model, covariance_m2=covariance), systems,
        risk=get_risk_budget(config), scale=level_scale(scale, config), overbound=overbound,
        map_error=MapDeviation(np.array(offset.beyond_m).T, offset.seen), sides=sides,
        n_excluded=raim.excluded,
    )  # fmt: skip
    status = availability(level.level_m, config.alarm_limit_m, consistent=level.consistent)
    return ProtectionResult(level=level, status=status, kind=choose_kind(config), basis=choose_basis(config))


def overbound_model(sigma_m: Floats, ranges: Ranges, antennas: AntennaRows, fix: LineFix) -> tuple[LinearModel, Floats]:
    """Return the linear model with overbounding range sigmas `sigma_m` (T, K), and a noise scale of 1, shape (T,)."""
    weight = np.where(ranges.weight > 0, 1.0 / sigma_m**2, 0.0)
    found = fix.constrained
    model = linear_model(replace(ranges, weight=weight), antennas, found.arc_m, section=found.section)
    return model, np.ones(len(ranges))


def late_sides(azimuth_deg: Floats, elevation_deg: Floats, heading_deg: Floats, risk: RiskBudget) -> Masks:
    """Return masks (T, S, K) of S sets of satellites whose codes can be delayed simultaneously; `heading_deg` is the
    azimuth of the track, shape (T,).

    The sets are the low satellites left and right of the track. If `RiskBudget.late_sides` is "all", there are two more
    sets: the satellites ahead and behind.
    """
    off_heading = np.radians(azimuth_deg - heading_deg[:, None])
    right, low = np.sin(off_heading) > 0, elevation_deg < risk.side_elevation_deg
    sides = [low & ~right, low & right]
    if risk.late_sides == "all":
        along = np.cos(off_heading) * np.cos(np.radians(elevation_deg))
        sides += [along > AHEAD, along < -AHEAD]
    return np.stack(sides, axis=1)


def apply_verdicts(
    protection: ProtectionResult, status: Codes, has: Masks, chainage_m: Floats, config: Config
) -> ProtectionResult:
    """Return the protection levels, adapted to the statuses and coordinates of the positions.

    A level is valid only for the position at which the ranges were linearised. If another position fits the ranges
    equally well, or the ranges place the antenna beyond an end of the map, the level is unavailable. A failed check, or
    a contradiction of ranges and map, is an alarm. Where `has` is False, there are no coordinates and no level. If the
    position plus or minus the level touches a stretch of `Config.no_level_m`, the level is infinite.
    """
    level, verdict = protection.level, protection.status
    if config.no_level_m or not has.all():
        level = _where_it_holds(level, has, chainage_m, config)
        verdict = availability(level.level_m, config.alarm_limit_m, consistent=level.consistent)
    verdict = np.where(_ALARMING[status], int(LevelStatus.ALARM), verdict)
    doubtful = np.isin(status, (Status.AMBIGUOUS, Status.MAP_END))
    verdict = np.where(doubtful & (verdict == int(LevelStatus.AVAILABLE)), int(LevelStatus.UNAVAILABLE), verdict)
    return copy_with(protection, level=level, status=verdict.astype(np.int8))


def _where_it_holds(level: ProtectionLevel, has: Masks, chainage_m: Floats, config: Config) -> ProtectionLevel:
    """Return the levels: NaN at epochs without coordinates, infinite in the stretches of `Config.no_level_m`."""
    values = {
        name: np.where(has, value, np.nan) if value.dtype == np.float64 else value
        for name, value in vars(level).items()
    }
    for start, end in config.no_level_m:
        near = (chainage_m + values["level_m"] > start) & (chainage_m - values["level_m"] < end)
        values["level_m"] = np.where(near, np.inf, values["level_m"])
        values["cause"] = np.where(near, int(Cause.UNBOUNDED), values["cause"]).astype(np.int8)
    return ProtectionLevel(**values)


#: Number of unknown coordinates.
_SPACE: Final = 3


def compute_araim(
    corrected: CorrectedRanges,
    solution: Solution,
    antennas: AntennaRows,
    support: SatelliteSupport,
    config: Config,
) -> AraimResult:
    """Compute ARAIM levels of positions on the line, shape (T,).

    The integrity sigmas combine the URA of the message, the atmospheric errors of `Config.nominal` and the scaled range
    noise. The sigmas for accuracy and for thresholds contain the URE instead of the URA. `corrected` has the rejection
    reasons of all stages.
    """
    place = antennas.at_arc(solution.arc_m)
    sight, clocks, channels = _sight(corrected, place)
    stated = support.arrays(corrected.satellite[channels].tolist())
    air = config.nominal.replaced(satellite_sigma_m=0.0).sigma_m(
        corrected.elevation_deg[:, channels], corrected.ionosphere_m[:, channels]
    )
    noise = level_scale(solution.noise_scale, config)[:, None] * corrected.sigma_m[:, channels]
    if config.error_model is not None:
        noise = np.fmax(noise, corrected.bound_sigma_m[:, channels])
    used = (corrected.reason[:, channels] == 0) & np.isfinite(place[:, :1]) & support.holds(corrected.time)[:, None]
    integrity, accuracy = (
        np.where(used, np.sqrt(sigma**2 + air**2 + noise**2), np.nan)
        for sigma in (stated.sigma_ura_m, stated.sigma_ure_m)
    )
    letters = np.array([name[0] for name in corrected.satellite[channels].tolist()], dtype=np.str_)
    named = [letter for letter in stated.constellation_prior if (letters == letter).any()]
    ranges = AraimGeometry(
        design=np.concatenate([-sight, np.broadcast_to(clocks, (len(place), *clocks.shape))], axis=2),
        sigma_int_m=integrity, sigma_acc_m=accuracy,
        bias_m=np.broadcast_to(np.nan_to_num(stated.bias_m), integrity.shape), prior=np.nan_to_num(stated.prior),
        together=np.array([letters == letter for letter in named], dtype=bool).reshape(len(named), len(letters)),
        together_prior=np.array([stated.constellation_prior[letter] for letter in named]),
    )  # fmt: skip
    budget = config.araim
    near = np.nan_to_num(place, nan=1e6)
    axes = antennas.get_axes(np.maximum(solution.fix.constrained.section, 0))
    on_line = with_map(_rotate_geometry(ranges, axes), antennas.sigma_plan_m, antennas.sigma_height_m, budget.map_prior)
    horizontal = budget.phmi_horizontal / 2.0, budget.false_alarm_horizontal / 2.0
    return AraimResult(
        along=araim_levels(on_line, [budget.phmi_along], [budget.false_alarm_along], budget),
        space=araim_levels(
            _rotate_geometry(ranges, enu_axes(*geodetic_from_ecef(near)[:2])),
            [horizontal[0], horizontal[0], budget.phmi_vertical],
            [horizontal[1], horizontal[1], budget.false_alarm_vertical],
            budget,
        ),
    )


def _sight(corrected: CorrectedRanges, place: Floats) -> tuple[Floats, Floats, Masks]:
    """Return unit vectors (T, M, 3), clock columns (M, G) and mask (K,) of the M used channels of a chunk."""
    channels = (corrected.reason == 0).any(axis=0)
    to_satellite = corrected.satellites.position_ecef_m[:, channels] - place[:, None, :]
    distance = np.linalg.norm(to_satellite, axis=2, keepdims=True)
    clock = corrected.channels.clock[channels]
    clocks = np.array([clock == letter for letter in dict.fromkeys(clock.tolist())], dtype=np.float64)
    return to_satellite / distance, clocks.reshape(-1, len(clock)).T, channels


def _rotate_geometry(geometry: AraimGeometry, axes: Floats) -> AraimGeometry:
    """Return the geometry rotated to other position axes: the rows of `axes`, shape (T, 3, 3)."""
    design = geometry.design.copy()
    design[..., :_SPACE] = design[..., :_SPACE] @ axes.swapaxes(1, 2)
    return copy_with(geometry, design=design)


def with_map(geometry: AraimGeometry, plan_m: float, height_m: float, prior: float) -> AraimGeometry:
    """Return the geometry on a line (axes along, across and up), with the map as two additional observations.

    `plan_m` and `height_m` are standard deviations of the map errors [m]; `prior` is the probability of a wrong map.
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
        prior=np.concatenate([geometry.prior, np.zeros(2)]), together=together,
        together_prior=np.append(geometry.together_prior, prior),
    )  # fmt: skip

"""Protection levels along a line over Japan for an hour of MSAS messages: geometry alone, no receiver.

The lines are great circles; every ten seconds each satellite of the navigation file that MSAS corrects (issues of data
matched) gives a range of its own sigma, and the level is that of a train at the point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.geodesy import ecef_from_geodetic, elevation_azimuth, geodetic_from_ecef, range_with_rotation
from railfix.gnss.orbits import satellite_states
from railfix.integrity.protection import protection_level
from railfix.integrity.protection.solution_separation import RangeBounds
from railfix.integrity.raim import linear_model
from railfix.io.rinex import read_navigation
from railfix.pipeline.config import parse_config
from railfix.pipeline.level_stage import get_risk_budget
from railfix.positioning.range_arrays import FILLER_SATELLITE_M, Ranges
from railfix.ranges.channels import clock_groups
from railfix.ranges.range_sigma import CodeNoise, code_sigma_m
from railfix.ranges.sbas import IonosphereState, SatelliteCorrections, SatelliteState, SbasCorrections, read_sbas
from railfix.ranges.sbas.sbas_sources import apply_long_term
from railfix.ranges.sbas.troposphere import rtca_troposphere_sigma_m
from railfix.track import Track
from railfix.track.trajectory import Trajectory

HEIGHT_M: Final = 50.0
GPS: Final = np.array([f"G{number:02d}" for number in range(1, 33)])
MASKS_DEG: Final = (5.0, 15.0, 20.0)
ALARM_LIMITS_M: Final = (10.0, 20.0, 40.0)
#: The messages have to come first: masks, types 7 and 10, grid [s].
WARM_UP_S: Final = 600.0

#: Sigma and largest bias of what multipath and receiver add, by elevation and azimuth from the direction of travel.
Local = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def by_noise(elevation_deg: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Default noise settings at their reference C/N0: 1 m at the zenith by 1/sin(elevation), and a floor of 1 m."""
    sigma = code_sigma_m(np.full(elevation_deg.shape, np.nan), elevation_deg, noise=CodeNoise())
    return sigma, np.zeros(sigma.shape)


@dataclass(frozen=True)
class Sky:
    """What MSAS and navigation file give at T epochs for K satellites, wherever the receiver is."""

    engine: SbasCorrections
    time: np.ndarray
    satellite: np.ndarray
    fixes: SatelliteCorrections
    position_ecef_m: np.ndarray
    good: np.ndarray  # (T, K) corrected


@dataclass(frozen=True)
class Levels:
    """Levels of T epochs at P points; NaN without a position."""

    local: str
    mask_deg: float
    used: np.ndarray  # (P, T)
    dilution: np.ndarray  # (P, T) sigma along the line for ranges of 1 m
    fault_free_m: np.ndarray  # (P, T) K sigma of the whole risk
    level_m: np.ndarray  # (P, T) with local faults
    variance_m2: np.ndarray  # (P, T, 5) of the position: flt, ionosphere, troposphere, local, map


def great_circle(begin: tuple[float, float], end: tuple[float, float], spacing_m: float = 1000.0) -> Trajectory:
    """Level line between two places, chainage rising toward the second."""
    ends = np.array([ecef_from_geodetic(*place, HEIGHT_M) for place in (begin, end)])
    unit = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    angle = np.arccos(unit[0] @ unit[1])
    part = np.linspace(0.0, 1.0, round(angle * 6.371e6 / spacing_m) + 1)[:, None]
    points = (np.sin((1.0 - part) * angle) * unit[0] + np.sin(part * angle) * unit[1]) / np.sin(angle)
    latitude, longitude, _ = geodetic_from_ecef(points * 6.371e6)
    return Trajectory.from_antenna_path(
        Track.from_ecef(ecef_from_geodetic(latitude, longitude, np.full(len(part), HEIGHT_M)))
    )


def sky(data: Path, *, step_s: int = 10) -> Sky:
    """Corrected satellites of the hour."""
    folder = data / "sbas" / "msas_20250215"
    log, navigation = read_sbas(folder / "046r_sbas_prn137.txt"), read_navigation(folder / "046r_rnx.nav")
    engine = SbasCorrections.from_log(log)
    time = log.time[0] + np.arange(0, 3600, step_s) * np.timedelta64(1, "s")
    fixes = engine.satellites(time, GPS, navigation)
    # A range for the time of transmission: its error of a few ms moves a satellite by metres.
    states = satellite_states(
        time, GPS, np.full(len(GPS), "1C"), np.full(fixes.state.shape, 2.3e7), navigation, record=fixes.record
    )
    states, _ = apply_long_term(states, fixes)
    good = (fixes.state == SatelliteState.OK) & ~states.unhealthy & ~states.too_old & ~states.no_record
    return Sky(engine, time, GPS, fixes, states.position_ecef_m, good)


def sigmas_of_sbas(
    above: Sky, place: np.ndarray, elevation: np.ndarray, azimuth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sigma flt, UIRE and of the troposphere at a place, shape (T, K) each (DO-229D J.1)."""
    latitude, longitude, _ = geodetic_from_ecef(place)
    grid = above.engine.ionosphere(above.time, latitude, longitude, elevation, azimuth)
    sight = above.position_ecef_m - place[:, None, :]
    sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    flt = above.fixes.sigma_flt_m(above.engine.delta_udre(above.time, above.fixes, sight, latitude, longitude))
    uire = np.where(grid.state == IonosphereState.OK, grid.sigma_uire_m, np.nan)
    return flt, uire, rtca_troposphere_sigma_m(elevation)


def ranges_at(above: Sky, place: np.ndarray, sigma: np.ndarray, used: np.ndarray) -> Ranges:
    """The ranges as geometry has them."""
    satellites = np.where(used[..., None], above.position_ecef_m, FILLER_SATELLITE_M)
    return Ranges(
        sat_ecef_m=satellites,
        code_m=np.where(used, range_with_rotation(satellites, place[:, None, :])[0], 0.0),
        weight=np.where(used, 1.0 / np.where(used, sigma, 1.0) ** 2, 0.0),
        groups=clock_groups([name[0] for name in above.satellite.tolist()]),
    )


def levels(
    above: Sky, line: Trajectory, local: dict[str, Local], masks_deg: tuple[float, ...] = MASKS_DEG
) -> list[Levels]:
    """Levels at the points of a line, one point after the other."""
    found: dict[tuple[str, float], list[tuple[np.ndarray, ...]]] = {}
    for point, arc in enumerate(line.arc_m):
        section = min(point, len(line.length_m) - 1)
        place = np.broadcast_to(line.ecef_m[point], (len(above.time), 3))
        elevation, azimuth = elevation_azimuth(above.position_ecef_m, place)
        of_sbas = sigmas_of_sbas(above, place, elevation, azimuth)
        turned = azimuth - line.body_azimuth_deg(np.array([arc]))[0]
        for name, of_local in local.items():
            own, bias = of_local(elevation, turned)
            sigmas = np.stack([*of_sbas, own], axis=-1)
            for mask in masks_deg:
                used = above.good & (elevation >= mask) & np.isfinite(sigmas).all(axis=-1)
                at_point = _at_point(above, line, (place, float(arc), section), used, sigmas, bias)
                found.setdefault((name, mask), []).append(at_point)
    return [Levels(*key, *(np.stack(part) for part in zip(*parts, strict=True))) for key, parts in found.items()]


def _at_point(
    above: Sky,
    line: Trajectory,
    where: tuple[np.ndarray, float, int],
    used: np.ndarray,
    sigmas: np.ndarray,
    bias: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Satellites used, dilution, levels and parts of the variance at one point, T epochs."""
    place, arc, section = where
    risk = get_risk_budget(parse_config({"sbas": ["messages"]}))
    enough = used.sum(axis=1) >= 3
    ranges = ranges_at(above, place, np.sqrt((sigmas**2).sum(axis=-1)), used)
    model = linear_model(ranges, line, np.where(enough, arc, np.nan), section=np.full(len(used), section))
    systems = [name[0] for name in above.satellite.tolist()]
    level = protection_level(model, systems, risk=risk, overbound=RangeBounds(bias_m=np.where(used, bias, 0.0)))
    gain = np.einsum("tkj,tj->tk", model.design, model.covariance_m2[:, 0]) * model.root_weight
    parts = (gain[..., None] ** 2 * np.where(used[..., None], sigmas, 0.0) ** 2).sum(axis=1)
    rest = model.covariance_m2[:, 0, 0] - parts.sum(axis=1)
    return (
        used.sum(axis=1),
        np.sqrt((gain**2).sum(axis=1)),
        risk.sample_k * np.sqrt(model.position_covariance_m2(np.ones(len(model)))[:, 0, 0]),
        level.level_m,
        np.concatenate([parts, rest[:, None]], axis=1),
    )


# ---- tables -----------------------------------------------------------------------------------------------


def warm(above: Sky) -> np.ndarray:
    """Epochs after the first ten minutes."""
    return above.time >= above.time[0] + np.timedelta64(int(WARM_UP_S), "s")

"""Results of antennas: every intermediate value side by side, coordinates where the status allows them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from railfix.core.arrays import Floats, Masks, read_only
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.reasons import CHECK_FAILED, POSITIONED, Status
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.pipeline.level_stage import judged
from railfix.pipeline.results import AntennaResult
from railfix.pipeline.solution import Solution, reason_of_all_channels, satellites_rejected
from railfix.positioning.antenna_rows import AntennaRows
from railfix.track.track import interpolate_kilometrage
from railfix.track.trajectory import Trajectory


@lru_cache
def with_coordinates(failed_checks: str) -> Masks:
    """Return which statuses come with coordinates, by the number of the status; of `Config.failed_checks`."""
    dropped = CHECK_FAILED if failed_checks == "drop" else ()
    return read_only(np.array([status in POSITIONED and status not in dropped for status in sorted(Status)]))


def antenna_results(
    corrected: CorrectedRanges, antennas: AntennaRows, solution: Solution, config: Config
) -> AntennaResult:
    """Return the result of one antenna, or of the rows of several."""
    obs, point, constrained = corrected.observations, solution.point, solution.place.constrained
    has = with_coordinates(config.failed_checks)[solution.status]
    arc = np.where(has, solution.arc_m, np.nan)
    ecef, chainage, kilometrage = antennas.each(lambda index, rows: _places(index.trajectory, arc[rows]))
    latitude, longitude, height = geodetic_from_ecef(ecef)
    nearest, offset, beside = antennas.each(lambda index, rows: _nearest(index.trajectory, point.ecef_m[rows]))
    reason = reason_of_all_channels(corrected)
    protection = solution.protection

    def on_all_channels(values: Floats) -> Floats:
        full = np.full(obs.code_m.shape, np.nan)
        full[:, corrected.columns] = values
        return full

    return AntennaResult(
        time=obs.time,
        satellite=obs.satellite,
        signal=obs.signal,
        status=solution.status,
        chainage_m=chainage,
        kilometrage_m=kilometrage,
        arc_m=arc,
        along_sigma_m=np.where(has, solution.along_sigma_m, np.nan),
        own_sigma_m=solution.own_sigma_m,
        noise_scale=solution.noise_scale,
        ecef_m=ecef,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        n_used=np.count_nonzero(corrected.reason == 0, axis=1),
        n_rejected=satellites_rejected(corrected.channels.member, reason),
        conventional_status=solution.point_status,
        conventional_ecef_m=point.ecef_m,
        conventional_arc_m=nearest,
        conventional_chainage_m=beside,
        conventional_offset_m=offset,
        reason=reason,
        elevation_deg=on_all_channels(corrected.elevation_deg),
        azimuth_deg=on_all_channels(corrected.azimuth_deg),
        cn0_dbhz=obs.cn0_dbhz,
        sigma_m=on_all_channels(corrected.sigma_m),
        bound_sigma_m=on_all_channels(corrected.bound_sigma_m),
        corrected_code_m=on_all_channels(corrected.corrected_code_m),
        residual_m=on_all_channels(np.where(corrected.reason == 0, constrained.residual_m, np.nan)),
        satellites=corrected.satellites,
        columns=corrected.columns,
        second=corrected.second,
        combined=corrected.combined,
        screens=corrected.screens,
        single_point=point,
        section=solution.place.section,
        constrained=constrained,
        phase=solution.phase,
        raim=replace(solution.raim, protection_level_m=np.where(has, solution.raim.protection_level_m, np.nan)),
        protection=None if protection is None else judged(protection, solution.status, has, chainage, config),
        map_offset=solution.map_offset,
        interference=solution.interference,
        araim=solution.araim,
        clocks=corrected.clocks,
        clock_offset_m=solution.ties.offset_m,
        clock_offset_sigma_m=solution.ties.sigma_m,
    )


def _places(line: Trajectory, arc_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return points (T, 3), chainages and kilometrage (T,) of a line at arc lengths [m]."""
    chainage = line.chainage_at(arc_m)
    return line.at_arc(arc_m), chainage, interpolate_kilometrage(chainage, line.chainage_m, line.kilometrage_m)


def _nearest(line: Trajectory, ecef_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return arc length and distance of the nearest point of a line, and its chainage, shape (T,) each [m]."""
    arc, offset = line.nearest(ecef_m)
    return arc, offset, line.chainage_at(arc)

"""Positions of a log by codes alone, Hatch-smoothed codes and float ambiguities; slips put into a log."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from level_cases import Case
from phase_run import phase_run
from railfix.core.geodesy import geodetic_from_ecef
from railfix.evaluate import along_track_error
from railfix.pipeline.results import AntennaResult
from railfix.positioning.carrier import (
    PhasePositions,
    Phases,
    Slips,
    TrackedPhases,
    TrackJumps,
    corrected_phase_m,
    find_slips,
    number_arcs,
    phase_positions,
    smooth_codes,
    track_jumps,
)
from railfix.positioning.normal_equations import position_on_line
from railfix.positioning.range_arrays import UNTIED_M, Ranges
from railfix.ranges.atmosphere import saastamoinen_delay_m
from railfix.ranges.channels import clock_groups
from railfix.track.trajectory import Trajectory

#: Phase noise at the zenith [m]: tracking, multipath, delays that the models miss.
PHASE_SIGMA_M = 0.01


@dataclass(frozen=True)
class Carried:
    """One log positioned in all forms."""

    case: Case
    result: AntennaResult
    slips: Slips
    jumps: TrackJumps
    smoothed: np.ndarray
    code_ranges: Ranges
    hatch_arc_m: np.ndarray
    live: PhasePositions
    whole: PhasePositions

    def errors(self) -> dict[str, np.ndarray]:
        """Signed errors along the line of each form [m]."""
        found = {
            "code": self.result.arc_m,
            "hatch": self.hatch_arc_m,
            "live": self.live.arc_m,
            "runs": self.whole.arc_m,
        }
        return {
            name: along_track_error(arc, self.case.reference_ecef_m, self.case.trajectory)
            for name, arc in found.items()
        }


def ranges_of(result: AntennaResult, code_m: np.ndarray, weight: np.ndarray) -> Ranges:
    """Ranges as the pipeline fitted them."""
    columns = result.columns
    reason = result.reason[:, columns]
    used = (reason == 0) & np.isfinite(code_m) & np.isfinite(weight)
    ties = result.ties
    groups = clock_groups(result.satellite[columns].astype("<U1"))
    return Ranges(
        sat_ecef_m=np.where(used[..., None], result.corrected.satellites.position_ecef_m, (2.6e7, 0.0, 0.0)),
        code_m=np.where(used, code_m, 0.0),
        weight=np.where(used, weight, 0.0),
        groups=groups,
        ties=ties if len(groups) > 1 and np.any(ties.sigma_m < UNTIED_M) else None,
    )


def delays(case: Case, result: AntennaResult) -> tuple[np.ndarray, np.ndarray]:
    """Ionosphere and troposphere of the channels in `result.columns`, from what the pipeline took off the codes."""
    columns = result.columns
    total = case.observations.code_m[:, columns] - result.corrected_code_m[:, columns]
    total = total + result.corrected.satellites.clock_m - result.corrected.satellites.group_delay_m
    latitude, _, height = geodetic_from_ecef(case.trajectory.ecef_m.mean(axis=0))
    elevation = result.elevation_deg[:, columns]
    shape = len(elevation)
    troposphere = saastamoinen_delay_m(np.full(shape, latitude), np.full(shape, height), elevation)
    return total - troposphere, troposphere


def solved_on_line(ranges: Ranges, case: Case, result: AntennaResult) -> np.ndarray:
    """Constrained positions of other codes, from the pipeline's sections; its epochs only."""
    vertex = np.where(np.isfinite(result.arc_m), result.fix.section.vertex, -1)
    return position_on_line(ranges, case.trajectory, vertex).arc_m


def on_track(case: Case, result: AntennaResult, slips: Slips, used: np.ndarray) -> tuple[np.ndarray, TrackJumps]:
    """Corrected phases of the used channels, and their jumps against the line."""
    obs, columns = case.observations, result.columns
    ionosphere, troposphere = delays(case, result)
    phase = corrected_phase_m(slips.phase_m[:, columns], result.corrected.satellites.clock_m, ionosphere, troposphere)
    phase = np.where(used, phase, np.nan)
    jumps, _ = track_jumps(
        obs.time, obs.satellite[columns], obs.signal[columns],
        TrackedPhases(phase, result.corrected.satellites.position_ecef_m, slips.slip[:, columns]), case.trajectory,
        result.arc_m,
    )  # fmt: skip
    return phase, jumps


def carried(case: Case) -> Carried:
    """All forms on one log, as a pipeline would call them."""
    obs = case.observations
    result = case.solved()
    columns = result.columns
    names = obs.satellite[columns], obs.signal[columns]
    slips, _ = find_slips(obs)
    smoothed, _ = smooth_codes(obs.time, obs.satellite, obs.signal, obs.code_m, slips.phase_m, slips.slip)
    weight = 1.0 / result.sigma_m[:, columns] ** 2
    code_ranges = ranges_of(result, result.corrected_code_m[:, columns], weight)
    corrected = result.corrected_code_m[:, columns] + (smoothed - obs.code_m)[:, columns]
    # The weights stay: what the floor and multipath leave is not averaged as white noise is.
    hatch = ranges_of(result, corrected, weight)

    phase, jumps = on_track(case, result, slips, code_ranges.weight > 0)
    has = np.isfinite(slips.phase_m[:, columns])
    arcs, _ = number_arcs(slips.slip[:, columns] | jumps.jump, has, *names)
    sine = np.sin(np.radians(np.maximum(result.elevation_deg[:, columns], 5.0)))
    phases = Phases(
        phase_m=np.where(np.isfinite(phase), phase, 0.0),
        weight=np.where(np.isfinite(phase), (sine / PHASE_SIGMA_M) ** 2, 0.0),
        arc_id=arcs,
    )
    live, _ = phase_positions(obs.time, code_ranges, phases, case.trajectory, result.arc_m)
    return Carried(
        case=case,
        result=result,
        slips=slips,
        jumps=jumps,
        smoothed=smoothed,
        code_ranges=code_ranges,
        hatch_arc_m=solved_on_line(hatch, case, result),
        live=live,
        whole=in_runs(obs.time, code_ranges, phases, case.trajectory, result.arc_m),
    )


def in_runs(
    time: np.ndarray, ranges: Ranges, phases: Phases, trajectory: Trajectory, arc_m: np.ndarray, run_s: int = 120
) -> PhasePositions:
    """`phase_run` of runs cut at absolute times; only positions and sigmas are joined."""
    number = time.astype("datetime64[s]").astype(np.int64) // run_s
    pieces = []
    for one in np.unique(number):
        rows = np.flatnonzero(number == one)
        pieces.append(phase_run(time[rows], ranges.take(rows), phases.take(rows), trajectory, arc_m[rows]))
    joined = {n: np.concatenate([getattr(p, n) for p in pieces]) for n in ("arc_m", "sigma_m", "noise_sigma_m")}
    return replace(pieces[-1], **joined)


@dataclass(frozen=True)
class Detection:
    """Slips put into a log: how many were found by the first test, by either, and what was flagged without any."""

    by_receiver_tests: float
    by_either: float


def joined(found: Carried) -> np.ndarray:
    """Used phases that nothing ended, shape (T, K)."""
    columns = found.result.columns
    has = (found.code_ranges.weight > 0) & np.isfinite(found.slips.phase_m[:, columns])
    fine = has & ~found.slips.slip[:, columns] & ~found.jumps.jump
    fine[1:] &= has[:-1]
    fine[0] = False
    return fine


def detections(found: Carried, sizes: tuple[int, ...] = (1, 2, 10, 1000), *, count: int = 150) -> list[Detection]:
    """Single slips injected into joined phases at random, at most one an epoch and some epochs apart."""
    case, result = found.case, found.result
    rng = np.random.default_rng(7)
    rows, channels = np.nonzero(joined(found))
    chosen = []
    for k in rng.permutation(len(rows)):
        if all(abs(rows[k] - rows[j]) > 1 for j in chosen):
            chosen.append(k)
        if len(chosen) == count:
            break
    at, channel = rows[chosen], channels[chosen]
    outcome = []
    for size in sizes:
        phase = case.observations.phase_cycles.copy()
        for t, m in zip(at, result.columns[channel], strict=True):
            phase[t:, m] += size * rng.choice([-1, 1])
        slipped = replace(case, observations=replace(case.observations, phase_cycles=phase))
        slips, _ = find_slips(slipped.observations)
        _, jumps = on_track(slipped, result, slips, found.code_ranges.weight > 0)
        first = slips.slip[:, result.columns][at, channel]
        either = first | jumps.jump[at, channel]
        outcome.append(Detection(float(first.mean()), float(either.mean())))
    return outcome

"""What carrier phase buys: codes alone, Hatch-smoothed codes, float ambiguities; one setting for all.

Run ``python tests/studies/carrier_score.py`` (or with a part of a log's name); ``python tests/studies/carrier_score.py
slips`` measures the detection of slips put into the logs. Recordings are taken where they are beside the checkout.
"""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl

import paths
import recordings_score
import recordings_truth
from phase_run import phase_run
from pipeline_cases import clean_files
from railfix.core.geodesy import geodetic_from_ecef
from railfix.evaluate import along_track_error, interpolate_reference, score
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.results import AntennaResult
from railfix.positioning.carrier import (
    PhaseLimits,
    PhasePositions,
    Phases,
    SlipReason,
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
from railfix.run.processor_setup import make_processor
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle

SETTINGS = parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}})
#: Phase noise at the zenith [m]: tracking, multipath, delays that the models miss.
PHASE_SIGMA_M = 0.01


@dataclass(frozen=True)
class Case:
    """One log with its reference."""

    name: str
    observations: Observations
    navigation: Navigation
    trajectory: Trajectory
    reference_ecef_m: np.ndarray
    config: Config = SETTINGS


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
    live_s: float

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


def carried(case: Case, *, limits: PhaseLimits | None = None) -> Carried:
    """All forms on one log, as a pipeline would call them."""
    obs = case.observations
    processor = make_processor(case.config, case.navigation, {"front": case.trajectory})
    result = processor.process({"front": obs})[0].antennas["front"]
    columns = result.columns
    names = obs.satellite[columns], obs.signal[columns]
    slips, _ = find_slips(obs)
    smoothed, _ = smooth_codes(obs.time, obs.satellite, obs.signal, obs.code_m, slips.phase_m, slips.slip)
    weight = 1.0 / result.sigma_m[:, columns] ** 2
    code_ranges = ranges_of(result, result.corrected_code_m[:, columns], weight)
    corrected = result.corrected_code_m[:, columns] + (smoothed - obs.code_m)[:, columns]
    # The weights stay: what the floor and multipath leave is not averaged as white noise is.
    hatch = ranges_of(result, corrected, weight)

    begin = clock.perf_counter()
    phase, jumps = on_track(case, result, slips, code_ranges.weight > 0)
    has = np.isfinite(slips.phase_m[:, columns])
    arcs, _ = number_arcs(slips.slip[:, columns] | jumps.jump, has, *names)
    sine = np.sin(np.radians(np.maximum(result.elevation_deg[:, columns], 5.0)))
    phases = Phases(
        phase_m=np.where(np.isfinite(phase), phase, 0.0),
        weight=np.where(np.isfinite(phase), (sine / PHASE_SIGMA_M) ** 2, 0.0),
        arc_id=arcs,
    )
    live, _ = phase_positions(obs.time, code_ranges, phases, case.trajectory, result.arc_m, limits=limits)
    took = clock.perf_counter() - begin
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
        live_s=took,
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


def clean() -> list[Case]:
    files = clean_files()
    track, vehicle = read_track(files["track"]), read_vehicle(files["vehicle"])
    truth = pl.read_csv(files["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
    cases = []
    for name in ("front", "rear"):
        rows = truth.filter(pl.col("antenna") == name)
        cases.append(
            Case(
                f"clean run {name}",
                read_observations(files[name]),
                read_navigation(files["nav"]),
                antenna_trajectory(track, vehicle, name),
                rows.select("x_m", "y_m", "z_m").to_numpy(),
            )
        )
    return cases


def recorded(name: str, observations: Path, navigation: Path, truth: tuple[np.ndarray, np.ndarray]) -> Case:
    obs = read_observations(observations)
    reference = interpolate_reference(obs.time, *truth)
    return Case(name, obs, read_navigation([navigation]), recordings_score.trajectory_of(*truth), reference)


def geonet(data: Path, station: str, azimuth_deg: float) -> Case:
    folder = data / "static" / "rtklib_geonet2005"
    obs = read_observations(folder / f"{station}0920.05o")
    place = obs.header.approximate_ecef_m
    line = recordings_score.straight_line(place, azimuth_deg)
    reference = np.broadcast_to(place, (len(obs), 3))
    return Case(
        f"geonet {station} {azimuth_deg:.0f}", obs, read_navigation([folder / f"{station}0920.05n"]), line, reference
    )


def recordings(data: Path) -> list[Case]:
    urban, phone = data / "kinematic" / "urbannav_tst", data / "kinematic" / "gsdc_pixel5_a"
    japan = data / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    town = recordings_truth.urbannav_truth(urban)
    log = "20210517.light-urban.tste.ublox"
    cases = [
        recorded("japan_mosaic", japan / "SEPT265G.21O", japan / "SEPT2650.21P", recordings_truth.japan_truth(japan)),
        recorded("urbannav F9P", urban / f"{log}.f9p.obs", urban / "hksc137c.nav", town),
        recorded("urbannav M8T", urban / f"{log}.m8t.GC.obs", urban / "hksc137c.nav", town),
        recorded("gsdc_pixel5_a", phone / "Pixel5_a.21o", phone / "hour1180.21n", recordings_truth.gsdc_truth(phone)),
    ]
    return cases + [geonet(data, s, a) for s in ("0759", "3040") for a in (0.0, 45.0, 90.0, 135.0)]


def scaled(found: PhasePositions, noise_scale: np.ndarray) -> np.ndarray:
    """Sigma along the line with the receiver's noise scale."""
    noise = found.noise_sigma_m
    return np.sqrt((noise_scale * noise) ** 2 + (found.sigma_m**2 - noise**2))


def slip_line(found: Carried) -> str:
    """What ended arcs, of all phases used."""
    columns = found.result.columns
    used = found.code_ranges.weight > 0
    has = used & np.isfinite(found.slips.phase_m[:, columns])
    reason = found.slips.reason[:, columns]
    counts = {
        bit.name.lower(): int(np.count_nonzero(has & ((reason & bit) > 0))) for bit in SlipReason if bit.value > 1
    }
    counts["on track"] = int(np.count_nonzero(found.jumps.jump))
    text = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    return f"    phases at {100 * has.sum() / max(used.sum(), 1):.0f} % of the codes; restarted: {text}"


@dataclass(frozen=True)
class Detection:
    """Slips put into a log: how many were found by the first test, by either, and what was flagged without any."""

    cycles: int
    injected: int
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
        outcome.append(Detection(size, len(at), float(first.mean()), float(either.mean())))
    return outcome


def slip_table(cases: list[Case]) -> None:
    """Detection rates of injected slips, and what the tests flag on the logs as they are."""
    print(
        f"{'log':18s} {'judged':>7s} {'flagged %':>9s} {'on track %':>10s}  found % of slips by 1, 2, 10, 1000 cycles"
    )
    for case in cases:
        found = carried(case)
        columns = found.result.columns
        has = (found.code_ranges.weight > 0) & np.isfinite(found.slips.phase_m[:, columns])
        reason = found.slips.reason[:, columns]
        tests = int(SlipReason.DOPPLER | SlipReason.CODE)
        judged = has & ((reason & ~tests) == 0)
        flagged, jumped = judged & (reason != 0), judged & found.jumps.jump
        rates = " ".join(f"{100 * d.by_receiver_tests:4.0f}/{100 * d.by_either:<4.0f}" for d in detections(found))
        total = max(int(judged.sum()), 1)
        print(
            f"{case.name:18s} {total:7d} {100 * flagged.sum() / total:9.3f} {100 * jumped.sum() / total:10.3f}  {rates}"
        )


def main(only: Callable[[str], bool] = lambda _: True) -> int:
    data = paths.DATA
    cases = clean() + (recordings(data) if data.is_dir() else [])
    if sys.argv[1:2] == ["slips"]:
        slip_table([c for c in cases if c.name.startswith(("clean run front", "japan", "urban", "gsdc"))])
        return 0
    names = ("n", "mean m", "std m", "p50 m", "p95 m", "max m")
    print(f"{'log':18s} {'form':6s} {names[0]:>5s} " + " ".join(f"{n:>7s}" for n in names[1:]) + "  error/sigma")
    for case in cases:
        if not only(case.name):
            continue
        found = carried(case)
        errors = found.errors()
        both = np.all([np.isfinite(e) for e in errors.values()], axis=0)
        sigmas = {"code": found.result.along_sigma_m}
        sigmas |= {n: scaled(p, found.result.noise_scale) for n, p in (("live", found.live), ("runs", found.whole))}
        for name, error in errors.items():
            s = score(error, both)
            ratio = np.sqrt(np.mean((error[both] / sigmas[name][both]) ** 2)) if name in sigmas else np.nan
            print(
                f"{case.name:18s} {name:6s} {s.positions:5d} {s.mean_m:7.2f} {s.std_m:7.3f} {s.p50_m:7.3f} "
                f"{s.p95_m:7.3f} {s.max_m:7.2f}  {ratio:6.2f}"
            )
        print(slip_line(found) + f"; live form {1e6 * found.live_s / len(case.observations):.0f} us an epoch")
    return 0


if __name__ == "__main__":
    sys.exit(main(lambda name: not sys.argv[1:] or any(word in name for word in sys.argv[1:])))

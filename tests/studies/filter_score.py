"""Scores of the filter along the track on the real recordings: ``python tests/studies/filter_score.py [TABLE ...]``.

Tables: ``figures`` (single epochs beside, and smoothed), ``ablation`` (without each kind of measurement), ``gaps``
(windows without satellites, with and without a wheel); levels: `belief_campaign`. One setting for all recordings;
distances are straight ones on the map.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np

import paths
import recordings_score
import recordings_truth
from railfix.core.constants import CLOCK_GROUP
from railfix.core.timescale import seconds
from railfix.evaluate import interpolate_reference, straight_distance
from railfix.pipeline import along_track
from railfix.pipeline.config import parse_config
from railfix.pipeline.smoothed_track import Replay, SmoothedTrack, smooth
from railfix.ranges.range_sigma import code_sigma_m
from railfix.track.trajectory import Trajectory
from railfix.tracking import GnssEpochs, Line, SensorEpochs, Tracked, TrackingLimits, track

CONFIG = parse_config({"filter": "track"})
#: Noise of the smartLoc receiver's codes against the weights, as a variance (docs/recordings: about 8).
SMARTLOC_SCALE = float(np.sqrt(8.0))


@dataclass(frozen=True)
class Case:
    """One recording as measurements of the filter."""

    name: str
    epochs: GnssEpochs
    trajectory: Trajectory
    reference: np.ndarray
    observed: np.ndarray
    single_arc_m: np.ndarray
    wheel: SensorEpochs | None = None

    def run(self, epochs: GnssEpochs | None = None, **changes: object) -> Tracked:
        sensors = changes.pop("sensors", None)
        assert sensors is None or isinstance(sensors, SensorEpochs)
        limits = TrackingLimits.model_validate(changes)
        return track(
            self.epochs if epochs is None else epochs,
            Line(self.trajectory),
            limits=limits,
            sensors=sensors,
        )[0]

    def smoothed(self, sensors: SensorEpochs | None = None) -> SmoothedTrack:
        """Places from both directions."""
        limits = TrackingLimits()
        replay = Replay(epochs=self.epochs, sensors=sensors or SensorEpochs(), before=None)
        return smooth([replay], Line(self.trajectory), limits)

    def part(self, first: int, end: int) -> Case:
        """Some epochs of it."""
        rows = slice(first, end)
        return replace(
            self,
            epochs=self.epochs.take(rows),
            reference=self.reference[rows],
            observed=self.observed[rows],
            single_arc_m=self.single_arc_m[rows],
        )

    def error(self, found: Tracked | SmoothedTrack) -> np.ndarray:
        arc = along_track.on_line_m(found, self.trajectory)
        return straight_distance(arc, self.reference, self.trajectory)


def rinex_case(name: str, run: Callable[..., recordings_score.Outcome], data: Path) -> Case:
    kept: list[GnssEpochs] = []
    tracked = along_track._run_filter

    def keeping(epochs: GnssEpochs, *args: object) -> object:
        kept.append(epochs)
        return tracked(epochs, *args)  # type: ignore[arg-type]

    with mock.patch.object(along_track, "_run_filter", keeping):
        outcome = run(data, CONFIG)
    assert outcome.result is not None
    reading = {"m8t": "urbannav", "f9p": "urbannav", "pixel": "gsdc", "japan": "japan"}[name]
    reference = interpolate_reference(outcome.result.time, *recordings_truth.TRUTHS[reading](data))
    observed = np.isfinite(reference[:, 0]) & np.any((outcome.result.reason & 1) == 0, axis=1)
    return Case(name, kept[0], outcome.trajectory, reference, observed, outcome.result.arc_m)


def smartloc_case(data: Path) -> Case:
    """Codes and odometry alone: the recording has neither Dopplers nor phases."""
    folder = data / "kinematic" / "smartloc_berlin"
    log = recordings_score.smartloc_ranges(folder)
    truth = recordings_truth.smartloc_truth(folder)
    trajectory = recordings_score.trajectory_of(*truth)
    single = recordings_score.smartloc(data, CONFIG)
    sigma = SMARTLOC_SCALE * code_sigma_m(log.cn0_dbhz, log.elevation_deg, noise=CONFIG.noise)
    nothing = np.full(log.code_m.shape, np.nan)
    epochs = GnssEpochs(
        time=log.time,
        satellite=log.satellite,
        signal=np.full(len(log.satellite), "1C"),
        clock=np.array([CLOCK_GROUP[str(s)[0]] for s in log.satellite]),
        sat_ecef_m=log.sat_ecef_m,
        sat_velocity_mps=np.zeros_like(log.sat_ecef_m),
        code_m=np.where(log.elevation_deg >= 15.0, log.code_m, np.nan),
        code_sigma_m=sigma,
        phase_m=nothing,
        phase_joined=np.zeros(nothing.shape, dtype=bool),
        rate_mps=nothing,
        cn0_dbhz=log.cn0_dbhz,
        off_map=np.zeros(len(log.time), dtype=bool),
    )
    lines = (folder / "Berlin_Potsdamer_Platz_Input.txt").read_text(encoding="ascii").splitlines()
    odometry = np.array([[float(x) for x in line.split()[1:3]] for line in lines if line.startswith("odom3")])
    t = seconds(log.time - recordings_truth.SMARTLOC_START)
    way = np.concatenate([[0.0], np.cumsum(np.diff(odometry[:, 0]) * 0.5 * (odometry[1:, 1] + odometry[:-1, 1]))])
    step = np.diff(np.interp(t, odometry[:, 0], way), prepend=np.nan)
    wheel = SensorEpochs(wheel_m=step, wheel_sigma_m=np.full(len(t), 0.03))
    reference = interpolate_reference(log.time, *truth)
    observed = np.isfinite(reference[:, 0]) & np.isfinite(log.code_m).any(axis=1)
    arc = np.full(len(t), np.nan)
    case = Case("smartloc", epochs, trajectory, reference, observed, arc, wheel)
    print(f"smartloc single epochs: p50 {single.constrained.p50_m:.2f}, p95 {single.constrained.p95_m:.2f} m")
    return case


def cases(data: Path) -> Iterator[Case]:
    for name, run in (
        ("m8t", recordings_score.urbannav_m8t),
        ("f9p", recordings_score.urbannav_f9p),
        ("pixel", recordings_score.gsdc),
        ("japan", recordings_score.japan),
    ):
        yield rinex_case(name, run, data)


def figures_of(error: np.ndarray) -> str:
    known = np.isfinite(error)
    return (
        f"rate {100 * known.mean():6.2f} %  p50 {np.nanmedian(error):5.2f}  p95 {np.nanpercentile(error, 95):6.2f}  "
        f"max {np.nanmax(error):6.1f}  over 50 m {np.count_nonzero(error > 50.0)}"
    )


def ratio_of(case: Case, found: Tracked | SmoothedTrack) -> str:
    """95th percentile of error over sigma, and its 95 % interval by drawing blocks of 60 s with replacement."""
    ratio = case.error(found) / found.sigma_m
    known = case.observed & np.isfinite(ratio)
    block = seconds(case.epochs.time - case.epochs.time[0])[known] // 60.0
    blocks = [ratio[known][block == k] for k in np.unique(block)]
    random = np.random.default_rng(0)
    drawn = [
        np.percentile(np.concatenate([blocks[k] for k in random.integers(0, len(blocks), len(blocks))]), 95)
        for _ in range(1000)
    ]
    low, high = np.percentile(drawn, [2.5, 97.5])
    p95 = np.percentile(ratio[known], 95)
    return f"error/sigma p95 {p95:4.1f} ({low:.1f} to {high:.1f}, {len(blocks)} blocks)"


def show_figures(all_cases: list[Case]) -> None:
    for case in all_cases:
        if np.isfinite(case.single_arc_m).any():
            error = straight_distance(case.single_arc_m, case.reference, case.trajectory)
            print(f"{case.name:9s} single epochs  {figures_of(error[case.observed])}")
        for label, sensors in (("filter", None), ("with wheel", case.wheel)):
            if label == "filter" or sensors is not None:
                found = case.run(sensors=sensors)
                error = case.error(found)[case.observed]
                print(f"{case.name:9s} {label:13s}  {figures_of(error)}  {ratio_of(case, found)}")
                both = case.smoothed(sensors)
                text = figures_of(case.error(both)[case.observed])
                print(f"{case.name:9s} {'  smoothed':13s}  {text}  {ratio_of(case, both)}", flush=True)


def show_ablation(all_cases: list[Case]) -> None:
    for case in all_cases:
        nothing = np.full(case.epochs.code_m.shape, np.nan)
        variants = {
            "all": case.epochs,
            "without phases": replace(case.epochs, phase_m=nothing),
            "without Dopplers": replace(case.epochs, rate_mps=nothing),
            "codes alone": replace(case.epochs, phase_m=nothing, rate_mps=nothing),
        }
        for label, epochs in variants.items():
            found = case.run(epochs)
            error = case.error(found)[case.observed]
            print(f"{case.name:9s} {label:17s}  {figures_of(error)}  {ratio_of(case, found)}")
        found = case.run(degrees_of_freedom=1e6, late_degrees_of_freedom=1e6)
        error = case.error(found)[case.observed]
        print(f"{case.name:9s} {'not robust':17s}  {figures_of(error)}  {ratio_of(case, found)}")


def show_gaps(all_cases: list[Case]) -> None:
    """Windows without satellites every 100 s, 60 s after a cold start; a wheel 1 % off by the reference."""
    for case in all_cases:
        t = seconds(case.epochs.time - case.epochs.time[0])
        for length in (30.0, 60.0):
            leaving: dict[str, list[float]] = {"no sensor": [], "wheel": []}
            ratio: dict[str, list[float]] = {"no sensor": [], "wheel": []}
            for begin in np.arange(100.0, t[-1] - length - 30.0, 100.0):
                first, start, end = (int(k) for k in np.searchsorted(t, [begin - 60.0, begin, begin + length]))
                piece = case.part(first, end)
                gap = np.arange(first, end) >= start
                if not piece.observed.all() or not gap.any():
                    continue
                blank = {
                    name: np.where(gap[:, None], np.nan, getattr(piece.epochs, name))
                    for name in ("code_m", "phase_m", "rate_mps")
                }
                way = 0.99 * np.linalg.norm(np.diff(piece.reference, axis=0, prepend=np.nan), axis=1)
                wheel = SensorEpochs(wheel_m=way, wheel_sigma_m=np.full(len(way), 0.05), wheel_sign="unknown")
                for label, sensors in (("no sensor", None), ("wheel", wheel)):
                    found = piece.run(replace(piece.epochs, **blank), sensors=sensors)
                    leaving[label].append(float(piece.error(found)[-1]))
                    ratio[label].append(leaving[label][-1] / float(found.sigma_m[-1]))
            for label, errors in leaving.items():
                known = np.isfinite(errors)
                if known.any():
                    print(
                        f"{case.name:9s} {length:3.0f} s {label:10s} {len(errors)} windows, {known.sum()} placed: "
                        f"p50 {np.nanmedian(errors):5.1f}  p95 {np.nanpercentile(errors, 95):5.1f} m  "
                        f"error/sigma p95 {np.nanpercentile(ratio[label], 95):4.1f}",
                        flush=True,
                    )


TABLES = {
    "figures": show_figures,
    "ablation": show_ablation,
    "gaps": show_gaps,
}


def main() -> int:
    data = paths.DATA
    if not data.is_dir():
        print(f"the real recordings are not at {data}", file=sys.stderr)
        return 1
    listed = list(cases(data))
    for name in sys.argv[1:] or TABLES:
        print(f"\n{name}")
        TABLES[name](listed if name in ("ablation", "gaps") else [*listed, smartloc_case(data)])
    return 0


if __name__ == "__main__":
    sys.exit(main())

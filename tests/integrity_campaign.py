"""Protection levels on simulated commercial lines: is any epoch misled, and how often is the level of use?

``python tests/integrity_campaign.py FOLDER [--runs 48] [--jobs 2]`` simulates runs over lines, places and skies
that all differ (the shipped scenario ``p1-commercial`` under other seeds), half of which make an error model
that the other half is judged by, and the other way round. Each run is kept in FOLDER, so that a broken
campaign goes on where it was. ``--summary`` prints the tables of what is there; ``--model FILE`` judges the same
runs by a model of another generator, such as one of the recordings (``tests/integrity_recordings.py`` writes them).
"""

from __future__ import annotations

import argparse
import os
import time as clock
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from railfix.core.reasons import Status
from railfix.core.settings import write_toml
from railfix.evaluate.range_errors import range_errors
from railfix.evaluate.range_errors.gather import joined
from railfix.integrity.protection import Cause, LevelStatus
from railfix.integrity.stanford import Region, stanford
from railfix.io.reference_log import AntennaReference
from railfix.pipeline.config import parse_config
from railfix.pipeline.results import AntennaResult, State
from railfix.ranges.error_model import (
    ErrorBins,
    ErrorModel,
    ErrorModelFit,
    ErrorSamples,
    fit_bins,
    read_error_model,
    write_error_model,
)
from railfix.run.processor import processor_of
from railfix.simulate import Scenario, Simulation
from railfix.simulate.run import vehicle_table
from railfix.simulate.scenario_file import load_recipe
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle

ANTENNAS = ("front", "rear")
ALARM_LIMITS_M = (10.0, 20.0, 40.0)
#: Bins of the models: finer in C/N0 than by default, there are millions of samples.
BINS = ErrorBins(cn0_dbhz=(0.0, 30.0, 35.0, 37.5, 40.0, 42.5, 45.0, 47.5, 50.0, 60.0))
#: Kinds of levels by the model that they rest on; those of any other model are "other".
NAMES = {None: "plain", "model-even": "judged", "model-odd": "judged"}
#: Settings of both halves.
SETTINGS: dict[str, Any] = {"elevation": {"mask_deg": 15.0}}


def scenario_of(run: int) -> Scenario:
    """A run over a line, a place and a sky of its own."""
    recipe = load_recipe("p1-commercial")
    base = recipe.scenario(run % 2)
    changes = {
        "seed": 100 + run,
        "place_seed": 100 + run,
        "start": base.start + np.timedelta64(run * 53_417 % 86_400 + run % 5 * 86_400, "s"),
        "line": {"azimuth_deg": (75.0 + 137.5 * run) % 360.0, "generated": {"seed": 100 + run}},
    }
    changes["start"] = changes["start"].astype("datetime64[s]").item()
    return recipe.scenario(run % 2, changes=changes)


@dataclass(frozen=True)
class Played:
    """A simulated run ready to be positioned."""

    simulation: Simulation
    trajectories: dict[str, Trajectory]

    @classmethod
    def of(cls, scenario: Scenario) -> Played:
        simulation = Simulation(scenario)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "vehicle.toml"
            write_toml(path, vehicle_table(scenario.vehicle))
            vehicle = read_vehicle(path)
        track = simulation.line.track()
        return cls(simulation, {name: antenna_trajectory(track, vehicle, name) for name in ANTENNAS})

    def results(self, settings: dict[str, Any]) -> Iterator[dict[str, tuple[AntennaResult, Any]]]:
        """Results of the chunks, each with the simulator's own piece."""
        processor = processor_of(parse_config(settings), self.simulation.navigation, self.trajectories)
        state = State()
        for pieces in zip(*(self.simulation.pieces(name) for name in ANTENNAS), strict=True):
            result, state = processor.process(
                {name: piece.observations for name, piece in zip(ANTENNAS, pieces, strict=True)}, state
            )
            yield {name: (result.antennas[name], piece) for name, piece in zip(ANTENNAS, pieces, strict=True)}

    def true_chainage_m(self, piece: Any) -> np.ndarray:
        """Chainage of the truth as the track map counts."""
        line = self.simulation.line
        return np.interp(piece.geometry.chainage_m, line.sampled_chainage_m(), line.track().chainage_m)


def gather(run: int, folder: Path) -> None:
    """Range errors of a run, for the model."""
    out = folder / f"samples-{run:03d}.npz"
    if out.exists():
        return
    played, parts = Played.of(scenario_of(run)), []
    for chunk in played.results({**SETTINGS, "protection": "off"}):
        for number, (name, (found, piece)) in enumerate(chunk.items()):
            reference = truth_of(found, piece)
            samples = range_errors(found, played.trajectories[name], reference).samples
            samples.block[:] += (2 * run + number) * 10**15
            parts.append(samples)
    whole = joined(parts)
    narrow = {f.name: getattr(whole, f.name) for f in fields(ErrorSamples)}
    narrow = {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in narrow.items()}
    _keep(out, narrow)


def truth_of(found: AntennaResult, piece: Any) -> AntennaReference:
    """The truth as a reference."""
    blank, words = np.full(len(found), np.nan), np.full(len(found), "")
    return AntennaReference(
        time=found.time,
        ecef_m=piece.geometry.antenna_ecef_m,
        chainage_m=blank,
        speed_mps=blank,
        sigma_m=blank,
        source=words,
        environment=words,
    )


def model_of(runs: list[int], folder: Path, name: str) -> Path:
    """Error model of some runs."""
    path = folder / f"{name}.toml"
    if not path.exists():
        parts = []
        for run in runs:
            with np.load(folder / f"samples-{run:03d}.npz") as file:
                parts.append(ErrorSamples(**{key: file[key] for key in file.files}))
        samples, fit = joined(parts), ErrorModelFit(bins=BINS)
        everything = np.ones(len(samples.error_m), dtype=bool)
        model = ErrorModel(
            bins=fit.bins,
            before=fit_bins(samples, everything, fit),
            after=fit_bins(samples, samples.used, fit),
            covers="satellite_and_atmosphere",
        )
        write_error_model(model, path)
    return path


def judge(run: int, model: Path | None, folder: Path) -> None:
    """Errors and levels of a run, weighted by a model of other runs."""
    out = folder / f"{NAMES.get(model and model.stem, 'other')}-{run:03d}.npz"
    if out.exists():
        return
    played = Played.of(scenario_of(run))
    settings = SETTINGS if model is None else {**SETTINGS, "error_model": str(model)}
    rows: dict[str, list[np.ndarray]] = {}
    for chunk in played.results(settings):
        for number, (found, piece) in enumerate(chunk.values()):
            level = found.protection.level
            true = played.true_chainage_m(piece)
            row = {
                "time": found.time,
                "antenna": np.full(len(found), number, dtype=np.int8),
                "chainage_m": true,
                "environment": played.simulation.environment.label_at(piece.geometry.chainage_m),
                "error_m": found.chainage_m - true,
                "level_m": level.level_m,
                "fault_free_m": level.fault_free_m,
                "one_fault_m": level.one_fault_m,
                "two_fault_m": level.two_fault_m,
                "cause": level.cause,
                "level_status": found.protection.status,
                "status": found.status,
                "n_used": found.n_used,
                "excluded": found.raim.excluded.sum(axis=1),
            }
            for key, values in row.items():
                rows.setdefault(key, []).append(values)
    _keep(out, {key: np.concatenate(values) for key, values in rows.items()})


def _keep(path: Path, arrays: dict[str, np.ndarray]) -> None:
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    np.savez(temporary, **arrays)
    temporary.replace(path)


def table(folder: Path, kind: str) -> dict[str, np.ndarray]:
    """All judged runs together, with the number of the run."""
    parts: dict[str, list[np.ndarray]] = {}
    for path in sorted(folder.glob(f"{kind}-*.npz")):
        with np.load(path) as file:
            for key in file.files:
                parts.setdefault(key, []).append(file[key])
            parts.setdefault("run", []).append(np.full(len(file["time"]), int(path.stem[-3:])))
    return {key: np.concatenate(values) for key, values in parts.items()}


def summary(rows: dict[str, np.ndarray]) -> Iterator[str]:
    """What the levels are worth, as lines of text."""
    error = np.abs(rows["error_m"])
    usable = rows["level_status"] == LevelStatus.AVAILABLE
    vouched = np.isin(rows["status"], [Status.OK]) & (rows["level_status"] != LevelStatus.ALARM)
    has = np.isfinite(rows["error_m"]) & vouched
    observed = rows["status"] != Status.NO_OBSERVATION
    yield (
        f"{len(error):,} epochs of {len(np.unique(rows['run']))} runs, {int(observed.sum()):,} with observations, "
        f"{int(has.sum()):,} with a position that no check is against ({100 * has.sum() / observed.sum():.2f} %), "
        f"usable within 20 m {100 * usable.sum() / observed.sum():.2f} %"
    )
    yield "alarm limit   nominal  misleading  hazardous  unavailable  unavail.+misl.  available of observed"
    level = np.where(has, rows["level_m"], np.inf)
    time = np.arange(len(error)) * np.timedelta64(1, "s") + np.datetime64("2000-01-01", "ns")
    for limit in ALARM_LIMITS_M:
        found = stanford(time, np.where(has, rows["error_m"], np.nan), level, alarm_limit_m=limit)
        count = found.counts
        within = int(((level <= limit) & observed).sum())
        yield (
            f"{limit:8.0f} m {count[Region.NOMINAL]:11,} {count[Region.MISLEADING]:11,} {count[Region.HAZARDOUS]:10,} "
            f"{count[Region.UNAVAILABLE]:12,} {count[Region.UNAVAILABLE_MISLEADING]:15,} "
            f"{100 * within / observed.sum():10.2f} %"
        )
    finite = has & np.isfinite(level)
    parts = ("level_m", "fault_free_m", "one_fault_m", "two_fault_m")
    yield "part           p50      p95      p99   [m]"
    for part in parts:
        yield f"{part:12} " + " ".join(f"{np.percentile(rows[part][finite], q):8.2f}" for q in (50, 95, 99))
    ratio = error[finite] / level[finite]
    yield f"error / level: p50 {np.median(ratio):.3f}, p99.9 {np.percentile(ratio, 99.9):.3f}, max {ratio.max():.3f}"
    p50, p95 = np.percentile(error[has], [50, 95])
    yield f"|error|: p50 {p50:.2f}, p95 {p95:.2f}, max {error[has].max():.2f} m"
    yield "environment   observed   no check against   level p50   available 10 m   20 m   40 m   |error| max"
    for name in np.unique(rows["environment"]).tolist():
        here = observed & (rows["environment"] == name)
        if not here.any():
            continue
        good = here & finite
        cells = [100 * (good & (level <= limit)).sum() / here.sum() for limit in ALARM_LIMITS_M]
        yield (
            f"{name:12} {int(here.sum()):9,} {100 * (here & has).sum() / here.sum():14.2f} % "
            f"{np.median(level[good]) if good.any() else np.nan:12.2f} "
            f"{cells[0]:12.2f} % {cells[1]:6.2f} {cells[2]:6.2f} "
            f"{error[good].max() if good.any() else np.nan:10.2f}"
        )
    beyond = np.flatnonzero(finite & (error > level))
    yield f"{len(beyond)} epochs beyond their level" + (":" if len(beyond) else "")
    for i in beyond[np.argsort(level[beyond] - error[beyond])][:40]:
        yield (
            f"  run {rows['run'][i]} {ANTENNAS[rows['antenna'][i]]} {str(rows['time'][i])[:21]} at "
            f"{rows['chainage_m'][i]:.0f} m {rows['environment'][i]}: error {rows['error_m'][i]:+.2f}, level "
            f"{level[i]:.2f} (by {Cause(int(rows['cause'][i])).name.lower()}), {rows['n_used'][i]} used, "
            f"{rows['excluded'][i]} excluded"
        )


def campaign(folder: Path, runs: int, jobs: int) -> None:
    """Simulate, model, judge."""
    folder.mkdir(parents=True, exist_ok=True)
    even, odd = list(range(0, runs, 2)), list(range(1, runs, 2))
    with ProcessPoolExecutor(max_workers=jobs) as pool:
        list(pool.map(gather, range(runs), [folder] * runs))
        # A half judges by what the other half has made.
        for_odd, for_even = model_of(even, folder, "model-even"), model_of(odd, folder, "model-odd")
        models = [for_even if run % 2 == 0 else for_odd for run in range(runs)]
        list(pool.map(judge, range(runs), models, [folder] * runs))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--runs", type=int, default=48)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--summary", action="store_true")
    parser.add_argument("--model", type=Path, help="judge the runs of FOLDER by this model, of another generator")
    options = parser.parse_args()
    began = clock.perf_counter()
    if options.model is not None:
        with ProcessPoolExecutor(max_workers=options.jobs) as pool:
            runs = range(options.runs)
            list(pool.map(judge, runs, [options.model] * options.runs, [options.folder] * options.runs))
        print("\n".join(summary(table(options.folder, "other"))))
        print(f"{clock.perf_counter() - began:.0f} s")
        return
    if not options.summary:
        campaign(options.folder, options.runs, options.jobs)
    print("\n".join(summary(table(options.folder, "judged"))))
    for name in ("model-even", "model-odd"):
        model = read_error_model(options.folder / f"{name}.toml")
        print(
            f"{name}: {int(model.after.count.sum()):,} ranges after the screens, bound sigma "
            f"{np.nanmin(model.after.bound_sigma_m):.2f} to {np.nanmax(model.after.bound_sigma_m):.2f} m"
        )
    print(f"{clock.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()

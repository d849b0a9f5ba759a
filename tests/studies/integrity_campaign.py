"""Protection levels on simulated lines: is any epoch misled, and how often is the level of use?

``python tests/studies/integrity_campaign.py FOLDER [--scenario p1-commercial] [--rate 10] [--runs 48] [--jobs 2]``
simulates runs over lines, places and skies that all differ (a shipped scenario under other seeds), half of which make
an error model that the other half is judged by, and the other way round. Each run is kept in FOLDER, so that a broken
campaign goes on where it was. ``--summary`` prints the tables of what is there; ``--model FILE`` judges the same runs
by a model of another generator: that of another scenario (``OTHER_FOLDER/model-all.toml``) or of the recordings
(``tests/studies/integrity_recordings.py`` writes them).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from railfix.core.reasons import Status
from railfix.core.settings_files import write_toml
from railfix.evaluate.range_errors import range_errors
from railfix.integrity.protection import Cause, LevelStatus
from railfix.integrity.stanford import Region, stanford
from railfix.io.reference_log import AntennaReference
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor_state import State
from railfix.pipeline.results import AntennaResult
from railfix.ranges.error_model import ErrorBins, ErrorModel, read_error_model, write_error_model
from railfix.ranges.error_model_fit import ErrorModelFit, ErrorSamples, fault_rate, fit_bins
from railfix.run.processor_setup import make_processor
from railfix.simulate import Scenario, Simulation
from railfix.simulate.run import vehicle_table
from railfix.simulate.scenario_file import load_recipe
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle

ANTENNAS = ("front", "rear")
ALARM_LIMITS_M = (10.0, 20.0, 40.0)
#: Bins of the models: finer in C/N0 than by default, there are millions of samples.
BINS = ErrorBins(cn0_dbhz=(0.0, 30.0, 35.0, 37.5, 40.0, 42.5, 45.0, 47.5, 50.0, 60.0))
#: Halves of the runs.
HALVES = ("even", "odd")
#: Errors beyond so many sigmas of the level are local faults, as in `railfix error-model`.
FAULT_SIGMAS = 5.0
#: Settings of both halves.
SETTINGS: dict[str, Any] = {"elevation": {"mask_deg": 15.0}}


@dataclass(frozen=True)
class Runs:
    """A shipped scenario, and the rate of its epochs [Hz]; None: its own."""

    scenario: str
    rate_hz: float | None = None


def joined(parts: list[ErrorSamples]) -> ErrorSamples:
    """Samples of several parts concatenated."""
    names = [item.name for item in fields(ErrorSamples)]
    return ErrorSamples(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def scenario_of(run: int, runs: Runs) -> Scenario:
    """A run over a line, a place and a sky of its own."""
    recipe = load_recipe(runs.scenario)
    direction = run % 2 % len(recipe.names)
    base = recipe.scenario(direction)
    changes = {
        "seed": 100 + run,
        "place_seed": 100 + run,
        "start": base.start + np.timedelta64(run * 53_417 % 86_400 + run % 5 * 86_400, "s"),
        "line": {"azimuth_deg": (75.0 + 137.5 * run) % 360.0, "generated": {"seed": 100 + run}},
    }
    changes["start"] = changes["start"].astype("datetime64[s]").item()
    scenario = recipe.scenario(direction, changes=changes).replaced(sensors=None)
    return scenario if runs.rate_hz is None else scenario.replaced(rate_hz=runs.rate_hz)


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
        processor = make_processor(parse_config(settings), self.simulation.navigation, self.trajectories)
        state = State()
        for pieces in zip(*(self.simulation.pieces(name) for name in ANTENNAS), strict=True):
            result, state = processor.process(
                {name: piece.observations for name, piece in zip(ANTENNAS, pieces, strict=True)}, state
            )
            yield {name: (result.antennas[name], piece) for name, piece in zip(ANTENNAS, pieces, strict=True)}

    def true_chainage_m(self, piece: Any) -> np.ndarray:
        """Chainage of the truth as the track map counts."""
        line = self.simulation.line
        return np.interp(piece.geometry.chainage_m, line.point_chainage_m(), line.track().chainage_m)


def gather(run: int, runs: Runs, folder: Path) -> None:
    """Range errors of a run, for the model."""
    out = folder / f"samples-{run:03d}.npz"
    if out.exists():
        return
    played, parts = Played.of(scenario_of(run, runs)), []
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


def samples_of(runs: list[int], folder: Path) -> ErrorSamples:
    """Range errors of some runs."""
    parts = []
    for run in runs:
        with np.load(folder / f"samples-{run:03d}.npz") as file:
            parts.append(ErrorSamples(**{key: file[key] for key in file.files}))
    return joined(parts)


def model_of(runs: list[int], folder: Path, name: str) -> Path:
    """Error model of some runs."""
    path = folder / f"{name}.toml"
    if not path.exists():
        samples, fit = samples_of(runs, folder), ErrorModelFit(bins=BINS)
        everything = np.ones(len(samples.error_m), dtype=bool)
        model = ErrorModel(
            bins=fit.bins,
            before=fit_bins(samples, everything, fit),
            after=fit_bins(samples, samples.used, fit),
            covers="satellite_and_atmosphere",
        )
        write_error_model(model, path)
    return path


def judge(run: int, runs: Runs, model: Path, folder: Path, kind: str) -> None:
    """Errors and levels of a run by a model of other runs."""
    out = folder / f"{kind}-{run:03d}.npz"
    if out.exists():
        return
    played = Played.of(scenario_of(run, runs))
    settings = {**SETTINGS, "error_model": str(model)}
    rows: dict[str, list[np.ndarray]] = {}
    ranges = np.zeros(2, dtype=np.int64)
    for chunk in played.results(settings):
        for number, (name, (found, piece)) in enumerate(chunk.items()):
            level = found.protection.level
            samples = range_errors(found, played.trajectories[name], truth_of(found, piece)).samples
            faulty = samples.used & (np.abs(samples.error_m) > FAULT_SIGMAS * samples.sigma_m)
            ranges += [np.count_nonzero(samples.used), np.count_nonzero(faulty)]
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
    _keep(out, {**{key: np.concatenate(values) for key, values in rows.items()}, "ranges": ranges})


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
    used, faulty = rows["ranges"].reshape(-1, 2).sum(axis=0)
    yield f"{used:,} ranges used, {faulty:,} beyond {FAULT_SIGMAS:g} sigma of the level ({faulty / used:.1e})"
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


def in_parallel(function: Callable[..., None], jobs: int, *arguments: list[Any]) -> None:
    """Call a function for each run."""
    with ProcessPoolExecutor(max_workers=jobs) as pool:
        list(pool.map(function, *arguments))


def campaign(folder: Path, runs: Runs, count: int, jobs: int) -> None:
    """Simulate, model, judge."""
    folder.mkdir(parents=True, exist_ok=True)
    every, same = list(range(count)), [runs] * count
    in_parallel(gather, jobs, every, same, [folder] * count)
    # A half judges by what the other half has made; the model of all is for other scenarios.
    for_odd, for_even = model_of(every[::2], folder, "model-even"), model_of(every[1::2], folder, "model-odd")
    model_of(every, folder, "model-all")
    models = [for_even if run % 2 == 0 else for_odd for run in every]
    in_parallel(judge, jobs, every, same, models, [folder] * count, ["judged"] * count)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenario", default="p1-commercial")
    parser.add_argument("--rate", type=float, help="epochs a second (default: of the scenario)")
    parser.add_argument("--runs", type=int, default=48)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--summary", action="store_true")
    parser.add_argument("--model", type=Path, help="judge the runs of FOLDER by this model, of another generator")
    options = parser.parse_args()
    count, runs = options.runs, Runs(options.scenario, options.rate)
    kind = "judged" if options.model is None else f"by-{options.model.parent.name}-{options.model.stem}"
    if options.model is None and not options.summary:
        campaign(options.folder, runs, count, options.jobs)
    elif not options.summary:
        same = [runs] * count, [options.model] * count, [options.folder] * count, [kind] * count
        in_parallel(judge, options.jobs, list(range(count)), *same)
    print("\n".join(summary(table(options.folder, kind))))
    for path in [options.model] if options.model else [options.folder / f"model-{half}.toml" for half in HALVES]:
        model = read_error_model(path)
        print(
            f"{path.stem}: {int(model.after.count.sum()):,} ranges after the screens, bound sigma "
            f"{np.nanmin(model.after.bound_sigma_m):.2f} to {np.nanmax(model.after.bound_sigma_m):.2f} m"
        )
    if options.model is None:
        rate = fault_rate(samples_of(list(range(count)), options.folder))
        print(
            f"without a model: {rate.faulty} of {rate.ranges:,} ranges beyond {rate.beyond_sigma:g} sigma "
            f"({rate.prior:.1e}, at most {rate.upper:.1e}), two satellites {rate.together:.1f} times as often as "
            f"independent ones, low ones of one side in {rate.side_faulty_blocks} of {rate.side_blocks:,} blocks "
            f"(at most {rate.side_upper:.1e})"
        )


if __name__ == "__main__":
    main()

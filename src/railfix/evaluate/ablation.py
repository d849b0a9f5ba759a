"""Effect of each screen and of each measurement source of the filter on accuracy and availability.

The logs are read once, and every chunk of them is processed with each choice of screens and sources.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.errors import MismatchError
from railfix.core.reasons import Status
from railfix.evaluate.accuracy import Score, score
from railfix.evaluate.place import along_track_error, interpolate_reference
from railfix.io.reference_log import AntennaReference, read_reference
from railfix.pipeline.config import Config, FilterSource
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.processor_state import State
from railfix.pipeline.results import AntennaResult
from railfix.ranges.cn0_curve_file import read_cn0_curve
from railfix.run.checks import check_same_day, check_same_place, check_whole_run
from railfix.run.driver import Progress, collect_notes, open_inputs, read_samples_and_units
from railfix.run.inputs import ColumnNames, RunInputs, RunOptions
from railfix.run.output import OutputFolder
from railfix.run.processor_setup import make_processor
from railfix.run.record import NO_FIGURES, RunProvenance, package_versions, run_record
from railfix.run.sensors import load_balises
from railfix.run.sources import align_logs
from railfix.run.tally import Tally
from railfix.screens import SCREENS, ScreenSetup
from railfix.track.trajectory import Trajectory
from railfix.tracking import TrackStatus

#: Names of the choices with all screens, with no screens, and with the filter along the track.
ALL, NONE, FILTER = "all", "none", "filter"
#: Filter sources that require sensor data, each with the names of the run inputs that the source needs.
_SENSORS: Final[Mapping[FilterSource, tuple[str, ...]]] = {
    "wheel": ("tachometer",),
    "radar": ("radar",),
    "force": ("inertial",),
    "feature": ("inertial", "tachometer"),
    "balise": ("balises",),
    "range": ("ranging",),
}


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Rates and errors of one antenna with one choice of screens or one choice of filter sources."""

    choice: str  #: Name of the choice, such as "all", "none", "only raim", "without raim", "filter without phase".
    screens: tuple[str, ...]  #: Active screens.
    sources: tuple[str, ...]  #: Measurement sources that the filter uses; empty for single-epoch positions.

    antenna: str
    epochs: int  #: Number of epochs with observations and, if a reference is given, with a reference position.
    rate: float  #: Fraction of the epochs that have coordinates.
    ok_rate: float  #: Fraction of the epochs with status `ok` (filter: status `tracking`).
    n_used: float  #: Mean number of satellites used.
    #: Median of the standard deviation along the line over the epochs with coordinates; NaN without such epochs.
    sigma_p50_m: float
    coordinates: Score | None = None  #: Errors at all epochs with coordinates; None without a reference.
    ok: Score | None = None  #: Errors of the positions with status ok; None without a reference.
    #: Errors of the conventional positions from the same ranges; None without a reference.
    conventional: Score | None = None
    #: Errors at epochs without observations, for example in tunnels; None if there are no such epochs or no reference.
    outage: Score | None = None
    #: 95th percentile of |error| / stated standard deviation; NaN without a reference.
    normalised_p95: float = float("nan")

    def as_row(self) -> dict[str, Any]:
        """Return the values by column name for one row of a table, with None in place of NaN."""
        row: dict[str, Any] = {name: getattr(self, name) for name in _OF_EFFECT}
        row["screens"], row["sources"] = " ".join(self.screens), " ".join(self.sources)
        for name in ("coordinates", "ok", "conventional", "outage"):
            figures: Score | None = getattr(self, name)
            for figure in _OF_SCORE:
                row[f"{name}_{figure}"] = None if figures is None else getattr(figures, figure)
        return {k: None if isinstance(v, float) and np.isnan(v) else v for k, v in row.items()}


_OF_EFFECT: Final = (
    "choice", "screens", "sources", "antenna", "epochs", "rate", "ok_rate", "n_used", "sigma_p50_m", "normalised_p95",
)  # fmt: skip
_OF_SCORE: Final = ("positions", "mean_m", "std_m", "p50_m", "p95_m", "max_m", "wrong_place")


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """Effects of all choices of screens and sources on one log."""

    effects: tuple[Effect, ...]  #: One effect per antenna and choice, ordered by antenna, then by choice.
    notes: tuple[str, ...]
    files: Mapping[str, Path]
    wall_s: float


def choices(screens: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the distinct choices of screens by name: all screens, none, each screen alone, and all except one."""
    named = {ALL: tuple(screens), NONE: ()}
    named |= {f"only {name}": (name,) for name in screens}
    named |= {f"without {name}": tuple(other for other in screens if other != name) for name in screens}
    first = {chosen: name for name, chosen in reversed(named.items())}
    return {name: chosen for name, chosen in named.items() if first[chosen] == name}


def filter_choices(inputs: RunInputs, sources: Sequence[FilterSource]) -> dict[str, tuple[FilterSource, ...]]:
    """Return the choices of filter sources by name: all, and all except one; every choice includes the codes."""
    absent = [source for source, names in _SENSORS.items() if any(getattr(inputs, name) is None for name in names)]
    there = tuple(source for source in sources if source not in absent)
    return {FILTER: there} | {
        f"{FILTER} without {name}": tuple(other for other in there if other != name) for name in there if name != "code"
    }


def judging_screens(config: Config, trajectories: Mapping[str, Trajectory]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the active screens whose inputs this run has, and a note on each active screen that is omitted."""
    setup = ScreenSetup(
        antennas=len(trajectories),
        spacing_known=all(t.body_chainage_m is not None for t in trajectories.values()),
        cn0_curve=None if config.cn0_curve is None else read_cn0_curve(config.cn0_curve),
    )
    chosen = [screen for screen in SCREENS if screen.name in config.screens]
    unable = [screen for screen in chosen if screen.unable(getattr(config, screen.name), setup)]
    notes = tuple(f"screen {screen.name}: left out, because it needs {screen.needs}" for screen in unable)
    return tuple(screen.name for screen in chosen if screen not in unable), notes


def ablate_files(
    inputs: RunInputs,
    config: Config | None = None,
    *,
    out: Path,
    options: RunOptions | None = None,
    asked: Mapping[str, Any] | None = None,
    reading: ColumnNames | None = None,
    progress: Progress | None = None,
) -> Ablation:
    """Process the logs with every choice of screens and sources, and write ``ablation.csv`` and ``ablation.json``.

    Raise the errors of `railfix.run.run_files`, and MismatchError if ground truth and log do not overlap in time.
    """
    began = clock.perf_counter()
    options = options or RunOptions()
    inputs, config = inputs.prepare(config or Config())
    given = OutputFolder(out, overwrite=options.overwrite, inputs=inputs.paths)
    with given as folder, ThreadPoolExecutor(max_workers=1) as pool:
        entries = inputs.entries(pool, out)
        antennas, truth = tuple(inputs.logs), _read_truth(inputs, reading or ColumnNames())
        navigation, line, logs = open_inputs(inputs, options, config)
        screens, left_out = judging_screens(config, line.trajectories)
        settings = _settings_of_choices(inputs, config, screens)
        sensors, units = read_samples_and_units(inputs)
        balises = load_balises(inputs.balises, inputs.balise_list, None, line.track, config)
        processors = {
            name: make_processor(chosen, navigation, line.trajectories, track=line.track, units=units, balises=balises)
            for name, chosen in settings.items()
        }
        received, states = np.datetime64("NaT", "ns"), dict.fromkeys(processors, State())
        tallies = {name: Tally(min_satellites=config.min_satellites) for name in processors}
        bare = tallies[NONE if NONE in tallies else ALL]  # without active screens, there is no choice "none"
        parts: dict[tuple[str, str], list[dict[str, Floats]]] = {}
        for chunk in align_logs({name: log.parts() for name, log in logs.items()}):
            end = max(part.time[-1] for part in chunk.values() if len(part))
            since = sensors.between(received, end)
            received = end
            for name, processor in processors.items():
                result, states[name] = processor.process(chunk, states[name], sensors=since)
                tallies[name].add(result)
                for antenna, positions in result.antennas.items():
                    reference, trajectory = truth.get(antenna), line.trajectories[antenna]
                    columns = _columns(positions, result.fusion.get(antenna), reference, trajectory)
                    parts.setdefault((name, antenna), []).append(columns)
            check_same_day(navigation, bare)
            check_same_place(bare, antennas="all")
            if progress is not None:
                progress(epochs=bare.epochs, fraction=min(log.share for log in logs.values()))
        check_whole_run(navigation, bare)
        effects = tuple(
            _effect(name, processor.config, antenna, parts[name, antenna])
            for antenna in inputs.logs
            for name, processor in processors.items()
        )
        found = collect_notes(line, navigation, tallies[ALL], logs, note_statistic=config.map_offset.note_threshold)
        notes = (*left_out, *found)
        wall = clock.perf_counter() - began
        made_from = RunProvenance(
            files=[entry.result() for entry in entries],
            packages=package_versions(),
            asked=asked or {},
            config=config.model_copy(update={"screens": screens, "protection": "off"}),
            options=options,
            line=line.facts,
            navigation=navigation,
        )
        record = run_record(made_from, tallies[ALL], notes, dict.fromkeys(antennas, NO_FIGURES), wall)
        rows = [effect.as_row() for effect in effects]
        folder.append_csv("ablation.csv", pl.DataFrame(rows, infer_schema_length=None))
        folder.write_json("ablation.json", record | {"choices": rows})
        files = folder.commit({})
    return Ablation(effects=effects, notes=notes, files=files, wall_s=wall)


def _read_truth(inputs: RunInputs, reading: ColumnNames) -> Mapping[str, AntennaReference]:
    """Return the reference positions by antenna; empty without `inputs.truth`."""
    return {} if inputs.truth is None else read_reference(inputs.truth, tuple(inputs.logs), **reading.arguments)


def _settings_of_choices(inputs: RunInputs, config: Config, screens: tuple[str, ...]) -> dict[str, Config]:
    """Return the settings of every choice by name; protection levels are off because they are not compared."""
    plain = config.model_copy(update={"protection": "off", "filter": "off"})
    settings = {name: plain.model_copy(update={"screens": chosen}) for name, chosen in choices(screens).items()}
    if config.filter == "track":
        filtered = plain.model_copy(update={"filter": "track", "screens": screens})
        for name, sources in filter_choices(inputs, config.filter_sources).items():
            settings[name] = filtered.model_copy(update={"filter_sources": sources})
    return settings


def _columns(
    result: AntennaResult, track: AlongTrack | None, reference: AntennaReference | None, trajectory: Trajectory
) -> dict[str, Floats]:
    """Return, for one chunk, the columns from which the effect on one antenna is computed; each has shape (T,).

    Positions and standard deviations are taken from the filter if `track` is given. Masks are stored as 1.0 and 0.0.
    """
    counted = result.status != Status.NO_OBSERVATION
    without = ~counted
    if track is None:
        arc, sigma, ok = result.arc_m, result.along_sigma_m, result.status == Status.OK
    else:
        arc = np.where(np.isfinite(track.chainage_m), track.tracked.arc_m, np.nan)
        sigma, ok = track.tracked.sigma_m, track.tracked.status == TrackStatus.TRACKING
    columns = {
        "has": np.isfinite(arc).astype(np.float64),
        "ok": ok.astype(np.float64),
        "n_used": result.n_used.astype(np.float64),
        "sigma_m": sigma,
    }
    if reference is not None:
        place = interpolate_reference(result.time, reference.time, reference.ecef_m)
        counted, without = counted & np.isfinite(place[:, 0]), without & np.isfinite(place[:, 0])
        columns["error_m"] = along_track_error(arc, place, trajectory)
        columns["conventional_m"] = along_track_error(result.conventional_arc_m, place, trajectory)
    return columns | {"counted": counted.astype(np.float64), "without": without.astype(np.float64)}


def _effect(choice: str, config: Config, antenna: str, parts: Sequence[Mapping[str, Floats]]) -> Effect:
    """Return the effect of one choice on one antenna.

    Raise MismatchError if reference and log do not overlap in time.
    """
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    counts = columns["counted"] > 0
    if not counts.any():
        raise MismatchError(
            f"the ground truth and the {antenna} log have no time in common; give the ground truth of the same run"
        )
    has, ok = counts & (columns["has"] > 0), counts & (columns["ok"] > 0)
    figures: dict[str, Score] = {}
    normalised = float("nan")
    if "error_m" in columns:
        error, without = columns["error_m"], columns["without"] > 0
        figures = {
            "coordinates": score(error, counts),
            "ok": score(np.where(ok, error, np.nan), counts),
            "conventional": score(columns["conventional_m"], counts),
        }
        if without.any():
            figures["outage"] = score(error, without)
        ratio = np.abs(error / columns["sigma_m"])[(counts | without) & np.isfinite(error)]
        normalised = float(np.percentile(ratio, 95.0)) if len(ratio) else normalised
    return Effect(
        choice=choice,
        screens=config.screens,
        sources=config.filter_sources if config.filter == "track" else (),
        antenna=antenna,
        epochs=int(counts.sum()),
        rate=float(has.sum() / counts.sum()),
        ok_rate=float(ok.sum() / counts.sum()),
        n_used=float(columns["n_used"][counts].mean()),
        sigma_p50_m=float(np.median(columns["sigma_m"][has])) if has.any() else float("nan"),
        normalised_p95=normalised,
        **figures,
    )

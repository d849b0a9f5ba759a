"""Positioning of the logs of a run in chunks, and writing of the run's tables and record."""

from __future__ import annotations

import sys
import time as clock
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from railfix import __version__
from railfix.core.arrays import Floats
from railfix.core.errors import NoPositionError, check_type, warn_of
from railfix.core.notebook import html_list
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io.logs import read_navigation
from railfix.motion.samples import SENSORS, GroundUnits, SensorSamples
from railfix.pipeline.antenna_order import AntennaOrder
from railfix.pipeline.chunk import Chunk
from railfix.pipeline.config import Config
from railfix.pipeline.level_stage import get_risk_budget, level_facts, prior_basis_text
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.run.checks import check_base, check_each_file, check_same_day, check_same_place, check_whole_run
from railfix.run.convert import add_mate_results
from railfix.run.inputs import Antenna, RunInputs, RunOptions
from railfix.run.output import OutputFolder
from railfix.run.processor_setup import BaseLog, base_log, make_processor
from railfix.run.record import RunProvenance, compute_figures, package_versions, run_record
from railfix.run.sensor_checks import SensorChecks
from railfix.run.sensors import check_filter, load_balises, read_sensors, units_of_ranges
from railfix.run.sources import TRACK_FILE, Log, OpenedLine, align_logs, open_line, read_ahead, without_beside
from railfix.run.tally import Replays, ResultRows, Tally, add_smoothed, shorten_notes
from railfix.run.verdict import Verdict, judge_run
from railfix.screens import SCREENS
from railfix.track import check_track, write_track_csv
from railfix.track.quality import error_note
from railfix.track.vehicle import read_vehicle


class Progress(Protocol):
    """Callback for the progress of a run."""

    def __call__(self, *, epochs: int, fraction: float) -> None:
        """Report the number of positioned epochs and the fraction of the logs that has been read, 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """Summary of a run."""

    tally: Tally  #: Counts of all epochs and observations.
    record: Mapping[str, Any]  #: Content of ``run.json``.
    verdict: Verdict  #: Verdict on the run.
    files: Mapping[str, Path]  #: Paths of the written files by name.
    wall_s: float  #: Elapsed time of the run [s].

    def __repr__(self) -> str:
        return f"<RunSummary: {'; '.join(self.verdict.lines())}>"

    def _repr_html_(self) -> str:
        return html_list([*self.verdict.lines(), *self.notes])

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the run, one sentence each."""
        return self.verdict.notes


def run_files(
    inputs: RunInputs,
    config: Config | None = None,
    *,
    out: Path,
    options: RunOptions | None = None,
    asked: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Position the logs of one run along its line and write the results into the folder `out`.

    `config` has all settings. `asked` has only the settings that the user specified; they are recorded in ``run.json``.
    Notes are issued as `RailfixWarning`. If the run fails, raise a RailfixError (`railfix.core.errors`) and leave `out`
    unchanged.
    """
    began = clock.perf_counter()
    config, options = config or Config(), options or RunOptions()
    for value, expected in ((inputs, RunInputs), (config, Config), (options, RunOptions)):
        check_type(value, expected, expected.__name__)
    inputs, config = inputs.prepare(config)
    needing = [name for name in SENSORS if getattr(inputs, name) is not None]
    check_filter(config, [*needing, *options.of_filter])
    with (
        OutputFolder(out, overwrite=options.overwrite, inputs=inputs.paths) as folder,
        ThreadPoolExecutor(max_workers=1) as hashing,
        ThreadPoolExecutor(max_workers=1) as beside,
    ):
        entries, packages = inputs.entries(hashing, out), beside.submit(package_versions)
        navigation, line, logs = open_inputs(inputs, options, config)
        config = config if line.route is None else line.route.with_unmapped(config)
        sensors, units = read_samples_and_units(inputs)
        balises = load_balises(inputs.balises, inputs.balise_list, inputs.virtual_balises, line.track, config)
        base = base_log(inputs.base, options)
        processor = make_processor(
            config, navigation, line.trajectories, track=line.track, units=units, balises=balises,
            base_ecef_m=None if base is None else base.ecef_m,
        )  # fmt: skip
        rows = ResultRows(
            folder=folder, line=line, observations=options.observations == "write",
            checks=SensorChecks() if sensors else None,
            passings=balises is not None, replays={name: Replays() for name in logs} if options.smooth == "on" else {},
        )  # fmt: skip
        tally = _position(logs, (sensors, base), processor, rows, beside, progress)
        if rows.replays:
            add_smoothed(rows.replays, processor, folder)
        causes = _causes(tally, logs, processor, config, line)
        corrections = processor.received.corrections
        unused = check_whole_run(navigation, tally, corrections=corrections, sensors=sensors, causes=causes)
        if base is not None:
            check_base(base, tally, line.trajectories)
        notes = (
            *collect_notes(line, navigation, tally, logs, causes, note_statistic=config.map_offset.note_threshold),
            *_notes_of_levels(config, tally),
            *unused,
            *_notes_of_sensors(rows.checks, sensors, units, line, config),
            *shorten_notes(rows.balise_notes),
        )
        sources = [entry.result() for entry in entries]
        folder.end_parquet(_footer(sources, notes))
        add_mate_results(folder, line.track, inputs.logs["front"][0])
        figures = compute_figures(folder, tally, config)
        wall = clock.perf_counter() - began
        made_from = RunProvenance(
            files=sources, packages=packages.result(), asked=asked or {}, config=config, options=options,
            line=line.facts, navigation=navigation,
        )  # fmt: skip
        record = run_record(made_from, tally, notes, figures, wall)
        record["likely_causes"] = list(dict.fromkeys(cause for cause in causes.values() if cause))
        verdict = _judge(record)
        folder.write_json("run.json", record)
        if not line.from_file:
            write_track_csv(line.track, folder.stage(TRACK_FILE))
        files = folder.commit()
    warn_of(notes)
    return RunSummary(tally=tally, record=record, verdict=verdict, files=files, wall_s=wall)


def _judge(record: Mapping[str, Any]) -> Verdict:
    """Return the verdict on a run. Raise NoPositionError if the run has no usable position."""
    verdict = judge_run(record)
    if not any(antenna.is_usable for antenna in verdict.antennas):
        raise NoPositionError(verdict.failure())
    return verdict


def open_inputs(
    inputs: RunInputs, options: RunOptions, config: Config
) -> tuple[Navigation, OpenedLine, dict[Antenna, Log]]:
    """Read the navigation data and the line, and open the log of each antenna. In a track network, find the route."""
    navigation = read_navigation(inputs.nav, **options.logs.arguments)
    if inputs.sp3:
        from railfix.io.sp3 import read_sp3

        precise = read_sp3(inputs.sp3)
        navigation = replace(navigation, precise=precise, notes=(*navigation.notes, *precise.notes))
    at = find_record_time(navigation)

    def open_log(paths: tuple[Path, ...]) -> Log:
        return Log(
            paths=paths, chunk_epochs=options.chunk_epochs, start=options.start, end=options.end,
            reading=options.logs,
        )  # fmt: skip

    from railfix.run.route import LogPositions

    antenna, paths = next(iter(inputs.logs.items()))
    offset = None if inputs.vehicle is None else read_vehicle(inputs.vehicle).antennas.get(antenna)
    positions = LogPositions(
        path=str(paths[0]), parts=open_log(paths).parts, navigation=navigation, config=config, time=at,
        reading=options.track, antenna_up_m=None if offset is None else offset.up_m,
        open_base=partial(base_log, inputs.base, options),
    )  # fmt: skip
    line = open_line(
        inputs.track, inputs.vehicle, antennas=tuple(inputs.logs), reading=options.track, heights=inputs.heights, at=at,
        log=positions,
    )  # fmt: skip
    logs = {name: open_log(paths) for name, paths in inputs.logs.items()}
    for log in logs.values():
        check_each_file(navigation, log)
    return navigation, line, logs


def find_record_time(navigation: Navigation) -> np.datetime64 | None:
    """Return the epoch for frame transformations: the median time of the navigation data, or None without data."""
    clocks = np.concatenate([navigation.kepler.toc, navigation.glonass.toe])
    if navigation.precise is not None:
        clocks = navigation.precise.time
    return None if not len(clocks) else np.sort(clocks)[len(clocks) // 2]


def read_samples_and_units(inputs: RunInputs) -> tuple[SensorSamples, GroundUnits | None]:
    """Read the samples of the on-board sensors, and the ground units of two-way ranging (None without ranges)."""
    samples = read_sensors(
        tachometer=inputs.tachometer, inertial=inputs.inertial, radar=inputs.radar, ranging=inputs.ranging,
        balises=inputs.balises,
    )  # fmt: skip
    return samples, units_of_ranges(samples, inputs.ranging_units, ranging=inputs.ranging)


def _position(
    logs: Mapping[Antenna, Log],
    others: tuple[SensorSamples, BaseLog | None],
    processor: EpochProcessor,
    rows: ResultRows,
    beside: Executor,
    progress: Progress | None,
) -> Tally:
    """Position the logs in chunks, and return the counts of the run.

    Five stages run in parallel on consecutive chunks: reading, screens, single-epoch positioning, filter, and writing
    (in the executor `beside`). `others` are the samples of the on-board sensors and the base-station log.
    """
    tolerance_s = processor.config.antenna_pair.tag_tolerance_s
    tally = Tally(
        min_satellites=processor.config.min_satellites,
        order=AntennaOrder.between(processor.trajectories, tolerance_s=tolerance_s),
    )
    state = State()
    written: Future[None] | None = None
    chunks = read_ahead(align_logs({name: log.parts() for name, log in logs.items()}))
    began = clock.perf_counter()
    screened = read_ahead(_screen_chunks(chunks, others, processor))
    for solved in read_ahead(_single_epochs(screened, processor)):
        result, state = processor.along_track(solved, state)
        if rows.line.route is not None:
            result = without_beside(result, rows.line.route, processor.config)
        tally.took([own.time for own in result.antennas.values()], clock.perf_counter() - began)
        began = clock.perf_counter()
        tally.add(result)
        check_same_day(processor.received.navigation, tally)
        check_same_place(tally, antennas="all")
        if written is not None:
            written.result()
        written = beside.submit(rows.write, result)
        if progress is not None:
            progress(epochs=tally.epochs, fraction=min(log.share for log in logs.values()))
    if written is not None:
        written.result()
    return tally


def _screen_chunks(
    chunks: Iterator[dict[str, Observations]],
    others: tuple[SensorSamples, BaseLog | None],
    processor: EpochProcessor,
) -> Iterator[Chunk]:
    """Yield the screened chunks, each with the sensor samples and base-station epochs up to the chunk's end."""
    samples, station = others
    after, state = np.datetime64("NaT", "ns"), State()
    for chunk in chunks:
        end = max(own.time[-1] for own in chunk.values() if len(own))
        sensors, base = samples.between(after, end), None if station is None else station.until(end)
        screened, state = processor.screen(chunk, state, sensors=sensors, base=base)
        after = end
        yield screened


def _single_epochs(screened: Iterator[Chunk], processor: EpochProcessor) -> Iterator[Chunk]:
    """Yield the chunks after single-epoch positioning."""
    state = State()
    for chunk in screened:
        solved, state = processor.position(chunk, state)
        yield solved


def _causes(
    tally: Tally, logs: Mapping[Antenna, Log], processor: EpochProcessor, config: Config, line: OpenedLine
) -> dict[str, str]:
    """Return the likely cause (or "") for each antenna with at least 90 % of positions off map or inconsistent."""
    causes: dict[str, str] = {}
    for name in logs:
        antenna = tally.antennas[name]
        off = sum(antenna.status[status] for status in ("off_map", "inconsistent", "map_offset"))
        if antenna.observed and off >= 0.9 * antenna.positioned:
            from railfix.run.locate import likely_cause

            again = replace(logs[name], problems=[], skipped=Counter())
            part = next(again.parts())
            causes[name] = likely_cause(part, processor.received, config, line.trajectories[name])
    return causes


def _notes_of_sensors(
    checks: SensorChecks | None, sensors: SensorSamples, units: GroundUnits | None, line: OpenedLine, config: Config
) -> tuple[str, ...]:
    """Return notes on sensors whose settings or tables contradict satellite positioning."""
    if checks is None:
        return ()
    trajectory = next(iter(line.trajectories.values()))
    return (*checks.notes(sensors, units, trajectory, config.sensors), *checks.radar_alarms(sensors.radar))


#: Last clause of a note on positions off the map, if their cause is unknown.
_TRACK: Final = "check whether this is the right track"
#: Maximum number of notes on excluded satellites for each antenna and each stage (single epochs, filter).
_NAMED: Final = 3


def collect_notes(
    line: OpenedLine,
    navigation: Navigation,
    tally: Tally,
    logs: Mapping[Antenna, Log],
    causes: Mapping[str, str] | None = None,
    *,
    note_statistic: float,
) -> tuple[str, ...]:
    """Return the notes of a run without repetitions.

    `causes` has, for each antenna, the likely cause of positions off the map. A map offset is noted if its test
    statistic exceeds `note_statistic`.
    """
    notes = [
        *line.notes,
        *error_note(check_track(line.track)),
        *navigation.notes,
    ]
    for antenna_name, log in logs.items():
        notes += log.problems
        if log.skipped:
            skipped = ", ".join(f"{count} {what}" for what, count in sorted(log.skipped.items()))
            notes.append(f"{antenna_name}: skipped: {skipped}")
    notes += tally.all_notes
    for name, antenna in tally.antennas.items():
        notes += [
            f"{name}: screen {screen.name} tested nothing; it needs {screen.needs}"
            for screen in SCREENS
            if antenna.judged.get(screen.name) is False
        ]
        if antenna.never_recorded:
            seen = ", ".join(antenna.never_recorded)
            notes.append(f"{name}: satellites seen without any usable navigation record: {seen}")
        for by, counts in (("single epochs", antenna.lasting), ("the filter", antenna.left_out)):
            notes += [
                f"{name}: {by} left out the codes of {satellite} at {count} epochs from {str(first)[:19]} on: "
                "inconsistent with the other satellites for over a minute"
                for satellite, (count, first) in sorted(counts.items(), key=lambda item: -item[1][0])[:_NAMED]
            ]
        offset = antenna.map_offset
        if offset is not None and offset.statistic > note_statistic:
            doubt = "contradicts the positions" if antenna.status["map_offset"] else "may be wrong"
            notes.append(f"{name}: the map {doubt}: {offset.text}")
        notes += [
            f"{name}: {_describe_sign(sign, antenna.tag_error_s)} at {count} epochs from {str(first)[:19]} on"
            for sign, (count, first) in antenna.interference.items()
        ]
        if antenna.positioned:
            notes.append(f"{name}: {_describe_detectable(antenna.map_detectable_m)}")
        off = antenna.status["off_map"]
        if off > 0.1 * antenna.positioned:
            which = "every position is" if off == antenna.positioned else f"{off} of {antenna.positioned} positions are"
            notes.append(f"{name}: {which} off the map; {(causes or {}).get(name) or _TRACK}")
    return tuple(dict.fromkeys(notes))


#: For each time-tag error [s], the time scale that causes it if it is used instead of GPS time.
_SCALES: Final = {-18.0: "UTC", -14.0: "BeiDou time", 19.0: "TAI"}


def _describe_sign(sign: str, tag_error_s: tuple[float, float]) -> str:
    """Return a description of a sign of interference, as the beginning of a sentence.

    `tag_error_s` are the smallest and largest time-tag error [s], positive for late tags.
    """
    if sign == "left_map":
        return "the 3-D positions have left the map (column interference_causes)"
    if sign == "contradicted":
        return "all positions of the previous minute failed a check, so that no filtered position is certain,"
    if sign != "time_tags":
        return f"interference: {sign}"
    low, high = tag_error_s
    middle, drifting = 0.5 * (low + high), high - low > _STEADY_S
    size = f"between {low:+.2f} and {high:+.2f} s" if drifting else f"{abs(middle):.2f} s"
    which = "off (+ late)" if drifting else "early" if middle < 0.0 else "late"
    scale = next((text for off, text in _SCALES.items() if not drifting and abs(middle - off) < _STEADY_S), None)
    guess = "they may drift" if drifting else f"they may be {scale}, not GPS time" if scale else "expected GPS time"
    return f"the time tags are {size} {which}, so there is no protection level ({guess})"


#: Time-tag errors that differ by at most this are taken as equal [s].
_STEADY_S: Final = 0.5


def _describe_detectable(detectable_m: Floats) -> str:
    """Return a clause on undetectable map offsets, given `AntennaTally.map_detectable_m`."""
    if np.isnan(detectable_m).any():
        return "the map was not tested against the positions: there is no minute of 3-D positions with redundant ranges"
    (across, up), (most_across, most_up) = detectable_m.tolist()
    return (
        f"map errors smaller than {across:.0f} m laterally or {up:.0f} m in height cannot be detected; where the "
        f"ranges are worst, smaller than {most_across:.0f} m or {most_up:.0f} m (columns map_detectable_*)"
    )


def _notes_of_levels(config: Config, tally: Tally) -> Iterator[str]:
    """Yield notes on missing protection levels, the basis of the fault priors, and priors that the run contradicts."""
    if not any(antenna.level_status for antenna in tally.antennas.values()):
        return
    for name, of_antenna in tally.antennas.items():
        if of_antenna.without_budget:
            yield (
                f"{name}: {of_antenna.without_budget} epochs have no protection level: simultaneous faults of more "
                "satellites than can be excluded are more probable than the risk allows, or too many satellites are "
                "excluded (settings risk)"
            )
    risk = get_risk_budget(config)
    yield (
        f"protection level: {prior_basis_text(level_facts(config))} (railfix error-model measures priors; "
        "the settings risk.local_prior, risk.side_prior and risk.priors state them)"
    )
    if "raim" not in config.screens:
        return
    used = sum(antenna.used for antenna in tally.antennas.values())
    excluded = sum(antenna.first_reason["fault_excluded"] for antenna in tally.antennas.values())
    # Exclusions in excess of the expected false alarms are taken as faults. The fault rate is compared with the prior.
    observed = sum(antenna.observed for antenna in tally.antennas.values())
    faults = excluded - config.raim.false_alarm * observed
    prior = risk.local_prior + max(risk.satellite_prior.values())
    if faults > 3.0 * np.sqrt(excluded) and faults > prior * (used + excluded):
        yield (
            f"protection level: the assumed fault probability is at most {prior:g} per range, but RAIM has excluded "
            f"{excluded} of {used + excluded} ranges. That is {faults:.0f} more than the expected number of false "
            f"alarms, or {faults / (used + excluded):.2g} per range; see risk.local_prior"
        )


def _footer(files: Iterable[Mapping[str, Any]], notes: Iterable[str]) -> dict[str, str]:
    """Return the metadata for the Parquet file footers: version, command, inputs and notes."""
    return {
        "railfix": __version__,
        "command": " ".join(sys.argv),
        "inputs": "; ".join(f"{f['input']} {f['path']} sha256:{f['sha256']}" for f in files),
        "notes": "; ".join(notes),
    }

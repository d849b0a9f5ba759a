"""An error model from runs with references: positions once more, errors of the ranges, bins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import Field

from railfix import __version__
from railfix.core.arrays import Floats
from railfix.core.errors import MismatchError
from railfix.core.files import file_sha256
from railfix.core.settings import Settings, option
from railfix.evaluate.range_errors.base_station import CommonErrors, base_station_from_files
from railfix.evaluate.range_errors.gather import GatherLimits, joined, range_errors
from railfix.io.reference_log import read_reference
from railfix.pipeline.corrected_ranges import conditions_of
from railfix.pipeline.processor import State
from railfix.ranges.error_model import (
    Conditions,
    ErrorModel,
    ErrorModelFit,
    ErrorModelSource,
    ErrorSamples,
    condition_differences,
    fault_rate,
    faulty_stretches,
    fit_bins,
)
from railfix.run.chunks import aligned
from railfix.run.driver import open_inputs
from railfix.run.folder import read_record
from railfix.run.inputs import input_option
from railfix.run.options import ColumnNames
from railfix.run.processor import processor_of

#: Called after each chunk with the name of the run and the epochs processed so far.
OnChunk = Callable[[str, int], None]


class StationBeside(Settings):
    """Reference positions of runs, and a station beside the line, as the command line names them."""

    reference: tuple[Path, ...] = input_option("Reference positions, one file for each RUN in order.", metavar="FILE")
    base: tuple[Path, ...] = input_option(
        "RINEX observations of a nearby reference station during all RUNs; repeat it for several files.",
        (),
        metavar="OBS",
    )
    base_position: str | None = option(
        "Position of the station; from its header without it.", None, metavar="LAT,LON,HEIGHT"
    )
    columns: ColumnNames = Field(default_factory=ColumnNames)


@dataclass(frozen=True, kw_only=True)
class ModelInputs:
    """A run with its reference trajectory, and optionally a reference station."""

    run: Path  #: Folder written by ``railfix run``.
    reference: Path  #: Reference trajectory of its antennas (`railfix.io.reference_log`).
    base: tuple[Path, ...] = ()  #: RINEX files of a nearby reference station; may be empty.
    base_position_ecef_m: Floats | None = None  #: Of the station, where its header is not good enough; shape (3,).
    columns: Mapping[str, str] = field(default_factory=dict)  #: Names of columns in a reference that is CSV.


@dataclass(frozen=True, kw_only=True)
class _RunErrors:
    """Range errors of one run, with what the model's source says of it."""

    samples: tuple[ErrorSamples, ...]
    times: tuple[np.datetime64, ...]
    epochs: int
    files: Mapping[str, str]
    base: str
    conditions: Conditions


def error_model_from_runs(
    inputs: Sequence[ModelInputs],
    *,
    fit: ErrorModelFit | None = None,
    limits: GatherLimits | None = None,
    progress: OnChunk | None = None,
) -> tuple[ErrorModel, ErrorSamples]:
    """Error model of the pseudoranges of several runs, before and after the screens, and its samples.

    Each run is processed again with its own settings, which gives corrected pseudoranges, satellites and the
    verdict of every screen. All runs have a reference station, or none has.

    Raises
    ------
    MismatchError
        Some runs have a reference station and others have none, their conditions differ, or no range error
        could be computed.
    RailfixError
        A file is not what it should be, or has changed since the run.
    """
    fit, limits = fit or ErrorModelFit(), limits or GatherLimits()
    with_base = {bool(source.base) for source in inputs}
    if len(with_base) != 1:
        raise MismatchError("give a reference station for every run or for none: the errors are of different kinds")
    runs = [_run_errors(source, number, fit, limits, progress) for number, source in enumerate(inputs)]
    parts = [samples for run in runs for samples in run.samples]
    if not any(len(part.error_m) for part in parts):
        raise MismatchError("no pseudorange error could be computed; do run, reference and station belong together?")
    samples = joined(parts)
    conditions = runs[0].conditions
    for source, run in zip(inputs[1:], runs[1:], strict=True):
        if differences := condition_differences(
            conditions, run.conditions, names=(str(inputs[0].run), str(source.run))
        ):
            raise MismatchError(f"the runs have different conditions: {'; '.join(differences)}; make a model for each")
    times = [time for run in runs for time in run.times]
    files = {path: digest for run in runs for path, digest in run.files.items()}
    model = ErrorModel(
        bins=fit.bins,
        before=fit_bins(samples, np.ones(len(samples.error_m), dtype=np.bool_), fit),
        after=fit_bins(samples, samples.used, fit),
        covers="local" if with_base == {True} else "satellite_and_atmosphere",
        conditions=conditions,
        source=ErrorModelSource(
            runs=tuple(str(source.run) for source in inputs),
            base=", ".join(dict.fromkeys(run.base for run in runs if run.base)),
            epochs=sum(run.epochs for run in runs),
            start=str(min(times)),
            end=str(max(times)),
            railfix_version=__version__,
            files=tuple(files.items()),
        ),
        faults=fault_rate(samples).replaced(no_level_m=faulty_stretches(samples)),
    )
    return model, samples


def _run_errors(
    source: ModelInputs, number: int, fit: ErrorModelFit, limits: GatherLimits, progress: OnChunk | None
) -> _RunErrors:
    """Range errors of one run, chunk by chunk."""
    past = read_record(source.run)
    past.check_inputs()
    navigation, line, logs = open_inputs(past.inputs, past.options, past.config)
    references = read_reference(source.reference, tuple(past.inputs.logs), columns=source.columns)
    processor = processor_of(past.config.replaced(filter="off"), navigation, line.trajectories)
    state = State()
    base: CommonErrors | None = None
    if source.base:
        base = base_station_from_files(source.base, processor, position_ecef_m=source.base_position_ecef_m)
    parts: list[ErrorSamples] = []
    times: list[np.datetime64] = []
    epochs = processed = 0
    for chunk in aligned({name: log.parts() for name, log in logs.items()}):
        result, state = processor.process(chunk, state)
        for antenna, (name, positions) in enumerate(result.antennas.items()):
            if not len(positions):
                continue
            errors = range_errors(
                positions, line.trajectories[name], references[name], base, limits=limits, block_s=fit.block_s
            )
            # satellite passes of different runs and antennas are independent blocks
            offset = (2 * number + antenna) * 10**16
            parts.append(replace(errors.samples, block=errors.samples.block + offset))
            epochs += errors.epochs
            times += [positions.time[0], positions.time[-1]]
            processed += len(positions)
        if progress is not None:
            progress(str(source.run), processed)
    files = {str(path): file_sha256(path) for path in (source.reference, *source.base)}
    return _RunErrors(
        samples=tuple(parts),
        times=tuple(times),
        epochs=epochs,
        files=files | {entry["path"]: entry["sha256"] for entry in past.record["inputs"]},
        base="" if base is None else base.name,
        conditions=conditions_of(past.config),
    )

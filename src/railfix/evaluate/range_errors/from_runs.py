"""An error model from runs with references: positions once more, errors of the ranges, bins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from railfix import __version__
from railfix.core.arrays import Floats
from railfix.core.errors import MismatchError
from railfix.core.files import file_sha256
from railfix.evaluate.range_errors.base_station import BaseStation, base_station_from_files
from railfix.evaluate.range_errors.gather import GatherLimits, joined, range_errors
from railfix.io.reference_log import read_reference
from railfix.pipeline.processor import EpochProcessor, State, conditions_of
from railfix.ranges.error_model import ErrorModel, ErrorModelFit, ErrorModelSource, ErrorSamples, fit_bins
from railfix.run.chunks import aligned
from railfix.run.driver import open_inputs
from railfix.run.past import past_run

#: Told after each chunk: name of the run and epochs done in it.
Told = Callable[[str, int], None]


@dataclass(frozen=True, kw_only=True)
class ModelInputs:
    """One run that a model is made from.

    Attributes
    ----------
    run : Path
        Folder written by ``railfix run``.
    reference : Path
        Where its antennas were (`railfix.io.reference_log`).
    base : tuple of Path
        RINEX files of a nearby reference station; may be empty.
    base_position_ecef_m : ndarray, shape (3,), or None [m]
        Of the station, where its header is not good enough.
    """

    run: Path
    reference: Path
    base: tuple[Path, ...] = ()
    base_position_ecef_m: Floats | None = None


@dataclass(kw_only=True)
class _Gathered:
    samples: list[ErrorSamples] = field(default_factory=list)
    times: list[np.datetime64] = field(default_factory=list)
    epochs: int = 0
    files: dict[str, str] = field(default_factory=dict)
    bases: list[str] = field(default_factory=list)
    conditions: list[str] = field(default_factory=list)


def error_model_from_runs(
    inputs: Sequence[ModelInputs],
    *,
    fit: ErrorModelFit | None = None,
    limits: GatherLimits | None = None,
    progress: Told | None = None,
) -> tuple[ErrorModel, ErrorSamples]:
    """Errors of all runs' pseudoranges by bin, before and after the screens.

    Each run is positioned once more with the settings it was done with, so that the corrected codes,
    the satellites and the verdict of every screen are at hand.

    Parameters
    ----------
    inputs : sequence of ModelInputs
        All of them with a reference station, or none.
    fit : ErrorModelFit, optional
    limits : GatherLimits, optional
    progress : callable, optional

    Returns
    -------
    ErrorModel
    ErrorSamples
        What it was fitted to.

    Raises
    ------
    MismatchError
        Some runs have a reference station and others none, their screens differ, or no range has an error that
        can be told.
    RailfixError
        A file is not what it should be, or has changed since the run.
    """
    fit = fit or ErrorModelFit()
    with_base = {bool(one.base) for one in inputs}
    if len(with_base) != 1:
        raise MismatchError("give a reference station for every run or for none: their errors are of another kind")
    gathered = _Gathered()
    for number, one in enumerate(inputs):
        _gather(one, number, gathered, fit, limits or GatherLimits(), progress)
    samples = joined(gathered.samples) if gathered.samples else None
    if samples is None or not len(samples.error_m):
        raise MismatchError(
            "no pseudorange has an error that can be told; do run, reference and station belong together?"
        )
    if len(set(gathered.conditions)) > 1:
        told = " and ".join(sorted(set(gathered.conditions)))
        raise MismatchError(f"the runs were done under different conditions: {told}; make a model for each")
    model = ErrorModel(
        bins=fit.bins,
        before=fit_bins(samples, np.ones(len(samples.error_m), dtype=np.bool_), fit),
        after=fit_bins(samples, samples.used, fit),
        covers="local" if with_base.pop() else "satellite_and_atmosphere",
        source=ErrorModelSource(
            runs=tuple(str(one.run) for one in inputs),
            base=", ".join(dict.fromkeys(gathered.bases)),
            conditions=gathered.conditions[0],
            epochs=gathered.epochs,
            start=str(min(gathered.times)),
            end=str(max(gathered.times)),
            railfix_version=__version__,
            files=tuple(gathered.files.items()),
        ),
    )
    return model, samples


def _gather(
    one: ModelInputs, number: int, into: _Gathered, fit: ErrorModelFit, limits: GatherLimits, progress: Told | None
) -> None:
    """Errors of one run, chunk by chunk."""
    past = past_run(one.run)
    past.check_inputs()
    navigation, line, logs = open_inputs(past.inputs, past.options)
    references = read_reference(one.reference, tuple(past.inputs.logs))
    processor, state, done = EpochProcessor(past.config, navigation, line.trajectories), State(), 0
    base: BaseStation | None = None
    if one.base:
        base = base_station_from_files(one.base, processor, position_ecef_m=one.base_position_ecef_m)
        into.bases.append(base.name)
    into.conditions.append(conditions_of(past.config))
    for chunk in aligned({name: log.parts() for name, log in logs.items()}):
        result, state = processor.process(chunk, state)
        for antenna, (name, found) in enumerate(result.antennas.items()):
            if not len(found):
                continue
            errors = range_errors(
                found, line.trajectories[name], references[name], base, limits=limits, block_s=fit.block_s
            )
            samples = errors.samples
            # Passes of different runs and antennas are different ones.
            samples.block[:] += (2 * number + antenna) * 10**16
            into.samples.append(samples)
            into.epochs += errors.epochs
            into.times += [found.time[0], found.time[-1]]
            done += len(found)
        if progress is not None:
            progress(str(one.run), done)
    for path in (one.reference, *one.base):
        into.files[str(path)] = file_sha256(path)
    into.files |= {entry["path"]: entry["sha256"] for entry in past.record["inputs"]}

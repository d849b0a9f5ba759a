"""Pseudorange errors at a reference position, minus receiver clock and common errors (paper P1, section 7, fig. 14).

A nearby reference station measures the common errors. An error model is fitted to the errors of several runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import Field

from railfix import __version__
from railfix.core.arrays import Datetimes, Floats, Strings, join_rows
from railfix.core.errors import InputFileError, MismatchError
from railfix.core.files import Reader, file_sha256
from railfix.core.geodesy import range_with_rotation
from railfix.core.options import option
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.evaluate.place import bracket, interpolate_reference
from railfix.gnss.observations import Observations
from railfix.io.logs import scan_observations
from railfix.io.reference_log import AntennaReference, read_reference
from railfix.pipeline.base_station_stage import BaseStation
from railfix.pipeline.carrier_stage import CarrierState
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.range_stage import collect_conditions
from railfix.pipeline.results import AntennaResult
from railfix.positioning.receiver_noise import RobustClock, robust_clock
from railfix.ranges.channels import clock_groups
from railfix.ranges.error_conditions import Conditions, condition_differences
from railfix.ranges.error_model import ErrorModel, ErrorModelSource
from railfix.ranges.error_model_fit import ErrorModelFit, ErrorSamples, fault_rate, faulty_stretches, fit_bins
from railfix.run.driver import open_inputs
from railfix.run.inputs import ColumnNames, input_option
from railfix.run.processor_setup import make_processor
from railfix.run.record import read_record
from railfix.run.sources import align_logs
from railfix.track.trajectory import Trajectory

__all__ = [
    "ModelInputs", "RangeErrors", "RobustClock", "StationBeside", "StationErrors", "base_station",
    "base_station_from_files", "error_model_from_runs", "range_errors", "robust_clock",
]  # fmt: skip

#: Rejection reasons of observations without a range error: no pseudorange, no ephemeris, or no correction.
NO_RANGE: Final = (
    Reason.NOT_OBSERVED
    | Reason.IMPLAUSIBLE_CODE
    | Reason.SYSTEM_NOT_SELECTED
    | Reason.OTHER_SIGNAL_TAKEN
    | Reason.EXCLUDED_BY_SETTING
    | Reason.NO_EPHEMERIS
    | Reason.EPHEMERIS_TOO_OLD
    | Reason.UNHEALTHY
    | Reason.NO_CORRECTION
    | Reason.SBAS_NOT_COVERED
    | Reason.SBAS_NO_CORRECTION
    | Reason.SBAS_TIMED_OUT
    | Reason.SBAS_DO_NOT_USE
    | Reason.SBAS_NO_IONOSPHERE
)

#: Reference positions with a larger standard deviation are not used [m].
_LARGEST_REFERENCE_SIGMA_M: Final = 0.5
#: The reference trajectory is not interpolated in gaps longer than this time [s].
_LARGEST_REFERENCE_GAP_S: Final = 2.5
#: Range errors of the reference station are not interpolated in gaps of its log longer than this time [s].
_LARGEST_BASE_GAP_S: Final = 35.0
#: The receiver clock is estimated only from constellations with at least this number of ranges after the screens.
_LEAST_RANGES: Final = 4


@dataclass(frozen=True, kw_only=True)
class StationErrors:
    """Range errors that a reference station shares with nearby receivers, at B epochs for S satellites."""

    name: str
    time: Datetimes  #: Time of each epoch, shape (B,).
    satellite: Strings  #: Names of the satellites, shape (S,).
    #: Corrected pseudorange minus geometric range and receiver clock offset; NaN where not observed; shape (B, S).
    error_m: Floats
    smoothed: bool  #: Whether the pseudoranges were smoothed by carrier phase.

    def at(self, time: Datetimes, satellite: Strings, *, largest_gap_s: float) -> Floats:
        """Interpolate the errors of K satellites linearly to T times, shape (T, K) [m].

        The result is NaN for satellites that the station did not observe, outside the station's log, and in gaps longer
        than `largest_gap_s`.
        """
        column = {name: i for i, name in enumerate(self.satellite.tolist())}
        known = [k for k, name in enumerate(satellite.tolist()) if name in column]
        result = np.full((len(time), len(satellite)), np.nan)
        if len(self.time) > 1:
            chosen = self.error_m[:, [column[str(name)] for name in satellite[known]]]
            result[:, known] = bracket(time, self.time, largest_gap_s=largest_gap_s).of(chosen)
        return result


def base_station(
    parts: Iterable[Observations], processor: EpochProcessor, position_ecef_m: Floats, *, name: str
) -> StationErrors:
    """Compute common range errors from the log of a station at a known position.

    Pseudoranges are corrected with the navigation and settings of `processor` and smoothed by carrier phase. The
    multipath of the station remains in the errors.
    """
    station, carrier, phases = BaseStation(processor.config, position_ecef_m), CarrierState(), False
    times: list[Datetimes] = []
    errors: list[dict[str, Floats]] = []
    for obs in parts:
        measured, carrier = station.errors(obs, processor.received, carrier, position_ecef_m)
        phases |= bool(np.isfinite(obs.phase_cycles).any())
        of_satellite: dict[str, Floats] = {}
        for k, satellite in enumerate(measured.satellite.tolist()):
            error, before = measured.code_m[:, k], of_satellite.get(satellite)
            of_satellite[satellite] = error if before is None else np.where(np.isnan(before), error, before)
        times.append(obs.time)
        errors.append(of_satellite)
    names = sorted({satellite for part in errors for satellite in part})
    blank = [np.full(len(time), np.nan) for time in times]
    table = [
        np.stack([part.get(satellite, empty) for satellite in names], axis=1)
        for part, empty in zip(errors, blank, strict=True)
        if names
    ]
    return StationErrors(
        name=name,
        time=np.concatenate(times) if times else np.empty(0, dtype="datetime64[ns]"),
        satellite=np.array(names, dtype=np.str_),
        error_m=np.concatenate(table) if table else np.empty((0, 0)),
        smoothed=phases,
    )


def base_station_from_files(
    paths: Sequence[Path],
    processor: EpochProcessor,
    *,
    position_ecef_m: Floats | None = None,
    reader: Reader = "railfix",
) -> StationErrors:
    """Compute common range errors from the RINEX files of a station, by default at the position stated in their header.

    Raise InputFileError if no position is known, or no range error of any satellite can be computed.
    """
    parts = list(scan_observations(paths, epochs=20_000, reader=reader))
    place = position_ecef_m if position_ecef_m is not None else parts[0].header.approximate_ecef_m
    if place is None or not np.isfinite(place).all() or np.linalg.norm(place) < 1e6:
        raise InputFileError(paths[0], "its header has no position; give the station's position (--base-position)")
    station = base_station(parts, processor, np.asarray(place), name=parts[0].header.marker or paths[0].name)
    if not np.isfinite(station.error_m).any():
        raise InputFileError(paths[0], "gives no range error of any satellite; give a navigation file of the same day")
    return station


@dataclass(frozen=True, kw_only=True)
class RangeErrors:
    """Errors of n pseudoranges, with their times and satellites."""

    samples: ErrorSamples
    time: Datetimes  #: Time of each error, shape (n,).
    satellite: Strings  #: Satellite of each error, shape (n,).
    epochs: int  #: Number of epochs that have a reference position.


def range_errors(
    result: AntennaResult,
    trajectory: Trajectory,
    reference: AntennaReference,
    base: StationErrors | None = None,
    *,
    block_s: float = 30.0,
) -> RangeErrors:
    """Compute the pseudorange errors of one antenna in one chunk of T epochs; `block_s` is the length of a block [s].

    The clock of each constellation is the robust mean of the residuals that passed the screens. Each range contributes
    to the clock that is subtracted from it, so that its residual becomes too small. The factor ``1 / sqrt(1 - share)``
    compensates for this; `share` is the weight of the range in the clock. An error common to all satellites is absorbed
    by the clock and does not affect the position. Without `base`, the satellite and atmospheric errors remain.

    Raise MismatchError if fewer than two reference positions have a sufficiently small sigma.
    """
    corrected = result.corrected
    good = ~(reference.sigma_m > _LARGEST_REFERENCE_SIGMA_M)
    if np.count_nonzero(good) < 2:
        raise MismatchError(
            f"fewer than two of the {len(good)} reference positions have a sigma of "
            f"{_LARGEST_REFERENCE_SIGMA_M:g} m or less; a more accurate reference is needed"
        )
    place = interpolate_reference(
        result.time, reference.time[good], reference.ecef_m[good], largest_gap_s=_LARGEST_REFERENCE_GAP_S
    )
    distance, _ = range_with_rotation(corrected.satellites.position_ecef_m, place[:, None, :])
    reason, satellite = corrected.reason, corrected.satellite
    residual = np.where((reason & NO_RANGE) == 0, corrected.corrected_code_m - distance, np.nan)
    if base is not None:
        residual = residual - base.at(result.time, satellite, largest_gap_s=_LARGEST_BASE_GAP_S)
    used = (reason == Reason.USED) & np.isfinite(residual)
    # Screens may keep a suspected range with an increased sigma; the model is fitted without such ranges.
    for name in ("doppler", "antenna_pair"):
        if name in result.screens:
            used &= ~result.screens[name].reject
    groups = clock_groups(satellite.astype("<U1"))
    clock = robust_clock(np.where(used, residual, np.nan), corrected.sigma_m, groups, least_ranges=_LEAST_RANGES)
    widths = [group.stop - group.start for group in groups]
    error = (residual - np.repeat(clock.clock_m, widths, axis=1)) / np.sqrt(1.0 - clock.share)
    arc, _ = trajectory.nearest(place)
    turned = corrected.azimuth_deg - trajectory.body_azimuth_deg(arc)[:, None]
    epoch, channel = np.nonzero(np.isfinite(error) & (corrected.elevation_deg > 0.0))
    numbers = np.array([ord(name[0]) * 1000 + int(name[1:]) for name in satellite.tolist()], dtype=np.int64)
    time_block = (seconds(result.time - np.datetime64("2000-01-01T00:00:00", "ns")) // block_s).astype(np.int64)
    return RangeErrors(
        samples=ErrorSamples(
            error_m=error[epoch, channel],
            elevation_deg=corrected.elevation_deg[epoch, channel],
            relative_azimuth_deg=turned[epoch, channel] % 360.0,
            cn0_dbhz=corrected.cn0_dbhz[epoch, channel],
            block=time_block[epoch] * 1_000_000 + numbers[channel],
            used=used[epoch, channel],
            sigma_m=_level_sigma_m(result)[epoch, channel],
            chainage_m=trajectory.chainage_at(trajectory.nearest(place[epoch])[0]),
        ),
        time=result.time[epoch],
        satellite=satellite[channel],
        epochs=int(np.isfinite(place[:, 0]).sum()),
    )


def _level_sigma_m(result: AntennaResult) -> Floats:
    """Return the standard deviation that the run's protection level assumes for each range, shape (T, K) [m]."""
    stated = result.corrected.sigma_m * np.maximum(result.noise_scale, 1.0)[:, None]
    return np.asarray(np.fmax(stated, result.corrected.bound_sigma_m))


class StationBeside(Settings):
    """Options of the command line for the reference positions of the runs and a reference station."""

    reference: tuple[Path, ...] = input_option(
        "File of reference positions; repeat the option for each RUN in order.", metavar="FILE"
    )
    base: tuple[Path, ...] = input_option(
        "RINEX observations of a nearby reference station during all RUNs; may be repeated.",
        (),
        metavar="OBS",
    )
    base_position: str | None = option(
        "Position of the station; by default from its file header.", None, metavar="LAT,LON,HEIGHT"
    )
    columns: ColumnNames = Field(default_factory=ColumnNames)


@dataclass(frozen=True, kw_only=True)
class ModelInputs:
    """Run with its reference trajectory and, optionally, the log of a reference station."""

    run: Path  #: Folder written by ``railfix run``.
    reference: Path  #: Reference trajectory of the antennas (`railfix.io.reference_log`).
    base: tuple[Path, ...] = ()  #: RINEX files of a nearby reference station; may be empty.
    #: Position of the station, ECEF, shape (3,) [m]; None for the position in the header of the station's first file.
    base_position_ecef_m: Floats | None = None
    columns: ColumnNames = field(default_factory=ColumnNames)  #: Options for reading the reference.


@dataclass(frozen=True, kw_only=True)
class _RunErrors:
    """Range errors of one run, with the information on their source for the model file."""

    samples: tuple[ErrorSamples, ...]
    times: tuple[np.datetime64, ...]
    epochs: int
    files: Mapping[str, str]
    base: str
    conditions: Conditions


def error_model_from_runs(
    inputs: Sequence[ModelInputs], *, fit: ErrorModelFit | None = None
) -> tuple[ErrorModel, ErrorSamples]:
    """Fit an error model to the pseudorange errors of several runs, before and after the screens.

    Return the model and the samples to which it was fitted. Each run is processed again with its own settings to obtain
    corrected pseudoranges, satellite positions and the result of every screen.

    Raise MismatchError if only some of the runs have a reference station, the conditions of the runs differ, no
    range error can be computed, or a file has changed since the run.
    """
    fit = fit or ErrorModelFit()
    with_base = {bool(source.base) for source in inputs}
    if len(with_base) != 1:
        raise MismatchError(
            "give a reference station for every run or for none; errors with and without a station cannot be combined"
        )
    runs = [_run_errors(source, number, fit) for number, source in enumerate(inputs)]
    parts = [samples for run in runs for samples in run.samples]
    if not any(len(part.error_m) for part in parts):
        raise MismatchError("no pseudorange error could be computed; give a reference and station log of the run")
    samples = join_rows(parts)
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


def _run_errors(source: ModelInputs, number: int, fit: ErrorModelFit) -> _RunErrors:
    """Compute the range errors of one run by processing it again, chunk by chunk; the run's `number` makes its block
    numbers differ from those of other runs.
    """
    past = read_record(source.run)
    past.check_inputs()
    navigation, line, logs = open_inputs(past.inputs, past.options, past.config)
    references = read_reference(source.reference, tuple(past.inputs.logs), **source.columns.arguments)
    processor = make_processor(past.config.replaced(filter="off"), navigation, line.trajectories)
    state = State()
    base: StationErrors | None = None
    if source.base:
        base = base_station_from_files(
            source.base, processor, position_ecef_m=source.base_position_ecef_m, reader=past.options.logs.reader
        )
    parts: list[ErrorSamples] = []
    times: list[np.datetime64] = []
    epochs = 0
    for chunk in align_logs({name: log.parts() for name, log in logs.items()}):
        result, state = processor.process(chunk, state)
        for antenna, (name, positions) in enumerate(result.antennas.items()):
            if not len(positions):
                continue
            errors = range_errors(positions, line.trajectories[name], references[name], base, block_s=fit.block_s)
            # blocks of different runs and antennas must have different numbers
            offset = (2 * number + antenna) * 10**16
            parts.append(replace(errors.samples, block=errors.samples.block + offset))
            epochs += errors.epochs
            times += [positions.time[0], positions.time[-1]]
    files = {str(path): file_sha256(path) for path in (source.reference, *source.base)}
    return _RunErrors(
        samples=tuple(parts),
        times=tuple(times),
        epochs=epochs,
        files=files | {entry["path"]: entry["sha256"] for entry in past.record["inputs"]},
        base="" if base is None else base.name,
        conditions=collect_conditions(past.config),
    )

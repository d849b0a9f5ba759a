"""Fit of a C/N0 curve to an observation log of an antenna under open sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from railfix import __version__
from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import BrokenLines, Reader, file_sha256
from railfix.core.geodesy import elevation_azimuth
from railfix.core.timescale import seconds
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import ObservationHeader, Observations
from railfix.gnss.orbits import satellite_states
from railfix.io.logs import read_navigation, scan_observations
from railfix.ranges.cn0_curve import KINDS, Cn0Curve, Cn0CurveSource, SourceFile
from railfix.ranges.cn0_curve_fit import Cn0Samples, CurveFit, fit_cn0_curve

_SHORT_S: Final = 12 * 3600.0  #: A log shorter than this causes a note [s]; P1 2.3(1) requires about a day.
_DEFICIT_DBHZ: Final = 10.0  #: P1 (table 6) rejects a signal whose C/N0 is lower than the mean by more than this [dB].
#: Of the samples at elevations above the first value [deg], at most the second value (a fraction) may be more than
#: `_DEFICIT_DBHZ` below the curve; if there are more, a note is issued.
_CHECKED_FROM_DEG, _REJECTED_SHARE = 15.0, 0.01
#: A tracked satellite below this elevation [deg] indicates a wrong antenna position.
_BELOW_DEG: Final = -5.0
_BELOW_SHARE: Final = 0.05  #: A larger fraction of samples below `_BELOW_DEG` is an error.


@dataclass(frozen=True, kw_only=True)
class Cn0Calibration:
    """C/N0 curve with the samples to which it was fitted."""

    curve: Cn0Curve
    samples: Cn0Samples
    notes: tuple[str, ...]


def satellite_elevation_deg(observations: Observations, navigation: Navigation, position_ecef_m: Floats) -> Floats:
    """Return the elevation of satellites seen from a fixed position (3,), shape (T, M) [deg]; NaN if orbit or code is
    missing.
    """
    names, first, which = np.unique(observations.satellite, return_index=True, return_inverse=True)
    code = np.full((len(observations), len(names)), np.nan)
    for m, k in enumerate(which.tolist()):
        code[:, k] = np.where(np.isnan(code[:, k]), observations.code_m[:, m], code[:, k])
    states = satellite_states(observations.time, names, observations.signal[first], code, navigation)
    place = np.broadcast_to(position_ecef_m, (len(observations), 3))
    elevation, _ = elevation_azimuth(states.position_ecef_m, place)
    return elevation[:, which]


def cn0_curve_from_log(
    observations: Sequence[Path],
    navigation: Sequence[Path],
    *,
    position_ecef_m: Floats | None = None,
    fit: CurveFit | None = None,
    broken_lines: BrokenLines = "stop",
    reader: Reader = "railfix",
    date: np.datetime64 | None = None,
) -> Cn0Calibration:
    """Fit a curve to a receiver log of about a day, recorded with an antenna under open sky.

    `position_ecef_m`, shape (3,), is the antenna position (an accuracy of kilometres suffices); by default, the
    position in the header is used. Raises InputFileError if a file is missing or of another kind, or if the log has no
    epochs or no C/N0; SettingsError if neither the header nor the caller provides a position; MismatchError if tracked
    satellites are below the horizon at the position, the navigation files have no orbit for the log, or there are too
    few samples for any curve.
    """
    records = read_navigation(list(navigation), broken_lines=broken_lines, date=date)
    samples, seen, below = Cn0Samples(), 0, 0
    header: ObservationHeader | None = None
    start, end, epochs = np.datetime64("NaT", "ns"), np.datetime64("NaT", "ns"), 0
    for part in scan_observations(list(observations), broken_lines=broken_lines, reader=reader, date=date):
        if header is None:
            header, start = part.header, part.time[0]
            place = header.approximate_ecef_m if position_ecef_m is None else position_ecef_m
            if not np.isfinite(place).all():
                what = "the header has no position (APPROX POSITION XYZ); give it with --position"
                raise SettingsError(f"{observations[0]}: {what}")
        end, epochs = part.time[-1], epochs + len(part)
        elevation = satellite_elevation_deg(part, records, place)
        seen += int(np.count_nonzero(np.isfinite(elevation)))
        below += int(np.count_nonzero(elevation < _BELOW_DEG))
        samples.add(part.cn0_dbhz, elevation, part.satellite, part.signal)
    if header is None:
        raise InputFileError(observations[0], "has no epochs")
    if not seen:
        raise MismatchError(
            f"{observations[0]}: the navigation files have no orbit for any satellite and time of this log"
        )
    if below > _BELOW_SHARE * seen:
        raise MismatchError(
            f"{observations[0]}: {100.0 * below / seen:.0f} % of the tracked satellites are below the horizon "
            "at this position; give the position of the antenna, or the navigation files of this day"
        )
    if not samples.keys():
        raise InputFileError(observations[0], "has no C/N0 (S1C, S2I, ...); enable it in the RINEX output")
    source = Cn0CurveSource(
        antenna=header.antenna,
        receiver=header.receiver,
        marker=header.marker,
        start=str(start),
        end=str(end),
        epochs=epochs,
        position_ecef_m=tuple(place.tolist()),
        railfix_version=__version__,
        file=tuple(SourceFile(name=p.name, sha256=file_sha256(p)) for p in (*observations, *navigation)),
    )
    try:
        curve = fit_cn0_curve(samples, fit=fit, source=source)
    except ValueError as error:
        raise MismatchError(f"{observations[0]}: {error}; give a longer log") from None
    return Cn0Calibration(curve=curve, samples=samples, notes=_notes(curve, samples, float(seconds(end - start))))


def _notes(curve: Cn0Curve, samples: Cn0Samples, duration_s: float) -> tuple[str, ...]:
    notes = []
    if duration_s < _SHORT_S:
        notes.append(
            f"the log is {duration_s / 3600.0:.1f} h long; about a day is required to cover all elevations and azimuths"
        )
    fitted = {(mean.kind, mean.signal) for mean in curve.means}
    without = [f"{KINDS.get(kind, kind)} {signal}" for kind, signal in samples.keys() if (kind, signal) not in fitted]  # noqa: SIM118
    if without:
        notes.append(f"no curve, because too few elevation bins have enough samples: {', '.join(without)}")
    for mean in curve.means:
        elevation, cn0 = samples.of(mean.kind, mean.signal)
        high = elevation >= _CHECKED_FROM_DEG
        rejected = np.count_nonzero(mean.at(elevation[high]) - cn0[high] > _DEFICIT_DBHZ)
        if rejected > _REJECTED_SHARE * np.count_nonzero(high):
            share = 100.0 * rejected / np.count_nonzero(high)
            notes.append(
                f"{KINDS.get(mean.kind, mean.kind)} {mean.signal}: {share:.1f} % of the open-sky samples lie more than "
                f"{_DEFICIT_DBHZ:g} dB below the mean; these satellites differ in power, or the sky is obstructed"
            )
    return tuple(notes)

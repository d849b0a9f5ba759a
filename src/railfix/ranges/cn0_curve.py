"""Mean C/N0 over elevation of one antenna and receiver, from a day of open sky (P1 2.3(1), figure 3).

It is fitted per constellation and signal; BeiDou and QZSS satellites are in two kinds of orbits with separate curves.
The mean of each elevation bin excludes outliers (beyond three robust standard deviations from the median). Between the
middles of the bins the curve runs by monotone cubic interpolation (PCHIP). Above the highest bin the last mean is used;
below the lowest bin there is no curve. The file is TOML.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator

from railfix.core.arrays import Floats, Integers, Masks, Strings, read_only
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath
from railfix.core.settings import Settings, read_model_file, write_toml
from railfix.gnss.observations import ObservationHeader

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

__all__ = [
    "KINDS",
    "Cn0Curve",
    "Cn0CurveSource",
    "Cn0Mean",
    "Cn0Samples",
    "CurveFit",
    "SourceFile",
    "fit_cn0_curve",
    "read_cn0_curve",
    "satellite_kind",
    "write_cn0_curve",
]


#: Standard deviation of a normal variable against its median absolute deviation.
_NORMAL_MAD: Final = 1.482_602_218_505_602
#: Numbers of BeiDou satellites 36 000 km above (GEO C01-C05, C59-C63; IGSO: CSNO, constellation status).
_BEIDOU_HIGH: Final = frozenset({*range(1, 11), 13, 16, 31, 38, 39, 40, 56, *range(59, 64)})
_QZSS_GEO: Final = frozenset({7, 8})  #: Numbers of the geostationary QZSS satellites (IS-QZSS-PNT: PRN 199, 200).

#: Kinds of satellites with equal transmit power, and their names.
KINDS: Final[dict[str, str]] = {
    "G": "GPS",
    "J": "QZSS",
    "J-GEO": "QZSS GEO",
    "E": "Galileo",
    "C": "BeiDou MEO",
    "C-HIGH": "BeiDou GEO, IGSO",
    "R": "GLONASS",
    "S": "SBAS",
    "I": "NavIC",
}


def satellite_kind(satellite: str) -> str:
    """Return the kind of a satellite, a key of `KINDS`: "C05" -> "C-HIGH", "G05" -> "G"."""
    letter, number = satellite[0], int(satellite[1:])
    if letter == "C" and number in _BEIDOU_HIGH:
        return "C-HIGH"
    if letter == "J" and number in _QZSS_GEO:
        return "J-GEO"
    return letter


class CurveFit(Settings):
    """Settings of the fit of a curve."""

    bin_deg: float = Field(default=5.0, ge=0.1, le=30.0)  #: Width of the bins of elevation.
    least_samples: int = Field(default=30, ge=1)  #: A bin of fewer samples is left out.
    least_bins: int = Field(default=4, ge=2)  #: A kind and signal of fewer bins gets no curve.
    #: Samples farther from their bin's median, in robust standard deviations, are left out.
    clip_sigma: float = Field(default=3.0, gt=0.0)


@dataclass(frozen=True, kw_only=True)
class Cn0Mean:
    """Mean C/N0 over elevation of one kind of satellites on one signal, B bins."""

    kind: str  #: Key of `KINDS`.
    signal: str
    elevation_deg: Floats  #: Middles of the bins, rising; shape (B,).
    #: Mean and robust standard deviation, shape (B,) [dB-Hz] [dB].
    mean_dbhz: Floats
    spread_db: Floats
    count: Integers  #: Samples of each bin, shape (B,).

    def __post_init__(self) -> None:
        for name in ("elevation_deg", "mean_dbhz", "spread_db", "count"):
            values = getattr(self, name)
            if values.shape != self.elevation_deg.shape or values.ndim != 1 or not np.isfinite(values).all():
                raise ValueError(f"{name} must be finite, one number a bin")
            object.__setattr__(self, name, read_only(values))
        if len(self.elevation_deg) < 2 or not (np.diff(self.elevation_deg) > 0.0).all():
            raise ValueError("elevation_deg must rise, over at least two bins")

    @cached_property
    def _interpolate(self) -> PchipInterpolator:
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.elevation_deg, self.mean_dbhz)

    def at(self, elevation_deg: ArrayLike) -> Floats:
        """Return the mean C/N0 at elevations [dB-Hz]; NaN below the lowest bin's lower half and for NaN."""
        elevation = np.asarray(elevation_deg, dtype=np.float64)
        lowest, highest = self.elevation_deg[0], self.elevation_deg[-1]
        half = (self.elevation_deg[1] - lowest) / 2.0
        inside = np.where(elevation >= lowest - half, np.clip(elevation, lowest, highest), np.nan)
        return np.asarray(self._interpolate(inside), dtype=np.float64)


class SourceFile(Settings):
    """A file that a curve was fitted on, and its SHA-256."""

    name: str
    sha256: str


class Cn0CurveSource(Settings):
    """Log that a curve was fitted on."""

    #: From the header of the log, as written.
    antenna: str = ""
    receiver: str = ""
    marker: str = ""
    #: First and last epoch used, ISO 8601, GPS time.
    start: str = ""
    end: str = ""

    epochs: int = Field(default=0, ge=0, strict=True)
    position_ecef_m: tuple[float, ...] = ()  #: Position of the antenna.
    railfix_version: str = ""
    file: tuple[SourceFile, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Cn0Curve:
    """Mean C/N0 over elevation of an antenna and receiver."""

    means: tuple[Cn0Mean, ...]  #: One a kind and signal.
    source: Cn0CurveSource = field(default_factory=Cn0CurveSource)

    def __post_init__(self) -> None:
        if len(self._by_key) != len(self.means):
            raise ValueError("a kind and signal has two curves")

    @cached_property
    def _by_key(self) -> dict[tuple[str, str], Cn0Mean]:
        return {(mean.kind, mean.signal): mean for mean in self.means}

    def _find(self, satellite: Strings, signal: Strings) -> list[Cn0Mean | None]:
        pairs = zip(satellite.tolist(), signal.tolist(), strict=True)
        return [self._by_key.get((satellite_kind(name), code)) for name, code in pairs]

    def covers(self, satellite: Strings, signal: Strings) -> Masks:
        """Return whether there is a curve for each channel, shape (M,)."""
        return np.array([mean is not None for mean in self._find(satellite, signal)], dtype=bool)

    def mean_dbhz(self, elevation_deg: ArrayLike, *, satellite: Strings, signal: Strings) -> Floats:
        """Return the mean C/N0 of channels at their elevations, shape (T, M) [dB-Hz]; NaN without a curve."""
        elevation = np.asarray(elevation_deg, dtype=np.float64)
        result = np.full(elevation.shape, np.nan)
        columns: dict[tuple[str, str], list[int]] = defaultdict(list)
        for m, mean in enumerate(self._find(satellite, signal)):
            if mean is not None:
                columns[mean.kind, mean.signal].append(m)
        for key, at in columns.items():
            result[:, at] = self._by_key[key].at(elevation[:, at])
        return result

    def notes_for(self, header: ObservationHeader) -> tuple[str, ...]:
        """Return differences of antenna and receiver between the log of the curve and another, one sentence each."""
        notes = []
        for what in ("antenna", "receiver"):
            ours, theirs = _plain(getattr(self.source, what)), _plain(getattr(header, what))
            if ours != theirs:
                notes.append(
                    f"C/N0 curve was made with {what} '{ours or 'not named'}', "
                    f"this log has '{theirs or 'not named'}': the limits may not fit"
                )
        return tuple(notes)


def _plain(text: str) -> str:
    """Type of an antenna or receiver with its blanks evened out."""
    return " ".join(text.split())


class Cn0Samples:
    """C/N0 and elevation collected piece by piece, by kind and signal, in single precision."""

    def __init__(self) -> None:
        self._parts: dict[tuple[str, str], list[NDArray[np.float32]]] = defaultdict(list)

    def add(self, cn0_dbhz: ArrayLike, elevation_deg: ArrayLike, satellite: Strings, signal: Strings) -> None:
        """Add samples of shape (T, M); those with NaN in either are left out."""
        cn0, elevation = np.asarray(cn0_dbhz), np.asarray(elevation_deg)
        finite = np.isfinite(cn0) & np.isfinite(elevation) & (elevation >= 0.0)
        for m, (name, code) in enumerate(zip(satellite.tolist(), signal.tolist(), strict=True)):
            rows = finite[:, m]
            if rows.any():
                pair = np.stack([elevation[rows, m], cn0[rows, m]]).astype(np.float32)
                self._parts[satellite_kind(name), code].append(pair)

    def keys(self) -> list[tuple[str, str]]:
        """Kinds and signals of which there are samples."""
        return sorted(self._parts)

    def of(self, kind: str, signal: str) -> tuple[Floats, Floats]:
        """Return the elevation [deg] and C/N0 [dB-Hz] of one kind and signal."""
        joined = np.concatenate(self._parts[kind, signal], axis=1).astype(np.float64)
        return joined[0], joined[1]


def fit_cn0_curve(
    samples: Cn0Samples | Iterable[tuple[ArrayLike, ArrayLike, Strings, Strings]],
    *,
    fit: CurveFit | None = None,
    source: Cn0CurveSource | None = None,
) -> Cn0Curve:
    """Fit the mean C/N0 over elevation, one curve a kind and signal with bins enough.

    `samples` are collected ones, or C/N0 (T, M), elevation (T, M), satellite and signal (M,), from a position with open
    sky. ValueError: no kind and signal has samples enough.
    """
    fit = fit or CurveFit()
    if not isinstance(samples, Cn0Samples):
        collected = Cn0Samples()
        for part in samples:
            collected.add(*part)
        samples = collected
    means = [_fit_mean(key, *samples.of(*key), fit) for key in samples.keys()]  # noqa: SIM118 (no mapping)
    fitted = tuple(mean for mean in means if mean is not None)
    if not fitted:
        raise ValueError(
            f"no constellation and signal has {fit.least_bins} bins of {fit.least_samples} samples over elevation"
        )
    return Cn0Curve(means=fitted, source=source or Cn0CurveSource())


def _fit_mean(key: tuple[str, str], elevation: Floats, cn0: Floats, fit: CurveFit) -> Cn0Mean | None:
    """Return the curve of one kind and signal, None with too few bins."""
    which = np.minimum(elevation // fit.bin_deg, np.ceil(90.0 / fit.bin_deg) - 1.0).astype(np.int64)
    bins = [b for b in np.unique(which).tolist() if np.count_nonzero(which == b) >= fit.least_samples]
    if len(bins) < fit.least_bins:
        return None
    rows = [_robust(cn0[which == b], fit.clip_sigma) for b in bins]
    return Cn0Mean(
        kind=key[0],
        signal=key[1],
        elevation_deg=(np.array(bins, dtype=np.float64) + 0.5) * fit.bin_deg,
        mean_dbhz=np.array([row[0] for row in rows]),
        spread_db=np.array([row[1] for row in rows]),
        count=np.array([np.count_nonzero(which == b) for b in bins], dtype=np.int64),
    )


def _robust(values: Floats, clip_sigma: float) -> tuple[float, float]:
    """Return the mean without outliers, and robust standard deviation."""
    middle = float(np.median(values))
    spread = _NORMAL_MAD * float(np.median(np.abs(values - middle)))
    # C/N0 is reported in steps of up to 1 dB-Hz, so that the spread of a few samples may vanish
    kept = values[np.abs(values - middle) <= clip_sigma * max(spread, 0.5)]
    return float(kept.mean()), spread


FORMAT: Final = "railfix C/N0 curve 1"
#: Columns of a curve, and the digits that they are written with.
_DIGITS: Final = {"elevation_deg": 3, "mean_dbhz": 2, "spread_db": 2, "count": 0}


def _number(low: float, high: float) -> object:
    return Field(ge=low, le=high, strict=True, allow_inf_nan=False)


class _Curve(Settings):
    """`Cn0Mean` as columns."""

    kind: str
    signal: str = Field(min_length=2, max_length=2)
    elevation_deg: tuple[Annotated[float, _number(0.0, 90.0)], ...]
    mean_dbhz: tuple[Annotated[float, _number(0.0, 100.0)], ...]
    spread_db: tuple[Annotated[float, _number(0.0, 50.0)], ...]
    count: tuple[Annotated[int, Field(ge=1, strict=True)], ...]

    @field_validator("kind")
    @classmethod
    def _known_kind(cls, value: str) -> str:
        if value not in KINDS:
            raise ValueError(f"one of {', '.join(KINDS)} was expected")
        return value


class _CurveFile(Settings):
    """Content of the file."""

    format: Literal["railfix C/N0 curve 1"]
    source: Cn0CurveSource
    curve: tuple[_Curve, ...] = Field(min_length=1)


def write_cn0_curve(curve: Cn0Curve, path: FilePath) -> None:
    """Write a curve; the file appears whole or not at all. OutputError: it cannot be written."""
    curves = [
        {
            "kind": mean.kind,
            "signal": mean.signal,
            **{name: np.round(getattr(mean, name), digits).tolist() for name, digits in _DIGITS.items()},
        }
        for mean in curve.means
    ]
    comment = "Mean C/N0 over elevation, measured under open sky; belongs to this antenna and receiver only."
    source = {**curve.source.model_dump(), "position_ecef_m": np.round(curve.source.position_ecef_m, 3).tolist()}
    values = {"format": FORMAT, "source": source, "curve": curves}
    write_toml(path, values, what="curve", comment=comment)


def read_cn0_curve(path: FilePath) -> Cn0Curve:
    """Read a curve.

    InputFileError: the file is missing, unreadable, no curve, or an entry of it is unknown, missing or out of range.
    """
    file = read_model_file(_CurveFile, path, what="a C/N0 curve", format_name=FORMAT, command="railfix cn0-curve")
    means = tuple(
        _mean(path, curve, f"curve {i + 1} ({curve.kind} {curve.signal})") for i, curve in enumerate(file.curve)
    )
    try:
        return Cn0Curve(means=means, source=file.source)
    except ValueError as error:
        raise InputFileError(path, f"{error}; each kind and signal stands once") from None


def _mean(path: FilePath, curve: _Curve, where: str) -> Cn0Mean:
    columns = {name: np.array(getattr(curve, name)) for name in _DIGITS}
    if len({len(values) for values in columns.values()}) != 1:
        raise InputFileError(path, f"{where}: {', '.join(_DIGITS)} must have the same number of values")
    try:
        return Cn0Mean(kind=curve.kind, signal=curve.signal, **columns)
    except ValueError as error:
        raise InputFileError(path, f"{where}: {error}") from None

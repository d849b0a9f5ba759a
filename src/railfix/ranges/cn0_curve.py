"""Mean C/N0 as a function of elevation, for one antenna and receiver, from a day under open sky (P1 2.3(1), figure 3).

A curve is fitted for each constellation and signal. BeiDou and QZSS have satellites in two kinds of orbits; each kind
has its own curve. The mean of each elevation bin excludes outliers (beyond three robust standard deviations from the
median). Between bin centres the curve is interpolated by monotone cubics (PCHIP). Above the highest bin the last mean
is used; below the lowest bin there is no curve. Curves are stored in TOML files.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.arrays import Floats, Integers, Masks, Strings, read_only
from railfix.core.settings import Settings
from railfix.gnss.observations import ObservationHeader

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

__all__ = ["KINDS", "Cn0Curve", "Cn0CurveSource", "Cn0Mean", "SourceFile", "satellite_kind"]


#: Numbers of the BeiDou GEO (C01-C05, C59-C63) and IGSO satellites, 36 000 km high (CSNO, constellation status).
_BEIDOU_HIGH: Final = frozenset({*range(1, 11), 13, 16, 31, 38, 39, 40, 56, *range(59, 64)})
_QZSS_GEO: Final = frozenset({7, 8})  #: Numbers of the geostationary QZSS satellites (IS-QZSS-PNT: PRN 199, 200).

#: Satellite kinds and their names. The satellites of a kind are assumed to transmit with equal power.
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


@dataclass(frozen=True, kw_only=True)
class Cn0Mean:
    """Mean C/N0 in B elevation bins, for one signal and one kind of satellites."""

    kind: str  #: Kind of the satellites, a key of `KINDS`.
    signal: str
    elevation_deg: Floats  #: Bin centres in ascending order, shape (B,).
    mean_dbhz: Floats  #: Mean C/N0 per bin, shape (B,).
    spread_db: Floats  #: Robust standard deviation of the C/N0 per bin, shape (B,).
    count: Integers  #: Number of samples per bin, shape (B,).

    def __post_init__(self) -> None:
        for name in ("elevation_deg", "mean_dbhz", "spread_db", "count"):
            values = getattr(self, name)
            if values.shape != self.elevation_deg.shape or values.ndim != 1 or not np.isfinite(values).all():
                raise ValueError(f"{name} must have one finite number per bin")
            object.__setattr__(self, name, read_only(values))
        if len(self.elevation_deg) < 2 or not (np.diff(self.elevation_deg) > 0.0).all():
            raise ValueError("elevation_deg must have at least two values, in ascending order")

    @cached_property
    def _interpolate(self) -> PchipInterpolator:
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.elevation_deg, self.mean_dbhz)

    def at(self, elevation_deg: ArrayLike) -> Floats:
        """Return the mean C/N0 at given elevations [dB-Hz]; NaN where the elevation is NaN or below the lowest bin."""
        elevation = np.asarray(elevation_deg, dtype=np.float64)
        lowest, highest = self.elevation_deg[0], self.elevation_deg[-1]
        half = (self.elevation_deg[1] - lowest) / 2.0
        inside = np.where(elevation >= lowest - half, np.clip(elevation, lowest, highest), np.nan)
        return np.asarray(self._interpolate(inside), dtype=np.float64)


class SourceFile(Settings):
    """File to which a curve was fitted, and its SHA-256."""

    name: str
    sha256: str


class Cn0CurveSource(Settings):
    """Log to which a curve was fitted."""

    #: Antenna, receiver and marker in the header of the log.
    antenna: str = ""
    receiver: str = ""
    marker: str = ""
    #: First and last epoch used, ISO 8601, GPS time.
    start: str = ""
    end: str = ""

    epochs: int = Field(default=0, ge=0, strict=True)
    position_ecef_m: tuple[float, ...] = ()  #: Position of the antenna; () if not stated.
    railfix_version: str = ""
    file: tuple[SourceFile, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Cn0Curve:
    """Mean C/N0 as a function of elevation, for one antenna and receiver."""

    means: tuple[Cn0Mean, ...]  #: One curve for each combination of satellite kind and signal.
    source: Cn0CurveSource = field(default_factory=Cn0CurveSource)

    def __post_init__(self) -> None:
        if len(self._by_key) != len(self.means):
            raise ValueError("a kind of satellites has two curves for one signal")

    @cached_property
    def _by_key(self) -> dict[tuple[str, str], Cn0Mean]:
        return {(mean.kind, mean.signal): mean for mean in self.means}

    def _find(self, satellite: Strings, signal: Strings) -> list[Cn0Mean | None]:
        pairs = zip(satellite.tolist(), signal.tolist(), strict=True)
        return [self._by_key.get((satellite_kind(name), code)) for name, code in pairs]

    def covers(self, satellite: Strings, signal: Strings) -> Masks:
        """Return a mask of the channels that have a curve, shape (M,)."""
        return np.array([mean is not None for mean in self._find(satellite, signal)], dtype=bool)

    def mean_dbhz(self, elevation_deg: ArrayLike, *, satellite: Strings, signal: Strings) -> Floats:
        """Return the mean C/N0 at each channel's elevation, shape (T, M) [dB-Hz]; NaN for channels without a curve."""
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
        """Return notes if `header` has another antenna or receiver than the log of the curve."""
        notes = []
        for what in ("antenna", "receiver"):
            ours, theirs = _plain(getattr(self.source, what)), _plain(getattr(header, what))
            if ours != theirs:
                notes.append(
                    f"C/N0 curve was made with {what} '{ours or 'not named'}', "
                    f"but this log has '{theirs or 'not named'}'; limits from the curve may not fit"
                )
        return tuple(notes)


def _plain(text: str) -> str:
    """Return the name of an antenna or receiver, with repeated spaces reduced to one."""
    return " ".join(text.split())

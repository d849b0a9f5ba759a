"""Fit of the mean C/N0 as a function of elevation, for each combination of satellite kind and signal."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from railfix.core.arrays import Floats, Strings
from railfix.core.settings import Settings
from railfix.ranges.cn0_curve import Cn0Curve, Cn0CurveSource, Cn0Mean, satellite_kind

__all__ = ["Cn0Samples", "CurveFit", "fit_cn0_curve"]

#: Ratio of a normal variable's standard deviation to its median absolute deviation.
_NORMAL_MAD: Final = 1.482_602_218_505_602


class CurveFit(Settings):
    """Settings of the fit of a curve."""

    bin_deg: float = Field(default=5.0, ge=0.1, le=30.0)  #: Width of the elevation bins.
    #: Bins with fewer samples than this are left out.
    least_samples: int = Field(default=30, ge=1)
    least_bins: int = Field(default=4, ge=2)  #: No curve is fitted to fewer bins than this.
    #: Samples farther from their bin's median than this many robust standard deviations are excluded as outliers.
    clip_sigma: float = Field(default=3.0, gt=0.0)


class Cn0Samples:
    """C/N0 and elevation from the parts of a log, by satellite kind and signal; stored in single precision."""

    def __init__(self) -> None:
        self._parts: dict[tuple[str, str], list[NDArray[np.float32]]] = defaultdict(list)

    def add(self, cn0_dbhz: ArrayLike, elevation_deg: ArrayLike, satellite: Strings, signal: Strings) -> None:
        """Add samples of shape (T, M); samples with NaN, or below the horizon, are left out."""
        cn0, elevation = np.asarray(cn0_dbhz), np.asarray(elevation_deg)
        finite = np.isfinite(cn0) & np.isfinite(elevation) & (elevation >= 0.0)
        for m, (name, code) in enumerate(zip(satellite.tolist(), signal.tolist(), strict=True)):
            rows = finite[:, m]
            if rows.any():
                pair = np.stack([elevation[rows, m], cn0[rows, m]]).astype(np.float32)
                self._parts[satellite_kind(name), code].append(pair)

    def keys(self) -> list[tuple[str, str]]:
        """Return the kinds and signals that have samples."""
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
    """Fit the mean C/N0 as a function of elevation for each satellite kind and signal with enough bins.

    `samples` is a `Cn0Samples` of an antenna under open sky, or an iterable of tuples of C/N0 (T, M), elevation (T, M),
    satellite (M,) and signal (M,). Raises ValueError if there are too few samples for any curve.
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
            f"no signal of any constellation has {fit.least_bins} elevation bins with {fit.least_samples} samples each"
        )
    return Cn0Curve(means=fitted, source=source or Cn0CurveSource())


def _fit_mean(key: tuple[str, str], elevation: Floats, cn0: Floats, fit: CurveFit) -> Cn0Mean | None:
    """Return the curve of one kind of satellites and one signal; None if it has too few bins."""
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
    """Return the mean without outliers, and the robust standard deviation."""
    middle = float(np.median(values))
    spread = _NORMAL_MAD * float(np.median(np.abs(values - middle)))
    # C/N0 is reported in steps of up to 1 dB-Hz, so that the spread of a few samples can be 0
    kept = values[np.abs(values - middle) <= clip_sigma * max(spread, 0.5)]
    return float(kept.mean()), spread

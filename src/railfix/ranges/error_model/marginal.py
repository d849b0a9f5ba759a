"""Summary of an error model by elevation, by sector and by C/N0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.ranges.error_model.model import BinStatistics, ErrorModel

_SIDES: Final = {1: ("all round",), 2: ("ahead", "behind"), 4: ("ahead", "right", "behind", "left")}


@dataclass(frozen=True, kw_only=True)
class SummaryRow:
    """One row: its name, and count, bias, sigma, overbound before and after the screens as text."""

    name: str
    cells: tuple[str, ...]


def summary(model: ErrorModel) -> Iterator[SummaryRow]:
    """Rows by elevation, by sector and by C/N0.

    Bias and sigma are those of all samples of the row, from the bins' own figures; the overbound is the span
    of the bins' sigmas of bounds.
    """
    bins = model.bins
    width = 360.0 / bins.sectors
    names = (
        [f"elevation {a:g}-{b:g}" for a, b in zip(bins.elevation_deg[:-1], bins.elevation_deg[1:], strict=True)],
        list(_SIDES.get(bins.sectors, tuple(f"azimuth {k * width:g} deg" for k in range(bins.sectors)))),
        [f"C/N0 {a:g}-{b:g}" for a, b in zip(bins.cn0_dbhz[:-1], bins.cn0_dbhz[1:], strict=True)],
    )
    for axis, labels in enumerate(names):
        for k, name in enumerate(labels):
            cells = (*_cells(model.before, axis, k), *_cells(model.after, axis, k))
            yield SummaryRow(name=name, cells=cells)


def _cells(statistics: BinStatistics, axis: int, k: int) -> tuple[str, str, str, str]:
    count = np.take(statistics.count, k, axis=axis)
    total, has = int(count.sum()), count > 0
    if total == 0:
        return "0", "-", "-", "-"
    bias, sigma, bound = (
        np.take(getattr(statistics, name), k, axis=axis)[has] for name in ("bias_m", "sigma_m", "bound_sigma_m")
    )
    share = count[has] / total
    mean = float(np.nansum(share * bias))
    spread = float(np.sqrt(np.nansum(share * (sigma**2 + (bias - mean) ** 2))))
    return f"{total:,}", f"{mean:+.2f}", f"{spread:.2f}", f"{np.nanmin(bound):.1f}-{np.nanmax(bound):.1f}"

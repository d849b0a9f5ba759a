"""The tables and the record of a reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from railfix.reference.assemble import Built
from railfix.reference.fixes import FixRejection
from railfix.track.trajectory import Trajectory


def fixes_table(name: str, part: Built, trajectory: Trajectory) -> pl.DataFrame:
    """Rows of fixes.csv of one antenna."""
    fixes = part.fixes
    words = {int(code): FixRejection(int(code)).text or "good" for code in np.unique(fixes.rejection)}
    return _round(
        pl.DataFrame(
            {
                "time_gpst": fixes.time,
                "antenna": np.full(len(fixes), name),
                "verdict": [words[code] for code in fixes.rejection.tolist()],
                "quality": fixes.quality,
                "ratio": fixes.ratio,
                "chainage_m": trajectory.chainage_at(fixes.arc_m),
                "lateral_m": fixes.lateral_m,
                "height_m": fixes.height_m,
                "spacing_m": fixes.spacing_m,
                "travel_m": fixes.travel_m,
                "sigma_m": fixes.sigma_m,
            }
        )
    )


def _round(table: pl.DataFrame) -> pl.DataFrame:
    """Round to tenths of millimetres, blank where there is no number."""
    return table.with_columns(pl.col(pl.Float64).round(4).fill_nan(None))


def antenna_record(part: Built) -> dict[str, Any]:
    """One antenna as plain values."""
    reference = part.reference
    sigma = reference.sigma_m[reference.source == "bridged"]
    return {
        "positions": len(part.fixes),
        "verdicts": part.fixes.counts(),
        "instants": {source: int((reference.source == source).sum()) for source in ("rtk", "bridged")},
        "left_out": part.left_out,
        "bridged_by": part.bridged_by,
        "bridged_sigma_m": None
        if not len(sigma)
        else {"p50": float(np.median(sigma)), "p95": float(np.percentile(sigma, 95)), "max": float(sigma.max())},
        "gaps": [
            {
                "start": np.datetime_as_string(gap.start, unit="ms"),
                "end": np.datetime_as_string(gap.end, unit="ms"),
                "length_s": gap.length_s,
                "bridged": gap.bridged,
            }
            for gap in part.gaps
        ],
        **part.facts,
    }

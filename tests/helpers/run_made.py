"""Run folders and references whose positions are given."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import polars as pl

import synthetic
from railfix.core.timescale import timedelta
from railfix.io.reference_log import AntennaReference, reference_table
from railfix.track import Track
from railfix.track.trajectory import Trajectory

START = np.datetime64("2024-03-05T01:00:00", "ns")
#: 2 km, level and straight, points every 10 m.
LINE = Track.from_ecef(synthetic.enu_to_ecef(np.stack([np.arange(0, 2001, 10.0), *np.zeros((2, 201))], axis=1)))
PATH = Trajectory.from_antenna_path(LINE)


def at(chainage: np.ndarray) -> np.ndarray:
    return PATH.at_arc(PATH.arc_at_chainage(chainage))


def reference(time_s: np.ndarray, chainage: np.ndarray, **columns: object) -> dict[str, AntennaReference]:
    blank = np.full(len(time_s), np.nan)
    whole = {
        "time": START + timedelta(time_s),
        "ecef_m": at(chainage),
        "chainage_m": chainage,
        "speed_mps": blank,
        "sigma_m": blank,
        "source": np.full(len(time_s), "truth"),
        "environment": np.full(len(time_s), ""),
    }
    return {"front": AntennaReference(**whole | columns)}  # type: ignore[arg-type]


def write_reference(path: Path, references: dict[str, AntennaReference]) -> None:
    reference_table(references).write_csv(path, float_precision=4, datetime_format="%Y-%m-%dT%H:%M:%S%.9f")


def write_run(
    folder: Path,
    time_s: np.ndarray,
    chainage: np.ndarray,
    *,
    conventional: np.ndarray | None = None,
    status: list[str] | None = None,
    track: Path | None = None,
    chainage_of: str = "antenna",
    settings: dict | None = None,
    **columns: np.ndarray,
) -> Path:
    """A run folder of one antenna; NaN where there is no position."""
    folder.mkdir(parents=True)
    conventional = chainage if conventional is None else conventional
    has = np.isfinite(chainage)
    rows = {
        "time_gpst": START + timedelta(np.asarray(time_s, dtype=np.float64)),
        "antenna": ["front"] * len(time_s),
        "status": status or np.where(has, "ok", "too_few_satellites").tolist(),
        "chainage_m": chainage,
        "along_sigma_m": np.where(has, 2.0, np.nan),
        "n_used": np.where(has, 8, 2),
        "conventional_chainage_m": conventional,
    }
    for prefix, values in (("", chainage), ("conventional_", conventional)):
        place = at(values)
        rows |= {f"{prefix}{axis}_m": place[:, i] for i, axis in enumerate("xyz")}
    pl.DataFrame(rows | columns, nan_to_null=True).write_parquet(folder / "positions.parquet")
    entries = []
    if track is not None:
        digest = hashlib.sha256(track.read_bytes()).hexdigest()
        entries = [{"input": "track", "path": str(track), "bytes": track.stat().st_size, "sha256": digest}]
    record = {
        "inputs": entries,
        "settings_used": settings or {"preset": "default", "screens": ["elevation"]},
        "line": {"track": {"name": "straight"}, "chainage_of": {"front": chainage_of}},
    }
    (folder / "run.json").write_text(json.dumps(record))
    return folder

"""The folder of a run whose tables are written by hand, for the pages on it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from railfix.core.reasons import Reason
from railfix.core.timescale import timedelta
from run_made import LINE, START, at, reference, write_reference, write_run

EPOCHS = 90


def _figures(epochs: int, positions: int, sigma_m: float, level_m: float | None) -> dict[str, Any]:
    return {
        "status": {"ok": epochs - 9, "tracking": epochs - 5, "uncertain": 3, "coasting": 2, "no_observation": 4},
        "chainage_m": {"positions": positions, "first": 100.0, "last": 545.0},
        "along_sigma_m": {"p50_m": sigma_m, "p95_m": 2.0 * sigma_m, "max_m": 3.0 * sigma_m},
        "level": level_m
        and {"p50_m": level_m, "p95_m": 2.0 * level_m, "max_m": 3.0 * level_m, "within_20_m": 40, "within_50_m": 60},
        "protection_level": level_m
        and {"p50_m": level_m, "p95_m": 2.0 * level_m, "max_m": 3.0 * level_m, "available": 70, "alarm": 2},
    }


def _record(filtered: bool) -> dict[str, Any]:
    facts = _figures(EPOCHS, 85, 1.25, 9.5) | {
        "epochs": EPOCHS, "epochs_with_observations": 86, "positioning_rate": 85 / 86, "ok_rate": 80 / 86,
        "first_epoch_gpst": "2024-03-05T01:00:00", "last_epoch_gpst": "2024-03-05T01:01:29",
        "epochs_with_position_by_status": {"ok": 80, "uncertain": 5},
        "epochs_without_position_by_status": {"too_few_satellites": 1, "no_observation": 4},
        "observations": 1000, "observations_used": 800,
        "observations_rejected_by_first_reason": {"elevation_mask": 150, "cn0_floor": 50},
        "observations_rejected_by_one_reason_alone": {"elevation_mask": 120},
        "filter": _figures(EPOCHS, 90, 0.75, 7.5) if filtered else None,
        "interference": {"fall of C/N0": {"epochs": 3, "first": "2024-03-05T01:00:07"}},
    }  # fmt: skip
    return {
        "versions": {"railfix": "0.1.0", "numpy": "2.0"}, "platform": "made", "wall_s": 1.5,
        "command": ["railfix", "run", "a file.obs"],
        "settings_asked": {"preset": "p1", "raim": {"false_alarm": 0.01}, "exclude": ["G01", "G02"], "gone": None},
        "settings_used": {"preset": "p1", "raim": {"false_alarm": 0.01}, "screens": ["elevation"], "protection": "on",
                          "alarm_limit_m": 25.0},
        "protection": {"kind": "separation", "basis": "indicative", "alarm_limit_m": 25.0, "risk_per_hour": 1e-7,
                       "satellite_prior": {"G": 1e-5, "E": 3e-5, "J": 3e-5}, "k_of_whole_risk": 6.311},
        "antennas": {"front": facts}, "likely_causes": ["a cause"], "notes": ["a note"],
        "chunks": {"first_epoch_gpst": ["2024-03-05T01:00:00", "2024-03-05T01:01:00"], "epochs": [60, 30],
                   "positioning_s": [0.12, 0.09]},
    }  # fmt: skip


def _single(time: np.ndarray, placed: np.ndarray) -> dict[str, Any]:
    """Columns of single epochs."""
    level = np.where(time % 10 == 3, np.inf, 12.0)
    some = np.where(time % 7 == 1, np.nan, 1.0)
    outcomes = ["passed", "excluded_one", "untestable"]
    return {
        "n_used": np.where(placed, 8, 0), "latitude_deg": np.full(EPOCHS, 35.0),
        "longitude_deg": np.full(EPOCHS, 135.7),
        "own_sigma_m": np.full(EPOCHS, 1.5),
        "kilometrage_m": 5000.0 + 5.0 * time, "n_rejected": np.full(EPOCHS, 3), "noise_scale": 1.2 * some,
        "raim_outcome": [outcomes[int(k) % 3] for k in time], "raim_statistic": 4.5 * some,
        "raim_threshold": np.full(EPOCHS, 16.25), "raim_level_m": np.full(EPOCHS, 8.0),
        "protection_level_m": np.where(placed, level, np.nan), "protection_kind": ["separation"] * EPOCHS,
        "protection_fault_free_m": 6.0 * some, "protection_one_fault_m": np.full(EPOCHS, 10.0),
        "protection_two_faults_m": np.full(EPOCHS, 2.0), "metric_antenna_spacing_m": np.full(EPOCHS, np.nan),
        "protection_cause": ["one_fault" if k % 10 != 3 else "unchecked_map" if k % 20 == 3 else None for k in time],
        "protection_status": np.where(np.isfinite(level), "available", "unavailable").tolist(),
    }  # fmt: skip


def _track(time: np.ndarray, answer: np.ndarray) -> pl.DataFrame:
    """Rows of the filter: tracking, several branches, coasting, without a level, with one on the ground."""
    k = time.astype(int)
    place = at(answer)
    statuses = ["tracking", "several_branches", "coasting"]
    whole = {
        "time_gpst": START + timedelta(time), "antenna": ["front"] * EPOCHS, "chainage_m": answer,
        "status": [statuses[i % 3] for i in k], "along_sigma_m": 0.5 + 0.01 * time,
        **{f"{axis}_m": place[:, i] for i, axis in enumerate("xyz")},
        "hypotheses": np.where(k % 3 == 1, 2, np.where(k % 5 == 0, 0, 1)),
        "branch_probability": np.where(k % 3, 0.75, 1.0),
        "protection_level_m": np.where(k % 4 == 2, np.nan, 3.5),
        "protection_noise_m": np.where(k % 8 == 6, np.nan, 3.0),
        "protection_level_ground_m": np.where(k % 8 == 2, 11.0, np.nan),
        "protection_separation_m": np.where(k % 5 == 1, np.nan, 0.5),
        "sources": ["" if i % 6 == 2 else "code+doppler" for i in k],
    }  # fmt: skip
    return pl.DataFrame(whole, nan_to_null=True)


def _observations(time: np.ndarray) -> pl.DataFrame:
    """Nine satellites an epoch; two are rejected, one of them is low; one is not known to the filter."""
    rows = []
    for k in time.astype(int):
        for m in range(9):
            rejected = m in (3, 8)
            reason = int(Reason.ELEVATION_MASK if m == 8 else Reason.CN0_FLOOR) if rejected else 0
            text = ("elevation_mask" if m == 8 else "cn0_floor") if rejected else "used"
            residual = None if rejected else 0.5 * (-1.0) ** m + 0.1 * m
            rows.append(
                ("GGGGEEEJC"[m] + f"{m + 1:02d}", "1C", reason, text, residual, 15.0 + 8.0 * ((m * 5) % 9), 40.0 * m,
                 None if m == 5 else 30.0 + m, 1.0 + 0.1 * m, int(k))
            )  # fmt: skip
    names = ("satellite", "signal", "reason", "reason_text", "residual_m", "elevation_deg", "azimuth_deg", "cn0_dbhz",
             "sigma_m", "k")  # fmt: skip
    table = pl.DataFrame(rows, schema=names, orient="row")
    more = {"weight_code": pl.lit(0.5), "innovation_code_m": pl.lit(0.25), "innovation_doppler_mps": pl.lit(0.01)}
    when = pl.Series("time_gpst", START + timedelta(table["k"].to_numpy().astype(float)))
    missing = [pl.lit(None, dtype=pl.Float64).alias(name) for name in _METRICS]
    return table.drop("k").with_columns(when, *missing, antenna=pl.lit("front"), **more)


_METRICS = (
    "metric_cn0_deficit_dbhz", "metric_doppler_m", "limit_doppler_m", "metric_antenna_pair_m",
    "metric_two_frequencies_m", "raim_own_error_m",
)  # fmt: skip


def made_report_run(folder: Path, *, filtered: bool = True, observations: bool = True) -> Path:
    """Write a run at 5 m/s from 100 m on and its ground truth ``truth.csv`` beside it; return the folder of the run.

    Epochs 20 to 29 are in a tunnel, 60 to 62 below a bridge: single epochs have no position there; a few others have
    failed a check.
    """
    time = np.arange(float(EPOCHS))
    place = 100.0 + 5.0 * time
    dark, bridge = (time >= 20) & (time < 30), (time >= 60) & (time < 63)
    dark |= bridge
    answer = np.where(dark, np.nan, place + np.sin(time))
    answer[50] = place[50] + 14.0
    status = np.where(dark, "too_few_satellites", np.where(time % 30 == 11, "uncertain", "ok")).tolist()
    environment = np.where(bridge, "bridge", np.where(dark, "tunnel", "open"))
    truth = reference(
        time, place, environment=environment, sigma_m=np.full(EPOCHS, 0.05), speed_mps=np.full(EPOCHS, 5.0)
    )
    folder.parent.mkdir(parents=True, exist_ok=True)
    write_reference(folder.parent / "truth.csv", truth)
    line = folder.parent / "line.csv"
    pl.DataFrame(
        {"latitude_deg": LINE.latitude_deg, "longitude_deg": LINE.longitude_deg, "height_m": LINE.height_m}
    ).write_csv(line)
    conventional = np.where(dark, np.nan, place + 3.0 * np.cos(time))
    write_run(folder, time, answer, conventional=conventional, status=status, track=line, **_single(time, ~dark))
    written = json.loads((folder / "run.json").read_text())
    record = _record(filtered)
    facts = {"name": "straight", "length_m": 2000.0, "points": 201, "sigma_plan_m": 0.3, "sigma_height_m": 0.6}
    record["line"] = {**written["line"], "track": facts, "vehicle": {"name": "car"}}
    record["inputs"] = written["inputs"]
    (folder / "run.json").write_text(json.dumps(record))
    if filtered:
        _track(time, place + 0.4 * np.cos(time)).write_parquet(folder / "train.parquet")
    if observations:
        _observations(time).write_parquet(folder / "observations.parquet")
    return folder

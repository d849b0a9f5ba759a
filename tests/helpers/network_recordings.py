"""Positions of the measuring train on the real network: shares on the right track.

The logs name no tracks, and even fixed positions (NARROW_INT3) lie metres from the centrelines of the map, so that the
track is known of some positions only: of fixed ones nearer than 1.5 m to one track, with the next at least 2 m farther,
and at a steady distance from it. Beside the log as it is, the same positions with errors like those of a single
receiver (2 m, lasting 30 s) are matched.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import paths
from network_made import to_degrees
from railfix.track.network import Network
from railfix.track.network_match import PlanLog, match, read_plan_positions

FOLDER = paths.DATA / "rail" / "infrabel"
COLUMNS = {"latitude_deg": "latitude", "longitude_deg": "longitude", "time_gpst": "timestamp"}
#: Standard deviation of the added errors of an axis [m], and time over which they last [s].
SIGMA_M, LASTING_S = 2.0, 30.0
_NEAREST_M, _FARTHER_M = 1.5, 2.0
#: Rows of about a second, and change of the distance from the track over them.
_ROWS, _STEADY_M = 3, 0.5


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Of one log: positions of a known track, share on it, also with errors; distance of the fixed positions from the
    nearest track, median."""

    known: int
    fixed_m: float
    right: float
    right_with_errors: float


def with_errors(log: PlanLog, rng: np.random.Generator) -> PlanLog:
    """The positions with a Gauss-Markov error on each axis."""
    seconds = np.diff(log.time) / np.timedelta64(1, "s")
    keep = np.exp(-np.where(np.isfinite(seconds), seconds, 0.4) / LASTING_S)
    error = np.empty((len(log.time), 2))
    error[0] = rng.normal(0.0, SIGMA_M, 2)
    for k, share in enumerate(keep, start=1):
        error[k] = share * error[k - 1] + np.sqrt(1.0 - share**2) * rng.normal(0.0, SIGMA_M, 2)
    latitude, longitude = to_degrees(error[:, 0], error[:, 1])
    return replace(
        log, latitude_deg=log.latitude_deg + latitude - 50.0, longitude_deg=log.longitude_deg + longitude - 5.0
    )


def known_tracks(network: Network, log: PlanLog, fixed: np.ndarray) -> np.ndarray:
    """Track on which each position is for certain, -1 where there is none.

    A train stays at the same distance from the track on which it is: over a second before and after, as far as that
    track reaches, that of the positions changes by less than `_STEADY_M`. Where it passes beside a connection between
    two tracks, which comes nearer and goes away, it does not.
    """
    near = network.near(log.latitude_deg, log.longitude_deg, within_m=30.0)
    offset = np.abs(near.offset_m)
    certain = fixed & (offset[:, 0] < _NEAREST_M) & (offset[:, 1] > offset[:, 0] + _FARTHER_M)
    rows = np.arange(len(offset))
    change = np.zeros(len(rows))
    for step in (-_ROWS, _ROWS):
        beside = np.clip(rows + step, 0, len(rows) - 1)
        at, apart = network.place_on(near.track[:, 0], log.latitude_deg[beside], log.longitude_deg[beside])
        inside = (at > 0.1) & (at < network.length_m[near.track[:, 0]] - 0.1)
        change = np.fmax(change, np.where(inside, np.abs(apart - offset[:, 0]), 0.0))
    return np.where(certain & (change < _STEADY_M), near.track[:, 0], -1)


def shares(network: Network, path: Path, *, seeds: int = 10) -> Shares:
    log = read_plan_positions(path, columns=COLUMNS)
    with path.open() as file:
        fixed = np.array([row["position_type"] == "NARROW_INT3" for row in csv.DictReader(file)])
    known = known_tracks(network, log, fixed)
    rows = known >= 0
    fixed_m = np.abs(network.near(log.latitude_deg, log.longitude_deg).offset_m[fixed, 0])
    noisy = [match(network, with_errors(log, np.random.default_rng(seed)), sigma_m=SIGMA_M) for seed in range(seeds)]

    def right(track: np.ndarray) -> float:
        return float((track == known)[rows].mean()) if rows.any() else np.nan

    return Shares(
        known=int(rows.sum()),
        fixed_m=float(np.median(fixed_m[np.isfinite(fixed_m)])),
        right=right(match(network, log).track),
        right_with_errors=float(np.mean([right(found.track) for found in noisy])),
    )

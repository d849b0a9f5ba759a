"""Positions of the measuring train on the real network: shares within 5 m and on the right track, time a position.

``python tests/studies/network_recordings.py`` prints them. The logs name no tracks, and even fixed positions
(NARROW_INT3) lie metres from the centrelines of the map, so that the track is known of some positions only: of fixed
ones nearer than 1.5 m to one track, with the next at least 2 m farther, and at a steady distance from it. Beside the
log as it is, the same positions with errors like those of a single receiver (2 m, lasting 30 s) are matched.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import paths
from network_made import to_degrees
from railfix.track.network import Network
from railfix.track.network_match import PlanLog, match, read_plan_positions
from railfix.track.network_read import read_network

FOLDER = paths.DATA / "rail" / "infrabel"
COLUMNS = {"latitude_deg": "latitude", "longitude_deg": "longitude", "time_gpst": "timestamp"}
#: Standard deviation of the added errors of an axis [m], and time over which they last [s].
SIGMA_M, LASTING_S = 2.0, 30.0
_NEAREST_M, _FARTHER_M = 1.5, 2.0
#: Rows of about a second, and change of the distance from the track over them.
_ROWS, _STEADY_M = 3, 0.5


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Of one log: positions by type, shares within 5 m, positions of a known track, shares on it; and how far the fixed
    positions are from the nearest track in the median."""

    name: str
    types: dict[str, int]
    within_5_m: dict[str, float]
    known: int
    fixed_m: float
    right: float
    right_with_errors: float
    stated_with_errors: float
    network_us: float
    one_track_us: float


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
        kind = np.array([row["position_type"] for row in csv.DictReader(file)])
    begin = time.process_time()
    matched = match(network, log)
    spent = time.process_time() - begin
    known = known_tracks(network, log, kind == "NARROW_INT3")
    rows = known >= 0
    fixed_m = np.abs(network.near(log.latitude_deg, log.longitude_deg).offset_m[kind == "NARROW_INT3", 0])
    noisy = [match(network, with_errors(log, np.random.default_rng(seed)), sigma_m=SIGMA_M) for seed in range(seeds)]
    # one track: that of the longest stay
    longest = int(np.bincount(matched.track[matched.track >= 0]).argmax())
    single = Network(tracks=(network.tracks[longest],), links=())
    begin = time.process_time()
    match(single, log)
    alone = time.process_time() - begin
    types = [str(name) for name in np.unique(kind)]

    def mean(values: np.ndarray) -> float:
        return float(values.mean()) if len(values) else np.nan

    return Shares(
        name=path.stem,
        types={name: int((kind == name).sum()) for name in types},
        within_5_m={name: float((np.abs(matched.offset_m[kind == name]) <= 5.0).mean()) for name in types},
        known=int(rows.sum()),
        fixed_m=float(np.median(fixed_m[np.isfinite(fixed_m)])),
        right=mean((matched.track == known)[rows]),
        right_with_errors=float(np.mean([mean((m.track == known)[rows]) for m in noisy])),
        stated_with_errors=float(np.mean([mean(m.probability[rows]) for m in noisy])),
        network_us=1e6 * spent / len(kind),
        one_track_us=1e6 * alone / len(kind),
    )


def every_log(*, seeds: int = 10) -> Iterator[Shares]:
    network = read_network([FOLDER / "network_airport.geojson"])
    network.near(np.array([50.9]), np.array([4.5]))
    _ = network.graph
    for path in sorted(FOLDER.glob("log_*.csv")):
        yield shares(network, path, seeds=seeds)


def main() -> None:
    for row in every_log():
        kinds = ", ".join(f"{name} {n} ({row.within_5_m[name]:.3f} within 5 m)" for name, n in row.types.items())
        print(
            f"{row.name}: {kinds}; fixed ones {row.fixed_m:.2f} m from a track in the median; {row.known} of a known "
            f"track, {row.right:.3f} on it, with errors of {SIGMA_M:g} m {row.right_with_errors:.3f} (stated "
            f"{row.stated_with_errors:.3f}); {row.network_us:.0f} us a position, on one track {row.one_track_us:.0f}"
        )


if __name__ == "__main__":
    main()

"""A town of 20,000 tracks, read from an OSM XML file and matched: time and memory.

``python tests/helpers/network_town.py`` prints them. Streets are a grid of 100 by 100 crossings, 150 m apart, with a
track from each crossing to the next ones, drawn with a point every 30 m; the run turns at random crossings.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from network_made import to_degrees
from railfix.track.network_match import PlanLog, match
from railfix.track.network_read import read_network

BLOCK_M, PIECES = 150.0, 5
SIGMA_M = 1.5


def write_town(path: Path, crossings: int = 100) -> None:
    """Write the ways between the crossings, each of them a track, as OSM XML."""
    nodes: dict[tuple[int, int], int] = {}
    ways = []
    for i in range(crossings):
        for j in range(crossings):
            for di, dj in ((1, 0), (0, 1)):
                at = [(PIECES * i + k * di, PIECES * j + k * dj) for k in range(PIECES + 1)]
                ways.append([nodes.setdefault(place, len(nodes) + 1) for place in at])
    east, north = (np.array(values) * BLOCK_M / PIECES for values in zip(*nodes, strict=True))
    latitude, longitude = to_degrees(east, north)
    with path.open("w") as file:
        file.write("<osm version='0.6'>\n")
        for number, lat, lon in zip(nodes.values(), latitude.tolist(), longitude.tolist(), strict=True):
            file.write(f'<node id="{number}" lat="{lat:.9f}" lon="{lon:.9f}"/>\n')
        for number, refs in enumerate(ways, start=1):
            inside = "".join(f'<nd ref="{ref}"/>' for ref in refs)
            file.write(f'<way id="{number}">{inside}<tag k="railway" v="tram"/></way>\n')
        file.write("</osm>\n")


def made_run(seconds: int, crossings: int, rng: np.random.Generator) -> PlanLog:
    """Positions each second at 10 m/s on straight lines of the grid, with errors that last 30 s."""
    along = np.arange(seconds) * 10.0 % (BLOCK_M * crossings)
    keep, error = np.exp(-1.0 / 30.0), np.zeros((seconds, 2))
    for k in range(1, seconds):
        error[k] = keep * error[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal(0.0, SIGMA_M, 2)
    latitude, longitude = to_degrees(along + error[:, 0], 50 * BLOCK_M + error[:, 1])
    return PlanLog(
        path="made", time=np.datetime64("2024-01-01", "ns") + np.arange(seconds) * np.timedelta64(1, "s"),
        latitude_deg=latitude, longitude_deg=longitude, sigma_m=np.full(seconds, SIGMA_M),
    )  # fmt: skip


def main(seconds: int = 1000) -> None:
    imported = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "town.osm"
        write_town(path)
        begin = time.process_time()
        network = read_network([path])
    read = time.process_time() - begin
    log = made_run(seconds, 100, np.random.default_rng(1))
    begin = time.process_time()
    matched = match(network, log)
    spent = time.process_time() - begin
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(
        f"{len(network.tracks)} tracks, {network.length_m.sum() / 1e3:.0f} km: read in {read:.1f} s, {seconds} "
        f"positions matched in {spent:.1f} s, {(np.abs(matched.offset_m) < 5.0).mean():.3f} within 5 m of their track, "
        f"peak memory {memory:.0f} MB, {imported:.0f} MB of it before"
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

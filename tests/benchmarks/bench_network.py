"""Opening of a network of 10,000 km: 5000 tracks of 2 km with points each 25 m, from a GeoPackage.

Run as a program; prints processor seconds, the least of some rounds::

    python tests/benchmarks/bench_network.py [--rounds 3]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pyogrio
import shapely

from railfix.track.network_read import read_network
from railfix.track.route import MapReading

LINES, TRACKS, POINTS, STEP_M = 100, 50, 81, 25.0


def write(path: Path) -> None:
    """Lines of tracks, each with a curvature of its own."""
    rng = np.random.default_rng(0)
    shapes = []
    for line in range(LINES):
        heading = (
            rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(np.repeat(rng.normal(0.0, 1 / 3000, TRACKS), POINTS - 1)) * STEP_M
        )
        steps = STEP_M * np.stack([np.sin(heading), np.cos(heading)], axis=-1)
        east, north = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]).T
        latitude, longitude = 46.0 + 0.5 * (line // 10), 6.0 + 0.9 * (line % 10)
        points = np.column_stack(
            [
                longitude + east / (111_200.0 * np.cos(np.radians(latitude))),
                latitude + north / 111_200.0,
                400.0 + 0.0 * east,
            ]
        )
        for first in range(0, TRACKS * (POINTS - 1), POINTS - 1):
            shapes.append(shapely.to_wkb(shapely.LineString(points[first : first + POINTS])))
    names = np.array([f"T{k}" for k in range(len(shapes))], dtype=object)
    pyogrio.raw.write(
        path, np.array(shapes), [names], ["name"], driver="GPKG", geometry_type="LineString Z", crs="EPSG:4258"
    )


def main() -> None:
    """Print the time of opening."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.gpkg"
        write(path)
        spent = []
        for _ in range(rounds):
            begin = time.process_time()
            network = read_network([path], MapReading(height_datum="ellipsoidal"))
            network.graph  # noqa: B018 - built at first use
            spent.append(time.process_time() - begin)
    print(f"{len(network.tracks)} tracks, {network.length_m.sum() / 1e3:,.0f} km: {min(spent):.2f} s of processor time")


if __name__ == "__main__":
    main()

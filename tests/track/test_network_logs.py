"""Logs of positions beside a network: one reader for every format, and what is assumed of a log is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from railfix.core.arrays import Floats
from railfix.track.network import Network
from railfix.track.network_match import Matched, match, read_plan_positions
from railfix.track.network_read import read_network
from railfix.track.route import MapReading

pytestmark = pytest.mark.requirement("A10")

METRE_DEG = 1.0 / 111_194.9  #: One metre of latitude.


def network(folder: Path, tracks: dict[str, tuple[float, float]]) -> Network:
    """Parallel tracks eastward, each so many metres north of the first and above 400 m."""
    features = [
        {
            "type": "Feature",
            "properties": {"name": name, "sigma_plan_m": 0.1},
            "geometry": {
                "type": "LineString",
                "coordinates": [[8.0 + 2e-4 * k, 47.0 + north * METRE_DEG, 400.0 + up] for k in range(60)],
            },
        }
        for name, (north, up) in tracks.items()
    ]
    crs = {"type": "name", "properties": {"name": "EPSG:9989"}}
    path = folder / "net.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    return read_network([path], MapReading(height_datum="ellipsoidal"))


def logs(folder: Path, north_m: Floats, up_m: float, sigma_m: float | None) -> tuple[Path, Path]:
    """The same positions, a second apart, as CSV and in RTKLIB's format."""
    rng = np.random.default_rng(1)
    names, values = "", ""
    if sigma_m is not None:
        names, values = ",sigma_north_m,sigma_east_m,sigma_up_m", f",{sigma_m},{sigma_m},{sigma_m}"
    table = ["time_gpst,latitude_deg,longitude_deg,height_m" + names]
    solution = ["%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)"]
    for k, north in enumerate(north_m.tolist()):
        latitude, height = 47.0 + (north + rng.normal(0.0, 0.2)) * METRE_DEG, 400.0 + up_m + rng.normal(0.0, 0.3)
        clock = f"08:{k // 60:02d}:{k % 60:02d}"
        place = f"{latitude:.9f}", f"{8.001 + 5e-5 * k:.9f}", f"{height:.3f}"
        table.append(f"2024-05-01T{clock}," + ",".join(place) + values)
        solution.append(f"2024/05/01 {clock}.000 {' '.join(place)} 5 9 {sigma_m} {sigma_m} {sigma_m}")
    paths = folder / "log.csv", folder / "log.pos"
    for path, lines in zip(paths, (table, solution), strict=True):
        path.write_text("\n".join(lines) + "\n")
    return paths


def matched(net: Network, path: Path) -> Matched:
    return match(net, read_plan_positions(path))


@pytest.mark.parametrize("up_m", [0.0, 4.0])
def test_heights_and_sigmas_of_a_csv_count_as_those_of_another_format(up_m: float, tmp_path: Path) -> None:
    net = network(tmp_path, {"A": (0.0, 0.0), "B": (4.5, 0.0)})
    table, solution = logs(tmp_path, np.full(200, 4.5), up_m, 8.0)
    of_table, of_solution = matched(net, table), matched(net, solution)
    np.testing.assert_allclose(of_table.probability, of_solution.probability, atol=1e-6)
    assert 0.6 < np.median(of_table.probability) < 0.9  # 4.5 m apart at 8 m of sigma
    net = network(tmp_path, {"LOW": (0.0, 0.0), "HIGH": (0.0, 25.0)})
    for path in logs(tmp_path, np.zeros(100), up_m, 0.5):
        of_levels = matched(net, path)
        assert (of_levels.track == 0).all()
        assert of_levels.probability.min() > 0.99


def test_a_log_without_sigmas_has_one_estimated_by_its_distances_and_says_so(tmp_path: Path) -> None:
    net = network(tmp_path, {"A": (0.0, 0.0), "B": (200.0, 0.0)})
    noise = np.random.default_rng(2).normal(0.0, 6.0, 200)
    found = matched(net, logs(tmp_path, noise, 0.0, None)[0])
    assert len(found.notes) == 1
    stated = float(found.notes[0].split(" no sigma, ")[1].split(" m is assumed")[0])
    assert stated == pytest.approx(6.0, rel=0.25)
    beside = network(tmp_path, {"A": (0.0, 0.0), "B": (4.5, 0.0)})
    found = matched(beside, logs(tmp_path, np.full(200, 4.5), 0.0, None)[0])
    assert "4.0 m is assumed, because too few of them are near a single track" in found.notes[0]
    assert np.median(found.probability) < 0.95  # of a common error of metres nothing is known


def test_a_time_that_steps_back_leaves_probabilities_and_is_said(tmp_path: Path) -> None:
    net = network(tmp_path, {"A": (0.0, 0.0), "B": (20.0, 0.0)})
    path = logs(tmp_path, np.zeros(20), 0.0, 1.0)[0]
    lines = path.read_text().splitlines()
    lines[11:] = [line.replace("2024-05-01", "2024-04-30") for line in lines[11:]]
    path.write_text("\n".join(lines) + "\n")
    found = matched(net, path)
    assert np.isfinite(found.probabilities).all()
    assert (found.track == 0).all()
    assert "the time decreases at 1 rows" in found.notes[0]

"""Errors along the line without and with a base station, and with integers fixed.

``python tests/studies/base_score.py``, with the recordings beside the checkout, prints
tests/references/results/base_score.txt: a car with a base 5.3 km away on the map of its reference (stated as 0.15 m),
and antennas at rest on a straight line through their place, stated as 0.05 m.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

import paths
import recordings_truth
from railfix.core.geodesy import ecef_from_geodetic
from railfix.evaluate import along_track_error, interpolate_reference
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.base_station_stage import Stations
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.track.trajectory import Trajectory
from recordings_score import straight_line, trajectory_of

#: Of the reference's own program, in the frame of the reference; the header of the station is 4.4 m off.
JAPAN_BASE: Final = ecef_from_geodetic(35.326681912, 139.466071726, 46.5007)


class Case(NamedTuple):
    name: str
    train: Observations
    base: Observations
    base_ecef_m: np.ndarray
    navigation: Navigation
    trajectory: Trajectory
    reference: np.ndarray
    map_m: float


def cases(data: Path) -> Iterator[Case]:
    folder = next((data / "kinematic").glob("japan_mosaic*"))
    time, ecef = recordings_truth.japan_truth(folder)
    train, base = read_observations(folder / "SEPT265G.21O"), read_observations(folder / "3034265G.21O")
    navigation = read_navigation([folder / "SEPT2650.21P"])
    reference = interpolate_reference(train.time, time, ecef)
    yield Case("car, base 5.3 km", train, base, JAPAN_BASE, navigation, trajectory_of(time, ecef), reference, 0.15)
    roof = data / "dual" / "mosaic_x2_99cm"
    base, train = read_observations(roof / "base.obs"), read_observations(roof / "rover.obs")
    texts = [(roof / f"{name}_position.txt").read_text(encoding="ascii").split() for name in ("base", "rover")]
    places = tuple(ecef_from_geodetic(*(float(v) for v in text)) for text in texts)
    yield at_rest("roof, base 1 m", train, base, places, read_navigation([roof / "base.nav"]))
    geonet = data / "static" / "rtklib_geonet2005"
    base, train = (read_observations(geonet / f"{name}0920.05o") for name in ("3040", "0759"))
    places = base.header.approximate_ecef_m, train.header.approximate_ecef_m
    apart = np.linalg.norm(places[0] - places[1]) / 1e3
    navigation = read_navigation([geonet / f"{name}0920.05n" for name in ("3040", "0759")])
    yield at_rest(f"stations {apart:.1f} km apart, 30 s", train, base, places, navigation)


def at_rest(
    name: str, train: Observations, base: Observations, places: tuple[np.ndarray, ...], navigation: Navigation
) -> Case:
    line = straight_line(places[1], 30.0)
    return Case(name, train, base, places[0], navigation, line, np.tile(places[1], (len(train), 1)), 0.05)


def rows(case: Case) -> Iterator[str]:
    kinds = (("codes", None, "off"), ("codes with base", case.base_ecef_m, "off"), ("fixed", case.base_ecef_m, "fixed"))
    for kind, place, carrier in kinds:
        config = parse_config({
            "filter": "off", "protection": "off", "elevation": {"mask_deg": 15.0}, "carrier": carrier,
            "map_plan_sigma_m": case.map_m, "map_height_sigma_m": case.map_m,
        })  # fmt: skip
        processor = EpochProcessor(
            config, {"front": case.trajectory}, navigation=case.navigation, stations=Stations(base_ecef_m=place)
        )
        result, _ = processor.process({"front": case.train}, base=None if place is None else case.base)
        found = result.antennas["front"]
        error = np.abs(along_track_error(found.arc_m, case.reference, case.trajectory))
        yield row(f"{case.name}: {kind}", error)
        if found.phase is not None and (found.phase.n_fixed > 0).any():
            fixed = found.phase.n_fixed > 0
            yield row("  of them fixed", error[fixed])
            yield f"  largest risk stated {1e6 * np.nanmax(found.phase.integer_risk[fixed]):.1f} ppm"


def row(name: str, error: np.ndarray) -> str:
    known = error[np.isfinite(error)]
    figures = np.percentile(known, [50, 95, 100]) if len(known) else np.full(3, np.nan)
    return f"{name:46} {len(known):5} " + " ".join(f"{value:7.3f}" for value in figures)


def main() -> int:
    print(f"{'':46} {'epochs':>5} {'p50':>7} {'p95':>7} {'max [m]':>7}")
    for case in cases(paths.DATA):
        for line in rows(case):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

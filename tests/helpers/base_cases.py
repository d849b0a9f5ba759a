"""Logs with a base station: a car 5.3 km from it on the map of its reference; antennas at rest on a straight line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

import recordings_truth
from railfix.core.geodesy import ecef_from_geodetic
from railfix.evaluate import interpolate_reference
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
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


def cases(data: Path) -> Iterator[Case]:
    folder = next((data / "kinematic").glob("japan_mosaic*"))
    time, ecef = recordings_truth.japan_truth(folder)
    train, base = read_observations(folder / "SEPT265G.21O"), read_observations(folder / "3034265G.21O")
    navigation = read_navigation([folder / "SEPT2650.21P"])
    reference = interpolate_reference(train.time, time, ecef)
    yield Case("car, base 5.3 km", train, base, JAPAN_BASE, navigation, trajectory_of(time, ecef), reference)
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
    return Case(name, train, base, places[0], navigation, line, np.tile(places[1], (len(train), 1)))

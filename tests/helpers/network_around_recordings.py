"""Errors of recordings along made lines on networks built around them: what is stated of tracks.

The errors of the conventional positions of each recording, in their order and with their stated standard deviations,
are put on made lines of any heading with the networks of `network_around` (parallel tracks, loop, fork, viaduct, four
tracks).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

import paths
import recordings_truth
from network_around import SHAPES, Shape, made, network_around
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.evaluate import interpolate_reference
from railfix.io import PositionLog, read_navigation, read_observations
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.without_map import locate
from railfix.track import Track
from railfix.track.network_match import match, plan_log
from railfix.track.trajectory import Trajectory

#: Speed on a made line [m/s], and standard deviation of its curvature [1/m].
_SPEED_MPS, _CURVATURE = 15.0, 1.0 / 1500.0
#: A fork counts from this distance between its tracks on [m].
_SAME_M: Final = 2.0


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Files of a drive and its truth."""

    observations: Path
    navigation: tuple[Path, ...]
    truth: recordings_truth.Truth


def recordings() -> dict[str, Recording]:
    folder = paths.DATA / "kinematic"
    towers, phone, japan, berlin = (
        folder / name
        for name in ("urbannav_tst", "gsdc_pixel5_a", "japan_mosaic_2021265_with_GEONET3034", "smartloc_berlin_rinex")
    )
    between = recordings_truth.urbannav_truth(paths.DATA)
    nav = (towers / "hksc137c.nav",)
    return {
        "towers F9P": Recording(
            observations=towers / "20210517.light-urban.tste.ublox.f9p.obs", navigation=nav, truth=between
        ),
        "towers M8T": Recording(
            observations=towers / "20210517.light-urban.tste.ublox.m8t.GC.obs", navigation=nav, truth=between
        ),
        "phone": Recording(
            observations=phone / "Pixel5_a.21o",
            navigation=(phone / "hour1180.21n",),
            truth=recordings_truth.gsdc_truth(paths.DATA),
        ),
        "Japan": Recording(
            observations=japan / "SEPT265G.21O",
            navigation=(japan / "SEPT2650.21P",),
            truth=recordings_truth.japan_truth(paths.DATA),
        ),
        "Berlin": Recording(
            observations=berlin / "Berlin_Potsdamer_Platz.obs.gz",
            navigation=(berlin / "brdc1580.16n.gz", berlin / "brdc1580.16g.gz"),
            truth=recordings_truth.smartloc_rinex_truth(berlin),
        ),
    }


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of conventional positions each second: errors and stated standard deviations north, east and up, (n, 3) [m]."""

    time: np.ndarray
    error_m: np.ndarray
    sigma_m: np.ndarray


def recorded_errors(recording: Recording) -> Errors:
    config = Config()
    log = read_observations(recording.observations)
    step = max(1, round(1.0 / float(np.median(np.diff(log.time) / np.timedelta64(1, "s")))))
    received = known_from_start(config, navigation=read_navigation(recording.navigation))
    found = locate(log[::step], received, config, ChannelBook(config))
    truth = interpolate_reference(found.time, *recording.truth)
    known = np.isfinite(found.ecef_m[:, 0]) & np.isfinite(truth[:, 0])
    latitude, longitude, _ = geodetic_from_ecef(truth[known])
    axes = enu_axes(latitude, longitude)[:, [1, 0, 2]]
    error = np.einsum("tij,tj->ti", axes, found.ecef_m[known] - truth[known])
    return Errors(time=found.time[known], error_m=error, sigma_m=found.sigma_m[known])


def made_line(length_m: float, rng: np.random.Generator) -> Track:
    """A level line of any heading, its curvature another one every kilometre."""
    way = np.arange(0.0, length_m + 10.0, 5.0)
    knots = np.arange(0.0, way[-1] + 2000.0, 1000.0)
    curvature = np.interp(way, knots, rng.normal(0.0, _CURVATURE, len(knots)))
    heading = rng.uniform(0.0, 2.0 * np.pi) + 5.0 * np.cumsum(curvature)
    axes = enu_axes(50.0, 5.0)
    east, north = 5.0 * np.cumsum(np.sin(heading)), 5.0 * np.cumsum(np.cos(heading))
    points = ecef_from_geodetic(50.0, 5.0, 100.0) + east[:, None] * axes[0] + north[:, None] * axes[1]
    latitude, longitude, _ = geodetic_from_ecef(points)
    return Track.from_geodetic(latitude, longitude, np.full(len(way), 100.0))


def stated(errors: Errors, shape: Shape, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest probability at each position, and whether its track is the one driven, or within `_SAME_M` of it."""
    rng = np.random.default_rng([seed, SHAPES.index(shape)])
    seconds = (errors.time - errors.time[0]) / np.timedelta64(1, "s")
    line = made_line(_SPEED_MPS * float(seconds[-1]), rng)
    around = network_around(line, shape, seed)
    network, path = made(around), Trajectory.from_antenna_path(line)
    place = path.at_arc(np.minimum(_SPEED_MPS * seconds, path.arc_m[-1]))
    latitude, longitude, _ = geodetic_from_ecef(place)
    axes = enu_axes(latitude, longitude)[:, [1, 0, 2]]
    ecef = place + np.einsum("tij,ti->tj", axes, errors.error_m)
    rows = np.arange(len(ecef))
    log = PositionLog(
        path="made", time=errors.time, ecef_m=ecef, quality=5 + 0 * rows, sigma_m=errors.sigma_m, line=rows
    )
    matched = match(network, plan_log(log))
    known = np.isfinite(matched.probability)
    shares = np.column_stack([matched.probabilities, 1.0 - matched.probabilities.sum(axis=1)])[known]
    track = np.column_stack([matched.candidates.track, np.full(len(place), -1)])[known]
    rows, best = np.arange(len(shares)), np.argmax(shares, axis=1)
    names = np.array([*network.names, "none"])[track[rows, best]]
    _, apart = network.place_on(track[rows, best], latitude[known], longitude[known])
    right = np.isin(names, sorted(around.driven)) | ((shape == "fork") & (np.abs(apart) < _SAME_M))
    return shares[rows, best], right

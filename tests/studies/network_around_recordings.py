"""Recordings on networks built around them: what is stated of tracks, and what is `ok` or has a level on a wrong one.

``python tests/studies/network_around_recordings.py [--seeds N] [--runs N]`` prints two tables.

The first: the errors of the conventional positions of each recording, in their order and with their stated standard
deviations, along made lines of any heading with the networks of `network_around` (parallel tracks, loop, fork, viaduct,
four tracks): of what is stated with a probability of 0.9, 0.99 and 0.999 the share that is right, and how many runs are
wrong anywhere from 0.99 on.

The second: `railfix run` on such networks around the way driven; between towers the line is one lap, which the
drive passes twice. The car park in Japan, with curves of 10 m radius, and the corners of Berlin are no railway: they
are in the first table alone.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

import paths
import recordings_truth
from network_around import SHAPES, Shape, made, network_around, write_network
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.evaluate import interpolate_reference
from railfix.io import PositionLog, read_navigation, read_observations
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.without_map import locate
from railfix.run import RunInputs, RunOptions, TrackReading, run_files
from railfix.track import Track, from_positions
from railfix.track.network_match import match, plan_log
from railfix.track.trajectory import Trajectory

STATED: Final = ((0.9, 0.99), (0.99, 0.999), (0.999, 1.0 + 1e-9))
#: Speed on a made line [m/s], and standard deviation of its curvature [1/m].
_SPEED_MPS, _CURVATURE = 15.0, 1.0 / 1500.0
#: A fork counts from this distance between its tracks on [m].
_SAME_M: Final = 2.0


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Files of a drive and its truth; `lap` is the number of the first point of one lap, None without."""

    observations: Path
    navigation: tuple[Path, ...]
    truth: recordings_truth.Truth
    lap: int | None = None


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
            observations=towers / "20210517.light-urban.tste.ublox.f9p.obs", navigation=nav, truth=between, lap=40
        ),
        "towers M8T": Recording(
            observations=towers / "20210517.light-urban.tste.ublox.m8t.GC.obs", navigation=nav, truth=between, lap=40
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


def run_around(recording: Recording, shape: Shape, seed: int) -> Iterator[tuple[str, int, int, int, int, int]]:
    """Of each table: rows, `ok` or `tracking` ones, those on a wrong track, finite levels, those on a wrong track."""
    line = from_positions(*recording.truth, spacing_m=5.0)
    if recording.lap is not None:
        line = _lap(line, recording.lap)
    around = network_around(line, shape, seed)
    inputs = {"front": (recording.observations,), "nav": recording.navigation}
    with tempfile.TemporaryDirectory() as name:
        track = write_network(around, Path(name) / "net.gpkg")
        summary = run_files(
            RunInputs(**inputs, track=(track,)),
            Config(filter="track"),
            out=Path(name) / "results",
            options=RunOptions(track=TrackReading(height_datum="ellipsoidal")),
        )
        for table, passed in (("positions", "ok"), ("train", "tracking")):
            rows = pl.read_parquet(summary.files[f"{table}.parquet"])
            # a track that is divided where another ends on it is two, "main/1" and "main/2"
            wrong = ~rows["track"].str.split("/").list.first().is_in(sorted(around.driven)).fill_null(value=True)
            good, level = rows["status"] == passed, rows["protection_level_m"].is_finite().fill_null(value=False)
            yield table, len(rows), good.sum(), (good & wrong).sum(), level.sum(), (level & wrong).sum()


def _lap(line: Track, first: int) -> Track:
    """One lap of a line from one of its points, closed."""
    points = line.ecef_m
    apart = np.linalg.norm(points - points[first], axis=1)
    back = first + 100 + int(np.argmin(apart[first + 100 :]))
    return Track.from_ecef(np.vstack([points[first:back], points[first]]))


def _share(stated_: np.ndarray, right: np.ndarray, low: float, high: float) -> str:
    rows = (stated_ >= low) & (stated_ < high)
    return f"{int(rows.sum()):7d} {right[rows].mean():.4f}" if rows.any() else f"{0:7d}      -"


def print_stated(every: dict[str, Recording], seeds: int) -> None:
    """The first table."""
    print(f"{'errors of':11s} {'network':13s} stated 0.9, right     0.99, right    0.999, right   runs wrong at 0.99")
    together: list[tuple[np.ndarray, np.ndarray]] = []
    for name, recording in every.items():
        errors = recorded_errors(recording)
        for shape in SHAPES:
            runs = [stated(errors, shape, seed) for seed in range(seeds)]
            together += runs
            wrong = sum(bool((~right & (share >= 0.99)).any()) for share, right in runs)
            both = [np.concatenate(parts) for parts in zip(*runs, strict=True)]
            cells = "  ".join(_share(*both, low, high) for low, high in STATED)
            print(f"{name:11s} {shape:13s} {cells}   {wrong} of {len(runs)}", flush=True)
    both = [np.concatenate(parts) for parts in zip(*together, strict=True)]
    print(f"{'all':25s} " + "  ".join(_share(*both, low, high) for low, high in STATED))


def print_runs(every: dict[str, Recording], count: int) -> None:
    """The second table."""
    print("\nruns on networks around the way driven: passed, of those on a wrong track; levels, on a wrong track")
    for name in ("towers F9P", "towers M8T", "phone"):
        for shape in SHAPES:
            for seed in range(count):
                for table, rows, good, bad, level, no in run_around(every[name], shape, seed):
                    word = "ok" if table == "positions" else "tracking"
                    counts = f"{good:5d} {bad:3d}; {level:5d} {no:3d}"
                    print(f"{name:11s} {shape:13s} {seed} {rows:5d} {word:8s} {counts}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6, help="networks of each shape and recording, first table")
    parser.add_argument("--runs", type=int, default=1, help="networks of each shape and recording, second table")
    given = parser.parse_args()
    every = recordings()
    if given.seeds:
        print_stated(every, given.seeds)
    if given.runs:
        print_runs(every, given.runs)


if __name__ == "__main__":
    main()

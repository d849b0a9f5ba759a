"""Simulated runs of issue 63 on networks that lack the track, or have others beside, above and below it.

``python tests/studies/map_networks.py [--seeds N] [--run] [--base] [--only WORD]``: the scenario is
`cases/maps/sc.toml` of the shared data. Of each network: the share of positions of which the right track is named,
where the map has it and where it does not, rows on a wrong track with a probability above 0.999, and the largest one;
with ``--run`` the rows of `railfix run` that are `ok` or `tracking` and those of them on a wrong track, also with a
probability above 0.999. With ``--base`` these runs have a base station: the rear antenna of a train of the same
scenario that stands all the time.
"""

from __future__ import annotations

import argparse
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl
import tomli_w
from typer.testing import CliRunner

import paths
from network_around import Around, made, write_network
from railfix.cli import app
from railfix.core.arrays import take_rows
from railfix.core.geodesy import axes_at, geodetic_from_ecef
from railfix.io import PositionLog
from railfix.io.logs import read_navigation, read_observations
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.without_map import locate
from railfix.track import read_track
from railfix.track.network_match import match, plan_log
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import read_vehicle

SCENARIO: Final = paths.DATA / "cases" / "maps" / "sc.toml"
END_M: Final = 1e9  #: Beyond the end of the line [m].
PAST_M: Final = 3.0  #: A position this far past the end of its track is on it: tracks end at a point every 5 m [m].
#: Tracks that were driven, and from where to where the map has them [m]; elsewhere it lacks the track.
Driven = Mapping[str, tuple[float, float]]
_SIGMA: Final = {"sigma_plan_m": "0.1", "sigma_height_m": "0.1"}


def networks(line: Trajectory) -> dict[str, tuple[Around, Driven]]:
    """Return the networks around a line by name, each with the tracks that were driven."""
    places = np.append(np.arange(0.0, float(line.arc_m[-1]), 5.0), line.arc_m[-1])
    points, right = line.at_arc(places), line.across[line.segment_at(places)[0]]
    up = axes_at(points)[:, 2]

    def part(
        aside: float, first: float = 0.0, last: float = END_M, *, ramp_m: float = 0.0, up_m: float = 0.0
    ) -> np.ndarray:
        inside = (places >= first) & (places <= last)
        share = np.clip((places - first) / ramp_m, 0.0, 1.0) if ramp_m else np.ones(len(places))
        shift = aside * (3.0 * share**2 - 2.0 * share**3)
        return (points + shift[:, None] * right + up_m * up)[inside]

    def around(driven: Driven, **tracks: np.ndarray) -> tuple[Around, Driven]:
        return Around(tracks=tracks, driven=frozenset(driven)), driven

    whole, main = {"M": (0.0, END_M)}, {"M1": (0.0, 400.0), "M2": (400.0, 900.0), "M3": (900.0, END_M)}
    found = {
        "three tracks": around(whole, M=part(0.0), R36=part(3.6), L36=part(-3.6)),
        "ladder": around(
            main, **{name: part(0.0, *at) for name, at in main.items()}, D1=part(4.5, 400.0, 900.0, ramp_m=60.0),
            D2=part(4.5, 900.0), W=part(-3.6, 0.0, 400.0),
        ),
        "flyover": around(whole, M=part(0.0), VIADUCT=part(0.0, up_m=8.0)),
        "tunnel": around(whole, M=part(0.0), TUNNEL=part(0.5, up_m=-15.0)),
    }  # fmt: skip
    for aside, other in ((3.6, 7.2), (7.2, -10.8), (15.0, -18.6)):
        found[f"missing {aside:g}"] = around({}, R=part(aside), O=part(other))
        found[f"missing {aside:g} from 500"] = around(
            {"M1": (0.0, 500.0)}, M1=part(0.0, 0.0, 500.0), R=part(aside, 500.0)
        )
    return found


def true_names(driven: Driven, chainage_m: np.ndarray) -> np.ndarray:
    """Return the name of the track driven at chainages, "none" where the map lacks it."""
    names = np.full(len(chainage_m), "none", dtype=object)
    for name, (first, last) in driven.items():
        names[(chainage_m >= first) & (chainage_m <= last + PAST_M)] = name
    return names


def invoke(*words: object) -> str:
    """Run a command, and return what it said where it ended with an error."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exception is None or isinstance(result.exception, SystemExit), (words, result.exception)
    return "" if result.exit_code == 0 else result.stderr.strip()


def matched_row(folder: Path, around: Around, driven: Driven) -> str:
    """Match conventional positions, once a second, to a network."""
    config, navigation = Config(), read_navigation([folder / "nav.rnx.gz"])
    log = read_observations(folder / "front.crx.gz")
    step = max(1, round(1.0 / float(np.median(np.diff(log.time) / np.timedelta64(1, "s")))))
    place = locate(log[::step], known_from_start(config, navigation=navigation), config, ChannelBook(config))
    place = take_rows(place, np.isfinite(place.ecef_m[:, 0]))
    rows = np.arange(len(place.time))
    positions = PositionLog(
        path="made", time=place.time, ecef_m=place.ecef_m, quality=5 + 0 * rows, sigma_m=place.sigma_m, line=rows
    )
    above = read_vehicle(folder / "vehicle.toml").antennas["front"].up_m
    network = made(around)
    network = replace(network, tracks=tuple(replace(t, metadata=t.metadata | _SIGMA) for t in network.tracks))
    found = match(network, plan_log(positions, antenna_up_m=above))
    true = true_names(driven, chainages(folder, place.time))
    names = np.array([*(name.split("/")[0] for name in network.names), "none"], dtype=object)[found.track]
    wrong, there = (names != true) & (names != "none"), true != "none"
    largest = float(np.max(np.where(wrong, found.probability, 0.0)))
    shares = [f"{(names == true)[k].mean():.3f}" if k.any() else "    -" for k in (there, ~there)]
    certain = int((wrong & (found.probability > 0.999)).sum())
    named = f"named {shares[0]} of {there.sum():3d}, none {shares[1]} of {(~there).sum():3d}"
    return f"{named}; wrong above 0.999: {certain}, largest {largest:.4f}"


def chainages(folder: Path, time: np.ndarray) -> np.ndarray:
    """Return chainages of the front antenna by the ground truth."""
    truth = pl.read_csv(folder / "truth.csv.gz", comment_prefix="#").filter(pl.col("antenna") == "front")
    at = truth["time_gpst"].to_numpy().astype("datetime64[ns]").astype(np.int64)
    return np.interp(time.astype("datetime64[ns]").astype(np.int64), at, truth["chainage_m"].to_numpy())


def base_words(folder: Path, seed: int) -> tuple[object, ...]:
    """Simulate the log of a base station, and return the options that name it."""
    scenario, out = tomllib.loads(SCENARIO.read_text()), folder / "base"
    length = float(np.ptp(read_observations(folder / "front.crx.gz").time) / np.timedelta64(1, "s"))
    scenario |= {"seed": seed, "duration_s": length, "run": {"first_stand_s": length + 1.0}}
    (folder / "base.toml").write_text(tomli_w.dumps(scenario))
    assert not invoke("simulate", folder / "base.toml", "--out", out)
    truth = pl.read_csv(out / "truth.csv.gz", comment_prefix="#").filter(pl.col("antenna") == "rear")
    place = geodetic_from_ecef(truth.select("x_m", "y_m", "z_m").to_numpy()[0])
    return ("--base", out / "rear.crx.gz", "--base-place", ",".join(f"{float(v):.9f}" for v in place))


def run_rows(folder: Path, around: Around, driven: Driven, base: tuple[object, ...] = ()) -> Iterator[str]:
    """Run a network with the filter, and count passed rows and those on a wrong track."""
    track, out = write_network(around, folder / "net.gpkg"), folder / "out"
    refused = invoke(
        "run", "--front", folder / "front.crx.gz", "--nav", folder / "nav.rnx.gz", "--vehicle", folder / "vehicle.toml",
        "--track", track, "--height-datum", "ellipsoidal", "--plan-sigma", 0.1, "--filter", "track", "--out", out,
        "--overwrite", *base,
    )  # fmt: skip
    if refused:
        yield refused[:200]
        return
    for table, passed in (("positions", "ok"), ("train", "tracking")):
        rows = pl.read_parquet(out / f"{table}.parquet")
        rows = rows.filter(pl.col("antenna") == "front") if "antenna" in rows.columns else rows
        true = true_names(driven, chainages(folder, rows["time_gpst"].to_numpy()))
        names = np.array([str(name).split("/")[0] for name in rows["track"]], dtype=object)
        good, certain = (
            (rows["status"] == passed).to_numpy(),
            (rows["track_probability"].fill_null(0.0) > 0.999).to_numpy(),
        )
        wrong = good & (names != true)
        counts = f"{wrong.sum()} of them wrong, {(wrong & certain).sum()} above 0.999"
        yield f"{table}: {len(rows)} rows, {good.sum()} {passed}, {counts}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--run", action="store_true")
    parser.add_argument("--base", action="store_true")
    given = parser.parse_args()
    for seed in range(given.first, given.first + given.seeds):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name) / "sim"
            assert not invoke("simulate", SCENARIO, "--seed", seed, "--out", folder)
            line = Trajectory.from_antenna_path(read_track(folder / "track.csv"))
            base = base_words(folder, seed) if given.base else ()
            for kind, (around, driven) in networks(line).items():
                if given.only not in kind:
                    continue
                print(f"{seed:2d} {kind:22s} {matched_row(folder, around, driven)}", flush=True)
                for text in run_rows(folder, around, driven, base) if given.run or given.base else ():
                    print(f"   {kind:22s} {text}", flush=True)


if __name__ == "__main__":
    main()

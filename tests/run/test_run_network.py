"""Runs on a network of tracks: the route found from the log, the tracks beside it, frames, evaluation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from network_around import Around, network_around, write_network
from network_made import made_network, made_run, segment, to_degrees, write_stations
from railfix.cli import app
from railfix.core.errors import MismatchError
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.evaluate import evaluate_run
from railfix.evaluate.evaluation_inputs import EvaluationOptions, read_run
from railfix.evaluate.place import read_run_track
from railfix.pipeline.config import Config
from railfix.run import RunInputs, RunOptions, RunSummary, TrackReading, run_files
from railfix.run.driver import open_inputs
from railfix.run.inputs import OF_LOG
from railfix.run.sources import open_line
from railfix.simulate.demonstration import demo_inputs, demo_truth
from railfix.simulate.run import write_run
from railfix.simulate.scenario_file import load_recipe
from railfix.track import read_track
from railfix.track.frames import points_at
from railfix.track.network import Network
from railfix.track.network_match import match
from railfix.track.network_read import links_of_ends
from railfix.track.network_route import find_route
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("A10")
LOOP_M = (250.0, 550.0)
ELLIPSOIDAL = RunOptions(track=TrackReading(height_datum="ellipsoidal"))


def _demo_on(folder: Path, *, aside_m: float, crs: str = "EPSG:4326") -> RunInputs:
    """The demo log on its own line, which has a loop beside it, as a GeoPackage."""
    inputs = demo_inputs()
    path = folder / "station.gpkg"
    write_stations(path, read_track(inputs.track), crs=crs, loops_m=[LOOP_M], aside_m=aside_m)
    return inputs.replaced(track=(path,), rear=(), vehicle=None)


@pytest.fixture(scope="module")
def near(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunInputs, RunSummary]:
    folder = tmp_path_factory.mktemp("near")
    inputs = _demo_on(folder, aside_m=4.5)
    return inputs, run_files(inputs, Config(filter="track"), out=folder / "results", options=ELLIPSOIDAL)


def test_route_is_found_and_the_loop_keeps_its_probability(near: tuple[RunInputs, RunSummary]) -> None:
    _, summary = near
    record = json.loads(summary.files["run.json"].read_text())
    route = record["line"]["route"]
    assert route["tracks"] == ["line 0", "main 0", "line 1"]
    assert [a["track"] for a in route["alternatives"]] == ["loop 0"]
    assert 0.05 < route["alternatives"][0]["largest_probability"] < 0.5
    assert route["least_probability"] == pytest.approx(1.0 - route["alternatives"][0]["largest_probability"], abs=0.02)
    notes = " ".join(summary.notes)
    assert "route found from the log: line 0, main 0, line 1" in notes
    assert "may be on loop 0 instead of main 0" in notes


def test_rows_name_their_track_and_the_probabilities_of_those_near(near: tuple[RunInputs, RunSummary]) -> None:
    _, summary = near
    rows = pl.read_parquet(summary.files["positions.parquet"])
    placed = rows.filter(pl.col("chainage_m").is_not_null())
    assert rows.filter(pl.col("chainage_m").is_null())["track"].null_count() == len(rows) - len(placed)
    for name, low, high in (("line 0", 0.0, LOOP_M[0]), ("main 0", *LOOP_M), ("line 1", LOOP_M[1], 1e4)):
        own = placed.filter(pl.col("track") == name)
        assert len(own) > 20
        assert own["chainage_m"].is_between(low - 0.01, high + 0.01).all()
        # the antenna leans out of a track that has no chainage of its own, gradients are in the chainage of the line
        along = own["chainage_m"] - low - own["track_chainage_m"]
        assert along.abs().max() < 1.0  # type: ignore[operator]
    near_ = pl.read_parquet(summary.files["tracks.parquet"])
    sums = near_.group_by("time_gpst", "antenna").agg(pl.col("probability").sum())
    assert len(sums) == len(placed)
    assert (sums["probability"] - 1.0).abs().max() < 2e-3  # type: ignore[operator]
    loop = near_.filter(pl.col("track") == "loop 0")
    assert not loop["on_route"].any()
    assert loop["offset_m"].median() == pytest.approx(4.5, abs=0.3)
    # the position without the map, which is metres from the route
    assert abs(loop["unconstrained_offset_m"].median()) == pytest.approx(4.5, abs=3.0)
    assert placed["unconstrained_offset_m"].abs().median() > 0.1  # type: ignore[operator]
    assert placed["unconstrained_offset_m"].abs().quantile(0.9) < 5.0
    assert placed["unmapped_probability"].is_between(0.0, 0.1).all()
    train = pl.read_parquet(summary.files["train.parquet"])
    assert train.filter(pl.col("chainage_m").is_not_null())["track"].null_count() == 0


def test_results_are_those_on_the_route_given_as_a_map(near: tuple[RunInputs, RunSummary], tmp_path: Path) -> None:
    _, summary = near
    given = demo_inputs().replaced(rear=(), vehicle=None)
    plain = run_files(given, Config(filter="off"), out=tmp_path / "plain")
    columns = ("time_gpst", "x_m", "y_m", "z_m", "status")
    ours, theirs = (pl.read_parquet(s.files["positions.parquet"]).select(columns) for s in (summary, plain))
    both = ours.join(theirs, on="time_gpst")
    apart = both.select((pl.col("x_m") - pl.col("x_m_right")).abs()).to_series()
    assert len(both) == len(theirs)
    # the map has the points 250 and 550 m besides, which bend nothing
    assert apart.max() < 1e-3  # type: ignore[operator]
    assert "route" not in " ".join(plain.notes)


def test_beside_the_route_no_position_is_ok_and_nothing_bounds_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The route is the loop, 20 m beside the track on which the demo drove: the probability of the route says so."""

    def wrong(network: Network, *_: object) -> tuple[list[int], list[int]]:
        return [network.find_index(name) for name in ("line 0", "loop 0", "line 1")], []

    monkeypatch.setattr("railfix.run.route.find_route", wrong)
    inputs = _demo_on(tmp_path, aside_m=20.0)
    summary = run_files(inputs, Config(filter="track"), out=tmp_path / "results", options=ELLIPSOIDAL)
    for table, passed in (("positions", "ok"), ("train", "tracking")):
        rows = pl.read_parquet(summary.files[f"{table}.parquet"])
        beside = rows.filter(pl.col("track_probability") < 1.0 - Config().track_risk)
        assert len(beside) > 20
        assert passed not in beside["status"].to_list()
        assert not beside["protection_level_m"].is_finite().any()
        assert (rows.filter(pl.col("track_probability") > 0.999)["status"] == passed).any()


def test_a_loop_that_is_possible_leaves_no_position_ok(near: tuple[RunInputs, RunSummary]) -> None:
    """The loop is 4.5 m from the track driven: likelier than the risk, less likely than that track."""
    _, summary = near
    for table, passed in (("positions", "ok"), ("train", "tracking")):
        rows = pl.read_parquet(summary.files[f"{table}.parquet"])
        on_main = rows.filter((pl.col("track") == "main 0") & (pl.col("track_probability") < 0.99))
        assert len(on_main) > 20
        assert (on_main["track_probability"] > 0.5).all()
        assert passed not in on_main["status"].to_list()
        assert not on_main["protection_level_m"].is_finite().any()
        assert passed in rows.filter(pl.col("track") == "line 0")["status"].to_list()


def test_evaluation_reads_the_track_that_the_run_wrote(near: tuple[RunInputs, RunSummary]) -> None:
    _, summary = near
    folder = summary.files["run.json"].parent
    assert read_run_track(read_run(folder)).chainage_m[-1] == pytest.approx(756.0, abs=1.0)
    result = evaluate_run(folder, demo_truth(), options=EvaluationOptions(method="trajectory"))
    assert result is not None


def test_a_map_in_another_frame_is_moved_also_in_a_network(tmp_path: Path) -> None:
    """JGD2011 has moved by decimetres since 2011: the same tracks named as WGS 84 are off by as much."""
    frames = {}
    for name, crs in (("wgs84", "EPSG:4326"), ("jgd2011", "EPSG:6668")):
        (tmp_path / name).mkdir()
        inputs = _demo_on(tmp_path / name, aside_m=4.5, crs=crs)
        _, line, _ = open_inputs(inputs, ELLIPSOIDAL, Config(filter="off"))
        frames[name] = line
    shift = frames["jgd2011"].frame
    assert 0.1 < np.hypot(shift.east_m, shift.north_m) < 0.6
    assert frames["jgd2011"].route.names == ["line 0", "main 0", "line 1"]
    assert not frames["jgd2011"].from_file
    # the line stands where the satellites have it, the route's positions where the map has it
    moved = frames["jgd2011"].track.ecef_m - frames["wgs84"].track.ecef_m
    assert np.linalg.norm(moved, axis=1) == pytest.approx(
        np.linalg.norm([shift.east_m, shift.north_m, shift.up_m]), abs=0.6
    )


def test_evaluation_of_a_run_on_a_map_that_was_moved(tmp_path: Path) -> None:
    """The track of the record is the map's own; positions lie where it was moved to."""
    inputs = demo_inputs().replaced(rear=())
    text = inputs.track[0].read_text()
    path = tmp_path / "line.csv"
    path.write_text("# crs: EPSG:6668\n" + "\n".join(x for x in text.splitlines() if not x.startswith("# crs")) + "\n")
    summary = run_files(inputs.replaced(track=(path,)), Config(filter="off"), out=tmp_path / "results")
    assert "track.csv" in summary.files
    evaluate_run(tmp_path / "results", demo_truth(), options=EvaluationOptions(method="trajectory"))


def test_without_a_log_a_network_is_a_sentence(tmp_path: Path) -> None:
    inputs = _demo_on(tmp_path, aside_m=4.5)
    with pytest.raises(MismatchError, match=r"4 tracks that do not join to one route; .* 'railfix map route'"):
        open_line(inputs.track, None, antennas=("front",), reading=TrackReading(height_datum="ellipsoidal"))


def test_a_network_elsewhere_is_a_sentence(tmp_path: Path, recordings: Path) -> None:
    folder = recordings / "rail" / "infrabel"
    inputs = demo_inputs().replaced(track=(folder / "network_airport.geojson",), heights=OF_LOG)
    with pytest.raises(MismatchError, match=r"the map is \d+ km away from the positions of the log"):
        run_files(inputs, Config(filter="off"), out=tmp_path / "results")


def test_memory_of_the_track_is_kept_without_positions() -> None:
    """A loop entered with good positions is still the loop after a gap, a tunnel, on it."""
    net = made_network(10.0)
    log, on = made_run(net, [0, 2, 3], rng=np.random.default_rng(5), sigma_m=0.2)
    latitude = np.where((on == 2) & (np.cumsum(on == 2) > 40), np.nan, log.latitude_deg)
    gap = type(log)(**{**vars(log), "latitude_deg": latitude})
    matched = match(net, gap)
    assert np.isnan(matched.probability[np.isnan(latitude)]).all()
    assert set(matched.track[np.isfinite(latitude)].tolist()) == {0, 2, 3}
    assert find_route(net, matched) == ([0, 2, 3], [])


def test_a_train_that_runs_back_over_another_track_has_a_route_and_says_so() -> None:
    net = made_network(10.0)
    there, _ = made_run(net, [0, 1, 3], rng=np.random.default_rng(5), sigma_m=0.05)
    back, _ = made_run(net, [0, 2, 3], rng=np.random.default_rng(6), sigma_m=0.05)
    both = type(there)(
        path="made",
        time=np.concatenate([there.time, back.time + np.timedelta64(1, "h")]),
        **{
            name: np.concatenate([getattr(there, name), getattr(back, name)[::-1]])
            for name in ("latitude_deg", "longitude_deg", "sigma_m")
        },
    )
    route, left_out = find_route(net, match(net, both, sigma_m=0.3))
    assert sorted([*route, *left_out]) == [0, 1, 2, 3]
    assert len(left_out) == 1
    assert left_out[0] in (1, 2)


def test_there_and_back_over_the_same_tracks_chainage_rises_on_the_way_there() -> None:
    net = made_network(10.0)
    log, _ = made_run(net, [0, 1, 3], rng=np.random.default_rng(5), sigma_m=0.05)
    matched = match(net, log, sigma_m=0.3)
    for seed in range(20):
        share = np.random.default_rng(seed).uniform(0.5, 1.0, len(log.time))[:, None] * matched.probabilities
        found = replace(
            matched,
            track=np.concatenate([matched.track, matched.track[::-1]]),
            probabilities=np.concatenate([share, share[::-1]]),
            candidates=replace(
                matched.candidates, track=np.concatenate([matched.candidates.track, matched.candidates.track[::-1]])
            ),
        )
        assert find_route(net, found) == ([0, 1, 3], [])


@pytest.mark.parametrize("jump", [(30, 10, 5), (2, 3, 3), (60, 4, 0)])
def test_a_jump_to_a_track_beside_cuts_no_connected_route(jump: tuple[int, int, int]) -> None:
    """The loop, nothing and the main track again: no way leads from the loop back, but one over all main tracks."""
    net = made_network(10.0)
    log, on = made_run(net, [0, 1, 3, 4, 6], rng=np.random.default_rng(5), sigma_m=0.05)
    matched = match(net, log, sigma_m=0.3)
    assert find_route(net, matched) == ([0, 1, 3, 4, 6], [])
    start, beside, unmapped = jump
    track, first = matched.track.copy(), int(np.argmax(on == 1)) + start
    track[first : first + beside] = 2
    track[first + beside : first + beside + unmapped] = -1
    for turn in (slice(None), slice(None, None, -1)):
        found = replace(matched, track=track[turn])
        route, left_out = find_route(net, found)
        assert (route, left_out) == ([0, 1, 3, 4, 6][turn], [2])


def test_a_closed_route_driven_three_times_passes_each_track_once() -> None:
    """A ring of two halves and a loop beside the second, which the train takes on its second round."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    east, north = 500.0 * np.sin(turn), 500.0 * np.cos(turn)
    wider = 1.0 + 0.03 * np.sin(turn[90:] - np.pi)
    tracks = (
        segment("first", *to_degrees(east[:91], north[:91])),
        segment("second", *to_degrees(east[90:], north[90:])),
        segment("loop", *to_degrees(east[90:] * wider, north[90:] * wider)),
    )
    net = Network(tracks=tracks, links=())
    net = replace(net, links=links_of_ends(net))
    log, on = made_run(net, [0, 1, 0, 2, 0, 1, 0], rng=np.random.default_rng(2), sigma_m=0.2)
    matched = match(net, log)
    assert (matched.track == on).mean() > 0.98
    assert find_route(net, matched) == ([0, 1], [2])


def test_a_gap_in_the_map_ends_the_route_and_is_said() -> None:
    """Of tracks without a connection those before or behind it are the route, and the others are left out."""
    made = made_network(10.0)
    for cut in (0, 2):
        links = tuple(link for link in made.links if {link.first, link.second} not in ({cut, 1}, {1, 3}, {2, 3}))
        net = replace(made, links=links)
        log, _ = made_run(made, [0, 1, 3], rng=np.random.default_rng(5), sigma_m=0.05)
        route, left_out = find_route(net, match(net, log, sigma_m=0.3))
        assert set(route) | set(left_out) >= {0, 1, 3}
        assert not set(route) & set(left_out)
        assert 1 <= len(left_out) <= 2


def test_positions_are_matched_in_the_frame_of_the_map() -> None:
    """Positions of satellites on tracks in ETRS89: on them when moved, 0.8 m north-east of them as they are."""
    made = made_network(10.0)
    net = replace(made, tracks=tuple(replace(t, frame="EPSG:4258", crs="EPSG:4258") for t in made.tracks))
    log, on = made_run(made, [0, 1, 3], rng=np.random.default_rng(5), sigma_m=1e-6)
    ecef = ecef_from_geodetic(log.latitude_deg, log.longitude_deg, np.zeros(len(on)))
    moved, _ = points_at(ecef, "EPSG:4258", log.time[0])
    latitude, longitude, _ = geodetic_from_ecef(moved)
    received = replace(log, latitude_deg=latitude, longitude_deg=longitude)
    back, shift = received.transform_to(net)
    assert np.abs(match(net, back, sigma_m=0.5).offset_m).max() < 1e-3
    assert np.abs(match(net, received, sigma_m=0.5).offset_m) == pytest.approx(abs(shift.north_m), abs=0.05)
    timeless = replace(received, time=np.full(len(on), np.datetime64("NaT", "ns")))
    with pytest.raises(MismatchError, match=r"has no times.*--same-frame"):
        timeless.transform_to(net)
    assert timeless.transform_to(made)[1].method.startswith("used as it is")
    swapped = replace(log, latitude_deg=log.longitude_deg, longitude_deg=log.latitude_deg)
    with pytest.raises(MismatchError, match=r"the map is \d+ km away from .* swapped in the map or the log"):
        swapped.transform_to(made)
    elsewhere = replace(log, longitude_deg=log.longitude_deg + 6.0)
    with pytest.raises(MismatchError, match=r"the map is \d\d\d km away from .* its CRS is right"):
        elsewhere.transform_to(made)


@pytest.mark.slow
def test_from_the_geopackage_of_an_operator_and_a_log_of_an_hour_to_positions_with_track_names(tmp_path: Path) -> None:
    """The commands of docs/how-to.md, on an hour of a simulated train between stations with loops."""

    def run(*words: str) -> str:
        done = CliRunner().invoke(app, [str(word) for word in words])
        assert done.exit_code == 0, done.output
        return done.output

    made, out, net = tmp_path / "made", tmp_path / "results", tmp_path / "tracks.gpkg"
    settings = ("rate_hz=1", "line.length_m=36000", "run.cruise_mps=25")
    run("simulate", "demo", "--seconds", "3600", *(w for s in settings for w in ("--set", s)), "--out", made, "--plain")
    track = read_track(made / "track.csv")
    loops = [(float(at), at + 900.0) for at in np.arange(2000.0, track.chainage_m[-1] - 1500.0, 6000.0)]
    write_stations(net, track, crs="EPSG:6668", loops_m=loops, aside_m=4.5)
    assert "separate part" in run(
        "map", "network", net, "--height-datum", "ellipsoidal", "--page", tmp_path / "net.html"
    )
    log = ("--front", made / "front.rnx", "--nav", made / "nav.rnx", "--height-datum", "ellipsoidal")
    text = run("run", *log, "--track", net, "--out", out)
    assert "route found from the log: line 0, main 0, line 1" in text
    rows = pl.read_csv(out / "train.csv").filter(pl.col("track").is_not_null())
    truth = pl.read_csv(made / "truth.csv").filter(pl.col("antenna") == "front").select("time_gpst", "chainage_m")
    both = rows.join(truth, on="time_gpst", suffix="_true")
    assert len(both) > 3000
    bounds = np.array([b for loop in loops for b in loop])
    number = np.searchsorted(bounds, both["chainage_m_true"].to_numpy())
    names = np.array([name for k in range(len(loops)) for name in (f"line {k}", f"main {k}")] + [f"line {len(loops)}"])
    right = names[number] == both["track"].to_numpy()
    assert right.mean() > 0.99
    near = pl.read_csv(out / "tracks.csv")
    assert set(near["track"]) >= {f"loop {k}" for k in range(2)}
    run("report", out, "--out", tmp_path / "report.html")


def test_with_a_base_station_one_of_three_tracks_is_told_from_the_others(tmp_path: Path) -> None:
    """A train at rest; the base station is its own rear antenna, 18 m away, which has the same satellite errors."""
    scenario = load_recipe("demo").scenario(changes={"duration_s": 90.0, "run": {"first_stand_s": 91.0}})
    files = write_run(scenario.replaced(seed=5), tmp_path / "made")
    line = Trajectory.from_antenna_path(read_track(files["track"]))
    right = line.across[line.segment_at(line.arc_m)[0]]
    tracks = {name: line.at_arc(line.arc_m) + aside * right for name, aside in (("L", -3.6), ("M", 0.0), ("R", 3.6))}
    net = write_network(Around(tracks=tracks, driven=frozenset({"M"})), tmp_path / "net.gpkg")
    truth = pl.read_csv(files["truth"]).filter(antenna="rear")
    place = geodetic_from_ecef(truth.select("x_m", "y_m", "z_m").to_numpy()[0])
    alone = RunInputs(front=(files["front"],), nav=(files["nav"],), track=(net,), vehicle=files["vehicle"])
    options = ELLIPSOIDAL.replaced(base_place=",".join(f"{float(v):.9f}" for v in place))
    least = []
    for inputs, chosen in ((alone, ELLIPSOIDAL), (alone.replaced(base=(files["rear"],)), options)):
        found = open_inputs(inputs, chosen, Config())[1].route
        least.append(float(found.probability.min()) if found.names == ["M"] else 0.0)
    assert least[0] < 0.99
    assert least[1] > 1.0 - Config().track_risk


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["demo", "city"])
def test_a_simulated_train_beside_a_loop_of_four_metres_keeps_its_route(tmp_path: Path, scenario: str) -> None:
    """Seed 12 once ended with "no route joins", 1,046 epochs off the map and 307 m of error."""
    files = write_run(load_recipe(scenario).scenario().replaced(seed=12), tmp_path / "simulated")
    around = network_around(read_track(files["track"]), "loop", 12)
    inputs = RunInputs(
        front=(files["front"],), nav=(files["nav"],), track=(write_network(around, tmp_path / "net.gpkg"),)
    )
    summary = run_files(inputs, Config(filter="track"), out=tmp_path / "results", options=ELLIPSOIDAL)
    assert json.loads(summary.files["run.json"].read_text())["line"]["route"]["tracks"] == ["line 0", "main", "line 1"]
    assert "cannot be joined" not in " ".join(summary.notes)
    truth = pl.read_csv(files["truth"]).filter(antenna="front")
    for table, passed in (("positions", "ok"), ("train", "tracking")):
        rows = pl.read_parquet(summary.files[f"{table}.parquet"])
        assert "off_map" not in rows["status"]
        sure = rows.filter((pl.col("status") == passed) | pl.col("protection_level_m").is_finite())
        assert len(sure) > 0.4 * len(rows)
        assert sure["track"].is_in(sorted(around.driven)).all()
        error = (rows["chainage_m"] - truth["chainage_m"]).abs()
        assert error.quantile(0.95) < (20.0 if table == "positions" and scenario == "city" else 3.0)

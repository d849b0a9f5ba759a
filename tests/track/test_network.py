"""Networks of tracks: connections, routes, matching of positions, checks."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from network_made import made_network, made_run, segment, to_degrees
from network_recordings import shares
from railfix.cli.map import app
from railfix.core.errors import MismatchError, SettingsError
from railfix.report.charts_page import write_network_page
from railfix.track import read_track
from railfix.track.network import Network
from railfix.track.network_match import match, read_plan_positions
from railfix.track.network_read import check_network, links_of_ends, read_network
from railfix.track.network_route import find_route
from railfix.track.route import MapReading
from report_page import browser, fetched, visited
from route_matcher import matched_track

pytestmark = pytest.mark.requirement("A10")
INFRABEL = {"latitude_deg": "latitude", "longitude_deg": "longitude", "time_gpst": "timestamp"}


def test_near_agrees_with_every_segment_of_every_track() -> None:
    net = made_network(30.0)
    rng = np.random.default_rng(2)
    east, north = rng.uniform(0.0, 18_000.0, 300), rng.uniform(-20.0, 24.0, 300)
    found = net.near(*to_degrees(east, north), within_m=30.0)
    for k in range(0, 300, 7):
        best = {}
        for t, track in enumerate(net.tracks):
            lat0, lon0 = to_degrees(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
            x = (track.longitude_deg - 5.0) / (lon0[1] - lon0[0])
            y = (track.latitude_deg - 50.0) / (lat0[1] - lat0[0])
            d = np.stack([np.diff(x), np.diff(y)], axis=-1)
            r = np.stack([east[k] - x[:-1], north[k] - y[:-1]], axis=-1)
            share = np.clip((r * d).sum(axis=1) / (d * d).sum(axis=1), 0.0, 1.0)
            best[t] = float(np.hypot(*(r - share[:, None] * d).T).min())
        expected = sorted((v, t) for t, v in best.items() if v <= 29.9)
        got = [float(v) for v in np.abs(found.offset_m[k]) if np.isfinite(v) and v <= 29.9]
        assert got == pytest.approx([v for v, _ in expected][: len(got)], abs=0.01)
        assert len(got) >= min(len(expected), 8)


def test_near_takes_more_tracks_than_samples_at_first() -> None:
    """Fifty tracks side by side; the last positions, taken in a part of their own, lie away from all."""
    tracks = tuple(segment(f"T{k}", *to_degrees(np.array([0.0, 400.0]), np.full(2, 0.5 * k))) for k in range(50))
    north = np.r_[np.full(256, 10.0), np.full(10, 400.0)]
    found = Network(tracks=tracks, links=()).near(*to_degrees(np.full(266, 200.0), north), most=40)
    assert found.track.shape == (266, 40)
    assert (found.track[:256] >= 0).all()
    assert (found.track[256:] == -1).all()


def test_near_finds_the_farther_tracks_of_a_densely_drawn_yard() -> None:
    """Twelve tracks with a point each metre: hundreds of segments lie nearer than the outer track."""
    x = np.arange(0.0, 400.0)
    tracks = tuple(segment(f"T{k}", *to_degrees(x, np.full(400, 3.6 * k))) for k in range(12))
    found = Network(tracks=tracks, links=()).near(*to_degrees(np.array([200.3]), np.array([0.5])), most=12)
    assert found.track[0, :9].tolist() == list(range(9))
    assert np.abs(found.offset_m[0, :9]) == pytest.approx([abs(3.6 * k - 0.5) for k in range(9)], abs=1e-3)


def test_routes_pass_a_switch_by_stem_and_leg_only() -> None:
    net = made_network(10.0)
    assert net.shortest_route([0, 2, 3]) == [0, 2, 3]
    assert net.shortest_route([0, 3]) == [0, 1, 3]
    assert net.shortest_route([3, 0]) == [3, 1, 0]
    with pytest.raises(MismatchError, match="without turning back"):
        net.shortest_route([1, 2])
    with pytest.raises(SettingsError, match="no track 'x'"):
        net.find_index("x")


def test_connections_from_ends_are_those_that_were_made() -> None:
    net = made_network(10.0)
    found = {frozenset([(a.first, a.first_end), (a.second, a.second_end)]): a.navigable for a in links_of_ends(net)}
    for link in net.links:
        assert found[frozenset([(link.first, link.first_end), (link.second, link.second_end)])] == link.navigable


def test_a_track_is_divided_where_another_ends_on_it(tmp_path: Path) -> None:
    main_lat, main_lon = to_degrees(np.array([0.0, 1000.0]), np.array([0.0, 0.0]))
    x = np.linspace(0.0, 300.0, 31)
    leg_lat, leg_lon = to_degrees(300.0 + x, 4.0 * np.minimum(x / 100.0, 1.0) ** 2)
    lines = [
        {"type": "Feature", "properties": {"name": n}, "geometry": {"type": "LineString", "coordinates": c}}
        for n, c in (
            ("main", np.stack([main_lon, main_lat], axis=-1).tolist()),
            ("leg", np.stack([leg_lon, leg_lat], axis=-1).tolist()),
        )
    ]
    path = tmp_path / "net.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": lines}))
    net = read_network([path])
    assert net.names == ("main/1", "main/2", "leg")
    assert net.length_m[:2] == pytest.approx([300.0, 700.0], abs=0.1)
    assert net.shortest_route([0, 2]) == [0, 2]
    quality = check_network(net)
    assert (quality.switches, quality.parts) == (1, 1)
    assert [f.kind for f in quality.findings] == ["dead end"] * 3


def test_a_geojson_network_with_heights_has_its_names_and_relations(recordings: Path, tmp_path: Path) -> None:
    """The Belgian network with a height at each point: the same tracks and connections as without."""
    path = recordings / "rail" / "infrabel" / "network_airport.geojson"
    document = json.loads(path.read_text())
    for feature in document["features"]:
        if feature["geometry"]["type"] == "LineString":
            feature["geometry"]["coordinates"] = [[*p, 50.0] for p in feature["geometry"]["coordinates"]]
    raised = tmp_path / "raised.geojson"
    raised.write_text(json.dumps({**document, "name": "tracks"}))
    plan, solid = read_network([path]), read_network([raised], MapReading(height_datum="ellipsoidal"))
    assert solid.names == plan.names
    assert solid.links == plan.links
    assert not any(np.isnan(track.height_m).any() for track in solid.tracks)


def test_check_finds_a_gap_a_kink_and_a_track_twice() -> None:
    net = made_network(10.0)
    x = np.linspace(0.0, 440.0, 23)
    gap = segment("far", *to_degrees(-2.0 - x[::-1], 0.0 * x))
    twice = segment("twice", *to_degrees(440.0 + np.linspace(0.0, 1120.0, 57), np.full(57, 0.5)))
    damaged = Network(tracks=(*net.tracks, gap, twice), links=net.links)
    kinds = [(f.kind, f.tracks) for f in check_network(damaged).findings if f.kind != "dead end"]
    assert ("gap", ("0a", "far")) in kinds
    assert ("too near", ("01", "twice")) in kinds
    turned = replace(net, links=tuple(replace(link, navigable=True) for link in net.links))
    assert any(f.kind == "kink" for f in check_network(turned).findings)
    assert not [f for f in check_network(net).findings if f.kind != "dead end"]


@pytest.mark.slow
def test_runs_are_on_the_right_track_and_probabilities_are_calibrated() -> None:
    """Of tracks 3.6 m apart: the share on the right one at the probability that is given, over 25 runs."""
    net = made_network(10.0)
    given, right = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        leg = int(rng.integers(1, 3))
        log, on = made_run(net, [0, leg, 3, 4, 4 + int(rng.integers(1, 3)), 7], rng=rng, sigma_m=1.5)
        matched = match(net, log, sigma_m=1.5, correlation_s=60.0)
        middle = np.isin(on % 4, [1, 2])
        given.append(matched.probability[middle])
        right.append((matched.track == on)[middle])
    p, r = np.concatenate(given), np.concatenate(right)
    assert r.mean() > 0.85
    for low, high in ((0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        rows = (p >= low) & (p < high)
        # runs, not positions, are independent: a bound of 25 runs at three sigma
        assert r[rows].mean() > p[rows].mean() - 3.0 * np.sqrt(0.25 / 25.0)


def test_a_run_beside_the_map_has_no_track() -> None:
    net = made_network(10.0)
    log, _ = made_run(net, [0, 1, 3], rng=np.random.default_rng(3), sigma_m=0.5)
    aside = replace(log, latitude_deg=log.latitude_deg + 15.0 / 111_000.0)
    assert (match(net, aside).track == -1).mean() > 0.98


def test_cost_of_a_position_does_not_grow_with_the_network() -> None:
    import time

    spent = []
    for km in (10.0, 1000.0):
        net = made_network(km)
        log, _ = made_run(net, [0, 2, 3], rng=np.random.default_rng(1), sigma_m=0.8)
        net.near(log.latitude_deg, log.longitude_deg)
        times = []
        for _ in range(5):
            begin = time.process_time()
            net.near(log.latitude_deg, log.longitude_deg)
            times.append(time.process_time() - begin)
        spent.append(min(times))
    assert spent[1] < 4.0 * spent[0]


@pytest.fixture(scope="module")
def infrabel(recordings: Path) -> Network:
    return read_network([recordings / "rail" / "infrabel" / "network_airport.geojson"])


def test_infrabel_network_has_every_switch(infrabel: Network) -> None:
    quality = check_network(infrabel)
    assert (quality.tracks, quality.parts) == (74, 1)
    assert quality.length_m == pytest.approx(56_008.0, abs=1.0)
    assert len(infrabel.links) == 142
    # each stem reaches two legs: as many as relations between legs that trains cannot take, less the crossings
    assert quality.switches == 43
    by_ends = {
        frozenset([(a.first, a.first_end), (a.second, a.second_end)]): a.navigable for a in links_of_ends(infrabel)
    }
    stated = {frozenset([(a.first, a.first_end), (a.second, a.second_end)]): a.navigable for a in infrabel.links}
    assert set(stated) <= set(by_ends)
    agree = np.mean([by_ends[key] == navigable for key, navigable in stated.items()])
    assert agree > 0.9


@pytest.mark.parametrize(
    ("name", "share"), [("28876_L36-B", 0.99), ("29304_L36-B_to_L36N-B", 0.99), ("28554_L36-A_to_L36C-A", 0.80)]
)
def test_infrabel_runs_lie_on_tracks_where_the_positions_are_fixed(
    recordings: Path, infrabel: Network, name: str, share: float
) -> None:
    path = recordings / "rail" / "infrabel" / f"log_{name}.csv"
    matched = match(infrabel, read_plan_positions(path, columns=INFRABEL))
    with path.open() as file:
        fixed = np.array([row["position_type"] == "NARROW_INT3" for row in csv.DictReader(file)])
    assert (np.abs(matched.offset_m[fixed]) <= 5.0).mean() > share
    tracks, left_out = find_route(infrabel, matched)
    assert 4 <= len(tracks) <= 12
    assert not left_out


@pytest.mark.slow
def test_infrabel_positions_are_on_the_track_that_is_known_of_them(infrabel: Network, recordings: Path) -> None:
    """Also with errors of 2 m. On the last log fixed positions lie metres from the map: no track is known."""
    folder = recordings / "rail" / "infrabel"
    names = ("28554_L36-A_to_L36C-A", "29304_L36-B_to_L36N-B")
    first, last = (shares(infrabel, folder / f"log_{name}.csv", seeds=2) for name in names)
    assert first.known > 200
    # one position at a joint may be on the track before or after it
    assert first.right > 0.995
    assert first.right_with_errors > 0.95
    assert last.known == 0
    assert last.fixed_m > 1.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["28554_L36-A_to_L36C-A", "28573_L36-A_to_L36C-A_to_L25N-B", "28876_L36-B"])
def test_positions_of_a_probable_track_lie_on_it_as_by_shortest_routes(
    infrabel: Network, recordings: Path, name: str
) -> None:
    """Another matcher, which has no probabilities; one position in 600 lies at a joint of tracks of 6 m."""
    log = read_plan_positions(recordings / "rail" / "infrabel" / f"log_{name}.csv", columns=INFRABEL)
    _, offset = matched_track(infrabel, log)
    found = match(infrabel, log)
    probable = (found.probability > 0.9) & (found.track >= 0)
    assert probable.sum() > 250
    assert (np.abs(found.offset_m[probable]) <= 5.0).sum() >= (np.abs(offset[probable]) <= 5.0).sum() - 1


def test_page_has_the_network_its_faults_and_the_run(tmp_path: Path) -> None:
    net = made_network(10.0)
    x = np.linspace(0.0, 440.0, 23)
    net = replace(net, tracks=(*net.tracks, segment("far <b>", *to_degrees(-2.0 - x[::-1], 0.0 * x))))
    log, on = made_run(net, [0, 2, 3], rng=np.random.default_rng(1), sigma_m=0.8)
    page = tmp_path / "network.html"
    write_network_page(net, check_network(net), page, run=(log, match(net, log)))
    text = page.read_text()
    assert fetched(text) == []
    assert "default-src &#39;none&#39;" in text or "default-src 'none'" in text
    assert "0a and far &lt;b&gt; end 2.00 m apart" in text
    assert f"{len(on):,} positions were matched: 100.0 % are on a track" in text
    row = text[text.index('<th scope="row">02</th>') :].split("</tr>")[0]
    assert ["1,120" in row, ">0a<" in row, ">0b<" in row, f"{(on == 2).sum()}<" in row] == [True] * 4
    if browser() is not None:
        with visited(page, viewport={"width": 1400, "height": 900}) as shown:
            finding = shown.locator("table[data-name=findings] tbody th a").first
            east, north = map(float, str(finding.get_attribute("href")).removeprefix("#plan:").split(","))
            finding.click()
            shown.wait_for_function("document.querySelector('figure').plot.range('xaxis')[1] < 1000")
            ranges = shown.evaluate("['xaxis', 'yaxis'].map(axis => document.querySelector('figure').plot.range(axis))")
            for (low, high), place in zip(ranges, (east, north), strict=True):
                assert low < place < high
                assert high - low < 1000.0


@pytest.mark.slow
@pytest.mark.skipif(browser() is None, reason="no chromium is installed")
def test_names_of_tracks_do_not_lie_over_one_another_and_come_with_the_zoom(tmp_path: Path) -> None:
    net = made_network(10.0)
    x = np.linspace(0.0, 440.0, 23)
    many = [segment(f"a track with the name {k}", *to_degrees(x, 0.0 * x + 6.0 * k)) for k in range(1, 40)]
    page = tmp_path / "network.html"
    crowded = replace(net, tracks=(*net.tracks, *many))
    write_network_page(crowded, check_network(net), page)
    with visited(page, viewport={"width": 1400, "height": 900}) as shown:
        labels = "Number(document.querySelector('figure').dataset.labels)"
        some = int(shown.evaluate(labels))
        assert 0 < some < 39
        shown.evaluate(
            """() => { const plot = document.querySelector("figure").plot;
            const names = plot.layers.find(layer => layer.kind === "marks");
            const x = names.x[20], y = names.y[20];
            Plotly.relayout(plot.div, { "xaxis.range": [x - 20, x + 20], "yaxis.range": [y - 10, y + 10] }); }"""
        )
        # three or four tracks are in view: each has its name
        shown.wait_for_function(f"{labels} <= 4")
        assert int(shown.evaluate(labels)) >= 1


def test_plan_of_a_large_network_is_thinned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    net = made_network(100.0)
    write_network_page(net, check_network(net), tmp_path / "whole.html")
    monkeypatch.setattr("railfix.report.plots.network._DRAWN", 500)
    write_network_page(net, check_network(net), tmp_path / "thin.html")
    sizes = [(tmp_path / name).stat().st_size for name in ("whole.html", "thin.html")]
    assert sizes[1] < sizes[0] - 20_000
    assert "point and the ends of each track are drawn" in (tmp_path / "thin.html").read_text()


def test_route_and_match_commands(recordings: Path, tmp_path: Path) -> None:
    folder = recordings / "rail" / "infrabel"
    log = folder / "log_28876_L36-B.csv"
    columns = [word for ours, theirs in INFRABEL.items() for word in ("--column", f"{ours}={theirs}")]
    out = tmp_path / "matched.csv"
    words = ["match", str(folder / "network_airport.geojson"), "--log", str(log), "--out", str(out), *columns]
    pages = ["--picture", str(tmp_path / "run.png"), "--page", str(tmp_path / "run.html")]
    result = CliRunner().invoke(app, [*words, *pages])
    assert result.exit_code == 0, result.output
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1132
    assert {row["track"] for row in rows} >= {"88_L_3842", "88_L_9748"}
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert "1,132 positions" in (tmp_path / "run.html").read_text()
    profile = tmp_path / "profile.csv"
    profile.write_text("chainage_m,height_m\n0,90\n20000,110\n")
    line = tmp_path / "line.csv"
    words = ["route", str(folder / "network_airport.geojson"), "--positions", str(log), "--heights", str(profile)]
    result = CliRunner().invoke(app, [*words, "--out", str(line), *columns])
    assert result.exit_code == 0, result.output
    assert "88_L_3842, 88_L_5900" in result.output
    assert len(read_track(line).sections) == 1
    assert 4000.0 < read_track(line).chainage_m[-1] < 12_000.0

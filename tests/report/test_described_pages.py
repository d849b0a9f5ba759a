"""Every chart, picture, table and sentence of the pages, compared with a reviewed text of its numbers and words.

The tables behind them are small enough to check by hand. After an intended change,
``python tests/report/test_described_pages.py`` writes the references again; review their difference.
"""

from __future__ import annotations

import base64
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import polars as pl
import pytest
from matplotlib.figure import Figure

if __name__ == "__main__":
    sys.path[:0] = [str(folder) for folder in sorted(Path(__file__).resolve().parents[1].iterdir()) if folder.is_dir()]

from chart_tables import START, errors_table, observations_table, positions_table, times
from described import check_described, describe, describe_axes, describe_figure, page_text, write_described
from made_report import made_report_run
from network_made import log_at, made_network, to_degrees
from railfix.core.geodesy import ecef_from_geodetic
from railfix.integrity.stanford import stanford as sorted_epochs
from railfix.ranges.cn0_curve import Cn0Curve, Cn0CurveSource, Cn0Mean
from railfix.ranges.cn0_curve_fit import Cn0Samples
from railfix.report import figures, plots, read_runs, report_page
from railfix.report.campaign import report_campaign, write_campaign_page
from railfix.report.charts_page import write_network_page
from railfix.report.explain import explain_epoch, write_explanation
from railfix.report.plots import campaign, network, screens
from railfix.report.plots.chart import Band, Bars, Cells, Chart, Curve, Marks, Points, RangeBars
from railfix.screens import Cn0Limits, ScreenPicture
from railfix.track import Track, check_track
from railfix.track.network import Candidates
from railfix.track.network_match import Matched
from railfix.track.network_read import NetworkFinding, NetworkQuality, check_network
from report_page import Page

pytestmark = pytest.mark.requirement("D3")
NAN: Final = float("nan")


def line_track(points: int = 9, step_m: float = 5.0) -> Track:
    """A line to the north through the positions of the tables."""
    latitude = 35.0 + np.arange(points) * step_m / 110_941.0
    return Track.from_ecef(ecef_from_geodetic(latitude, np.full(points, 135.0), np.full(points, 50.0)))


def with_levels(positions: pl.DataFrame) -> pl.DataFrame:
    return positions.with_columns(
        protection_level_m=pl.Series([5.0, np.inf, 7.0, None, 60.0]),
        protection_fault_free_m=pl.Series([4.0, 4.0, 4.0, None, 4.0]),
        protection_one_fault_m=pl.Series([4.5, 4.5, 6.0, None, 50.0]),
        protection_two_faults_m=pl.Series([0.0, 0.0, 0.0, None, 0.0]),
        raim_level_m=pl.Series([3.0, 3.0, 3.0, None, 3.0]),
        protection_status=pl.Series(["available", "unavailable", "available", "alarm", "available"]),
    )


def long_errors() -> pl.DataFrame:
    """20,000 epochs that are thinned, with two outages, a few huge errors and a level that is missing at first."""
    time = np.concatenate([np.arange(8000.0), 9000.0 + np.arange(12_000.0)])
    error = np.sin(time / 50.0) * (1.0 + 0.2 * np.cos(time * 1.7))
    error[[100, 15_000]] = [-40.0, 66.0]
    level = np.where(time < 500.0, np.nan, 5.0 + np.cos(time / 700.0))
    level[17_000] = 900.0
    status = np.where(np.arange(len(time)) % 1000 == 0, "inconsistent", "ok")
    return pl.DataFrame(
        {
            "time_gpst": times(time), "status": status, "chainage_m": 7.0 * time, "error_m": error,
            "conventional_error_m": 2.0 * error + 0.5, "along_sigma_m": 1.0 + 0.1 * np.sin(time / 300.0),
            "protection_level_m": level, "interval_m": np.where(time % 9 == 0, 0.0, 7.0),
            "conventional_interval_m": 7.0 + (time % 5),
        }
    )  # fmt: skip


def _errors() -> Iterator[Chart]:
    errors = errors_table()
    filtered = errors.with_columns(error_m=pl.Series([0.1, 0.2, -0.3, 0.4, 0.5]))
    two_levels = errors.rename({"protection_level_m": "separation_protection_level_m"}).with_columns(
        sbas_protection_level_m=pl.lit(3.0)
    )
    failed = errors.with_columns(status=pl.Series(["ok", "inconsistent", "ok", "uncertain", "ok"]))
    for table in (errors, two_levels, failed, errors.drop("status", "along_sigma_m", "reference_good")):
        yield plots.error_over_time(table)
    for table, other in ((errors, filtered), (long_errors(), None)):
        yield plots.error_over_time(table, filtered=other)
        yield plots.error_over_chainage(table, filtered=other)
    nothing = errors.with_columns(error_m=pl.lit(None, dtype=pl.Float64))
    yield plots.error_ranges({"a": errors, "b": nothing})
    yield plots.errors_of_runs({"a": errors, "b": nothing, "c": long_errors()})


def _levels() -> Iterator[Chart]:
    positions = with_levels(positions_table())
    for table in (positions, positions_table(), positions.with_columns(chainage_m=pl.Series([1.0, None, 2.0, 3.0, 4]))):
        yield plots.levels_over_time(table, 20.0)
        yield plots.levels_over_chainage(table, 20.0)
    error, level = [1.0, -5.0, 12.0, 3.0, 25.0, np.nan, 1.0], [4.0, 4.0, 30.0, np.inf, 8.0, 5.0, np.nan]
    yield plots.stanford(sorted_epochs(times(np.arange(7)), error, level, alarm_limit_m=20.0))
    many = np.abs(np.sin(np.arange(200.0))) * 5.0
    yield plots.stanford(sorted_epochs(times(np.arange(200)), many, many + 4.0, alarm_limit_m=10.0), title="kept")


def _plans() -> Iterator[Chart]:
    positions = positions_table()
    yield plots.plan(positions)
    yield plots.plan(positions.with_columns(kilometrage_m=pl.lit(None, dtype=pl.Float64)))
    yield plots.plan(positions, error_m=np.array([0.1, -1.5, 3.0, np.nan, -80.0]))
    street = np.array([[135.0001, 34.9999], [135.0001, 35.0005], [136.0, 36.0], [137.0, 36.0]])
    yield plots.plan(
        positions.filter(pl.col("chainage_m") != 20.0), level_m=np.array([3.0, 7.0, 39.0, np.inf]), track=line_track(),
        filtered=positions.select("time_gpst", "x_m", "y_m", "z_m"), tunnels_m=[(15.0, 25.0), (31.0, 34.0)],
        background=[street, street + 10.0, street[::-1]], title="A line",
    )  # fmt: skip
    far = positions.with_columns(
        conventional_x_m=pl.Series([1e6, *[None] * 4]), kilometrage_m=pl.col("chainage_m") * 900
    )
    yield plots.plan(far)
    yield plots.plan(positions.with_columns(x_m=pl.lit(None, dtype=pl.Float64)))
    gap = pl.concat([positions, positions.with_columns(pl.col("chainage_m") + 500.0)] * 2)
    yield plots.plan(gap)
    east = np.arange(7000.0) * 0.01
    spread = pl.concat([positions.head(1)] * 7000).with_columns(
        x_m=pl.col("x_m") - east * np.sin(np.radians(135.0)), y_m=pl.col("y_m") + east * np.cos(np.radians(135.0)),
        conventional_x_m=pl.col("conventional_x_m") - east * np.sin(np.radians(135.0)),
        conventional_y_m=pl.col("conventional_y_m") + east * np.cos(np.radians(135.0)),
    )  # fmt: skip
    later = spread.with_columns((pl.col("time_gpst") + pl.duration(days=1)).cast(pl.Datetime("ns")))
    yield plots.plan(spread, filtered=later.select("time_gpst", "x_m", "y_m", "z_m"))


def _line() -> Iterator[Chart]:
    errors, positions = errors_table(), positions_table()
    crept = positions.with_columns(pl.col("chainage_m", "conventional_chainage_m") * 0.01)
    for table in (errors, errors.head(1), positions, crept, long_errors()):
        yield plots.interval_over_chainage(table)
        yield plots.interval_distribution(table)
    yield plots.satellites_over_time(positions)
    chunks = {"epochs": [100, 50], "positioning_s": [0.2, 0.3]}
    chunks["first_epoch_gpst"] = [str(t) for t in times([0.0, 60.0])]
    yield plots.processing_time(chunks)
    yield plots.processing_time({name: [] for name in chunks})
    places = positions.with_columns(error_m=pl.Series([0.1, 1.5, None, 7.0, -80.0]), protection_level_m=pl.lit(12.0))
    for quantity in ("error_m", "protection_level_m"):
        yield campaign.campaign_plan(places, quantity)
        high = np.array([5.0, np.nan, 9.0])
        yield campaign.campaign_bars(["a", "b", "c"], high / 4.0, high / 2.0, high, quantity)
    yield campaign.campaign_plan(places.with_columns(x_m=pl.lit(None, dtype=pl.Float64)), "error_m")
    yield from campaign.service_charts(_service(), 20.0)


def _service() -> pl.DataFrame:
    columns = ("satellites_median", "satellites_p5", "reflection_p95_m", "ok_share", "tracking_share",
               "within_limit_share", "level_median_m", "level_p95_m")  # fmt: skip
    values = {name: [1.0 + i, None, 3.0 + i] for i, name in enumerate(columns)}
    return pl.DataFrame({"from_m": [0.0, 100.0, 200.0], "to_m": [100.0, 200.0, 250.0]} | values)


def _curve() -> Cn0Curve:
    bins = np.array([10.0, 30.0, 50.0, 70.0])
    mean = {"elevation_deg": bins, "spread_db": np.ones(4), "count": np.full(4, 50)}
    return Cn0Curve(
        means=(
            Cn0Mean(kind="G", signal="1C", mean_dbhz=np.array([38.0, 42.0, 46.0, 48.0]), **mean),
            Cn0Mean(kind="E", signal="1C", mean_dbhz=np.array([36.0, 40.0, 44.0, 46.0]), **mean),
        ),
        source=Cn0CurveSource(antenna="ANT", receiver="REC"),
    )


def _signals() -> Iterator[Any]:
    observations = observations_table()
    many = pl.concat([observations, observations.with_columns(elevation_deg=pl.lit(90.0))] * 6)
    limits = Cn0Limits(floor_dbhz=30.0)
    yield from plots.cn0_over_elevation(observations, limits=limits, mask_deg=20.0)
    for given in (limits, Cn0Limits(deficit_dbhz=None)):
        yield from plots.cn0_over_elevation(many, limits=given, curve=_curve())
    yield plots.sky_epochs(observations, title="Sky over the roof")
    more = pl.concat([observations.head(4).with_columns(time_gpst=pl.lit(t)) for t in times(np.arange(100.0))])
    yield plots.sky_epochs(more, epochs=20, wanted=times([33.0, 77.0, 5000.0]))
    yield plots.sky_epochs(observations.clear())


def _picture(sides: Any, *, rows: int = 6, large: float = 3.0, limit: Any = 2.0) -> ScreenPicture:
    metric = np.linspace(-1.0, large, rows)[:, None] * np.array([1.0, 0.5])
    metric[1, 0] = np.nan
    return ScreenPicture(
        title="front: metric",
        label="metric [m]",
        metric=metric,
        reject=metric > np.asarray(limit),
        limit=limit,
        sides=sides,
    )


def _screens() -> Iterator[Chart]:
    for sides in ("both", "above", "below"):
        yield screens.screen_over_time(_picture(sides), times(np.arange(6)))
    limit = np.array([2.0, 2.5, np.nan, 3.0, 2.0, 1.0])[:, None]
    varied, place = _picture("both", large=50.0, limit=limit), np.array([0.0, np.nan, 10.0, 10.0, 20.0, 30.0])
    yield screens.screen_over_chainage(varied, place)
    yield screens.screen_over_chainage(varied, place[[0, 2, 4]], epoch=np.array([0, 0, 1, 1, 2, 2]))
    nothing = _picture("both", rows=2)
    nothing.metric[:] = np.nan
    yield screens.screen_over_time(nothing, times([0.0, 1.0]))
    yield screens.screen_over_chainage(_picture("above", rows=150_000, limit=np.nan), np.arange(150_000.0))


def _run() -> tuple[Any, Matched]:
    """Ten positions: two tracks in turn, three probabilities, two on no track, one without a place."""
    north, east = np.array([0.0, 1.0, -1.0, 0.5, 0.0, 0.2, 3.6, 80.0, 90.0, np.nan]), np.arange(10) * 90.0 + 20.0
    track, nothing = np.array([0, 0, 0, 0, 0, 1, 1, -1, -1, -1]), np.zeros((10, 1))
    return log_at(*to_degrees(east, north)), Matched(
        track=track, chainage_m=np.where(track == 0, east, east - 440.0), offset_m=-north,
        probability=np.array([0.999, 0.99, 0.95, 0.9, 0.7, 0.5, 0.3, np.nan, np.nan, np.nan]),
        candidates=Candidates(track=nothing, chainage_m=nothing, offset_m=nothing), probabilities=np.ones((10, 1)),
    )  # fmt: skip


def _networks() -> Iterator[Any]:
    net = made_network(10.0)
    found = [
        NetworkFinding(kind=kind, tracks=("0a",), latitude_deg=50.0 + i * 1e-3, longitude_deg=5.0, sentence=f"a {kind}")
        for i, kind in enumerate(("gap", "joint", "kink", "too near", "dead end"))
    ]
    quality = NetworkQuality(tracks=12, switches=4, ends=2, parts=1, length_m=9360.0, findings=tuple(found))
    yield network.network_plan(net, None, None)
    yield network.network_plan(net, quality, _run())
    nowhere = log_at(np.full(2, np.nan), np.full(2, np.nan))
    yield network.network_plan(net, check_network(net), (nowhere, _run()[1].take(np.array([7, 8]))))


def _empty() -> Iterator[Iterable[str]]:
    """Whether a chart has something to draw, by layer: nothing known, one of the coordinates, all."""
    one, none, zero = np.array([1.0]), np.array([NAN]), np.array([0.0])
    edges, count = np.array([0.0, 1.0]), np.array([[1]])
    layers = [Points(label="", colour="", x=x, y=y) for x in (one, none) for y in (one, none)]
    layers += [Band(label="", colour="", x=one, low=low, high=one) for low in (one, none)]
    layers += [Bars(label="", colour="", left=zero, right=one, height=height) for height in (one, zero)]
    layers += [Cells(label="", colour="", x_edges=edges, y_edges=edges, counts=n) for n in (count, 0 * count)]
    layers += [RangeBars(label="", colour="", names=("a",), low=one, mid=mid, high=one) for mid in (one, none)]
    layers += [Marks(label="", colour="", x=one, y=one, words=("a",))]
    frame = {"name": "", "title": "", "caption": "", "x_label": "", "y_label": ""}
    yield [f"{layer.kind} empty {Chart(layers=(layer,), **frame).empty}" for layer in layers]


def _layers() -> Iterator[Iterable[str]]:
    """Each kind of layer drawn by matplotlib, with and without time, and each scale."""
    x, y = np.array([0.0, 1.0, 2.0]), np.array([1.0, np.nan, 5.0])
    layers = (
        Curve(label="curve", colour="#0072b2", x=x, y=y, dash="dashed", width=3.0),
        Band(label="band", colour="#00805e", x=x, low=y - 1.0, high=y + 1.0),
        *(Points(label=shape, colour="#d55e00", x=x, y=y, shape=shape, size=5.0) for shape in ("dot", "ring", "cross")),
        Points(label="many", colour="#d55e00", x=np.arange(2000.0), y=np.arange(2000.0)),
        Marks(label="", colour="#000000", x=x[:2], y=x[:2], words=("a", "b\nc")),
        Marks(label="", colour="#000000", x=x[:1], y=x[:1], words=("on",), place="on"),
    )
    frame = {"name": "n", "title": "title", "caption": "", "x_label": "x", "y_label": "y"}
    yield describe_axes(plots.draw_chart(Chart(layers=layers, **frame), Figure().subplots()))
    yield describe_axes(plots.draw_chart(Chart(layers=layers[:3], start=START, **frame), Figure().subplots()))
    bars = (
        Bars(label="bars", colour="#0072b2", left=x, right=x + 0.5, height=x + 1.0),
        Cells(label="cells", colour="#000000", x_edges=np.arange(4.0), y_edges=np.arange(3.0),
              counts=np.array([[0, 1], [2, 0], [3, 4]])),
    )  # fmt: skip
    scaled = {"y_scale": "symlog", "y_linear": 2.0, "x_range": (0.5, 9.0), "y_range": (-3.0, 3.0), "equal": True}
    yield describe_axes(plots.draw_chart(Chart(layers=bars, **scaled, **frame), Figure().subplots()))
    yield describe_axes(plots.draw_chart(Chart(layers=(), equal=True, **frame), Figure().subplots()))
    ranges = RangeBars(label="range", colour="#0072b2", names=("a", "b", "c"), low=x, mid=y, high=x + 2.0)
    curve = Curve(label="curve", colour="#0072b2", x=x + 1.0, y=x + 2.0)
    logs = Chart(layers=(curve,), x_scale="log", y_scale="log", width="half", **frame)
    for chart in (logs, Chart(layers=(ranges,), **frame), Chart(layers=(), equal=True, **frame)):
        yield describe_figure(plots.draw_figure(chart))
    polar = Figure().subplots(subplot_kw={"projection": "polar"})
    yield describe_axes(plots.draw_sky(plots.sky_epochs(observations_table()), times(0.8), ax=polar))


def _pictures(folder: Path) -> Iterator[Iterable[str]]:
    """Pictures that are drawn without a chart, as they are before they are saved."""
    kept: list[Figure] = []
    with pytest.MonkeyPatch.context() as patch:
        for module in (network, screens, campaign):
            patch.setattr(module, "save_figure", lambda figure, path: kept.append(figure) or path)
        enu = np.array([[0.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 40.0, 1.0], [20.0, 50.0, 1.0], [20.0, 50.4, 1.0],
                        [20.0, 120.0, 1.0]])  # fmt: skip
        latitude, longitude = 35.0 + enu[:, 1] / 110_941.0, 135.0 + enu[:, 0] / 91_288.0
        cant = np.array([0.0, 0.0, 0.15, 0.2, 0.0, 0.0])
        for more in ({}, {"cant_m": cant, "gradient_permille": 100.0 * cant}):
            faulty = Track.from_geodetic(latitude, longitude, 50.0 + enu[:, 2], name="faulty", **more)
            network.plot_track_quality(check_track(faulty), folder / "quality.png")
        for step_m in (12.0, 13.0):  # a limit is drawn from a quarter of it on
            network.plot_track_quality(check_track(line_track(4, step_m)), folder / "quality.png")
        track = line_track()
        sigma = {"sigma_plan_m": np.linspace(0.5, 1.0, 9), "sigma_height_m": np.linspace(1.0, 2.0, 9)}
        runs = [SimpleNamespace(ecef_m=track.ecef_m[::2] + shift) for shift in (0.0, 1.0)]
        survey = SimpleNamespace(survey=SimpleNamespace(track=track, **sigma), runs=runs)
        network.plot_survey(survey, folder / "survey.png")  # type: ignore[arg-type]
        looks = [[0.5, 0.5, 0.0005], [0.9, 0.0999, 0.0001], [1.0, 0.0, 0.0]]
        posteriors = [SimpleNamespace(names=("1", "2", "3"), probability=np.array(look)) for look in looks]
        decision = SimpleNamespace(posteriors=posteriors, seconds=np.array([60.0, 70.0, 80.0]), track="1")
        network.plot_track_decision(decision, folder / "decision.png", risk=1e-3)  # type: ignore[arg-type]
        campaign.plot_service(_service(), folder / "service.png", title="line", limit_m=20.0)
        screens.draw_screen(folder / "screen.png", _picture("both"), times(np.arange(6)), np.arange(6.0))
        samples = Cn0Samples()
        elevation = np.array([[10.0, 12.0], [30.2, 60.0]])
        samples.add(elevation / 2.0 + 30.0, elevation, np.array(["G01", "E02"]), np.array(["1C", "1C"]))
        screens.draw_cn0_curve(folder / "curve.png", _curve(), samples)
    assert len(kept) == 9
    yield from (describe_figure(figure) for figure in kept)


#: Words of a page that differ from one writing to the next.
_HIDDEN: Final = {
    r"\d{4}-\d\d-\d\d \d\d:\d\d(:\d\d)? UTC": "TIME", r"by railfix [0-9.a-z+]*": "by railfix.",
    r"[0-9a-f]{64}": "SHA256",
}  # fmt: skip


def _page_of(document: str, folder: Path) -> Iterator[str]:
    """Yield the text of a page and the numbers of its charts."""
    hidden = {str(folder): "FOLDER", **_HIDDEN}
    yield from page_text(document, hidden)
    for figure in (page := Page(document)).figures:
        yield f"chart {figure['data-name']}"
        for key, value in json.loads(page.text[figure["data-chart"]]).items():
            for number, layer in enumerate(value if key == "layers" else [{"": value}]):
                for name, inside in layer.items():
                    yield from describe(unpacked(inside), f"  {key} {number if key == 'layers' else ''} {name}")


def unpacked(value: Any) -> Any:
    """Return an array of the page, packed as base 64 after the letter of its kind; anything else as it is."""
    if isinstance(value, str) and re.fullmatch(r"[fhi][A-Za-z0-9+/]*={0,2}", value) and len(value) % 4 == 1:
        return np.frombuffer(base64.b64decode(value[1:]), dtype={"f": "<f4", "h": "<u2", "i": "<u4"}[value[0]])
    return value


def _reports(folder: Path) -> Iterator[Iterable[str]]:
    """The whole report with and without a reference, filter and observations, and on two runs."""
    run, bare = made_report_run(folder / "run"), made_report_run(folder / "bare", filtered=False, observations=False)
    unknown = pl.when(pl.col("chainage_m") % 2.0 == 0.0).then(pl.col("error_m"))
    worst = figures._worst(long_errors().head(300).with_columns(error_m=unknown, conventional_error_m=unknown / 4.0))
    yield describe((worst - START) / np.timedelta64(1, "s"), "worst epochs [s]")  # type: ignore[operator]
    for runs, references in (([run], [folder / "truth.csv"]), ([bare], []), ([bare, run], [folder / "truth.csv"])):
        reported, evaluation = read_runs(runs, references, conventional=[bare] * len(references) * (len(runs) == 1))
        document = report_page(reported, evaluation)
        whole = bool(references) and len(runs) == 1
        yield _page_of(document, folder) if whole else page_text(document, {str(folder): "FOLDER", **_HIDDEN})


def _explained(folder: Path) -> Iterator[Iterable[str]]:
    """Sentences on epochs of each status, level and kind, and two pages."""
    run, bare = made_report_run(folder / "run"), made_report_run(folder / "bare", filtered=False)
    for second in (0, 1, 2, 3, 6, 8, 11, 13, 15, 23, 50):
        yield explain_epoch(run, f"01:{second // 60:02d}:{second % 60:02d}").sentences
    yield describe(explain_epoch(bare, "2024-03-05 01:00:04").satellites)
    record = json.loads((bare / "run.json").read_text())
    record["settings_used"] |= {"map_plan_sigma_m": 0.75, "map_height_sigma_m": 3.0}
    (bare / "run.json").write_text(json.dumps(record))
    for made, time in ((run, "01:00:05"), (bare, "01:01:29")):
        page = write_explanation(explain_epoch(made, time), folder / f"{made.name}.html")
        yield page_text(page.read_text(encoding="utf-8"), {str(folder): "FOLDER"})


def _campaigns(folder: Path) -> Iterator[Iterable[str]]:
    rows = []
    for number, name in enumerate(("a", "b", "c")):
        run = made_report_run(folder / name / "run", filtered=number != 1, observations=number == 0)
        facts = {"epochs": 90 + number, "positioning_rate": 0.75, "ok_rate": 0.5}
        facts["folder"] = str(run.relative_to(folder))
        rows.append({"train": name, "day": 3, "status": "done", "error": None, **facts})
    rows.append({"train": "d", "day": 4, "status": "failed", "error": "no log"})
    for reference in ("a/truth.csv", None, "line.csv"):
        whole = pl.DataFrame(rows, infer_schema_length=None)
        truth = None if reference is None else str(folder / reference)
        found = report_campaign(whole.with_columns(reference=pl.lit(truth, dtype=pl.String)), folder)
        page = write_campaign_page(found, folder / "campaign.html", title="All runs")
        yield page_text(page.read_text(encoding="utf-8"), {str(folder): "FOLDER", **_HIDDEN})
        for chart in found.charts:
            yield describe(chart)


def _network_pages(folder: Path) -> Iterator[Iterable[str]]:
    net = replace(made_network(10.0), notes=("a note",))
    for run in (None, _run()):
        write_network_page(net, check_network(net), folder / "network.html", run=run)
        yield page_text((folder / "network.html").read_text(encoding="utf-8"), _HIDDEN)


def _of(charts: Iterable[Any]) -> Iterator[Iterable[str]]:
    for chart in charts:
        axis = f"; common axis {chart.common_axis!r}" if isinstance(chart, Chart) else ""
        yield [*describe(chart), f"empty {chart.empty}{axis}"]


CASES: Final[dict[str, Callable[[Path], Iterable[Iterable[str]]]]] = {
    "errors": lambda _: _of(_errors()),
    "levels": lambda _: _of(_levels()),
    "plans": lambda _: _of(_plans()),
    "line": lambda _: _of(_line()),
    "signals": lambda _: _of(_signals()),
    "screens": lambda _: _of(_screens()),
    "networks": lambda _: _of(_networks()),
    "empty": lambda _: _empty(),
    "layers": lambda _: _layers(),
    "pictures": _pictures,
    "reports": _reports,
    "explained": _explained,
    "campaigns": _campaigns,
    "network_pages": _network_pages,
}


@pytest.mark.parametrize("name", CASES)
def test_pages_show_what_was_reviewed(name: str, tmp_path: Path) -> None:
    check_described(name, CASES[name](tmp_path))


if __name__ == "__main__":
    write_described(CASES, sys.argv[1:])

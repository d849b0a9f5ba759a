"""Reference triangle: truth table, causes and times of faults put in, false stops against the rate that was set."""

from __future__ import annotations

import socket
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import static_fixes
from railfix.cli.ground import app
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss import Observations, concatenate
from railfix.ground.demo import PLAN_M, TIME, draw_fixes, points_ecef_m
from railfix.ground.fixes_at_stations import StationStreams, station_fixes
from railfix.ground.triangle import (
    SIDES,
    STOPPING,
    Monitor,
    MonitorLimits,
    MonitorState,
    Order,
    TriangleLimits,
    TriangleVerdict,
    _verdicts,
    advance,
    compare_triangle,
    limits_for_false_stops,
    release,
)
from railfix.io import read_navigation, read_observations, write_observations
from railfix.pipeline.received import no_navigation
from railfix.simulate import write_run
from railfix.simulate.scenario import ReferenceStation
from railfix.simulate.scenario_file import load_recipe

pytestmark = pytest.mark.requirement("F1")

LIMITS = TriangleLimits(radius_m=12.0, side_m=6.0)
TIMES = MonitorLimits()


def table_verdict(inside: tuple[bool, ...], small: tuple[bool, ...], coincide: bool) -> tuple[TriangleVerdict, int]:
    """The table of docs/ground.md, written a second time by counting; sides are 01, 12, 20."""
    outside, large = inside.count(False), small.count(False)
    between = {frozenset({0, 2}): 0, frozenset({0, 1}): 1, frozenset({1, 2}): 2}
    shared = between.get(frozenset(k for k in range(3) if not small[k]), -1) if large == 2 else -1
    if outside == 0 and large == 0:
        return TriangleVerdict.HEALTHY, -1
    if outside == 0 and large in (1, 2):
        return TriangleVerdict.RECEIVER_DRIFTING, shared
    if outside == 1 and shared >= 0 and not inside[shared]:
        return TriangleVerdict.ONE_RECEIVER, shared
    if outside == 3 and large == 0:
        return TriangleVerdict.SATELLITES_OR_JAMMING, -1
    if outside >= 2 and coincide:
        return TriangleVerdict.SPOOFING, -1
    return TriangleVerdict.GROUND_LOST, -1


def test_truth_table_of_all_combinations() -> None:
    for *bits, coincide in product((True, False), repeat=7):
        inside, small = tuple(bits[:3]), tuple(bits[3:])
        verdict, receiver = _verdicts(
            np.array([True]), np.array([inside]), np.array([small]), np.array([coincide]), np.array([False])
        )
        assert (TriangleVerdict(int(verdict[0])), int(receiver[0])) == table_verdict(inside, small, coincide)


OUT, FAR = np.array([20.0, 0.0]), np.array([300.0, 40.0])


@pytest.mark.parametrize(
    ("moved", "verdict", "receiver"),
    [
        (np.zeros((3, 2)), TriangleVerdict.HEALTHY, -1),
        (np.array([[0, 0], [8.0, 0], [0, 0]]), TriangleVerdict.RECEIVER_DRIFTING, 1),
        (np.array([[0, 0], [0, 0], OUT]), TriangleVerdict.ONE_RECEIVER, 2),
        (np.array([OUT, OUT, OUT]), TriangleVerdict.SATELLITES_OR_JAMMING, -1),
        (FAR - PLAN_M, TriangleVerdict.SPOOFING, -1),
        (PLAN_M[0] - PLAN_M, TriangleVerdict.SPOOFING, -1),
        (np.array([OUT, OUT, [9.0, 0]]), TriangleVerdict.GROUND_LOST, -1),
        (np.array([OUT, -OUT, [0, 0]]), TriangleVerdict.GROUND_LOST, -1),
        (np.array([[12.5, 0], [8.0, 0], [8.0, 0]]), TriangleVerdict.GROUND_LOST, -1),
        (np.array([[0, 0], [np.nan, 0], [0, 0]]), TriangleVerdict.MONITOR_LOST, -1),
    ],
)
def test_moved_fixes(moved: np.ndarray, verdict: TriangleVerdict, receiver: int) -> None:
    result = compare_triangle(PLAN_M, (PLAN_M + moved)[None], limits=LIMITS)
    assert (TriangleVerdict(int(result.verdict[0])), int(result.receiver[0])) == (verdict, receiver)


def test_distance_and_bearing_of_a_turned_triangle() -> None:
    """A triangle turned clockwise by 2 deg about its first point: no length changes, every bearing does by 2 deg."""
    turn = np.radians(-2.0)
    turned = PLAN_M @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    result = compare_triangle(PLAN_M, turned[None], limits=LIMITS)
    assert result.distance_error_m[0] == pytest.approx(np.zeros(3), abs=1e-9)
    assert result.bearing_error_deg[0] == pytest.approx(np.full(3, 2.0), abs=1e-9)
    lengths = [np.hypot(*(PLAN_M[b] - PLAN_M[a])) for a, b in SIDES]
    assert result.side_error_m[0] == pytest.approx(2.0 * np.sin(np.radians(1.0)) * np.array(lengths))


@given(
    st.lists(st.floats(-1e7, 1e7) | st.just(float("nan")) | st.just(float("inf")), min_size=6, max_size=6),
    st.integers(0, 5),
)
def test_nan_never_reads_as_inside(values: list[float], absent: int) -> None:
    fixes = np.array(values).reshape(1, 3, 2)
    fixes[0, absent // 2, absent % 2] = np.nan
    with np.errstate(invalid="ignore"):
        result = compare_triangle(PLAN_M, fixes, limits=LIMITS)
    assert result.verdict[0] == TriangleVerdict.MONITOR_LOST


def test_a_triangle_too_small_for_its_limits_is_rejected() -> None:
    with pytest.raises(ValueError, match="shortest side"):
        compare_triangle(PLAN_M / 40.0, PLAN_M[None], limits=LIMITS)


@pytest.mark.parametrize("per_sample", [1e-2, 1e-3, 1e-4])
@pytest.mark.slow
def test_false_stops_stay_below_the_rate_that_was_set(per_sample: float) -> None:
    """A million independent samples; Rayleigh tails of three circles make up half of the rate."""
    stops_per_year = per_sample * 31_557_600.0 / 100.0
    limits = limits_for_false_stops(3.0, 1.0, stops_per_year=stops_per_year)
    rng, samples = np.random.default_rng(7), 1_000_000
    common = rng.normal(0.0, np.sqrt(3.0**2 - 1.0**2), (samples, 1, 2))
    own = rng.normal(0.0, 1.0, (samples, 3, 2))
    result = compare_triangle(PLAN_M, PLAN_M + common + own, limits=limits)
    stops = int(np.isin(result.verdict, list(STOPPING)).sum())
    allowed = per_sample * samples
    assert stops <= allowed
    # one circle alone: the closed form
    outside = int((result.error_m[:, 0] > limits.radius_m).sum())
    expected = allowed / 6.0
    assert abs(outside - expected) < 4.0 * np.sqrt(expected)
    assert stops >= outside


FAULTS = ("satellite ramp", "satellite clock step", "one receiver", "drift inside", "jamming", "spoofing")
CAUSES = {
    "satellite ramp": TriangleVerdict.SATELLITES_OR_JAMMING,
    "satellite clock step": TriangleVerdict.SATELLITES_OR_JAMMING,
    "one receiver": TriangleVerdict.ONE_RECEIVER,
    "jamming": TriangleVerdict.JAMMING,
    "spoofing": TriangleVerdict.SPOOFING,
}


@pytest.mark.every(4)
@pytest.mark.parametrize("fault", FAULTS)
def test_cause_and_time_to_alert_of_faults(fault: str) -> None:
    """200 seeds; the fault begins at 20 s; the alert comes within 6 s of an error beyond the radius."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        common, moved = np.zeros((60, 9)), np.zeros((60, 3, 2))
        since = np.clip(np.arange(60.0) - 19.0, 0.0, None)
        satellite = int(rng.choice([1, 3, 4, 5, 6, 7]))  # errors of the lowest and of those abeam move a fix most
        if fault == "satellite ramp":
            common[:, satellite] = 6.0 * since
        elif fault == "satellite clock step":
            common[:, satellite] = np.where(since > 0, 150.0, 0.0)
        elif fault == "one receiver":
            moved[:, 1, 0] = np.where(since > 0, 30.0, 0.0)
        elif fault == "drift inside":
            moved[:, 2, 1] = np.minimum(0.5 * since, 9.5)
        elif fault == "jamming":
            moved[since > 0] = np.nan
        else:
            moved[since > 0] = FAR - PLAN_M
        fixes = draw_fixes(rng, common_m=common, moved_m=moved)
        log = Monitor(limits=LIMITS, times=TIMES).judge(fixes)
        verdicts = log.triangle.verdict
        assert (verdicts[:20] == TriangleVerdict.HEALTHY).all()
        if fault == "drift inside":
            # the circles alone, P3's method, see nothing; the sides of the raw fixes do
            assert (log.triangle.error_m[:, 2][since >= 17] < LIMITS.radius_m).all()
            assert log.orders == ()
            named = log.triangle.receiver[since >= 19]
            assert (named == 2).mean() > 0.9
            continue
        kinds = [order for _, order, _, _ in log.orders]
        assert kinds == [Order.SUSPEND, Order.STOP]
        assert {cause for _, _, cause, _ in log.orders} == {CAUSES[fault]}
        stopped = (log.orders[0][0] - fixes.time[0]) / np.timedelta64(1, "s")
        worst = np.nan_to_num(log.triangle.error_m).max(axis=1)
        begun = 20.0 if fault == "jamming" else float(np.argmax(worst > LIMITS.radius_m))
        assert begun <= stopped <= begun + 6.0
        state = MonitorState(stopped=False)
        for k, value in enumerate(verdicts.tolist()):
            state, _ = advance(
                state, float(k), TriangleVerdict(value), receiver=int(log.triangle.receiver[k]), limits=TIMES
            )
        assert state.cause is CAUSES[fault], seed
        if fault == "one receiver":
            assert state.receiver == 1


def test_a_stop_is_latched_and_released_by_hand_after_healthy_time() -> None:
    state, orders = advance(MonitorState(stopped=False), 1.0, TriangleVerdict.SPOOFING, limits=TIMES)
    assert orders == (Order.SUSPEND, Order.STOP)
    for now in range(2, 400):
        before = release(state, float(now - 1), limits=TIMES)
        assert before[2] is not None or now > 302
        state, orders = advance(state, float(now), TriangleVerdict.HEALTHY, limits=TIMES)
        assert orders == ()
        assert state.stopped
        assert state.cause is TriangleVerdict.SPOOFING
    assert "the last fixes are 11.0 s old" in (release(state, 410.0, limits=TIMES)[2] or "")
    state, orders, reason = release(state, 399.0, limits=TIMES)
    assert (state.stopped, orders, reason) == (False, (Order.RESUME,), None)


def test_healthy_time_begins_again_after_an_absent_fix() -> None:
    state, _ = advance(MonitorState(stopped=False), 0.0, TriangleVerdict.GROUND_LOST, limits=TIMES)
    for now in range(1, 301):
        state, _ = advance(state, float(now), None if now == 150 else TriangleVerdict.HEALTHY, limits=TIMES)
    assert release(state, 300.0, limits=TIMES)[2] == "fixes are healthy for 149 s; a release requires 300 s"


def test_nothing_from_a_receiver_stops_after_the_late_time() -> None:
    state, _ = advance(MonitorState(stopped=False), 0.0, TriangleVerdict.HEALTHY, limits=TIMES)
    state, orders = advance(state, 3.0, None, limits=TIMES)
    assert orders == ()
    state, orders = advance(state, 3.1, None, limits=TIMES)
    assert orders == (Order.SUSPEND, Order.STOP)
    assert state.cause is TriangleVerdict.MONITOR_LOST
    with pytest.raises(ValueError, match="ran back"):
        advance(replace(state, complete_s=5.0), 4.0, None, limits=TIMES)


@pytest.fixture(scope="module")
def triangle_logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    """Logs of three reference stations of the simulator, 60 s at 1 Hz."""
    places = (("a", 100.0, 50.0), ("b", 900.0, 50.0), ("c", 400.0, 600.0))
    stations = tuple(ReferenceStation(name=name, chainage_m=at, lateral_m=side) for name, at, side in places)
    base = load_recipe("commercial-run").scenario(changes={"duration_s": 60.0})
    scenario = base.replaced(rate_hz=1.0, sensors=None, stations=stations)
    files = write_run(scenario, tmp_path_factory.mktemp("triangle"), packing="plain")
    return [files[name] for name, _, _ in places], files["nav"]


def test_logs_of_the_simulator(triangle_logs: tuple[list[Path], Path], tmp_path: Path) -> None:
    logs, nav = triangle_logs
    options = ["--nav", str(nav), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, ["monitor", *map(str, logs), *options])
    assert done.exit_code == 0, done.output
    assert "no stop" in done.output
    assert (tmp_path / "out" / "triangle.png").stat().st_size > 10_000


def test_a_satellite_clock_step_in_the_logs(triangle_logs: tuple[list[Path], Path], tmp_path: Path) -> None:
    logs, nav = triangle_logs
    observations = [read_observations(path) for path in logs]
    healthy = station_fixes(
        observations, np.stack([o.header.approximate_ecef_m for o in observations]), read_navigation(nav)
    )
    assert np.isfinite(healthy.fixes_m).all()
    strength = np.nan_to_num(observations[0].cn0_dbhz.mean(axis=0)) * (observations[0].signal == "1C")
    name = observations[0].satellite[np.argsort(strength)[-3]]  # high enough to be used, low enough to move a fix
    broken = []
    for k, log in enumerate(observations):
        code = log.code_m.copy()
        code[30:, log.satellite == name] += 400.0
        broken.append(tmp_path / f"{k}.rnx")
        write_observations(replace(log, code_m=code), broken[-1])
    options = ["--nav", str(nav), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, ["monitor", *map(str, broken), *options])
    assert "suspend satellite positioning: satellites_or_jamming" in done.output, done.output
    assert done.output.index("suspend") < done.output.index("stop:")


@pytest.mark.requirement("E1")
def test_fixes_computed_elsewhere_are_judged_with_limits_of_their_grade(tmp_path: Path) -> None:
    """P3 3: CLAS-grade fixes of 3 cm; one receiver that drifts by 0.1 m/s is found within 6 s."""
    points, random, seconds = points_ecef_m(), np.random.default_rng(3), np.arange(60)
    start, logs, known = np.datetime64("2024-03-05T02:00:00", "ms"), [], []
    for k, point in enumerate(points):
        known += ["--point", ",".join(f"{value:.9f}" for value in geodetic_from_ecef(point))]
        east = np.cross([0.0, 0.0, 1.0], point)
        drift = 0.1 * np.maximum(seconds - 20, 0) * (k == 1)
        place = point + random.normal(0.0, 0.03, (60, 3)) + drift[:, None] * (east / np.linalg.norm(east))
        latitude, longitude, height = geodetic_from_ecef(place)
        table = pl.DataFrame({"time_gpst": start + seconds.astype("timedelta64[s]"), "latitude_deg": latitude})
        table = table.with_columns(longitude_deg=pl.Series(longitude), height_m=pl.Series(height))
        logs.append(tmp_path / f"{k}.csv")
        table.write_csv(logs[-1])
    words = [
        "monitor",
        "--fixes",
        *map(str, logs),
        "--radius",
        "0.32",
        "--side",
        "0.22",
        "--out",
        str(tmp_path / "out"),
    ]
    done = CliRunner().invoke(app, [*words, *known])
    assert done.exit_code == 0, done.output
    first = next(line for line in done.output.splitlines() if "suspend satellite positioning" in line)
    assert first.endswith("one_receiver, receiver 1"), done.output
    assert "2024-03-05T02:00:21" < first[:19] <= "2024-03-05T02:00:26"
    for more, sentence in (
        ([], "--point is missing"),
        ([*known, "--nav", str(logs[0])], "--nav cannot be used with --fixes"),
    ):
        refused = CliRunner().invoke(app, [*words, "--overwrite", *more])
        assert refused.exit_code == 4
        assert sentence in refused.output


@pytest.mark.slow
def test_streams_are_judged_as_their_logs_are(triangle_logs: tuple[list[Path], Path], tmp_path: Path) -> None:
    """The same verdicts and errors as from the logs; a clock step in the streams stops the trains at once."""
    logs, nav = triangle_logs
    observations = [read_observations(path) for path in logs]
    points = [
        ",".join(f"{float(value):.9f}" for value in geodetic_from_ecef(log.header.approximate_ecef_m))
        for log in observations
    ]
    places = [word for point in points for word in ("--point", point)]
    words = [*map(str, logs), "--nav", str(nav), *places]
    for name, more in (("logs", []), ("live", ["--live"])):
        done = CliRunner().invoke(app, ["monitor", *words, *more, "--out", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        assert "no stop" in done.output
    once, live = (pl.read_csv(tmp_path / name / "monitor.csv") for name in ("logs", "live"))
    assert live["time_gpst"].to_list() == once["time_gpst"].to_list()
    assert live["verdict"].to_list() == once["verdict"].to_list() == ["healthy"] * 60
    for name in ("error_0_m", "side_01_m"):
        assert np.abs((live[name] - once[name]).to_numpy()).max() < 1e-6
    strength = np.nan_to_num(observations[0].cn0_dbhz.mean(axis=0)) * (observations[0].signal == "1C")
    satellite = observations[0].satellite[np.argsort(strength)[-3]]
    for k, log in enumerate(observations):
        code = log.code_m.copy()
        code[30:, log.satellite == satellite] += 400.0
        write_observations(replace(log, code_m=code), tmp_path / f"{k}.rnx")
    words = [*(str(tmp_path / f"{k}.rnx") for k in range(3)), "--nav", str(nav), *places, "--live"]
    done = CliRunner().invoke(app, ["monitor", *words, "--out", str(tmp_path / "step")])
    tag = np.datetime_as_string(once["time_gpst"].str.to_datetime(time_unit="ns").to_numpy()[30], unit="s")
    assert f"{tag} suspend satellite positioning: satellites_or_jamming" in done.output, done.output


def test_streams_of_which_nothing_comes_stop_the_trains(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        source = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        words = ["monitor", source, source, source, "--live", "--late", "0.5", "--for", "2", "--out", str(tmp_path)]
        done = CliRunner().invoke(app, [*words, *("--point", "35.7,139.7,100") * 3])
    assert done.exit_code == 0, done.output
    assert done.output.count("suspend satellite positioning: monitor_lost") == 1


def test_a_receiver_without_satellites_gives_no_fix_and_all_three_are_jamming() -> None:
    """Epochs without any satellite come on: monitor lost; where the C/N0 of all three has fallen: jamming."""
    logs = [full_sky(k) for k in range(3)]
    stations = StationStreams(points_ecef_m())
    for second in range(20):
        for k, log in enumerate(logs):
            fixes = stations.push(k, log[second : second + 1])
    assert not fixes.cn0_fallen.any()
    for second in range(20, 23):
        for k, log in enumerate(logs):
            epoch = log[second : second + 1]
            fixes = stations.push(k, replace(epoch, code_m=epoch.code_m * np.nan, cn0_dbhz=epoch.cn0_dbhz * np.nan))
    assert fixes.cn0_fallen.all()
    assert np.isnan(fixes.fixes_m).all()
    triangle = compare_triangle(PLAN_M, fixes.fixes_m, limits=LIMITS, cn0_fallen=fixes.cn0_fallen)
    assert triangle.verdict[0] == TriangleVerdict.JAMMING


def test_epochs_that_a_receiver_lacks_are_late_in_logs_as_in_streams() -> None:
    """Epochs missing at random: the same epochs count, with the same C/N0; a gap of more than 3 s stops the trains."""
    random = np.random.default_rng(5)
    there = random.random((3, 30)) < 0.8
    there[:, [0, 3, 6, 9, 12, 15, 17, 22]] = True
    there[1, 18:22] = False  # nothing from the second one for 4 s
    logs = [
        concatenate([full_epoch(full_sky(k), second) for second in np.flatnonzero(rows)])
        for k, rows in enumerate(there)
    ]
    log = station_fixes(logs, points_ecef_m(), no_navigation())
    stations, streamed = StationStreams(points_ecef_m()), []
    for second in range(30):
        for k, rows in enumerate(there):
            if rows[second]:
                streamed.append(stations.push(k, full_epoch(logs[k], second)))
    parts = [fixes for fixes in streamed if fixes is not None]
    np.testing.assert_array_equal(np.concatenate([part.time for part in parts]), log.time)
    np.testing.assert_array_equal(np.concatenate([part.cn0_fallen for part in parts]), log.cn0_fallen)
    assert log.cn0_fallen[-1].all()
    assert len(log.time) == there.all(axis=0).sum()
    assert stations.counts["incomplete"] == there.any(axis=0).sum() - there.all(axis=0).sum()
    healthy = replace(log, fixes_m=np.broadcast_to(log.points_m, log.fixes_m.shape))
    whole = Monitor(limits=LIMITS, times=TIMES).judge(healthy)
    gap = TIME + np.timedelta64(22, "s")
    assert {(time, cause) for time, _, cause, _ in whole.orders} == {(gap, TriangleVerdict.MONITOR_LOST)}
    monitor = Monitor(limits=LIMITS, times=TIMES)
    pieces = [monitor.judge(replace(part, fixes_m=np.broadcast_to(part.points_m, (1, 3, 2)))) for part in parts]
    assert [order for piece in pieces for order in piece.orders] == list(whole.orders)


def full_epoch(log: Observations, second: int) -> Observations:
    """The epoch of a log in a second from the start; from 25 s on all C/N0 is 8 dB less."""
    row = int(np.argmin(np.abs(log.time - TIME - np.timedelta64(second, "s"))))
    return replace(log[row : row + 1], cn0_dbhz=np.full((1, len(log.satellite)), 37.0 if second >= 25 else 45.0))


def full_sky(receiver: int) -> Observations:
    """Thirty epochs of one receiver with C/N0; without records there are no fixes."""
    satellite = np.array([f"G{k:02d}" for k in range(1, 9)])
    shape = (30, len(satellite))
    empty = np.full(shape, np.nan)
    return Observations(
        time=TIME + np.arange(30) * np.timedelta64(1, "s") + np.timedelta64(receiver, "ms"),
        satellite=satellite, signal=np.full(len(satellite), "1C"), code_m=np.full(shape, 2.2e7), phase_cycles=empty,
        doppler_hz=empty, cn0_dbhz=np.full(shape, 45.0), loss_of_lock=np.zeros(shape, dtype=np.uint8),
        break_before=np.zeros(30, dtype=bool),
    )  # fmt: skip


def test_two_stations_of_a_recording_as_monitors(recordings: Path) -> None:
    """Two GEONET stations, 2005, GPS: no fix leaves 12 m with six satellites."""
    folder = recordings / "static" / "rtklib_geonet2005"
    logs = [read_observations(folder / name) for name in ("07590920.05o", "30400920.05o")]
    points = np.stack([log.header.approximate_ecef_m for log in logs])
    fixes = station_fixes(logs, points, read_navigation([folder / "07590920.05n", folder / "30400920.05n"]))
    error = np.hypot(*np.moveaxis(fixes.fixes_m - fixes.points_m, -1, 0))
    assert (error[fixes.n_satellites >= 6] < LIMITS.radius_m).all()
    assert np.isfinite(error).all(axis=1).mean() > 0.9


@pytest.mark.slow
def test_static_recordings_under_open_sky_give_no_false_alarm(recordings: Path) -> None:
    """One receiver at a time against its circle; an attenuated antenna at its cold start is another matter."""
    found = static_fixes.recordings(recordings)
    for name, (_, offset, _) in found.items():
        error = np.hypot(*offset.T)
        assert np.isfinite(error).mean() > 0.97, name
        if "attenuation" not in name:
            assert np.nanmax(error) < LIMITS.radius_m, name
    attenuated = np.hypot(*found["u-blox, 16 dB attenuation, cold start"][1].T)
    assert np.nanmedian(attenuated) < 5.0

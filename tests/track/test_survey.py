"""Survey of a line from several runs of ordinary receivers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from helpers.recordings_truth import urbannav_truth
from railfix.cli import app
from railfix.core.arrays import Floats
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, range_with_rotation
from railfix.core.timescale import timedelta
from railfix.track import read_track
from railfix.track.survey.line import Survey, adjust, survey_line
from railfix.track.survey.runs import RunSignals, SurveyRun

pytestmark = pytest.mark.requirement("A1", "G4")

ORIGIN = ecef_from_geodetic(48.0, 11.0, 500.0)
AXES = enu_axes(48.0, 11.0)
START = np.datetime64("2024-05-01T08:00:00", "ns")


def open_line() -> Floats:
    """A line of 2.1 km every metre: straight, 60 degrees with a radius of 400 m, straight; it climbs by 10 permille."""
    heading = np.concatenate([np.zeros(800), np.linspace(0.0, np.pi / 3.0, 419), np.full(881, np.pi / 3.0)])
    east, north = np.cumsum(np.sin(heading)), np.cumsum(np.cos(heading))
    return np.stack([east, north, 0.01 * np.arange(len(east))], axis=1)


def ring() -> Floats:
    """A closed line of 2 km: a circle."""
    angle = np.arange(0.0, 2.0 * np.pi, 1.0 / 318.3)
    return 318.3 * np.stack([1.0 - np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)


def run_over(line: Floats, way_m: Floats, seed: int, *, sigma_m: float = 3.0) -> SurveyRun:
    """Positions at places along the line, one a second, with errors that last 5 s, 5 % of them 30 to 80 m off."""
    rng = np.random.default_rng(seed)
    truth = line[np.clip(np.round(way_m).astype(int), 0, len(line) - 1)]
    error, last = np.empty(truth.shape), rng.normal(0.0, sigma_m, 3)
    for k in range(len(truth)):
        last = 0.8 * last + np.sqrt(1.0 - 0.8**2) * rng.normal(0.0, sigma_m, 3)
        error[k] = last
    wrong = rng.random(len(truth)) < 0.05
    error[wrong] += rng.choice([-1.0, 1.0], (int(wrong.sum()), 3)) * rng.uniform(30.0, 80.0, (int(wrong.sum()), 3))
    return SurveyRun(
        name=f"run {seed}",
        time=START + timedelta(np.arange(len(truth)) + 1e4 * seed),
        ecef_m=ORIGIN + (truth + error) @ AXES,
        sigma_m=np.full(truth.shape, sigma_m),
        common_sigma_m=(0.5, 1.0),
    )


def there_and_back(first_m: float, last_m: float, speed_mps: float = 15.0) -> Floats:
    """Places of a run that stops for a minute half-way, turns back at the end, and returns."""
    out = np.arange(first_m, last_m, speed_mps)
    half = len(out) // 2
    out = np.concatenate([out[:half], np.full(60, out[half]), out[half:], np.full(30, last_m)])
    return np.concatenate([out, np.arange(last_m, first_m, -speed_mps)])


def across_m(survey: Survey, line: Floats) -> Floats:
    """Distance of each point of the map from the line in plan [m]."""
    local = (survey.track.ecef_m - ORIGIN) @ AXES.T
    return np.asarray(cKDTree(line[:, :2]).query(local[:, :2])[0])


@pytest.mark.slow
def test_runs_there_and_back_and_over_a_part_make_one_line() -> None:
    line = open_line()
    runs = [
        run_over(line, there_and_back(0.0, 2099.0), 1),
        run_over(line, there_and_back(0.0, 2099.0, 20.0), 2),
        run_over(line, np.arange(2099.0, 900.0, -12.0), 3),
        run_over(line, there_and_back(0.0, 2099.0, 11.0), 4),
    ]
    survey = survey_line(runs)
    error = across_m(survey, line)
    assert not survey.closed
    assert survey.track.chainage_m[-1] == pytest.approx(2099.0, rel=0.01)
    assert np.percentile(error, 95) < 2.5
    assert np.percentile(error / survey.sigma_plan_m, 95) < 2.5
    # one pass of the map: never back over itself
    direction = np.diff((survey.track.ecef_m - ORIGIN) @ AXES.T, axis=0)[:, :2]
    assert ((direction[1:] * direction[:-1]).sum(axis=1) > 0.0).all()
    height = (survey.track.ecef_m - ORIGIN) @ AXES[2]
    nearest = cKDTree(line[:, :2]).query(((survey.track.ecef_m - ORIGIN) @ AXES.T)[:, :2])[1]
    assert np.percentile(np.abs(height - line[nearest, 2]), 95) < 3.0
    assert survey.passes.max() >= 6


@pytest.mark.parametrize("gap_m", [(300.0, 510.0), (1000.0, 1200.0)])
def test_a_gap_of_a_tunnel_is_bridged_and_one_run_states_what_it_does_not_see(gap_m: tuple[float, float]) -> None:
    """On the straight, and in the curve of 400 m."""
    line, way = open_line(), np.arange(0.0, 2099.0, 14.0)
    whole = run_over(line, way, 3, sigma_m=0.1)
    kept = (way <= gap_m[0]) | (way >= gap_m[1])
    run = replace(whole, time=whole.time[kept], ecef_m=whole.ecef_m[kept], sigma_m=whole.sigma_m[kept])
    survey = survey_line([run])
    assert survey.track.chainage_m[-1] == pytest.approx(2099.0, rel=0.04)
    assert np.percentile(across_m(survey, line), 95) < 2.0
    notes = " ".join(survey.track.provenance.notes)
    assert "1 gap in the runs bridged by a curve, the longest 2" in notes
    assert "the accuracy of the map includes 1.0 m in plan and 2.0 m in height for this error" in notes
    assert survey.sigma_plan_m.min() > 0.99
    assert survey_line([whole, replace(whole, name="again")]).track.sigma_plan_m < survey.track.sigma_plan_m


def test_runs_over_two_parts_are_joined_where_they_overlap() -> None:
    line = open_line()
    runs = [run_over(line, np.arange(0.0, 1300.0, 10.0), 5), run_over(line, np.arange(900.0, 2099.0, 10.0), 6)]
    survey = survey_line(runs)
    assert survey.track.chainage_m[-1] == pytest.approx(2099.0, rel=0.015)
    assert np.percentile(across_m(survey, line), 95) < 6.0
    middle = survey.passes[len(survey.passes) // 2]
    assert (survey.passes[5], middle, survey.passes[-5]) == (1, 2, 1)


def test_laps_of_a_ring_are_one_closed_line() -> None:
    line = ring()
    survey = survey_line([run_over(line, np.mod(np.arange(100.0, 5300.0, 12.0), 2000.0), 7)])
    assert survey.closed
    assert survey.track.chainage_m[-1] == pytest.approx(2000.0, rel=0.005)
    assert np.linalg.norm(survey.track.ecef_m[0] - survey.track.ecef_m[-1]) < 1e-6
    assert np.percentile(across_m(survey, line), 95) < 4.5


@pytest.mark.slow
@pytest.mark.parametrize(("apart_m", "other"), [(16.0, True), (1.0, False)])
def test_the_track_beside_is_not_averaged_into_the_line(apart_m: float, other: bool) -> None:
    """There on one track, back on one to the left of it; on the same one, but for the antenna, they make one line."""
    line = open_line()
    way = np.gradient(line[:, :2], axis=0)
    left = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(way, axis=1, keepdims=True)
    beside = line + np.pad(apart_m * left, ((0, 0), (0, 1)))
    out, back = np.arange(0.0, 2090.0, 15.0), np.arange(2090.0, 0.0, -16.0)
    runs = [run_over(line, out, 1, sigma_m=1.0), run_over(line, out + 7.0, 2, sigma_m=1.0)]
    survey = survey_line([*runs, run_over(beside, back, 3, sigma_m=1.0)])
    assert any("are assumed to be on another track" in note for note in survey.track.provenance.notes) == other
    assert np.percentile(across_m(survey, line), 95) < 2.0
    assert (survey.beside_m > 1000.0) == other


def test_a_branch_is_reported_and_left_out() -> None:
    line = open_line()
    branch = np.concatenate([line[:700], line[700] + np.arange(1, 500)[:, None] * np.array([-0.7, 0.7, 0.0])])
    runs = [run_over(line, np.arange(0.0, 2099.0, 10.0), 8), run_over(branch, np.arange(0.0, 1190.0, 10.0), 9)]
    survey = survey_line(runs)
    assert survey.track.chainage_m[-1] == pytest.approx(2099.0, rel=0.015)
    assert any("are off the line" in note for note in survey.track.provenance.notes)
    assert survey.beside_m > 300.0


def test_dopplers_of_a_reflected_signal_do_not_bend_the_line() -> None:
    """Two minutes at 10 m/s: phases of three satellites, Dopplers of three, one of them 0.5 m/s wrong throughout."""
    rng = np.random.default_rng(0)
    count, truth = 120, ORIGIN + np.arange(120)[:, None] * 10.0 * AXES[0]
    azimuth, elevation = np.radians([[10, 80, 150, 220, 300, 190], [70, 35, 40, 60, 30, 25]])
    level = np.cos(elevation)
    sat = ORIGIN + 2.2e7 * np.stack([np.sin(azimuth) * level, np.cos(azimuth) * level, np.sin(elevation)], 1) @ AXES
    row, channel = (index.ravel() for index in np.indices((count, 6)))
    step, of_step = (index.ravel() for index in np.indices((count - 1, 6)))
    at_row, before, after = (
        range_with_rotation(sat[c], truth[r])[0] for r, c in ((row, channel), (step, of_step), (step + 1, of_step))
    )
    by_doppler = of_step >= 3
    noise = np.where(by_doppler, 0.2, 0.01) * rng.normal(size=len(step))
    signals = RunSignals(
        row=row,
        sat_ecef_m=sat[channel],
        code_m=at_row + rng.normal(0.0, 2.0, len(row)),
        sigma_m=np.full(len(row), 3.0),
        clock=np.zeros(len(row), dtype=np.intp),
        step=step,
        before_ecef_m=sat[of_step],
        after_ecef_m=sat[of_step],
        change_m=after - before + np.where(of_step == 5, 0.5, 0.0) + noise,
        change_sigma_m=np.where(by_doppler, 0.3, 0.02),
        by_doppler=by_doppler,
    )
    time, sigma = START + timedelta(np.arange(count)), np.full((count, 3), 3.0)
    run = SurveyRun(name="street", time=time, ecef_m=truth, sigma_m=sigma, signals=signals)
    error = (adjust([run], [truth]).ecef_m[0] - truth) @ AXES.T
    # as many independent errors as seconds: 2.7 m
    assert np.linalg.norm(error[:, :2], axis=1).max() < 1.5


def test_runs_that_never_move_are_no_survey() -> None:
    with pytest.raises(ValueError, match=r"no run moves|line in common"):
        survey_line([run_over(open_line(), np.full(50, 100.0), 10, sigma_m=0.1)])


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["none.pos", "--out", "m.csv"], 3, "no such file"),
        (["log.obs", "--out", "m.csv"], 3, "give --nav"),
        (["few.csv", "--out", "m.csv"], 3, "a run of a survey needs three"),
        (["few.csv", "few.csv", "--out", "m.csv"], 3, "given twice"),
        (["few.csv", "--out", "few.csv"], 8, "input"),
        (["few.csv", "--out", "m.csv", "--spacing", "0"], 4, "--spacing"),
    ],
)
def test_misuse_ends_with_one_sentence_and_its_code(
    words: list[str], code: int, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.obs").write_text(f"{'     3.03           OBSERVATION DATA':60}RINEX VERSION / TYPE\n")
    (tmp_path / "few.csv").write_text(
        "time_gpst,latitude_deg,longitude_deg,height_m\n2024-05-01T08:00:00,48,11,500\n2024-05-01T08:00:01,48,11.1,500\n"
    )
    result = CliRunner().invoke(app, ["map", "survey", *words], env={"COLUMNS": "200"})
    assert result.exit_code == code, result.output
    assert sentence in " ".join(result.output.split())
    assert not (tmp_path / "m.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("log", "limit_m"),
    [("20210517.light-urban.tste.ublox.m8t.GC.obs", 2.2), ("20210517.light-urban.tste.ublox.f9p.obs", 2.7)],
)
def test_receiver_of_a_car_between_towers_surveys_its_street(
    log: str, limit_m: float, recordings: Path, tmp_path: Path
) -> None:
    """Two laps. Codes are up to 400 m wrong; in one street of 400 m nearly all are, on both laps, for the M8T."""
    folder = recordings / "kinematic" / "urbannav_tst"
    out = tmp_path / "street.csv"
    words = ["map", "survey", str(folder / log), "--nav", str(folder / "hksc137c.nav"), "--out", str(out)]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    assert "a closed line of 1,8" in result.output
    time, truth = urbannav_truth(recordings)
    since = (time - time[0]) / np.timedelta64(1, "s")
    dense = np.stack([np.interp(np.arange(0.0, since[-1], 0.05), since, truth[:, i]) for i in range(3)], axis=1)
    track = read_track(out)
    axes = enu_axes(track.latitude_deg[0], track.longitude_deg[0])
    local, there = (track.ecef_m - truth[0]) @ axes.T, (dense - truth[0]) @ axes.T
    error = cKDTree(there[:, :2]).query(local[:, :2])[0]
    assert np.percentile(error, 95) < limit_m
    # one lap of the reference: 1,819.5 m
    assert track.chainage_m[-1] == pytest.approx(1819.5, rel=0.005)
    rows = [line.split(",") for line in out.read_text().splitlines() if not line.startswith("#")]
    sigma = np.array([float(row[rows[0].index("sigma_plan_m")]) for row in rows[1:]])
    assert np.percentile(error / sigma, 95) < 2.0
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 8
    assert "exists already" in again.output

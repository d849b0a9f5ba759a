"""On which track a train at rest stands: closed form, calibration, the real roof."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.stats import binom
from typer.testing import CliRunner

from network_made import made_network
from railfix.cli import app
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config
from railfix.positioning.standstill_phase import CodePlace
from railfix.positioning.track_choice import StandstillErrors, StandstillFix, TrackPosterior, track_posterior
from railfix.run.standstill import StandstillCodes, standstill_codes
from railfix.run.which_track import (
    WhichTrackInputs,
    WhichTrackOptions,
    decide_track,
    prior_of_interlocking,
    prior_of_last_place,
    which_track_files,
    write_last_place,
)
from railfix.simulate.demonstration import demo_files
from yard_made import RISKS, SPACING_M, decided, made_tracks, to_geojson

pytestmark = pytest.mark.requirement("E6")


def _fix(place: tuple[float, float], sigma: float) -> StandstillFix:
    own = sigma**2 * np.eye(2)
    return StandstillFix(east_north_m=np.array(place), own_m2=own, common_m2=np.zeros((2, 2)), misfit=8.0, freedom=10)


@pytest.mark.parametrize("y", [-1.5, -0.2, 0.0, 0.7, 2.0])
def test_two_tracks_have_the_logistic_posterior(y: float) -> None:
    """P = 1 / (1 + exp(-d y / sigma^2)) of the track on the side of y, for two tracks at distance d."""
    sigma = 1.3
    tracks = made_tracks(2, 0.0, np.array([-SPACING_M / 2.0, 0.0]), 0)
    errors = StandstillErrors(map_sigma_m=0.0, unmapped_prior=1e-12)
    posterior = track_posterior(tracks, [_fix((y, 3.0), sigma)], arms_m=(0.0,), errors=errors)
    assert posterior.probability[1] == pytest.approx(1.0 / (1.0 + np.exp(-SPACING_M * y / sigma**2)), rel=1e-5)
    assert posterior.probability.sum() == pytest.approx(1.0)


def test_two_antennas_give_the_facing_and_one_does_not() -> None:
    tracks = made_tracks(3, 30.0, np.zeros(2), 1)
    heading = np.array([np.sin(np.radians(30.0)), np.cos(np.radians(30.0))])
    fixes = [_fix(tuple(-10.0 * heading), 0.5), _fix(tuple(10.0 * heading), 0.5)]
    both = track_posterior(tracks, fixes, arms_m=(10.0, -10.0), errors=StandstillErrors())
    assert both.decision(risk=1e-2) == "T2"
    assert both.with_rising[1] < 1e-6
    one = track_posterior(tracks, fixes[:1], arms_m=(0.0,), errors=StandstillErrors())
    assert one.with_rising[1] == pytest.approx(one.probability[1] / 2.0)


def test_a_prior_of_the_interlocking_rules_tracks_out() -> None:
    tracks = made_tracks(3, 0.0, np.zeros(2), 1)
    fix = _fix((1.8, 0.0), 0.8)
    open_ = track_posterior(tracks, [fix], arms_m=(0.0,), errors=StandstillErrors())
    assert not open_.decision(risk=0.05)
    known = track_posterior(
        tracks, [fix], arms_m=(0.0,), errors=StandstillErrors(unmapped_prior=1e-3), prior={"T3": 0.9, "T1": 0.1}
    )
    assert known.decision(risk=0.05) == "T3"


def test_codes_that_do_not_fit_give_no_decision() -> None:
    tracks = made_tracks(2, 0.0, np.zeros(2), 0)
    good = _fix((0.0, 0.0), 0.2)
    bad = StandstillFix(
        east_north_m=good.east_north_m, own_m2=good.own_m2, common_m2=good.common_m2, misfit=60.0, freedom=10
    )
    assert track_posterior(tracks, [good], arms_m=(0.0,), errors=StandstillErrors()).decision(risk=1e-2) == "T1"
    assert track_posterior(tracks, [bad], arms_m=(0.0,), errors=StandstillErrors()).decision(risk=1e-2) == ""


@pytest.mark.parametrize("sigma", [0.25, 0.4, 0.6])
def test_an_antenna_between_tracks_is_on_neither(sigma: float) -> None:
    """The map is displaced by half the spacing: whichever the track is, nothing is decided."""
    tracks = made_tracks(2, 0.0, np.zeros(2), 0)
    for place in (0.45 * SPACING_M, 0.5 * SPACING_M):
        posterior = track_posterior(tracks, [_fix((place, 0.0), sigma)], arms_m=(0.0,), errors=StandstillErrors())
        assert posterior.decision(risk=1e-3) in ("", "none")


def test_a_place_far_from_its_track_in_standard_deviations_decides_nothing() -> None:
    """One track alone, with little prior of another: the codes' place lies 5 sigma beside it, then 1."""
    tracks = made_tracks(1, 0.0, np.zeros(2), 0)
    errors = StandstillErrors(map_sigma_m=0.0, unmapped_prior=1e-9)
    beside = track_posterior(tracks, [_fix((1.0, 0.0), 0.2)], arms_m=(0.0,), errors=errors)
    assert beside.probability[0] > 1.0 - 1e-3
    assert beside.misfit_sigmas[0] == pytest.approx(5.0, abs=0.05)
    assert beside.decision(risk=1e-3) == ""
    near = track_posterior(tracks, [_fix((0.2, 0.0), 0.2)], arms_m=(0.0,), errors=errors)
    assert near.misfit_sigmas[0] == pytest.approx(1.0, abs=0.05)
    assert near.decision(risk=1e-3) == "T1"


@pytest.mark.parametrize(("antenna_up_m", "sigma_up_m", "least"), [(4.0, 2.0, 0.95), (None, 2.0, 0.9), (4.0, 8.0, 0.5)])
def test_a_train_under_a_viaduct_is_not_on_it(antenna_up_m: float | None, sigma_up_m: float, least: float) -> None:
    """Two tracks at one place in plan, 8 m above each other; the codes' height is 4 m above the lower one."""
    below = made_tracks(1, 0.0, np.zeros(2), 0)[0]
    tracks = [replace(below, up_m=-4.0, sigma_up_m=0.5), replace(below, name="viaduct", up_m=4.0, sigma_up_m=0.5)]
    place = CodePlace(place_m=np.zeros(3), covariance_m2=np.diag([0.25, 0.25, sigma_up_m**2]))
    errors = StandstillErrors(antenna_up_m=antenna_up_m)
    found = track_posterior(tracks, [replace(_fix((0.0, 0.0), 0.5), place=place)], arms_m=(0.0,), errors=errors)
    assert found.probability[0] / found.probability[:2].sum() > least
    square = np.array([4.0 - (antenna_up_m or 2.5), -4.0 - (antenna_up_m or 2.5)]) ** 2
    square /= sigma_up_m**2 + 0.25 + (1.5**2 if antenna_up_m is None else 0.0)
    density = (1.0 + square / 8.0) ** -4.5
    assert found.probability[0] / found.probability[1] == pytest.approx(density[0] / density[1], rel=1e-9)
    unknown = [replace(tracks[0], up_m=np.nan), replace(tracks[1], up_m=np.nan)]
    plan = track_posterior(unknown, [replace(_fix((0.0, 0.0), 0.5), place=place)], arms_m=(0.0,), errors=errors)
    assert plan.probability[0] == pytest.approx(plan.probability[1])


def test_mean_noise_is_that_of_a_gauss_markov_process() -> None:
    errors = StandstillErrors(code_noise_m=1.0, correlation_s=30.0)
    rng = np.random.default_rng(4)
    keep = np.exp(-1.0 / 30.0)
    from scipy.signal import lfilter

    noise = rng.normal(0.0, 1.0, (6000, 90)) * np.sqrt(1.0 - keep**2)
    noise[:, 0] /= np.sqrt(1.0 - keep**2)
    means = lfilter([1.0], [1.0, -keep], noise, axis=1).mean(axis=1)
    assert means.std() == pytest.approx(float(errors.mean_noise_m(np.array([90.0]), 90.0)[0]), rel=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("common_m", [0.05, 1.0])
def test_wrong_decisions_of_2000_yards_are_within_the_risk(common_m: float) -> None:
    rows = [decided(seed, errors=StandstillErrors(), common_sigma_m=common_m) for seed in range(2000)]
    for risk in RISKS:
        given = [(a[risk][0], own) for a, own in rows if risk in a]
        assert len(given) > 400
        assert sum(name != own for name, own in given) <= binom.ppf(0.999, len(given), risk)


@pytest.mark.slow
@pytest.mark.parametrize("half_cycle", [False, True])
def test_wrong_decisions_with_phases_are_within_the_risk(half_cycle: bool) -> None:
    """Also where a satellite's phase is half a cycle off: such phases follow no model and count for nothing."""
    rows = [
        decided(
            k,
            errors=StandstillErrors(),
            common_sigma_m=0.05,
            method="phase",
            looks=(60.0, 300.0),
            half_cycle=half_cycle,
        )
        for k in range(500)
    ]
    for risk in RISKS:
        given = [(a[risk][0], own) for a, own in rows if risk in a]
        assert len(given) > 300
        assert sum(name != own for name, own in given) <= binom.ppf(0.999, len(given), risk)


def test_a_train_on_a_track_that_the_map_lacks_is_on_none() -> None:
    answers = [
        decided(k, errors=StandstillErrors(), common_sigma_m=0.05, unmapped=True)[0].get(1e-2) for k in range(12)
    ]
    assert all(a is None or a[0] == "none" for a in answers)
    assert sum(a is not None for a in answers) > 5


@pytest.fixture(scope="module")
def roof(recordings: Path) -> dict[str, StandstillCodes]:
    folder = recordings / "dual" / "mosaic_x2_99cm"
    navigation = read_navigation(folder / "base.nav")
    place = {
        name: ecef_from_geodetic(*(float(v) for v in (folder / f"{name}_position.txt").read_text().split()))
        for name in ("base", "rover")
    }
    base = (read_observations(folder / "base.obs"), place["base"])
    rover = read_observations(folder / "rover.obs")
    origin = place["rover"]
    return {
        "base": standstill_codes(rover, navigation, Config(filter="off"), base=base, origin_ecef_m=origin),
        "alone": standstill_codes(rover, navigation, Config(filter="off"), origin_ecef_m=origin),
    }


def _from(codes: StandstillCodes, first: int, epochs: int) -> StandstillCodes:
    rows = slice(first, first + epochs)
    phases = codes.phases
    if phases is not None:
        parts = {name: getattr(phases, name)[rows] for name in ("difference_m", "lost", "toward", "elevation_deg")}
        phases = replace(phases, **parts)
    return replace(codes, time=codes.time[rows], residual_m=codes.residual_m[rows], phases=phases)


@pytest.mark.parametrize(("kind", "decisions"), [("base", 0.9), ("alone", 0.0)])
@pytest.mark.every(4)
def test_roof_with_invented_yards_is_never_on_a_wrong_track(
    roof: dict[str, StandstillCodes], kind: str, decisions: float
) -> None:
    """3 azimuths, starts every minute, yards of 5 tracks with the train on the middle or the edge."""
    answers = []
    for azimuth in range(0, 180, 60):
        for start, own in ((0, 2), (60, 0), (120, 4), (180, 1), (240, 3)):
            yard = made_tracks(5, azimuth, np.zeros(2), own)
            result = decide_track(
                yard, [_from(roof[kind], start, 61)], arms_m=(0.0,), errors=StandstillErrors(), risk=1e-3
            )
            answers.append((result.track, f"T{own + 1}"))
    assert not [a for a in answers if a[0] not in ("undecided", a[1])]
    assert np.mean([a == b for a, b in answers]) >= decisions


def test_phases_of_the_roof_decide_at_a_millionth(roof: dict[str, StandstillCodes]) -> None:
    """Within a minute and at every azimuth, where codes beside the same base station leave tracks undecided."""
    answers: dict[bool, list[str]] = {True: [], False: []}
    for azimuth in range(0, 180, 30):
        yard = made_tracks(5, azimuth, np.zeros(2), 2)
        for with_phases, names in answers.items():
            codes = _from(roof["base"], 0, 61)
            codes = codes if with_phases else replace(codes, phases=None)
            names.append(decide_track(yard, [codes], arms_m=(0.0,), errors=StandstillErrors(), risk=1e-6).track)
    assert answers[True] == ["T3"] * 6
    assert answers[False].count("undecided") > 1
    assert set(answers[False]) <= {"T3", "undecided"}


def test_phases_of_the_roof_are_whole_wavelengths_at_its_place(roof: dict[str, StandstillCodes]) -> None:
    phases = roof["base"].phases
    mean = phases.mean(slice(0, 61), StandstillErrors())
    cycles = mean.difference_m / mean.wavelength_m
    assert len(cycles) > 20
    assert np.abs(cycles - np.round(cycles)).max() < 0.06


def test_a_slip_ends_the_part_of_a_satellite_that_is_used(roof: dict[str, StandstillCodes]) -> None:
    phases = roof["base"].phases
    whole = phases.mean(slice(0, 61), StandstillErrors())
    slipped = phases.difference_m.copy()
    slipped[25:, 3] += 5 * phases.wavelength_m[3]
    again = replace(phases, difference_m=slipped).mean(slice(0, 61), StandstillErrors())
    change = (again.difference_m - whole.difference_m) / whole.wavelength_m
    # the longer part is that after the slip: five wavelengths more, the mean is not between
    assert sorted(np.round(np.abs(change)).tolist())[-1] == 5.0
    assert np.abs(change - np.round(change)).max() < 0.02


@pytest.mark.slow
def test_roof_between_tracks_of_a_map_that_lacks_its_own_is_on_none(roof: dict[str, StandstillCodes]) -> None:
    for azimuth in range(0, 180, 60):
        yard = [track for k, track in enumerate(made_tracks(5, azimuth, np.zeros(2), 2)) if k != 2]
        result = decide_track(yard, [roof["base"]], arms_m=(0.0,), errors=StandstillErrors(), risk=1e-2, every_s=60.0)
        assert result.track in ("none", "undecided")


def test_command_prints_the_track_and_draws_it(recordings: Path, tmp_path: Path) -> None:
    folder = recordings / "dual" / "mosaic_x2_99cm"
    latitude, longitude, _ = (float(v) for v in (folder / "rover_position.txt").read_text().split())
    yard = to_geojson(made_tracks(4, 30.0, np.zeros(2), 1), latitude, longitude)
    (tmp_path / "yard.geojson").write_text(yard)
    place = ",".join((folder / "base_position.txt").read_text().split())
    words = ["which-track", "--front", str(folder / "rover.obs"), "--base", str(folder / "base.obs")]
    words += ["--nav", str(folder / "base.nav"), "--map", str(tmp_path / "yard.geojson"), "--base-place", place]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "p.png")])
    assert result.exit_code == 0, result.output
    assert result.output.startswith("track: T2, decided after 60 s")
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_errors_of_satellites_and_atmosphere_are_small_beside_a_base_station(roof: dict[str, StandstillCodes]) -> None:
    np.testing.assert_array_equal(roof["base"].common_m, 0.05)
    assert (roof["alone"].common_m > 0.5).all()


def test_a_moving_train_is_an_error(recordings: Path) -> None:
    folder = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    with pytest.raises(MismatchError, match="standstill"):
        standstill_codes(
            read_observations(folder / "SEPT265G.21O"), read_navigation(folder / "SEPT2650.21P"), Config(filter="off")
        )


def test_a_train_that_comes_back_is_a_moving_one() -> None:
    files = demo_files()
    log = read_observations(files["front"])[::10]
    with pytest.raises(MismatchError, match="standstill"):
        standstill_codes(log, read_navigation(files["nav"]), Config(filter="off"))


def test_breaks_and_half_cycles_of_either_receiver_are_in_the_phases() -> None:
    """At rest, the rear antenna as the base station: a break, a slip that the receiver names, half a cycle."""
    files = demo_files()
    front, rear = (read_observations(files[name])[:30] for name in ("front", "rear"))
    breaks, locks = front.break_before.copy(), [obs.loss_of_lock.copy() for obs in (front, rear)]
    breaks[10] = True
    channel = int(np.flatnonzero(np.isfinite(front.phase_cycles).all(axis=0))[0])
    name = (front.satellite[channel], front.signal[channel])
    other = int(np.flatnonzero((rear.satellite == name[0]) & (rear.signal == name[1]))[0])
    locks[0][15, channel], locks[1][20, other], locks[1][25, other] = 2, 1, 2
    front, rear = replace(front, break_before=breaks, loss_of_lock=locks[0]), replace(rear, loss_of_lock=locks[1])
    place = np.asarray(front.header.approximate_ecef_m)
    codes = standstill_codes(front, read_navigation(files["nav"]), Config(filter="off"), base=(rear, place))
    phases = codes.phases
    assert phases.lost[10].all()
    known = np.isfinite(phases.difference_m)
    (own,) = np.flatnonzero(~known[15] & ~known[25] & known[14] & known[20])
    assert np.flatnonzero(phases.lost[:, own]).tolist() == [10, 20]
    assert not phases.lost[11:, np.arange(known.shape[1]) != own].any()


@pytest.mark.parametrize("turned", [False, True])
def test_the_front_log_is_of_the_antenna_ahead(tmp_path: Path, turned: bool) -> None:
    """At rest on a track that rises to where the train faces, and on one that falls."""
    files = demo_files()
    truth = pl.read_csv(files["truth"])
    places = [truth.filter(pl.col("antenna") == name).select("x_m", "y_m", "z_m").row(0) for name in ("front", "rear")]
    front, rear = (np.array(place) for place in places)
    latitude, longitude, _ = (float(v) for v in geodetic_from_ecef((front + rear) / 2.0))
    east, north = enu_axes(latitude, longitude)[:2] @ (front - rear)
    azimuth = float(np.degrees(np.arctan2(east, north))) + 180.0 * turned
    (tmp_path / "y.geojson").write_text(to_geojson(made_tracks(1, azimuth, np.zeros(2), 0), latitude, longitude))
    inputs = WhichTrackInputs(
        front=(files["front"],), rear=(files["rear"],), nav=(files["nav"],), map=(tmp_path / "y.geojson",)
    )
    spacing, end = float(np.linalg.norm(front - rear)), datetime(2024, 3, 5, 3, 10, 3)
    options = WhichTrackOptions(spacing=spacing, end=end, same_frame="yes")
    posterior = which_track_files(inputs, options, Config(filter="off")).posteriors[-1]
    rising = float(posterior.with_rising[0] / posterior.probability[0])
    assert rising == pytest.approx(0.0 if turned else 1.0, abs=0.01)


# --- what is known beforehand ------------------------------------------------


def _last(folder: Path, **shares: float) -> Path:
    path = folder / "last.json"
    names = tuple(shares)
    posterior = TrackPosterior(
        names=names,
        probability=np.array([*shares.values()]),
        with_rising=np.zeros(len(names) - 1),
        fits=True,
        misfit_sigmas=np.zeros(len(names)),
    )
    write_last_place(posterior, np.datetime64("2024-01-01"), path)
    return path


def test_a_train_that_has_not_moved_is_where_it_was_but_for_a_missed_move(tmp_path: Path) -> None:
    net = made_network(10.0)
    path = _last(tmp_path, **{"01": 0.98, "02": 0.015, "none": 0.005})
    prior, unmapped = prior_of_last_place(path, net, moved_m=0.4, missed_move=1e-2, unmapped=0.05)
    count = len(net.names)
    assert prior["01"] == pytest.approx(0.99 * 0.98 + 0.01 * 0.995 / count)
    assert prior["1a"] == pytest.approx(0.01 * 0.995 / count)
    assert unmapped == pytest.approx(0.99 * 0.005 + 0.01 * 0.05)
    assert sum(prior.values()) == pytest.approx(0.995)


def test_a_train_that_has_moved_is_on_a_track_within_reach(tmp_path: Path) -> None:
    """From 01, which is 1120 m long, 100 m lead to 0a and 0b only, and by turning there to 02; 600 m to 1a, too."""
    net = made_network(10.0)
    path = _last(tmp_path, **{"01": 1.0, "none": 0.0})
    near, _ = prior_of_last_place(path, net, moved_m=100.0, missed_move=1e-3, unmapped=0.05)
    likely = {name for name, weight in near.items() if weight > 0.01}
    assert likely == {"01", "02", "0a", "0b"}
    far, _ = prior_of_last_place(path, net, moved_m=600.0, missed_move=1e-3, unmapped=0.05)
    assert {name for name, weight in far.items() if weight > 0.01} == likely | {"1a"}


def test_last_places_that_cannot_be_used_are_one_sentence(tmp_path: Path) -> None:
    net = made_network(10.0)
    known = {"moved_m": 0.0, "missed_move": 1e-3, "unmapped": 0.05}
    with pytest.raises(InputFileError, match="track 'x' is not in the map"):
        prior_of_last_place(_last(tmp_path, **{"x": 0.9, "none": 0.1}), net, **known)
    with pytest.raises(InputFileError, match="do not add up to 1"):
        prior_of_last_place(_last(tmp_path, **{"01": 0.9, "none": 0.3}), net, **known)
    (tmp_path / "last.json").write_text('{"probability": {"01": "much"}}')
    with pytest.raises(InputFileError, match="--save-last writes it"):
        prior_of_last_place(tmp_path / "last.json", net, **known)
    for text in ("01", "01=-1", "01=0", "01=nan"):
        with pytest.raises(SettingsError, match=r"NAME=WEIGHT|all weights are 0"):
            prior_of_interlocking(text, net)
    with pytest.raises(SettingsError, match="no track 'y'"):
        prior_of_interlocking("y=1", net)


@pytest.mark.slow
def test_last_place_decides_what_codes_alone_cannot(recordings: Path, tmp_path: Path) -> None:
    """Switched off beside a base station, switched on again without one."""
    folder = recordings / "dual" / "mosaic_x2_99cm"
    latitude, longitude, _ = (float(v) for v in (folder / "rover_position.txt").read_text().split())
    yard = to_geojson(made_tracks(4, 30.0, np.zeros(2), 1), latitude, longitude)
    (tmp_path / "yard.geojson").write_text(yard)
    place = ",".join((folder / "base_position.txt").read_text().split())
    words = ["which-track", "--front", str(folder / "rover.obs"), "--nav", str(folder / "base.nav")]
    words += ["--map", str(tmp_path / "yard.geojson"), "--crs", "EPSG:4326"]
    beside = ["--base", str(folder / "base.obs"), "--base-place", place, "--save-last", str(tmp_path / "last.json")]
    alone = CliRunner().invoke(app, words)
    assert alone.output.startswith("track: undecided"), alone.output
    first = CliRunner().invoke(app, [*words, *beside])
    assert first.output.startswith("track: T2"), first.output
    again = CliRunner().invoke(app, [*words, "--last", str(tmp_path / "last.json"), "--moved", "0"])
    assert again.output.startswith("track: T2"), again.output
    half = CliRunner().invoke(app, [*words, "--last", str(tmp_path / "last.json")])
    assert half.exit_code == 4

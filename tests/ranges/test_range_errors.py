"""Errors of single pseudoranges: clocks, reference station, past runs, the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import recordings_truth
from railfix.cli import app
from railfix.core.errors import InputFileError, MismatchError
from railfix.evaluate.range_errors import (
    ModelInputs,
    StationErrors,
    base_station,
    base_station_from_files,
    error_model_from_runs,
    range_errors,
    robust_clock,
)
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.io.reference_log import AntennaReference, read_reference
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.range_stage import collect_conditions
from railfix.ranges.error_model import read_error_model, write_error_model
from railfix.ranges.error_model_fit import ErrorModelFit
from railfix.run import RunOptions, read_record, run_files
from railfix.run.driver import open_inputs
from railfix.run.processor_setup import make_processor
from railfix.screens import Screened
from railfix.simulate import Scenario, Simulation, demo_files
from railfix.simulate.demonstration import demo_inputs
from railfix.track import from_positions
from railfix.track.trajectory import Trajectory
from recordings_score import straight_line

pytestmark = pytest.mark.requirement("C3")
EPOCH = np.datetime64("2024-03-05T00:00:00", "ns")


def test_the_clock_is_the_mean_of_clean_ranges_and_one_bad_one_hardly_moves_it() -> None:
    rng = np.random.default_rng(4)
    clean = 1000.0 + rng.normal(0.0, 1.0, (500, 9))
    sigma = np.ones_like(clean)
    groups = (slice(0, 5), slice(5, 9))
    found = robust_clock(clean, sigma, groups)
    assert np.abs(found.clock_m[:, 0] - clean[:, :5].mean(axis=1)).max() < 0.6
    assert found.clock_m[:, 0].std() == pytest.approx(1.0 / np.sqrt(5), rel=0.15)
    np.testing.assert_allclose(found.share[:, :5].sum(axis=1), 1.0)
    dirty = clean.copy()
    dirty[:, 2] += 100.0
    moved = robust_clock(dirty, sigma, groups).clock_m - found.clock_m
    assert np.abs(moved[:, 0]).max() < 1.5
    assert (moved[:, 1] == 0.0).all()


def test_too_few_ranges_have_no_clock() -> None:
    residual = np.full((1, 5), 7.0)
    residual[0, 3:] = np.nan
    assert np.isnan(robust_clock(residual, np.ones((1, 5)), (slice(0, 5),)).clock_m).all()
    assert robust_clock(residual, np.ones((1, 5)), (slice(0, 5),), least_ranges=3).clock_m[0, 0] == 7.0


def test_a_station_speaks_between_its_epochs_and_of_its_satellites() -> None:
    station = StationErrors(
        name="x",
        time=EPOCH + np.array([0, 30, 90]) * np.timedelta64(1, "s"),
        satellite=np.array(["E01", "G01"]),
        error_m=np.array([[1.0, 4.0], [3.0, np.nan], [5.0, 8.0]]),
        smoothed=True,
    )
    at = EPOCH + np.array([-1, 0, 15, 30, 60, 91]) * np.timedelta64(1, "s")
    found = station.at(at, np.array(["E01", "R01"]), largest_gap_s=35.0)
    np.testing.assert_allclose(found[:, 0], [np.nan, 1.0, 2.0, 3.0, np.nan, np.nan])
    assert np.isnan(found[:, 1]).all()
    assert np.isnan(station.at(at, np.array(["G01"]), largest_gap_s=100.0)[2, 0])


def _demo(config: Config, part: slice = slice(0, 600)) -> tuple[EpochProcessor, Observations, AntennaReference]:
    inputs = demo_inputs()
    navigation, line, logs = open_inputs(inputs, RunOptions(), Config(filter="off"))
    processor = make_processor(config, navigation, line.trajectories)
    reference = read_reference(demo_files()["truth"], ("front", "rear"))["front"]
    return processor, next(logs["front"].parts())[part], reference


def test_an_error_put_into_a_code_comes_back_and_touches_no_other_satellite() -> None:
    config = parse_config({"filter": "off", "screens": ["elevation"], "systems": ["G"]})
    processor, obs, reference = _demo(config, slice(0, 50))
    found, _ = processor.process({"front": obs})
    used = np.flatnonzero(np.char.startswith(obs.satellite, "G") & (found.antennas["front"].reason == 0).all(axis=0))
    one = int(used[0])
    code = obs.code_m.copy()
    code[:, one] += 60.0
    spoilt, _ = processor.process({"front": replace(obs, code_m=code)})
    path = processor.trajectories["front"]
    before = range_errors(found.antennas["front"], path, reference)
    after = range_errors(spoilt.antennas["front"], path, reference)
    np.testing.assert_array_equal(before.satellite, after.satellite)
    changed = after.samples.error_m - before.samples.error_m
    itself = before.satellite == obs.satellite[one]
    # Huber's weight holds a sixtyfold outlier down to a share of a few per cent of the clock.
    assert np.median(changed[itself]) == pytest.approx(60.0, abs=4.0)
    assert np.abs(np.median(changed[~itself])) < 1.0


@pytest.mark.parametrize("screen", ["doppler", "antenna_pair"])
def test_a_range_that_a_screen_suspects_does_not_count_for_its_clock(screen: str) -> None:
    processor, obs, reference = _demo(parse_config({"filter": "off", "screens": ["elevation"]}), slice(0, 5))
    found, path = processor.process({"front": obs})[0].antennas["front"], processor.trajectories["front"]
    reject = np.zeros(found.corrected.reason.shape, dtype=bool)
    reject[:, np.flatnonzero((found.corrected.reason == 0).all(axis=0))[0]] = True
    suspected = replace(found, screens={screen: Screened(reject=reject, metric=np.zeros(reject.shape))})
    before, after = (range_errors(result, path, reference).samples for result in (found, suspected))
    assert before.used.sum() - after.used.sum() == 5


def test_the_errors_of_a_simulated_run_have_the_noise_that_was_put_in() -> None:
    made = Simulation(Scenario(duration_s=60.0))
    (piece,) = made.pieces("front", chunk_epochs=600)
    path = Trajectory.from_antenna_path(made.line.track())
    processor = make_processor(
        parse_config({"filter": "off", "screens": ["elevation"]}), made.navigation, {"front": path}
    )
    result, _ = processor.process({"front": piece.observations})
    blank, words = np.full(600, np.nan), np.full(600, "")
    reference = AntennaReference(
        time=piece.observations.time,
        ecef_m=piece.geometry.antenna_ecef_m,
        chainage_m=blank,
        speed_mps=blank,
        sigma_m=blank,
        source=words,
        environment=words,
    )
    errors = range_errors(result.antennas["front"], path, reference)
    sample = errors.samples
    expected = 0.5 * 10.0 ** ((45.0 - np.minimum(sample.cn0_dbhz, 50.0)) / 20.0)
    expected /= np.sin(np.radians(sample.elevation_deg))
    score = sample.error_m[sample.used] / expected[sample.used]
    assert errors.epochs == 600
    assert score.std() == pytest.approx(1.0, abs=0.05)
    assert abs(score.mean()) < 0.05


def test_the_car_s_own_front_counts_not_north() -> None:
    processor, obs, reference = _demo(parse_config({"filter": "off", "screens": ["elevation"]}), slice(0, 2))
    result, _ = processor.process({"front": obs})
    path = processor.trajectories["front"]
    errors = range_errors(result.antennas["front"], path, reference)
    turned = range_errors(result.antennas["front"], replace(path, facing="falling"), reference)
    away = (errors.samples.relative_azimuth_deg - turned.samples.relative_azimuth_deg) % 360.0
    np.testing.assert_allclose(away, 180.0)
    column = int(np.flatnonzero(obs.satellite == errors.satellite[0])[0])
    heading = path.body_azimuth_deg(path.nearest(reference.ecef_m[:1])[0])[0]
    expected = (result.antennas["front"].azimuth_deg[0, column] - heading) % 360.0
    assert errors.samples.relative_azimuth_deg[0] == pytest.approx(expected, abs=0.1)


def test_a_station_takes_the_common_errors_away(recordings: Path) -> None:
    folder = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    time, ecef = recordings_truth.japan_truth(folder)
    navigation = read_navigation([folder / "SEPT2650.21P"])
    path = Trajectory.from_antenna_path(from_positions(time, ecef, spacing_m=5.0))
    config = parse_config({"filter": "off", "ionosphere": "off", "troposphere": "off"})
    result, _ = make_processor(config, navigation, {"front": path}).process(
        {"front": read_observations(folder / "SEPT265G.21O")}
    )
    blank = np.full(len(time), np.nan)
    words = np.full(len(time), "")
    reference = AntennaReference(
        time=time, ecef_m=ecef, chainage_m=blank, speed_mps=blank, sigma_m=blank, source=words, environment=words
    )
    processor = make_processor(config, navigation, {"front": path})
    station = base_station_from_files([folder / "3034265G.21O"], processor)
    assert station.smoothed
    antenna = result.antennas["front"]
    alone = range_errors(antenna, path, reference)
    with_station = range_errors(antenna, path, reference, station)

    def spread(errors: object) -> float:
        size = np.abs(errors.samples.error_m[errors.samples.used])  # type: ignore[attr-defined]
        return float(np.percentile(size, 68))

    # Without any model of the atmosphere the errors are of metres; both receivers have the same ones.
    assert spread(alone) > 2.0
    assert spread(with_station) < 0.7 * spread(alone)


@pytest.fixture(scope="module")
def done_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    run_files(demo_inputs(), parse_config({"filter": "off", "min_satellites": 4}), out=folder / "run")
    return folder / "run"


def test_a_read_record_knows_how_it_was_done(done_run: Path) -> None:
    past = read_record(done_run)
    assert past.config.min_satellites == 4
    assert past.inputs == demo_inputs()
    assert past.options == RunOptions()
    past.check_inputs()


def test_a_read_record_whose_input_has_changed_is_refused(done_run: Path, tmp_path: Path) -> None:
    record = json.loads((done_run / "run.json").read_text())
    record["inputs"][0]["sha256"] = "0" * 64
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(MismatchError, match="has changed since the run"):
        read_record(tmp_path).check_inputs()


@pytest.mark.parametrize(
    ("content", "said"),
    [("{", "is not valid JSON"), ("{}", "has no table settings_used"), ("[]", "expected a JSON object")],
)
def test_a_folder_that_is_no_run_is_refused(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(InputFileError, match=said):
        _ = read_record(tmp_path).config
    with pytest.raises(InputFileError, match="expected the folder that railfix run wrote"):
        read_record(tmp_path / "nothing")


def test_the_command_writes_a_model_and_says_what_it_lacks(done_run: Path, tmp_path: Path) -> None:
    truth, out = str(demo_files()["truth"]), tmp_path / "model.toml"
    done = CliRunner().invoke(
        app, ["error-model", str(done_run), "--reference", truth, "--out", str(out), "--cn0", "0,60"]
    )
    assert done.exit_code == 0, done.output
    assert "satellite and atmospheric errors are part of the model" in " ".join(done.output.split())
    model = read_error_model(out)
    assert model.covers == "satellite_and_atmosphere"
    assert model.bins.shape == (5, 4, 1)
    assert model.source.epochs == 4000
    assert (model.before.count >= model.after.count).all()
    again, samples = error_model_from_runs(
        [ModelInputs(run=done_run, reference=demo_files()["truth"])], fit=ErrorModelFit(bins=model.bins)
    )
    np.testing.assert_allclose(again.after.bound_sigma_m, model.after.bound_sigma_m, atol=5e-4)
    assert again.after.count.sum() == samples.used.sum()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--out", "nodir/m.toml"], 8, "the folder nodir does not exist"),
        (["--out", "m.toml", "--elevations", "0,90,45"], 4, "ascending order"),
        (["--out", "m.toml", "--cn0", "x"], 4, "--cn0: Input should be a valid number"),
        (["--out", "m.toml", "--reference", "b"], 4, "1 runs and 2 references"),
        (["--out", "m.toml", "--base-position", "1,2"], 4, "--base-position '1,2'"),
    ],
)
def test_what_cannot_be_is_said_before_the_work(
    done_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["error-model", str(done_run), "--reference", "a", *arguments])
    assert done.exit_code == code
    assert said in done.output


def test_a_reference_that_is_nowhere_good_enough_is_refused() -> None:
    processor, obs, reference = _demo(parse_config({"filter": "off", "screens": ["elevation"]}), slice(0, 20))
    result, _ = processor.process({"front": obs})
    wide = replace(reference, sigma_m=np.full(len(reference.time), 0.6))
    with pytest.raises(MismatchError, match=r"fewer than two of the .* positions have a sigma of 0\.5 m or less"):
        range_errors(result.antennas["front"], processor.trajectories["front"], wide)


def test_a_run_of_another_version_is_refused(done_run: Path, tmp_path: Path) -> None:
    record = json.loads((done_run / "run.json").read_text())
    record["options"]["novelty"] = 1
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputFileError, match=r"does not fit this version .*unknown setting novelty"):
        _ = read_record(tmp_path).options


def test_the_station_is_corrected_as_the_train_is(recordings: Path) -> None:
    """A station that plays the train, on an SBAS run: nothing is left but what each has of its own."""
    folder = recordings / "sbas" / "msas_20080526_crescent"
    navigation = read_navigation([folder / "cres_20080526.bin.nav"])
    config = parse_config(
        {"sbas": [str(folder / "cres_20080526.bin.sbs")], "sbas_prn": 137, "elevation": {"mask_deg": 10.0}}
    )
    plain = parse_config({"filter": "off", "elevation": {"mask_deg": 10.0}})
    log = read_observations(folder / "cres_20080526.bin.obs")[:200]
    line = straight_line(log.header.approximate_ecef_m, 45.0)
    found, _ = make_processor(plain, navigation, {"front": line}).process({"front": log})
    place = np.nanmedian(found.antennas["front"].point.ecef_m, axis=0)
    line = straight_line(place, 45.0)
    processor = make_processor(config, navigation, {"front": line})
    result, _ = processor.process({"front": log})
    blank, words = np.full(len(log), np.nan), np.full(len(log), "")
    reference = AntennaReference(
        time=log.time,
        ecef_m=np.tile(place, (len(log), 1)),
        chainage_m=blank,
        speed_mps=blank,
        sigma_m=blank,
        source=words,
        environment=words,
    )
    errors = []
    for one in (processor, make_processor(plain, navigation, {"front": line})):
        station = base_station([log], one, place, name="itself")
        found_errors = range_errors(result.antennas["front"], line, reference, station)
        errors.append(
            max(
                abs(float(found_errors.samples.error_m[found_errors.satellite == name].mean()))
                for name in np.unique(found_errors.satellite)
            )
        )
    same, other = errors
    print(f"largest mean error of a satellite: {same:.2f} m with the station corrected alike, {other:.2f} m if not")
    assert same < 1.2
    assert other > 2.0 * same


def test_a_model_says_under_which_conditions_it_holds(done_run: Path, tmp_path: Path) -> None:
    model, _ = error_model_from_runs([ModelInputs(run=done_run, reference=demo_files()["truth"])])
    assert model.conditions == collect_conditions(read_record(done_run).config)
    write_error_model(model, tmp_path / "m.toml")
    same = make_processor(parse_config({"filter": "off", "error_model": str(tmp_path / "m.toml")}), *_nothing())
    assert not any("other conditions" in note for note in same.notes)
    other = make_processor(
        parse_config({"filter": "off", "error_model": str(tmp_path / "m.toml"), "screens": []}), *_nothing()
    )
    assert any("its conditions differ from those of this run: screens: model elevation" in note for note in other.notes)


def _nothing() -> tuple[Navigation, dict[str, Trajectory]]:
    navigation, line, _ = open_inputs(demo_inputs(), RunOptions(), Config(filter="off"))
    return navigation, line.trajectories

"""Positions with SBAS corrections: what is corrected, what is refused and why, what the level rests on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.errors import SettingsError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.reasons import Reason, Status
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import satellite_states
from railfix.integrity.fault_exclusion import compute_statistic
from railfix.integrity.protection.solution_separation import RangeBounds
from railfix.integrity.raim import linear_model
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.level_stage import late_sides, level_facts, prior_basis_text, protection_levels
from railfix.pipeline.range_stage import fit_ranges
from railfix.pipeline.results import AntennaResult
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.line_fix import fix_on_line
from railfix.positioning.map_offset import MapOffset
from railfix.positioning.normal_equations import point_position
from railfix.ranges.atmosphere import saastamoinen_delay_m
from railfix.ranges.sbas import SatelliteState, SbasCorrections, read_sbas
from railfix.ranges.sbas.sbas_sources import REASONS
from railfix.run.processor_setup import make_processor
from railfix.simulate import demo_files
from railfix.track import Track, write_track_csv
from railfix.track.trajectory import Trajectory
from recordings_score import straight_line

pytestmark = pytest.mark.requirement("C1")
SETTINGS = {"elevation": {"mask_deg": 10.0}, "sbas_prn": 137}


class Recording:
    """The log of 2008 with its messages, and a level line through where it was parked."""

    def __init__(self, folder: Path) -> None:
        self.sbas = folder / "cres_20080526.bin.sbs"
        self.front = folder / "cres_20080526.bin.obs"
        self.nav = folder / "cres_20080526.bin.nav"
        self.observations: Observations = read_observations(self.front)
        self.navigation: Navigation = read_navigation([self.nav])
        without = make_processor(parse_config({"filter": "off"}), self.navigation, {"front": self.line_at(None)})
        found = without.process({"front": self.observations[:200]})[0].antennas["front"]
        self.parked = np.nanmedian(found.point.ecef_m, axis=0)
        self.line = self.line_at(self.parked)

    def line_at(self, place: np.ndarray | None) -> Trajectory:
        return straight_line(self.observations.header.approximate_ecef_m if place is None else place, 45.0)

    def config(self, **settings: object) -> Config:
        return parse_config({"filter": "off", **SETTINGS, "sbas": [str(self.sbas)], **settings})

    def process(self, config: Config, observations: Observations | None = None) -> AntennaResult:
        processor = make_processor(config, self.navigation, {"front": self.line})
        return processor.process({"front": observations or self.observations})[0].antennas["front"]


@pytest.fixture(scope="module")
def recording(recordings: Path) -> Recording:
    return Recording(recordings / "sbas" / "msas_20080526_crescent")


@pytest.fixture(scope="module")
def corrected(recording: Recording) -> AntennaResult:
    return recording.process(recording.config())


def test_every_state_of_a_satellite_has_a_reason() -> None:
    assert len(REASONS) == len(SatelliteState)
    assert [int(state) for state in SatelliteState if REASONS[state] == 0] == [SatelliteState.OK]


def test_a_satellite_is_used_or_refused_as_its_corrections_are(recording: Recording, corrected: AntennaResult) -> None:
    engine = SbasCorrections.from_log(read_sbas([recording.sbas]), prn=137)
    satellite = corrected.satellite[corrected.columns]
    fixes = engine.satellites(corrected.time, satellite, recording.navigation)
    reason = corrected.reason[:, corrected.columns]
    observed = (reason & Reason.NOT_OBSERVED) == 0
    of_sbas = Reason.SBAS_NOT_COVERED | Reason.SBAS_NO_CORRECTION | Reason.SBAS_TIMED_OUT | Reason.SBAS_DO_NOT_USE
    np.testing.assert_array_equal((reason & of_sbas)[observed], REASONS[fixes.state][observed])
    assert (fixes.state[reason == 0] == SatelliteState.OK).all()
    # The log begins in the middle of things: until mask, corrections and grid had come nothing could be used.
    first = int(np.argmax((reason == 0).any(axis=1)))
    assert 60 < first < 200
    assert (corrected.status[:first] == Status.TOO_FEW_SATELLITES).all()
    assert {int(r) for r in np.unique(reason & ~int(Reason.ELEVATION_MASK | Reason.FAULT_EXCLUDED))} >= {
        0,
        int(Reason.SBAS_NO_CORRECTION),
        int(Reason.SBAS_DO_NOT_USE),
        int(Reason.SBAS_NO_IONOSPHERE),
    }


def test_a_corrected_code_is_the_sum_of_its_parts(recording: Recording, corrected: AntennaResult) -> None:
    engine = SbasCorrections.from_log(read_sbas([recording.sbas]), prn=137)
    columns = corrected.columns
    satellite, code = corrected.satellite[columns], recording.observations.code_m[:, columns]
    fixes = engine.satellites(corrected.time, satellite, recording.navigation)
    states = satellite_states(
        corrected.time, satellite, corrected.signal[columns], code, recording.navigation, record=fixes.record
    )
    place = corrected.point.ecef_m
    latitude, longitude, height = geodetic_from_ecef(np.where(np.isnan(place), recording.parked, place))
    elevation, azimuth = corrected.elevation_deg[:, columns], corrected.azimuth_deg[:, columns]
    grid = engine.ionosphere(corrected.time, latitude, longitude, elevation, azimuth)
    used = corrected.reason[:, columns] == 0
    by_hand = code + states.clock_m - states.group_delay_m + fixes.fast_m + SPEED_OF_LIGHT * fixes.clock_s
    by_hand -= grid.delay_m
    troposphere = by_hand - corrected.corrected_code_m[:, columns]
    # What is left is DO-229D's troposphere, within 4 % of Saastamoinen's of the same place.
    other = saastamoinen_delay_m(latitude, height, elevation)
    assert used.sum() > 500
    np.testing.assert_allclose(troposphere[used], other[used], rtol=0.04, atol=0.02)


def test_the_parked_antenna_stays_where_it_is(recording: Recording, corrected: AntennaResult) -> None:
    """Corrections of metres move a position by metres, not by more: it agrees with the uncorrected one within 15 m."""
    plain = recording.process(parse_config({"filter": "off", "elevation": {"mask_deg": 10.0}}))
    both = np.isfinite(corrected.point.ecef_m[:, 0]) & (np.arange(len(plain)) < 200)
    moved = np.linalg.norm(corrected.point.ecef_m - plain.point.ecef_m, axis=1)[both]
    assert both.sum() > 20
    assert 0.1 < np.median(moved) < 15.0


@pytest.mark.requirement("C2")
def test_the_level_of_an_sbas_rests_on_its_sigmas_and_never_shrinks_them(recording: Recording) -> None:
    config = recording.config()
    assert level_facts(config)["kind"] == "sbas"
    assert set(level_facts(config)["satellite_prior"].values()) == {0.0}
    assert level_facts(parse_config({"filter": "off"}))["kind"] == "separation"
    processor = make_processor(config, recording.navigation, {"front": recording.line})
    obs = recording.observations[180:200]
    one = processor.screen({"front": obs})[0].corrected
    antennas, ranges = AntennaRows.on(processor.indices["front"]), fit_ranges(one)
    fix = fix_on_line(ranges, antennas, point_position(ranges, one.near_ecef_m), config.fix_limits)
    position = fix.constrained
    scale, model_on_line = (
        np.ones(len(ranges)),
        linear_model(ranges, antennas, position.arc_m, section=position.section),
    )
    raim = compute_statistic(ranges, fix, scale, limits=config.raim)
    systems = [name[0] for name in one.satellite.tolist()]
    nothing = (np.zeros(len(ranges)), np.zeros(len(ranges)))
    offset = cast("MapOffset", SimpleNamespace(beyond_m=nothing, seen=None))

    sides = late_sides(one.azimuth_deg, one.elevation_deg, np.zeros(len(scale)), config.risk)

    def levels(scale: np.ndarray, settings: Config) -> np.ndarray:
        bounds = None if settings.error_model is None else RangeBounds(one.bound_sigma_m, one.bias_m)
        found = protection_levels(model_on_line, systems, offset, raim, scale, sides, settings, overbound=bounds)
        return found.level.level_m

    has = np.isfinite(levels(scale, config))
    assert has.any()
    np.testing.assert_array_equal(levels(0.3 * scale, config), levels(scale, config))
    assert (levels(3.0 * scale, config)[has] > levels(scale, config)[has]).all()
    plain = config.model_copy(update={"sbas": ()})
    np.testing.assert_array_equal(levels(0.3 * scale, plain), levels(scale, plain))
    # Without the integrity of an SBAS the satellites' own faults are hypotheses, too.
    assert (levels(scale, plain)[has] > levels(scale, config)[has]).all()
    model = config.model_copy(update={"error_model": Path("line.toml")})
    np.testing.assert_array_equal(levels(0.3 * scale, model), levels(scale, model))
    assert np.nanmin(one.sigma_m[one.reason == 0]) > 1.0


@pytest.mark.parametrize(("prn", "words"), [(120, "sbas_prn = 120"), (999, "sbas_prn: a PRN of SBAS .* was expected")])
def test_a_geo_that_the_log_does_not_have_is_refused(recording: Recording, prn: int, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        make_processor(recording.config(sbas_prn=prn), recording.navigation, {"front": recording.line})


def test_the_command_says_what_was_asked_and_what_was_used(recording: Recording, tmp_path: Path) -> None:
    latitude, longitude, height = geodetic_from_ecef(recording.line.ecef_m)
    write_track_csv(Track.from_geodetic(latitude, longitude, height, name="parked"), tmp_path / "line.csv")
    command = [
        "run",
        "--front",
        str(recording.front),
        "--nav",
        str(recording.nav),
        "--track",
        str(tmp_path / "line.csv"),
    ]
    command += ["--set", "elevation.mask_deg=10"]
    done = CliRunner().invoke(app, [*command, "--sbas", str(recording.sbas), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["settings_asked"]["sbas"] == [str(recording.sbas)]
    assert {entry["input"] for entry in record["inputs"]} == {"front", "nav", "track", "sbas"}
    assert record["protection"]["kind"] == "sbas"
    said = " ".join(record["notes"])
    assert "klobuchar, troposphere: saastamoinen requested, SBAS models used instead" in said
    assert "best SBAS PRN by usable fast corrections: 137" in said
    assert record["antennas"]["front"]["observations_rejected_by_first_reason"]["sbas_no_correction"] > 1000
    missing = CliRunner().invoke(app, [*command, "--sbas", "nowhere.sbs", "--out", str(tmp_path / "other")])
    assert missing.exit_code == 3
    assert "nowhere.sbs" in missing.output
    assert not (tmp_path / "other").exists()


def test_messages_of_another_day_do_not_belong_to_the_log(recording: Recording, tmp_path: Path) -> None:
    files = demo_files()
    command = ["run", "--front", str(files["front"]), "--nav", str(files["nav"]), "--track", str(files["track"])]
    done = CliRunner().invoke(app, [*command, "--sbas", str(recording.sbas), "--out", str(tmp_path / "out")])
    assert done.exit_code == 5
    assert "have no time in common" in done.output


def test_precise_orbits_are_not_what_sbas_corrects(recording: Recording) -> None:
    # Never looked into: the refusal comes before.
    navigation = replace(recording.navigation, precise=object())
    with pytest.raises(SettingsError, match="use either --sbas or --sp3"):
        make_processor(recording.config(), navigation, {"front": recording.line})


def test_other_signals_than_l1_ca_are_not_corrected(recording: Recording) -> None:
    renamed = replace(recording.observations, signal=np.full(len(recording.observations.signal), "1W"))
    found = recording.process(recording.config(), renamed[180:200])
    observed = ((found.reason & Reason.NOT_OBSERVED) == 0) & np.char.startswith(found.satellite, "G")
    assert observed.any()
    assert (found.reason[observed] & Reason.SBAS_NOT_COVERED).all()


def test_a_newer_record_that_calls_a_satellite_unhealthy_wins_over_the_issue_of_its_correction(
    recording: Recording, corrected: AntennaResult
) -> None:
    used = (corrected.reason == 0).sum(axis=0)
    one = str(corrected.satellite[int(np.argmax(used))])
    kepler = recording.navigation.kepler
    row = int(np.flatnonzero(kepler.satellite == one)[0])
    names = list(kepler.__dataclass_fields__)
    extra = {name: np.concatenate([getattr(kepler, name), getattr(kepler, name)[row : row + 1]]) for name in names}
    extra["health"][-1], extra["iode"][-1] = 63, (int(kepler.iode[row]) + 7) % 256
    extra["transmitted"][-1] = recording.observations.time[0]
    extra["toe"][-1] = extra["toe"][-1] + np.timedelta64(16, "s")
    navigation = replace(recording.navigation, kepler=replace(kepler, **extra))
    processor = make_processor(recording.config(), navigation, {"front": recording.line})
    found = processor.process({"front": recording.observations})[0].antennas["front"]
    column = int(np.flatnonzero(found.satellite == one)[0])
    observed = (found.reason[:, column] & Reason.NOT_OBSERVED) == 0
    assert (found.reason[observed, column] & Reason.UNHEALTHY).all()


@pytest.mark.requirement("C2")
def test_positions_from_code_and_phase_have_no_level(recording: Recording) -> None:
    config = recording.config(carrier="float")
    processor = make_processor(config, recording.navigation, {"front": recording.line})
    assert processor.process({"front": recording.observations[150:170]})[0].antennas["front"].protection is None
    assert any("not available for positions from both code and phase" in note for note in processor.notes)


@pytest.mark.requirement("C2", "C3")
def test_every_output_names_what_a_level_rests_on() -> None:
    """Assumed priors, and a prior of one side of the track below what any data supports."""
    for risk, indicative, unsupported in (
        ({}, True, False),
        ({"side_prior": 1e-8}, True, True),
        ({"priors": "measured", "local_prior": 2e-5, "side_prior": 2e-5}, False, False),
        ({"priors": "measured", "local_prior": 2e-5, "side_prior": 5e-6}, False, False),  # measured there
        ({"priors": "measured", "local_prior": 2e-5, "side_prior": 0.0}, False, True),
    ):
        text = prior_basis_text(level_facts(parse_config({"filter": "off", "risk": risk})))
        assert ("indicative" in text, "no hourly risk" in text) == (indicative, indicative)
        assert ("no data supports" in text) == unsupported
    assert prior_basis_text({}) == "not recorded"

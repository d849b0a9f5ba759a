"""A base station beside a recorded drive: codes, integers, cutting into chunks, and what is missing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import base_cases
import recordings_truth
from railfix.core.errors import SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.evaluate import along_track_error, interpolate_reference
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.base_station_stage import Stations
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.results import AntennaResult
from railfix.ranges.base_station import BaseErrors
from railfix.ranges.sbas import SbasState
from railfix.track import from_positions
from railfix.track.trajectory import Trajectory

#: Of the reference's own program; the position in the station's header is 4.4 m off.
PLACE = ecef_from_geodetic(35.326681912, 139.466071726, 46.5007)


class Drive:
    """The car in Japan, its base station 5.3 km away, and the map from its reference."""

    def __init__(self, recordings: Path) -> None:
        folder = next((recordings / "kinematic").glob("japan_mosaic*"))
        self.time, self.ecef_m = recordings_truth.japan_truth(folder)
        self.trajectory = Trajectory.from_antenna_path(from_positions(self.time, self.ecef_m, spacing_m=5.0))
        self.navigation = read_navigation([folder / "SEPT2650.21P"])
        self.train = read_observations(folder / "SEPT265G.21O")
        self.base = read_observations(folder / "3034265G.21O")

    def run(self, *, base: bool, cuts: tuple[int, ...] = (), **settings: Any) -> list[AntennaResult]:
        config = parse_config({"filter": "off", "elevation": {"mask_deg": 15.0}, **settings})
        processor = EpochProcessor(
            config,
            {"front": self.trajectory},
            navigation=self.navigation,
            stations=Stations(base_ecef_m=PLACE if base else None),
        )
        state, results, read = State(), [], 0
        for part in np.split(np.arange(len(self.train)), cuts):
            chunk = self.train[part[0] : part[-1] + 1]
            end = int(np.searchsorted(self.base.time, chunk.time[-1], side="right"))
            news = self.base[read:end] if base else None
            read = end
            result, state = processor.process({"front": chunk}, state, base=news)
            results.append(result.antennas["front"])
        return results

    def errors(self, result: AntennaResult) -> np.ndarray:
        reference = interpolate_reference(result.time, self.time, self.ecef_m)
        return np.abs(along_track_error(result.arc_m, reference, self.trajectory))


@pytest.fixture(scope="module")
def drive(recordings: Path) -> Drive:
    return Drive(recordings)


@pytest.mark.requirement("A12")
@pytest.mark.slow
def test_differences_of_codes_halve_the_errors(drive: Drive) -> None:
    alone, beside = (drive.errors(drive.run(base=base, protection="off")[0]) for base in (False, True))
    for share in (50, 95, 100):
        assert np.nanpercentile(beside, share) < 0.5 * np.nanpercentile(alone, share)


@pytest.mark.requirement("A12")
@pytest.mark.slow
def test_fixed_integers_are_right_and_any_cutting_gives_the_same(drive: Drive) -> None:
    (whole,) = drive.run(base=True, carrier="fixed")
    error = drive.errors(whole)
    fixed = whole.phase.n_fixed > 0
    assert fixed.sum() > 150
    assert np.nanpercentile(error[fixed], 95) < 0.05
    cut = drive.run(base=True, carrier="fixed", cuts=(1, 40, 41, 200))
    np.testing.assert_allclose(np.concatenate([part.arc_m for part in cut]), whole.arc_m, atol=1e-6)
    risk = np.concatenate([part.phase.integer_risk for part in cut])
    np.testing.assert_allclose(risk, whole.phase.integer_risk, rtol=1e-6)  # sums over other channels round differently


def test_a_position_of_the_stream_is_taken_from_its_headers(drive: Drive) -> None:
    processor = EpochProcessor(
        parse_config({"filter": "off", "protection": "off"}),
        {"front": drive.trajectory},
        navigation=drive.navigation,
        stations=Stations(base_ecef_m="stream"),
    )
    nowhere, known = (with_place(drive.base[:1], place) for place in (np.full(3, np.nan), PLACE))
    first, state = processor.process({"front": drive.train[:1]}, base=nowhere)
    assert any("no epoch with a known station position" in note for note in first.notes)
    assert base_errors(state) is None
    second, state = processor.process({"front": drive.train[1:2]}, state, base=known)
    assert not any("base station" in note for note in second.notes)
    assert base_errors(state) is not None
    moved = with_place(drive.base[1:2], PLACE + 1.0)
    _, state = processor.process({"front": drive.train[2:3]}, state, base=moved)
    errors = base_errors(state)
    assert len(errors) == 1  # the one before was of another place


def test_a_virtual_station_that_has_moved_begins_anew_with_its_smoothing(drive: Drive) -> None:
    """As the first epoch of a log does: what its codes were smoothed by belongs to the place before."""
    moved, found = with_place(drive.base[6:7], PLACE + 1.0), []
    for before in ((0, 6), None):
        processor = EpochProcessor(
            parse_config({"filter": "off", "protection": "off"}),
            {"front": drive.trajectory},
            navigation=drive.navigation,
            stations=Stations(base_ecef_m="stream"),
        )
        state = None
        if before is not None:
            rows = slice(*before)
            _, state = processor.process({"front": drive.train[rows]}, base=with_place(drive.base[rows], PLACE))
        _, state = processor.process({"front": drive.train[6:7]}, state, base=moved)
        errors = base_errors(state)
        assert errors is not None
        found.append(errors)
    np.testing.assert_array_equal(found[0].satellite, found[1].satellite)
    np.testing.assert_allclose(found[0].code_m, found[1].code_m, atol=1e-6)


@pytest.mark.requirement("A12")
def test_integers_of_two_antennas_on_a_roof_are_right(recordings: Path) -> None:
    """Also where the first places are off by decimetres, as codes are; the map is stated as 0.05 m and right."""
    case = next(case for case in base_cases.cases(recordings) if case.name.startswith("roof"))
    processor = EpochProcessor(
        parse_config({
            "filter": "off", "carrier": "fixed", "elevation": {"mask_deg": 15.0}, "map_plan_sigma_m": 0.05,
            "map_height_sigma_m": 0.05,
        }),
        {"front": case.trajectory}, navigation=case.navigation, stations=Stations(base_ecef_m=case.base_ecef_m),
    )  # fmt: skip
    result, _ = processor.process({"front": case.train[:40]}, base=case.base[:40])
    phase = result.antennas["front"].phase
    fixed = phase.n_fixed > 0
    assert fixed.sum() >= 20
    error = along_track_error(phase.arc_m, case.reference[:40], case.trajectory)
    assert np.abs(error[fixed]).max() < 0.02


def base_errors(state: State) -> BaseErrors | None:
    return state.base.errors


def with_place(obs: Observations, place: np.ndarray) -> Observations:
    return replace(obs, header=replace(obs.header, approximate_ecef_m=place))


def test_integers_without_a_base_station_and_two_kinds_of_corrections_are_refused(line_trajectory: Trajectory) -> None:
    with pytest.raises(SettingsError, match="requires a base station"):
        EpochProcessor(parse_config({"carrier": "fixed"}), {"front": line_trajectory})
    with pytest.raises(SettingsError, match="use only one of the two"):
        EpochProcessor(
            parse_config({"sbas": "stream", "sbas_prn": 137}), {"front": line_trajectory},
            corrections=SbasState(prn=137), stations=Stations(base_ecef_m=PLACE),
        )  # fmt: skip


@pytest.mark.parametrize(
    ("base", "settings", "words"),
    [(True, {}, "a base station corrects a single frequency"), (False, {}, ""),
     (False, {"signals": {"G": ["5Q"]}}, "no satellite has a second code")],
)  # fmt: skip
def test_one_frequency_in_place_of_two_is_told(drive: Drive, base: bool, settings: dict[str, Any], words: str) -> None:
    config = parse_config({"filter": "off", "protection": "off", "frequencies": "two", "systems": ["G"], **settings})
    stations = Stations(base_ecef_m=PLACE if base else None)
    processor = EpochProcessor(config, {"front": drive.trajectory}, navigation=drive.navigation, stations=stations)
    result, _ = processor.process({"front": drive.train[:1]}, base=drive.base[:1] if base else None)
    told = [note for note in result.notes if note.startswith("frequencies: two requested, one used: ")]
    assert [note.split(": ")[-1] for note in told] == ([words] if words else [])


@pytest.fixture
def line_trajectory() -> Trajectory:
    from railfix.track import Track

    return Trajectory.from_antenna_path(Track.from_ecef(ecef_from_geodetic(35.0 + np.array([0.0, 0.01]), 139.0, 50.0)))

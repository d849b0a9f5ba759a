"""Arguments of functions in Python: wrong ones are one sentence, paths may be texts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli.ground import app
from railfix.simulate import Scenario

pytestmark = pytest.mark.requirement("G4")
FILES = railfix.demo_files()


def test_another_reader_is_named() -> None:
    with pytest.raises(ValueError, match="reader is 'pandas', 'railfix' or 'georinex' was expected"):
        railfix.read_observations(FILES["front"], reader="pandas")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="GPS time has none"):
        railfix.read_observations(FILES["front"], start="2024-03-05T03:11:00Z")


def test_a_log_or_a_trajectory_without_its_antenna_is_named() -> None:
    log = railfix.read_observations(FILES["front"])[:5]
    path = railfix.Trajectory.from_antenna_path(railfix.read_track(FILES["track"]))
    processor = railfix.EpochProcessor(railfix.Config(), {"front": path})
    for wrong in (log, {}):
        with pytest.raises(ValueError, match="one log for each antenna, at least one"):
            processor.process(wrong)  # type: ignore[arg-type]
    for several in (path, {}):
        with pytest.raises(ValueError, match="one for each antenna, at least one"):
            railfix.EpochProcessor(railfix.Config(), several)  # type: ignore[arg-type]


def test_a_track_off_the_earth_is_no_track() -> None:
    track = railfix.read_track(FILES["track"])
    with pytest.raises(ValueError, match="no place on Earth"):
        railfix.Track.from_geodetic(track.longitude_deg, track.latitude_deg, track.height_m)
    for places in (track.ecef_m / 1e3, np.zeros((5, 3))):
        with pytest.raises(ValueError, match="no place on Earth"):
            railfix.Track.from_ecef(places)


def test_keys_of_a_million_days_are_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["keys", str(tmp_path / "keys"), "--train", "1", "--days", "9999999"])
    assert "less than or equal to 36500" in " ".join(str(done.output).split())


def test_settings_show_what_differs_from_the_defaults() -> None:
    assert repr(Scenario()) == "Scenario()"  # with defaults that are computed from other settings
    assert repr(railfix.Config(min_satellites=2)) == "Config(min_satellites=2)"

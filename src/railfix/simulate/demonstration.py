"""Inputs and ground truth of the demonstration run."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from railfix.core.errors import InputFileError
from railfix.io import read_navigation, read_observations
from railfix.pipeline import Config, EpochProcessor, Result
from railfix.run import RunInputs
from railfix.track import antenna_trajectory, read_track, read_vehicle

#: Names of the files of the demonstration run by kind, as `railfix.simulate.write_run` names them.
DEMO_FILES: Final = {
    "front": "front.crx.gz",
    "rear": "rear.crx.gz",
    "nav": "nav.rnx.gz",
    "track": "track.csv",
    "vehicle": "vehicle.toml",
    "truth": "truth.csv.gz",
    "readme": "README.md",
}


def demo_folder() -> Path:
    """Return the folder of the demonstration run, in the installed package or in a clone of the repository.

    Raise InputFileError if neither has the folder, or a file is missing.
    """
    package = Path(__file__).resolve().parents[1]
    places = (package / "_demo", package.parents[1] / "data" / "demo")
    for place in places:
        if place.is_dir():
            missing = [name for name in DEMO_FILES.values() if not (place / name).is_file()]
            if missing:
                raise InputFileError(place / missing[0], "the demonstration run is incomplete; install railfix again")
            return place
    raise InputFileError(places[0], f"has no demonstration run, nor has {places[1]}; install railfix again")


def demo_files() -> dict[str, Path]:
    """Return the files of the demonstration run by kind (`DEMO_FILES`); raise InputFileError if they are missing."""
    folder = demo_folder()
    return {name: folder / file for name, file in DEMO_FILES.items()}


def demo_inputs() -> RunInputs:
    """Return the files of the demonstration run as inputs of a run; raise InputFileError if they are missing."""
    files = demo_files()
    return RunInputs(
        front=(files["front"],),
        rear=(files["rear"],),
        nav=(files["nav"],),
        track=(files["track"],),
        vehicle=files["vehicle"],
    )


def demo_truth() -> Path:
    """Return the path of the ground truth of the demonstration run; raise InputFileError if it is missing."""
    return demo_files()["truth"]


def demo() -> Result:
    """Compute the positions of the demonstration run for both antennas: by the filter along the track, and for single
    epochs.

    A notebook shows the result as a table; `railfix.train_table` and `railfix.positions_table` return its rows.
    """
    files = demo_files()
    track, vehicle = read_track(files["track"]), read_vehicle(files["vehicle"])
    trajectories = {name: antenna_trajectory(track, vehicle, name) for name in ("front", "rear")}
    processor = EpochProcessor(Config(), trajectories, navigation=read_navigation(files["nav"]))
    result, _ = processor.process({name: read_observations(files[name]) for name in trajectories})
    return result

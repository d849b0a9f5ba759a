"""Inputs and ground truth of the demonstration run."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from railfix.core.errors import InputFileError
from railfix.run import RunInputs

#: Files of the demonstration run by what they are, as `railfix.simulate.write_run` names them.
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
    """Return the folder of the demonstration run: in an installed package, or in the clone it runs from.

    InputFileError: when neither has it, or a file is missing.
    """
    package = Path(__file__).resolve().parents[1]
    places = (package / "_demo", package.parents[1] / "data" / "demo")
    for place in places:
        if place.is_dir():
            missing = [name for name in DEMO_FILES.values() if not (place / name).is_file()]
            if missing:
                raise InputFileError(place / missing[0], "the demonstration run is incomplete; install railfix again")
            return place
    raise InputFileError(places[0], f"the demonstration run is neither here nor in {places[1]}; install railfix again")


def demo_files() -> dict[str, Path]:
    """Files of the demonstration run: ``front``, ``rear``, ``nav``, ``track``, ``vehicle``, ``truth``, ``readme``."""
    folder = demo_folder()
    return {name: folder / file for name, file in DEMO_FILES.items()}


def demo_inputs() -> RunInputs:
    """Return the files of the demonstration run; InputFileError where neither the package nor the clone has them."""
    files = demo_files()
    return RunInputs(
        front=(files["front"],),
        rear=(files["rear"],),
        nav=(files["nav"],),
        track=(files["track"],),
        vehicle=files["vehicle"],
    )


def demo_truth() -> Path:
    """File of the reference trajectory of the demonstration run, for `railfix.evaluate`; InputFileError without."""
    return demo_files()["truth"]

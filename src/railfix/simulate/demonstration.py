"""Inputs and ground truth of the demonstration run."""

from __future__ import annotations

from pathlib import Path

from railfix.run import RunInputs
from railfix.simulate.demo_data import demo_files


def demo_inputs() -> RunInputs:
    """The files of the demonstration run; InputFileError where neither the package nor the clone has them."""
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

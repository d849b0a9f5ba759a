"""Inputs and ground truth of the demonstration run."""

from __future__ import annotations

from pathlib import Path

from railfix.run import RunInputs
from railfix.simulate.demo_data import demo_files


def demo_inputs() -> RunInputs:
    """The files of the demonstration run.

    Raises
    ------
    InputFileError
        They are not where the package or the clone has them.
    """
    files = demo_files()
    return RunInputs(
        front=(files["front"],),
        rear=(files["rear"],),
        nav=(files["nav"],),
        track=(files["track"],),
        vehicle=files["vehicle"],
    )


def demo_truth() -> Path:
    """File of the reference trajectory of the demonstration run, for `railfix.evaluate`.

    Raises
    ------
    InputFileError
        It is not where the package or the clone has it.
    """
    return demo_files()["truth"]

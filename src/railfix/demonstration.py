"""The demonstration: the run that comes with railfix, its results beside the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.evaluate import Score, score
from railfix.report import RunPicture, draw_run
from railfix.run import RunInputs
from railfix.simulate.demo_data import demo_files
from railfix.track_map import read_track

Floats = NDArray[np.float64]

_ECEF = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, kw_only=True)
class AntennaComparison:
    """One antenna against the truth, T epochs.

    Attributes
    ----------
    on_map, conventional : Score
        Errors along the line of the positions on the map, and of the 3-D ones moved to its nearest point.
    picture : RunPicture
        The same epoch by epoch.
    """

    on_map: Score
    conventional: Score
    picture: RunPicture


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All antennas against the truth.

    Attributes
    ----------
    line_ecef_m : ndarray, shape (V, 3) [m]
        The track.
    antennas : dict of str to AntennaComparison
    """

    line_ecef_m: Floats
    antennas: dict[str, AntennaComparison]


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


def compare(inputs: RunInputs, positions: Path) -> Comparison:
    """Errors along the line of the demonstration run.

    Parameters
    ----------
    inputs : RunInputs
        The files of the demonstration run.
    positions : Path
        ``positions.parquet`` of the run.

    Returns
    -------
    Comparison
    """
    truth = pl.read_csv(demo_files()["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
    rows = pl.read_parquet(positions).join(
        truth.select("time_gpst", "antenna", true_chainage_m="chainage_m"),
        on=["time_gpst", "antenna"],
        how="inner",
        maintain_order="left",
    )
    names = rows["antenna"].unique(maintain_order=True).to_list()
    return Comparison(
        line_ecef_m=read_track(inputs.track).ecef_m,
        antennas={name: _antenna(rows.filter(pl.col("antenna") == name)) for name in names},
    )


def _antenna(rows: pl.DataFrame) -> AntennaComparison:
    def column(name: str) -> Floats:
        return rows[name].cast(pl.Float64).fill_null(float("nan")).to_numpy()

    truth = column("true_chainage_m")
    error = column("chainage_m") - truth
    conventional = column("conventional_chainage_m") - truth
    observed = (rows["status"].cast(pl.String) != "no_observation").to_numpy()
    return AntennaComparison(
        on_map=score(error, observed),
        conventional=score(conventional, observed),
        picture=RunPicture(
            chainage_m=truth,
            ecef_m=np.stack([column(name) for name in _ECEF], axis=1),
            conventional_ecef_m=np.stack([column(f"conventional_{name}") for name in _ECEF], axis=1),
            error_m=error,
            conventional_error_m=conventional,
            along_sigma_m=column("along_sigma_m"),
            n_used=rows["n_used"].to_numpy().astype(np.int64),
        ),
    )


def draw(comparison: Comparison, path: Path) -> Path:
    """Draw the comparison into one picture file.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    pictures = {name: antenna.picture for name, antenna in comparison.antennas.items()}
    return draw_run(path, comparison.line_ecef_m, pictures, title="railfix demo: a made-up run against its truth")

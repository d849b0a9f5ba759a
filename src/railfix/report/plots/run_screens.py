"""Pictures of the screens of a run: each metric against its limit, from the files that the run wrote."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats, Indices, Masks
from railfix.core.errors import InputFileError, OutputError
from railfix.core.reasons import Reason
from railfix.pipeline.config import Config
from railfix.report.plots.screens import draw_screen
from railfix.run.folder import read_parquet, read_record
from railfix.screens import SCREENS, ScreenPicture

_NEEDED: Final = ("run.json", "positions.parquet", "observations.parquet")


@dataclass(frozen=True, kw_only=True)
class _Grid:
    """Observations of one antenna as arrays, T epochs by M channels, and its positions."""

    time: Datetimes
    chainage_m: Floats
    positions: pl.DataFrame
    rows: pl.DataFrame
    at: tuple[Indices, Indices]
    shape: tuple[int, int]

    def channels(self, column: str) -> Floats:
        """One column of the observations, NaN where not observed."""
        whole = np.full(self.shape, np.nan)
        whole[self.at] = _floats(self.rows, column)
        return whole

    def rejected(self, reason: Reason) -> Masks:
        """Observations that carry a reason."""
        whole = np.zeros(self.shape, dtype=bool)
        whole[self.at] = (self.rows["reason"].to_numpy() & int(reason)) != 0
        return whole

    def epochs(self, column: str) -> Floats:
        """One column of the positions, shape (T, 1)."""
        return _floats(self.positions, column)[:, None]


def draw_run_screens(run: Path, out: Path) -> list[Path]:
    """Draw every screen of a run that judged anything, a picture an antenna.

    Parameters
    ----------
    run : Path
        Folder that ``railfix run --observations`` wrote.
    out : Path
        Folder for the pictures; it is made.

    Returns
    -------
    list of Path
        ``front_doppler.png`` and the like.

    Raises
    ------
    InputFileError
        The folder is not that of a run, or the run wrote no observations.
    OutputError
        A picture cannot be written.
    """
    config, positions, observations = _read(run)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be made ({error.strerror})") from None
    return [
        draw_screen(out / f"{screen.antenna}_{screen.name}.png", screen.picture, screen.time, screen.chainage_m)
        for screen in screens_of(config, positions, observations)
    ]


@dataclass(frozen=True, kw_only=True)
class RunScreen:
    """One screen of a run over one antenna.

    Attributes
    ----------
    antenna, name : str
        ``front``, ``doppler``.
    picture : ScreenPicture
    time : ndarray of datetime64[ns], shape (T,)
    chainage_m : ndarray, shape (T,) [m]
        Of the positions; NaN where there is none.
    """

    antenna: str
    name: str
    picture: ScreenPicture
    time: Datetimes
    chainage_m: Floats


def screens_of(config: Config, positions: pl.DataFrame, observations: pl.DataFrame) -> Iterator[RunScreen]:
    """Every screen of a run that judged anything, antenna by antenna.

    Parameters
    ----------
    config : Config
        Settings that were in force.
    positions, observations : polars.DataFrame
        Tables of the run, columns of `railfix.pipeline.tables`.

    Yields
    ------
    RunScreen
    """
    for antenna in positions["antenna"].unique(maintain_order=True).to_list():
        grid = _grid(positions.filter(pl.col("antenna") == antenna), observations.filter(pl.col("antenna") == antenna))
        for name, picture in _pictures(antenna, grid, config):
            if np.isfinite(picture.metric).any():
                yield RunScreen(antenna=antenna, name=name, picture=picture, time=grid.time, chainage_m=grid.chainage_m)


def _read(run: Path) -> tuple[Config, pl.DataFrame, pl.DataFrame]:
    """Settings and tables of a run."""
    for name in _NEEDED:
        if not (run / name).is_file():
            hint = "; run again with --observations" if name == "observations.parquet" else ""
            raise InputFileError(run / name, f"there is no such file; expected the folder of a railfix run{hint}")
    config = read_record(run).config
    positions, observations = (read_parquet(run / name) for name in _NEEDED[1:])
    columns = [column for screen in SCREENS for column in screen.columns]
    lacking = {"raim_statistic", *(c.name for c in columns if c.table == "positions")} - set(positions.columns)
    lacking |= {c.name for c in columns if c.table == "observations"} - set(observations.columns)
    if lacking:
        raise InputFileError(run, f"the tables lack {', '.join(sorted(lacking))}; run again with this railfix")
    return config, positions, observations


def _grid(positions: pl.DataFrame, observations: pl.DataFrame) -> _Grid:
    time = positions["time_gpst"].to_numpy()
    names = (observations["satellite"] + " " + observations["signal"]).to_numpy().astype(np.str_)
    channels, column = np.unique(names, return_inverse=True)
    row = np.searchsorted(time, observations["time_gpst"].to_numpy())
    return _Grid(
        time=time,
        chainage_m=_floats(positions, "chainage_m"),
        positions=positions,
        rows=observations,
        at=(row.astype(np.intp), column.astype(np.intp)),
        shape=(len(time), len(channels)),
    )


def _pictures(antenna: str, grid: _Grid, config: Config) -> Iterator[tuple[str, ScreenPicture]]:
    """Pictures of the screens that were on, and of the protection level, with the name of the file."""
    for screen in SCREENS:
        if screen.name in config.screens:
            for name, picture in screen.pictures(grid, getattr(config, screen.name)):
                yield name, replace(picture, title=f"{antenna}: {picture.title}")
        if screen.name == "raim" and config.protection == "on":
            level = grid.epochs("protection_level_m")
            level = np.where(np.isfinite(level), level, np.nan)
            yield (
                "protection_level",
                ScreenPicture(
                    title=f"{antenna}: protection level along the line against the alarm limit (finite ones)",
                    label="protection level [m]",
                    metric=level,
                    reject=level > config.alarm_limit_m,
                    limit=config.alarm_limit_m,
                    sides="above",
                ),
            )


def _floats(table: pl.DataFrame, column: str) -> Floats:
    return np.array(table[column].cast(pl.Float64).fill_null(float("nan")).to_numpy())

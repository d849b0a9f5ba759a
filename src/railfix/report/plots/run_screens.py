"""Pictures of the screens of a run: each metric against its limit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.errors import InputFileError, OutputError
from railfix.core.reasons import Reason
from railfix.pipeline.config import Config
from railfix.report.plots.columns import floats
from railfix.report.plots.screens import draw_screen
from railfix.report.runs import read_runs
from railfix.screens import SCREENS, ScreenPicture


@dataclass(frozen=True, kw_only=True)
class _ScreenRows:
    """Positions and observations of one antenna; the observations of a column are read when it is drawn."""

    positions: pl.DataFrame
    observations: pl.LazyFrame
    epoch: NDArray[np.int32]

    def channels(self, column: str) -> Floats:
        """One column of the observations in the precision of charts, shape (N, 1)."""
        values = pl.col(column).cast(pl.Float32).fill_null(float("nan"))
        return self.observations.select(values).collect()[column].to_numpy()[:, None]

    def rejected(self, reason: Reason) -> Masks:
        """Observations with a reason, shape (N, 1)."""
        flags = self.observations.select((pl.col("reason") & int(reason)) != 0).collect()
        return flags["reason"].to_numpy()[:, None]

    def epochs(self, column: str) -> Floats:
        """One column of the positions, shape (T, 1)."""
        return floats(self.positions, column)[:, None]


def draw_run_screens(run: Path, out: Path) -> list[Path]:
    """Draw every screen of a run that tested anything, one picture per antenna: ``front_doppler.png`` and the like.

    Raises
    ------
    InputFileError
        The folder is not that of a run, or the run wrote no observations (``railfix run --observations``).
    OutputError
        A picture cannot be written.
    """
    (reported,), _ = read_runs([run])
    if reported.observations is None:
        raise InputFileError(
            run / "observations.parquet",
            "there is no such file; expected the folder of railfix run; run again with --observations",
        )
    missing = missing_columns(reported.folder.positions, reported.observations)
    if missing:
        raise InputFileError(run, f"the tables lack {', '.join(missing)}; run again with this version of railfix")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: the folder cannot be created ({error.strerror})") from None
    return [
        draw_screen(out / f"{screen.antenna}_{screen.name}.png", screen.picture, screen.time, screen.chainage_m)
        for screen in screens_of(reported.config, reported.folder.positions, reported.observations)
    ]


def missing_columns(positions: pl.DataFrame, observations: pl.LazyFrame) -> list[str]:
    """Columns of the screens that tables of an earlier version lack."""
    columns = [column for screen in SCREENS for column in screen.columns]
    missing = {"raim_statistic", *(c.name for c in columns if c.table == "positions")} - set(positions.columns)
    missing |= {c.name for c in columns if c.table == "observations"} - set(observations.collect_schema())
    return sorted(missing)


@dataclass(frozen=True, kw_only=True)
class RunScreen:
    """One screen of a run over one antenna.

    Attributes
    ----------
    antenna, name : str
        ``front``, ``doppler``.
    picture : ScreenPicture
        A row an epoch, or an observation.
    epoch : ndarray of int, shape (T,) or None
        Epoch of each row; None where the rows are the epochs.
    epoch_time : ndarray of datetime64[ns], shape (E,)
    epoch_chainage_m : ndarray, shape (E,) [m]
        Of the position; NaN without one.
    """

    antenna: str
    name: str
    picture: ScreenPicture
    epoch: NDArray[np.int32] | None
    epoch_time: Datetimes
    epoch_chainage_m: Floats

    @property
    def time(self) -> Datetimes:
        """Time of each row of the picture, shape (T,)."""
        return self.epoch_time if self.epoch is None else self.epoch_time[self.epoch]

    @property
    def chainage_m(self) -> Floats:
        """Chainage of each row of the picture, shape (T,) [m]."""
        return self.epoch_chainage_m if self.epoch is None else self.epoch_chainage_m[self.epoch]


def screens_of(config: Config, positions: pl.DataFrame, observations: pl.LazyFrame) -> Iterator[RunScreen]:
    """Every screen of a run that tested anything, antenna by antenna, with the settings that were used."""
    antennas = positions["antenna"].unique(maintain_order=True).to_list()
    for antenna in antennas:
        mine = positions.filter(pl.col("antenna") == antenna) if len(antennas) > 1 else positions
        seen = observations.filter(pl.col("antenna") == antenna)
        time, chainage = mine["time_gpst"].to_numpy(), floats(mine, "chainage_m")
        seen_at = seen.select("time_gpst").collect()["time_gpst"].to_numpy()
        epoch = np.searchsorted(time, seen_at).astype(np.int32)
        del seen_at
        rows = _ScreenRows(positions=mine, observations=seen, epoch=epoch)
        for name, picture in _pictures(antenna, rows, config):
            if np.isfinite(picture.metric).any():
                yield RunScreen(
                    antenna=antenna,
                    name=name,
                    picture=picture,
                    epoch=epoch if len(picture.metric) == len(epoch) else None,
                    epoch_time=time,
                    epoch_chainage_m=chainage,
                )


def _pictures(antenna: str, rows: _ScreenRows, config: Config) -> Iterator[tuple[str, ScreenPicture]]:
    """Pictures of the active screens and of the protection level, with the names of their files."""
    for screen in SCREENS:
        if screen.name in config.screens:
            for name, picture in screen.pictures(rows, getattr(config, screen.name)):
                yield name, replace(picture, title=f"{antenna}: {picture.title}")
        if screen.name == "raim" and config.protection == "on":
            level = rows.epochs("protection_level_m")
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

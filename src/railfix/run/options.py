"""Options of a run that do not change the positions."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from railfix.core.files import BrokenLines
from railfix.core.settings import Settings, option
from railfix.io.position_log import column_names
from railfix.run.output import Overwrite
from railfix.track.frames import MapMotion
from railfix.track.route import MapReading
from railfix.track.vehicle import Reference

#: Last whole year of times to the nanosecond in 64 bits.
LAST_YEAR: Final = 2261


class TrackReading(Settings):
    """How to read the track, and which point of the vehicle the chainage is that of."""

    crs: str | None = option("CRS of the track where its file does not name one.", None, metavar="EPSG")
    height_datum: str | None = option("Heights of the track: ellipsoidal or orthometric.", None, metavar="DATUM")
    geoid: str | None = option(
        "Geoid of orthometric heights: egm96 (the world), japan (JPGEO2024), gsigeo2011, or a grid or CRS of PROJ.",
        None,
        metavar="MODEL",
    )
    plan_sigma: float | None = option(
        "Standard deviation of the track in plan, in place of its own (OpenStreetMap: 2 m where the file states none).",
        None,
        metavar="M",
        gt=0,
        le=1000.0,
    )
    height_sigma: float | None = option(
        "Standard deviation of the track's heights, in place of its own; of a raster needed.",
        None,
        metavar="M",
        gt=0,
        le=1000.0,
    )
    map_epoch: float | None = option(
        "Epoch of the track's coordinates, where its frame is an ITRF or held at an epoch (JGD2011).",
        None,
        metavar="YEAR",
        gt=1980.0,
        lt=2100.0,
    )
    plate: str | None = option("Plate that moves such coordinates to the time of the log.", None, metavar="NAME")
    jgd_parameters: Path | None = option(
        "Semi-dynamic correction parameters (.par) that move a map in JGD2011 to their epoch; --map-epoch names it.",
        None,
        metavar="FILE",
    )
    reference: Reference = option("Point of the vehicle whose chainage is given.", "antenna")

    @property
    def of_map(self) -> MapReading:
        """What the readers of maps take."""
        return MapReading(crs=self.crs, height_datum=self.height_datum, geoid=self.geoid, sigma_plan_m=self.plan_sigma)

    @property
    def motion(self) -> MapMotion:
        """What moves the track to the frame of the satellites."""
        return {"epoch": self.map_epoch, "plate": self.plate, "parameters": self.jgd_parameters}

    cache: Literal["use", "skip"] = option(
        "Prepare the line anew: neither read nor write the cache folder.", "use", name="--no-cache"
    )


class ColumnNames(Settings):
    """Names of columns in CSV files of positions."""

    column: tuple[str, ...] = option(
        "Column of CSV positions under another name, such as time_utc=Timestamp; may be repeated. Names: time_gpst, "
        "time_utc, unix_s, or week and tow_s; latitude_deg, longitude_deg, height_m, or x_m, y_m, z_m; antenna, "
        "chainage_m, quality, ...",
        (),
        metavar="NAME=COLUMN",
    )

    @property
    def names(self) -> dict[str, str]:
        """Name in the file by that in railfix; SettingsError where a text is not NAME=COLUMN."""
        return column_names(self.column)


class LogReading(Settings):
    """How to read receiver logs."""

    date: datetime | None = option(
        "Some time within half a week of RTCM 3 logs, GPS time: their observations carry no week.", None, metavar="TIME"
    )

    @property
    def instant(self) -> np.datetime64 | None:
        """The date as the readers take it."""
        return None if self.date is None else np.datetime64(self.date.replace(tzinfo=None), "ns")


class RunOptions(Settings):
    """Options of a run that do not change the positions."""

    start: datetime | None = option("First epoch, GPS time.", None, metavar="TIME")
    end: datetime | None = option("Epochs before this time only, GPS time.", None, metavar="TIME")
    base_place: str | None = option(
        "Position of the base station, in the frame of the satellites; from its header without it.",
        None,
        metavar="LAT,LON,HEIGHT",
    )
    observations: Literal["skip", "write"] = option(
        "Also write observations.parquet: one row per epoch, satellite and signal, with its reason.",
        "skip",
        name="--observations",
    )
    broken_lines: BrokenLines = option(
        "Count broken lines of the input files and continue, instead of stopping.", "stop", name="--lenient"
    )
    overwrite: Overwrite = option("Replace results that are already there.", "refuse", name="--overwrite")
    chunk_epochs: int = option(
        "Epochs in memory at a time; the results do not depend on it.", 3000, name="--chunk", metavar="EPOCHS", ge=1
    )
    smooth: Literal["off", "on"] = option(
        "Also smooth the filter along the track: places by everything measured before and after, in columns of train.*",
        "off",
        name="--smooth",
    )
    check: Literal["off", "batch"] = option(
        "batch: fit codes and Dopplers of the whole log without the filter, write the places beside its own and say "
        "where the two differ.",
        "off",
    )
    track: TrackReading = Field(default_factory=TrackReading)
    logs: LogReading = Field(default_factory=LogReading)

    @property
    def of_filter(self) -> list[str]:
        """Options given that need the filter along the track."""
        return [*(["smooth"] if self.smooth == "on" else []), *(["check batch"] if self.check == "batch" else [])]

    @field_validator("start", "end")
    @classmethod
    def _within_gps_time(cls, value: datetime | None) -> datetime | None:
        if value is not None and not 1980 <= value.year <= LAST_YEAR:
            raise ValueError(f"a GPS time from 1980 to {LAST_YEAR} was expected")
        return value

    @model_validator(mode="after")
    def _start_before_end(self) -> Self:
        if self.start is not None and self.end is not None and self.start >= self.end:
            raise ValueError(f"--start {self.start} is not before --end {self.end}; give an earlier start")
        return self

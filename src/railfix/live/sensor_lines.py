"""Samples of a sensor on board from a stream of lines: the rows of its CSV table as they are measured.

The first line names the columns, as in the tables of ``railfix run``; it may come again after a break. A row of which
the time alone is given says that nothing was measured until then: a tachometer that stands still sends no pulse, and is
heard by such rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.motion.samples import (
    BaliseReadings,
    GroundUnits,
    InertialSamples,
    RadarSpeeds,
    SensorSamples,
    StationRanges,
    TachometerPulses,
)
from railfix.run.sensors import COLUMNS

#: After every epoch.
FOREVER: Final = np.datetime64("2200-01-01", "ns")
#: Columns without which a row says nothing but its time.
_NEEDED: Final = ("pulse", "range_m")
#: Columns of names.
_NAMES: Final = ("unit", "balise")
#: Longest line; a longer one is no row.
_LINE_BYTES: Final = 4096


@dataclass(frozen=True, kw_only=True)
class Sensed:
    """What some bytes of a sensor's stream completed."""

    sensor: str
    samples: SensorSamples = field(default_factory=SensorSamples)
    #: Time up to which the sensor has been heard; NaT before the first row, `FOREVER` of a whole table.
    until: np.datetime64
    skipped: int = 0  #: Lines that are no rows, or whose time is before that of the row before.

    def unsurveyed(self, units: GroundUnits | None) -> int:
        """Count the ranges to ground units that are not among these, which are not used."""
        return int(np.count_nonzero(~np.isin(self.samples.ranging.station, () if units is None else units.name)))


@dataclass(kw_only=True)
class SensorLines:
    """Rows of one sensor's stream."""

    #: Which of `railfix.motion.samples.SENSORS`, and its source for the messages.
    sensor: str
    source: str
    columns: tuple[str, ...] = ()  #: Names of the columns; empty before the header line.
    until: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Of the last row.
    rest: bytes = b""  #: Line that has no end yet.

    def after_break(self) -> None:
        """Begin a line anew where the connection broke."""
        self.rest = b""

    def take(self, data: bytes) -> Sensed:
        """Take some bytes, cut anywhere.

        InputFileError: the first line is not the header of this sensor's table.
        """
        *lines, self.rest = (self.rest + data).split(b"\n")
        self.rest = self.rest[-_LINE_BYTES:]
        rows, times, skipped = [], [], 0
        for line in lines:
            cells = [cell.strip() for cell in line.decode("utf-8", "replace").split(",")]
            if cells == [""] or cells[0].startswith("#"):
                continue
            if not self.columns:
                self.columns = self._header(cells)
                continue
            if cells == [*self.columns]:
                continue
            row = self._row(cells)
            if row is None or row[0] < self.until:
                skipped += 1
                continue
            self.until = row[0]
            if row[1]:
                times.append(row[0])
                rows.append(row[1])
        return Sensed(sensor=self.sensor, samples=self._samples(times, rows), until=self.until, skipped=skipped)

    def _header(self, cells: list[str]) -> tuple[str, ...]:
        needed = ("time_gpst", *(name for name in COLUMNS[self.sensor] if not name.startswith("[")))
        missing = [name for name in needed if name not in cells]
        if missing:
            raise InputFileError(
                self.source,
                f"the first line has no column {missing[0]}; expected a header with {', '.join(needed)} of the "
                f"{self.sensor}, then its rows",
            )
        return tuple(cells)

    def _row(self, cells: list[str]) -> tuple[np.datetime64, Mapping[str, float | str]] | None:
        """Time and values of a row, none of them where the time stands alone; None for what is no row."""
        if len(cells) != len(self.columns):
            return None
        given = dict(zip(self.columns, cells, strict=True))
        try:
            time = np.datetime64(given.pop("time_gpst"), "ns")
            texts = {name.strip("[]"): given.get(name.strip("[]"), "") for name in COLUMNS[self.sensor]}
            if not any(texts.values()):
                return None if np.isnat(time) else (time, {})
            unit: dict[str, float | str] = {name: texts.pop(name) for name in _NAMES if name in texts}
            values = {name: float(text) if text else np.nan for name, text in texts.items()}
        except ValueError:
            return None
        lacking = any(np.isnan(values.get(name, 0.0)) for name in _NEEDED) or "" in unit.values()
        if np.isnat(time) or np.isinf([*values.values()]).any() or lacking:
            return None
        return time, {**unit, **values}

    def _samples(self, times: list[np.datetime64], rows: list[Mapping[str, float | str]]) -> SensorSamples:
        if not rows:
            return SensorSamples()
        columns: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        time = np.array(times, dtype="datetime64[ns]")
        if self.sensor == "tachometer":
            whole = {name: np.nan_to_num(values).astype(np.int64) for name, values in columns.items()}
            return SensorSamples(tachometer=TachometerPulses(time=time, **whole))
        if self.sensor == "radar":
            return SensorSamples(radar=RadarSpeeds(time=time, **columns))
        if self.sensor == "balises":
            return SensorSamples(balises=BaliseReadings(time=time, **columns))
        if self.sensor == "ranging":
            return SensorSamples(ranging=StationRanges(time=time, station=columns.pop("unit"), **columns))
        six = np.stack([columns[name] for name in COLUMNS["inertial"]], axis=1)
        return SensorSamples(inertial=InertialSamples(time=time, force_mps2=six[:, :3], rate_radps=six[:, 3:]))

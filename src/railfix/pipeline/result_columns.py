"""Columns of the result tables: their names, units, meanings, decimals, and sources of their values.

Tables of positions, observations and the filter (polars, Parquet, CSV), arrays with named axes (xarray) and the
reference document are made from the same `Column` objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Generic, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Floats
from railfix.core.reasons import Status
from railfix.integrity.interference import Suspicion, cause_text
from railfix.integrity.point_validation import PointStatus
from railfix.integrity.protection import Cause, LevelStatus
from railfix.integrity.raim import Outcome
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.level_stage import BASES, KINDS
from railfix.pipeline.results import AntennaResult
from railfix.positioning.two_frequencies import Combined
from railfix.ranges.corrected import SecondCodes
from railfix.screens import SCREENS, ScreenColumn
from railfix.tracking import Kind

Source = TypeVar("Source")
#: Unit of a column, by the last part of the column's name.
UNITS: Final[Mapping[str, str]] = {
    "m": "m", "mm": "mm", "mps": "m/s", "mps2": "m/s^2", "deg": "deg", "dbhz": "dB-Hz", "permille": "permille",
    "1pm": "1/m", "s": "s", "db": "dB",
}  # fmt: skip
#: Decimals of numbers in CSV files (0.1 mm for lengths).
DECIMALS: Final = 4
DECIMALS_DEG: Final = 9


@dataclass(frozen=True)
class Column(Generic[Source]):
    """Column of the result tables."""

    name: str  #: Name, ending with the unit if there is one: ``along_sigma_m``.
    meaning: str
    #: How to get the values from the source of a table: an attribute path (``raim.statistic``; by default the column's
    #: name), a function of the source, or None if the source lacks the values. The values are an array with epochs on
    #: axis 0, or one value for all rows. If the column has `words`, the values are indices of words.
    values: str | Callable[[Source], NDArray[Any] | str | None] | None = ""
    dtype: pl.DataType = field(default=pl.Float64(), kw_only=True)
    words: tuple[str, ...] = field(default=(), kw_only=True)  #: Words to which integer values refer, by index.

    @property
    def unit(self) -> str:
        """Unit of the values; empty for words, counts and ratios."""
        return UNITS.get(self.name.rsplit("_", 1)[-1], "") if self.dtype == pl.Float64 and not self.words else ""

    @property
    def decimals(self) -> int:
        """Decimals of a number in CSV files."""
        return decimals(self.name)

    def of(self, source: Source) -> Any:
        """Return the values from the source of a table; None if the source lacks them."""
        if not isinstance(self.values, str):
            return None if self.values is None else self.values(source)
        found: Any = source
        for part in (self.values or self.name).split("."):
            found = None if found is None else getattr(found, part)
        return found

    def series(self, values: NDArray[Any] | str | None, rows: int) -> pl.Series:
        """Return values as a column of a table; NaN as null."""
        kind = pl.Enum(self.words) if self.words else self.dtype
        if values is None or isinstance(values, str):
            return pl.Series(values=[values], dtype=kind).new_from_index(0, rows)
        if self.words:
            return pl.Series(values=self.words, dtype=kind).gather(pl.Series(values=values.astype(np.uint32)))
        if self.dtype == pl.Float64:
            return float_column(values)
        return pl.Series(values=values.tolist() if values.dtype.kind == "U" else np.array(values), dtype=kind)

    def array(self, values: NDArray[Any] | str | None, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return values as an array of a given shape: words as text, absent numbers as NaN, absent words as blank."""
        if values is None or isinstance(values, str):
            absent = "" if self.words or self.dtype == pl.String else np.nan
            return np.full(shape, absent if values is None else values)
        return np.array(self.words)[values] if self.words else np.asarray(values)


def decimals(name: str) -> int:
    """Return the decimals of a column's numbers in CSV files."""
    return DECIMALS_DEG if UNITS.get(name.rsplit("_", 1)[-1]) == "deg" else DECIMALS


def by_name(columns: Iterable[Column[Source]]) -> dict[str, Column[Source]]:
    """Return columns by their name, in order."""
    return {column.name: column for column in columns}


def of_one_meaning(meaning: str, **values: str | Callable[[Any], NDArray[Any] | None]) -> Iterator[Column[Any]]:
    """Return float columns that have the same description but different values."""
    return (Column(name, meaning, source) for name, source in values.items())


def float_column(values: Floats) -> pl.Series:
    """Return a column of floats, NaN as null."""
    return pl.Series(values=np.ascontiguousarray(values, dtype=np.float64), nan_to_null=True)


def make_table(columns: Mapping[str, Column[Source]], source: Source, rows: int, **given: str) -> pl.DataFrame:
    """Return a table of columns with one row per epoch; `given` has the values of columns missing in the source."""
    return pl.DataFrame(
        {name: column.series(given.get(name, column.of(source)), rows) for name, column in columns.items()}
    )


def _get_screened(result: AntennaResult, column: ScreenColumn) -> Floats | None:
    """Return the values of a column that a screen fills; None if the screen is off."""
    return getattr(result.screens[column.verdict], column.field) if column.verdict in result.screens else None


def _get_screened_channels(observed: Observed, column: ScreenColumn) -> Floats:
    """Return the values of a column that an observation screen fills, on all channels."""
    return observed.on_all_channels(_get_screened(observed.result, column))


def _screen_columns(table: str, get: Callable[..., Floats | None]) -> Iterator[Column[Any]]:
    """Yield the columns that screens add to a table."""
    for column in (column for screen in SCREENS for column in screen.columns if column.table == table):
        yield Column(column.name, column.meaning, partial(get, column=column))


@dataclass(frozen=True)
class Observed:
    """Results of one antenna by channel, including filter results if the filter is on."""

    result: AntennaResult
    tracked: AlongTrack | None = None

    def on_all_channels(self, values: Floats | None) -> Floats:
        """Return `values` of the positioning channels as an array of all channels, shape (T, M), NaN elsewhere."""
        return self.result.on_all_channels(np.nan if values is None else values)

    def innovation(self, kind: Kind) -> Floats:
        """Return the filter's innovations of one measurement kind per channel, shape (T, M); NaN without the filter."""
        return self.on_all_channels(None if self.tracked is None else self.tracked.tracked.innovation[:, kind])


#: Columns of epoch, place on the line and position in space, in both the positions' and the filter's table.
EPOCH: Final[tuple[Column[Any], ...]] = (
    Column("time_gpst", "time tag of the receiver, GPS time", "time", dtype=pl.Datetime("ns")),
    Column("antenna", "`front` or `rear`", None, dtype=pl.String()),
)
ON_LINE: Final[tuple[Column[Any], ...]] = (
    Column("chainage_m", "distance along the line from the first point of the track"),
    Column("kilometrage_m", "kilometrage as marked on the line, if the track has it"),
)
IN_SPACE: Final[tuple[Column[Any], ...]] = (
    Column("latitude_deg", "latitude of the antenna, WGS 84"),
    Column("longitude_deg", "longitude of the antenna, WGS 84"),
    Column("height_m", "height of the antenna above the ellipsoid"),
    Column("x_m", "ECEF coordinate of the antenna", lambda r: r.ecef_m[:, 0]),
    Column("y_m", "ECEF coordinate of the antenna", lambda r: r.ecef_m[:, 1]),
    Column("z_m", "ECEF coordinate of the antenna", lambda r: r.ecef_m[:, 2]),
)
#: Columns of the table of positions.
POSITION_COLUMNS: Final[Mapping[str, Column[AntennaResult]]] = by_name(
    (
        *EPOCH,
        Column("status", "see `railfix.core.reasons.Status`", words=tuple(s.text for s in Status)),
        *ON_LINE,
        Column("along_sigma_m", "standard deviation along the line, larger if alternative positions are unresolved"),
        Column(
            "own_sigma_m",
            "single-epoch sigma, computed from the codes of the epoch alone; the status is `uncertain` above "
            "`largest_sigma_m`",
            "epoch_sigma_m",
        ),
        *IN_SPACE,
        Column("n_used", "satellites used", dtype=pl.Int16()),
        Column("n_rejected", "satellites that have a pseudorange but were not used", dtype=pl.Int16()),
        Column("noise_scale", "ratio of the receiver's noise to the noise assumed by the weights, as estimated so far"),
        Column(
            "raim_outcome",
            "result of RAIM: `passed`, `excluded_one`, `excluded_two`, `inseparable`, `unresolved`, `untestable`",
            "raim.outcome",
            words=tuple(o.name.lower() for o in Outcome),
        ),
        Column(
            "raim_statistic",
            "sum of squared residuals before any exclusion / noise variance (with the fixed limit: the sum in m^2)",
            "raim.statistic",
        ),
        Column("raim_scale", "noise scale that `raim_statistic` assumes, from consistent earlier ranges", "raim.scale"),
        Column("raim_threshold", "threshold of the statistic, above which a fault is detected", "raim.threshold"),
        Column(
            "raim_level_m",
            "protection level of P4: error caused by a fault that RAIM misses, plus noise; infinite if a satellite "
            "cannot be checked, empty if a fault remains",
            "raim.protection_level_m",
        ),
        Column(
            "integers_fixed",
            "with `carrier = fixed`: number of phase differences fixed to integers; 0 for a float or code solution",
            "phase.n_fixed",
            dtype=pl.Int16(),
        ),
        Column(
            "integer_risk_ppm",
            "probability that any fixed integer is wrong or, if none is fixed, that any best candidate is wrong [1e-6]",
            lambda r: None if r.phase is None else 1e6 * r.phase.integer_risk,
        ),
        Column(
            "protection_level_m",
            "bound that the error along the line exceeds at most with the stated risk; infinite for the reason in "
            "`protection_cause`, empty where a fault remains",
            "protection.level.level_m",
        ),
        Column(
            "protection_fault_free_m",
            "protection level for noise alone and the risk allocated to noise; may exceed `protection_level_m`",
            "protection.level.fault_free_m",
        ),
        *of_one_meaning(
            "protection level for one fault, or for two faults, as in the column's name; 0 if the probability of such "
            "faults is below the risk allocated to them",
            protection_one_fault_m="protection.level.one_fault_m",
            protection_two_faults_m="protection.level.two_fault_m",
        ),
        *of_one_meaning(
            "multiplier K of sigma in the protection level for no, one or two faults, as in the column's name",
            protection_k_fault_free="protection.level.k_fault_free",
            protection_k_one_fault="protection.level.k_one_fault",
            protection_k_two_faults="protection.level.k_two_faults",
        ),
        Column(
            "protection_separation",
            "largest ratio of the solution separation of a fault hypothesis to its threshold",
            "protection.level.separation",
        ),
        Column(
            "protection_kind",
            "fault hypotheses of the level: `sbas`, local faults only; `separation`, satellite faults as well",
            "protection.kind",
            words=KINDS,
        ),
        Column(
            "protection_basis",
            "fault priors: `measured` on the line, or `indicative` (assumed, so no hourly risk is claimed)",
            "protection.basis",
            words=BASES,
        ),
        Column(
            "protection_cause",
            "largest contribution to the level: `fault_free`, `one_fault`, `two_faults`, `three_faults` or more; or "
            "the reason for a missing level: `unchecked`, `unchecked_constellation`, `unchecked_side`, "
            "`unchecked_map`, "
            "`unchecked_together` (all `unchecked`: faults that cannot be detected), `budget`, `unbounded`, "
            "`no_position`",
            "protection.level.cause",
            words=tuple(c.name.lower() for c in Cause),
        ),
        Column(
            "protection_status",
            "`available`: level within the alarm limit; `unavailable`: larger level or doubtful position; `alarm`: a "
            "solution separation exceeds its threshold, or a check has failed",
            "protection.status",
            words=tuple(s.name.lower() for s in LevelStatus),
        ),
        Column(
            "araim_level_m",
            "ARAIM level along the line, from the integrity support message and with the map as a constraint",
            lambda r: None if r.araim is None else r.araim.along.level_m[:, 0],
        ),
        Column(
            "araim_horizontal_m",
            "horizontal ARAIM level of the 3-D position from the same ranges, without the map",
            "araim.horizontal_m",
        ),
        Column(
            "araim_vertical_m",
            "vertical ARAIM level of the 3-D position from the same ranges, without the map",
            lambda r: None if r.araim is None else r.araim.space.level_m[:, 2],
        ),
        *_screen_columns("positions", _get_screened),
        Column(
            "conventional_status",
            "3-D single point: `valid`, `no_position`, `residuals` (too large, chi-square test), "
            "`dilution` (over its limit)",
            words=tuple(s.name.lower() for s in PointStatus),
        ),
        Column("conventional_chainage_m", "chainage of the trajectory point nearest to the 3-D single point"),
        Column("conventional_offset_m", "distance of the 3-D single point from the nearest point of the trajectory"),
        Column(
            "map_offset_across_m",
            "mean offset to the right of the line, facing rising chainage, of the 3-D positions of the last minutes",
            "map_offset.across_m",
        ),
        Column("map_offset_up_m", "mean height above the line of the last minutes' 3-D positions", "map_offset.up_m"),
        *of_one_meaning(
            "smallest offset across (or up) that the test for the status `map_offset` detects with 99 % probability",
            map_detectable_across_m=lambda r: r.map_offset.detectable_m[:, 0],
            map_detectable_up_m=lambda r: r.map_offset.detectable_m[:, 1],
        ),
        Column(
            "map_offset_statistic",
            "squared normalised map offset; the status is `map_offset` at 13.8 or more",
            "map_offset.statistic",
        ),
        Column(
            "interference",
            "`none`, `jamming_suspected`, `spoofing_suspected`, or another cause of the signs of interference: "
            "`time_tags`, `left_map`, `contradicted`; the status may differ",
            "interference.suspicion",
            words=tuple(s.name.lower() for s in Suspicion),
        ),
        Column(
            "interference_causes",
            "signs of interference joined by `+`, see `railfix.integrity.interference.Sign`",
            lambda r: None if r.interference is None else cause_text(r.interference.causes),
            dtype=pl.String(),
        ),
        Column(
            "cn0_fall_db", "median drop of the satellites' C/N0 below its recent peak", "interference.power.fall_db"
        ),
        Column("conventional_x_m", "3-D single point, ECEF", lambda r: r.point.ecef_m[:, 0]),
        Column("conventional_y_m", "3-D single point, ECEF", lambda r: r.point.ecef_m[:, 1]),
        Column("conventional_z_m", "3-D single point, ECEF", lambda r: r.point.ecef_m[:, 2]),
    )
)


def _second(observed: Observed, values: Callable[[Combined, SecondCodes], Floats]) -> Floats | None:
    """Return values of the two-code combination on all channels; None with one frequency."""
    combined, second = observed.result.combined, observed.result.corrected.second
    return None if combined is None or second is None else observed.on_all_channels(values(combined, second))


#: Columns of the table of observations that have a value for each epoch and channel.
CHANNEL_COLUMNS: Final[Mapping[str, Column[Observed]]] = by_name(
    (
        Column("reason", "bits of `railfix.core.reasons.Reason`, 0 = used", "result.reason", dtype=pl.Int32()),
        Column(
            "residual_m",
            "corrected pseudorange minus geometric range and receiver clock at the position on the line",
            "result.residual_m",
        ),
        Column("elevation_deg", "elevation of the satellite", "result.elevation_deg"),
        Column("azimuth_deg", "azimuth of the satellite, from north over east", "result.azimuth_deg"),
        Column("cn0_dbhz", "carrier-to-noise density", "result.cn0_dbhz"),
        Column("sigma_m", "standard deviation of the pseudorange, from which its weight is computed", "result.sigma_m"),
        Column(
            "corrected_code_m",
            "pseudorange corrected for satellite clock, group delay and atmosphere",
            "result.corrected_code_m",
        ),
        *_screen_columns("observations", _get_screened_channels),
        Column(
            "second_share",
            "two frequencies: weight of the second code; negative if it reduces ionospheric errors; "
            "empty if the first code is used alone",
            lambda o: _second(o, lambda r, _: r.share),
        ),
        Column(
            "ionosphere_measured_m",
            "two frequencies: measured ionospheric delay on the first signal, minus the delay of the model",
            lambda o: _second(o, lambda r, _: r.ionosphere_m),
        ),
        Column(
            "metric_two_frequencies_m",
            "two frequencies: second code minus first code, minus the predicted difference; multipath and noise remain",
            lambda o: _second(o, lambda r, _: r.difference_m),
        ),
        Column(
            "second_cn0_dbhz",
            "two frequencies: carrier-to-noise density of the second signal",
            lambda o: _second(o, lambda _, s: s.cn0_dbhz),
        ),
        Column(
            "raim_own_error_m",
            "screen `raim`: error of a faulty satellite's range, estimated from all other ranges; empty if the "
            "robust fit rejected the range",
            lambda o: o.on_all_channels(o.result.raim.own_error_m),
        ),
        Column(
            "innovation_code_m",
            "filter along the track: code minus the code predicted from earlier epochs; only at epochs whose codes "
            "are used (one per second)",
            lambda o: o.innovation(Kind.CODE),
        ),
        *of_one_meaning(
            "filter along the track: measured minus predicted carrier-phase change, or Doppler, as in the name",
            innovation_phase_m=lambda o: o.innovation(Kind.PHASE),
            innovation_doppler_mps=lambda o: o.innovation(Kind.DOPPLER),
        ),
        Column(
            "weight_code",
            "weight of the code in the filter; 1 if the error of the code is one standard deviation",
            lambda o: o.on_all_channels(None if o.tracked is None else o.tracked.tracked.weight[:, Kind.CODE]),
        ),
    )
)
_REASON: Final = CHANNEL_COLUMNS["reason"]
#: Columns of the table of observations.
OBSERVATION_COLUMNS: Final[Mapping[str, Column[Any]]] = by_name(
    (
        *EPOCH,
        Column("satellite", "`G01`, `J02`", None, dtype=pl.String()),
        Column("signal", "RINEX 3 code without its type letter, `1C`", None, dtype=pl.String()),
        _REASON,
        Column("reason_text", "names of the bits of `reason` joined by `+`, `used` for 0", None, dtype=pl.String()),
        *(column for column in CHANNEL_COLUMNS.values() if column is not _REASON),
    )
)

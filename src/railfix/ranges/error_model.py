"""Error model of pseudoranges on a railway: bias, sigma and overbound by direction and C/N0 (P1 7).

A bin is an interval of elevation, of azimuth relative to the car body, and of C/N0. The TOML file has the bins, the
conditions, and the columns of `BinStatistics`. Each column is an array with one number per bin, ordered by elevation,
then sector, then C/N0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator

from railfix.core.arrays import Floats, Integers
from railfix.core.errors import InputFileError
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.core.settings_files import read_model_file, write_toml
from railfix.core.staged_files import FilePath
from railfix.ranges.error_conditions import Conditions

__all__ = [
    "LARGEST_PRIOR",
    "POOLED",
    "BinStatistics",
    "ErrorBins",
    "ErrorModel",
    "ErrorModelSource",
    "FaultRate",
    "read_error_model",
    "write_error_model",
]


#: Sets of samples from which the statistics of a bin can be computed: the bin's own samples, or wider sets.
POOLED: Final = ("own", "all azimuths", "all azimuths and C/N0", "all azimuths and elevations", "all")


class ErrorBins(Settings):
    """Edges of the bins of elevation, azimuth and C/N0."""

    #: E + 1 edges in ascending order; values beyond the outer edges belong to the outer bins.
    elevation_deg: tuple[Annotated[float, Field(ge=0.0, le=90.0)], ...] = option(
        "Edges of the elevation bins.", (0.0, 15.0, 30.0, 45.0, 60.0, 90.0), name="--elevations", metavar="DEG,..."
    )
    sectors: int = option("Number of azimuth sectors; the first is centred ahead of the car.", 4, metavar="N", ge=1)
    #: C + 1 edges in ascending order; values beyond the outer edges belong to the outer bins. Observations without C/N0
    #: belong to the lowest bin.
    cn0_dbhz: tuple[float, ...] = option(
        "Edges of the C/N0 bins; 0,60 makes a single bin.",
        (0.0, 30.0, 35.0, 40.0, 45.0, 60.0),
        name="--cn0",
        metavar="DBHZ,...",
    )

    @field_validator("elevation_deg", "cn0_dbhz")
    @classmethod
    def _rising(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) < 2 or not (np.diff(value) > 0).all():
            raise ValueError("at least two edges in ascending order are needed")
        return value

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of bins of elevation, sector and C/N0."""
        return len(self.elevation_deg) - 1, self.sectors, len(self.cn0_dbhz) - 1

    def index(self, elevation_deg: ArrayLike, relative_azimuth_deg: ArrayLike, cn0_dbhz: ArrayLike) -> Integers:
        """Return the flat index of the bin of each observation, any shape; -1 where elevation or azimuth is NaN.

        The azimuth is clockwise from the car's forward direction.
        """
        elevation, azimuth, cn0 = np.broadcast_arrays(
            np.asarray(elevation_deg, dtype=np.float64),
            np.asarray(relative_azimuth_deg, dtype=np.float64),
            np.asarray(cn0_dbhz, dtype=np.float64),
        )
        known = np.isfinite(elevation) & np.isfinite(azimuth)
        e = np.searchsorted(self.elevation_deg[1:-1], np.where(known, elevation, 0.0), side="right")
        width = 360.0 / self.sectors
        turned = np.mod(np.where(known, azimuth, 0.0) + width / 2.0, 360.0)
        a = np.minimum((turned // width).astype(np.int64), self.sectors - 1)
        c = np.searchsorted(self.cn0_dbhz[1:-1], np.where(np.isnan(cn0), -np.inf, cn0), side="right")
        flat = np.ravel_multi_index((e, a, c), self.shape)
        return np.where(known, flat, -1)


@dataclass(frozen=True, kw_only=True)
class BinStatistics:
    """Statistics of every bin, shape (E, A, C); biases and sigmas from fewer than three pooled samples are NaN."""

    count: Integers  #: Number of samples in the bin.
    #: Number of blocks in the bin. A block has the samples of one satellite in a time interval
    #: (`ErrorModelFit.block_s`); their errors are correlated.
    blocks: Integers
    bias_m: Floats  #: Mean error of the samples used for the bin.
    sigma_m: Floats  #: Standard deviation of the errors of these samples.
    bound_bias_m: Floats  #: Bias of the overbound of these errors (`error_model_fit.gaussian_overbound`).
    bound_sigma_m: Floats  #: Sigma of the overbound.
    pooled: Integers  #: Index in `POOLED` of the set of samples used for the bin.


class ErrorModelSource(Settings):
    """Runs to which a model was fitted."""

    runs: tuple[str, ...] = ()
    base: str = ""  #: Marker of the reference station.
    epochs: int = Field(default=0, ge=0)
    start: str = ""
    end: str = ""
    railfix_version: str = ""
    files: tuple[tuple[str, str], ...] = ()  #: Name and SHA-256 of each input file.


LARGEST_PRIOR: Final = 0.05  #: If the bound of a fault prior exceeds this, no protection level is finite.


class FaultRate(Settings):
    """Measured probability that a used range is faulty at a given time."""

    #: A range is faulty if the error exceeds this multiple of the sigma that the protection level assumes for the
    #: range. Normal noise exceeds five sigmas, the multiple in use, with a probability of 6e-7.
    beyond_sigma: float = Field(gt=0)
    ranges: int = Field(ge=0)  #: Number of ranges that passed every screen.
    faulty: int = Field(ge=0)  #: Number of these ranges that are faulty.
    #: Number of blocks. A block has the ranges of one satellite in a time interval; blocks count as independent.
    blocks: int = Field(ge=0)
    faulty_blocks: int = Field(ge=0)  #: Number of blocks with a faulty range.
    prior: float = Field(ge=0, le=1)  #: `faulty` divided by `ranges`.
    #: Upper end of the one-sided 95 % confidence interval of the prior (Clopper and Pearson), computed from the numbers
    #: of blocks. It is used as `RiskBudget.local_prior` if `bounds_priors` is true.
    upper: float = Field(ge=0, le=1)
    #: Number of time intervals in which two or more satellites are faulty, divided by the number expected for
    #: independent satellites; 0 without faults.
    together: float = Field(ge=0)
    #: Number of time intervals with at least two low satellites on one side of the track; each side counts separately.
    side_blocks: int = Field(default=0, ge=0)
    #: Number of these time intervals in which at least two of these low satellites were faulty.
    side_faulty_blocks: int = Field(default=0, ge=0)
    #: Upper end of the one-sided 95 % confidence interval of the probability that low satellites of one side are faulty
    #: together, computed from `side_blocks` and `side_faulty_blocks`; 1 if `side_blocks` is 0. It is used as
    #: `RiskBudget.side_prior` if `bounds_priors` is true.
    side_upper: float = Field(default=1.0, ge=0, le=1)
    #: Stretches with more frequent local faults than the line as a whole (`faulty_stretches`): first and last chainage
    #: of each stretch [m].
    no_level_m: tuple[tuple[float, float], ...] = ()

    @property
    def bounds_priors(self) -> bool:
        """Whether the bounds of both priors are at most `LARGEST_PRIOR`."""
        return max(self.upper, self.side_upper) <= LARGEST_PRIOR


@dataclass(frozen=True, kw_only=True)
class ErrorModel:
    """Errors of corrected pseudoranges by bin."""

    bins: ErrorBins
    before: BinStatistics  #: Errors before the screens; compared with `after`, they show the effect of the screens.
    after: BinStatistics  #: Errors after the screens, from which weights and protection level are computed.
    #: "local": only multipath and receiver noise, because a reference station removed satellite and atmospheric errors.
    #: "satellite_and_atmosphere": in addition, satellite and atmospheric errors of the recorded days.
    covers: Literal["local", "satellite_and_atmosphere"]
    #: Settings under which the model is valid; if None, the settings of a run are not checked against the model.
    conditions: Conditions | None = None
    source: ErrorModelSource = field(default_factory=ErrorModelSource)
    #: Rate of local faults among the ranges to which the model was fitted; None if not measured.
    faults: FaultRate | None = None

    def at(
        self, elevation_deg: ArrayLike, relative_azimuth_deg: ArrayLike, cn0_dbhz: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Return the overbounding sigma and bias of observations [m]; the arguments are broadcast as by NumPy.

        Sigma and bias are NaN where the direction is unknown or the model has no value.
        """
        index = self.bins.index(elevation_deg, relative_azimuth_deg, cn0_dbhz)
        inside, safe = index >= 0, np.maximum(index, 0)
        sigma = np.where(inside, self.after.bound_sigma_m.ravel()[safe], np.nan)
        return sigma, np.where(inside, self.after.bound_bias_m.ravel()[safe], np.nan)

    def missing_parts(self) -> tuple[str, ...]:
        """Return one sentence for each part that is missing because the file is of an earlier version."""
        if self.faults is None or "side_upper" in self.faults.model_fields_set:
            return ()
        return (
            "error model: faults.side_upper, bound of simultaneous faults of low satellites on one side, is missing; "
            "the file is of an earlier version, so fit the model again with railfix error-model",
        )


FORMAT: Final = "railfix error model 2"
_COLUMNS: Final = tuple(item.name for item in fields(BinStatistics))
_SIDES: Final = ("before", "after")  #: Before and after the screens.
_COUNTS: Final = ("count", "blocks", "pooled")
_Count = Annotated[int, Field(ge=0)]


class _Columns(Settings):
    """`BinStatistics` as columns, with one number per bin; NaN where a bin has no value."""

    count: tuple[_Count, ...]
    blocks: tuple[_Count, ...]
    bias_m: tuple[float, ...]
    sigma_m: tuple[float, ...]
    bound_bias_m: tuple[float, ...]
    bound_sigma_m: tuple[float, ...]
    pooled: tuple[Annotated[int, Field(ge=0, lt=len(POOLED))], ...]


class _ErrorModelFile(Settings):
    """Content of the file of an error model."""

    format: Literal["railfix error model 2"]
    covers: Literal["local", "satellite_and_atmosphere"]
    bins: ErrorBins
    conditions: Conditions | None = None
    source: ErrorModelSource = Field(default_factory=ErrorModelSource)
    faults: FaultRate | None = None
    before: _Columns
    after: _Columns


def write_error_model(model: ErrorModel, path: FilePath) -> None:
    """Write a model atomically; raise OutputError if the file cannot be written."""
    columns = {side: _columns(getattr(model, side)) for side in _SIDES}
    file = _ErrorModelFile(format=FORMAT, **{**vars(model), **columns})
    comment = "Errors of corrected pseudoranges by elevation, azimuth from the car's front, and C/N0."
    write_toml(path, file.model_dump(exclude_none=True), what="error model", comment=comment)


def _columns(statistics: BinStatistics) -> _Columns:
    """Return statistics as columns, rounded to the millimetre."""
    return _Columns(**{name: tuple(np.round(getattr(statistics, name).ravel(), 3).tolist()) for name in _COLUMNS})


def read_error_model(path: FilePath) -> ErrorModel:
    """Read an error model from its file.

    Raises InputFileError if the file is missing or unreadable, is no error model, or has version 1, or if an entry is
    missing or out of range.
    """
    file = read_model_file(
        _ErrorModelFile, path, what="an error model", format_name=FORMAT, command="railfix error-model"
    )
    values = {item.name: getattr(file, item.name) for item in fields(ErrorModel)}
    return ErrorModel(**values | {side: _statistics(path, side, values[side], file.bins) for side in _SIDES})


def _statistics(path: FilePath, name: str, columns: _Columns, bins: ErrorBins) -> BinStatistics:
    arrays = {}
    for column in _COLUMNS:
        values = np.array(getattr(columns, column), dtype=np.int64 if column in _COUNTS else np.float64)
        if len(values) != np.prod(bins.shape):
            raise InputFileError(
                path,
                f"entry {name}.{column}: {np.prod(bins.shape)} values were expected, one per bin, got {len(values)}",
            )
        if column not in ("bias_m", *_COUNTS) and (values < 0.0).any():
            raise InputFileError(path, f"entry {name}.{column}: must not be negative, got {np.nanmin(values)}")
        arrays[column] = values.reshape(bins.shape)
    return BinStatistics(**arrays)  # type: ignore[arg-type]

"""Types that the settings of the simulator share: ranges of numbers, times, and the word "none"."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, get_args

import numpy as np
from pydantic import AfterValidator, Field, PlainSerializer, PlainValidator, ValidationInfo, model_validator

from railfix.core.settings import Settings

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
#: A probability or a share of a total.
Share = Annotated[float, Field(ge=0.0, le=1.0)]
#: Three components, forward, right and down.
Three = tuple[Finite, Finite, Finite]
Seed = Annotated[int, Field(ge=0)]
#: Letters of the constellations that are simulated.
SYSTEMS = "GJEC"


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] <= pair[1]:
        raise ValueError("must be two numbers, the smaller one first")
    return pair


def beyond_start(to_m: float, info: ValidationInfo) -> float:
    """Validate the end of a part of the line, whose start is `from_m`."""
    if to_m <= info.data.get("from_m", -np.inf):
        raise ValueError(f"must lie beyond from_m of {info.data['from_m']}")
    return to_m


def at_least(least: float) -> AfterValidator:
    """Validator of a range of lengths that must begin at this length [m]."""

    def check(pair: tuple[float, float]) -> tuple[float, float]:
        if pair[0] < least:
            raise ValueError(f"must begin at {least:g} m or more")
        return pair

    return AfterValidator(check)


#: Least and greatest value of a uniform distribution.
Between = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_rising)]
AngleBetween = Annotated[tuple[Finite, Finite], AfterValidator(_rising)]


def _gps_time(value: Any) -> np.datetime64:
    """GPS time of a TOML time, a text or a datetime64."""
    try:
        if isinstance(value, datetime) and value.tzinfo is None:
            value = value.isoformat()
        if isinstance(value, (str, np.datetime64)):
            time = np.datetime64(str(value), "ns")
            if not np.isnat(time):
                return np.datetime64(time)
    except ValueError:
        pass
    raise ValueError("must be a time as 2024-03-05T03:10:00, GPS time without a zone")


def _toml_time(time: np.datetime64) -> datetime | str:
    """A TOML time where microseconds are enough, else text."""
    rounded = datetime.fromisoformat(str(time.astype("datetime64[us]")))
    return rounded if np.datetime64(rounded) == time else str(time)


#: GPS time to the nanosecond.
GpsTime = Annotated[np.datetime64, PlainValidator(_gps_time), PlainSerializer(_toml_time)]


class ScenarioSettings(Settings):
    """Base of the simulator's settings: the word "none" stands for None, which TOML does not have."""

    @model_validator(mode="before")
    @classmethod
    def _none(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        optional = {name for name, field in cls.model_fields.items() if type(None) in get_args(field.annotation)}
        return {key: None if key in optional and value == "none" else value for key, value in values.items()}


class Interval(ScenarioSettings):
    """Part of a run."""

    #: Seconds after the start of the run; an end of None is the end of the run.
    start_s: Finite
    end_s: Annotated[float, Field(allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _forward(self) -> Interval:
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s must be after start_s, got start_s = {self.start_s}, end_s = {self.end_s}")
        return self

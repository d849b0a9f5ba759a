"""ARAIM integrity support message: standard deviations, biases and fault probabilities of satellites."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from railfix.core.arrays import Datetimes, Masks
from railfix.core.errors import InputFileError
from railfix.core.settings import Settings, validate
from railfix.core.settings_files import read_toml
from railfix.core.staged_files import FilePath
from railfix.integrity.protection.araim import SupportArrays

FORMAT: Final = "railfix integrity support 1"

Letter = Annotated[str, Field(pattern=r"^[GJECR]$")]
Satellite = Annotated[str, Field(pattern=r"^[GJECR][0-9]{2}$")]


class StatedSupport(Settings):
    """Integrity support of a satellite."""

    #: Integrity standard deviation of the range error caused by orbit and clock.
    sigma_ura_m: float = Field(gt=0)
    #: Accuracy and continuity standard deviation of the range error caused by orbit and clock.
    sigma_ure_m: float = Field(gt=0)
    bias_m: float = Field(ge=0)  #: Largest nominal range bias (b_nom).
    prior: float = Field(ge=0, lt=1)  #: Probability that the satellite is faulty at a given time (P_sat).


class ConstellationSupport(StatedSupport):
    """Integrity support of a constellation's satellites."""

    #: Probability of a fault common to the constellation at a given time (P_const).
    constellation_prior: float = Field(ge=0, lt=1)


class IntegritySupport(Settings):
    """Integrity support message (EU-U.S. Working Group C, ARAIM milestone 3 report; ADD 3.0, table 2)."""

    format: Literal["railfix integrity support 1"]
    #: Start of the validity period (GPS time). Epochs outside the validity period have no ARAIM level.
    valid_from: datetime | None = None
    valid_until: datetime | None = None  #: End of the validity period (GPS time).
    #: Support of each constellation, by letter. Constellations without support are not used in ARAIM levels.
    constellation: dict[Letter, ConstellationSupport] = Field(min_length=1)
    #: Support of single satellites, which replaces the support of their constellation.
    satellite: dict[Satellite, StatedSupport] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _period(self) -> Self:
        ends = [end for end in (self.valid_from, self.valid_until) if end is not None]
        if any(end.tzinfo is not None for end in ends):
            raise ValueError("valid_from and valid_until are GPS time: write them without a time zone")
        if len(ends) == 2 and not ends[0] < ends[1]:
            raise ValueError(f"valid_from = {ends[0]} must be before valid_until = {ends[1]}")
        return self

    def holds(self, time: Datetimes) -> Masks:
        """Return True for epochs at which the message is valid, shape (T,)."""
        first, last = (
            np.datetime64("NaT" if end is None else end, "ns") for end in (self.valid_from, self.valid_until)
        )
        return ~((time < first) | (time > last))

    def notes(self, time: Datetimes) -> tuple[str, ...]:
        """Return a note if the message has no `valid_until` or is not valid at all epochs."""
        if self.valid_until is None:
            return ("integrity support message: without valid_until it is not known whether it has expired",)
        if self.holds(time).all():
            return ()
        first = "" if self.valid_from is None else f"from {self.valid_from} "
        return (
            f"the integrity support message is valid {first}until {self.valid_until} (GPS time). Epochs outside "
            "this period have no ARAIM level; provide a message that covers them",
        )

    def arrays(self, satellites: Sequence[str]) -> SupportArrays:
        """Return the support of each channel's satellite ("G07"); NaN for satellites without support."""
        of_each = [self.satellite.get(name) or self.constellation.get(name[0]) for name in satellites]
        ura, ure, bias, prior = (
            np.array([np.nan if each is None else getattr(each, name) for each in of_each], dtype=np.float64)
            for name in ("sigma_ura_m", "sigma_ure_m", "bias_m", "prior")
        )
        return SupportArrays(ura, ure, bias, prior, {k: c.constellation_prior for k, c in self.constellation.items()})


def read_integrity_support(path: FilePath) -> IntegritySupport:
    """Read an integrity support message from a TOML file; raise InputFileError if the file has other content."""
    values = read_toml(path, what="an integrity support message")
    if values.get("format") != FORMAT:
        raise InputFileError(path, f"is not an integrity support message: format = '{FORMAT}' was expected")
    return validate(IntegritySupport, values, source=str(path))

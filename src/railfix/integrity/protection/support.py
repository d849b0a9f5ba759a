"""Integrity support message: what the operator of a constellation, or an authority, states on its satellites."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath
from railfix.core.settings import Settings, read_toml, validated

FORMAT: Final = "railfix integrity support 1"

Letter = Annotated[str, Field(pattern=r"^[GJECR]$")]
Satellite = Annotated[str, Field(pattern=r"^[GJECR][0-9]{2}$")]


class SatelliteSupport(Settings):
    """Statement on a satellite.

    Attributes
    ----------
    sigma_ura_m, sigma_ure_m : float [m]
        Standard deviation of the error of orbit and clock in the range: for integrity, and for accuracy and continuity.
    bias_m : float [m]
        Largest nominal bias of the range (b_nom).
    prior : float
        Probability that the satellite is faulty at a time (P_sat).
    """

    sigma_ura_m: float = Field(gt=0)
    sigma_ure_m: float = Field(gt=0)
    bias_m: float = Field(ge=0)
    prior: float = Field(ge=0, lt=1)


class ConstellationSupport(SatelliteSupport):
    """Statement on the satellites of a constellation.

    Attributes
    ----------
    constellation_prior : float
        Probability that a fault common to the constellation is there at a time (P_const).
    """

    constellation_prior: float = Field(ge=0, lt=1)


class SupportArrays(NamedTuple):
    """Statements by channel, shape (M,); `constellation_prior` by letter."""

    sigma_ura_m: Floats
    sigma_ure_m: Floats
    bias_m: Floats
    prior: Floats
    constellation_prior: dict[str, float]


class IntegritySupport(Settings):
    """Integrity support message (EU-U.S. Working Group C, ARAIM milestone 3 report; ADD 3.0, table 2).

    Attributes
    ----------
    format : str
    constellation : mapping of str to ConstellationSupport
        By letter; one without a statement is not used in the levels.
    satellite : mapping of str to SatelliteSupport
        Satellites with statements of their own.
    """

    format: Literal["railfix integrity support 1"]
    constellation: dict[Letter, ConstellationSupport] = Field(min_length=1)
    satellite: dict[Satellite, SatelliteSupport] = Field(default_factory=dict)

    def arrays(self, satellites: Sequence[str]) -> SupportArrays:
        """Return the statements on satellites; NaN for constellations without one."""
        of_each = [self.satellite.get(name) or self.constellation.get(name[0]) for name in satellites]
        ura, ure, bias, prior = (
            np.array([np.nan if each is None else getattr(each, name) for each in of_each], dtype=np.float64)
            for name in ("sigma_ura_m", "sigma_ure_m", "bias_m", "prior")
        )
        return SupportArrays(ura, ure, bias, prior, {k: c.constellation_prior for k, c in self.constellation.items()})


def read_integrity_support(path: FilePath) -> IntegritySupport:
    """Read an integrity support message from TOML.

    Raises
    ------
    InputFileError
        The file is missing, of another format, or an entry is unknown, missing or out of range.
    """
    values = read_toml(path, what="an integrity support message")
    if values.get("format") != FORMAT:
        raise InputFileError(path, f"is not an integrity support message: format = '{FORMAT}' was expected")
    return validated(IntegritySupport, values, source=str(path))

"""Comparison of C/N0 with the open-sky mean at the same elevation, and with an absolute floor (P1 2.3(1)).

P1 measures the mean C/N0 as a function of elevation for each antenna and receiver under open sky
(`railfix.ranges.cn0_curve`), and rejects observations that are more than 10 dB below this mean, or below 30 dB-Hz.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.arrays import Strings
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.ranges.corrected import AntennaRanges
from railfix.screens.base import (
    ObservationPicture,
    ObservationScreen,
    OpenSkyCn0,
    ScreenColumn,
    Screened,
    ScreenSetup,
    Verdict,
)


class Cn0Limits(Settings):
    """Limits of the C/N0 screen."""

    #: Largest accepted deficit of C/N0 below the open-sky mean at the same elevation; 10 in P1 table 6. None: no test.
    deficit_dbhz: float | None = Field(default=10.0, gt=0.0, allow_inf_nan=False)
    #: Minimum C/N0; with None, the default, there is no floor. P1 table 6 uses 30 for its receivers. Receivers measure
    #: C/N0 differently: 30 rejects over half of an M8T's signals in a city, where 20 to 25 is suitable.
    floor_dbhz: float | None = Field(default=None, gt=0.0, lt=100.0)


@dataclass(frozen=True, kw_only=True)
class Cn0Screened(Screened):
    """Verdict of the C/N0 screen; the metric is C/N0, and the limit is the higher of the two limits [dB-Hz]."""

    floor: Screened  #: Verdict of the comparison with the floor; the metric is C/N0 [dB-Hz].
    #: Comparison with the curve; the metric is the mean minus the measured C/N0 [dB], NaN for an unknown mean.
    curve: Screened


def cn0_screen(
    cn0_dbhz: ArrayLike,
    elevation_deg: ArrayLike,
    *,
    satellite: Strings,
    signal: Strings,
    limits: Cn0Limits | None = None,
    curve: OpenSkyCn0 | None = None,
) -> Cn0Screened:
    """Reject observations whose C/N0 is too far below the open-sky mean, or below the floor (P1 2.3(1), table 6).

    Parameters
    ----------
    cn0_dbhz : array_like, shape (T, M) [dB-Hz]
        An observation without C/N0 (NaN) is not rejected.
    elevation_deg : array_like, shape (T, M) [deg]
    satellite, signal : ndarray of str, shape (M,)
    curve : Cn0Curve or another OpenSkyCn0, optional
        Mean C/N0 as a function of elevation; without it only the floor is applied.

    Returns
    -------
    Cn0Screened
        Verdicts, shape (T, M). An observation exactly at a limit is not rejected.
    """
    limits = limits or Cn0Limits()
    cn0 = np.asarray(cn0_dbhz, dtype=np.float64)
    elevation = np.asarray(elevation_deg, dtype=np.float64)
    deficit = np.full(cn0.shape, np.nan)
    if curve is not None and limits.deficit_dbhz is not None:
        deficit = curve.mean_dbhz(elevation, satellite=satellite, signal=signal) - cn0
    nothing, lowest = np.zeros(cn0.shape, dtype=bool), np.full(cn0.shape, np.nan)
    floor, curved = (np.nan if limit is None else limit for limit in (limits.floor_dbhz, limits.deficit_dbhz))
    weak, deep = (nothing if limits.floor_dbhz is None else cn0 < floor), nothing
    if limits.deficit_dbhz is not None:
        deep, lowest = deficit > curved, cn0 + deficit - curved
    return Cn0Screened(
        metric=cn0,
        reject=weak | deep,
        limit=np.fmax(lowest, floor),
        floor=Screened(metric=cn0, reject=weak, limit=floor),
        curve=Screened(metric=deficit, reject=deep, limit=curved),
    )


class Cn0Screen(ObservationScreen[Cn0Limits]):
    """Screen of C/N0, with an absolute floor and a curve of the open-sky mean over elevation."""

    name = "cn0"
    limits = Cn0Limits()
    needs = "a curve over elevation (cn0_curve) or a floor"
    columns = (
        ScreenColumn(
            name="metric_cn0_deficit_dbhz",
            meaning="screen `cn0`: mean C/N0 at the satellite's elevation minus measured C/N0",
            verdict="cn0_curve",
        ),
    )
    observation_pictures = (
        ObservationPicture(
            "cn0_floor", "signal strength, floor", "C/N0 [dB-Hz]", "cn0_dbhz", Reason.CN0_FLOOR, "floor_dbhz", "below"
        ),
        ObservationPicture(
            "cn0_curve", "C/N0 relative to open sky", "mean at the elevation minus measured C/N0 [dB]",
            "metric_cn0_deficit_dbhz", Reason.CN0_CURVE, "deficit_dbhz", "above",
        ),
    )  # fmt: skip

    def unable(self, limits: Cn0Limits, setup: ScreenSetup) -> bool:
        """Return whether both the curve and the floor are missing."""
        return setup.cn0_curve is None and limits.floor_dbhz is None

    def notes(self, limits: Cn0Limits, setup: ScreenSetup) -> tuple[str, ...]:
        """Return a note if the curve is missing; the note states whether the floor is applied."""
        if setup.cn0_curve is not None or limits.floor_dbhz is None:
            return super().notes(limits, setup)
        return (f"screen cn0 has no curve (cn0_curve), so only the floor of {limits.floor_dbhz:g} dB-Hz is used",)

    def judge(
        self, antenna: AntennaRanges, limits: Cn0Limits, setup: ScreenSetup, state: Any
    ) -> tuple[tuple[Verdict, ...], Any]:
        """Return the verdicts of floor and curve on a chunk; the state is unchanged, as no earlier epochs are used."""
        result = cn0_screen(
            antenna.cn0_dbhz,
            antenna.elevation_deg,
            satellite=antenna.satellite,
            signal=antenna.signal,
            limits=limits,
            curve=setup.cn0_curve,
        )
        return (
            Verdict(name="cn0_floor", reason=Reason.CN0_FLOOR, screened=result.floor),
            Verdict(name="cn0_curve", reason=Reason.CN0_CURVE, screened=result.curve),
        ), state


SCREEN = Cn0Screen()

"""Conventional positioning: the 3-D single point, without the map.

The reference method of P1 section 5. Weighted least squares in x, y, z and one receiver clock a
constellation; the nearest point of the trajectory is taken afterwards by the pipeline.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Floats, Indices
from railfix.core.settings import Settings
from railfix.positioning.normal_equations import Ranges


class SinglePointLimits(Settings):
    """Limits of the iteration, and of the validation of its position (`conventional_status`)."""

    tolerance_m: float = Field(default=1.0, gt=0)  #: The last step: one of 1 m leaves 0.01 mm (`after_step`).
    max_iterations: int = Field(default=12, ge=1)  #: Steps at most.
    #: Probability that noise alone fails the chi-square test of the residuals.
    false_alarm: float = Field(default=1e-3, gt=0, lt=0.5)
    #: Largest position dilution of precision; 30, as RTKLIB has for the geometric one.
    dilution_limit: float = Field(default=30.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class SinglePoint:
    """3-D positions, T epochs."""

    #: NaN where there is none: fewer than three satellites beyond one a clock, singular geometry, or no convergence;
    #: shape (T, 3).
    ecef_m: Floats
    clock_m: Floats  #: Shape (T, G).
    matrix: Floats  #: Normal matrix at the position, shape (T, 3, 3) [1/m^2].
    covariance_m2: Floats  #: Of the position, from the weights; shape (T, 3, 3).
    wsse: Floats  #: Shape (T,).
    residual_m: Floats  #: Shape (T, M).

    def take(self, epochs: Indices) -> SinglePoint:
        """The positions of some epochs, by index."""
        return SinglePoint(**{item.name: getattr(self, item.name)[epochs] for item in fields(self)})


def single_point(ranges: Ranges, start_ecef_m: Floats, *, limits: SinglePointLimits | None = None) -> SinglePoint:
    """Single-point positions of all epochs at once.

    Parameters
    ----------
    ranges : Ranges
        T epochs.
    start_ecef_m : ndarray, shape (T, 3) [m]
        Where the iteration starts; anywhere within a few thousand kilometres.
    limits : SinglePointLimits, optional
    """
    limits = limits or SinglePointLimits()
    place, clock, matrix, covariance, wsse, residual = kernels.ranges.iterated_points(
        ranges.arrays,
        np.ascontiguousarray(start_ecef_m, dtype=np.float64),
        np.asarray(ranges.n_used - ranges.n_clocks >= 3),
        limits.tolerance_m,
        limits.max_iterations,
    )
    return SinglePoint(
        ecef_m=place, clock_m=clock, matrix=matrix, covariance_m2=covariance, wsse=wsse, residual_m=residual
    )

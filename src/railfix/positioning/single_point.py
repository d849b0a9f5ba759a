"""Conventional positioning: the 3-D single point, without the map.

The reference method of P1 section 5. Weighted least squares in x, y, z and one receiver clock a
constellation; the nearest point of the trajectory is taken afterwards by the pipeline.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Indices
from railfix.core.settings import Settings
from railfix.positioning.normal_equations import Ranges, inverse_3x3, normal_equations


class SinglePointLimits(Settings):
    """Convergence limits of the iteration.

    Attributes
    ----------
    tolerance_m : float
        The last step: one of 1 m leaves 0.01 mm (`NormalEquations.after`).
    max_iterations : int
    """

    tolerance_m: float = Field(default=1.0, gt=0)
    max_iterations: int = Field(default=12, ge=1)


@dataclass(frozen=True, kw_only=True)
class SinglePoint:
    """3-D positions, T epochs.

    Attributes
    ----------
    ecef_m : ndarray, shape (T, 3) [m]
        NaN where there is none: fewer than three satellites beyond one a clock, singular
        geometry, or no convergence.
    clock_m : ndarray, shape (T, G) [m]
    matrix : ndarray, shape (T, 3, 3) [1/m^2]
        Normal matrix at the position.
    covariance_m2 : ndarray, shape (T, 3, 3) [m^2]
        Of the position, from the weights.
    wsse : ndarray, shape (T,)
    residual_m : ndarray, shape (T, M) [m]
    """

    ecef_m: Floats
    clock_m: Floats
    matrix: Floats
    covariance_m2: Floats
    wsse: Floats
    residual_m: Floats

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

    Returns
    -------
    SinglePoint
    """
    limits = limits or SinglePointLimits()
    epochs, channels = ranges.code_m.shape
    place = np.full((epochs, 3), np.nan)
    clock = np.full((epochs, len(ranges.groups)), np.nan)
    matrix, covariance = np.full((2, epochs, 3, 3), np.nan)
    wsse = np.full(epochs, np.nan)
    residual = np.full((epochs, channels), np.nan)
    active = np.flatnonzero(ranges.n_used - ranges.n_clocks >= 3)
    current = start_ecef_m[active]
    for _ in range(limits.max_iterations):
        if not len(active):
            break
        part = ranges if len(active) == epochs else ranges.take(active)
        equations = normal_equations(part, current)
        inverse = inverse_3x3(equations.matrix)
        step = np.einsum("tij,tj->ti", inverse, equations.vector)
        length = np.sqrt(np.einsum("ti,ti->t", step, step))
        settled = length < limits.tolerance_m
        done = active[settled]
        place[done] = current[settled] + step[settled]
        clock[done], residual[done] = equations.after(step[settled], settled)
        matrix[done] = equations.matrix[settled]
        covariance[done] = inverse[settled]
        wsse[done] = equations.wsse[settled] - np.einsum("ti,ti->t", step, equations.vector)[settled]
        going = ~settled & (length < 1e8)
        current = (current + step)[going]
        active = active[going]
    return SinglePoint(
        ecef_m=place,
        clock_m=clock,
        matrix=matrix,
        covariance_m2=covariance,
        wsse=wsse,
        residual_m=residual,
    )

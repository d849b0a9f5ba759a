"""Conventional positioning: the 3-D single point, without the map.

The reference method of P1 section 5. Weighted least squares in x, y, z and one receiver clock a
constellation; the nearest point of the trajectory is taken afterwards by the pipeline.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.settings import Settings
from railfix.kernels import compiled_by
from railfix.positioning.normal_equations import RangeArrays, Ranges, after_step, inverse_3x3, reduced_equations


class SinglePointLimits(Settings):
    """Convergence limits of the iteration.

    Attributes
    ----------
    tolerance_m : float
        The last step: one of 1 m leaves 0.01 mm (`after_step`).
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
    place, clock, matrix, covariance, wsse, residual = iterated_points(
        ranges.arrays,
        np.ascontiguousarray(start_ecef_m, dtype=np.float64),
        np.asarray(ranges.n_used - ranges.n_clocks >= 3),
        limits.tolerance_m,
        limits.max_iterations,
    )
    return SinglePoint(
        ecef_m=place, clock_m=clock, matrix=matrix, covariance_m2=covariance, wsse=wsse, residual_m=residual
    )


@compiled_by("ranges")
def iterated_points(
    ranges: RangeArrays, start_ecef_m: Floats, enough: Masks, tolerance_m: float, most: int
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Iterate 3-D positions.

    Parameters
    ----------
    ranges : RangeArrays
    start_ecef_m : ndarray, shape (T, 3) [m]
    enough : ndarray of bool, shape (T,)
        Epochs with satellites for a position; the others are NaN.
    tolerance_m, most
        Last step, and number of steps.

    Returns
    -------
    ecef_m, clock_m, matrix, covariance_m2, wsse, residual_m
        Of `SinglePoint`.
    """
    epochs, channels = ranges.code_m.shape
    groups = len(ranges.starts)
    place, clock = np.full((epochs, 3), np.nan), np.full((epochs, groups), np.nan)
    matrix, covariance = np.full((2, epochs, 3, 3), np.nan)
    wsse, residual = np.full(epochs, np.nan), np.full((epochs, channels), np.nan)
    active = np.flatnonzero(enough)
    current = start_ecef_m[active]
    for _ in range(most):
        if not len(active):
            break
        some = slice(None) if len(active) == epochs else active
        system, means, rows, seen = reduced_equations(ranges.take(some), current)
        vector, inverse = system[:, :3, 3], inverse_3x3(system[:, :3, :3])
        step = np.einsum("tij,tj->ti", inverse, vector)
        length = np.sqrt(np.einsum("ti,ti->t", step, step))
        settled = length < tolerance_m
        done = active[settled]
        place[done] = current[settled] + step[settled]
        clock[done], residual[done] = after_step(means[settled], rows[settled], seen[settled], step[settled])
        matrix[done], covariance[done] = system[settled, :3, :3], inverse[settled]
        wsse[done] = system[settled, 3, 3] - np.einsum("ti,ti->t", step, vector)[settled]
        going = ~settled & (length < 1e8)
        current, active = (current + step)[going], active[going]
    return place, clock, matrix, covariance, wsse, residual

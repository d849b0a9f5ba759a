"""Linear model of the ranges for RAIM, on the line and in space.

P4 tests the residuals of ``y = H x + v``. Here, every range is divided by its sigma. The receiver clocks and the
lateral and vertical map errors are eliminated; the map errors have a prior. The residual projector is ``S = I - R K R^T
- B Q B^T``. R has 1/sigma in the column of the satellite's clock, K is the clock covariance at a known position, B is
the design without the clocks, and Q is the position covariance. The residuals are ``nu = S y``, and ``WSSE = y^T S y``
is chi-square distributed with `LinearModel.freedom` degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Integers, Masks, RowArrays, kernel_array
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.normal_equations import Constrained
from railfix.positioning.range_arrays import Ranges


class ModelArrays(NamedTuple):
    """Arrays of `LinearModel` in C order, for compiled functions."""

    root_weight: Floats
    clock: Indices
    clock_covariance_m2: Floats
    design: Floats
    covariance_m2: Floats
    prior: Floats
    misfit: Floats


#: Fields of `LinearModel` whose first axis is the epochs.
_BY_EPOCH: Final = ("root_weight", "clock_covariance_m2", "design", "covariance_m2", "misfit", "freedom")


@dataclass(frozen=True, kw_only=True)
class LinearModel:
    """Whitened ranges of M channels at T epochs, linearised at one position per epoch.

    The three position unknowns are along, across and up on the line, or east, north and up in space. The first
    `interest` unknowns are the components of interest.
    """

    root_weight: Floats  #: 1/sigma of each range, shape (T, M) [1/m]; 0 for unused ranges.
    clock: Indices  #: Index of each channel's receiver clock, shape (M,).
    clock_covariance_m2: Floats  #: Clock covariance K at a known position, shape (T, G, G).
    #: Design B: derivatives of the whitened ranges with respect to the position, with the clocks eliminated, shape (T,
    #: M, 3) [1/m]; 0 for unused ranges.
    design: Floats
    #: Position covariance Q, computed with the prior, shape (T, 3, 3); NaN where the position is undetermined.
    covariance_m2: Floats
    prior: Floats  #: Prior information P on the position, from the map sigmas, shape (3, 3) [1/m^2].
    #: Whitened code minus distance (y), including the receiver clock, shape (T, M); 0 for unused ranges.
    misfit: Floats
    freedom: Integers  #: Degrees of freedom: ranges minus unknowns, shape (T,); may be negative.
    interest: int  #: Number of components of interest: 1 on the line, 2 in space (horizontal).

    def __len__(self) -> int:
        return len(self.root_weight)

    def take(self, epochs: Masks | Indices) -> LinearModel:
        """Return the model of selected epochs."""
        return replace(self, **{name: getattr(self, name)[epochs] for name in _BY_EPOCH})

    def patch(self, epochs: Indices, part: LinearModel) -> LinearModel:
        """Return the model after replacing `epochs` by the epochs of `part`."""
        if len(epochs) == len(self):
            return part
        changed = {}
        for name in _BY_EPOCH:
            changed[name] = getattr(self, name).copy()
            changed[name][epochs] = getattr(part, name)
        return replace(self, **changed)

    @cached_property
    def arrays(self) -> ModelArrays:
        """Arrays for compiled functions."""
        return ModelArrays(*(np.ascontiguousarray(getattr(self, name)) for name in ModelArrays._fields))

    @property
    def used(self) -> Masks:
        """True for channels with a weight above 0, shape (T, M)."""
        return self.root_weight > 0

    @property
    def sigma_m(self) -> Floats:
        """Standard deviation of each range, shape (T, M) [m]; NaN for unused ranges."""
        return np.asarray(1.0 / np.where(self.used, self.root_weight, np.nan))

    @cached_property
    def _fitted(self) -> tuple[Floats, Floats, Floats]:
        return kernels.model.residuals(self.arrays)

    @property
    def step_m(self) -> Floats:
        """Best-fitting position minus linearisation position, shape (T, 3) [m]; near 0 at a solution."""
        return self._fitted[0]

    @property
    def residual(self) -> Floats:
        """Whitened residuals ``nu = S y``, shape (T, M)."""
        return self._fitted[1]

    @property
    def redundancy(self) -> Floats:
        """Redundancy numbers (diagonal of S), shape (T, M); 0 for unused ranges and ranges that no other range tests.

        A redundancy number is the fraction of a range error that appears in the residual of the same range.
        """
        return self._fitted[2]

    @cached_property
    def residual_m(self) -> Floats:
        """Residuals of the fit in which the map error is estimated, shape (T, M) [m]; 0 for unused ranges."""
        return np.where(self.used, self.residual / np.where(self.used, self.root_weight, 1.0), 0.0)

    @cached_property
    def wsse(self) -> Floats:
        """Weighted sum of squared residuals ``y^T S y``, with map and clock-offset terms, shape (T,)."""
        return np.asarray(np.einsum("tm,tm->t", self.misfit, self.residual))

    @cached_property
    def gain_m(self) -> Floats:
        """Derivative of the position with respect to each whitened range, shape (T, M, interest) [m]."""
        return np.asarray(self.design @ self.covariance_m2[:, :, : self.interest])

    def position_covariance_m2(self, scale: Floats) -> Floats:
        """Return the covariance of the components of interest, shape (T, interest, interest) [m^2].

        `scale` multiplies the sigmas of ranges and clock offsets, but not the sigmas of the map error. Map errors
        contribute ``Q P Q`` to the covariance Q, range errors ``Q - Q P Q``.
        """
        k = self.interest
        covariance = self.covariance_m2
        map_part = (covariance @ self.prior @ covariance)[:, :k, :k]
        return np.asarray(scale[:, None, None] ** 2 * (covariance[:, :k, :k] - map_part) + map_part)


@dataclass(frozen=True, kw_only=True)
class Compact(RowArrays):
    """Residuals and projector of T epochs and n channels. At each epoch, the used channels are first."""

    channel: Indices  #: Channel number in `LinearModel` of each of the n channels, shape (T, n).
    used: Masks  #: True for used channels, shape (T, n).
    projector: Floats  #: Residual projector S, shape (T, n, n); 0 for unused channels.
    residual: Floats  #: Whitened residuals, shape (T, n).
    sigma_m: Floats  #: Standard deviations of the ranges, shape (T, n); 0 for unused channels.
    gain_m: Floats  #: Gain of each channel (`LinearModel.gain_m`), shape (T, n, interest).


def compact(model: LinearModel) -> Compact:
    """Return residuals and residual projector of the used channels, in channel order."""
    n = int(model.used.sum(axis=1).max(initial=0))
    channel = np.argsort(~model.used, axis=1, kind="stable")[:, :n]
    used = np.take_along_axis(model.used, channel, axis=1)
    root = np.take_along_axis(model.root_weight, channel, axis=1)
    design = np.take_along_axis(model.design, channel[..., None], axis=1)
    of_place, of_clocks = (np.ascontiguousarray(part) for part in (model.covariance_m2, model.clock_covariance_m2))
    clocks = root[..., None] * (model.clock[channel][..., None] == np.arange(of_clocks.shape[1]))
    unknowns = np.concatenate([clocks, design], axis=2)
    spread = np.concatenate([clocks @ of_clocks, design @ of_place], axis=2)
    projector = -spread @ unknowns.swapaxes(1, 2)
    projector[:, np.arange(n), np.arange(n)] += used
    return Compact(
        channel=channel, used=used, projector=projector, residual=np.take_along_axis(model.residual, channel, axis=1),
        sigma_m=np.where(used, 1.0 / np.where(used, root, 1.0), 0.0),
        gain_m=np.take_along_axis(model.gain_m, channel[..., None], axis=1),
    )  # fmt: skip


def linear_model(ranges: Ranges, line: Line, arc_m: Floats, *, section: Indices | None = None) -> LinearModel:
    """Linearise ranges at positions on the line, with a prior on lateral and vertical map errors (P1 2.2(3), P4).

    The prior uses `sigma_plan_m` and `sigma_height_m` of the trajectory. The model is NaN at epochs without a position.

    Parameters
    ----------
    ranges : Ranges
        Returned by `railfix.positioning.weighted_ranges`.
    line : Trajectory, SearchIndex or AntennaRows
    arc_m : ndarray, shape (T,) [m]
        Positions computed from `ranges` (`Constrained.arc_m` of `railfix.positioning.position_on_line`).
    section : ndarray of int, shape (T,), optional
        Section of each position (`Constrained.section`). It is required for positions at the joint of two sections.
    """
    antennas = AntennaRows.on(line)
    at = antennas.segment_at(arc_m) if section is None else np.maximum(section, 0)
    prior = np.diag([0.0, 1.0 / antennas.sigma_plan_m**2, 1.0 / antennas.sigma_height_m**2])
    return _model(ranges, antennas.at_arc(arc_m), antennas.get_axes(at), prior, unknowns=1)


def update_model(
    model: LinearModel, ranges: Ranges, antennas: AntennaRows, position: Constrained, epochs: Indices
) -> LinearModel:
    """Return the model after recomputing `epochs` from new ranges and positions; `epochs` must be ascending."""
    for index, own in antennas.split(epochs):
        model = model.patch(
            own, linear_model(ranges.take(own), index, position.arc_m[own], section=position.section[own])
        )
    return model


def _model(ranges: Ranges, place_ecef_m: Floats, axes: Floats, prior: Floats, *, unknowns: int) -> LinearModel:
    """Whiten the ranges, eliminate the clocks, and invert the normal matrix.

    `axes`, shape (T, 3, 3), are the unit vectors of the position unknowns at `place_ecef_m`; NaN without a position.
    """
    arrays = ranges.arrays
    root, clocks, design, covariance, misfit = kernels.model.linearise_ranges(
        arrays, kernel_array(place_ecef_m), kernel_array(axes), kernel_array(prior)
    )
    return LinearModel(
        root_weight=root, clock=arrays.clock, clock_covariance_m2=clocks, design=design, covariance_m2=covariance,
        prior=prior, misfit=misfit, freedom=ranges.n_used - ranges.n_clocks - unknowns,
        interest=1 if unknowns == 1 else 2,
    )  # fmt: skip

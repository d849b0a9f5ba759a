"""One linear model for RAIM on the line and in space.

P4 tests the residuals of ``y = H x + v``. Here every range is divided by its sigma, and the receiver clocks and the map
error across and up, unknowns with a prior, are taken out beforehand. What is left is a residual projector ``S = I - R K
R^T - B Q B^T`` (R: 1/sigma in the column of the satellite's clock, K: covariance of the clocks at a known place, B:
design with the clocks taken out, Q: its covariance), with ``nu = S y`` and ``WSSE = y^T S y``, chi-square distributed
with `LinearModel.freedom` degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.core.geodesy import range_with_rotation
from railfix.positioning.normal_equations import Ranges, inverse_3x3
from railfix.track.trajectory import Trajectory


class ModelArrays(NamedTuple):
    """Arrays of `LinearModel` in C order, as compiled functions take them."""

    root_weight: Floats
    clock: Indices
    clock_covariance_m2: Floats
    design: Floats
    covariance_m2: Floats
    prior: Floats
    misfit: Floats


@dataclass(frozen=True, kw_only=True)
class LinearModel:
    """Ranges linearised at a position, whitened, T epochs by M channels.

    The three unknowns of the place are, on the line, along, across and up; in space, east, north
    and up. The first `interest` of them are what the position is wanted for.
    """

    root_weight: Floats  #: 1/sigma of each range, 0 for what is not used; shape (T, M) [1/m].
    clock: Indices  #: Clock of each channel: index into the groups of the ranges; shape (M,).
    clock_covariance_m2: Floats  #: Of the clocks at a known place (K), shape (T, G, G).
    #: Change of the whitened range with the place, clocks taken out (B); 0 where not used; shape (T, M, 3) [1/m].
    design: Floats
    #: Of the place, prior included (Q); NaN where the ranges do not determine it; shape (T, 3, 3).
    covariance_m2: Floats
    prior: Floats  #: Prior information on the place: the map error across and up; shape (3, 3) [1/m^2].
    misfit: Floats  #: Whitened code - range at the position, up to a clock (y); 0 where not used; shape (T, M).
    freedom: Integers  #: Ranges beyond the unknowns; may be negative; shape (T,).
    interest: int  #: 1 on the line, 2 (horizontal) in space.

    def __len__(self) -> int:
        return len(self.root_weight)

    def take(self, epochs: Masks | Indices) -> LinearModel:
        """The model of some epochs, by mask or index."""
        return LinearModel(
            root_weight=self.root_weight[epochs], clock=self.clock,
            clock_covariance_m2=self.clock_covariance_m2[epochs], design=self.design[epochs],
            covariance_m2=self.covariance_m2[epochs], prior=self.prior, misfit=self.misfit[epochs],
            freedom=self.freedom[epochs], interest=self.interest,
        )  # fmt: skip

    @property
    def arrays(self) -> ModelArrays:
        """The same as plain arrays, without `freedom` and `interest`."""
        return ModelArrays(*(np.ascontiguousarray(getattr(self, name)) for name in ModelArrays._fields))

    @property
    def used(self) -> Masks:
        """Channels with weight, shape (T, M)."""
        return self.root_weight > 0

    @property
    def sigma_m(self) -> Floats:
        """Standard deviation of each range, shape (T, M) [m]; NaN where not used."""
        return np.asarray(1.0 / np.where(self.used, self.root_weight, np.nan))

    @cached_property
    def step_m(self) -> Floats:
        """The place that fits best, from the position the model stands at, shape (T, 3) [m]; near 0 at a solution."""
        pull = np.matmul(self.misfit[:, None, :], self.design)
        return np.asarray(np.matmul(pull, self.covariance_m2)[:, 0])

    @cached_property
    def residual(self) -> Floats:
        """Whitened residuals ``nu = S y``, shape (T, M)."""
        clocks = _clocks(self.root_weight, self.clock, self.clock_covariance_m2, self.misfit[..., None])[..., 0]
        return np.asarray(self.misfit - self.root_weight * clocks - np.einsum("tmi,ti->tm", self.design, self.step_m))

    @cached_property
    def residual_m(self) -> Floats:
        """Residuals of the fit, map error allowed for, shape (T, M) [m]; 0 where not used."""
        return np.where(self.used, self.residual / np.where(self.used, self.root_weight, 1.0), 0.0)

    @cached_property
    def wsse(self) -> Floats:
        """Weighted sum of squared residuals ``y^T S y``, map error and ties allowed for, shape (T,)."""
        return np.asarray(np.einsum("tm,tm->t", self.misfit, self.residual))

    @cached_property
    def gain_m(self) -> Floats:
        """Change of the position with a whitened range, shape (T, M, interest) [m]."""
        return np.asarray(self.design @ self.covariance_m2[:, :, : self.interest])

    @cached_property
    def redundancy(self) -> Floats:
        """Diagonal of S: the share of its own error that a range shows in its residual, shape (T, M).

        0 where not used, and where nothing checks the range.
        """
        clocks = np.einsum("tgg->tg", self.clock_covariance_m2)[:, self.clock]
        place = ((self.design @ self.covariance_m2) * self.design).sum(axis=2)
        return np.asarray(self.used * (1.0 - self.root_weight**2 * clocks) - place)

    def position_covariance_m2(self, scale: Floats) -> Floats:
        """Covariance of the wanted components, shape (T, interest, interest) [m^2].

        `scale` multiplies the sigmas of the ranges (and ties), not the map error: of the covariance
        Q, ``Q P Q`` comes from the prior P and ``Q - Q P Q`` from the ranges.
        """
        k = self.interest
        covariance = self.covariance_m2
        map_part = (covariance @ self.prior @ covariance)[:, :k, :k]
        return np.asarray(scale[:, None, None] ** 2 * (covariance[:, :k, :k] - map_part) + map_part)


@dataclass(frozen=True, kw_only=True)
class Compact:
    """Residuals and their projector of the used channels alone, side by side: T epochs by n."""

    channel: Indices  #: Channel of the model in each place, shape (T, n).
    used: Masks  #: False in the places beyond the epoch's own channels, shape (T, n).
    projector: Floats  #: S; 0 beyond; shape (T, n, n).
    residual: Floats  #: Shape (T, n).
    sigma_m: Floats  #: 0 beyond, shape (T, n).
    gain_m: Floats  #: Shape (T, n, interest).

    def take(self, epochs: Indices) -> Compact:
        """The parts of some epochs, by index."""
        return Compact(**{item.name: getattr(self, item.name)[epochs] for item in fields(self)})


def compact(model: LinearModel) -> Compact:
    """The residual projector over the channels in use, in their order; (T, n, n) of memory."""
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


def constrained_model(
    ranges: Ranges, trajectory: Trajectory, arc_m: Floats, *, section: Indices | None = None
) -> LinearModel:
    """Model of positions along the line: distance d unknown, the map error a prior across and up (P1 2.2(3), P4).

    The prior is `sigma_plan_m` and `sigma_height_m` of the trajectory. `arc_m`, shape (T,), are positions as
    `constrained_position` gives them, with `section` where they are points that two sections share. The model is NaN in
    the epochs without a position.
    """
    at = trajectory.segment_at(arc_m)[0] if section is None else section
    place, axes = trajectory.at_arc(arc_m), trajectory.axes_of(at)
    return model_on_line(ranges, place, axes, trajectory.sigma_plan_m, trajectory.sigma_height_m)


def model_on_line(
    ranges: Ranges, place_ecef_m: Floats, axes: Floats, sigma_plan_m: float, sigma_height_m: float
) -> LinearModel:
    """Return the model from places (T, 3) [m] and axes along, across and up there, shape (T, 3, 3)."""
    prior = np.diag([0.0, 1.0 / sigma_plan_m**2, 1.0 / sigma_height_m**2])
    return _model(ranges, place_ecef_m, axes, prior, unknowns=1)


def _model(ranges: Ranges, place_ecef_m: Floats, axes: Floats, prior: Floats, *, unknowns: int) -> LinearModel:
    """Whiten, take the clocks out, invert.

    `axes`, shape (T, 3, 3): unit vectors of the unknowns at positions (T, 3), NaN without; `prior`, shape (3, 3)
    [1/m^2].
    """
    arrays = ranges.arrays
    weight, clock = arrays.weight, arrays.clock
    distance, los = range_with_rotation(arrays.sat_ecef_m, np.ascontiguousarray(place_ecef_m)[:, None, :])
    root, totals = np.sqrt(weight), weight @ _one_hot(clock, len(arrays.starts))
    misfit = arrays.code_m - distance
    if arrays.tied:
        misfit = misfit - arrays.offset_m[:, clock]
    # A constant common to all ranges is no residual; subtracting it keeps the digits of the sums.
    total = totals.sum(axis=1, keepdims=True)
    misfit = misfit - (weight * misfit).sum(axis=1, keepdims=True) / np.where(total > 0, total, 1.0)
    rows = root[..., None] * -(los @ axes.swapaxes(1, 2))
    covariance = _clock_covariance(totals, arrays.sigma_m if arrays.tied else None)
    design = rows - root[..., None] * _clocks(root, clock, covariance, rows)
    normal = rows.swapaxes(1, 2) @ design
    return LinearModel(
        root_weight=root, clock=clock, clock_covariance_m2=covariance, design=design,
        covariance_m2=regular_inverse((normal + normal.swapaxes(1, 2)) / 2.0 + prior), prior=prior,
        misfit=root * misfit, freedom=ranges.n_used - ranges.n_clocks - unknowns, interest=1 if unknowns == 1 else 2,
    )  # fmt: skip


def _clock_covariance(totals: Floats, tie_sigma_m: Floats | None) -> Floats:
    """Covariance of the clocks at a known place, shape (T, G, G) [m^2].

    Of a clock on its own 1/T, T the summed weight of its satellites. Clocks that keep an offset to
    a common one to sigma: ``diag(sigma^2 rho) + rho rho^T / sum(T rho)``, ``rho = 1/(1 + sigma^2 T)``.
    0 for clocks without satellites.
    """
    seen = totals > 0
    covariance = np.zeros((*totals.shape, totals.shape[1]))
    each = np.arange(totals.shape[1])
    if tie_sigma_m is None:
        covariance[:, each, each] = np.where(seen, 1.0 / np.where(seen, totals, 1.0), 0.0)
        return covariance
    rho = seen / (1.0 + tie_sigma_m**2 * totals)
    mass = (totals * rho).sum(axis=1)
    covariance += rho[:, :, None] * (rho / np.where(mass > 0, mass, 1.0)[:, None])[:, None, :]
    covariance[:, each, each] += tie_sigma_m**2 * rho
    return covariance


def _one_hot(clock: Indices, clocks: int) -> Floats:
    """Membership of the channels, shape (M, G)."""
    return np.asarray(clock[:, None] == np.arange(clocks), dtype=np.float64)


def _clocks(root: Floats, clock: Indices, covariance: Floats, columns: Floats) -> Floats:
    """Clocks that whitened `columns` (T, M, C) ask for, at each channel: ``K R^T columns``, shape (T, M, C)."""
    member = _one_hot(clock, covariance.shape[1])
    sums = np.matmul(member.T, root[..., None] * columns)
    return np.asarray(np.matmul(covariance, sums)[:, clock])


def regular_inverse(matrix: Floats) -> Floats:
    """Inverse of symmetric 3 x 3 matrices, each scaled to a unit diagonal; NaN where singular."""
    diagonal = np.einsum("tii->ti", matrix)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, np.nan))
    outer = scale[:, :, None] * scale[:, None, :]
    return np.asarray(inverse_3x3(matrix * outer) * outer)

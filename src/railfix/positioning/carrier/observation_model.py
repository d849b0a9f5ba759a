"""Linearised observation equations of P4, and elimination of each epoch's own unknowns.

For each epoch and channel, at a position on the line::

    code  - range = -u.e d + (-u.c m1 - u.h m2) + b_g
    phase - range = -u.e d + (-u.c m1 - u.h m2) + b   + N_arc

Here, u is the unit vector to the satellite, and e, c and h are the unit vectors along, across and up. d is the distance
along the section, m1 and m2 are the lateral and vertical map errors, and b_g is the clock of the constellation. P4
assumes b = b_g (`clocks="shared"`), which is wrong for telephones. With a separate phase clock b, the ambiguities N are
determined except for a common constant. Let ``L`` be the normal matrix of an epoch's own unknowns, and ``C`` their
coupling to the ambiguities. The epoch then adds ``diag(w) - C^T L^-1 C`` to the normal matrix of the ambiguities (Schur
complement). N absorbs the residual ionospheric error at the start of an arc. Afterwards, N drifts by twice the change
of this error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.core.geodesy import range_with_rotation
from railfix.positioning.range_arrays import InterSystemBiases, Ranges
from railfix.track.trajectory import Trajectory

PhaseClocks = Literal["own", "shared"]

PLACE: Final = 3  #: Number of position unknowns of an epoch: along, across, up.
_FREE_M: Final = 1e5  #: Large prior sigma of an unknown, which keeps the normal matrices invertible [m].
_LEAST_TIE_M: Final = 1e-2  #: Smaller sigmas of inter-system biases are replaced by this sigma [m].


@dataclass(frozen=True, kw_only=True)
class IntegerChannels:
    """Channels whose ambiguities differ by whole numbers of cycles."""

    wavelength_m: Floats  #: Carrier wavelength of each channel, shape (M,).
    group: Integers  #: Group of channels with equal clock and signal, shape (M,); -1 for real-valued ambiguities.


@dataclass(frozen=True, kw_only=True)
class Phases:
    """Corrected phases of an antenna, T epochs by M channels as in its `Ranges`."""

    #: Carrier phase (`corrected_phase_m`), shape (T, M); arbitrary where the weight is 0.
    phase_m: Floats
    #: Weight 1/sigma^2, shape (T, M) [1/m^2]; 0 for unused phases. `Ranges.sat_ecef_m` must be valid for used phases.
    weight: Floats
    #: Arc number of each phase, shape (T, M), unique in a run and constant while the channel has no slip or gap.
    arc_id: Integers
    integers: IntegerChannels | None = None  #: Integer ambiguities; None if all are real-valued.

    def take(self, epochs: Masks | Indices | slice) -> Phases:
        """Return the phases of selected epochs."""
        arrays = {name: getattr(self, name)[epochs] for name in ("phase_m", "weight", "arc_id")}
        return replace(self, **arrays)


def corrected_phase_m(phase_m: Floats, sat_clock_m: Floats, ionosphere_m: Floats, troposphere_m: Floats) -> Floats:
    """Return phases that contain only geometry, receiver clock and a constant, shape (T, M) [m].

    Parameters
    ----------
    phase_m : ndarray, shape (T, M) [m]
        `Slips.phase_m`.
    sat_clock_m : ndarray, shape (T, M) [m]
        c times the satellite clock error. Group delays are not corrected, because they are constant on an arc.
    ionosphere_m, troposphere_m : ndarray, shape (T, M) [m]
        Delays of the code. The ionosphere advances the phase by the same distance.
    """
    return phase_m + sat_clock_m + ionosphere_m - troposphere_m


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """Linearised equations of T epochs. Each epoch has P own unknowns ``x = [along, across, up, clocks]``."""

    code_design: Floats  #: Design rows of the codes, shape (T, M, P).
    phase_design: Floats  #: Design rows of the phases, shape (T, M, P).
    groups: int  #: Number of code clocks. A separate phase clock is the last unknown.
    code_weight: Floats  #: Weights of the codes, shape (T, M) [1/m^2].
    phase_weight: Floats  #: Weights of the phases, shape (T, M) [1/m^2].
    code_m: Floats  #: Observed minus computed code minus `clock_m`, shape (T, M).
    phase_m: Floats  #: Observed minus computed phase minus `phase_clock_m`, shape (T, M).
    clock_m: Floats  #: Approximate receiver clock of the codes, shape (T,).
    phase_clock_m: Floats  #: Approximate receiver clock of the phases, shape (T,).
    known: Floats  #: Prior information on map errors and inter-system biases, shape (T, P, P).
    inverse: Floats  #: Inverse of the normal matrix of each epoch's own unknowns, shape (T, P, P).
    #: Right-hand side of each epoch's own unknowns, shape (T, P). It contains only codes until `shift_phases` adds
    #: phases.
    right: Floats
    coupling: Floats  #: Normal matrix block of own unknowns and ambiguities, shape (T, P, M).
    prior: Floats  #: Prior information on lateral and vertical map errors, shape (2,) [1/m^2].


def linearise(
    ranges: Ranges, phases: Phases, trajectory: Trajectory, arc_m: Floats, *, clocks: PhaseClocks = "own"
) -> Linearised:
    """Linearise the observation equations at arc lengths `arc_m`, shape (T,), which must be finite."""
    section, along = trajectory.segment_at(arc_m)
    place = trajectory.ecef_m[section] + along[:, None] * trajectory.tangent[section]
    distance, los = range_with_rotation(ranges.sat_ecef_m, place[:, None, :])
    axes = trajectory.get_axes(section)
    groups = len(ranges.groups)
    unknowns = PLACE + groups + (clocks == "own")
    for_code = np.zeros((*ranges.code_m.shape, unknowns))
    for_code[..., :PLACE] = -np.matmul(los, axes.swapaxes(1, 2))
    for_phase = for_code.copy()
    for g, group in enumerate(ranges.groups):
        for_code[:, group, PLACE + g] = 1.0
        for_phase[:, group, PLACE + g if clocks == "shared" else -1] = 1.0

    w, v = ranges.weight, phases.weight
    code, clock = _level(ranges.code_m - distance, w)
    phase = np.where(v > 0, phases.phase_m - distance - clock[:, None], 0.0)
    prior = np.array([trajectory.sigma_plan_m**-2.0, trajectory.sigma_height_m**-2.0])
    known = np.zeros((len(code), unknowns, unknowns))
    # the loose prior makes the matrix regular even where an epoch does not determine an unknown
    for free in (0, *range(PLACE, unknowns)):
        known[:, free, free] = _FREE_M**-2.0
    known[:, 1, 1], known[:, 2, 2] = prior
    matrix = np.matmul((for_code * w[..., None]).swapaxes(1, 2), for_code)
    matrix += np.matmul((for_phase * v[..., None]).swapaxes(1, 2), for_phase)
    right = np.matmul((w * code)[:, None, :], for_code)[:, 0]
    if ranges.ties is not None:
        tie, tied = _ties(ranges.ties)
        known[:, PLACE : PLACE + groups, PLACE : PLACE + groups] += tie
        right[:, PLACE : PLACE + groups] += tied
    return Linearised(
        code_design=for_code,
        phase_design=for_phase,
        groups=groups,
        code_weight=w,
        phase_weight=v,
        code_m=code,
        phase_m=phase,
        clock_m=clock,
        phase_clock_m=clock,
        known=known,
        inverse=np.linalg.inv(matrix + known),
        right=right,
        coupling=(for_phase * v[..., None]).swapaxes(1, 2),
        prior=prior,
    )


def _level(values: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return values minus each epoch's weighted mean (0 where the weight is 0), and the means, shape (T,)."""
    used = np.where(weight > 0, values, 0.0)
    total = weight.sum(axis=1)
    mean = (weight * used).sum(axis=1) / np.where(total > 0, total, 1.0)
    return np.where(weight > 0, used - mean[:, None], 0.0), mean


def _ties(ties: InterSystemBiases) -> tuple[Floats, Floats]:
    """Return normal matrix and right-hand side of the inter-system biases, with the common clock eliminated."""
    mass = 1.0 / np.maximum(ties.sigma_m, _LEAST_TIE_M) ** 2
    share = mass / mass.sum(axis=1, keepdims=True)
    matrix = mass[:, :, None] * (np.eye(mass.shape[1]) - share[:, None, :])
    return matrix, np.einsum("tgh,th->tg", matrix, ties.offset_m)


def own_clock(lin: Linearised) -> bool:
    """Return True if the phases have a separate clock."""
    return bool(lin.phase_design.shape[-1] > PLACE + lin.groups)


def shift_phases(lin: Linearised, first_m: Floats) -> Linearised:
    """Subtract the first values of the ambiguities, shape (T, M), and a separate phase clock from the phases.

    The phases are added to the right-hand side of the equations only after this subtraction, because values of 1e7 m
    would cause rounding errors of millimetres.
    """
    phase = np.where(lin.phase_weight > 0, lin.phase_m - first_m, 0.0)
    clock = np.zeros(len(phase))
    if own_clock(lin):
        phase, clock = _level(phase, lin.phase_weight)
    right = lin.right + np.matmul((lin.phase_weight * phase)[:, None, :], lin.phase_design)[:, 0]
    return replace(lin, phase_m=phase, right=right, phase_clock_m=lin.phase_clock_m + clock)


def reduce(lin: Linearised) -> tuple[Floats, Floats]:
    """Return each epoch's information on the ambiguities after eliminating its own unknowns (Schur complement).

    The results are normal matrices (T, M, M) [1/m^2] and right-hand sides (T, M, 3) [1/m] for the observations and for
    map errors of 1 m across and in height. The right-hand side for the map error k is ``prior_k C^T L^-1 e_k``, where
    prior_k is the prior information on this error and e_k is a unit vector.
    """
    gain = np.matmul(lin.inverse, lin.coupling)
    # A sum of squared residuals is never negative, and errors of the inverse affect it only in second order, whereas
    # diag(v) - C^T L^-1 C would lose all digits where an epoch has little information.
    left = [
        (lin.code_weight, -np.matmul(lin.code_design, gain)),
        (lin.phase_weight, np.eye(gain.shape[2]) - np.matmul(lin.phase_design, gain)),
    ]
    matrix = np.matmul(gain.swapaxes(1, 2), np.matmul(lin.known, gain))
    for weight, rows in left:
        matrix += np.matmul((rows * weight[..., None]).swapaxes(1, 2), rows)
    matrix *= ((lin.phase_weight > 0)[:, :, None]) & ((lin.phase_weight > 0)[:, None, :])
    right = np.empty((*lin.phase_m.shape, 3))
    right[..., 0] = lin.phase_weight * lin.phase_m - np.matmul(lin.right[:, None, :], gain)[:, 0]
    right[..., 1:] = (gain[:, 1:PLACE] * lin.prior[:, None]).swapaxes(1, 2)
    return matrix, right


@dataclass(frozen=True, kw_only=True)
class OwnUnknowns:
    """Solution for each epoch's own unknowns, given the ambiguities."""

    step_m: Floats  #: Position along the line minus linearisation position, shape (T,).
    noise_sigma_m: Floats  #: Standard deviation of `step_m` due to noise alone, shape (T,).
    sigma_m: Floats  #: Standard deviation of `step_m`, including the map error, shape (T,).
    clock_m: Floats  #: Receiver clock of each group, shape (T, G).
    code_residual_m: Floats  #: Observed minus computed code, shape (T, M); 0 if unused.
    phase_residual_m: Floats  #: Observed minus computed phase, shape (T, M); 0 if unused.


def own_unknowns(
    lin: Linearised, ambiguity_m: Floats, covariance_m2: Floats, trajectory: Trajectory, *, repeats: Floats
) -> OwnUnknowns:
    """Solve for each epoch's own unknowns by back-substitution.

    `ambiguity_m`, shape (T, M, 3), are each channel's ambiguity and its changes for map errors of 1 m across and in
    height. A map error that is constant over a run does not average out. The sigma therefore contains the larger of two
    effects of the map error: the direct effect with fixed ambiguities, and the total effect, in which the map error
    also changes the ambiguities. `repeats`, shape (T,), are the numbers of epochs in which code errors stay the same;
    they multiply the variance of the ambiguities.
    """
    used = lin.phase_weight > 0
    known = np.where(used[..., None], ambiguity_m, 0.0)
    x = np.matmul(lin.inverse, (lin.right - np.matmul(lin.coupling, known[..., :1])[..., 0])[..., None])[..., 0]
    # derivatives of the position along the line with respect to the ambiguities
    row = -np.matmul(lin.inverse[:, :1], lin.coupling)[:, 0]
    from_arcs = np.einsum("ti,tij,tj->t", row, covariance_m2, row)
    from_noise = lin.inverse[:, 0, 0] + from_arcs
    # if code errors are fully correlated, the phases do not reduce the sigma
    by_codes = np.matmul((lin.code_design * lin.code_weight[..., None]).swapaxes(1, 2), lin.code_design)
    most = np.maximum(np.linalg.inv(by_codes + lin.known)[:, 0, 0], from_noise)
    from_noise = np.minimum(lin.inverse[:, 0, 0] + repeats * from_arcs, most)
    alone = -lin.inverse[:, 0, 1:PLACE] * lin.prior
    together = alone + np.matmul(row[:, None, :], known[..., 1:])[:, 0]
    sigma = np.array([trajectory.sigma_plan_m, trajectory.sigma_height_m])
    alone_m2, together_m2 = ((part**2 @ sigma**2) for part in (alone, together))
    noise_m2 = np.maximum(from_noise - alone_m2, 0.0)
    code = np.where(lin.code_weight > 0, lin.code_m - np.matmul(lin.code_design, x[..., None])[..., 0], 0.0)
    phase = lin.phase_m - np.matmul(lin.phase_design, x[..., None])[..., 0] - known[..., 0]
    return OwnUnknowns(
        step_m=x[:, 0],
        noise_sigma_m=np.sqrt(noise_m2),
        sigma_m=np.sqrt(noise_m2 + np.maximum(alone_m2, together_m2)),
        clock_m=x[:, PLACE : PLACE + lin.groups] + lin.clock_m[:, None],
        code_residual_m=code,
        phase_residual_m=np.where(used, phase, 0.0),
    )

"""Linearised observation equations of P4, with the unknowns of each epoch eliminated.

Per epoch t and channel i, around a position on the line::

    code  - range = -u.e d + (-u.c m1 - u.h m2) + b_g
    phase - range = -u.e d + (-u.c m1 - u.h m2) + b   + N_arc

where d is the distance along the section, m1 and m2 are the map errors across the track and in height, and b_g is the
clock of the constellation. P4 sets b = b_g (`clocks="shared"`), which does not hold for telephones. With a separate
phase clock, the N are determined up to a common constant. Let ``L`` be the normal matrix of an epoch's own unknowns,
and ``C`` their coupling to the N. The epoch then adds ``diag(w) - C^T L^-1 C`` to the normal matrix of the N (Schur
complement). N absorbs the residual ionospheric error at the start of an arc; afterwards N drifts by twice the change of
this error.
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

PLACE: Final = 3  #: Number of own unknowns of an epoch before the clocks: along, across, up.
_FREE_M: Final = 1e5  #: Prior sigma of an unknown, a loose prior for conditioning [m].
_LEAST_TIE_M: Final = 1e-2  #: Minimum sigma of an inter-system bias that ties two clocks [m].


@dataclass(frozen=True, kw_only=True)
class IntegerChannels:
    """Channels whose ambiguities differ by whole cycles."""

    wavelength_m: Floats  #: Shape (M,).
    group: Integers  #: Group of channels with the same clock and signal; -1 without integer ambiguities; shape (M,).


@dataclass(frozen=True, kw_only=True)
class Phases:
    """Corrected phases of an antenna for its `Ranges`: T epochs by M channels."""

    #: Carrier phase [m], corrected like the code (`corrected_phase_m`); arbitrary where the weight is 0; shape (T, M).
    phase_m: Floats
    #: 1/sigma^2 [1/m^2]; 0 for unused phases; shape (T, M). `Ranges.sat_ecef_m` must be valid where the weight is
    #: positive.
    weight: Floats
    #: Number of the arc of each phase, unique in a run; constant while a channel's phase is unbroken; shape (T, M).
    arc_id: Integers
    integers: IntegerChannels | None = None  #: Channels with integer ambiguities; None if all are real-valued.

    def take(self, epochs: Masks | Indices | slice) -> Phases:
        """Return the phases of some epochs."""
        arrays = {name: getattr(self, name)[epochs] for name in ("phase_m", "weight", "arc_id")}
        return replace(self, **arrays)


def corrected_phase_m(phase_m: Floats, sat_clock_m: Floats, ionosphere_m: Floats, troposphere_m: Floats) -> Floats:
    """Return the phase corrected so that geometry, receiver clock and a constant remain, shape (T, M) [m].

    Parameters
    ----------
    phase_m : ndarray, shape (T, M) [m]
        `Slips.phase_m`.
    sat_clock_m : ndarray, shape (T, M) [m]
        c times the satellite clock. Group delays of the phase are constant on an arc and are not corrected.
    ionosphere_m, troposphere_m : ndarray, shape (T, M) [m]
        Delays of the code; the ionosphere advances the phase by the same amount.
    """
    return phase_m + sat_clock_m + ionosphere_m - troposphere_m


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """Linearised equations of T epochs; each epoch has P unknowns ``x = [along, across, up, clocks]`` of its own."""

    code_design: Floats  #: Design rows of the codes, shape (T, M, P).
    phase_design: Floats  #: Design rows of the phases, shape (T, M, P).
    groups: int  #: Number of code clocks; a separate phase clock follows them.
    code_weight: Floats  #: Weights of the codes, shape (T, M) [1/m^2].
    phase_weight: Floats  #: Weights of the phases, shape (T, M) [1/m^2].
    code_m: Floats  #: Observed minus computed code, minus `clock_m`; shape (T, M).
    phase_m: Floats  #: Observed minus computed phase, minus `phase_clock_m`; shape (T, M).
    clock_m: Floats  #: Approximate clock of the epoch, subtracted from the codes; shape (T,).
    phase_clock_m: Floats  #: Approximate clock of the epoch, subtracted from the phases; shape (T,).
    known: Floats  #: Prior information on map errors and inter-system biases, shape (T, P, P).
    inverse: Floats  #: Inverse of the normal matrix of each epoch's own unknowns, shape (T, P, P).
    #: Right-hand side of each epoch's own unknowns; codes alone until `shift_phases` adds the phases; shape (T, P).
    right: Floats
    coupling: Floats  #: Normal matrix between own unknowns and each channel's ambiguity, shape (T, P, M).
    prior: Floats  #: Prior information on the map errors across and in height, shape (2,) [1/m^2].


def linearise(
    ranges: Ranges, phases: Phases, trajectory: Trajectory, arc_m: Floats, *, clocks: PhaseClocks = "own"
) -> Linearised:
    """Linearise the observation equations at finite arc lengths `arc_m`, shape (T,)."""
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
    # With the loose prior, the matrix is regular even where an epoch does not determine an unknown.
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
    """Return the values minus each epoch's weighted mean (0 where the weight is 0), and the means, shape (T,)."""
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
    """Return whether the phases have a separate clock."""
    return bool(lin.phase_design.shape[-1] > PLACE + lin.groups)


def shift_phases(lin: Linearised, first_m: Floats) -> Linearised:
    """Subtract first values of the ambiguities (T, M), and of a separate phase clock, from the phases.

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
    """Compute each epoch's information on the ambiguities, with the epoch's own unknowns eliminated (Schur complement).

    Returns normal matrices (T, M, M) [1/m^2] and right-hand sides (T, M, 3) [1/m] of the observations, and of map
    errors of 1 m across and in height. A map error changes code and phase equally, by a column of the design; with the
    prior of the map error, the right-hand side is ``prior_k C^T L^-1 e_k``.
    """
    gain = np.matmul(lin.inverse, lin.coupling)
    # A sum of squared residuals is never negative, and squares the errors of the inverse. In contrast, diag(v) - C^T
    # L^-1 C would lose all digits where an epoch has little information.
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

    step_m: Floats  #: Distance along the line from the point of linearisation, shape (T,).
    noise_sigma_m: Floats  #: Standard deviation due to noise alone, shape (T,).
    sigma_m: Floats  #: Standard deviation, including the map error; shape (T,).
    clock_m: Floats  #: Receiver clock of each group, shape (T, G).
    code_residual_m: Floats  #: Observed minus computed code; 0 where the weight is 0; shape (T, M).
    phase_residual_m: Floats  #: Observed minus computed phase; 0 where the weight is 0; shape (T, M).


def own_unknowns(
    lin: Linearised, ambiguity_m: Floats, covariance_m2: Floats, trajectory: Trajectory, *, repeats: Floats
) -> OwnUnknowns:
    """Solve for each epoch's own unknowns by back-substitution.

    `ambiguity_m`, shape (T, M, 3), are each channel's ambiguity and its responses to map errors of 1 m across and in
    height. A map error that is constant over a run does not average out, so the sigma contains the larger of two
    responses: the response of the epoch alone, and the response with the ambiguities. `repeats`, shape (T,), are the
    numbers of epochs with the same code errors; they multiply the ambiguities' variance.
    """
    used = lin.phase_weight > 0
    known = np.where(used[..., None], ambiguity_m, 0.0)
    x = np.matmul(lin.inverse, (lin.right - np.matmul(lin.coupling, known[..., :1])[..., 0])[..., None])[..., 0]
    # Response of the distance along the line to the ambiguities, and to the map.
    row = -np.matmul(lin.inverse[:, :1], lin.coupling)[:, 0]
    from_arcs = np.einsum("ti,tij,tj->t", row, covariance_m2, row)
    from_noise = lin.inverse[:, 0, 0] + from_arcs
    # With fully correlated code errors the phases do not reduce the sigma.
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

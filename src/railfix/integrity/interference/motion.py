"""Detection of clock, velocity and position steps that are impossible for an oscillator or a train."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Final, NamedTuple

import numpy as np

from railfix import kernels
from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings, kernel_array
from railfix.core.channel_state import join_channels
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.timescale import seconds
from railfix.integrity.interference.limits import InterferenceLimits
from railfix.integrity.interference.range_fits import MotionInputs, clock_columns, fit_epochs, misfit_at
from railfix.integrity.interference.time_tags import NO_TAGS, TagErrors, fit_time_tags, median_tag_error

#: Step of the ranges when the receiver clock steps by 1 ms [m]. Receivers adjust their clocks by whole milliseconds.
_MILLISECOND_M: Final = SPEED_OF_LIGHT * 1e-3
#: Fits with fewer redundant ranges or Dopplers are not used, because so few can agree by chance.
_LEAST_FREEDOM: Final = 3
_LEAST_MPS: Final = 0.05  #: Lower limit of the estimated Doppler noise [m/s].
_SIZE: Final = 4  #: Number of unknowns of a single-constellation fit: position and clock.


class Fix(NamedTuple):
    """Positions and velocities of T epochs with 3-D standard deviations; NaN where missing."""

    time: Datetimes
    ecef_m: Floats  # (T, 3)
    sigma_m: Floats
    velocity_mps: Floats  # (T, 4), clock drift last
    velocity_sigma_mps: Floats

    def take(self, rows: Indices | slice) -> Fix:
        """Return the positions and velocities of selected epochs."""
        time, ecef, sigma, velocity, velocity_sigma = self
        return Fix(time[rows], ecef[rows], sigma[rows], velocity[rows], velocity_sigma[rows])


def _no_fix() -> Fix:
    nothing = np.full(1, np.nan)
    return Fix(
        np.full(1, np.datetime64("NaT", "ns")), np.full((1, 3), np.nan), nothing, np.full((1, 4), np.nan), nothing
    )


@dataclass(frozen=True, kw_only=True)
class MotionSignState:
    """State of the motion tests at the end of a chunk."""

    #: Time of the last epoch; NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    channel: Strings = field(default_factory=lambda: np.zeros(0, dtype="<U5"))  #: Satellite and signal, shape (K,).
    code_m: Floats = field(default_factory=lambda: np.zeros(0))  #: Last code range of each channel, shape (K,).
    #: Last range rate (``-lambda D``) of each channel, shape (K,).
    rate_mps: Floats = field(default_factory=lambda: np.zeros(0))
    #: Time of the last code and range rate of each channel, shape (K,).
    since: Datetimes = field(default_factory=lambda: np.zeros(0, dtype="datetime64[ns]"))
    position: Fix = field(default_factory=_no_fix)  #: Last position that is accurate enough for a comparison.
    velocity: Fix = field(default_factory=_no_fix)  #: Last velocity that is accurate enough for a comparison.
    on_map: bool = False  #: True once a position has been on the map.
    tags: TagErrors = NO_TAGS  #: Time-tag errors of the last epochs.


@dataclass(frozen=True, kw_only=True)
class MotionSigns:
    """Motion statistics of T epochs; NaN where a comparison is not possible."""

    clock_jump_m: Floats  #: Median change of codes relative to Dopplers, without whole milliseconds; shape (T,).
    #: Jumps of clock drift, velocity and position, shape (T,). A jump is the part of a change that exceeds the limits
    #: of an oscillator or a train. Each jump is also expressed in standard deviations.
    drift_jump_mps: Floats
    drift_jump_sigmas: Floats
    speed_jump_mps: Floats
    speed_jump_sigmas: Floats
    position_jump_m: Floats
    position_jump_sigmas: Floats
    #: Largest difference of positions and clocks between any two constellations, in sigmas, shape (T,).
    part_sigmas: Floats
    off_line_m: Floats  #: 3-D position's distance from the line, shape (T,); NaN before the first position on the line.
    #: Excess of `off_line_m` over `InterferenceLimits.position_jump_m`, in standard deviations; shape (T,).
    off_line_sigmas: Floats
    tag_error_s: Floats  #: Median time-tag error of the last epochs, positive for late time tags; shape (T,).
    tag_error_sigmas: Floats  #: Absolute value of `tag_error_s` in standard deviations, shape (T,).


class MotionFit(NamedTuple):
    """Single-epoch fits at T epochs; the epochs can be from several antennas."""

    fixes: Fix
    part_sigmas: Floats  #: As `MotionSigns.part_sigmas`.
    tag_error_s: Floats  #: Time-tag error, positive for late time tags, shape (T,); NaN if undetermined.
    tag_sigma_s: Floats  #: Sigma of the time-tag error, shape (T,); infinite if not significant, NaN if undetermined.

    def take(self, rows: slice) -> MotionFit:
        """Return the fits of selected epochs."""
        return MotionFit(self.fixes.take(rows), self.part_sigmas[rows], self.tag_error_s[rows], self.tag_sigma_s[rows])


def fit_motion(inputs: MotionInputs, limits: InterferenceLimits) -> MotionFit:
    """Estimate position, velocity, constellation difference and time-tag error of each epoch."""
    linear = misfit_at(inputs)
    parts = _parts(inputs, linear, limits.least_satellites - 1)
    return MotionFit(fit_motion_fixes(inputs, linear), parts, *fit_time_tags(inputs))


def motion_signs(
    inputs: MotionInputs, state: MotionSignState, limits: InterferenceLimits, fitted: MotionFit | None = None
) -> tuple[MotionSigns, MotionSignState]:
    """Compute clock, velocity and position statistics of T epochs; return them and the state for the next chunk.

    `fitted` is the result of `fit_motion` for the same inputs. By default, the function computes it.
    """
    if not len(inputs.time):
        return MotionSigns(**{item.name: np.zeros(0) for item in fields(MotionSigns)}), state
    fixes, part_sigmas, tag_error, tag_sigma = fitted or fit_motion(inputs, limits)
    tags = TagErrors(inputs.time, tag_error, tag_sigma)
    median, sigmas, last_tags = median_tag_error(tags, state.tags)
    position, last_position = _before(fixes, state.position, fixes.sigma_m <= limits.largest_sigma_m)
    velocity, last_velocity = _before(fixes, state.velocity, fixes.velocity_sigma_mps <= limits.largest_speed_sigma_mps)
    speed, speed_sigmas, drift, drift_sigmas = _speed_jump(fixes, velocity, limits)
    jump, jump_sigmas = _position_jump(fixes, position, velocity, limits)
    clock, last_codes = _clock_jump(inputs, state, limits)
    on_line = inputs.off_line_m < np.fmax(limits.position_jump_m, 3.0 * fixes.sigma_m)
    been = np.logical_or.accumulate(np.concatenate([[state.on_map], on_line]))
    off = np.where(been[1:], inputs.off_line_m, np.nan)
    signs = MotionSigns(
        clock_jump_m=clock, drift_jump_mps=drift, drift_jump_sigmas=drift_sigmas, speed_jump_mps=speed,
        speed_jump_sigmas=speed_sigmas, position_jump_m=jump, position_jump_sigmas=jump_sigmas,
        part_sigmas=part_sigmas, off_line_m=off,
        off_line_sigmas=np.maximum(off - limits.position_jump_m, 0.0) / fixes.sigma_m,
        tag_error_s=median, tag_error_sigmas=sigmas,
    )  # fmt: skip
    after = MotionSignState(
        time=inputs.time[-1], channel=last_codes[0], code_m=last_codes[1], rate_mps=last_codes[2],
        since=last_codes[3], position=last_position, velocity=last_velocity, on_map=bool(been[-1]),
        tags=last_tags,
    )  # fmt: skip
    return signs, after


def fit_motion_fixes(inputs: MotionInputs, linear: tuple[Floats, Floats, Floats]) -> Fix:
    """Compute positions and velocities by least squares from the used ranges and Dopplers of all constellations."""
    near, sight, misfit = linear
    clocks = clock_columns(inputs)
    design = np.concatenate([-sight, np.broadcast_to(clocks, (len(near), *clocks.shape))], axis=2)
    weight = np.where(inputs.used, 1.0 / inputs.sigma_m**2, 0.0)
    step, covariance, scale = fit_epochs(design, misfit, weight, least=_LEAST_FREEDOM)
    scale = np.maximum(scale, inputs.noise_scale)
    moving = (sight * inputs.sat_velocity_mps).sum(axis=2)
    rate = inputs.rate_mps - moving
    known = inputs.used & np.isfinite(rate)
    ones = np.ones((*sight.shape[:2], 1))
    velocity, of_velocity, noise = fit_epochs(
        np.concatenate([-sight, ones], axis=2), rate, known.astype(np.float64), least=_LEAST_FREEDOM
    )
    return Fix(
        inputs.time, near + step[:, :3], scale * _length(covariance), velocity,
        np.maximum(noise, _LEAST_MPS) * _length(of_velocity),
    )  # fmt: skip


def _length(covariance: Floats) -> Floats:
    """Return the 3-D standard deviation, shape (T,), from the variances of the first three unknowns."""
    return np.asarray(np.sqrt(covariance[:, :3, :3].trace(axis1=1, axis2=2)))


def _before(fixes: Fix, start: Fix, good: Masks) -> tuple[Fix, Fix]:
    """Return the last fix marked in `good` before each epoch and at the chunk's end; `start` where there is none."""
    if len(good) == 1:
        return start, fixes if good[0] else start
    time, *numbers = (np.concatenate([a, b]) for a, b in zip(start, fixes, strict=True))
    everything = Fix(time, *numbers)
    row = np.where(np.concatenate([[True], good]), np.arange(len(good) + 1), 0)
    latest = np.maximum.accumulate(row)
    return everything.take(latest[:-1]), everything.take(latest[-1:])


def _speed_jump(now: Fix, before: Fix, limits: InterferenceLimits) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the jumps of velocity and clock drift, each in m/s and in standard deviations, shape (T,)."""
    dt = seconds(now.time - before.time)
    near = np.where(dt <= limits.longest_gap_s, 1.0, np.nan)
    sigma = np.hypot(now.velocity_sigma_mps, before.velocity_sigma_mps)
    sigma = np.where(now.velocity_sigma_mps <= limits.largest_speed_sigma_mps, sigma, np.nan) * near
    change = now.velocity_mps - before.velocity_mps
    allowed = limits.acceleration_mps2 * dt
    speed = np.maximum(np.linalg.norm(change[:, :3], axis=1) - allowed, 0.0)
    drift = np.maximum(np.abs(change[:, 3]) - allowed, 0.0)
    return speed, speed / sigma, drift, drift / sigma


def _position_jump(now: Fix, before: Fix, moving: Fix, limits: InterferenceLimits) -> tuple[Floats, Floats]:
    """Return the position jump in metres and in standard deviations, shape (T,).

    The jump is measured from the previous position, extrapolated with the previous velocity. If the previous velocity
    is unknown, a motion in any direction at the largest speed of a train is allowed.
    """
    dt = seconds(now.time - before.time)
    velocity = np.where((moving.time == before.time)[:, None], moving.velocity_mps[:, :3], np.nan)
    slow = np.isnan(velocity[:, 0])
    expected = before.ecef_m + np.where(slow[:, None], 0.0, velocity) * dt[:, None]
    reach = np.where(slow, limits.max_speed_mps, 0.5 * limits.acceleration_mps2 * dt) * dt
    sigma = np.hypot(now.sigma_m, before.sigma_m)
    sigma = np.where((now.sigma_m <= limits.largest_sigma_m) & (dt <= limits.longest_gap_s), sigma, np.nan)
    jump = np.maximum(np.linalg.norm(now.ecef_m - expected, axis=1) - reach, 0.0)
    return jump, jump / sigma


def _clock_jump(
    inputs: MotionInputs, state: MotionSignState, limits: InterferenceLimits
) -> tuple[Floats, tuple[Strings, Floats, Floats, Datetimes]]:
    """Return `MotionSigns.clock_jump_m`, and the name, last code, last range rate and last time of each channel."""
    young = seconds(inputs.time[0] - state.since) <= limits.longest_gap_s
    joined = join_channels(inputs.channel, [state.channel], [young])
    code, rate = (joined.arrange(values, np.nan) for values in (state.code_m, state.rate_mps))
    since = joined.arrange(state.since, np.datetime64("NaT", "ns"))
    step, (code, rate, since_ns) = kernels.screens.clock_steps(
        inputs.time.astype(np.int64), inputs.break_before, kernel_array(joined.widen(inputs.code_m, np.nan)),
        kernel_array(joined.widen(inputs.rate_mps, np.nan)), (code, rate, since.view(np.int64)), limits.longest_gap_s,
        limits.least_satellites,
    )  # fmt: skip
    after = joined.channel, code, rate, since_ns.view("datetime64[ns]")
    return np.asarray(step - np.round(step / _MILLISECOND_M) * _MILLISECOND_M), after


def _parts(inputs: MotionInputs, linear: tuple[Floats, Floats, Floats], least: int) -> Floats:
    """Return the largest normalised position and clock difference between two constellations, shape (T,)."""
    near, sight, misfit = linear
    design = np.concatenate([-sight, np.ones((*sight.shape[:2], 1))], axis=2)
    epochs, clocks = len(near), int(inputs.group.max(initial=-1)) + 1
    used = inputs.used & (inputs.group == np.arange(clocks)[:, None, None])
    enough = used.sum(axis=2) >= least
    weight = np.where(used & enough[..., None], 1.0 / inputs.sigma_m**2, 0.0)
    weight = weight.reshape(clocks * epochs, used.shape[2])
    rows = np.tile(np.arange(epochs), clocks)
    step, covariance, scale = fit_epochs(design[rows], misfit[rows], weight, least=1)
    covariance = covariance * (np.maximum(scale, inputs.noise_scale[rows]) ** 2)[:, None, None]
    step[:, 3] -= inputs.clock_offset_m.T.ravel()
    covariance[:, 3, 3] += inputs.clock_sigma_m.T.ravel() ** 2
    shape = clocks, epochs, _SIZE
    found = list(zip(step.reshape(shape), covariance.reshape(*shape, _SIZE), strict=True))
    largest = np.full(len(near), np.nan)
    for k, (one, of_one) in enumerate(found):
        for other, of_other in found[:k]:
            difference, both = one - other, of_one + of_other
            fine = np.isfinite(difference).all(axis=1) & np.isfinite(both).all(axis=(1, 2))
            both = np.where(fine[:, None, None], both, np.eye(_SIZE))
            inverse = np.linalg.inv(both)
            square = ((inverse @ difference[..., None])[..., 0] * difference).sum(axis=1)
            largest = np.fmax(largest, np.where(fine, np.sqrt(np.maximum(square, 0.0)), np.nan))
    return largest

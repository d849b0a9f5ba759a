"""Adaptation to the measurements: phase and Doppler noise, contradictions, length errors of the map, faulty satellites.

Over a minute, the normalised innovations of a satellite's codes have a mean near 0, even with short reflections. A
wrong clock record or a persistent reflection causes innovations of constant sign. The fault is detected by the mean of
the innovations, each clipped to one standard deviation (`is_faulty`).
"""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Given, Record, Rows, State
from railfix.kernels.tracking.update import Equations, Fit, mean_weights


@inner
def mean_square(rows: Rows, own: slice, found: Fit) -> float:
    """Return the weighted mean square of the normalised residuals of the rows `own`; NaN for fewer than four rows."""
    size, total = own.stop - own.start, 0.0
    for j in range(own.start, own.stop):
        total += found.weight[j] * (found.residual[j] ** 2 + found.fitted[j]) / rows.variance[j]
    return total / size if size > 3 else math.nan


@inner
def update_scale(log_scale: float, mean_square: float, dt: float) -> float:
    """Return the log scale of a variance, updated with an epoch's mean square; a NaN mean square is ignored."""
    if not math.isnan(mean_square):
        log_scale += (1.0 - math.exp(-min(dt, 1.0) / constants.SCALE_S)) * math.log(mean_square)
    return min(max(log_scale, constants.LEAST_SCALE), constants.LARGEST_SCALE)


@inner
def update_doubt(monitors: Record, rows: Rows, found: Fit, dt: float) -> None:
    """Update the timers of low weights of motion and of codes, and the filtered mean misfit of Dopplers and phases."""
    code, motion = mean_weights(rows, rows.variance, found.weight)
    if motion < constants.LOST_MOTION_WEIGHT:
        monitors.weak_motion_s += dt
    else:
        monitors.weak_motion_s = max(monitors.weak_motion_s - constants.MOTION_LEAK * dt, 0.0)
    misfit = 0.0 if math.isnan(motion) else 1.0 - motion
    for j in range(rows.sensor.start, rows.sensor.stop):
        misfit = 0.0 if rows.channel[j] < ix.FORCE_COLUMN else misfit  # 0 if a wheel or radar measures the speed
    monitors.motion_misfit += (1.0 - math.exp(-dt / constants.MOTION_FIT_S)) * (misfit - monitors.motion_misfit)
    if rows.code_s > 0.0:
        if code < constants.LOST_CODE_WEIGHT:
            monitors.weak_code_s += rows.code_s
        else:
            monitors.weak_code_s = max(monitors.weak_code_s - constants.CODE_LEAK * rows.code_s, 0.0)


@inner
def adapt(given: Given, t: int, state: State, rows: Rows, found: Fit, innovation: Floats, shift: float) -> bool:
    """Adapt the state to an epoch's fit; return True if codes of a further satellite are excluded after this epoch.

    `shift` is the result of `compute_code_shift` for the reported hypothesis.
    """
    monitors, parameters, dt = state.monitors[0], given.parameters[0], given.epoch[t].interval_s
    of_dopplers, of_phases = mean_square(rows, rows.doppler, found), mean_square(rows, rows.phase, found)
    monitors.log_doppler_scale = update_scale(monitors.log_doppler_scale, of_dopplers, dt)
    monitors.log_phase_scale = update_scale(monitors.log_phase_scale, of_phases, dt)
    update_doubt(monitors, rows, found, dt)
    update_map_scale(monitors, shift, rows.code_s, parameters)
    beyond, early, excluded = 0, 0, False
    for j in range(rows.code.start, rows.code.stop):
        channel = given.channel[t, rows.channel[j]]
        sigma = channel.code_sigma_m * math.sqrt(1.0 + parameters.code_white_share**2)
        bias = state.code_bias[channel.satellite]
        if abs(bias) > constants.BIAS_FAULTY and abs(bias) * sigma > constants.NOMINAL_M:
            beyond += 1
            early += bias < 0.0
        state.code_bias[channel.satellite] = update_bias(bias, innovation[j] / sigma, rows.code_s)
        excluded = excluded or (is_faulty(state.code_bias[channel.satellite]) and not is_faulty(bias))
    if early and beyond > constants.BIAS_SATELLITES:
        monitors.level_hold_s = max(monitors.level_hold_s, constants.LEVEL_HOLD_S)
    return bool(excluded)


@inner
def update_bias(code_bias: float, innovation: float, code_s: float) -> float:
    """Return a satellite's mean normalised innovation, updated with a new innovation."""
    share = 1.0 - math.exp(-min(code_s, 1.0) / constants.BIAS_MEMORY_S)
    return code_bias + share * (min(max(innovation, -constants.BIAS_MOST), constants.BIAS_MOST) - code_bias)


@inner
def is_faulty(code_bias: float) -> bool:
    """Return True if a satellite's codes are excluded because of their mean innovation."""
    return bool(code_bias > constants.BIAS_FAULTY or code_bias < constants.BIAS_SHORT)


@inner
def compute_code_shift(rows: Rows, equations: Equations, covariance: Floats, weight: Floats) -> float:
    """Return the normalised position shift that the codes of an epoch imply; 0 with fewer than `MISFIT_CODES` codes.

    The shift is the score of the innovations v, ``h' S^-1 v / sqrt(h' S^-1 h)``, where h are the coefficients of the
    arc length. It is standard normal and white over epochs if the model is correct. `covariance`, shape (Q, Q), is H P
    H' of the quantities before the correction, codes first. `weight`, shape (M,), has the initial weights; larger
    weights than 1 count as 1.
    """
    codes = rows.code.stop
    if codes < constants.MISFIT_CODES:
        return 0.0
    S, h, v = covariance[:codes, :codes].copy(), equations.coefficient[:codes, 0].copy(), equations.value[:codes].copy()
    for j in range(codes):
        S[j, j] += rows.variance[j] / min(weight[j], 1.0)
    score = information = 0.0
    for i in range(codes):  # elimination with S = L D L': sums of the products of L^-1 h and L^-1 v, divided by D
        score += h[i] * v[i] / S[i, i]
        information += h[i] ** 2 / S[i, i]
        for j in range(i + 1, codes):
            share = S[j, i] / S[i, i]
            h[j] -= share * h[i]
            v[j] -= share * v[i]
            S[j, i:] -= share * S[i, i:]
    return score / math.sqrt(information) if information > 0.0 else 0.0


@inner
def update_map_scale(monitors: Record, shift: float, dt: float, parameters: Record) -> None:
    """Update the mean code shift with the `shift` of an epoch, and adapt the assumed length error of the map."""
    dt = min(dt, 1.0)
    share = 1.0 - math.exp(-dt / constants.MAP_MISFIT_S)
    if abs(shift) > constants.STEP_SIGMAS:
        shift = 0.0
    shift = min(max(shift, -constants.MISFIT_CLIPPED), constants.MISFIT_CLIPPED)
    mean = (1.0 - share) * monitors.code_shift + share * shift
    variance = (1.0 - share) ** 2 * monitors.code_shift_variance + share**2
    monitors.code_shift, monitors.code_shift_variance = mean, variance
    beyond = abs(mean) / (np.sqrt(variance) * parameters.map_misfit_sigmas)
    scale = monitors.map_log_variance * math.exp(-dt / constants.MAP_MISFIT_KEPT_S)
    if beyond > 1.0:
        scale += 2.0 * math.log(beyond) * dt / constants.MISFIT_LEARNT_S
    monitors.map_log_variance = min(scale, constants.MISFIT_LARGEST)

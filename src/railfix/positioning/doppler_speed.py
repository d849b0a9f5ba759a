r"""Speed along the track from carrier Dopplers.

The range ``rho = |s - r| + omega / c (s_x r_y - s_y r_x)``, with the satellite s at ``t - rho / c``, has the derivative
``rho' = (A + g . v) / (1 + A / c)``. A is the contribution of the satellite velocity, and ``g = d rho / d r``. A
receiver that moves at speed v along the unit tangent e of the track measures

    ``-lambda D = (A + (g . e) v) / (1 + A / c) + d_r - d_s + T'``

where d_r and d_s are the drifts of the receiver and satellite clocks [m/s], and T' is the rate of the tropospheric
delay. The unknowns are v and d_r, for any number of constellations. The ionospheric delay rate (millimetres per second)
is neglected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, FrozenArrays, Integers, Masks, Strings, channel_sums
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.geodesy import elevation_azimuth, geodetic_from_ecef, range_with_rotation
from railfix.core.settings import Settings
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.gnss.orbits import satellite_states
from railfix.ranges.atmosphere import saastamoinen_delay_m
from railfix.ranges.channels import PLAUSIBLE_CODE_M, channel_order, first_available

_STEP_S: Final = 1.0  #: Time step of the numerical derivatives of satellite clocks and tropospheric delays [s].
_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.
_PASSES: Final = 3  #: Number of passes of outlier rejection. Each pass uses the noise scale of the previous fit.
_TELLING: Final = 2.0  #: Normalised variances count as 1 unless they exceed 1 by more than this many sigmas.
_FLOOR_MPS: Final = 0.02  #: Standard deviation of a Doppler at high C/N0.


class DopplerSpeedLimits(Settings):
    """Limits and weights for the estimation of the speed from Dopplers."""

    mask_deg: float = 10.0  #: Elevation mask.
    #: Noise of a Doppler at 45 dB-Hz: ``sigma^2 = floor^2 + (zenith 10^((45 - min(C/N0, 50)) / 20))^2``. Only the
    #: relative noise of Dopplers affects the speed, because the noise scale is estimated from the residuals of the log.
    zenith_mps: float = Field(default=0.03, gt=0)
    #: Dopplers with normalised residuals above this are rejected one by one, the largest residual first (w-test of
    #: Baarda, 1968).
    outlier: float = Field(default=3.5, gt=0)
    most_rejected: int = Field(default=8, ge=0)  #: Largest number of Dopplers rejected per epoch.
    min_satellites: int = Field(default=4, ge=3)  #: Epochs with fewer Dopplers than this have no speed.


@dataclass(frozen=True, kw_only=True)
class Dopplers(FrozenArrays):
    """Satellite states, and the Dopplers of one receiver, T epochs by K channels."""

    time: Datetimes  #: Receiver time of each epoch, shape (T,).
    #: Satellite of each channel, shape (K,). At each epoch, only one channel of a satellite has values.
    satellite: Strings
    rate_mps: Floats  #: Range rate ``-lambda D``, positive for a receding satellite, shape (T, K); NaN if missing.
    cn0_dbhz: Floats  #: C/N0, shape (T, K).
    sat_ecef_m: Floats  #: Satellite position at the time of transmission, shape (T, K, 3).
    earlier_ecef_m: Floats  #: Satellite position one second earlier, shape (T, K, 3).
    sat_velocity_mps: Floats  #: Satellite velocity at the time of transmission, ECEF, shape (T, K, 3).
    clock_rate_mps: Floats  #: c times the satellite clock drift, including relativity, shape (T, K).

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, kw_only=True)
class DopplerSpeed:
    """Speed along the track, T epochs."""

    #: Speed, positive along the tangent, shape (T,); NaN with too few satellites or singular geometry.
    speed_mps: Floats
    sigma_mps: Floats  #: Standard deviation of `speed_mps`, shape (T,).
    clock_drift_mps: Floats  #: c times the receiver clock drift, shape (T,).
    residual_mps: Floats  #: Measured minus fitted range rate, shape (T, K); NaN if neither used nor rejected.
    used: Masks  #: True for Dopplers used in the fit, shape (T, K).
    rejected: Masks  #: True for Dopplers rejected as outliers, shape (T, K).
    n_used: Integers  #: Number of Dopplers used, shape (T,).
    scale: float  #: Ratio of the receiver's Doppler noise in the whole log to the assumed noise (`zenith_mps`).


def dopplers_of_log(
    obs: Observations, navigation: Navigation, *, systems: Sequence[str], signals: Mapping[str, Sequence[str]]
) -> Dopplers:
    """Return the Dopplers of a log and the satellite states, with one signal per satellite and epoch.

    Excluded are unhealthy satellites, satellites without navigation records, and channels with an unknown carrier
    frequency or an implausible code. The transmission time is computed from the code.
    """
    columns = channel_order(obs.satellite, obs.signal, systems=systems, signals=signals)
    satellite, signal = obs.satellite[columns], obs.signal[columns]
    code, doppler = obs.code_m[:, columns], obs.doppler_hz[:, columns]
    channel = {**glonass_channels(navigation), **obs.header.glonass_channel}
    wavelength = SPEED_OF_LIGHT / carrier_frequency_hz(satellite, signal, channel)
    known = np.isfinite(doppler) & np.isfinite(wavelength) & (code > PLAUSIBLE_CODE_M[0]) & (code < PLAUSIBLE_CODE_M[1])
    code = np.where(first_available(satellite, known), code, np.nan)
    now = satellite_states(obs.time, satellite, signal, code, navigation)
    # the same orbit and clock, evaluated one second earlier
    before = satellite_states(obs.time, satellite, signal, code + SPEED_OF_LIGHT * _STEP_S, navigation)
    usable = np.isfinite(now.clock_m) & np.isfinite(before.clock_m) & ~now.unhealthy
    return Dopplers(
        time=obs.time,
        satellite=satellite,
        rate_mps=np.where(usable, -wavelength * doppler, np.nan),
        cn0_dbhz=obs.cn0_dbhz[:, columns],
        sat_ecef_m=now.position_ecef_m,
        earlier_ecef_m=before.position_ecef_m,
        sat_velocity_mps=now.velocity_ecef_mps,
        clock_rate_mps=(now.clock_m - before.clock_m) / _STEP_S,
    )


def doppler_speed(
    dopplers: Dopplers, ecef_m: Floats, tangent: Floats, *, limits: DopplerSpeedLimits | None = None
) -> DopplerSpeed:
    """Estimate speed along the track and receiver clock drift at all epochs by weighted least squares.

    `ecef_m`, shape (T, 3), are antenna positions. Where they are NaN, no speed is computed. A position error of 10 m
    changes a range rate by 2 mm/s. `tangent`, shape (T, 3), are unit vectors along the track. Outliers are rejected one
    by one, the largest first, while enough satellites remain. The noise scale is estimated from the median of the
    absolute normalised residuals of the whole log.
    """
    limits = limits or DopplerSpeedLimits()
    shape = (len(dopplers), 3)
    if ecef_m.shape != shape or tangent.shape != shape:
        raise ValueError(f"ecef_m and tangent have shapes {ecef_m.shape} and {tangent.shape}, expected {shape}")
    measured, slope, elevation = _equations(dopplers, ecef_m, tangent)
    cn0 = np.where(np.isnan(dopplers.cn0_dbhz), 45.0, np.minimum(dopplers.cn0_dbhz, 50.0))
    sigma = np.hypot(_FLOOR_MPS, limits.zenith_mps * 10.0 ** ((45.0 - cn0) / 20.0))
    offered = np.isfinite(measured) & np.isfinite(slope) & (elevation >= limits.mask_deg)
    measured, slope = np.where(offered, measured, 0.0), np.where(offered, slope, 0.0)
    scale, used = 1.0, offered
    fit = _fit(measured, slope, sigma, used)
    for _ in range(_PASSES):
        redundant = used & (used.sum(axis=1) >= limits.min_satellites)[:, None]
        normalised = np.abs(fit.normalised[redundant])
        scale = float(np.median(normalised)) / _NORMAL_MEDIAN if normalised.size else 1.0
        scale = max(scale, 1e-6)
        used, fit = _reject_outliers(measured, slope, sigma, offered, scale, limits)
    count = used.sum(axis=1)
    solved = (count >= limits.min_satellites) & np.isfinite(fit.variance)
    freedom = np.maximum(count - 2, 1)
    excess = fit.wsse / scale**2 / freedom
    excess = np.where(excess > 1.0 + _TELLING * np.sqrt(2.0 / freedom), excess, 1.0)
    own = scale * np.sqrt(np.where(solved, fit.variance * excess, np.nan))
    return DopplerSpeed(
        speed_mps=np.where(solved, fit.speed, np.nan),
        sigma_mps=own,
        clock_drift_mps=np.where(solved, fit.drift, np.nan),
        residual_mps=np.where(offered & solved[:, None], fit.residual, np.nan),
        used=used & solved[:, None],
        rejected=offered & ~used & solved[:, None],
        n_used=np.where(solved, count, 0),
        scale=scale,
    )


def _equations(dopplers: Dopplers, ecef_m: Floats, tangent: Floats) -> tuple[Floats, Floats, Floats]:
    """Return rates and slopes of the model ``rate = slope v + drift`` [m/s], and elevations [deg], shape (T, K)."""
    receiver, along = ecef_m[:, None, :], tangent[:, None, :]
    sat, velocity = dopplers.sat_ecef_m, dopplers.sat_velocity_mps
    _, sight = range_with_rotation(sat, receiver)
    turn = EARTH_ROTATION_RATE / SPEED_OF_LIGHT
    moving = np.einsum("tki,tki->tk", sight, velocity)
    moving += turn * (velocity[..., 0] * receiver[..., 1] - velocity[..., 1] * receiver[..., 0])
    slope = -np.einsum("tki,tki->tk", sight, np.broadcast_to(along, sight.shape))
    slope += turn * (sat[..., 0] * along[..., 1] - sat[..., 1] * along[..., 0])
    stretch = 1.0 + moving / SPEED_OF_LIGHT
    latitude, _, height = geodetic_from_ecef(ecef_m)
    elevation, _ = elevation_azimuth(sat, ecef_m)
    earlier, _ = elevation_azimuth(dopplers.earlier_ecef_m, ecef_m)
    above = elevation > 1.0
    delays = [saastamoinen_delay_m(latitude, height, np.where(above, e, 45.0)) for e in (elevation, earlier)]
    troposphere = (delays[0] - delays[1]) / _STEP_S
    return dopplers.rate_mps + dopplers.clock_rate_mps - troposphere - moving / stretch, slope / stretch, elevation


@dataclass(frozen=True, kw_only=True)
class _SpeedFit:
    """Speed, drift, speed variance, residuals, normalised residuals and weighted sum of squares of a fit."""

    speed: Floats
    drift: Floats
    variance: Floats
    residual: Floats
    normalised: Floats
    wsse: Floats


def _fit(measured: Floats, slope: Floats, sigma: Floats, used: Masks) -> _SpeedFit:
    weight = np.where(used, 1.0 / sigma**2, 0.0)
    one, h, hh, y, hy = (
        channel_sums(values)
        for values in (weight, weight * slope, weight * slope**2, weight * measured, weight * slope * measured)
    )
    # One satellite, or several in the same direction, do not determine the speed.
    determinant = one * hh - h * h
    determinant = np.where((used.sum(axis=1) >= 2) & (determinant > 1e-9 * one * hh), determinant, np.nan)
    speed, drift = (one * hy - h * y) / determinant, (hh * y - h * hy) / determinant
    residual = measured - slope * speed[:, None] - drift[:, None]
    fitted = (hh[:, None] - 2.0 * slope * h[:, None] + slope**2 * one[:, None]) / determinant[:, None]
    own = sigma**2 - np.where(used, fitted, -fitted)
    with np.errstate(invalid="ignore"):
        normalised = residual / np.sqrt(np.where(own > 1e-6 * sigma**2, own, np.nan))
    return _SpeedFit(
        speed=speed,
        drift=drift,
        variance=one / determinant,
        residual=residual,
        normalised=np.nan_to_num(normalised),
        wsse=channel_sums(weight * residual**2),
    )


def _reject_outliers(
    measured: Floats, slope: Floats, sigma: Floats, offered: Masks, scale: float, limits: DopplerSpeedLimits
) -> tuple[Masks, _SpeedFit]:
    """Repeatedly reject the largest outlier of each epoch; return a mask of the remaining Dopplers, and their fit."""
    used = offered.copy()
    fit = _fit(measured, slope, sigma, used)
    for _ in range(limits.most_rejected):
        size = np.where(used, np.abs(fit.normalised), 0.0)
        worst = size.argmax(axis=1)
        epochs = np.flatnonzero(
            (size.max(axis=1) > limits.outlier * scale) & (used.sum(axis=1) > limits.min_satellites)
        )
        if not len(epochs):
            break
        used[epochs, worst[epochs]] = False
        fit = _fit(measured, slope, sigma, used)
    return used, fit

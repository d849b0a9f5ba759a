"""Ionospheric and tropospheric delays, computed independently of `railfix.ranges.atmosphere` by the same models.

Klobuchar (IS-GPS-200, 20.3.3.5.2.5) and Saastamoinen with the standard atmosphere and 70 % relative
humidity: a receiver that applies them corrects the simulated delays exactly, unless a scale changes them.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT

_HUMIDITY: Final = 0.7


def ionosphere_m(
    coefficients: Floats,
    second_of_day_s: Floats,
    latitude_deg: Floats,
    longitude_deg: Floats,
    elevation_deg: Floats,
    azimuth_deg: Floats,
    *,
    frequency_hz: float | Floats,
) -> Floats:
    """Klobuchar's delay [m] at a frequency, all arguments of one shape; angles inside in semicircles."""
    elevation, azimuth = elevation_deg / 180.0, np.radians(azimuth_deg)
    psi = 0.0137 / (elevation + 0.11) - 0.022
    phi = np.clip(latitude_deg / 180.0 + psi * np.cos(azimuth), -0.416, 0.416)
    lam = longitude_deg / 180.0 + psi * np.sin(azimuth) / np.cos(phi * np.pi)
    magnetic = phi + 0.064 * np.cos((lam - 1.617) * np.pi)
    local = (43_200.0 * lam + second_of_day_s) % 86_400.0
    slant = 1.0 + 16.0 * (0.53 - elevation) ** 3
    powers = magnetic[..., None] ** np.arange(4)
    amplitude = np.maximum(powers @ coefficients[:4], 0.0)
    period = np.maximum(powers @ coefficients[4:], 72_000.0)
    x = 2.0 * np.pi * (local - 50_400.0) / period
    bulge = np.where(np.abs(x) < 1.57, amplitude * (1.0 - x**2 / 2.0 + x**4 / 24.0), 0.0)
    return SPEED_OF_LIGHT * slant * (5e-9 + bulge) * (FREQUENCY_L1 / frequency_hz) ** 2


def troposphere_m(latitude_deg: Floats, height_m: Floats, elevation_deg: Floats) -> Floats:
    """Saastamoinen's delay [m], all arguments of one shape."""
    height = np.maximum(height_m, 0.0)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568
    temperature = 15.0 - 6.5e-3 * height + 273.16
    vapour = 6.108 * _HUMIDITY * np.exp((17.15 * temperature - 4684.0) / (temperature - 38.45))
    sine = np.sin(np.radians(elevation_deg))
    dry = 0.0022768 * pressure / (1.0 - 0.00266 * np.cos(2.0 * np.radians(latitude_deg)) - 0.00028 * height / 1e3)
    wet = 0.002277 * (1255.0 / temperature + 0.05) * vapour
    return np.asarray((dry + wet) / sine)

"""Compiled function of `railfix.ranges.atmosphere`: ionospheric delays by the broadcast model."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.kernels.compiling import inner, kernel

_DAY_S = 86_400.0


@inner
def _cubic(coefficients: Floats, x: float) -> float:
    """Value of a polynomial of third degree."""
    return float(coefficients[0] + x * (coefficients[1] + x * (coefficients[2] + x * coefficients[3])))


@kernel
def klobuchar(
    seconds_of_week: Floats,
    latitude_deg: Floats,
    longitude_deg: Floats,
    elevation_deg: Floats,
    azimuth_deg: Floats,
    coefficients: Floats,
    frequency_hz: Floats,
) -> Floats:
    """Return ionospheric delays [m], satellite by satellite."""
    epochs, channels = elevation_deg.shape
    delay = np.full((epochs, channels), np.nan)
    for t in range(epochs):
        for m in range(channels):
            if not elevation_deg[t, m] > 0.0:
                continue
            elevation, azimuth = elevation_deg[t, m] / 180.0, math.radians(azimuth_deg[t, m])
            earth_angle = 0.0137 / (elevation + 0.11) - 0.022
            latitude = latitude_deg[t] / 180.0 + earth_angle * math.cos(azimuth)
            if math.isnan(latitude):
                continue
            latitude = min(max(latitude, -0.416), 0.416)
            longitude = longitude_deg[t] / 180.0 + earth_angle * math.sin(azimuth) / math.cos(latitude * math.pi)
            if math.isnan(longitude):
                continue
            magnetic = latitude + 0.064 * math.cos((longitude - 1.617) * math.pi)
            local = (43_200.0 * longitude + seconds_of_week[t]) % _DAY_S
            low = 0.53 - elevation
            slant = 1.0 + 16.0 * low * low * low
            amplitude = max(_cubic(coefficients[0], magnetic), 0.0)
            period = max(_cubic(coefficients[1], magnetic), 72_000.0)
            phase = 2.0 * math.pi * (local - 50_400.0) / period
            cosine = 1.0 + phase * phase * (-0.5 + phase * phase / 24.0)
            vertical = 5e-9 if abs(phase) >= 1.57 else 5e-9 + amplitude * cosine
            delay[t, m] = SPEED_OF_LIGHT * slant * vertical * (FREQUENCY_L1 / frequency_hz[m]) ** 2
    return delay

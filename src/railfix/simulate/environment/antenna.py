"""Reception of reflected signals: wall material, polarisation, and the antenna's cross-polar gain."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats
from railfix.simulate.environment.settings import AntennaSettings


def circular_reflection(cosine: Floats, permittivity: float) -> tuple[Floats, Floats]:
    """Amplitudes, right-handed and left-handed, that a smooth dielectric wall reflects of a right-handed circular wave.

    ``G_perp = (c - r) / (c + r)``, ``G_par = (e c - r) / (e c + r)`` with c the cosine of incidence from the wall's
    normal, e the relative permittivity and ``r = sqrt(e - 1 + c^2)`` (Fresnel); right-handed ``|G_par + G_perp| / 2``,
    left-handed ``|G_par - G_perp| / 2``: at normal incidence all is left-handed, at grazing incidence right-handed.
    """
    root = np.sqrt(permittivity - 1.0 + cosine**2)
    perpendicular = (cosine - root) / (cosine + root)
    parallel = (permittivity * cosine - root) / (permittivity * cosine + root)
    return np.abs(parallel + perpendicular) / 2.0, np.abs(parallel - perpendicular) / 2.0


def received_amplitude(cosine: Floats, sine_elevation: Floats, antenna: AntennaSettings) -> Floats:
    """Amplitude of a wall's reflection behind the antenna, over the direct signal from the same elevation.

    Both polarisations add in power; the left-handed one is received with the antenna's cross-polar loss, linear in
    the sine of the elevation from horizon to zenith [dB].
    """
    right, left = circular_reflection(cosine, antenna.wall_permittivity)
    return np.sqrt(right**2 + (left * cross_polar_gain(sine_elevation, antenna)) ** 2)


def cross_polar_gain(sine_elevation: Floats | float, antenna: AntennaSettings) -> Floats:
    """Amplitude received of left-handed signals over that of right-handed ones."""
    horizon_db, zenith_db = antenna.cross_polar_horizon_db, antenna.cross_polar_zenith_db
    return np.asarray(10.0 ** (-(horizon_db + sine_elevation * (zenith_db - horizon_db)) / 20.0))

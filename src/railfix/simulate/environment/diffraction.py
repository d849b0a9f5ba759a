"""Loss by diffraction, and the antenna pattern."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import fresnel

from railfix.core.arrays import Complexes, Floats
from railfix.simulate.environment.settings import AntennaSettings

#: Below this the loss of an edge is 0 by the formula of ITU-R P.526-15, 4.1.
CLEAR_V: Final = -0.78


def per_metre(distance_m: Floats, wavelength_m: Floats) -> Floats:
    """Fresnel parameter [1/m] of a clearance of 1 m, the source infinitely far, the edge so far from the antenna
    (P.526-15, 4.1).
    """
    return np.sqrt(2.0 / (wavelength_m * np.maximum(distance_m, 0.1)))


def edge_amplitude(v: Floats) -> Floats:
    """Amplitude behind a knife edge of Fresnel parameter v, positive in the shadow (P.526-15, 4.1).

    ``J(v) = 6.9 + 20 log10(sqrt((v - 0.1)^2 + 1) + v - 0.1)`` dB above v = -0.78, else none.
    """
    w = v - 0.1
    loss = 10.0 ** (-6.9 / 20.0) / (np.sqrt(w * w + 1.0) + w)
    return np.where(v > CLEAR_V, np.minimum(loss, 1.0), 1.0)


def strip_field(v: Floats, width_v: Floats) -> Complexes:
    """Field that a strip removes from a wave of amplitude 1, by Kirchhoff and Babinet.

    The field behind the strip is 1 minus this: ``(1 + j)/2 * integral of exp(-j pi t^2/2)`` over the strip, with its
    middle and width as Fresnel parameters.
    """
    sine_1, cosine_1 = fresnel(v - 0.5 * width_v)
    sine_2, cosine_2 = fresnel(v + 0.5 * width_v)
    return np.asarray(0.5 * (1.0 + 1.0j) * ((cosine_2 - cosine_1) - 1.0j * (sine_2 - sine_1)))


def roughness_loss(roughness_m: Floats, cosine: Floats, wavelength_m: Floats) -> Floats:
    """Amplitude factor of specular reflection off a rough wall: exp(-g^2/2), g = 4 pi sigma cos(incidence)/lambda.

    Ament (1953), Proc. IRE 41, 142; the criterion of Rayleigh is g of about 1.6.
    """
    g = 4.0 * np.pi * roughness_m * cosine / wavelength_m
    return np.exp(-0.5 * g * g)


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

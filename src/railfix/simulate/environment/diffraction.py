"""Diffraction by edges and strips, and loss by roughness (ITU-R P.526-15, section 4.1; Born & Wolf, chapter 8)."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import fresnel

from railfix.core.arrays import Complexes, Floats

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

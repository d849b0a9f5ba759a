"""Code, phase and C/N0 of an early-late receiver with several signal paths; diffraction, antenna pattern.

The code error of the coherent loop is the zero of ``Re(conj(P) (E - L))`` with the sums of all paths in the early, late
and prompt correlators (Irsigler 2008, 4.1; Braasch in Parkinson & Spilker 1996, vol. I, ch. 14), with the triangle of
unlimited bandwidth. Where the triangle is straight that zero is a quotient, so a few iterations find it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import fresnel

from railfix.core.arrays import Complexes, Floats, Indices
from railfix.simulate.environment.settings import AntennaSettings, CorrelatorSettings

Singles = NDArray[np.float32]

#: Iterations: three suffice for errors of a few hundredths of a chip; a wide spacing requires more.
_ROUNDS_NARROW: Final = 3
_ROUNDS_WIDE: Final = 12
_NARROW_CHIPS: Final = 0.2  #: Up to this spacing the correlator is narrow [chips].


@dataclass(frozen=True, kw_only=True)
class TrackedCode:
    """Tracked signals, shapes (N,)."""

    #: Delay beyond the unobstructed direct signal.
    code_m: Floats
    phase_m: Floats
    rate_mps: Floats  #: Correlation time of the phase, at constant amplitudes of the paths.
    gain_db: Floats  #: Amplitude of the prompt correlator relative to the unobstructed direct signal.
    main: Indices  #: Path to which the loops lock.


def track_paths(
    field: Complexes,
    extra_m: Floats,
    rate_mps: Floats,
    wavelength_m: Floats,
    chip_m: Floats,
    receiver: CorrelatorSettings,
) -> TrackedCode:
    """Track the sum of P paths for N signals, `field` (P, N) relative to the direct one: loops lock to the strongest,
    the code error stays within half the spacing, fading is attenuated by ``1 / sqrt(1 + (f / loop_hz)^2)``.
    """
    column = np.arange(field.shape[1])
    strength = np.sqrt(field.real**2 + field.imag**2)
    main = np.argmax(strength, axis=0)
    first, first_rate, anchor = extra_m[main, column], rate_mps[main, column], field[main, column]
    size = np.maximum(strength[main, column], 1e-9)
    delay, rate = extra_m - first, rate_mps - first_rate
    # Relative to the main path: c = (a + jb) exp(-j 2 pi delay / wavelength).
    # From here single precision: 1e-7 of a chip or of a wave.
    turn = np.asarray(np.remainder(delay / wavelength_m, 1.0) * (2.0 * np.pi), dtype=np.float32)
    cosine, sine = np.cos(turn), np.sin(turn)
    a = np.asarray((field.real * anchor.real + field.imag * anchor.imag) / size**2, dtype=np.float32)
    b = np.asarray((field.imag * anchor.real - field.real * anchor.imag) / size**2, dtype=np.float32)
    real, imaginary = a * cosine + b * sine, b * cosine - a * sine
    turning_hz = np.asarray(rate / wavelength_m, dtype=np.float32)
    follow = 1.0 / np.sqrt(1.0 + (turning_hz / receiver.code_loop_hz) ** 2)
    late = np.asarray(delay / chip_m, dtype=np.float32)
    error = _zero(real, imaginary, late, follow, receiver.spacing_chips)
    triangle = _triangle(error - late)
    followed = triangle * follow
    power = (real * followed).sum(axis=0) ** 2 + (imaginary * followed).sum(axis=0) ** 2
    power += (((1.0 - follow**2) * triangle**2) * (real**2 + imaginary**2)).sum(axis=0)
    passed = triangle / np.sqrt(1.0 + (turning_hz / receiver.carrier_loop_hz) ** 2)
    angle, pulled = _carrier(real * passed, imaginary * passed, rate, anchor)
    limit = np.abs(rate * (strength > 0.05 * size)).max(axis=0)
    return TrackedCode(
        code_m=first + error * chip_m,
        phase_m=first - angle * wavelength_m / (2.0 * np.pi),
        rate_mps=first_rate + np.clip(pulled, -limit, limit),
        gain_db=20.0 * np.log10(np.maximum(np.sqrt(power) * size, 1e-9)),
        main=main,
    )


def _carrier(real: Singles, imaginary: Singles, rate_mps: Floats, anchor: Complexes) -> tuple[Floats, Floats]:
    """Return the phase of the sum of paths [rad], and its rate beyond the main path's [m/s], at constant amplitudes."""
    carrier, quadrature = real.sum(axis=0), imaginary.sum(axis=0)
    angle = np.arctan2(
        quadrature * anchor.real + carrier * anchor.imag, carrier * anchor.real - quadrature * anchor.imag
    )
    pulled = (carrier * (real * rate_mps).sum(axis=0) + quadrature * (imaginary * rate_mps).sum(axis=0)) / np.maximum(
        carrier**2 + quadrature**2, 1e-18
    )
    return angle, pulled


def _triangle(x: Singles) -> Singles:
    return np.maximum(1.0 - np.abs(x), 0.0)


def _zero(real: Singles, imaginary: Singles, late: Singles, follow: Singles, spacing: float) -> Singles:
    """Return the zero of the discriminator, in chips from the main path (which is 1 and `late` by 0)."""
    half = 0.5 * spacing
    error = np.zeros(real.shape[1], dtype=np.float32)
    own = (1.0 - follow) * (real**2 + imaginary**2)
    for _ in range(_ROUNDS_NARROW if spacing <= _NARROW_CHIPS else _ROUNDS_WIDE):
        x = error - late
        away = np.abs(x)
        triangle = _triangle(x)
        carrier, quadrature = (real * triangle).sum(axis=0), (imaginary * triangle).sum(axis=0)
        # Part of each path in phase with the sum: its own square is constant, the rest oscillates.
        in_phase = follow * (real * carrier + imaginary * quadrature) + own * triangle
        near = away < half
        # Early less late of a path at x: -2 x when near, otherwise a plateau that falls to 0 past a chip.
        far = np.copysign(np.clip(1.0 + half - away, 0.0, spacing), -x)
        push = np.where(near, 2.0 * late, far) * in_phase
        slope = 2.0 * (near * in_phase).sum(axis=0)
        error = np.clip(push.sum(axis=0) / np.maximum(slope, 1e-3), -half, half)
    return error


CLEAR_V: Final = -0.78  #: Below this the loss of an edge is 0 by the formula of ITU-R P.526-15, 4.1.


def per_metre(distance_m: Floats, wavelength_m: Floats) -> Floats:
    """Fresnel parameter per clearance [1/m] of an edge at this distance, source at infinity (P.526-15, 4.1)."""
    return np.sqrt(2.0 / (wavelength_m * np.maximum(distance_m, 0.1)))


def edge_amplitude(v: Floats) -> Floats:
    """Return the amplitude behind a knife edge of Fresnel parameter v, positive in the shadow (P.526-15, 4.1).

    ``J(v) = 6.9 + 20 log10(sqrt((v - 0.1)^2 + 1) + v - 0.1)`` dB above v = -0.78, else none.
    """
    w = v - 0.1
    loss = 10.0 ** (-6.9 / 20.0) / (np.sqrt(w * w + 1.0) + w)
    return np.where(v > CLEAR_V, np.minimum(loss, 1.0), 1.0)


def strip_field(v: Floats, width_v: Floats) -> Complexes:
    """Return the field a strip removes (Kirchhoff, Babinet): ``(1 + j)/2 * integral of exp(-j pi t^2/2)`` over it."""
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
    """Right-handed and left-handed amplitudes of a right-handed circular wave reflected by a smooth dielectric wall.

    ``G_perp = (c - r) / (c + r)``, ``G_par = (e c - r) / (e c + r)`` with c the cosine of incidence from the wall's
    normal, e the relative permittivity and ``r = sqrt(e - 1 + c^2)`` (Fresnel); ``|G_par + G_perp| / 2`` right-handed,
    ``|G_par - G_perp| / 2`` left-handed.
    """
    root = np.sqrt(permittivity - 1.0 + cosine**2)
    perpendicular = (cosine - root) / (cosine + root)
    parallel = (permittivity * cosine - root) / (permittivity * cosine + root)
    return np.abs(parallel + perpendicular) / 2.0, np.abs(parallel - perpendicular) / 2.0


def reflection_amplitude(cosine: Floats, sine_elevation: Floats, antenna: AntennaSettings) -> Floats:
    """Amplitude of a wall's reflection over the direct signal's; the left-handed part has the antenna's cross-polar
    loss, linear in the sine of the elevation [dB].
    """
    right, left = circular_reflection(cosine, antenna.wall_permittivity)
    return np.sqrt(right**2 + (left * cross_polar_gain(sine_elevation, antenna)) ** 2)


def cross_polar_gain(sine_elevation: Floats | float, antenna: AntennaSettings) -> Floats:
    """Return the ratio of received amplitudes of left-handed to right-handed signals."""
    horizon_db, zenith_db = antenna.cross_polar_horizon_db, antenna.cross_polar_zenith_db
    return np.asarray(10.0 ** (-(horizon_db + sine_elevation * (zenith_db - horizon_db)) / 20.0))

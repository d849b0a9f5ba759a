"""Code, phase and C/N0 of an early-late receiver with several signal paths; diffraction and reflection amplitudes.

The code error of the coherent loop is the zero of ``Re(conj(P) (E - L))``, where E, L and P are the sums of all paths
in the early, late and prompt correlators (Irsigler 2008, 4.1; Braasch in Parkinson & Spilker 1996, vol. I, ch. 14). The
autocorrelation is a triangle, as for unlimited bandwidth. Between the corners of the triangle, the zero is the quotient
of two sums; a few iterations therefore suffice.
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

#: Number of iterations with a narrow correlator, whose code errors are at most a few hundredths of a chip.
_ROUNDS_NARROW: Final = 3
_ROUNDS_WIDE: Final = 12  #: Number of iterations with a wide correlator.
_NARROW_CHIPS: Final = 0.2  #: A correlator counts as narrow up to this early-late spacing [chips].


@dataclass(frozen=True, kw_only=True)
class TrackedCode:
    """Code, phase and amplitude at which the loops track N signals, relative to the unobstructed direct signal; shapes
    (N,).
    """

    code_m: Floats  #: Delay of the code.
    phase_m: Floats  #: Delay of the carrier phase.
    rate_mps: Floats  #: Rate of change of `phase_m`, computed for constant path amplitudes.
    gain_db: Floats  #: Amplitude of the prompt correlator, as a change of C/N0.
    main: Indices  #: Index of the path to which the loops lock.


def track_paths(
    field: Complexes,
    extra_m: Floats,
    rate_mps: Floats,
    wavelength_m: Floats,
    chip_m: Floats,
    receiver: CorrelatorSettings,
) -> TrackedCode:
    """Compute code, phase and amplitude of N signals, each a sum of P paths.

    `field` are the complex amplitudes of the paths relative to the unobstructed direct signal, `extra_m` their extra
    delays and `rate_mps` the rates of the delays, shape (P, N). The loops lock to the strongest path, and the code
    error relative to this path is at most half the early-late spacing. Paths whose phase relative to the strongest path
    changes with a frequency f are attenuated by ``1 / sqrt(1 + (f / loop_hz)^2)``.
    """
    column = np.arange(field.shape[1])
    strength = np.sqrt(field.real**2 + field.imag**2)
    main = np.argmax(strength, axis=0)
    first, first_rate, anchor = extra_m[main, column], rate_mps[main, column], field[main, column]
    size = np.maximum(strength[main, column], 1e-9)
    delay, rate = extra_m - first, rate_mps - first_rate
    # Amplitudes relative to the main path: c = (a + jb) exp(-j 2 pi delay / wavelength). From here on, single precision
    # suffices; its error is 1e-7 of a chip or of a wavelength.
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
    """Return the phase of the sum of paths [rad], and the rate of this phase minus the rate of the main path [m/s]."""
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
    """Return the zero of the discriminator [chips] relative to the main path (amplitude 1, `late` 0)."""
    half = 0.5 * spacing
    error = np.zeros(real.shape[1], dtype=np.float32)
    own = (1.0 - follow) * (real**2 + imaginary**2)
    for _ in range(_ROUNDS_NARROW if spacing <= _NARROW_CHIPS else _ROUNDS_WIDE):
        x = error - late
        away = np.abs(x)
        triangle = _triangle(x)
        carrier, quadrature = (real * triangle).sum(axis=0), (imaginary * triangle).sum(axis=0)
        # Component of each path in phase with the sum of the paths. The product of a path with itself is constant over
        # time; the products of two different paths oscillate.
        in_phase = follow * (real * carrier + imaginary * quadrature) + own * triangle
        near = away < half
        # For a path at x, early minus late is -2 x near zero, then constant, and falls to 0 beyond one chip.
        far = np.copysign(np.clip(1.0 + half - away, 0.0, spacing), -x)
        push = np.where(near, 2.0 * late, far) * in_phase
        slope = 2.0 * (near * in_phase).sum(axis=0)
        error = np.clip(push.sum(axis=0) / np.maximum(slope, 1e-3), -half, half)
    return error


CLEAR_V: Final = -0.78  #: Fresnel parameter below which the loss of a knife edge is 0 (ITU-R P.526-15, 4.1).


def per_metre(distance_m: Floats, wavelength_m: Floats) -> Floats:
    """Return the ratio of Fresnel parameter to clearance [1/m] for an edge at `distance_m` and a source at infinity.

    The formula is from ITU-R P.526-15, 4.1.
    """
    return np.sqrt(2.0 / (wavelength_m * np.maximum(distance_m, 0.1)))


def edge_amplitude(v: Floats) -> Floats:
    """Return the amplitude behind a knife edge for Fresnel parameters v, which are positive in the shadow.

    The loss is ``J(v) = 6.9 + 20 log10(sqrt((v - 0.1)^2 + 1) + v - 0.1)`` dB for v > -0.78, otherwise 0 (ITU-R
    P.526-15, 4.1).
    """
    w = v - 0.1
    loss = 10.0 ** (-6.9 / 20.0) / (np.sqrt(w * w + 1.0) + w)
    return np.where(v > CLEAR_V, np.minimum(loss, 1.0), 1.0)


def strip_field(v: Floats, width_v: Floats) -> Complexes:
    """Return the field that an opaque strip removes from the direct signal (Kirchhoff diffraction, Babinet).

    The field is ``(1 + j)/2 * integral of exp(-j pi t^2/2)`` over the strip, whose middle is at the Fresnel parameter
    `v` and whose width is `width_v`.
    """
    sine_1, cosine_1 = fresnel(v - 0.5 * width_v)
    sine_2, cosine_2 = fresnel(v + 0.5 * width_v)
    return np.asarray(0.5 * (1.0 + 1.0j) * ((cosine_2 - cosine_1) - 1.0j * (sine_2 - sine_1)))


def roughness_loss(roughness_m: Floats, cosine: Floats, wavelength_m: Floats) -> Floats:
    """Return the amplitude factor of specular reflection by a rough wall.

    The factor is exp(-g^2/2) with g = 4 pi sigma cos(incidence) / lambda (Ament 1953, Proc. IRE 41, 142). Rayleigh's
    criterion corresponds to g of about 1.6.
    """
    g = 4.0 * np.pi * roughness_m * cosine / wavelength_m
    return np.exp(-0.5 * g * g)


def circular_reflection(cosine: Floats, permittivity: float) -> tuple[Floats, Floats]:
    """Return the right-handed and left-handed amplitudes of a right-handed wave reflected by a smooth dielectric wall.

    ``G_perp = (c - r) / (c + r)``, ``G_par = (e c - r) / (e c + r)`` with c the cosine of incidence from the wall's
    normal, e the relative permittivity and ``r = sqrt(e - 1 + c^2)`` (Fresnel). The amplitudes are ``|G_par + G_perp| /
    2`` (right-handed) and ``|G_par - G_perp| / 2`` (left-handed).
    """
    root = np.sqrt(permittivity - 1.0 + cosine**2)
    perpendicular = (cosine - root) / (cosine + root)
    parallel = (permittivity * cosine - root) / (permittivity * cosine + root)
    return np.abs(parallel + perpendicular) / 2.0, np.abs(parallel - perpendicular) / 2.0


def reflection_amplitude(cosine: Floats, sine_elevation: Floats, antenna: AntennaSettings) -> Floats:
    """Return the ratio of the received amplitudes of a wall reflection and of the direct signal.

    The left-handed part is attenuated by `cross_polar_gain`.
    """
    right, left = circular_reflection(cosine, antenna.wall_permittivity)
    return np.sqrt(right**2 + (left * cross_polar_gain(sine_elevation, antenna)) ** 2)


def cross_polar_gain(sine_elevation: Floats | float, antenna: AntennaSettings) -> Floats:
    """Return the ratio of the received amplitudes of left-handed and right-handed signals.

    The ratio in dB is linear in the sine of the elevation.
    """
    horizon_db, zenith_db = antenna.cross_polar_horizon_db, antenna.cross_polar_zenith_db
    return np.asarray(10.0 ** (-(horizon_db + sine_elevation * (zenith_db - horizon_db)) / 20.0))

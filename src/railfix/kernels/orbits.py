"""Compiled function of `railfix.gnss.orbits`: states of Keplerian records at the times of transmission."""

from __future__ import annotations

import math
from typing import Any

from railfix.core.arrays import Floats, Integers, Masks
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.kernels.compiling import inner, kernel

#: `railfix.gnss.orbits.kepler._GEO_TILT`.
_COS_X, _SIN_X = math.cos(math.radians(-5.0)), math.sin(math.radians(-5.0))
_SECOND = 1_000_000_000


@inner
def _sine_cosine(angle: float) -> tuple[float, float]:
    """Return both to the last digit but one, below 1e5 rad; polynomials of fdlibm (Sun Microsystems, 1993).

    A third of the time of `math.sin` and `math.cos`, each of which reduces the angle again.
    """
    turns = math.floor(angle * (2.0 / math.pi) + 0.5)
    x = (angle - turns * 1.57079632673412561417) - turns * 6.07710050650619224932e-11
    z = x * x
    sine = 2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
    sine = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * sine)
    sine = x + z * x * (-1.66666666666666324348e-01 + z * sine)
    cosine = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
    cosine = 4.16666666666666019037e-02 + z * (
        -1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * cosine)
    )
    cosine = 1.0 - (0.5 * z - z * z * cosine)
    quarter = int(turns) & 3
    if quarter & 1:
        sine, cosine = cosine, -sine
    return (sine, cosine) if quarter < 2 else (-sine, -cosine)


@inner
def _rotated(sine: float, cosine: float, angle: float) -> tuple[float, float]:
    square = angle * angle
    small_sine, small_cosine = angle * (1.0 - square / 6.0), 1.0 - square * (0.5 - square / 24.0)
    return sine * small_cosine + cosine * small_sine, cosine * small_cosine - sine * small_sine


@kernel
def kepler_channels(
    time_ns: Integers, code_m: Floats, channels: Any, records: Any, states: Any
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats, Masks]:
    """Compute states of channels, element by element (`railfix.gnss.orbits.kepler.kepler_state`)."""
    channel, rows, usable, signal = channels
    toe_ns, orbits, clocks, ahead_s, accuracies_m, delays_s, flagged = records
    position, velocity, clock_m, age_s, accuracy_m, delay_m, unhealthy = states
    for t in range(len(time_ns)):
        for k in range(len(channel)):
            if not usable[k, t]:
                continue
            m, row = channel[k], rows[k, t]
            (
                a, motion, e, root, m0, cos_omega, sin_omega, cos_i0, sin_i0, i_dot,
                node_0, node_rate, tilted_rate, cuc, cus, crc, crs, cic, cis, relativity,
            ) = orbits[row]  # fmt: skip
            since = time_ns[t] - toe_ns[row]
            age = float(since // _SECOND) + (since % _SECOND) / _SECOND
            s = age - code_m[t, m] / SPEED_OF_LIGHT
            ahead = ahead_s[row]
            c = s + ahead
            s -= clocks[0, row] + c * (clocks[1, row] + c * clocks[2, row])
            c = s + ahead

            mean = m0 + motion * s
            anomaly = mean
            sin_e, cos_e = _sine_cosine(mean)
            for _ in range(3):
                step = (mean - anomaly + e * sin_e) / (1.0 - e * cos_e)
                anomaly += step
                if abs(step) < 1e-3:
                    sin_e, cos_e = _rotated(sin_e, cos_e, step)
                else:
                    sin_e, cos_e = _sine_cosine(anomaly)
            shrink = 1.0 - e * cos_e
            sin_v, cos_v = root * sin_e / shrink, (cos_e - e) / shrink
            sin_p, cos_p = sin_v * cos_omega + cos_v * sin_omega, cos_v * cos_omega - sin_v * sin_omega
            sin_2p, cos_2p = 2.0 * sin_p * cos_p, cos_p * cos_p - sin_p * sin_p
            sin_u, cos_u = _rotated(sin_p, cos_p, cus * sin_2p + cuc * cos_2p)
            sin_i, cos_i = _rotated(sin_i0, cos_i0, i_dot * s + cis * sin_2p + cic * cos_2p)
            r = a * shrink + crs * sin_2p + crc * cos_2p
            e_rate = motion / shrink
            p_rate = e_rate * root / shrink
            u_rate = p_rate * (1.0 + 2.0 * (cus * cos_2p - cuc * sin_2p))
            r_rate = a * e * sin_e * e_rate + 2.0 * p_rate * (crs * cos_2p - crc * sin_2p)
            i_rate = i_dot + 2.0 * p_rate * (cis * cos_2p - cic * sin_2p)
            node = node_0 + node_rate * s
            sin_n, cos_n = _sine_cosine(node)
            x, y = r * cos_u, r * sin_u
            x_rate, y_rate = r_rate * cos_u - y * u_rate, r_rate * sin_u + x * u_rate
            across, z = y * cos_i, y * sin_i
            across_rate = y_rate * cos_i - z * i_rate
            px, py = x * cos_n - across * sin_n, x * sin_n + across * cos_n
            vx = x_rate * cos_n - across_rate * sin_n - py * node_rate
            vy = x_rate * sin_n + across_rate * cos_n + px * node_rate
            vz = y_rate * sin_i + across * i_rate
            if tilted_rate != 0.0:
                angle = tilted_rate * s
                sin_z, cos_z = _sine_cosine(angle)
                py, z = _COS_X * py + _SIN_X * z, _COS_X * z - _SIN_X * py
                vy, vz = _COS_X * vy + _SIN_X * vz, _COS_X * vz - _SIN_X * vy
                px, py = cos_z * px + sin_z * py, cos_z * py - sin_z * px
                vx, vy = cos_z * vx + sin_z * vy, cos_z * vy - sin_z * vx
                vx, vy = vx + tilted_rate * py, vy - tilted_rate * px
            position[t, m, 0], position[t, m, 1], position[t, m, 2] = px, py, z
            velocity[t, m, 0], velocity[t, m, 1], velocity[t, m, 2] = vx, vy, vz
            offset = clocks[0, row] + c * (clocks[1, row] + c * clocks[2, row])
            clock_m[t, m], age_s[t, m] = SPEED_OF_LIGHT * (offset + relativity * sin_e), age
            accuracy_m[t, m], delay_m[t, m] = accuracies_m[row], SPEED_OF_LIGHT * delays_s[signal[k], row]
            unhealthy[t, m] = flagged[signal[k], row]
    return position, velocity, clock_m, age_s, accuracy_m, delay_m, unhealthy

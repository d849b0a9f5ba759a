"""Physical constants and signal frequencies with units and sources, and constants shared by kernels and callers."""

from __future__ import annotations

from typing import Final

SPEED_OF_LIGHT: Final = 299_792_458.0  #: Speed of light in vacuum [m/s] (IS-GPS-200, 20.3.4.3; CGPM 1983).

#: Earth rotation rate [rad/s] (WGS 84; IS-GPS-200 table 20-IV; Galileo OS SIS ICD 5.1.1).
EARTH_ROTATION_RATE: Final = 7.292_115_146_7e-5
#: Earth rotation rate of CGCS2000 [rad/s] (BDS-SIS-ICD-B1I 3.0, 5.2.4.12).
EARTH_ROTATION_RATE_BEIDOU: Final = 7.292_115e-5
EARTH_ROTATION_RATE_GLONASS: Final = 7.292_115e-5  #: Earth rotation rate of PZ-90 [rad/s] (GLONASS ICD 5.1, A.3.1.2).

GM_GPS: Final = 3.986_005_0e14  #: Geocentric gravitational constant of GPS and QZSS [m^3/s^2] (IS-GPS-200 table 20-IV).
#: Geocentric gravitational constant of Galileo and BeiDou [m^3/s^2] (Galileo OS SIS ICD 5.1.1; BDS-SIS-ICD-B1I).
GM_GALILEO: Final = 3.986_004_418e14
#: Geocentric gravitational constant of GLONASS [m^3/s^2] (GLONASS ICD 5.1, A.3.1.2).
GM_GLONASS: Final = 3.986_004_4e14
PZ90_SEMI_MAJOR_AXIS: Final = 6_378_136.0  #: Semi-major axis of the PZ-90 ellipsoid [m] (GLONASS ICD 5.1, A.3.1.2).
PZ90_J2: Final = 1.082_625_7e-3  #: Second zonal harmonic of the geopotential, PZ-90 [-] (GLONASS ICD 5.1, A.3.1.2).

GRAVITY_MPS2: Final = 9.806_65  #: Standard gravity [m/s2] (CGPM 1901).

BDT_MINUS_GPST_S: Final = -14.0  #: BDT - GPST [s]: BeiDou time lags GPS time by a constant (BDS-SIS-ICD-B1I 3.0, 3.3).

#: GPS L1 carrier frequency [Hz]; the delay of the Klobuchar model is for this frequency (IS-GPS-200, 20.3.3.5.2.5).
FREQUENCY_L1: Final = 1_575.42e6

#: Carrier frequency [Hz] by constellation letter and RINEX 3 band digit (RINEX 3.05, tables 4 to 10).
#: For GLONASS bands 1 and 2, the value is the frequency of channel 0; add the channel number times `GLONASS_STEP`.
CARRIER_FREQUENCY: Final[dict[str, dict[str, float]]] = {
    "G": {"1": 1_575.42e6, "2": 1_227.60e6, "5": 1_176.45e6},
    "J": {"1": 1_575.42e6, "2": 1_227.60e6, "5": 1_176.45e6, "6": 1_278.75e6},
    "E": {"1": 1_575.42e6, "5": 1_176.45e6, "7": 1_207.140e6, "8": 1_191.795e6, "6": 1_278.75e6},
    "C": {"1": 1_575.42e6, "2": 1_561.098e6, "5": 1_176.45e6, "7": 1_207.140e6, "8": 1_191.795e6, "6": 1_268.52e6},
    "R": {"1": 1_602.0e6, "2": 1_246.0e6, "3": 1_202.025e6, "4": 1_600.995e6, "6": 1_248.06e6},
    "S": {"1": 1_575.42e6, "5": 1_176.45e6},
    "I": {"1": 1_575.42e6, "5": 1_176.45e6, "9": 2_492.028e6},
}

#: Spacing of the GLONASS FDMA channels [Hz] by band digit (GLONASS ICD 5.1, 3.3.1.1).
GLONASS_STEP: Final[dict[str, float]] = {"1": 0.5625e6, "2": 0.4375e6}

#: Clock group by constellation letter. The constellations of a group share a receiver clock (IS-QZSS-PNT, 3.2.1).
CLOCK_GROUP: Final[dict[str, str]] = {"G": "G", "J": "G", "E": "E", "C": "C", "R": "R", "S": "G", "I": "I"}

# Constants that kernels and their callers share.
#: Gradient of the Earth-rotation term of a range with respect to the receiver's position, rounded up (see `geodesy`).
ROTATION_GRADIENT: Final = 1.1e-5
#: Each step of the section search divides a stretch of the line into this number of parts.
FAN_OUT: Final = 8
#: The error of a range is estimated only if the redundancy number of the range is at least this value.
LEAST_REDUNDANCY: Final = 1e-9
#: Cosine of 6 deg. The linear model of the protection level does not apply to points of the line whose direction from
#: the position makes a larger angle with the tangent.
ALONG: Final = 0.9945
#: The section search approximates the line by its tangent up to the next bend, but at most over this distance [m].
CLEAR_M: Final = 200.0
#: A point counts as lying on a tangent if its distance from the tangent is at most this value [m].
ON_TANGENT_M: Final = 1e-3

#: Prior probability of a joint fault of the low satellites on one side of the track: the upper 95 % confidence bound of
#: the fraction of time with such a fault. In 70 simulated hours in a city, 2 of 30 943 blocks of 30 s had such a fault,
#: for a part of the block (docs/level-results.md). Real recordings are shorter, and support only an upper bound of
#: 1e-2.
SUPPORTED_SIDE_PRIOR: Final = 1.3e-5

"""Navigation messages, bit by bit: GPS, QZSS LNAV and CNAV, Galileo I/NAV, F/NAV, BeiDou D1, D2, B-CNAV2, GLONASS.

Each function takes the bits of many messages of one kind and returns their fields, scaled, as arrays.
Angles are turned from semicircles into radians.

Sources: IS-GPS-200N, 20.3.3 and 30.3.3; IS-QZSS-PNT-005, 4.1.2 and 4.3.2; Galileo OS SIS ICD 2.1, 4.2.3 and 4.3.5;
BDS-SIS-ICD-B1I 3.0, 5.2 and 5.3; BDS-SIS-ICD-B2a 1.0, 6.2 and 7 (as cssrlib
1.2.1 reads it); GLONASS ICD L1, L2 5.1, 4.4.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Floats, Masks
from railfix.io.receiver.framing import Field, crc24q, fields

_PI: Final = np.pi


def _p(*exponents: int) -> tuple[float, ...]:
    return tuple(2.0**e for e in exponents)


#: LNAV subframes without parity (10 words of 24 bits); TOW count and number are in all of them.
LNAV_HEAD: Final[dict[str, Field]] = {"tow_s": (24, 17, 6.0, "u"), "subframe": (43, 3, 1.0, "u")}
LNAV: Final[dict[int, dict[str, Field]]] = {
    1: {
        "week": (48, 10, 1.0, "u"),
        "accuracy": (60, 4, 1.0, "u"),
        "health": (64, 6, 1.0, "u"),
        "iodc": (((70, 2), (168, 8)), 10, 1.0, "u"),
        "group_delay_1_s": (160, 8, 2.0**-31, "s"),
        "toc_s": (176, 16, 16.0, "u"),
        "af2": (192, 8, 2.0**-55, "s"),
        "af1": (200, 16, 2.0**-43, "s"),
        "af0_s": (216, 22, 2.0**-31, "s"),
        "codes": (58, 2, 1.0, "u"),
        "flag": (72, 1, 1.0, "u"),
    },
    2: {
        "iode": (48, 8, 1.0, "u"),
        "crs": (56, 16, 2.0**-5, "s"),
        "delta_n": (72, 16, 2.0**-43 * _PI, "s"),
        "m0": (88, 32, 2.0**-31 * _PI, "s"),
        "cuc": (120, 16, 2.0**-29, "s"),
        "eccentricity": (136, 32, 2.0**-33, "u"),
        "cus": (168, 16, 2.0**-29, "s"),
        "sqrt_a": (184, 32, 2.0**-19, "u"),
        "toe_sow_s": (216, 16, 16.0, "u"),
        "fit": (232, 1, 1.0, "u"),
    },
    3: {
        "cic": (48, 16, 2.0**-29, "s"),
        "omega0": (64, 32, 2.0**-31 * _PI, "s"),
        "cis": (96, 16, 2.0**-29, "s"),
        "i0": (112, 32, 2.0**-31 * _PI, "s"),
        "crc": (144, 16, 2.0**-5, "s"),
        "omega": (160, 32, 2.0**-31 * _PI, "s"),
        "omega_dot": (192, 24, 2.0**-43 * _PI, "s"),
        "iode": (216, 8, 1.0, "u"),
        "i_dot": (224, 14, 2.0**-43 * _PI, "s"),
    },
    4: {
        "data_id": (48, 2, 1.0, "u"),
        "page_sv": (50, 6, 1.0, "u"),
        **{
            f"ion{k}": (56 + 8 * k, 8, factor, "s")
            for k, factor in enumerate(_p(-30, -27, -24, -24) + _p(11, 14, 16, 16))
        },
        "leap_seconds": (192, 8, 1.0, "s"),
    },
}
#: Galileo I/NAV words of 128 bits, by word type.
INAV: Final[dict[int, dict[str, Field]]] = {
    1: {
        "iod": (6, 10, 1.0, "u"),
        "toe_sow_s": (16, 14, 60.0, "u"),
        "m0": (30, 32, 2.0**-31 * _PI, "s"),
        "eccentricity": (62, 32, 2.0**-33, "u"),
        "sqrt_a": (94, 32, 2.0**-19, "u"),
    },
    2: {
        "iod": (6, 10, 1.0, "u"),
        "omega0": (16, 32, 2.0**-31 * _PI, "s"),
        "i0": (48, 32, 2.0**-31 * _PI, "s"),
        "omega": (80, 32, 2.0**-31 * _PI, "s"),
        "i_dot": (112, 14, 2.0**-43 * _PI, "s"),
    },
    3: {
        "iod": (6, 10, 1.0, "u"),
        "omega_dot": (16, 24, 2.0**-43 * _PI, "s"),
        "delta_n": (40, 16, 2.0**-43 * _PI, "s"),
        "cuc": (56, 16, 2.0**-29, "s"),
        "cus": (72, 16, 2.0**-29, "s"),
        "crc": (88, 16, 2.0**-5, "s"),
        "crs": (104, 16, 2.0**-5, "s"),
        "accuracy": (120, 8, 1.0, "u"),
    },
    4: {
        "iod": (6, 10, 1.0, "u"),
        "number": (16, 6, 1.0, "u"),
        "cic": (22, 16, 2.0**-29, "s"),
        "cis": (38, 16, 2.0**-29, "s"),
        "toc_s": (54, 14, 60.0, "u"),
        "af0_s": (68, 31, 2.0**-34, "s"),
        "af1": (99, 21, 2.0**-46, "s"),
        "af2": (120, 6, 2.0**-59, "s"),
    },
    5: {
        "group_delay_1_s": (47, 10, 2.0**-32, "s"),
        "group_delay_2_s": (57, 10, 2.0**-32, "s"),
        "e5b_health": (67, 2, 1.0, "u"),
        "e1b_health": (69, 2, 1.0, "u"),
        "e5b_invalid": (71, 1, 1.0, "u"),
        "e1b_invalid": (72, 1, 1.0, "u"),
        "week": (73, 12, 1.0, "u"),
        "tow_s": (85, 20, 1.0, "u"),
    },
    6: {"tow_s": (105, 20, 1.0, "u")},
}
#: CNAV messages of 300 bits; PRN, type and TOW count are in all of them.
CNAV_HEAD: Final[dict[str, Field]] = {
    "number": (8, 6, 1.0, "u"),
    "type": (14, 6, 1.0, "u"),
    "tow_s": (20, 17, 6.0, "u"),
}
CNAV: Final[dict[int, dict[str, Field]]] = {
    10: {
        "week": (38, 13, 1.0, "u"),
        "health": (51, 3, 1.0, "u"),
        "top": (54, 11, 300.0, "u"),
        "accuracy_index": (65, 5, 1.0, "s"),
        "toe_sow_s": (70, 11, 300.0, "u"),
        "delta_a": (81, 26, 2.0**-9, "s"),
        "a_dot": (107, 25, 2.0**-21, "s"),
        "delta_n": (132, 17, 2.0**-44 * _PI, "s"),
        "delta_n_dot": (149, 23, 2.0**-57 * _PI, "s"),
        "m0": (172, 33, 2.0**-32 * _PI, "s"),
        "eccentricity": (205, 33, 2.0**-34, "u"),
        "omega": (238, 33, 2.0**-32 * _PI, "s"),
    },
    11: {
        "toe_sow_s": (38, 11, 300.0, "u"),
        "omega0": (49, 33, 2.0**-32 * _PI, "s"),
        "i0": (82, 33, 2.0**-32 * _PI, "s"),
        "delta_omega_dot": (115, 17, 2.0**-44 * _PI, "s"),
        "i_dot": (132, 15, 2.0**-44 * _PI, "s"),
        "cis": (147, 16, 2.0**-30, "s"),
        "cic": (163, 16, 2.0**-30, "s"),
        "crs": (179, 24, 2.0**-8, "s"),
        "crc": (203, 24, 2.0**-8, "s"),
        "cus": (227, 21, 2.0**-30, "s"),
        "cuc": (248, 21, 2.0**-30, "s"),
    },
    30: {
        "ned_0": (49, 5, 1.0, "s"),
        "ned_1": (54, 3, 1.0, "u"),
        "ned_2": (57, 3, 1.0, "u"),
        "toc_s": (60, 11, 300.0, "u"),
        "af0_s": (71, 26, 2.0**-35, "s"),
        "af1": (97, 20, 2.0**-48, "s"),
        "af2": (117, 10, 2.0**-60, "s"),
        "group_delay_1_s": (127, 13, 2.0**-35, "s"),
        **{f"inter_signal_{k}": (140 + 13 * k, 13, 2.0**-35, "s") for k in range(4)},
        **{
            f"ion{k}": (192 + 8 * k, 8, factor, "s")
            for k, factor in enumerate(_p(-30, -27, -24, -24) + _p(11, 14, 16, 16))
        },
        "week_top": (256, 8, 1.0, "u"),
    },
}
CNAV_NO_DELAY_S: Final = -4096 * 2.0**-35  #: A group delay of CNAV that is not available (IS-GPS-200N, 30.3.3.3.1.1).
#: Semi-major axes [m] that CNAV refers to, and rate of the node [rad/s] (IS-GPS-200N, table 30-I; IS-QZSS-PNT-005).
CNAV_AXIS_M: Final = {"G": 26_559_710.0, "J": 42_164_200.0}
CNAV_OMEGA_DOT: Final = -2.6e-9 * _PI
#: Galileo F/NAV pages of 244 bits, by page type.
FNAV: Final[dict[int, dict[str, Field]]] = {
    1: {
        "number": (6, 6, 1.0, "u"),
        "iod": (12, 10, 1.0, "u"),
        "toc_s": (22, 14, 60.0, "u"),
        "af0_s": (36, 31, 2.0**-34, "s"),
        "af1": (67, 21, 2.0**-46, "s"),
        "af2": (88, 6, 2.0**-59, "s"),
        "accuracy": (94, 8, 1.0, "u"),
        "group_delay_1_s": (143, 10, 2.0**-32, "s"),
        "e5a_health": (153, 2, 1.0, "u"),
        "week": (155, 12, 1.0, "u"),
        "tow_s": (167, 20, 1.0, "u"),
        "e5a_invalid": (187, 1, 1.0, "u"),
    },
    2: {
        "iod": (6, 10, 1.0, "u"),
        "m0": (16, 32, 2.0**-31 * _PI, "s"),
        "omega_dot": (48, 24, 2.0**-43 * _PI, "s"),
        "eccentricity": (72, 32, 2.0**-33, "u"),
        "sqrt_a": (104, 32, 2.0**-19, "u"),
        "omega0": (136, 32, 2.0**-31 * _PI, "s"),
        "i_dot": (168, 14, 2.0**-43 * _PI, "s"),
    },
    3: {
        "iod": (6, 10, 1.0, "u"),
        "i0": (16, 32, 2.0**-31 * _PI, "s"),
        "omega": (48, 32, 2.0**-31 * _PI, "s"),
        "delta_n": (80, 16, 2.0**-43 * _PI, "s"),
        "cuc": (96, 16, 2.0**-29, "s"),
        "cus": (112, 16, 2.0**-29, "s"),
        "crc": (128, 16, 2.0**-5, "s"),
        "crs": (144, 16, 2.0**-5, "s"),
        "toe_sow_s": (160, 14, 60.0, "u"),
    },
    4: {"iod": (6, 10, 1.0, "u"), "cic": (16, 16, 2.0**-29, "s"), "cis": (32, 16, 2.0**-29, "s")},
}
#: BeiDou B-CNAV2 messages of 288 bits, without preamble and parity symbols; PRN, type and SOW are in all of them.
BCNAV2_HEAD: Final[dict[str, Field]] = {"number": (0, 6, 1.0, "u"), "tow_s": (12, 18, 3.0, "u")}
BCNAV2: Final[dict[int, dict[str, Field]]] = {
    10: {
        "week": (30, 13, 1.0, "u"),
        "iode": (53, 8, 1.0, "u"),
        "toe_sow_s": (61, 11, 300.0, "u"),
        "kind": (72, 2, 1.0, "u"),
        "delta_a": (74, 26, 2.0**-9, "s"),
        "a_dot": (100, 25, 2.0**-21, "s"),
        "delta_n": (125, 17, 2.0**-44 * _PI, "s"),
        "delta_n_dot": (142, 23, 2.0**-57 * _PI, "s"),
        "m0": (165, 33, 2.0**-32 * _PI, "s"),
        "eccentricity": (198, 33, 2.0**-34, "u"),
        "omega": (231, 33, 2.0**-32 * _PI, "s"),
    },
    11: {
        "health": (30, 2, 1.0, "u"),
        "flags": (32, 3, 1.0, "u"),
        "sismai": (35, 4, 1.0, "u"),
        "omega0": (42, 33, 2.0**-32 * _PI, "s"),
        "i0": (75, 33, 2.0**-32 * _PI, "s"),
        "omega_dot": (108, 19, 2.0**-44 * _PI, "s"),
        "i_dot": (127, 15, 2.0**-44 * _PI, "s"),
        "cis": (142, 16, 2.0**-30, "s"),
        "cic": (158, 16, 2.0**-30, "s"),
        "crs": (174, 24, 2.0**-8, "s"),
        "crc": (198, 24, 2.0**-8, "s"),
        "cus": (222, 21, 2.0**-30, "s"),
        "cuc": (243, 21, 2.0**-30, "s"),
    },
    30: {
        "toc_s": (42, 11, 300.0, "u"),
        "af0_s": (53, 25, 2.0**-34, "s"),
        "af1": (78, 22, 2.0**-50, "s"),
        "af2": (100, 11, 2.0**-66, "s"),
        "iodc": (111, 10, 1.0, "u"),
        "group_delay_2_s": (121, 12, 2.0**-34, "s"),
        "inter_signal_1": (133, 12, 2.0**-34, "s"),
        "group_delay_1_s": (219, 12, 2.0**-34, "s"),
    },
}
#: Semi-major axes that B-CNAV2 refers to [m]: medium orbits (kind 3), and those of the period of the Earth.
BCNAV2_AXIS_M: Final = {1: 42_162_200.0, 2: 42_162_200.0, 3: 27_906_100.0}
CNAV_CHECKED, FNAV_CHECKED, BCNAV2_CHECKED = 276, 214, 264  #: Bits of CNAV, F/NAV and B-CNAV2 before their CRC.
#: BeiDou: seconds of week and subframe number of D1 and D2 (10 words of 30 bits, parity included).
BDS_HEAD: Final[dict[str, Field]] = {"tow_s": (((18, 8), (30, 12)), 20, 1.0, "u"), "subframe": (15, 3, 1.0, "u")}
D1: Final[dict[int, dict[str, Field]]] = {
    1: {
        "health": (42, 1, 1.0, "u"),
        "aodc": (43, 5, 1.0, "u"),
        "accuracy": (48, 4, 1.0, "u"),
        "week": (60, 13, 1.0, "u"),
        "toc_s": (((73, 9), (90, 8)), 17, 8.0, "u"),
        "group_delay_1_s": (98, 10, 1e-10, "s"),
        "group_delay_2_s": (((108, 4), (120, 6)), 10, 1e-10, "s"),
        "ion0": (126, 8, 2.0**-30, "s"),
        "ion1": (134, 8, 2.0**-27, "s"),
        "ion2": (150, 8, 2.0**-24, "s"),
        "ion3": (158, 8, 2.0**-24, "s"),
        "ion4": (((166, 6), (180, 2)), 8, 2.0**11, "s"),
        "ion5": (182, 8, 2.0**14, "s"),
        "ion6": (190, 8, 2.0**16, "s"),
        "ion7": (((198, 4), (210, 4)), 8, 2.0**16, "s"),
        "af2": (214, 11, 2.0**-66, "s"),
        "af0_s": (((225, 7), (240, 17)), 24, 2.0**-33, "s"),
        "af1": (((257, 5), (270, 17)), 22, 2.0**-50, "s"),
        "aode": (287, 5, 1.0, "u"),
    },
    2: {
        "delta_n": (((42, 10), (60, 6)), 16, 2.0**-43 * _PI, "s"),
        "cuc": (((66, 16), (90, 2)), 18, 2.0**-31, "s"),
        "m0": (((92, 20), (120, 12)), 32, 2.0**-31 * _PI, "s"),
        "eccentricity": (((132, 10), (150, 22)), 32, 2.0**-33, "u"),
        "cus": (180, 18, 2.0**-31, "s"),
        "crc": (((198, 4), (210, 14)), 18, 2.0**-6, "s"),
        "crs": (((224, 8), (240, 10)), 18, 2.0**-6, "s"),
        "sqrt_a": (((250, 12), (270, 20)), 32, 2.0**-19, "u"),
        "toe_high": (290, 2, 1.0, "u"),
    },
    3: {
        "toe_low": (((42, 10), (60, 5)), 15, 1.0, "u"),
        "i0": (((65, 17), (90, 15)), 32, 2.0**-31 * _PI, "s"),
        "cic": (((105, 7), (120, 11)), 18, 2.0**-31, "s"),
        "omega_dot": (((131, 11), (150, 13)), 24, 2.0**-43 * _PI, "s"),
        "cis": (((163, 9), (180, 9)), 18, 2.0**-31, "s"),
        "i_dot": (((189, 13), (210, 1)), 14, 2.0**-43 * _PI, "s"),
        "omega0": (((211, 21), (240, 11)), 32, 2.0**-31 * _PI, "s"),
        "omega": (((251, 11), (270, 21)), 32, 2.0**-31 * _PI, "s"),
    },
}
#: Where each page of D2, subframe 1, begins in the 3000 bits of its ten pages put after each other: page k (1 to 10) at
#: 300 (k - 1); fields that go over a page are given in pieces.
_PAGE: Final = {k: 300 * (k - 1) for k in range(1, 11)}
D2: Final[dict[str, Field]] = {
    "health": (_PAGE[1] + 46, 1, 1.0, "u"),
    "aodc": (_PAGE[1] + 47, 5, 1.0, "u"),
    "accuracy": (_PAGE[1] + 60, 4, 1.0, "u"),
    "week": (_PAGE[1] + 64, 13, 1.0, "u"),
    "toc_s": (((_PAGE[1] + 77, 5), (_PAGE[1] + 90, 12)), 17, 8.0, "u"),
    "group_delay_1_s": (_PAGE[1] + 102, 10, 1e-10, "s"),
    "group_delay_2_s": (_PAGE[1] + 120, 10, 1e-10, "s"),
    "af0_s": (((_PAGE[3] + 100, 12), (_PAGE[3] + 120, 12)), 24, 2.0**-33, "s"),
    "af1": (((_PAGE[3] + 132, 4), (_PAGE[4] + 46, 6), (_PAGE[4] + 60, 12)), 22, 2.0**-50, "s"),
    "af2": (((_PAGE[4] + 72, 10), (_PAGE[4] + 90, 1)), 11, 2.0**-66, "s"),
    "aode": (_PAGE[4] + 91, 5, 1.0, "u"),
    "delta_n": (_PAGE[4] + 96, 16, 2.0**-43 * _PI, "s"),
    "cuc": (((_PAGE[4] + 120, 14), (_PAGE[5] + 46, 4)), 18, 2.0**-31, "s"),
    "m0": (((_PAGE[5] + 50, 2), (_PAGE[5] + 60, 22), (_PAGE[5] + 90, 8)), 32, 2.0**-31 * _PI, "s"),
    "cus": (((_PAGE[5] + 98, 14), (_PAGE[5] + 120, 4)), 18, 2.0**-31, "s"),
    "eccentricity": (((_PAGE[5] + 124, 10), (_PAGE[6] + 46, 6), (_PAGE[6] + 60, 16)), 32, 2.0**-33, "u"),
    "sqrt_a": (((_PAGE[6] + 76, 6), (_PAGE[6] + 90, 22), (_PAGE[6] + 120, 4)), 32, 2.0**-19, "u"),
    "cic": (((_PAGE[6] + 124, 10), (_PAGE[7] + 46, 6), (_PAGE[7] + 60, 2)), 18, 2.0**-31, "s"),
    "cis": (_PAGE[7] + 62, 18, 2.0**-31, "s"),
    "toe_sow_s": (((_PAGE[7] + 80, 2), (_PAGE[7] + 90, 15)), 17, 8.0, "u"),
    "i0": (
        ((_PAGE[7] + 105, 7), (_PAGE[7] + 120, 14), (_PAGE[8] + 46, 6), (_PAGE[8] + 60, 5)),
        32,
        2.0**-31 * _PI,
        "s",
    ),
    "crc": (((_PAGE[8] + 65, 17), (_PAGE[8] + 90, 1)), 18, 2.0**-6, "s"),
    "crs": (_PAGE[8] + 91, 18, 2.0**-6, "s"),
    "omega_dot": (((_PAGE[8] + 109, 3), (_PAGE[8] + 120, 16), (_PAGE[9] + 46, 5)), 24, 2.0**-43 * _PI, "s"),
    "omega0": (((_PAGE[9] + 51, 1), (_PAGE[9] + 60, 22), (_PAGE[9] + 90, 9)), 32, 2.0**-31 * _PI, "s"),
    "omega": (((_PAGE[9] + 99, 13), (_PAGE[9] + 120, 14), (_PAGE[10] + 46, 5)), 32, 2.0**-31 * _PI, "s"),
    "i_dot": (((_PAGE[10] + 51, 1), (_PAGE[10] + 60, 13)), 14, 2.0**-43 * _PI, "s"),
}
#: GLONASS strings of 85 bits, the idle bit first, by number.
GLONASS: Final[dict[int, dict[str, Field]]] = {
    1: {
        "hour": (9, 5, 3600.0, "u"),
        "minute": (14, 6, 60.0, "u"),
        "half_minute": (20, 1, 30.0, "u"),
        "x_velocity": (21, 24, 2.0**-20, "m"),
        "x_acceleration": (45, 5, 2.0**-30, "m"),
        "x": (50, 27, 2.0**-11, "m"),
    },
    2: {
        "health": (5, 3, 1.0, "u"),
        "tb_s": (9, 7, 900.0, "u"),
        "y_velocity": (21, 24, 2.0**-20, "m"),
        "y_acceleration": (45, 5, 2.0**-30, "m"),
        "y": (50, 27, 2.0**-11, "m"),
    },
    3: {
        "relative_frequency": (6, 11, 2.0**-40, "m"),
        "ln": (20, 1, 1.0, "u"),
        "z_velocity": (21, 24, 2.0**-20, "m"),
        "z_acceleration": (45, 5, 2.0**-30, "m"),
        "z": (50, 27, 2.0**-11, "m"),
    },
    4: {
        "tau_s": (5, 22, 2.0**-30, "m"),
        "age": (32, 5, 1.0, "u"),
        "day": (59, 11, 1.0, "u"),
        "slot": (70, 5, 1.0, "u"),
    },
}
#: User range accuracy of GPS, QZSS and BeiDou [m] by index, the nominal values that RINEX writes
#: (IS-GPS-200N, 20.3.3.3.1.3).
URA_NOMINAL_M: Final = np.array([2, 2.8, 4, 5.7, 8, 11.3, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192])


def inav_words(words: np.ndarray[tuple[int, int], np.dtype[np.uint32]]) -> tuple[Bytes, Masks]:
    """Words of Galileo I/NAV page pairs as bits, shape (N, 128), and which have a valid CRC (even page first, no alert
    page).

    `words`, shape (N, 8): even page (four words of 32 bits, 120 bits used), then odd page.
    """
    octets = words[:, :8].astype(">u4").view(np.uint8).reshape(len(words), 32)
    bits = np.unpackbits(octets, axis=1)
    even, odd = bits[:, :120], bits[:, 128:248]
    checked = np.concatenate([np.zeros((len(bits), 4), np.uint8), even[:, :114], odd[:, :82]], axis=1)
    data = np.packbits(checked, axis=1)
    start = np.arange(len(data)) * data.shape[1]
    crc = crc24q(data.reshape(-1), start, start + data.shape[1])
    sent = fields(odd, {"crc": (82, 24, 1.0, "u")})["crc"]
    valid = (even[:, 0] == 0) & (odd[:, 0] == 1) & (even[:, 1] == 0) & (odd[:, 1] == 0) & (crc == sent)
    return np.concatenate([even[:, 2:114], odd[:, 2:18]], axis=1), valid


def has_crc(bits: Bytes, checked: int) -> Masks:
    """Whether the 24 bits after the first `checked` are their CRC-24Q, shape (N,)."""
    before = np.zeros((len(bits), -checked % 8), dtype=np.uint8)
    data = np.packbits(np.concatenate([before, bits[:, :checked]], axis=1), axis=1)
    start = np.arange(len(data)) * data.shape[1]
    crc = crc24q(data.reshape(-1), start, start + data.shape[1])
    return np.asarray(crc == fields(bits, {"crc": (checked, 24, 1.0, "u")})["crc"])


def sisa_m(index: Floats) -> Floats:
    """Signal-in-space accuracy of Galileo [m] by index; NaN where no prediction is available (ICD, table 89)."""
    i = np.asarray(index)
    value = np.select(
        [i < 50, i < 75, i < 100, i < 126],
        [0.01 * i, 0.5 + 0.02 * (i - 50), 1.0 + 0.04 * (i - 75), 2.0 + 0.16 * (i - 100)],
        default=np.nan,
    )
    return np.asarray(value)


def glonass_hamming(bits: Bytes) -> Masks:
    """Whether GLONASS strings of 85 bits pass their Hamming code (ICD, 4.7), shape (N,)."""
    # Bit 85 of the ICD is sent first. Its data bits 9 to 85 have the places of a Hamming code that are no powers of
    # two, in this order; check bit k covers the places with bit k set. Check bits are the ICD's bits 1 to 7.
    value = bits[:, 84::-1].astype(np.int64)
    places = np.array([place for place in range(1, 86) if place & (place - 1)])[:77]
    checks = [(value[:, 8:][:, places >> k & 1 == 1].sum(axis=1) + value[:, k]) & 1 for k in range(7)]
    total = value.sum(axis=1) & 1
    wrong = np.stack(checks, axis=1).any(axis=1)
    return np.asarray(~wrong & (total == 0))
